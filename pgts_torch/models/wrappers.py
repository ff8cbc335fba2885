"""Wrappers as a model needs them: looked through where they change nothing, applied where they transform one number or
one observation, and refused where they do more than that."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import getattr_static
from typing import Any

import gymnasium
import numpy as np
from gymnasium import ActionWrapper, ObservationWrapper, RewardWrapper, wrappers

from pgts_torch.errors import MissingModel
from pgts_torch.models.attributes import attributes, different, fingerprint
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.trial import environment_code, random_walk

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

_TRIED_STEPS, _LONGEST, _SECONDS = 60, 20, 0.2
"""How long the trial of wrappers is, and the episodes in it."""


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
    """The transforms of the wrappers of an environment, by their classes (`check_transforms` compares them with steps).

    Raises:
        MissingModel: a wrapper has a `step` or a `reset` of its own, and is not known to change nothing.
    """
    hooks: dict[str, list[Callable[[Any], Any]]] = {"action": [], "reward": [], "observation": []}
    for wrapper in wrappers_of(env):
        kind = _kind(wrapper)
        if kind is None:
            raise _refusal(env, wrapper, "which may change what a step gives")
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
        Failed: the environment raises.
    """
    transforms, hooked = transforms_of(env), [wrapper for wrapper in wrappers_of(env) if _kind(wrapper)]
    if not hooked:
        return
    before = attributes(env)
    innermost = wrappers_of(env)[-1]
    innermost.env = recorder = _Recorder(innermost.env)
    walk = random_walk(env, actions, generator, steps=_TRIED_STEPS, longest=_LONGEST, seconds=_SECONDS)
    outside = [_copied(taken.action, taken.observation, taken.reward) for taken in walk]
    innermost.env = recorder.env
    changed = different(before, attributes(env))
    for wrapper in hooked:
        if any(name.startswith(f"{type(wrapper).__name__}.") for name in changed):
            raise _refusal(env, wrapper, "which remembers something from step to step")
    # The environment is in another state by now, and the wrappers have been used in between.
    for (taken, observation, reward), (action, seen, paid) in zip(recorder.inside, outside, strict=True):
        with environment_code():
            pairs = {"observation": (transforms.observation(observation), seen)}
            if action is not None:
                pairs |= {"action": (transforms.action(action), taken), "reward": (transforms.reward(reward), paid)}
        for kind, (now, then) in pairs.items():
            if fingerprint(now) != fingerprint(then):
                outermost = next((wrapper for wrapper in hooked if _kind(wrapper) == kind), hooked[0])
                raise _refusal(env, outermost, f"which makes different things of the same {kind}")


def _copied(action: Any, observation: Any, reward: Any) -> tuple[Any, Any, Any]:
    """What a step took and gave, in objects of its own; action and reward are None in a reset."""
    with environment_code():
        return copy.deepcopy((action, observation, reward))


class _Recorder(gymnasium.Wrapper):
    """Between an environment and its wrappers: records what passes."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.inside: list[tuple[Any, Any, Any]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        answer = self.env.reset(seed=seed, options=options)
        self.inside.append(_copied(None, answer[0], None))
        return answer

    def step(self, action: Any) -> Any:
        answer = self.env.step(action)
        self.inside.append(_copied(action, *answer[:2]))
        return answer


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


def _through(functions: Sequence[Callable[[Any], Any]], value: Any) -> Any:
    for function in functions:
        value = function(value)
    return value


def _refusal(env: gymnasium.Env, wrapper: gymnasium.Wrapper, why: str) -> MissingModel:
    """The error that names a wrapper and the ways out."""
    return MissingModel(
        f"{env_name(env)} is wrapped in {type(wrapper).__name__}, {why}, and a model only knows the environment "
        "inside: leave it out, or make it part of an environment with get_state and set_state"
    )
