"""Whether the transforms of wrappers are functions of single values: a random walk through them."""

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np

from pgts_torch.models.attributes import attributes, different, fingerprint
from pgts_torch.models.trial import environment_code, random_walk
from pgts_torch.models.wrappers import hook_of, refusal, transforms_of, wrappers_of

_TRIED_STEPS, _LONGEST, _SECONDS = 60, 20, 0.2
"""How long the trial of wrappers is, and the episodes in it."""


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
    transforms, hooked = transforms_of(env), [wrapper for wrapper in wrappers_of(env) if hook_of(wrapper)]
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
            raise refusal(env, wrapper, "which remembers something from step to step")
    # The environment is in another state by now, and the wrappers have been used in between.
    for (taken, observation, reward), (action, seen, paid) in zip(recorder.inside, outside, strict=True):
        with environment_code():
            pairs = {"observation": (transforms.observation(observation), seen)}
            if action is not None:
                pairs |= {"action": (transforms.action(action), taken), "reward": (transforms.reward(reward), paid)}
        for kind, (now, then) in pairs.items():
            if fingerprint(now) != fingerprint(then):
                outermost = next((wrapper for wrapper in hooked if hook_of(wrapper) == kind), hooked[0])
                raise refusal(env, outermost, f"which makes different things of the same {kind}")


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
