"""How a policy moves, given lookahead values at the states it visited."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.policies import Policy, SimplexPolicy, SoftmaxPolicy
from pgts_torch.agent.rollout import StateWeight
from pgts_torch.errors import PgtsError
from pgts_torch.search.lookahead import check_finite
from pgts_torch.tabular.ascent import centred, floored, normalised, projected_step, softmax_direction


class Update(ABC):
    """How a policy is moved at visited states.

    state_weight: w(s) of a visited state. `occupancy`: the estimate of d^pi(s), as in the paper. `visits`: its share of
        all visits, without discounts (sums to 1). `uniform`: 1, as in h-PMD.
    policies: the kinds of policy that it moves.
    """

    state_weight: StateWeight
    policies: ClassVar[tuple[type[Policy], ...]]

    @abstractmethod
    def __call__(
        self,
        policy: Policy,
        observation_N: Tensor,
        advantage_NA: Float[Tensor, "N A"],
        weight_N: Float[Tensor, "N"],
        *,
        generator: torch.Generator,
        noise: float = 0.0,
    ) -> dict[str, float]:
        """Move pi(.|o) along the advantages of all actions, in place; losses and the like, by name.

        Args:
            observation_N: what the policy sees of N visited states.
            advantage_NA: (T^m Q)(s, a) - <pi, T^m Q> (`advantages.centred`), or sampled ones.
            weight_N: w(s).
            noise: the standard error of the advantages, in reward units: the least that normalised steps divide by.
        """

    def state_dict(self) -> dict[str, Any]:
        """What an optimiser remembers, as tensors on the CPU and plain values."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave."""
        if state:
            raise PgtsError(f"{type(self).__name__} remembers nothing; it cannot take over {sorted(state)}")

    def check(self, policy: Policy) -> None:
        """PgtsError unless this update, and what it remembers, can move such a policy."""
        if not isinstance(policy, self.policies):
            names = " or ".join(kind.__name__ for kind in self.policies)
            raise PgtsError(
                f"{type(self).__name__} moves a {names}, not a {type(policy).__name__}; take such a policy or another "
                "update"
            )


@dataclass(frozen=True)
class TabularUpdate(Update):
    """One step at the rows of a table; all other states stay as they are.

    Args:
        step_size: eta > 0.
    """

    step_size: float = 0.1
    state_weight: StateWeight = "occupancy"

    def __post_init__(self) -> None:
        if not 0 < self.step_size < math.inf:
            raise PgtsError(f"step_size is {self.step_size}; it must be finite and above 0")
        check_state_weight(self.state_weight)

    def __call__(
        self,
        policy: Policy,
        observation_N: Tensor,
        advantage_NA: Float[Tensor, "N A"],
        weight_N: Float[Tensor, "N"],
        *,
        generator: torch.Generator,
        noise: float = 0.0,
    ) -> dict[str, float]:
        """Nothing is drawn, and there is no loss.

        Raises:
            NotFinite: step_size w(s) adv(s, a) is not finite for the best action of a state, or what the policy would
                become is not.
        """
        step_NA = self.step_size * weight_N[:, None] * advantage_NA
        check_finite("advantage", "the step along the advantages", step_NA, observation_N)
        self.step(policy, observation_N, advantage_NA, weight_N, noise)
        return {}

    @abstractmethod
    def step(
        self,
        policy: Policy,
        state_N: Int[Tensor, "N"],
        q_NA: Float[Tensor, "N A"],
        weight_N: Float[Tensor, "N"],
        noise: float = 0.0,
    ) -> None:
        """Move pi(.|s) at N distinct states along q(s, .), or along q(s, .) less anything that all actions share."""


