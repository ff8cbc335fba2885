"""Environments whose states can only be reached by their own steps, as those of physics engines."""

import io
import pickle
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.core import RenderFrame
from gymnasium.wrappers import TimeLimit

from pgts_torch.errors import PgtsError
from pgts_torch.trust import import_named


@final
class Retraced(gymnasium.Env[Any, Any]):
    """An environment whose state is how its episode came about: the reset, the actions since then, and what they drew
    from. A state is restored by resetting and taking these actions again.

    So a lookahead needs no `get_state` of an environment that holds what does not pickle, as Box2D's LunarLander. The
    price: a state t steps into an episode takes a reset and t steps to restore, once for each action that a lookahead
    tries there. Restored states are compared with the environment as those of any other simulator are, which also
    finds one whose resets remember earlier episodes or whose steps draw from elsewhere than its `np_random`.

    Args:
        env: the environment, with any wrappers; a time limit among them is a part of its state.

    Attributes:
        retraced: how many steps were taken again so far.

    Raises:
        PgtsError: env is no environment of Gymnasium, or its actions are not numbers or vectors.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        if not isinstance(env, gymnasium.Env):
            raise PgtsError(f"Retraced takes a gymnasium.Env, not {type(env).__name__}")
        if not isinstance(env.action_space, spaces.Discrete | spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary):
            raise PgtsError(f"{type(env.unwrapped).__name__} cannot be retraced: its actions are {env.action_space}")
        self._env = env
        self.action_space, self.observation_space = env.action_space, env.observation_space
        self.metadata, self.render_mode = env.metadata, env.render_mode
        # How the present state came about, and the state of the generator in which that left it.
        self._path, self._left = b"", None
        self.retraced = 0
        if env.has_wrapper_attr("action_masks"):
            self.action_masks = env.get_wrapper_attr("action_masks")

    @property
    def np_random(self) -> np.random.Generator:
        """The generator of the environment inside."""
        return self._env.unwrapped.np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self._env.unwrapped.np_random = generator

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """That of the environment inside."""
        before = None if seed is not None else self._generator()
        began = self._env.reset(seed=seed, options=options)
        self._left = self._generator()
        self._path = pickle.dumps((seed, None if self._left == before else before, options), 5)
        return began

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """That of the environment inside."""
        taken = int(action) if isinstance(self.action_space, spaces.Discrete) else np.array(action)
        before, path = self._generator(), self._path
        self._path = b""  # unknown, should the step fail
        step = self._env.step(taken)
        after = self._generator()
        # What is drawn in an episode that goes on by itself follows from its beginning.
        goes_on = before in (after, self._left)
        self._path = path + pickle.dumps((taken, None if goes_on else before), 5)
        if after != before:
            self._left = after
        return step

    def get_state(self) -> bytes:
        """The reset and the steps since then, one pickle after another."""
        return self._path

    def set_state(self, state: bytes) -> None:
        """Go there, from the present state where it lies on the way; the generator stays as it is."""
        generator, file, here = self._generator(), io.BytesIO(state), self._path
        self._path = b""
        if here and state.startswith(here):
            file.seek(len(here))
            self._draw_from(self._left)
        else:
            seed, before, options = pickle.load(file)
            self._draw_from(before)
            self._env.reset(seed=seed, options=options)
        while file.tell() < len(state):
            action, before = pickle.load(file)
            self._draw_from(before)
            self._env.step(action)
            self.retraced += 1
        self._path, self._left = state, self._generator()
        self._draw_from(generator)

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        """That of the environment inside."""
        return self._env.render()

    def close(self) -> None:
        """Close the environment inside."""
        self._env.close()

    def _generator(self) -> Any:
        return self.np_random.bit_generator.state

    def _draw_from(self, state: Any) -> None:
        if state is not None:
            self.np_random.bit_generator.state = state


def retraced(env: str = "", render_mode: str | None = None, **kwargs: Any) -> gymnasium.Env:
    """`Retraced`, of a registered environment; its time limit stays outside.

    Args:
        env: its id; MODULE:ID imports the module first.
        kwargs: its arguments.

    Raises:
        PgtsError: no id is given.
    """
    if not env:
        raise PgtsError("retraced/Env-v0 needs the id of an environment: --env.kwargs.env LunarLander-v3, for instance")
    module, colon, id = env.rpartition(":")
    if colon:
        import_named(module)
    options: dict[str, Any] = {"max_episode_steps": -1, "disable_env_checker": True, "render_mode": render_mode}
    inside = gymnasium.make(id, **options, **kwargs)
    assert inside.spec is not None
    limit = gymnasium.spec(inside.spec.id).max_episode_steps
    whole: gymnasium.Env = Retraced(inside)
    return whole if limit is None else TimeLimit(whole, limit)
