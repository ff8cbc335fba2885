"""What a tree search knows of a state, found out once however often the state occurs in the trees."""

from typing import final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import GROWTH, check_memory
from pgts_torch.search.outcome_table import has_weight
from pgts_torch.search.topology import Topology


@final
class KnownStates:
    """Tables over the states T that a search has expanded, with E = A * K outcomes. Outcomes themselves are in the
    table of the topology.

    table_row_T: the row of the state in `topology.table`.
    value_TE: what the critic says of the state that an outcome leads to; 0 where the outcome has no weight.
    q_TA, v_T: r + sum_k p_k gamma_k v(child), and its maximum.
    prior_TA: the policy that the search starts from.
    exhausted_outcome_TE, exhausted_action_TA, exhausted_T: numbers to add to a score: -inf where the outcome, all
        outcomes of the action or all outcomes of the state have no weight, so that nothing is below; else 0.
    width_TA, outcomes_T: how many outcomes of the action, and of the state, have weight.
    weighed_TA: the probability that an outcome of the action has weight.
    row_S: the row T of a state; -1 where it is unknown.
    """

    def __init__(self, topology: Topology, leaves: Leaves) -> None:
        self.topology, self._leaves = topology, leaves
        model = topology.model
        self.num_actions, self.num_outcomes = model.num_actions, 1
        self.device, self.dtype = model.device, model.dtype
        self.row_S = torch.full((model.num_states,), -1, device=self.device)
        self.count = 0

        def none(*width: int, dtype: torch.dtype = self.dtype) -> Tensor:
            return torch.zeros(0, *width, dtype=dtype, device=self.device)

        A = self.num_actions
        self.q_TA, self.prior_TA, self.exhausted_action_TA, self.weighed_TA = (none(A) for _ in range(4))
        self.width_TA = none(A, dtype=torch.float64)
        self.value_TE, self.exhausted_outcome_TE = none(A), none(A)
        self.v_T, self.exhausted_T = none(), none()
        self.outcomes_T, self.table_row_T = none(dtype=torch.int64), none(dtype=torch.int64)

    def rows(self, state_N: Int[Tensor, "N"], **tree: int) -> Int[Tensor, "N"]:
        """The rows T of these states; the model and the critic are first called for the new ones, together.

        Args:
            tree: what the nodes of the search take, see `check_memory`.

        Raises:
            PgtsError: the model, the critic or the prior returns something that cannot be used.
            NodeBudgetExceeded: see `check_memory`; the model has not been queried.
        """
        row_N = self.row_S.index_select(0, state_N)
        if int(row_N.amin()) < 0:
            new_N = state_N[row_N < 0].unique()
            self.check_memory(len(new_N), **tree)
            self._learn(new_N)
            row_N = self.row_S.index_select(0, state_N)
        else:
            self.check_memory(0, **tree)
        return row_N

    def check_memory(self, new: int, **tree: int) -> None:
        """NodeBudgetExceeded if so many more states, beside the tree, are too much.

        Args:
            tree: what the tree counts: nodes, places and arms.
        """
        learned = self.count + new
        needed = self.topology.bytes(new, looked_up=new, kept=new, learned=learned, **tree)
        nodes = tree.get("nodes", 0)
        what = f"the search ({nodes} nodes, {learned} states of {self.num_actions} actions)"
        check_memory(needed, self.topology.max_bytes, what)

    def weight_NE(self, row_N: Int[Tensor, "N"]) -> Float[Tensor, "N E"]:
        """p_k gamma_k of the outcomes of some of the known states; 0 where an outcome has no weight."""
        table, table_row_N = self.topology.table, self.table_row_T.index_select(0, row_N)
        weight_NAK = table.prob_RAK.index_select(0, table_row_N).mul_(table.discount_RAK.index_select(0, table_row_N))
        # An action that is not allowed may have outcomes with p gamma > 0.
        return weight_NAK.flatten(1).masked_fill_(self.exhausted_outcome_TE.index_select(0, row_N) < 0, 0)

    def _learn(self, state_N: Int[Tensor, "N"]) -> None:
        with torch.inference_mode(False), torch.no_grad():
            state_N = state_N.clone()
            outcomes, children = self.topology.step(state_N)
            v_C = self._leaves.v(children) if len(children) else None
            prior_NA = self._leaves.prior(state_N)
        N, _, K = outcomes.child_NAK.shape
        weighs_NAK = has_weight(outcomes)
        zero = torch.zeros((), dtype=self.dtype, device=self.device)
        prob_NAK = torch.where(weighs_NAK, outcomes.prob_NAK, zero)
        weight_NAK = torch.where(weighs_NAK, outcomes.prob_NAK * outcomes.discount_NAK, zero)
        # `outcomes.child_NAK` are positions in `children`, 0 where an outcome has no weight.
        value_NAK = zero.expand(N, self.num_actions, K)
        if v_C is not None:
            value_NAK = torch.where(weighs_NAK, v_C[outcomes.child_NAK], zero)
        q_NA = outcomes.reward_NA + (weight_NAK * value_NAK).sum(-1)
        exhausted_NAK = torch.where(weighs_NAK, zero, -torch.inf)
        exhausted_NA = exhausted_NAK.amax(-1)
        self._add(
            state_N,
            K,
            table_row_T=self.topology.row_S[state_N],
            value_TE=value_NAK,
            q_TA=q_NA,
            v_T=q_NA.amax(-1),
            prior_TA=prior_NA,
            exhausted_outcome_TE=exhausted_NAK,
            exhausted_action_TA=exhausted_NA,
            exhausted_T=exhausted_NA.amax(-1),
            width_TA=weighs_NAK.sum(2).double(),
            outcomes_T=weighs_NAK.sum((1, 2)),
            weighed_TA=prob_NAK.sum(-1),
        )

    def _add(self, state_N: Int[Tensor, "N"], K: int, **columns: Tensor) -> None:
        """Rows for these states, whose outcomes are K of each action."""
        if self.num_outcomes < K:
            for name, fill in (("value_TE", 0.0), ("exhausted_outcome_TE", -torch.inf)):
                setattr(self, name, widened(getattr(self, name), self.num_outcomes, K, fill))
            self.num_outcomes = K
        first, last = self.count, self.count + len(state_N)
        if last > len(self.v_T):
            for name in columns:
                setattr(self, name, longer(getattr(self, name), max(last, int(GROWTH * len(getattr(self, name))))))
        for name, rows in columns.items():
            getattr(self, name)[first:last] = rows.reshape(len(state_N), *getattr(self, name).shape[1:])
        if (missing := self.topology.model.num_states - len(self.row_S)) > 0:  # states that the model has met since
            self.row_S = torch.nn.functional.pad(self.row_S, (0, missing + len(self.row_S)), value=-1)
        self.row_S[state_N] = torch.arange(first, last, device=self.device)
        self.count = last


def longer(x_N: Tensor, rows: int) -> Tensor:
    """The same rows, followed by zeros until there are so many."""
    return torch.cat([x_N, x_N.new_zeros(rows - len(x_N), *x_N.shape[1:])])


def widened(x_NE: Tensor, old: int, new: int, fill: float = 0) -> Tensor:
    """The same outcomes of each action with room for `new` in place of `old`."""
    x_NAK = x_NE.view(len(x_NE), x_NE.shape[1] // old, old)
    return torch.nn.functional.pad(x_NAK, (0, new - old), value=fill).flatten(1)
