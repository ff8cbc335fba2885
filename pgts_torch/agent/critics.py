"""Critics: estimates of v^pi or Q^pi; here the exact one, tables, and rollouts in the model."""

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeVar, final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.agent.advantages import critic_targets
from pgts_torch.agent.components import legal_only
from pgts_torch.agent.imagine import simulated_returns
from pgts_torch.agent.policies import Policy, exact_probs, fitting
from pgts_torch.agent.rollout import Rollout
from pgts_torch.bellman import policy_mean
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import SamplingModel
from pgts_torch.options.critics import ExactValues, RolloutValues, TabularValues
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP

Target = Literal["v", "q"]
Learned = TypeVar("Learned")


class Critic(ABC):
    """An estimate of the values of the policy it was last fitted to.

    options: what it was made from; None for a critic of the caller's own class.
    target: whether the leaves of a lookahead take its v (with one more level) or its Q.
    samples_when_queried: whether it uses random numbers when values are queried, and not when it is fitted.
    is_exact: whether its values are those of the policy, up to rounding (`error`).
    error: an upper bound on |mu^T v - J^pi|; infinite unless the critic is exact.
    dtype: of its values.
    num_env_steps: environment steps before this iteration, by which options that are schedules change.
    """

    options: Any = None
    num_env_steps: int = 0
    target: Target
    samples_when_queried: bool = False
    is_exact: bool = False
    error: float = math.inf
    dtype: torch.dtype = torch.float64

    @abstractmethod
    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Fit the estimate to `policy`, which collected `rollout`. Return the losses, by name."""

    @abstractmethod
    def v(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Estimates of v^pi(s)."""

    @abstractmethod
    def q(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"]:
        """Estimates of Q^pi(s, .). A lookahead queries them only where target is "q"."""

    def values(self, rollout: Rollout) -> tuple[Float[Tensor, "T B"], Float[Tensor, "T B"]]:
        """v(s_t) and v(s_{t+1}), as `Rollout.values`."""
        return rollout.values(self.v)

    @property
    def model_calls(self) -> int:
        """The number of (state, action) that this critic has queried a model for so far."""
        return 0

    def state_dict(self) -> dict[str, Any]:
        """Return what was learned, as tensors on the CPU and plain values."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned."""
        if state:
            raise PgtsError(f"{type(self).__name__} learns nothing; it cannot load {sorted(state)}")


@final
class ExactCritic(Critic):
    """The exact v^pi and Q^pi, from the tables of the environment. For validation, and for planning in a known MDP.

    `error` bounds the rounding of the solution v of the Bellman equation:

        |mu^T v - J^pi| = |sum_s d^pi(s) (T^pi v - v)(s)| <= 2 sum_s d(s) ( |T^pi v - v|(s) + (A + K + 4) eps size )

    with size = max |r| + max |v|. The term with eps is for the rounding of T^pi v, an eps size for each operation; the
    factor 2 is for the much smaller rounding of d.
    """

    is_exact = True

    def __init__(self, mdp: TabularMDP, options: ExactValues = ExactValues()) -> None:  # noqa: B008 - frozen
        self.mdp = mdp
        self.options, self.target = options, options.target
        self._evaluation: exact.Evaluation | None = None

    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Solve the Bellman equation of the policy, whose observations are states; the episodes are not used."""
        self.solve(exact_probs(policy, torch.arange(self.mdp.num_states, device=rollout.alive_TB.device)))
        return {}

    def solve(self, pi_SA: Float[Tensor, "S A"]) -> None:
        """Solve the Bellman equation of a policy; `v` and `q` are its values from then on."""
        pi_SA = exact.check_policy(self.mdp, pi_SA)
        self._evaluation = evaluation = exact.evaluate(self.mdp, pi_SA)
        rewards_SA, allowed_SA = self.mdp.outcomes.reward_NA, pi_SA > 0
        size = float(rewards_SA[allowed_SA].abs().max() + evaluation.v_S.abs().max())
        steps = self.mdp.num_actions + self.mdp.outcomes.num_outcomes + 4
        residual_S = (policy_mean(pi_SA, evaluation.q_SA) - evaluation.v_S).abs()
        self.error = 2 * float(evaluation.d_S @ (residual_S + steps * torch.finfo(torch.float64).eps * size))

    def v(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        return _fitted(self._evaluation).v_S.to(state_N.device)[state_N]

    def q(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"]:
        return _fitted(self._evaluation).q_SA.to(state_N.device)[state_N]


@final
class TabularCritic(Critic):
    """A table with a value for each state, or each (state, action), moved toward targets from rollouts.

        V(s) <- V(s) + alpha (mean of the targets at s - V(s))

    Cells that were never visited have the mean value of the iteration's visits, or a given one.

    Args:
        options: with `step_size` "mean" alpha is the number of new visits divided by that of all visits so far, so that
            the estimate is the mean of all targets; this suits a policy that is not updated. With `initial` "mean"
            cells that were never visited have the value w for which the mean of the iteration's targets is w, where
            episodes that were cut off in such a cell are bootstrapped with w. A constant c added to all rewards of a
            continuing task adds c / (1 - gamma) to w, as to all values; a factor multiplies it.
        legal_SA: the actions that are allowed, the others have Q = -inf; None: all are.
    """

    options: TabularValues

    def __init__(
        self,
        num_states: int,
        num_actions: int,
        options: TabularValues = TabularValues(),  # noqa: B008 - frozen
        *,
        legal_SA: Bool[Tensor, "S A"] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.num_states, self.num_actions = num_states, num_actions
        self.options, self.target = options, options.target
        self._policy: Policy | None = None
        self._legal_SA = legal_SA
        cells = num_states if self.target == "v" else num_states * num_actions
        first = 0.0 if options.initial == "mean" else options.initial
        self._value_C = torch.full((cells,), first, dtype=torch.float64, device=device)
        self._count_C = torch.zeros(cells, dtype=torch.float64, device=device)

    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Move every visited cell toward the mean of its targets. Return the mean squared error before the step."""
        self._policy = policy
        value_C = self._value_C
        if self.options.initial == "mean":
            value_C = torch.where(self._count_C > 0, value_C, self._mean_target(rollout))
        target_V = self._targets(rollout, value_C)
        cell_V = rollout.observation_V
        if self.target == "q":
            cell_V = cell_V * self.num_actions + rollout.of_visits(rollout.action_TB)
        loss = rollout.share.mean("squared errors", (target_V - value_C[cell_V]).square())
        # the number of visits to each cell in this rollout, and the sum of their targets
        count_C = torch.zeros_like(self._count_C).index_add_(0, cell_V, torch.ones_like(target_V))
        sum_C = torch.zeros_like(self._count_C).index_add_(0, cell_V, target_V)
        if rollout.ranks.size > 1:
            own = torch.nonzero(count_C).flatten()
            cell_N, count_N, sum_N = rollout.ranks.rows("visited cells", own, count_C[own], sum_C[own])
            count_C, sum_C = (
                torch.zeros_like(x_C).index_add_(0, cell_N, x_N) for x_C, x_N in ((count_C, count_N), (sum_C, sum_N))
            )
        self._count_C += count_C
        alpha_C = count_C / self._count_C.clamp(min=1) if self.options.step_size == "mean" else self.options.step_size
        mean_C = sum_C / count_C.clamp(min=1)
        self._value_C = torch.where(count_C > 0, value_C + alpha_C * (mean_C - value_C), value_C)
        return {"value": float(loss)}

    def v(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """The values in the table; for a table of Q, sum_a pi(a|s) Q(s, a)."""
        return self._read(self._value_C, state_N)

    def _read(self, value_C: Float[Tensor, "C"], state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        if self.target == "v":
            return value_C[state_N]
        return policy_mean(_fitted(self._policy).probs(state_N), value_C.view(-1, self.num_actions)[state_N])

    def q(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"]:
        if self.target != "q":
            raise PgtsError("this critic learns v; it has no Q. Make it with target='q', or search with v_leaf")
        q_NA = self._value_C.view(self.num_states, self.num_actions)[state_N]
        return legal_only(q_NA, None if self._legal_SA is None else self._legal_SA[state_N])

    def state_dict(self) -> dict[str, Any]:
        return {"value_C": self._value_C.cpu().clone(), "count_C": self._count_C.cpu().clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        value_C, count_C = fitting(state, "value_C", self._value_C), fitting(state, "count_C", self._count_C)
        if not bool((count_C >= 0).all()):
            raise PgtsError("count_C has negative counts")
        self._value_C, self._count_C = value_C, count_C

    def _targets(self, rollout: Rollout, value_C: Float[Tensor, "C"]) -> Float[Tensor, "V"]:
        """The target of each visit, bootstrapped with the values of a table."""
        _, next_v_TB = rollout.values(partial(self._read, value_C))
        return critic_targets(rollout, next_v_TB, self.options.method)

    def _mean_target(self, rollout: Rollout) -> Float[Tensor, ""]:
        """The w that is the mean of the targets if it is the value of all cells that were never visited.

        Targets are linear in w, a + b w, so w = mean a / (1 - mean b). a: the targets for w = 0. b: the targets for w =
        1 without rewards and with all other values 0. If every target is bootstrapped in such cells alone (mean b = 1),
        w is undetermined and set to 0.
        """
        seen_C = (self._count_C > 0).double()
        unrewarded = replace(rollout, reward_TB=torch.zeros_like(rollout.reward_TB))
        a = rollout.share.mean("targets", self._targets(rollout, self._value_C * seen_C))
        b = rollout.share.mean("targets without rewards", self._targets(unrewarded, 1 - seen_C))
        return torch.where(b < 1, a / (1 - b), 0.0)


@final
class RolloutCritic(Critic):
    """Mean returns of episodes in the model from the queried states.

    So states that the policy never visits get values as good as the others; with the geometric horizon, unbiased ones.
    Nothing is learned: each query samples new episodes.

    Args:
        options: both v and Q can be queried, whatever the target. With a fixed horizon returns end at the horizon.
    """

    samples_when_queried = True
    options: RolloutValues

    def __init__(self, model: SamplingModel, options: RolloutValues = RolloutValues()) -> None:  # noqa: B008 - frozen
        self.model, self.options, self.target = model, options, options.target
        self._model_calls = 0
        self._following: tuple[Policy, torch.Generator] | None = None

    @property
    def model_calls(self) -> int:
        return self._model_calls

    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Set the policy that episodes in the model follow; the rollout is not used."""
        self._following = policy, generator
        return {}

    def v(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        return self._mean_return(state_N, None)

    def q(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"]:
        A = self.model.num_actions
        action_NA = torch.arange(A, device=state_N.device).expand(len(state_N), A)
        return self._mean_return(state_N.repeat_interleave(A), action_NA.reshape(-1)).view(-1, A)

    def _mean_return(self, state_N: Tensor, action_N: Tensor | None) -> Tensor:
        policy, generator = _fitted(self._following)
        returns_B, num_steps = simulated_returns(
            self.model,
            policy,
            state_N.repeat(self.options.samples),
            self.options.horizon,
            first_action_B=None if action_N is None else action_N.repeat(self.options.samples),
            generator=generator,
        )
        self._model_calls += num_steps
        return returns_B.view(self.options.samples, -1).mean(0)


def _fitted(learned: Learned | None) -> Learned:
    if learned is None:
        raise PgtsError("the critic has no values yet; call fit or iterate before querying it")
    return learned
