"""Evaluate a policy by episodes that are not trained on."""

import math
from dataclasses import dataclass
from typing import Any, Self, final

import scipy.special
import torch
from gymnasium.vector import VectorEnv
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.collect import rollout
from pgts_torch.agent.episodes import UNLIMITED_LENGTH
from pgts_torch.agent.gaussian import GaussianPolicy, Mean
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.policies import Policy
from pgts_torch.errors import check_count
from pgts_torch.models.environments import EnvSource, close_environments
from pgts_torch.options.rollouts import FixedHorizon
from pgts_torch.seeding import SharedGenerators, stream


@dataclass(frozen=True)
class Score:
    """A mean over episodes with the half-width of its 95 % confidence interval (Student's t); None for one episode."""

    mean: float
    half_width: float | None

    @classmethod
    def of(cls, value_B: Float[Tensor, "B"]) -> Self:
        """The score of one value for each episode."""
        count = len(value_B)
        if count == 1:
            return cls(float(value_B), None)
        spread = float(value_B.std()) / math.sqrt(count)
        return cls(float(value_B.mean()), float(scipy.special.stdtrit(count - 1, 0.975)) * spread)


@dataclass(frozen=True)
class Evaluation:
    """Scores of episodes under the environment's own time limit.

    episodic_return: sums of rewards.   discounted_return: discounted sums.   episodic_length: in steps.
    """

    episodes: int
    episodic_return: Score
    discounted_return: Score
    episodic_length: Score


@final
class Evaluator:
    """Evaluates a policy again and again in the same environments, which are made for the first evaluation.

    A context that closes them, with a UserWarning where one raises an error in `close`.

    Args:
        episodes: of one evaluation, at least 1; they run side by side.

    Raises:
        PgtsError: episodes is below 1.
    """

    def __init__(self, episodes: int) -> None:
        check_count("episodes", episodes)
        self.episodes = episodes
        self._env: VectorEnv | None = None
        self._limit: int | None = None
        self._source: EnvSource | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __call__(self, algorithm: PGTS, *, deterministic: bool = True, seed: int = 0) -> Evaluation:
        """The scores of new episodes. Training is not affected.

        Args:
            deterministic: take the most probable action, of a gaussian policy the mean; else sample from pi.
            seed: of these episodes alone.

        Raises:
            PgtsError: no more environments of this kind can be made (`EnvSource.make`); or the environment failed,
                naming step and seeds.
        """
        names = ("evaluate", "deterministic" if deterministic else "sampled")
        env, limit = self._environments(algorithm.source, seed)
        made = rollout(
            algorithm.world.of(env),
            greedy(algorithm.policy) if deterministic else algorithm.policy,
            FixedHorizon(length=limit or UNLIMITED_LENGTH),
            seed=seed,
            names=names,
            generator=stream(seed, *names, device=algorithm.device),
        )
        return Evaluation(
            self.episodes,
            Score.of((made.reward_TB * made.alive_TB).sum(0)),
            Score.of(made.returns()),
            Score.of(made.alive_TB.double().sum(0)),
        )

    def close(self) -> None:
        """Close the environments; another evaluation makes new ones."""
        if self._env is not None:
            close_environments(self._env)
            self._env = None

    def _environments(self, source: EnvSource, seed: int) -> tuple[VectorEnv, int | None]:
        """The environments, and the time limit of their episodes."""
        if source is not self._source:
            self.close()
            self._source = source
        if self._env is None:
            with SharedGenerators(seed, "evaluate", "construction"):
                self._env, self._limit = source.make(self.episodes), source.time_limit
        return self._env, self._limit


def evaluate(algorithm: PGTS, *, episodes: int, deterministic: bool = True, seed: int = 0) -> Evaluation:
    """The scores of new episodes, in environments of their own; training is not affected.

    Args:
        algorithm: the training whose policy acts, without search.
        episodes: how many, at least 1; they run side by side, under the environment's own time limit.
        deterministic: take the most probable action, of a gaussian policy the mean; else sample from pi.
        seed: of these episodes alone.

    Returns:
        `episodic_return`, `discounted_return` and `episodic_length`, each with its `mean` and the `half_width` of a
        95 % confidence interval (None for one episode).

    Raises:
        PgtsError: as `Evaluator` and its call say.
    """
    with Evaluator(episodes) as evaluator:
        return evaluator(algorithm, deterministic=deterministic, seed=seed)


def greedy(policy: Policy) -> Policy:
    """The policy that takes the most probable action of this one."""
    return Mean(policy) if isinstance(policy, GaussianPolicy) else Greedy(policy)


@final
class Greedy(Policy):
    """Takes the most probable action of another policy."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.num_actions = policy.num_actions

    def probs(self, observation_N: Tensor) -> Float[Tensor, "N A"]:
        """The one-hot probabilities of the most probable action."""
        best_N = self.policy.probs(observation_N).argmax(-1)
        return torch.nn.functional.one_hot(best_N, self.num_actions).double()

    def state_dict(self) -> dict[str, Any]:
        return self.policy.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.policy.load_state_dict(state)
