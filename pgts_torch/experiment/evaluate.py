"""How good a policy is, by episodes that nothing is learned from."""

import math
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import scipy.stats
import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.policies import Policy, SimplexPolicy
from pgts_torch.agent.rollout import FixedHorizon, rollout
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.tracking import CHECKPOINTS
from pgts_torch.seeding import stream

UNLIMITED_LENGTH = 1000
"""Longest episode where the environment sets no time limit."""


@dataclass(frozen=True)
class Score:
    """A mean over episodes with the half-width of its 95 % confidence interval (Student's t); None for one episode."""

    mean: float
    half_width: float | None


@dataclass(frozen=True)
class Evaluation:
    """Episodes under the environment's own time limit: sums of rewards, discounted sums, and lengths."""

    episodes: int
    episodic_return: Score
    discounted_return: Score
    episodic_length: Score


def evaluate(algorithm: PGTS, *, episodes: int, deterministic: bool, seed: int) -> Evaluation:
    """Run the policy in fresh copies of its environment.

    Args:
        episodes: how many, at least 1.
        deterministic: take the most probable action, else draw from pi.
        seed: of these episodes alone; training is not touched.
    """
    env = algorithm.make_copies(episodes)
    limit = gymnasium.spec(algorithm.env_id).max_episode_steps or UNLIMITED_LENGTH
    names = ("evaluate", "deterministic" if deterministic else "sampled")
    made = rollout(
        env,
        greedy(algorithm.policy) if deterministic else algorithm.policy,
        FixedHorizon(limit),
        gamma=algorithm.gamma,
        seed=seed,
        names=names,
        generator=stream(seed, *names, device=algorithm.device),
    )
    env.close()
    return Evaluation(
        episodes,
        _score((made.reward_TB * made.alive_TB).sum(0)),
        _score(made.returns()),
        _score(made.alive_TB.double().sum(0)),
    )


def greedy(policy: Policy) -> SimplexPolicy:
    """The policy that takes the most probable action everywhere."""
    best = SimplexPolicy(policy.num_states, policy.num_actions)
    best.probs_SA = torch.nn.functional.one_hot(policy.table().argmax(-1), policy.num_actions).double()
    return best


def last_checkpoint(run: Path) -> Path:
    """The newest checkpoint of a run folder; PgtsError if there is none."""
    checkpoints = sorted((run / CHECKPOINTS).glob("*.pt"))
    if not checkpoints:
        raise PgtsError(f"{run} holds no checkpoint; it must be the folder of a run")
    return checkpoints[-1]


def _score(value_B: Float[Tensor, "B"]) -> Score:
    count = len(value_B)
    if count == 1:
        return Score(float(value_B), None)
    spread = float(value_B.std()) / math.sqrt(count)
    return Score(float(value_B.mean()), float(scipy.stats.t.ppf(0.975, count - 1)) * spread)
