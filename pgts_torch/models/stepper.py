"""The simulator behind a `SimulatorModel`: one instance of an environment, put into states and stepped."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np
from gymnasium import spaces

from pgts_torch.errors import PgtsError, failure
from pgts_torch.models.actions import all_actions
from pgts_torch.models.adapters import adapter_for
from pgts_torch.models.environments import EnvSource, Given
from pgts_torch.models.rewards import RewardRange
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter, env_name, generator_state
from pgts_torch.models.steps import check_step, discount_of, names_discounts, number_of
from pgts_torch.models.wrappers import transforms_of


@final
class Stepper:
    """An instance without its wrappers, whose transforms are applied to actions, rewards and observations.

    name: of the environment.   env: the instance.   space: of observations, outside of the wrappers.
    actions: as the instance takes them, in the order of their numbers.
    steps: how often it was stepped.

    Args:
        env, gamma, actions, adapter: as in `SimulatorModel`, which says what is raised.
    """

    def __init__(
        self, env: Given, *, gamma: float, actions: Sequence[Any] | None, adapter: SnapshotAdapter | None
    ) -> None:
        self.made = EnvSource.of(env).make_one()
        self.name = env_name(self.made)
        self.env: Any = self.made.unwrapped
        self.adapter = adapter or adapter_for(self.made)
        self.transforms, self.space = transforms_of(self.made), self.made.observation_space
        # Actions as the outermost wrapper takes them, and as the bare instance does.
        outer = all_actions(self.made.action_space) if actions is None else actions
        self.actions = [self.transforms.action(action) for action in outer]
        if not self.actions:
            raise PgtsError("actions is empty; a model needs at least one")
        try:
            # Only to have a state at all: the first snapshot replaces it.
            self.env.reset(seed=0)
        except BaseException as error:
            raise failure(f"{self.name} failed in reset with seed 0", error) from error
        # What makes the observation of the present state, where steps do not.
        self._show = self.adapter.skip_observations(self.env)
        self._names_discounts, self._gamma = names_discounts(self.env), gamma
        self._observation: Any = None
        self.steps = 0

    def follow(
        self, data: Any, taken: Any, key: int, *, repeat: int, rewards: RewardRange | None
    ) -> tuple[float, float, Snapshot, bool]:
        """Take an action so many times, or until the episode ends.

        Args:
            data: of the snapshot of the state in which it begins.
            taken: one of `actions`.
            key: decides what is random.
            rewards: between which numbers the reward of each step must be.

        Returns:
            The discounted sum of rewards, the product of discounts, the state reached, and whether chance was involved.
        """
        # total, discount: sum_i gamma_0 ... gamma_{i-1} r_i and gamma_0 ... gamma_{k-1} of the k steps made so far.
        self.adapter.set_state(self.env, data)
        total, discount, random = 0.0, 1.0, False
        for _ in range(repeat):
            # Where the adapter cannot tell whether chance decides, the generator does: it moves if it is drawn from.
            # The key seeds it for the first draw only; later draws of the same outcome go on from there.
            known = self.adapter.is_random(self.env, taken)
            if known is not False and not random:
                self.adapter.seed(self.env, key)
            before = generator_state(self.env) if known is None else None
            self._observation, reward, terminated, truncated, info = self.env.step(taken)
            self.steps += 1
            random |= generator_state(self.env) != before if known is None else known
            # What is not finite or does not fit its space is found before it is transformed.
            if self._show is None:
                self._checked(self._observation, number_of("reward", reward))
            reward = number_of("reward", self.transforms.reward(reward))
            if rewards is not None:
                rewards.check(reward)
            total += discount * reward
            discount *= 0.0 if terminated else discount_of(info, self._gamma, named=self._names_discounts)
            if discount == 0 or truncated:
                break
        # Truncation is part of the state, unless the episode has also ended: then nothing follows anyway.
        reached = self.adapter.get_state(self.env)
        return total, discount, replace(reached, cut=True) if truncated and discount else reached, random

    def observation(self, reward: float) -> Any:
        """The observation of the state that `follow` has reached, outside of the wrappers and in the dtype that their
        space declares. It is checked beside a reward where steps make none."""
        inner = self._observation if self._show is None else self._checked(self._show(), reward)
        if not self.transforms.observations:
            return inner
        outside = self.transforms.observation(inner)
        return np.asarray(outside, self.space.dtype) if isinstance(self.space, spaces.Box) else outside

    def _checked(self, observation: Any, reward: float) -> Any:
        """The observation; PgtsError unless it and the reward are what the environment declares."""
        check_step(self.env.observation_space, observation, reward)
        return observation
