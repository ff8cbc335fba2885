"""What each action is worth above the policy, at the states that it visits: the batch that an update moves it by."""

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
"""So many roundings of the largest lookahead value make a difference that means nothing."""


class Estimator(ABC):
    """Estimates advantages from episodes of a policy and a critic.

    comes_first: whether it needs the critic as it was before it learns from these episodes.
    """

    comes_first: bool

    @abstractmethod
    def __call__(self, experience: Rollout, draws: Draws) -> PolicyBatch:
        """The advantages of the policy that made these episodes.

        Args:
            draws: of the iteration.
        """


@final
class LookaheadEstimator(Estimator):
    """Of all actions, by a lookahead from the distinct visited states: (T^m Q)(s, a) - <pi, T^m Q>.

    Args:
        look: the lookahead of the policy that made the episodes.
        choose: how deep it goes.
        weight: what a state counts for.
    """

    comes_first = False

    def __init__(self, look: PolicyLookahead, choose: DepthChoice, weight: StateWeight) -> None:
        self._look, self._choose, self._weight = look, choose, weight

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
        """Differences of lookahead values that rounding explains, in reward units."""
        eps = max(torch.finfo(dtype).eps for dtype in (look.q_BA.dtype, self._look.critic.dtype))
        return _ROUNDINGS * eps * float(look.q_BA[look.q_BA.isfinite()].abs().amax())


@final
class SampledEstimator(Estimator):
    """Of the actions taken, from what came of them, as in PPO and A2C (`gae`): a row for each visit.

    Args:
        policy: that made the episodes.
        critic: of earlier episodes; what it knows of these would be what came of the very actions.
        lambda_: in [0, 1].
        weight: what a visit counts for.
    """

    comes_first = True

    def __init__(self, policy: Policy, critic: Critic, lambda_: float, weight: StateWeight) -> None:
        self._policy, self._critic, self._lambda, self._weight = policy, critic, lambda_, weight

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
