"""What the tests of this folder share: experience of a known policy, and how far a sample lies from the truth."""

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from torch import Tensor

from pgts_torch.agent.collect import rollout
from pgts_torch.agent.policies import Policy, SimplexPolicy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.envs import TabularVectorEnv
from pgts_torch.models.tabular import tabular_truth
from pgts_torch.options.rollouts import Horizon
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP


def following(pi_SA: Tensor) -> SimplexPolicy:
    """The policy with these probabilities."""
    policy = SimplexPolicy(*pi_SA.shape)
    policy.load_state_dict({"probs_SA": pi_SA.double()})  # a state of another dtype is refused
    return policy


def vector_env(mdp: TabularMDP, num_envs: int, **kwargs) -> TabularVectorEnv:
    return TabularVectorEnv(mdp, num_envs, autoreset_mode=AutoresetMode.DISABLED, **kwargs)


def experience(
    mdp: TabularMDP, pi_SA: Tensor, horizon: Horizon, *, episodes: int, seed: int = 0, gamma=np.nan
) -> Rollout:
    """Episodes in the MDP, which knows its own discounts: `gamma` must not be needed."""
    return made_in(vector_env(mdp, episodes), following(pi_SA), horizon, gamma=gamma, seed=seed)


def made_in(
    env: VectorEnv,
    policy: Policy,
    horizon: Horizon,
    *,
    gamma: float,
    seed: int = 0,
    names: tuple[str | int, ...] = ("test",),
    generator: torch.Generator | None = None,
) -> Rollout:
    """A rollout in the world of these environments; `gamma` is the discount of steps that name none."""
    world = TabularWorld(env, tabular_truth(env, gamma=0.9), masks="off")
    world.gamma = gamma
    generator = generator or stream(seed, *names)
    return rollout(world, policy, horizon, seed=seed, names=names, generator=generator)


def by_hand(reward: float = 1.0, shows: Tensor | None = None) -> Rollout:
    """Three episodes of rewards 1, 2, 4 (times `reward`) with discounts 0.5: the first is cut after three steps, the
    second terminates in its third, the third is cut after two. States 0, 1, 2, 3 follow each other, and show rows of
    `shows`, or their number."""
    column = reward * torch.tensor([[1.0], [2.0], [4.0]], dtype=torch.float64).expand(3, 3)
    discount_TB = torch.full((3, 3), 0.5, dtype=torch.float64)
    discount_TB[2, 1] = 0.0
    alive_TB = torch.tensor([[1, 1, 1], [1, 1, 1], [1, 1, 0]], dtype=torch.bool)
    survival_TB = torch.tensor([[1, 1, 1], [1, 1, 0], [1, 0, 0]], dtype=torch.float64)
    state_UB = torch.arange(4)[:, None].expand(4, 3)
    observation_UB = state_UB if shows is None else shows[state_UB]
    return Rollout(observation_UB, state_UB[:-1] % 2, column, discount_TB, alive_TB, column, survival_TB)


def transitions(made: Rollout) -> list[tuple[int, int, float, float, int]]:
    """The distinct (state, action, reward, discount, next state) that happened."""
    columns = (made.state_TB, made.action_TB, made.reward_TB, made.discount_TB, made.next_state_TB)
    rows = torch.stack([column[made.alive_TB].double() for column in columns], -1).unique(dim=0).tolist()
    return [(int(s), int(a), reward, discount, int(child)) for s, a, reward, discount, child in rows]


def weight_by_episode(made: Rollout, weight_TB: Tensor, num_states: int) -> Tensor:
    """sum_t weight_t 1(s_t = s) of each episode, shape [B, S]."""
    T, B = made.state_TB.shape
    table_BS = torch.zeros(B, num_states, dtype=torch.float64)
    episode_TB = torch.arange(B).expand(T, B)
    weight_TB = torch.where(made.alive_TB, weight_TB.double(), 0.0)
    return table_BS.index_put_((episode_TB, made.state_TB), weight_TB, accumulate=True)


def z_scores(sample_BX: Tensor, truth_X: Tensor) -> Tensor:
    """How many standard errors the mean of the sample lies from the truth; 0 where a sample without spread is right."""
    error_X = sample_BX.mean(0) - truth_X
    spread_X = sample_BX.std(0) / len(sample_BX) ** 0.5
    right_X = (error_X.abs() <= 1e-12) & (spread_X <= 1e-12)
    return torch.where(right_X, 0.0, error_X / spread_X)


def visit_z_scores(weight_BS: Tensor, d_S: Tensor) -> Tensor:
    """z_scores of the states that more than 200 episodes visit, or should: rarer means are not yet normal."""
    count_S = (weight_BS != 0).sum(0).maximum(d_S * len(weight_BS))
    assert (count_S > 200).any()
    return torch.where(count_S > 200, z_scores(weight_BS, d_S), 0.0)


def log_slope(count: list[int], error: list[float]) -> float:
    """The exponent p in error ~ count^p, by least squares."""
    return float(np.polyfit(np.log(count), np.log(error), 1)[0])


def same_bits(first: Rollout, second: Rollout) -> bool:
    columns = [name for name, value in vars(first).items() if isinstance(value, Tensor)]
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in columns)
