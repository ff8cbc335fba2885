"""Experience: what a policy does in an environment, or in a model of it."""

from dataclasses import dataclass
from typing import Any, Literal, final

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.agent.policies import Policy
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import SamplingModel
from pgts_torch.seeding import draw_keys, seed_sequence

StateWeight = Literal["occupancy", "visits", "uniform"]


@final
@dataclass(frozen=True)
class FixedHorizon:
    """Every episode runs for `length` steps or until it terminates; a visit counts by its discounts so far."""

    length: int = 50

    def __post_init__(self) -> None:
        if self.length < 1:
            raise PgtsError(f"horizon length is {self.length}; it must be at least 1")

    @property
    def limit(self) -> int:
        """The most steps of an episode."""
        return self.length

    def survival(self, discount_B: Float[Tensor, "B"], generator: torch.Generator) -> Float[Tensor, "B"]:
        """What one unit of weight is worth after a step of this discount: the discount."""
        return discount_B.double()

    def check_end(self, num_alive: int) -> None:
        """Episodes may be alive at the limit."""


@final
@dataclass(frozen=True)
class GeometricHorizon:
    """After each step an episode goes on with probability gamma; every visit counts fully.

    So visits are an unbiased sample of d^pi, and undiscounted sums of rewards one of v^pi. `max_length` is a guard
    against processes that never end (gamma = 1): reaching it is an error.
    """

    max_length: int = 100_000

    def __post_init__(self) -> None:
        if self.max_length < 1:
            raise PgtsError(f"max_length is {self.max_length}; it must be at least 1")

    @property
    def limit(self) -> int:
        """The most steps of an episode."""
        return self.max_length

    def survival(self, discount_B: Float[Tensor, "B"], generator: torch.Generator) -> Float[Tensor, "B"]:
        """What one unit of weight is worth after a step of this discount: 1 with that probability, else 0."""
        uniform_B = torch.rand(discount_B.shape, generator=generator, dtype=torch.float64, device=discount_B.device)
        return (uniform_B < discount_B).double()

    def check_end(self, num_alive: int) -> None:
        """PgtsError if episodes are alive at the limit."""
        if num_alive:
            raise PgtsError(
                f"an episode outlived max_length = {self.max_length} steps of the geometric horizon; is gamma 1?"
            )


Horizon = FixedHorizon | GeometricHorizon


@dataclass(frozen=True, eq=False)
class Rollout:
    """B episodes, step by step; where an episode is over, its row is padded and `alive_TB` is False.

    reward_TB: in reward units.   discount_TB: of the transition itself, 0 where it terminated.
    weight_TB: what a visit counts for in the occupancy: the product of the discounts before it (fixed horizon) or 1
        (geometric horizon); 0 where the episode is over.
    survival_TB: what one later unit of weight is worth now: weight_{t+1} = weight_t * survival_t.
    """

    state_TB: Int[Tensor, "T B"]
    action_TB: Int[Tensor, "T B"]
    reward_TB: Float[Tensor, "T B"]
    discount_TB: Float[Tensor, "T B"]
    next_state_TB: Int[Tensor, "T B"]
    alive_TB: Bool[Tensor, "T B"]
    weight_TB: Float[Tensor, "T B"]
    survival_TB: Float[Tensor, "T B"]

    @property
    def num_steps(self) -> int:
        """Transitions made, padding not counted."""
        return int(self.alive_TB.sum())

    @property
    def num_episodes(self) -> int:
        return self.state_TB.shape[1]

    @property
    def follows_TB(self) -> Bool[Tensor, "T B"]:
        """Whether the next row goes on with the same episode."""
        return torch.cat([self.alive_TB[1:], torch.zeros_like(self.alive_TB[:1])])

    def returns(self) -> Float[Tensor, "B"]:
        """Weighted reward of each episode: an estimate of J^pi, unbiased for the geometric horizon."""
        return (self.weight_TB * self.reward_TB).sum(0)

    def visits(self, state_weight: StateWeight) -> tuple[Int[Tensor, "N"], Float[Tensor, "N"]]:
        """The distinct visited states, ascending, and w(s) of each.

        occupancy:  mean over episodes of sum_t weight_t 1(s_t = s), an estimate of d^pi(s)    [PGTS Sec. 2]
        visits:     share of s among all visits
        uniform:    1
        """
        states, row_V = self.state_TB[self.alive_TB].unique(return_inverse=True)
        if state_weight == "uniform":
            return states, torch.ones(len(states), dtype=self.weight_TB.dtype, device=states.device)
        if state_weight == "visits":
            count_V = torch.full_like(self.weight_TB[self.alive_TB], 1 / len(row_V))
        else:
            count_V = self.weight_TB[self.alive_TB] / self.num_episodes
        weight_N = torch.zeros(len(states), dtype=count_V.dtype, device=states.device)
        return states, weight_N.index_add_(0, row_V, count_V)


