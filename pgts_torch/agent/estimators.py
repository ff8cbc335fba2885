"""Estimators of advantages at visited states: they return the batch that an update is computed from."""

import math
from abc import ABC, abstractmethod
from typing import Any, final

import torch
from torch import Tensor

from pgts_torch.agent.advantages import gae, score_function
from pgts_torch.agent.components import legal_in
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.depth import DepthChoice
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.gaussian import GaussianPolicy
from pgts_torch.agent.iteration import PolicyBatch
from pgts_torch.agent.policies import Policy, TabularPolicy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.roots import Roots, roots_of
from pgts_torch.errors import ModelMismatch
from pgts_torch.models.drawn_actions import Drawn
from pgts_torch.options.updates import StateWeight
from pgts_torch.tabular.ascent import centred

_ROUNDINGS = 16
"""Differences of lookahead values up to so many rounding errors of the largest one count as 0."""


class Estimator(ABC):
    """Evaluates a policy by its episodes, and estimates the advantages that it is updated by."""

    @abstractmethod
    def evaluate(self, experience: Rollout, draws: Draws) -> dict[str, float]:
        """Fit the critic to the policy that collected these episodes. Return its losses, by name."""

    @abstractmethod
    def __call__(self, experience: Rollout, draws: Draws) -> PolicyBatch:
        """Return the advantages in these episodes, after `evaluate`."""


@final
class LookaheadEstimator(Estimator):
    """Advantages of all actions, by a lookahead from the distinct visited states: (T^m Q)(s, a) - <pi, T^m Q>(s).

    Args:
        choose: computes the lookahead, and chooses its depth.
        weight: the weights of states in the update.
        max_roots: the most visits that the lookahead starts from; None: all.
    """

    def __init__(self, choose: DepthChoice, weight: StateWeight, max_roots: int | None = None) -> None:
        self._look, self._choose, self._weight, self._max_roots = choose.look, choose, weight, max_roots

    def evaluate(self, experience: Rollout, draws: Draws) -> dict[str, float]:
        critic = self._look.critic
        generator = draws.own if critic.samples_when_queried else draws.common
        return critic.fit(self._look.policy, experience, generator=generator)

    def __call__(self, experience: Rollout, draws: Draws) -> PolicyBatch:
        self._look.restart(draws.search())
        roots, ranks = roots_of(experience, self._look.world, self._weight, self._max_roots, draws), experience.ranks
        drawn = self._look.drawn(roots.state_N)
        pi_NA = self._look.policy.probs(roots.observation_N) if drawn is None else drawn.prob_NK
        chosen = self._choose(experience, roots, pi_NA, draws)
        self._check_legal(roots, chosen.look.q_BA)
        q_NA, count = chosen.look.q_BA, chosen.look.q_BA.numel()
        size: Any = torch.where(q_NA.isfinite(), q_NA, 0.0).abs().amax().double() if count else 0.0
        noise = chosen.look.noise if count else 0.0
        if ranks.size > 1:
            size_R, square_R, count_R = ranks.each("lookahead", size, noise**2 * count, count).T
            size, noise = float(size_R.max()), math.sqrt(square_R.sum() / count_R.sum())
        # Differences that rounding may have caused are no advantages.
        eps = max(torch.finfo(dtype).eps for dtype in (q_NA.dtype, self._look.critic.dtype))
        return PolicyBatch(
            roots.observation_N,
            centred(q_NA, pi_NA, rounding=_ROUNDINGS * eps * size),
            roots.weight_N,
            noise,
            self._look.policy,
            ranks,
            drawn=drawn,
            state_N=roots.state_N,
            pi_NA=pi_NA,
            **chosen._asdict(),
        )

    def _check_legal(self, roots: Roots, q_NA: Tensor) -> None:
        """ModelMismatch unless the model allows the actions that observations say are legal."""
        world, policy = self._look.world, self._look.policy
        legal_NA = legal_in(world.perceived_space, roots.observation_N)
        if legal_NA is None and isinstance(policy, TabularPolicy):
            return  # which knows the actions that the table allows
        allowed_NA = q_NA > -math.inf
        off_NA = allowed_NA != (torch.ones_like(allowed_NA) if legal_NA is None else legal_NA)
        if off_NA.any():
            n, a = torch.nonzero(off_NA)[0].tolist()
            says = "allows" if allowed_NA[n, a] else "does not allow"
            raise ModelMismatch(
                f"{type(world.model).__name__} {says} action {a} in state {int(roots.state_N[n])}, and by what is "
                f"observed it is {'not legal' if allowed_NA[n, a] else 'legal'}: correct one of them, or set forbids = "
                "True in the model, which then says what is legal"
            )


@final
class SampledEstimator(Estimator):
    """Advantages of the actions taken, from the rewards after them, as in PPO and A2C (`gae`): a row for each visit.

    Args:
        policy: that collected the episodes.
        critic: gives values of states. They are those from before its fit to the same episodes, after which they depend
            on the actions taken.
        lambda_: in [0, 1].
        weight: the weights of visits in the update.
    """

    def __init__(self, policy: Policy, critic: Critic, lambda_: float, weight: StateWeight) -> None:
        self._policy, self._critic, self._lambda, self._weight = policy, critic, lambda_, weight

    def evaluate(self, experience: Rollout, draws: Draws) -> dict[str, float]:
        self._batch = self._before_fit(experience)
        return self._critic.fit(self._policy, experience, generator=draws.common)

    def __call__(self, experience: Rollout, draws: Draws) -> PolicyBatch:
        return self._batch

    def _before_fit(self, experience: Rollout) -> PolicyBatch:
        observation_N = experience.observation_V
        advantage_TB = gae(experience, *self._critic.values(experience), self._lambda)
        action_N, advantage_N = experience.of_visits(experience.action_TB), experience.of_visits(advantage_TB)
        drawn = None
        if isinstance(self._policy, GaussianPolicy):  # of K = 1 action, the one taken
            pi_NA = torch.ones_like(advantage_N)[:, None]
            drawn, estimate_NA = Drawn(action_N[:, None], pi_NA.float()), advantage_N[:, None]
        else:
            pi_NA = self._policy.probs(observation_N)
            estimate_NA = score_function(action_N, advantage_N, pi_NA)
        weight_N = experience.visit_weight(self._weight)
        return PolicyBatch(
            observation_N,
            estimate_NA,
            weight_N,
            ranks=experience.ranks,
            drawn=drawn,
            state_N=None,
            pi_NA=pi_NA,
            depth=0,
            look=None,
            gap_N=torch.full_like(weight_N, torch.nan),
            certificate=math.inf,
            gap_bound=math.inf,
            is_enough=False,
        )
