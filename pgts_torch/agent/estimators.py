"""Estimators of advantages at visited states: they return the batch that an update is computed from."""

import math
from abc import ABC, abstractmethod
from typing import final

import torch

from pgts_torch.agent.advantages import gae, score_function
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.depth import DepthChoice
from pgts_torch.agent.iteration import PolicyBatch
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.policy_lookahead import PolicyLookahead
from pgts_torch.agent.ranks import Draws
from pgts_torch.agent.rollout import Rollout, StateWeight
from pgts_torch.search.lookahead import Lookahead
from pgts_torch.tabular.ascent import centred

_ROUNDINGS = 16
"""Differences of lookahead values up to so many rounding errors of the largest one count as 0."""


class Estimator(ABC):
    """Estimates advantages from episodes of a policy and a critic.

    comes_first: whether it is called before the critic is fitted to these episodes.
    """

    comes_first: bool

    @property
    @abstractmethod
    def model_calls(self) -> int:
        """For how many (state, action) the model has been queried so far, by the critic too."""

    @abstractmethod
    def __call__(self, experience: Rollout, draws: Draws) -> PolicyBatch:
        """Return the advantages of the policy that collected these episodes.

        Args:
            draws: the random generators of the iteration.
        """


@final
class LookaheadEstimator(Estimator):
    """Advantages of all actions, by a lookahead from the distinct visited states: (T^m Q)(s, a) - <pi, T^m Q>(s).

    Args:
        look: the lookahead of the policy that collected the episodes.
        choose: chooses its depth.
        weight: the weights of states in the update.
    """

    comes_first = False

    def __init__(self, look: PolicyLookahead, choose: DepthChoice, weight: StateWeight) -> None:
        self._look, self._choose, self._weight = look, choose, weight

    @property
    def model_calls(self) -> int:
        return self._look.search.model_calls + self._look.critic.model_calls

    def __call__(self, experience: Rollout, draws: Draws) -> PolicyBatch:
        self._look.restart()
        state_N, weight_N = experience.visits(self._weight)
        observation_N = experience.first_observation_N
        pi_NA = self._look.policy.probs(observation_N)
        chosen = self._choose(experience, pi_NA, draws)
        return PolicyBatch(
            observation_N=observation_N,
            state_N=state_N,
            weight_N=weight_N,
            pi_NA=pi_NA,
            advantage_NA=centred(chosen.look.q_BA, pi_NA, rounding=self._rounding(chosen.look)),
            noise=chosen.look.noise,
            **chosen._asdict(),
        )

    def _rounding(self, look: Lookahead) -> float:
        """The largest difference of lookahead values that rounding may have caused, in reward units."""
        eps = max(torch.finfo(dtype).eps for dtype in (look.q_BA.dtype, self._look.critic.dtype))
        return _ROUNDINGS * eps * float(look.q_BA[look.q_BA.isfinite()].abs().amax())


@final
class SampledEstimator(Estimator):
    """Advantages of the actions taken, from the rewards after them, as in PPO and A2C (`gae`): a row for each visit.

    Args:
        policy: that collected the episodes.
        critic: fitted to earlier episodes; fitted to these, its values would depend on the actions taken.
        lambda_: in [0, 1].
        weight: the weights of visits in the update.
    """

    comes_first = True

    def __init__(self, policy: Policy, critic: Critic, lambda_: float, weight: StateWeight) -> None:
        self._policy, self._critic, self._lambda, self._weight = policy, critic, lambda_, weight

    @property
    def model_calls(self) -> int:
        return self._critic.model_calls

    def __call__(self, experience: Rollout, draws: Draws) -> PolicyBatch:
        alive_TB, observation_N = experience.alive_TB, experience.observation_V
        pi_NA = self._policy.probs(observation_N)
        advantage_TB = gae(experience, *self._critic.values(experience), self._lambda)
        weight_N = experience.visit_weight(self._weight)
        return PolicyBatch(
            observation_N=observation_N,
            state_N=None,
            weight_N=weight_N,
            pi_NA=pi_NA,
            advantage_NA=score_function(experience.action_TB[alive_TB], advantage_TB[alive_TB], pi_NA),
            noise=0.0,
            depth=0,
            look=None,
            gap_N=torch.full_like(weight_N, torch.nan),
            certificate=math.inf,
            is_enough=False,
        )
