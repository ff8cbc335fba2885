"""Estimates of Q^pi or v^pi, each from what it is allowed to see."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeVar, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.policies import Policy, fitting, listed
from pgts_torch.agent.rollout import Rollout, simulated_returns
from pgts_torch.bellman import policy_mean
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.base import SamplingModel
from pgts_torch.options.critics import ExactValues, RolloutValues, TabularValues, TDLambda
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP

Target = Literal["v", "q"]
Learned = TypeVar("Learned")


class Critic(ABC):
    """An estimate of the values of the policy it was last fitted to.

    options: what it was made from; None for a critic of the caller's own kind.
    target: whether a lookahead stands on its v (one more level) or its Q.
    draws_when_asked: whether it draws when it is asked for values, not when it is fitted.
    is_exact: whether its values are those of the policy, but for `error`.
    error: by how much the mean of its v over the start distribution may miss J^pi; infinite where it is an estimate.
    dtype: that its values are rounded to.
    """

    options: Any = None
    target: Target
    draws_when_asked: bool = False
    is_exact: bool = False
    error: float = math.inf
    dtype: torch.dtype = torch.float64

    @abstractmethod
    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Estimate the values of `policy`, which made `rollout`; the losses, by name."""

    @abstractmethod
    def v(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Estimates of v^pi(s)."""

    @abstractmethod
    def q(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"]:
        """Estimates of Q^pi(s, .). Only where target is "q" does a lookahead ask for them."""

    def values(self, rollout: Rollout) -> tuple[Float[Tensor, "T B"], Float[Tensor, "T B"]]:
        """v(s_t) and v(s_{t+1}), as `Rollout.values`."""
        return rollout.values(self.v)

    @property
    def model_calls(self) -> int:
        """How many (state, action) this critic has asked of a model so far."""
        return 0

    def state_dict(self) -> dict[str, Any]:
        """What has been learned, as tensors on the CPU and plain values."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave."""
        if state:
            raise PgtsError(f"{type(self).__name__} learns nothing; it cannot take over {sorted(state)}")


@final
class ExactCritic(Critic):
    """v^pi and Q^pi of the true MDP. For validation: what is trained with it has learned from the truth.

    `error` is what rounding may have done to the solution v of its Bellman equation:

        |mu^T v - J^pi| = |sum_s d^pi(s) (T^pi v - v)(s)| <= 2 sum_s d(s) ( |T^pi v - v|(s) + (A + K + 4) eps size )

    T^pi v is computed, so eps size stands for each of its operations, size = max |r| + max |v|; the factor 2 is for the
    rounding of d itself, which is far less.
    """

    is_exact = True

    def __init__(self, mdp: TabularMDP, options: ExactValues = ExactValues()) -> None:  # noqa: B008 - frozen
        self.mdp = mdp
        self.options, self.target = options, options.target
        self._evaluation: exact.Evaluation | None = None

    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Solve the Bellman equation of the policy, which sees the states themselves; the rollout is not looked at."""
        self.solve(listed(policy, torch.arange(self.mdp.num_states, device=rollout.alive_TB.device)))
        return {}

    def solve(self, pi_SA: Float[Tensor, "S A"]) -> None:
        """The values of this policy, from now on."""
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
    """One number for each state, or each (state, action), moved toward targets from rollouts.

        V(s) <- V(s) + alpha (mean of the targets at s - V(s))

    What was never visited is worth what all visits of the iteration are on average, or a given number.

    Args:
        num_states, num_actions: the shape of the table.
        options: with `step_size` "mean" alpha is the share of the new visits among all so far, which makes the estimate
            the mean of all targets, and suits a policy that stands still. With `initial` "mean" cells that were never
            visited are worth the w that makes the mean of an iteration's targets w, where w stands for the rest of
            episodes that were cut in such a cell. A constant added to all rewards of a continuing task adds constant /
            (1 - gamma) to it, as to all values; a factor multiplies it.
    """

    options: TabularValues

    def __init__(
        self,
        num_states: int,
        num_actions: int,
        options: TabularValues = TabularValues(),  # noqa: B008 - frozen
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        self.num_states, self.num_actions = num_states, num_actions
        self.options, self.target = options, options.target
        self._policy: Policy | None = None
        cells = num_states if self.target == "v" else num_states * num_actions
        first = 0.0 if options.initial == "mean" else options.initial
        self._value_C = torch.full((cells,), first, dtype=torch.float64, device=device)
        self._count_C = torch.zeros(cells, dtype=torch.float64, device=device)

    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Move every visited cell toward the mean of its targets; returns the mean squared error before."""
        self._policy = policy
        value_C = self._value_C
        if self.options.initial == "mean":
            value_C = torch.where(self._count_C > 0, value_C, self._mean_target(rollout))
        target_TB = self._targets(rollout, partial(self._read, value_C))[rollout.alive_TB]
        check_targets(target_TB)
        cell_TB = rollout.observation_UB[:-1]
        if self.target == "q":
            cell_TB = cell_TB * self.num_actions + rollout.action_TB
        cell_V = cell_TB[rollout.alive_TB]
        loss = float((target_TB - value_C[cell_V]).square().mean())
        ones_V = torch.ones_like(target_TB)
        count_C = torch.zeros_like(self._count_C).index_add_(0, cell_V, ones_V)
        sum_C = torch.zeros_like(self._count_C).index_add_(0, cell_V, target_TB)
        self._count_C += count_C
        alpha_C = count_C / self._count_C.clamp(min=1) if self.options.step_size == "mean" else self.options.step_size
        seen_C = count_C > 0
        mean_C = sum_C / count_C.clamp(min=1)
        self._value_C = torch.where(seen_C, value_C + alpha_C * (mean_C - value_C), value_C)
        return {"value": loss}

    def v(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """The table, or sum_a pi(a|s) Q(s, a) of it."""
        return self._read(self._value_C, state_N)

    def _read(self, value_C: Float[Tensor, "C"], state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        if self.target == "v":
            return value_C[state_N]
        return policy_mean(_fitted(self._policy).probs(state_N), value_C.view(-1, self.num_actions)[state_N])

    def q(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"]:
        if self.target != "q":
            raise PgtsError("this critic learns v; it has no Q. Make it with target='q', or search with v_leaf")
        return self._value_C.view(self.num_states, self.num_actions)[state_N]

    def state_dict(self) -> dict[str, Any]:
        return {"value_C": self._value_C.cpu().clone(), "count_C": self._count_C.cpu().clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        value_C, count_C = fitting(state, "value_C", self._value_C), fitting(state, "count_C", self._count_C)
        if not bool((count_C >= 0).all()):
            raise PgtsError("count_C has negative counts")
        self._value_C, self._count_C = value_C, count_C

    def _targets(self, rollout: Rollout, v: Callable[[Tensor], Tensor]) -> Float[Tensor, "T B"]:
        next_TB = rollout.observation_UB[1:]
        bootstrap_TB = v(next_TB.reshape(-1)).view(next_TB.shape)
        if isinstance(self.options.method, TDLambda):
            return lambda_returns(rollout, bootstrap_TB, rollout.discount_TB, self.options.method.lambda_)
        return lambda_returns(rollout, bootstrap_TB, rollout.survival_TB, 1.0)

    def _mean_target(self, rollout: Rollout) -> Float[Tensor, ""]:
        """The w of which the targets have the mean, if it is what cells that were never visited are worth.

        Targets are a + b w: w = mean a / (1 - mean b). Two passes with w = 0 and, without rewards and with all other
        values 0, w = 1. Where no target ends anywhere else (mean b = 1) nothing is known of w, and it is 0.
        """
        value_C, seen_C = self._value_C, self._count_C > 0
        unseen_C = (~seen_C).to(value_C)
        silent = replace(rollout, reward_TB=torch.zeros_like(rollout.reward_TB))
        a = self._targets(rollout, partial(self._read, value_C * seen_C))[rollout.alive_TB].mean()
        b = self._targets(silent, partial(self._read, unseen_C))[rollout.alive_TB].mean()
        return torch.where(b < 1, a / (1 - b), 0.0)


@final
class RolloutCritic(Critic):
    """Monte-Carlo through the model from the very states that are asked for.

    So states that the policy never visits get values as good as the others; with the geometric horizon, unbiased ones.
    Nothing is remembered between fits; each question is answered by fresh episodes.

    Args:
        model: samples outcomes.
        options: both v and Q can be asked for, whatever the target. A fixed horizon leaves out what comes after it.
    """

    draws_when_asked = True
    options: RolloutValues

    def __init__(self, model: SamplingModel, options: RolloutValues = RolloutValues()) -> None:  # noqa: B008 - frozen
        self.model, self.options, self.target = model, options, options.target
        self._model_calls = 0
        self._following: tuple[Policy, torch.Generator] | None = None

    @property
    def model_calls(self) -> int:
        return self._model_calls

    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Take the policy to be followed; the rollout is not looked at."""
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


def lambda_returns(
    rollout: Rollout,
    bootstrap_TB: Float[Tensor, "T B"],
    discount_TB: Float[Tensor, "T B"],
    lambda_: float,
) -> Float[Tensor, "T B"]:
    """G_t = r_t + gamma_t ((1 - lambda) V(s_{t+1}) + lambda G_{t+1}); V(s_{t+1}) alone where the episode's data end.

    Args:
        rollout: B episodes.
        bootstrap_TB: V(s_{t+1}).
        discount_TB: gamma_t; 0 after a terminated step, so that nothing is bootstrapped there.
        lambda_: in [0, 1]; 1 gives Monte-Carlo returns.
    """
    lambda_TB = lambda_ * rollout.follows_TB.float()
    returns_TB = rollout.reward_TB + discount_TB * (1 - lambda_TB) * bootstrap_TB
    # Row by row on the CPU, where a few numbers cost least.
    row_TB, later_TB = returns_TB.cpu().numpy(), (discount_TB * lambda_TB).cpu().numpy()
    for t in reversed(range(len(row_TB) - 1)):
        row_TB[t] += later_TB[t] * row_TB[t + 1]
    return torch.from_numpy(row_TB).to(returns_TB.device)


def check_targets(target_V: Float[Tensor, "V"]) -> None:
    """NotFinite unless a critic can learn from these."""
    if not math.isfinite(target_V.sum()):
        raise NotFinite("a target of the critic is not finite; it has learned nothing from this rollout", what="value")


def _fitted(learned: Learned | None) -> Learned:
    if learned is None:
        raise PgtsError("the critic knows no policy yet; fit it, or iterate, before asking for values")
    return learned
