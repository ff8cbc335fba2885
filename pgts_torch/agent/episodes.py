"""One episode in each of several environments, step by step."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal, final

import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from pgts_torch.errors import PgtsError, failure
from pgts_torch.models.masks import KEY, ActionMasks, Masked
from pgts_torch.models.snapshots import each_of, env_name
from pgts_torch.models.steps import (
    check_discounts,
    check_info,
    check_observation,
    check_rewards,
    discount_of,
    names_discounts,
    number_of,
    rewards_of,
)

UNLIMITED_LENGTH = 1000
"""The length at which episodes that are not trained on are cut off where the environment has no time limit."""


@final
class Episodes:
    """One episode in each environment, from `reset` on.

    An environment whose episode is over is not stepped any more where environments can be stepped one by one (a plain
    `SyncVectorEnv`); else it is reset, and its further steps are ignored.

    Args:
        env: environments in `AutoresetMode.DISABLED`.
        gamma: discount of a step that does not end the episode. An environment with `metadata["discounts"] = True` may
            name another one in `info["discount"]`.
        seeds: one for the reset of each environment.
        masks: how action masks are read; "off": they are not, if there are any; None: there are none.
    """

    def __init__(
        self,
        env: VectorEnv,
        *,
        gamma: float,
        seeds: list[int],
        masks: ActionMasks | Literal["off"] | None = None,
    ) -> None:
        self._env, self._gamma, self._seeds = env, gamma, seeds
        self._one_by_one = isinstance(env, SyncVectorEnv) and type(env).step is SyncVectorEnv.step
        self._names_discounts = [names_discounts(one) for one in each_of(env)]
        self._all_name_discounts = all(self._names_discounts)
        self._over_B = np.zeros(env.num_envs, dtype=bool)
        self._reward_B = np.zeros(env.num_envs)
        self._stepping: int | None = None  # the index of the environment whose step is running
        self._each: list[Any] = []  # the latest observation of each environment, where these are stepped one by one
        self._observation: Any = None
        self._masks = masks if isinstance(masks, ActionMasks) else None
        self._unmasked = masks is None
        self._legal_BA = np.zeros((0, 0), dtype=bool)  # rows without a legal action: the episode is over

    @property
    def observation(self) -> Any:
        """The latest observation of each environment; `Masked` where there are action masks."""
        return self._observation if self._masks is None else Masked(self._observation, self._legal_BA)

    def reset(self) -> None:
        """Begin the episodes."""
        self._observation, info = self._env.reset(seed=self._seeds)  # type: ignore[arg-type]  # or one seed for all
        if self._one_by_one:
            self._each = list(iterate(self._env.observation_space, self._observation))
            for b in range(self._env.num_envs):
                self._check_actions(b)
        if self._masks is not None:
            self._legal_BA = self._read_masks(info, np.ones(self._env.num_envs, dtype=bool))

    def restart(self, over_B: np.ndarray, seeds: list[int]) -> None:
        """Begin new episodes in some environments.

        Args:
            over_B: in which.
            seeds: one for each environment; only those of `over_B` are used.
        """
        self._seeds, self._over_B = seeds, self._over_B & ~over_B
        if not self._one_by_one:
            self._reset_some(over_B, seeds)
            return
        assert isinstance(self._env, SyncVectorEnv)
        self._legal_BA = self._legal_BA.copy()
        for b in over_B.nonzero()[0]:
            self._stepping = int(b)
            self._each[b], info = self._env.envs[b].reset(seed=seeds[b])
            self._check_actions(int(b))
            if self._masks is not None:
                self._legal_BA[b] = self._masks.of(self._env.envs[b], self._each[b], info)
        self._stepping = None
        self._join()

    def _reset_some(self, over_B: np.ndarray, seeds: list[int] | None) -> None:
        """Reset the environments of `over_B`, with a seed each."""
        self._observation, info = self._env.reset(seed=seeds, options={"reset_mask": over_B})  # type: ignore[arg-type]
        if self._masks is not None:
            self._legal_BA = np.where(over_B[:, None], self._read_masks(info, over_B), self._legal_BA)

    def _read_masks(self, info: dict[str, Any], needed_B: np.ndarray) -> np.ndarray:
        """The legal actions of all environments, by what they have just returned together."""
        assert self._masks is not None

        def reads(b: int) -> None:
            self._stepping = b

        legal_BA = self._masks.of_all(self._env, self._observation, info, needed_B, reads)
        self._stepping = None
        return legal_BA

    def step(self, action_B: np.ndarray, alive_B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take one step. Return rewards, discounts and truncations; they have no meaning outside `alive_B`.

        Args:
            alive_B: the episodes that are not over.

        Raises:
            NotFinite: a reward or a discount is not finite, or a reward is too large to be learned from.
            PgtsError: a reward is not one number, or a discount is not in [0, 1].
        """
        step = self._step_alive if self._one_by_one else self._step_all
        reward_B, discount_B, truncated_B = step(action_B, alive_B)
        check_rewards(reward_B)
        return reward_B, discount_B, truncated_B

    def _step_all(self, action_B: np.ndarray, alive_B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if self._over_B.any():
            self._reset_some(self._over_B, None)
        if self._masks is not None:  # of episodes that are over any legal action will do
            action_B = np.where(alive_B, action_B, self._legal_BA.argmax(-1))
        self._observation, rewards, terminated_B, truncated_B, info = self._env.step(action_B)
        self._over_B = terminated_B | truncated_B
        if self._masks is not None:
            self._legal_BA = self._read_masks(info, ~self._over_B) & ~terminated_B[:, None]
        elif self._unmasked and KEY in info:
            self._refuse_masks()
        discount: Any = self._gamma
        if self._all_name_discounts and "discount" in info:
            # info["_discount"] is True where an environment has named a discount in this step.
            discount = np.where(info.get("_discount", True), info["discount"], self._gamma)
        discount_B = np.where(terminated_B, 0.0, discount)
        if discount is not self._gamma:
            check_discounts(discount_B)
        return rewards_of(rewards, self._env.num_envs), discount_B, truncated_B

    def _step_alive(self, action_B: np.ndarray, alive_B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        assert isinstance(self._env, SyncVectorEnv)
        envs = self._env.envs
        reward_B, discount_B = np.zeros((2, len(envs)))
        self._reward_B = reward_B
        truncated_B, masks, self._legal_BA = np.zeros(len(envs), dtype=bool), self._masks, self._legal_BA.copy()
        for b in alive_B.nonzero()[0]:
            self._stepping = int(b)
            self._each[b], reward, terminated, truncated_B[b], info = envs[b].step(action_B[b])
            check_info(info)
            if masks is not None:
                self._legal_BA[b] = masks.after(envs[b], self._each[b], info, terminated, truncated_B[b])
            elif self._unmasked and KEY in info:
                self._refuse_masks()
            reward_B[b] = number_of("reward", reward)
            discount_B[b] = 0.0 if terminated else discount_of(info, self._gamma, named=self._names_discounts[b])
        self._stepping = None
        self._join()
        return reward_B, discount_B, truncated_B

    def _join(self) -> None:
        """Make one observation of those of all environments."""
        space = self._env.single_observation_space
        rows: Any = create_empty_array(space, n=len(self._each))
        self._observation = concatenate(space, self._each, rows)

    def _check_actions(self, b: int) -> None:
        """PgtsError if a reset has changed the action space of an environment."""
        assert isinstance(self._env, SyncVectorEnv)
        space, known = self._env.envs[b].action_space, self._env.single_action_space
        if space is not known and space != known:
            self._stepping = b
            raise PgtsError(
                f"its actions are {space} after a reset, and were {known}: they must be the same in all episodes; "
                "action masks say which of them are legal"
            )

    def _refuse_masks(self) -> None:
        raise PgtsError(
            f"info has {KEY!r} after a step and had none after a reset, so that nothing is known of the first actions: "
            "give a mask after each reset, too, or set action_masks to 'off'"
        )

    @contextmanager
    def named(self, when: str) -> Iterator[None]:
        """A context whose errors become PgtsErrors that name the environment, `when`, and the seeds of the episodes
        that may have caused them."""
        try:
            yield
        except BaseException as error:
            seeds, cause = self._cause(error)
            which = (
                f"the episode with the seed {seeds[0]}" if len(seeds) == 1 else f"the episodes with the seeds {seeds}"
            )
            raise failure(f"{env_name(self._env)} failed {when} of {which}", cause) from error

    def _cause(self, error: BaseException) -> tuple[list[int], BaseException]:
        """The seeds of the environments that may have caused an error, and the error.

        Where a single environment has returned something invalid, these are its seed and the error that says so.
        """
        if self._stepping is not None:
            return [self._seeds[self._stepping]], error
        space = self._env.single_observation_space
        for seed, observation, reward in zip(self._seeds, self._each, self._reward_B, strict=False):
            try:
                check_rewards(float(reward))
                check_observation(space, observation)
            except PgtsError as found:
                return [seed], found
        return self._seeds, error
