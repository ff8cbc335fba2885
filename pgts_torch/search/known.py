"""What a tree search knows of a state, found out once however often the state occurs in the trees."""

from typing import final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.errors import PgtsError
from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import check_memory
from pgts_torch.search.outcome_table import has_weight
from pgts_torch.search.table import Table, with_room
from pgts_torch.search.topology import Topology


@final
class KnownStates(Table):
    """A row for each state that a search has expanded. The outcomes themselves are in the table of the topology.

    table_row_T: the row of the state in `topology.table`.
    value_TAK: the critic's value of the state that an outcome leads to; 0 where the outcome has no weight.
    q_TA, v_T: r + sum_k p_k gamma_k v(child), and its maximum.
    prior_TA: the policy that the search starts from.
    exhausted_TAK, exhausted_TA, exhausted_T: numbers to add to a score: -inf where the outcome, all outcomes of the
        action or all outcomes of the state have no weight, so that nothing is below; else 0.
    width_TA, outcomes_T: how many outcomes of the action, and of the state, have weight.
    weighed_TA: the probability that an outcome of the action has weight.
    row_S: the row T of a state; -1 where it is unknown.
    """

    axis = "T"

    def __init__(self, topology: Topology, leaves: Leaves) -> None:
        model = topology.model
        super().__init__(model.num_actions, 1, model.dtype, model.device)
        self.topology, self._leaves = topology, leaves
        self.row_S = torch.full((model.num_states,), -1, device=self.device)
        self.table_row_T, self.outcomes_T = (self._column(dtype=torch.int64) for _ in range(2))
        self.v_T, self.exhausted_T = self._column(), self._column()
        self.q_TA, self.prior_TA, self.exhausted_TA, self.weighed_TA = (self._column("A") for _ in range(4))
        self.width_TA = self._column("A", dtype=torch.float64)
        self.value_TAK, self.exhausted_TAK = self._column("AK"), self._column("AK")
        self._useful = dict[tuple[int, int], Tensor]()

    def rows(self, state_N: Int[Tensor, "N"], **tree: int) -> Int[Tensor, "N"]:
        """The rows T of these states; the model and the critic are first called for the new ones, together.

        Raises:
            PgtsError: the model, the critic or the prior returns something that cannot be used.
            NodeBudgetExceeded: it would be too much, and the model has not been queried.
        """
        row_N = self.row_S.index_select(0, state_N)
        if int(row_N.amin()) >= 0:
            self.check_memory(0, **tree)
            return row_N
        new_N = state_N[row_N < 0].unique()
        self.check_memory(len(new_N), **tree)
        self._learn(new_N)
        return self.row_S.index_select(0, state_N)

    def check_memory(self, new: int, **tree: int) -> None:
        """NodeBudgetExceeded if so many more states, beside the tree, are too much.

        Args:
            tree: what the tree counts: nodes, places and arms.
        """
        learned = self.count + new
        needed = self.topology.bytes(new, looked_up=new, kept=new, learned=learned, **tree)
        what = f"the search ({tree.get('nodes', 0)} nodes, {learned} states of {self.num_actions} actions)"
        check_memory(needed, self.topology.max_bytes, what)

    def weight_NAK(self, row_N: Int[Tensor, "N"]) -> Float[Tensor, "N A K"]:
        """p_k gamma_k of the outcomes of some of the known states; 0 where an outcome has no weight."""
        table, table_row_N = self.topology.table, self.table_row_T.index_select(0, row_N)
        weight_NAK = table.prob_RAK.index_select(0, table_row_N).mul_(table.discount_RAK.index_select(0, table_row_N))
        # An action that is not allowed may have outcomes with p gamma > 0.
        return weight_NAK.masked_fill_(self.exhausted_TAK.index_select(0, row_N) < 0, 0)

    def useful(self, row_N: Int[Tensor, "N"], levels: int) -> Float[Tensor, "N 1"]:
        """How many simulations a subtree of so many levels below an outcome of these states can use, if all states in
        it have as many outcomes e: 1 + e + e^2 + ...

        An estimate, in order that simulations do not crowd where there is little to expand.
        """
        key = levels, self.count
        if key not in self._useful:
            outcomes_T = self.outcomes_T.double()
            useful_T = torch.zeros_like(outcomes_T)
            for _ in range(levels):
                useful_T.mul_(outcomes_T).add_(1)
            self._useful[key] = useful_T
        return self._useful[key].index_select(0, row_N).unsqueeze(1)

    def _learn(self, state_N: Int[Tensor, "N"]) -> None:
        # The code of the model, of the critic and of the policy is not run in inference mode.
        with torch.inference_mode(False), torch.no_grad():
            state_N = state_N.clone()
            outcomes, children = self.topology.step(state_N)
            v_C = self._leaves.v(children) if len(children) else None
            prior_NA = prior_of_allowed(self._leaves.prior(state_N), outcomes.reward_NA, state_N)
        # Terminal outcomes, actions that are not allowed and padding count nothing, whatever their numbers.
        weighs_NAK = has_weight(outcomes)
        zero = torch.zeros((), dtype=self.dtype, device=self.device)
        prob_NAK = torch.where(weighs_NAK, outcomes.prob_NAK, zero)
        weight_NAK = torch.where(weighs_NAK, outcomes.prob_NAK * outcomes.discount_NAK, zero)
        # `outcomes.child_NAK` are positions in `children`, 0 where an outcome has no weight.
        value_NAK = zero.expand(weighs_NAK.shape) if v_C is None else v_C[outcomes.child_NAK].where(weighs_NAK, zero)
        q_NA = outcomes.reward_NA + (weight_NAK * value_NAK).sum(-1)
        # Added to a score, -inf says that there is nothing to select; the maximum is 0 as long as one has weight.
        exhausted_NAK = torch.where(weighs_NAK, zero, -torch.inf)
        exhausted_NA = exhausted_NAK.amax(-1)
        row_N = self._append(
            table_row_T=self.topology.table.row_S[state_N],
            value_TAK=value_NAK,
            q_TA=q_NA,
            v_T=q_NA.amax(-1),
            prior_TA=prior_NA,
            exhausted_TAK=exhausted_NAK,
            exhausted_TA=exhausted_NA,
            exhausted_T=exhausted_NA.amax(-1),
            width_TA=weighs_NAK.sum(2).double(),
            outcomes_T=weighs_NAK.sum((1, 2)),
            weighed_TA=prob_NAK.sum(-1),
        )
        self.row_S = with_room(self.row_S, self.topology.model.num_states)  # with those that the model has met since
        self.row_S[state_N] = row_N


def prior_of_allowed(
    prior_NA: Float[Tensor, "N A"], reward_NA: Float[Tensor, "N A"], state_N: Int[Tensor, "N"]
) -> Float[Tensor, "N A"]:
    """The prior probabilities of actions, given that the action is allowed: its reward is not -inf.

    Raises:
        PgtsError: no action that is allowed in a state has a prior.
    """
    allowed_NA = reward_NA > -torch.inf
    if allowed_NA.all():
        return prior_NA
    share_NA = prior_NA.where(allowed_NA, 0)
    total_N1 = share_NA.sum(-1, keepdim=True)
    if (total_N1 == 0).any():
        n = int((total_N1 == 0).nonzero()[0, 0])
        raise PgtsError(
            f"the prior of state {int(state_N[n])} is {prior_NA[n].tolist()}; one of its allowed actions, "
            f"{allowed_NA[n].nonzero().flatten().tolist()}, must have a probability"
        )
    return torch.where(allowed_NA.all(-1, keepdim=True), prior_NA, share_NA / total_N1)
