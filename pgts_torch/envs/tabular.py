"""A tabular MDP as a Gymnasium environment."""

from functools import cached_property
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.core import RenderFrame
from gymnasium.error import ResetNeeded

from pgts_torch.envs.drawing import Drawing
from pgts_torch.envs.sampler import OutcomeSampler
from pgts_torch.errors import PgtsError
from pgts_torch.tabular.mdp import TabularMDP

RENDER_FPS = 4


@final
class TabularEnv(gymnasium.Env):
    """A tabular MDP to act in: the observation is the state's number.

    A step pays the reward of the sampled outcome. `info["discount"]` is its discount (`metadata["discounts"]`), and
    `terminated` says that it is 0. Where the MDP does not allow all actions, `info["action_mask"]` has a 1 for those
    that it does. There is no time limit inside; registration adds one as a wrapper.

    Args:
        mdp: the MDP; kept as `mdp`.
        render_mode: "ansi", "rgb_array" or None.

    Raises:
        PgtsError: the render mode, an action, or a state to start in does not exist; or an action is not allowed.
        ResetNeeded: `step` or `render` before the first reset, or `step` after the end of the episode.
    """

    metadata = {  # noqa: RUF012 (Gymnasium's type)
        "render_modes": ["ansi", "rgb_array"],
        "render_fps": RENDER_FPS,
        "discounts": True,  # info["discount"] is the discount of a step
    }

    def __init__(self, mdp: TabularMDP, *, render_mode: str | None = None) -> None:
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.mdp = mdp
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Discrete(mdp.num_states)
        self.action_space = gymnasium.spaces.Discrete(mdp.num_actions)
        self.last_action: int | None = None
        self.num_steps = 0
        self._sampler = OutcomeSampler(mdp)
        self._state: int | None = None
        self._ended = False

    @property
    def state(self) -> int | None:
        """Where the episode stands, None before the first reset. Setting it goes on from there, as a planner may."""
        return self._state

    @state.setter
    def state(self, state: int) -> None:
        if isinstance(state, bool) or not isinstance(state, int | np.integer) or not 0 <= state < self.mdp.num_states:
            raise PgtsError(f"state {state!r} does not exist; states are 0 to {self.mdp.num_states - 1}")
        self._state, self._ended = int(state), False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, dict[str, Any]]:
        """Start an episode in a state sampled from the start distribution, or in `options["state"]`."""
        super().reset(seed=seed)
        check_options(options, ("state",))
        given = (options or {}).get("state")
        self.state = int(self._sampler.starts(self.np_random, 1)[0]) if given is None else given
        self.last_action = None
        self.num_steps = 0
        assert self._state is not None
        return self._state, {**self._sampler.masks(self._state)}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Sample one outcome of the state and the action."""
        if self._state is None:
            raise ResetNeeded("Cannot call env.step() before calling env.reset()")
        if self._ended:
            raise ResetNeeded(f"the episode ended in state {self._state}; call env.reset() before the next env.step()")
        if not self.action_space.contains(action):
            raise PgtsError(f"action {action!r} does not exist; actions are 0 to {self.mdp.num_actions - 1}")
        self._sampler.check_legal(np.array([self._state]), np.array([action]))
        pair = self._state * self.mdp.num_actions + int(action)
        (outcome,) = self._sampler.outcomes(self.np_random, np.array([pair]))
        discount = float(self._sampler.discount_SAK.take(outcome))
        self._state = int(self._sampler.child_SAK.take(outcome))
        self._ended = discount == 0
        self.last_action = int(action)
        self.num_steps += 1
        info = {"discount": discount, **self._sampler.masks(self._state)}
        return self._state, float(self._sampler.reward_SAK.take(outcome)), self._ended, False, info

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        """A text or a picture [height, width, 3], as `render_mode` says."""
        if self.render_mode is None:
            raise PgtsError("render_mode is None; give render_mode='ansi' or 'rgb_array' to gymnasium.make")
        if self._state is None:
            raise ResetNeeded("Cannot call env.render() before calling env.reset()")
        if self.render_mode == "ansi":
            return self._drawing.text(self._state, last_action=self.last_action, num_steps=self.num_steps)
        return self._drawing.picture(self._state)

    @cached_property
    def _drawing(self) -> Drawing:
        return Drawing(self.mdp)


def check_render_mode(render_mode: str | None, known: list[str]) -> None:
    """Raise PgtsError unless the mode is None or known."""
    if render_mode is not None and render_mode not in known:
        raise PgtsError(f"render_mode is {render_mode!r}; it must be None or one of {known}")


def check_options(options: dict[str, Any] | None, known: tuple[str, ...]) -> None:
    """Raise PgtsError if a reset option would be ignored."""
    for name in options or {}:
        if name not in known:
            raise PgtsError(f"reset has no option {name!r}; it has {', '.join(known)}")