def rollout(
    env: gymnasium.vector.VectorEnv,
    policy: Policy,
    horizon: Horizon,
    *,
    gamma: float,
    seed: int,
    names: tuple[str | int, ...],
    generator: torch.Generator,
) -> Rollout:
    """One episode of each copy of a vector environment, from a fresh reset.

    What happens is a function of (seed, names), the policy and nothing else: the environment is seeded anew.

    Args:
        env: copies with discrete observations and actions, in `AutoresetMode.DISABLED`.
        gamma: discount of a step whose `info` names none.
        seed, names: the environment's own stream.
        generator: draws actions and the geometric horizon.

    Raises:
        PgtsError: an episode outlived `max_length` of the geometric horizon.
    """
    words = seed_sequence(seed, *names, "env").generate_state(env.num_envs)
    observation, _ = env.reset(seed=words.tolist())
    state_B = torch.from_numpy(np.array(observation, dtype=np.int64)).to(generator.device)
    alive_B = torch.ones_like(state_B, dtype=torch.bool)
    weight_B = torch.ones_like(state_B, dtype=torch.float64)
    rows: list[tuple[Tensor, ...]] = []
    while len(rows) < horizon.limit and bool(alive_B.any()):
        action_B = policy.sample(state_B, generator=generator)
        reward_B, discount_B, next_B, truncated_B = _step(env, action_B, gamma)
        survival_B = horizon.survival(discount_B, generator)
        rows.append((state_B, action_B, reward_B, discount_B, next_B, alive_B, weight_B * alive_B, survival_B))
        weight_B = weight_B * survival_B
        alive_B = alive_B & (survival_B > 0) & ~truncated_B
        state_B = next_B
    horizon.check_end(int(alive_B.sum()))
    return Rollout(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _step(
    env: gymnasium.vector.VectorEnv, action_B: Int[Tensor, "B"], gamma: float
) -> tuple[Float[Tensor, "B"], Float[Tensor, "B"], Int[Tensor, "B"], Bool[Tensor, "B"]]:
    """Rewards, discounts, next states, and whether a copy was truncated; copies that are over start again."""
    device = action_B.device
    observation, reward, terminated, truncated, info = env.step(action_B.cpu().numpy())
    discount = np.where(terminated, 0.0, info.get("discount", gamma))
    over = terminated | truncated
    if over.any():
        env.reset(options={"reset_mask": over})
    return (
        torch.from_numpy(np.asarray(reward, dtype=np.float64)).to(device),
        torch.from_numpy(discount).to(device),
        torch.from_numpy(np.array(observation, dtype=np.int64)).to(device),
        torch.from_numpy(truncated).to(device),
    )


def simulated_returns(
    model: SamplingModel,
    policy: Policy,
    state_B: Int[Tensor, "B"],
    horizon: Horizon,
    *,
    first_action_B: Int[Tensor, "B"] | None = None,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "B"], int]:
    """The weighted reward of one episode in the model from each given state, and how many steps they took together.

    The first action is given or the policy's own. Episodes that are over cost nothing more.

    Raises:
        PgtsError: an episode outlived `max_length` of the geometric horizon.
    """
    returns_B = torch.zeros(len(state_B), dtype=torch.float64, device=state_B.device)
    row_N, state_N, weight_N = torch.arange(len(state_B), device=state_B.device), state_B, torch.ones_like(returns_B)
    action_N = policy.sample(state_B, generator=generator) if first_action_B is None else first_action_B
    num_steps = 0
    for _ in range(horizon.limit):
        drawn = model.sample(state_N, action_N, key_N=draw_keys(len(state_N), generator=generator))
        returns_B[row_N] += weight_N * drawn.reward_N
        num_steps += len(row_N)
        weight_N = weight_N * horizon.survival(drawn.discount_N, generator)
        alive_N = weight_N > 0
        row_N, state_N, weight_N = row_N[alive_N], drawn.next_state_N[alive_N], weight_N[alive_N]
        if len(row_N) == 0:
            break
        action_N = policy.sample(state_N, generator=generator)
    horizon.check_end(len(row_N))
    return returns_B, num_steps


def make_vector_env(env_id: str, num_envs: int, *, gamma: float | None, **kwargs: Any) -> gymnasium.vector.VectorEnv:
    """Copies of a registered environment that reset by mask, without its time limit: the horizon is ours.

    Args:
        gamma: handed to environments that carry a discount of their own (pgts/*), if given.

    Raises:
        PgtsError: Gymnasium knows no such environment or cannot make it.
    """
    if num_envs < 1:
        raise PgtsError(f"num_envs is {num_envs}; it must be at least 1")
    options: dict[str, Any] = {"max_episode_steps": -1, **kwargs}
    try:
        if gymnasium.spec(env_id).namespace == "pgts":
            options |= {} if gamma is None else {"gamma": gamma}
            options |= {"vectorization_mode": "vector_entry_point", "autoreset_mode": AutoresetMode.DISABLED}
        else:
            options |= {"vectorization_mode": "sync", "vector_kwargs": {"autoreset_mode": AutoresetMode.DISABLED}}
        return gymnasium.make_vec(env_id, num_envs=num_envs, **options)
    except (gymnasium.error.Error, ImportError, LookupError, TypeError) as error:
        raise PgtsError(f"{env_id} cannot be made: {error}") from error


def check_vector_env(env: gymnasium.vector.VectorEnv) -> None:
    """PgtsError unless rollouts can be made in this environment: discrete spaces, reset by mask."""
    if not isinstance(env, gymnasium.vector.VectorEnv):
        raise PgtsError(f"the environment is {env!r}; it must be a Gymnasium id or a VectorEnv")
    for name in ("single_observation_space", "single_action_space"):
        space = getattr(env, name)
        if not isinstance(space, gymnasium.spaces.Discrete) or space.start != 0:
            raise PgtsError(f"{name} is {space}; tabular policies need Discrete(n) counted from 0")
    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.DISABLED:
        raise PgtsError(f"the environment resets by {mode}; make it with autoreset_mode=AutoresetMode.DISABLED")
