"""Wrappers as a model needs them: looked through where they change nothing, applied where they transform one number or
one observation, and refused where they do more than that."""

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import getattr_static
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import ActionWrapper, ObservationWrapper, RewardWrapper, wrappers

from pgts_torch.errors import MissingModel
from pgts_torch.models.attributes import attributes, different, fingerprint
from pgts_torch.models.snapshots import env_name

_HARMLESS = (
    wrappers.TimeLimit,
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.RecordEpisodeStatistics,
    wrappers.HumanRendering,
    wrappers.RenderCollection,
    wrappers.RecordVideo,
)
"""Wrappers that have a `step` of their own and change neither observations nor rewards. Subclasses may."""

_HOOKS = {ActionWrapper: "action", ObservationWrapper: "observation", RewardWrapper: "reward", gymnasium.Wrapper: ""}
"""What a wrapper transforms whose `step` and `reset` are those of this base class of Gymnasium."""

_TRIED_STEPS, _SECONDS = 60, 0.2
"""How long the trial of wrappers is."""


@dataclass(frozen=True)
class Transforms:
    """What the wrappers of an environment make of actions, rewards and observations, each a function of that value.

    actions: the outermost wrapper's function first.   rewards, observations: the innermost one's first.
    """

    actions: tuple[Callable[[Any], Any], ...] = ()
    rewards: tuple[Callable[[Any], Any], ...] = ()
    observations: tuple[Callable[[Any], Any], ...] = ()

    def action(self, action: Any) -> Any:
        """The action of the environment inside its wrappers."""
        return _through(self.actions, action)

    def reward(self, reward: Any) -> Any:
        """The reward outside of the wrappers."""
        return _through(self.rewards, reward)

    def observation(self, observation: Any) -> Any:
        """The observation outside of the wrappers."""
        return _through(self.observations, observation)


def wrappers_of(env: gymnasium.Env) -> list[gymnasium.Wrapper]:
    """The wrappers around an environment, the outermost first."""
    found = []
    while isinstance(env, gymnasium.Wrapper):
        found.append(env)
        env = env.env
    return found


def transforms_of(env: gymnasium.Env) -> Transforms:
    """The transforms of the wrappers of an environment, by their classes (`check_transforms` compares them with steps).

    Raises:
        MissingModel: a wrapper has a `step` or a `reset` of its own, and is not known to change nothing.
    """
    hooks: dict[str, list[Callable[[Any], Any]]] = {"action": [], "reward": [], "observation": []}
    for wrapper in wrappers_of(env):
        kind = _kind(wrapper)
        if kind is None:
            raise refusal(env, wrapper, "which may change what a step gives")
        if kind:
            hooks[kind].append(getattr(wrapper, kind))
    return Transforms(tuple(hooks["action"]), tuple(hooks["reward"][::-1]), tuple(hooks["observation"][::-1]))


def check_transforms(env: gymnasium.Env, actions: Sequence[Any], generator: np.random.Generator) -> None:
    """Check in a random walk that the transforms of wrappers have no memory and use no chance: the same value is
    transformed alike in any state, and no attribute of a wrapper changes.

    Args:
        env: an instance for this alone; it is stepped.
        actions: its actions, as its outermost wrapper takes them, from which those of the walk are sampled.

    Raises:
        MissingModel: as `transforms_of` does, or a wrapper has a memory, or uses chance.
    """
    transforms, hooked = transforms_of(env), [wrapper for wrapper in wrappers_of(env) if _kind(wrapper)]
    if not hooked:
        return
    before = attributes(env)
    raw, seen = _walk(env, actions, generator)
    changed = different(before, attributes(env))
    for wrapper in hooked:
        if any(name.startswith(f"{type(wrapper).__name__}.") for name in changed):
            raise refusal(env, wrapper, "which remembers something from step to step")
    # The environment is in another state by now, and the wrappers have been used in between.
    for (taken, observation, reward), (action, outside, paid) in zip(raw, seen, strict=True):
        if fingerprint(transforms.observation(observation)) != fingerprint(outside):
            raise refusal(env, _with("observation", hooked), "which makes different things of the same observation")
        if action is None:
            continue
        if fingerprint(transforms.action(action)) != fingerprint(taken):
            raise refusal(env, _with("action", hooked), "which makes different things of the same action")
        if fingerprint(transforms.reward(reward)) != fingerprint(paid):
            raise refusal(env, _with("reward", hooked), "which makes different things of the same reward")


_Seen = tuple[Any, Any, Any]
"""Action, observation and reward of a step; the first and the last are None in a reset."""


def _walk(
    env: gymnasium.Env, actions: Sequence[Any], generator: np.random.Generator
) -> tuple[list[_Seen], list[_Seen]]:
    """A random walk, as recorded inside the wrappers and outside of them."""
    base, until = cast(Any, env.unwrapped), time.monotonic() + _SECONDS
    raw, seen, inside = list[_Seen](), list[_Seen](), False

    def recorded(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal inside
            if inside:  # an environment may step itself in its reset
                return method(*args, **kwargs)
            inside = True
            try:
                answer = method(*args, **kwargs)
            finally:
                inside = False
            raw.append(copy.deepcopy((args[0], *answer[:2]) if len(answer) > 2 else (None, answer[0], None)))
            return answer

        return call

    own = {name: vars(base)[name] for name in ("step", "reset") if name in vars(base)}
    base.step, base.reset = recorded(base.step), recorded(base.reset)
    try:
        over = True
        for _ in range(_TRIED_STEPS):
            if over:
                observation, _ = env.reset(seed=int(generator.integers(2**31)))
                seen.append(copy.deepcopy((None, observation, None)))
            action = actions[int(generator.integers(len(actions)))]
            observation, paid, terminated, truncated, _ = env.step(action)
            seen.append(copy.deepcopy((action, observation, paid)))
            over = terminated or truncated
            if time.monotonic() > until:
                break
    finally:
        del base.step, base.reset
        vars(base).update(own)
    return raw, seen


def _kind(wrapper: gymnasium.Wrapper) -> str | None:
    """The name of the method that makes the transform of a wrapper; empty: it changes nothing; None: unknown."""
    own, cls = vars(wrapper).keys() & {"step", "reset"}, type(wrapper)
    if own or cls in _HARMLESS:
        return None if own else ""
    for base, hook in _HOOKS.items():
        if isinstance(wrapper, base) and all(
            getattr_static(cls, name) is getattr_static(base, name) for name in ("step", "reset")
        ):
            return hook
    return None


def _with(kind: str, hooked: Sequence[gymnasium.Wrapper]) -> gymnasium.Wrapper:
    """The outermost wrapper that transforms this."""
    return next((wrapper for wrapper in hooked if _kind(wrapper) == kind), hooked[0])


def _through(functions: Sequence[Callable[[Any], Any]], value: Any) -> Any:
    for function in functions:
        value = function(value)
    return value


def refusal(env: gymnasium.Env, wrapper: gymnasium.Wrapper, why: str) -> MissingModel:
    """The error that names a wrapper and the ways out."""
    return MissingModel(
        f"{env_name(env)} is wrapped in {type(wrapper).__name__}, {why}, and a model only knows the environment "
        "inside: leave it out, or make it part of an environment with get_state and set_state"
    )