@final
@dataclass(frozen=True)
class ProjectedUpdate(TabularUpdate):
    """The paper's update, pi(.|s) <- proj[pi(.|s) + eta w(s) q(s, .)].        [PGTS Eq. (3)]"""

    policies = (SimplexPolicy,)

    def step(self, policy: Policy, state_N: Tensor, q_NA: Tensor, weight_N: Tensor, noise: float = 0.0) -> None:
        assert isinstance(policy, SimplexPolicy)
        _replace(policy.probs_SA, state_N, projected_step(policy.probs_SA[state_N], q_NA, weight_N, self.step_size))


@final
@dataclass(frozen=True)
class SoftmaxUpdate(TabularUpdate):
    """All-action policy gradient on the logits: theta(s, .) <- theta(s, .) + eta w(s) pi (q - <pi, q>)."""

    policies = (SoftmaxPolicy,)

    def step(self, policy: Policy, state_N: Tensor, q_NA: Tensor, weight_N: Tensor, noise: float = 0.0) -> None:
        assert isinstance(policy, SoftmaxPolicy)
        step_NA = self.step_size * softmax_direction(policy.probs(state_N), q_NA, weight_N)
        _replace(policy.logits_SA, state_N, policy.logits_SA[state_N] + step_NA)


@final
@dataclass(frozen=True)
class MirrorUpdate(TabularUpdate):
    """A KL step at visited states, in units of what the advantages amount to (Protopapas and Barakat 2024).

        pi(a|s) <- pi(a|s) exp(eta w(s) A(s, a) / s) / Z,        s = sqrt(mean over visited states of sum_a pi A^2)

    So neither a constant added to all rewards of a continuing task nor their scale matters; a factor of 2^k leaves
    every bit as it is. Where all advantages are 0 nothing moves.

    Args:
        normalize: "rms": s as above, and at least the standard error of a sampled lookahead; "none": s = 1, the paper's
            step in reward units.
        floor: the least that log pi(a|s) may be below its largest in a row that moves, so that a policy which was sure
            too early can come back; None: no limit.
    """

    policies = (SoftmaxPolicy, SimplexPolicy)

    step_size: float = 1.0
    state_weight: StateWeight = "uniform"
    normalize: Literal["rms", "none"] = "rms"
    floor: float | None = 12.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.normalize not in ("rms", "none"):
            raise PgtsError(f"normalize is {self.normalize!r}; it must be rms or none")
        if self.floor is not None and not 0 < self.floor < math.inf:
            raise PgtsError(f"floor is {self.floor}; it must be finite and above 0, or None")

    def step(self, policy: Policy, state_N: Tensor, q_NA: Tensor, weight_N: Tensor, noise: float = 0.0) -> None:
        pi_NA = policy.probs(state_N)
        log_NA = policy.logits_SA[state_N] if isinstance(policy, SoftmaxPolicy) else pi_NA.log()
        advantage_NA = centred(q_NA, pi_NA)
        if self.normalize == "rms":
            advantage_NA = normalised(advantage_NA, pi_NA, noise=noise)
        next_NA = floored(log_NA, self.step_size * weight_N[:, None] * advantage_NA, self.floor)
        moves_N1 = (advantage_NA != 0).any(-1, keepdim=True)
        if isinstance(policy, SoftmaxPolicy):
            _replace(policy.logits_SA, state_N, torch.where(moves_N1, next_NA, log_NA))
        else:
            assert isinstance(policy, SimplexPolicy)
            _replace(policy.probs_SA, state_N, torch.where(moves_N1, next_NA.softmax(-1), pi_NA))


def _replace(table_SA: Float[Tensor, "S A"], state_N: Int[Tensor, "N"], row_NA: Float[Tensor, "N A"]) -> None:
    """Write the rows; NotFinite, and nothing written, if they are no logits or probabilities."""
    check_finite("probability", "the next policy", row_NA, state_N)
    table_SA[state_N] = row_NA


def check_state_weight(state_weight: str) -> None:
    """PgtsError unless it is one."""
    if state_weight not in ("occupancy", "visits", "uniform"):
        raise PgtsError(f"state_weight is {state_weight!r}; it must be occupancy, visits or uniform")
