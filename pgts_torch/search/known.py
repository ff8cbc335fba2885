"""What a tree search knows of a state, found out once however often the state occurs in the tree."""

from typing import final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import GROWTH, check_memory
from pgts_torch.search.topology import Topology, counting


@final
class KnownStates:
    """Tables over the states T that a search has expanded, with their outcomes E = A * K.

    reward_TA: -inf where the action is not allowed.
    weight_TE, prob_TE: p_k gamma_k and p_k of an outcome, 0 where it has no weight; p_k in float64.
    carry_TE: gamma_k times the probability that an outcome of the action has weight: what is left of a return that is
        drawn from those that have.
    child_TE, value_TE: the state that an outcome leads to, and what the critic says of it.
    q_TA, v_T: r + sum_k p_k gamma_k v(child) and its maximum.
    prior_TA: the policy that the search starts from.
    shut_outcome_TE, shut_action_TA, shut_T: 0, or -inf where an outcome, all outcomes of an action or all outcomes of
        the state have no weight.
    outcomes_T, width_TA: how many outcomes of the state, and of each action, have weight.
    max_bytes: the topology's: the most memory that the tables and the nodes of the search may take.
    """

    def __init__(self, topology: Topology, leaves: Leaves) -> None:
        self._topology, self._leaves, self.max_bytes = topology, leaves, topology.max_bytes
        model = topology.model
        self.num_actions, self.num_outcomes = model.num_actions, 1
        self.device, self.dtype = model.device, model.dtype
        self.row_S = torch.full((model.num_states,), -1, device=self.device)
        self.count = 0

        def none(*width: int, dtype: torch.dtype = self.dtype) -> Tensor:
            return torch.zeros(0, *width, dtype=dtype, device=self.device)

        A = self.num_actions
        self.reward_TA, self.q_TA, self.shut_action_TA, self.prior_TA = (none(A) for _ in range(4))
        self.width_TA = none(A, dtype=torch.float64)
        self.weight_TE, self.carry_TE, self.value_TE, self.shut_outcome_TE = (none(A) for _ in range(4))
        self.prob_TE, self.child_TE = none(A, dtype=torch.float64), none(A, dtype=torch.int64)
        self.v_T, self.shut_T, self.outcomes_T = none(), none(), none(dtype=torch.int64)

    def rows(self, state_N: Int[Tensor, "N"], **tree: int) -> Int[Tensor, "N"]:
        """Where these states stand in the tables; those that are new are asked about first, together.

        Args:
            tree: what the nodes of the search take, see `check_memory`.

        Raises:
            PgtsError: the model, the critic or the prior answers with something that cannot be used.
            NodeBudgetExceeded: see `check_memory`; the model has not been asked.
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
        needed = self._topology.bytes(new, asked=new, kept=new, learned=learned, **tree)
        nodes = tree.get("nodes", 0)
        check_memory(
            needed, self.max_bytes, f"the search ({nodes} nodes, {learned} states of {self.num_actions} actions)"
        )

    def _learn(self, state_N: Int[Tensor, "N"]) -> None:
        with torch.inference_mode(False), torch.no_grad():
            state_N = state_N.clone()
            outcomes, children = self._topology.step(state_N)
            v_C = self._leaves.v(children) if len(children) else None
            prior = self._leaves.prior(state_N)
        N, _, K = outcomes.child_NAK.shape
        has_weight = counting(outcomes)
        zero = torch.zeros((), dtype=self.dtype, device=self.device)
        prob = torch.where(has_weight, outcomes.prob_NAK, zero)
        weight = torch.where(has_weight, outcomes.prob_NAK * outcomes.discount_NAK, zero)
        child, value = torch.zeros_like(outcomes.child_NAK), torch.zeros_like(prob)
        if v_C is not None:
            child = torch.where(has_weight, children[outcomes.child_NAK], 0)
            value = torch.where(has_weight, v_C[outcomes.child_NAK], zero)
        q = outcomes.reward_NA + (weight * value).sum(-1)
        shut_outcome = torch.where(has_weight, zero, -torch.inf)
        shut_action = shut_outcome.amax(-1)
        more = {
            "reward_TA": outcomes.reward_NA,
            "weight_TE": weight,
            "prob_TE": prob.double(),
            "carry_TE": torch.where(has_weight, outcomes.discount_NAK, zero) * prob.sum(-1, keepdim=True),
            "child_TE": child,
            "value_TE": value,
            "q_TA": q,
            "v_T": q.amax(-1),
            "prior_TA": prior,
            "shut_outcome_TE": shut_outcome,
            "shut_action_TA": shut_action,
            "shut_T": shut_action.amax(-1),
            "width_TA": has_weight.sum(2).double(),
            "outcomes_T": has_weight.sum((1, 2)),
        }
        self._widen(K)
        first, last = self.count, self.count + N
        if last > len(self.v_T):
            for name in more:
                setattr(self, name, longer(getattr(self, name), max(last, int(GROWTH * len(getattr(self, name))))))
        for name, rows in more.items():
            getattr(self, name)[first:last] = rows.view(N, *getattr(self, name).shape[1:])
        if (missing := self._topology.model.num_states - len(self.row_S)) > 0:
            self.row_S = torch.nn.functional.pad(self.row_S, (0, missing + len(self.row_S)), value=-1)
        self.row_S[state_N] = torch.arange(first, last, device=self.device)
        self.count = last

    def _widen(self, K: int) -> None:
        """Room for K outcomes of each action."""
        if self.num_outcomes < K:
            for name in ("weight_TE", "prob_TE", "carry_TE", "child_TE", "value_TE", "shut_outcome_TE"):
                fill = -torch.inf if name.startswith("shut") else 0
                setattr(self, name, widened(getattr(self, name), self.num_outcomes, K, fill))
            self.num_outcomes = K


def longer(x_N: Tensor, rows: int) -> Tensor:
    """The same rows and as many zeros as it takes to be so many."""
    return torch.cat([x_N, x_N.new_zeros(rows - len(x_N), *x_N.shape[1:])])


def widened(x_NE: Tensor, old: int, new: int, fill: float = 0) -> Tensor:
    """The same outcomes of each action with room for `new` in place of `old`."""
    x_NAK = x_NE.view(len(x_NE), x_NE.shape[1] // old, old)
    return torch.nn.functional.pad(x_NAK, (0, new - old), value=fill).flatten(1)
