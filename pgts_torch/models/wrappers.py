"""Wrappers as a model needs them: looked through where they change nothing, applied where they transform one number or
one observation, and refused where they do more than that."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import getattr_static
from typing import Any

import gymnasium
from gymnasium import ActionWrapper, ObservationWrapper, RewardWrapper, wrappers

from pgts_torch.errors import MissingModel
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


def with_effect(env: gymnasium.Env) -> list[gymnasium.Wrapper]:
    """Those of its wrappers that may change actions, observations, rewards or ends, the outermost first."""
    return [wrapper for wrapper in wrappers_of(env) if type(wrapper) not in _HARMLESS]


def only_with_effect(env: gymnasium.Env) -> gymnasium.Env:
    """The environment without those of its wrappers that have none; it is changed."""
    outer = with_effect(env)
    for wrapper, inside in zip(outer, [*outer[1:], env.unwrapped], strict=True):
        wrapper.env = inside
    return outer[0] if outer else env.unwrapped


def transforms_of(env: gymnasium.Env) -> Transforms:
    """The transforms of the wrappers of an environment, by their classes (`wrapper_trial` compares them with steps).

    Raises:
        MissingModel: a wrapper has a `step` or a `reset` of its own, and is not known to change nothing.
    """
    hooks: dict[str, list[Callable[[Any], Any]]] = {"action": [], "reward": [], "observation": []}
    for wrapper in wrappers_of(env):
        kind = hook_of(wrapper)
        if kind is None:
            raise refusal(env, wrapper, "which may change what a step gives")
        if kind:
            hooks[kind].append(getattr(wrapper, kind))
    return Transforms(tuple(hooks["action"]), tuple(hooks["reward"][::-1]), tuple(hooks["observation"][::-1]))


def hook_of(wrapper: gymnasium.Wrapper) -> str | None:
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
