"""Gymnasium's vectorised CartPole as environments that are reset by mask, each with a random generator of its own."""

from collections.abc import Sequence
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from jaxtyping import Float

_ENTRY_POINTS = tuple(f"gymnasium.envs.classic_control.cartpole:CartPole{kind}Env" for kind in ("", "Vector"))
_NO_LIMIT = 2**31 - 1
_TRIED_ENVS, _TRIED_STEPS = 3, 20


@final
class CartPoles(CartPoleVectorEnv):
    """`num_envs` CartPoles without a time limit, whose steps are a few array operations for all.

    Starts, steps and generators are those of as many `CartPoleEnv` in a SyncVectorEnv with the same seeds, in
    `AutoresetMode.DISABLED`.

    Args:
        options: `sutton_barto_reward`, `render_mode`.

    Raises:
        ResetNeeded: `step` before the first reset, or of an environment whose episode is over.
    """

    state: Any

    def __init__(self, num_envs: int, spec: EnvSpec, **options: Any) -> None:
        super().__init__(num_envs, max_episode_steps=_NO_LIMIT, **options)
        self.spec, self.metadata = spec, self.metadata | {"autoreset_mode": AutoresetMode.DISABLED}
        self._generators = [np_random()[0] for _ in range(num_envs)]

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "B 4"], dict[str, Any]]:
        """Start new episodes in all environments, or in those of `options["reset_mask"]` [B].

        Args:
            seed: one for each environment, or that of the first, which the others count on from.
        """
        mask_B = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        if self.state is None:
            if not mask_B.all():
                raise ResetNeeded("Cannot reset some environments before env.reset() has started all of them")
            self.state = np.zeros((4, self.num_envs))
        seeds = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
        for b in mask_B.nonzero()[0]:
            if seeds is not None:
                self._generators[b] = np_random(seeds[b])[0]
            self.state[:, b] = self._generators[b].uniform(self.low, self.high, size=4)
        self.steps[mask_B], self.prev_done[mask_B] = 0, False
        return self.state.T.astype(np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one step in each environment."""
        if self.state is None or self.prev_done.any():
            raise ResetNeeded("Cannot step environments that were not reset, or whose episode is over")
        return super().step(action)


def is_cart_pole(spec: EnvSpec, options: dict[str, Any]) -> bool:
    """Whether `CartPoles` with these options are the environments of a spec, as it is registered and as its code is in
    this process: tried for a few steps, in which every bit must be the same."""
    registered = (spec.entry_point, spec.vector_entry_point) == _ENTRY_POINTS and not spec.additional_wrappers
    if not registered or not options.keys() <= {"sutton_barto_reward"}:
        return False
    make = [lambda: gymnasium.make(spec, max_episode_steps=-1, **options)] * _TRIED_ENVS
    single = SyncVectorEnv(make, autoreset_mode=AutoresetMode.DISABLED)
    forms, random = (single, CartPoles(_TRIED_ENVS, spec, **options)), np.random.default_rng(0)
    first, second = (form.reset(seed=0)[0] for form in forms)
    same = np.array_equal(first, second)
    for _ in range(_TRIED_STEPS):
        actions = random.integers(0, 2, _TRIED_ENVS)
        (*one, _), (*other, _) = (form.step(actions) for form in forms)
        same &= all(map(np.array_equal, one, other))
        if not same:
            break
        if (over_B := one[2] | one[3]).any():
            first, second = (form.reset(seed=1, options={"reset_mask": over_B})[0] for form in forms)
            same &= np.array_equal(first, second)
    return bool(same)
