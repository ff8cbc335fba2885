"""The simulator behind a `SimulatorModel`: one instance of an environment, put into states and stepped."""

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
from gymnasium import spaces

from pgts_torch.errors import PgtsError, failure
from pgts_torch.models.actions import all_actions
from pgts_torch.models.adapters import adapter_for
from pgts_torch.models.adapters_generic import Layered, inside
from pgts_torch.models.answers import Seen, Step, observed
from pgts_torch.models.chance import Chance
from pgts_torch.models.environments import EnvSource, Given
from pgts_torch.models.masks import ActionMasks
from pgts_torch.models.rewards import RewardRange
from pgts_torch.models.snapshots import SnapshotAdapter, env_name
from pgts_torch.models.steps import (
    LARGEST_REWARD,
    check_observation,
    check_rewards,
    discount_of,
    names_discounts,
    number_of,
)
from pgts_torch.models.wrappers import Transforms, transforms_of


@final
class Stepper:
    """An instance without its wrappers, whose transforms are applied to actions, rewards and observations; with
    `Layered`, one with those of its wrappers that have an effect.

    name: of the environment.   env: the instance.   space: of observations, outside of the wrappers.
    actions: as the instance takes them, in the order of their numbers.
    steps: how often it was stepped.   chance: its generator, watched.   clock: what `Clock` says of it.

    Args:
        env, gamma, actions, adapter, observe, masks: as in `SimulatorModel`, which says what is raised.
    """

    def __init__(
        self,
        env: Given,
        *,
        gamma: float,
        actions: Sequence[Any] | None,
        adapter: SnapshotAdapter | None,
        observe: Callable[[Any], Any] | None,
        masks: ActionMasks | None = None,
    ) -> None:
        self.made = EnvSource.of(env).make_one()
        self.name = env_name(self.made)
        self.adapter = adapter or adapter_for(self.made)
        self.env: Any = inside(self.made, self.adapter)
        # Wrappers that belong to the instance itself are no transforms of what it gives.
        self.transforms = Transforms() if isinstance(self.adapter, Layered) else transforms_of(self.made)
        self.space = self.made.observation_space
        self._pays, self._observe, self._masks = bool(self.transforms.rewards), observe, masks
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
        shows_masks = masks is not None and masks.source == "observation"
        self._show = None if shows_masks else self.adapter.skip_observations(self.env)
        self._names_discounts, self._gamma = names_discounts(self.env), gamma
        self._inner_space = self.env.observation_space
        # With discounts of its own a step might read the clock for these too.
        self.clock = None if self._names_discounts else self.adapter.clock(self.env)
        self.chance = Chance(self.env, self.adapter)
        self.steps = 0

    @property
    def observes_late(self) -> bool:
        """Whether steps make no observation, so that one is made only of a state that is asked for."""
        return self._show is not None

    def follow(self, data: Any, taken: Any, key: int | None, repeat: int, rewards: RewardRange | None) -> Step:
        """Take an action so many times, or until the episode ends: the discounted sum of rewards, the product of
        discounts, and the state reached.

        Args:
            data: of the snapshot of the state in which it begins.
            taken: one of `actions`.
            key: decides what is random; None: nothing may be. `Step.random` is None then, where only the generator
                knows: `chance` can be looked at afterwards, of several steps at once.
            rewards: between which numbers the reward of each step must be.
        """
        # total, discount: sum_i gamma_0 ... gamma_{i-1} r_i and gamma_0 ... gamma_{k-1} of the k steps made so far.
        env, adapter, shown = self.env, self.adapter, self._show is None
        adapter.set_state(env, data)
        total, discount = 0.0, 1.0
        random: bool | None = False
        for _ in range(repeat):
            # Where the adapter cannot tell whether chance decides, the generator does: it moves if it is drawn from.
            # The key seeds it for the first draw only; later draws of the same outcome go on from there.
            known = adapter.is_random(env, taken)
            if not random and (known or (known is None and key is not None)):
                self.chance.seed(key or 0)
            observation, reward, terminated, truncated, info = env.step(taken)
            self.steps += 1
            if known is None and key is not None:
                known = self.chance.was_drawn()
            if known or random is False:
                random = known
            reading = None if self.clock is None else self.clock.reading(reward, truncated)
            reward = self._reward(reward, rewards)
            if shown:
                check_observation(self._inner_space, observation)
            total += discount * reward
            if terminated:
                discount = 0.0
            elif self._names_discounts:
                discount *= discount_of(info, self._gamma, named=True)
            else:
                discount *= self._gamma
            if discount == 0 or truncated:
                break
        # Truncation is part of the state, unless the episode has also ended: then nothing follows anyway.
        reached = adapter.get_state(env)
        if truncated and discount:
            reached = reached._replace(cut=True)
        seen = Seen(reached, self._kept(observation) if shown else None)
        if self._masks is not None:
            seen.legal = self._legal(observation, info, terminated, truncated)
        return Step(total, discount, seen, random, reading if repeat == 1 else None)

    def follow_each(
        self, requests: Sequence[tuple[Any, Any]], repeat: int, rewards: RewardRange | None, found: list[Step]
    ) -> None:
        """What follows the action of each request, as `follow` without a key, added to those `found`. Where one fails,
        its step and those after it are missing there.

        Args:
            requests: the data of a snapshot and one of `actions`, each.
        """
        if repeat > 1 or self._names_discounts:
            for data, taken in requests:
                found.append(self.follow(data, taken, None, repeat, rewards))
            return
        env, adapter, clock, gamma, shown = self.env, self.adapter, self.clock, self._gamma, self._show is None
        masks = self._masks
        set_state, get_state, step, add = adapter.set_state, adapter.get_state, env.step, found.append
        tells = type(adapter).is_random is not SnapshotAdapter.is_random
        # Rewards and observations that are plain numbers are not looked into one by one.
        as_paid, rows = rewards is None and not self._pays, self._rows(len(requests))
        shape, dtype = (None, None) if rows is None else (rows.shape[1:], rows.dtype)
        for i, (data, taken) in enumerate(requests):
            set_state(env, data)
            random = adapter.is_random(env, taken) if tells else None
            if random:
                self.chance.seed(0)
            observation, reward, terminated, truncated, info = step(taken)
            self.steps += 1
            reading = None if clock is None else clock.reading(reward, truncated)
            if not (as_paid and type(reward) is float and -LARGEST_REWARD <= reward <= LARGEST_REWARD):
                reward = self._reward(reward, rewards)
            kept = None
            is_row = type(observation) is np.ndarray and observation.dtype is dtype and observation.shape == shape
            if rows is not None and is_row:
                rows[i] = observation
                kept = rows[i]
            elif shown:
                check_observation(self._inner_space, observation)
                kept = self._kept(observation)
            reached = get_state(env)
            if truncated and gamma and not terminated:
                reached = reached._replace(cut=True)
            seen = Seen(reached, kept)
            if masks is not None:
                seen.legal = self._legal(observation, info, terminated, truncated)
            add(Step(reward, 0.0 if terminated else gamma, seen, random, reading))
        if rows is not None and not np.isfinite(rows).all():
            first = int(np.flatnonzero(~np.isfinite(rows).reshape(len(rows), -1).all(1))[0])
            del found[first:]
            check_observation(self._inner_space, rows[first])

    def _rows(self, count: int) -> np.ndarray | None:
        """Room for so many observations, where these are numbers that are kept as they are; else None."""
        space = self._inner_space
        is_plain = self._show is None and self._observe is None and not self.transforms.observations
        if is_plain and isinstance(space, spaces.Box) and space.dtype.kind == "f":
            return np.zeros((count, *space.shape), space.dtype)
        return None

    def at_count(self, step: Step, count: int, rewards: RewardRange | None = None) -> Step:
        """What follows an action where the clock is at another count after it."""
        reading, seen = step.reading, step.child
        assert self.clock is not None
        assert reading is not None
        reward = self._reward(self.clock.reward(reading, count), rewards) if reading.pays else step.reward
        reached = self.clock.at(seen.snapshot, count)
        if count >= reading.limit and step.discount:
            reached = reached._replace(cut=True)
        now = Seen(reached, seen.observation, seen.like or seen, seen.legal)
        return Step(reward, step.discount, now, step.random, reading)

    def _legal(self, observation: Any, info: Any, terminated: bool, truncated: bool) -> bytes | None:
        """The legal actions after a step, as `Seen` has them."""
        assert self._masks is not None
        legal_A = self._masks.after(self.made, observation, info, terminated, truncated)
        return legal_A.tobytes() if legal_A.any() else None

    def _reward(self, paid: Any, rewards: RewardRange | None) -> float:
        """A reward outside of the wrappers; what is not finite is found before it is transformed."""
        reward = number_of("reward", paid)
        check_rewards(reward)
        if self._pays:
            reward = number_of("reward", self.transforms.reward(reward))
        if rewards is not None:
            rewards.check(reward)
        return reward

    def observation(self, data: Any) -> Any:
        """The observation of a state by the data of its snapshot, where steps make none."""
        assert self._show is not None
        self.adapter.set_state(self.env, data)
        inner = self._show()
        check_observation(self._inner_space, inner)
        return self._kept(inner)

    def _kept(self, observation: Any) -> Any:
        """What is kept of an observation outside of the wrappers, in the dtype that their space declares."""
        if self.transforms.observations:
            observation = self.transforms.observation(observation)
            if isinstance(self.space, spaces.Box):
                observation = np.asarray(observation, self.space.dtype)
        return observed(observation, self._observe)
