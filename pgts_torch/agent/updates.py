"""Updates of a policy from advantages at the states it visited; here those of tables."""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.policies import Policy, SimplexPolicy, SoftmaxPolicy
from pgts_torch.errors import PgtsError
from pgts_torch.options.fields import limit
from pgts_torch.options.schedules import value_at
from pgts_torch.options.updates import Mirror, Projected, SoftmaxGradient, StateWeight
from pgts_torch.search.lookahead import check_finite
from pgts_torch.tabular.ascent import centred, floored, normalised, projected_step, softmax_direction


class Update(ABC):
    """A rule that changes a policy at visited states.

    state_weight: the weight w(s) of a visited state. `occupancy`: the estimate of d^pi(s), as in the paper. `visits`:
        the fraction of all visits that are to s, without discounts. `uniform`: 1, as in h-PMD.
    policies: the classes of policy that it can change.
    num_env_steps: environment steps before this iteration, by which options that are schedules change.
    options: what it was made from; None for an update of the caller's own class.
    """

    options: Any = None
    num_env_steps: int = 0
    state_weight: StateWeight
    policies: ClassVar[tuple[type[Policy], ...]]

    @abstractmethod
    def __call__(self, policy: Policy, batch: Batch, *, generator: torch.Generator) -> dict[str, float]:
        """Change pi(.|o) along the advantages of all actions, in place. Return losses and diagnostics, by name."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the optimiser, as tensors on the CPU and plain values; empty where there is none."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned."""
        if state:
            raise PgtsError(f"{type(self).__name__} has no state; it cannot load {sorted(state)}")

    def check(self, policy: Policy) -> None:
        """PgtsError unless this update, with the state of its optimiser, can change such a policy."""
        if not isinstance(policy, self.policies):
            names = " or ".join(kind.__name__ for kind in self.policies)
            raise PgtsError(
                f"{type(self).__name__} updates a {names}, not a {type(policy).__name__}; take such a policy or "
                "another update"
            )


class TabularUpdate(Update):
    """One step in the rows of visited states; all other rows stay as they are.

    options: of the class, by default.
    """

    def __init__(self, options: Any = None) -> None:
        self.options = self.options if options is None else options
        self.state_weight = self.options.state_weight

    @property
    def step_size(self) -> float:
        """eta, the present value where it is a schedule."""
        return value_at(self.options.step_size, self.num_env_steps)

    def __call__(self, policy: Policy, batch: Batch, *, generator: torch.Generator) -> dict[str, float]:
        """Take the step. It uses no random numbers and has no losses.

        Raises:
            NotFinite: step_size w(s) adv(s, a) is not finite for the best action of a state, or the next policy is not.
        """
        rows = batch.ranks.rows("rows of a table", batch.observation_N, batch.advantage_NA, batch.weight_N)
        if batch.ranks.size > 1:  # in the order in which one process would have them
            order_N = rows[0].argsort()
            rows = [column[order_N] for column in rows]
        state_N, advantage_NA, weight_N = rows
        step_NA = self.step_size * weight_N[:, None] * advantage_NA
        check_finite("advantage", "the step along the advantages", step_NA, state_N)
        self.step(policy, state_N, advantage_NA, weight_N, batch.noise)
        return {}

    @abstractmethod
    def step(self, policy: Policy, state_N: Tensor, q_NA: Tensor, weight_N: Tensor, noise: float = 0.0) -> None:
        """Change pi(.|s) in N distinct states along q(s, .), which may have any constant added in each state."""


@final
class ProjectedUpdate(TabularUpdate):
    """The paper's update, pi(.|s) <- proj[pi(.|s) + eta w(s) q(s, .)].        [PGTS Eq. (3)]"""

    policies = (SimplexPolicy,)
    options: Projected = Projected()

    def step(self, policy: Policy, state_N: Tensor, q_NA: Tensor, weight_N: Tensor, noise: float = 0.0) -> None:
        assert isinstance(policy, SimplexPolicy)
        _replace(policy.probs_SA, state_N, projected_step(policy.probs_SA[state_N], q_NA, weight_N, self.step_size))


@final
class SoftmaxUpdate(TabularUpdate):
    """All-action policy gradient on the logits: theta(s, .) <- theta(s, .) + eta w(s) pi (q - <pi, q>)."""

    policies = (SoftmaxPolicy,)
    options: SoftmaxGradient = SoftmaxGradient()

    def step(self, policy: Policy, state_N: Tensor, q_NA: Tensor, weight_N: Tensor, noise: float = 0.0) -> None:
        assert isinstance(policy, SoftmaxPolicy)
        step_NA = self.step_size * softmax_direction(policy.probs(state_N), q_NA, weight_N)
        _replace(policy.logits_SA, state_N, policy.logits_SA[state_N] + step_NA)


@final
class MirrorUpdate(TabularUpdate):
    """A mirror ascent step at visited states, with normalised advantages (Protopapas and Barakat 2024).

        pi(a|s) <- pi(a|s) exp(eta w(s) A(s, a) / c) / Z,        c = sqrt(mean over visited states of sum_a pi A^2)

    So neither a constant added to all rewards of a continuing task nor their scale matters; a factor of 2^k changes no
    bit of the policy. A row in which all advantages are 0 stays as it is.

    Args:
        options: those of tables. With `normalize` "rms" c is at least the standard error of a sampled lookahead; with
            "none" it is 1, the paper's step in reward units. After a step, log pi(a|s) is at most `floor` below the
            largest of its row, so that a policy that became deterministic too early can recover.
    """

    policies = (SoftmaxPolicy, SimplexPolicy)
    options: Any

    def __init__(self, options: Mirror = Mirror()) -> None:  # noqa: B008 - frozen
        super().__init__(options.filled("tables"))
        self._floor = limit(self.options.floor)

    def step(self, policy: Policy, state_N: Tensor, q_NA: Tensor, weight_N: Tensor, noise: float = 0.0) -> None:
        pi_NA = policy.probs(state_N)
        log_NA = policy.logits_SA[state_N] if isinstance(policy, SoftmaxPolicy) else pi_NA.log()
        advantage_NA = centred(q_NA, pi_NA)
        if self.options.normalize == "rms":
            advantage_NA = normalised(advantage_NA, pi_NA, noise=noise)
        next_NA = floored(log_NA, self.step_size * weight_N[:, None] * advantage_NA, self._floor)
        moves_N1 = (advantage_NA != 0).any(-1, keepdim=True)
        if isinstance(policy, SoftmaxPolicy):
            _replace(policy.logits_SA, state_N, torch.where(moves_N1, next_NA, log_NA))
        else:
            assert isinstance(policy, SimplexPolicy)
            _replace(policy.probs_SA, state_N, torch.where(moves_N1, next_NA.softmax(-1), pi_NA))


def _replace(table_SA: Float[Tensor, "S A"], state_N: Int[Tensor, "N"], row_NA: Float[Tensor, "N A"]) -> None:
    """Write rows into a table; NotFinite, and nothing is written, unless they are finite logits or probabilities."""
    check_finite("probability", "the next policy", row_NA, state_N)
    table_SA[state_N] = row_NA
