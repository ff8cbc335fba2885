"""Trees whose nodes get more of the actions drawn for them the more often they are visited (progressive widening)."""

import math
from collections.abc import Callable
from typing import Self, final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.base import Model
from pgts_torch.models.drawn_actions import DrawnActions
from pgts_torch.options.search import MCTS
from pgts_torch.search.lookahead import Leaves
from pgts_torch.search.memory import Sizes, check_memory, check_nodes, search_bytes, tree_nodes
from pgts_torch.search.split import Selection

_SLACK = 1e-9
"""By how much C N^alpha may be above a whole number that it is by rounding."""


@final
class WideningTrees:
    """One simulation after another, below all roots at once, over K drawn actions, of which a node that was visited N
    times has (Couetoux et al. 2011)

        k(N) = min(K, ceil(C N^alpha)),    alpha in [0, 1]

    and one more where nothing is left to expand below those that it has. A root has all K. The model is queried for an
    action when a node gets it; the values of nodes are maxima over the actions that they have. So with C >= K, and
    after finitely many simulations whatever C and alpha are, these are the trees of a search that expands all actions.

    A: K.
    nodes: itself. As of `Tree`, `q_NA` and `visits_NA` are values and simulations; q is -inf of actions that a node
        does not have.

    Args:
        model: in which each action has one outcome.
        bottom: nodes at this level are never expanded.

    Raises:
        NodeBudgetExceeded: there would not be room.
    """

    def __init__(
        self, model: DrawnActions, leaves: Leaves, bottom: int, options: MCTS, *, num_roots: int, max_bytes: int
    ) -> None:
        assert options.widening is not None
        self.model, self.A, self._leaves, self._bottom = model, model.num_actions, leaves, bottom
        self._selection = Selection(options.rule, 1.25 if options.exploration is None else options.exploration)
        self._widening, self._max_nodes = options.widening, options.max_nodes
        self._power = 0.5 if options.widening_power is None else options.widening_power
        room = int(num_roots * min(options.simulations, tree_nodes(1, self.A, bottom - 1))) + 1
        needed = search_bytes(Sizes(self.A, 1, model.dtype), nodes=room)
        check_memory(needed, max_bytes, f"the search ({room - 1} nodes of {self.A} actions)")
        device, A = model.device, self.A

        def column(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
            return torch.zeros(room, *shape, dtype=dtype, device=device)

        # Row 0 is no node. An arm, [N, A], is a node's action: what it pays, the state that it leads to and the node
        # that stands for it, 0 where there is none; and whether something is left to expand below it.
        self.count = 1
        self._state_N, self._level_N, self._has_N = (column(dtype=torch.int64) for _ in range(3))
        self.visits_N, self._v_N, self._open_N = column(), column(), column(dtype=torch.bool)
        self.q_NA, self.visits_NA, self._prior_NA = column(A), column(A), column(A)
        self._reward_NA, self._discount_NA = column(A), column(A)
        self._child_NA, self._below_NA = column(A, dtype=torch.int64), column(A, dtype=torch.int64)
        self._open_NA = column(A, dtype=torch.bool)
        self.model_calls, self.nodes_per_level = 0, [num_roots] + [0] * bottom

    def add_roots(self, state_B: Int[Tensor, "B"]) -> Int[Tensor, "B"]:
        """Nodes for these distinct states, with all their actions."""
        node_B = self._add(state_B, torch.zeros_like(state_B))
        self._measured(len(node_B) * self.A, lambda: self._widen(node_B, torch.full_like(node_B, self.A)))
        self._sum_up(node_B)
        return node_B

    def open(self, node_B: Int[Tensor, "B"]) -> Bool[Tensor, "B A"]:
        """Actions of these roots below which there is something to expand."""
        return self._open_NA[node_B]

    @property
    def nodes(self) -> Self:
        return self

    def split(self, node_B: Int[Tensor, "B"], budget_B: Float[Tensor, "B"]) -> Float[Tensor, "B A"]:
        """Which action the one simulation that passes each of these nodes takes, as 1 among 0."""
        return torch.zeros_like(self.q_NA[node_B]).scatter_(1, self._select(node_B)[:, None], 1.0)

    def wave(self, node_B: Int[Tensor, "B"], share_BA: Float[Tensor, "B A"]) -> Float[Tensor, "B"]:
        """A simulation by each action of these roots whose share is 1; how many there were of each root."""
        row_L, action_L = share_BA.nonzero().unbind(1)
        self._measured(
            len(row_L) * calls_of_simulation(self._widening), lambda: self._simulate(node_B[row_L], action_L)
        )
        return share_BA.sum(1)

    def _measured(self, calls: int, work: Callable[[], None]) -> None:
        """Do what takes at most so many calls of the model, and measure it."""
        if (meter := self._leaves.meter) is None:
            work()
        else:
            apart = torch.empty(0, dtype=torch.int64)
            each = torch.empty(calls, dtype=torch.int64)
            meter.query(each, lambda _: work(), lambda _: (apart, apart), known=self.model_calls, divides=False)

    def _simulate(self, node_L: Int[Tensor, "L"], action_L: Int[Tensor, "L"]) -> None:
        """A simulation by each of these actions of roots."""
        lane_L = torch.arange(len(node_L), device=node_L.device)
        path, end_L, want_L = list[tuple[Tensor, Tensor]](), torch.zeros_like(node_L), torch.zeros_like(node_L)
        while len(lane_L):  # those lanes of simulations that have not come to their end
            path.append((node_L, action_L))
            self.visits_NA[node_L, action_L] += 1
            below_L = self._below_NA[node_L, action_L]
            new_L = below_L == 0
            if bool(new_L.any()):
                arm_M = node_L[new_L], action_L[new_L]
                below_L = below_L.masked_scatter(new_L, self._add(self._child_NA[arm_M], self._level_N[arm_M[0]] + 1))
                self._below_NA[arm_M] = below_L[new_L]
            self.visits_N[below_L] += 1
            has_L, most_L = self._has_N[below_L], self._allowed(self.visits_N[below_L])
            # At least one more where there is no way down.
            most_L = torch.where(self._open_NA[below_L].any(1), most_L, most_L.maximum(has_L + 1)).clamp(max=self.A)
            ends_L = most_L > has_L
            end_L[lane_L[ends_L]], want_L[lane_L[ends_L]] = below_L[ends_L], most_L[ends_L]
            lane_L, node_L = lane_L[~ends_L], below_L[~ends_L]
            action_L = self._select(node_L) if len(node_L) else node_L
        self._widen(end_L, want_L)
        self._sum_up(end_L)
        for node_L, action_L in reversed(path):
            self._back_up(node_L, action_L)

    def _allowed(self, visits_L: Float[Tensor, "L"]) -> Int[Tensor, "L"]:
        """k(N)."""
        return (self._widening * visits_L**self._power - _SLACK).ceil().clamp(1, self.A).long()

    def _add(self, state_L: Int[Tensor, "L"], level_L: Int[Tensor, "L"]) -> Int[Tensor, "L"]:
        """Nodes without actions for these states."""
        node_L = torch.arange(self.count, self.count + len(state_L), device=state_L.device)
        self.count += len(state_L)
        self._state_N[node_L], self._level_N[node_L] = state_L, level_L
        self._prior_NA[node_L] = self._leaves.prior(state_L).double()
        self.q_NA[node_L] = -torch.inf
        return node_L

    def _widen(self, node_L: Int[Tensor, "L"], want_L: Int[Tensor, "L"]) -> None:
        """Query the model for the next actions of these distinct nodes, so that they have as many as that, and the
        critic for what follows."""
        place_A = torch.arange(self.A, device=node_L.device)
        is_new_LA = (place_A >= self._has_N[node_L, None]) & (place_A < want_L[:, None])
        lane_M, action_M = is_new_LA.nonzero().unbind(1)
        node_M = node_L[lane_M]
        made = self.model.follow(self._state_N[node_M], action_M)
        self.model_calls += len(node_M)
        self._has_N[node_L] = want_L
        reward_M, discount_M, child_M = made.reward_N.double(), made.discount_N.double(), made.next_state_N
        if not bool(reward_M.isfinite().all()):
            off = int((~reward_M.isfinite()).nonzero()[0, 0])
            raise NotFinite(
                f"the model's reward in state {int(self._state_N[node_M[off]])} is {float(reward_M[off])} under a "
                "drawn action; it must be a number",
                what="reward",
            )
        goes_on_M, value_M = discount_M > 0, torch.zeros_like(reward_M)
        if bool(goes_on_M.any()):
            value_M[goes_on_M] = self._leaves.v(child_M[goes_on_M]).double()
        arm_M = node_M, action_M
        self._reward_NA[arm_M], self._discount_NA[arm_M], self._child_NA[arm_M] = reward_M, discount_M, child_M
        self.q_NA[arm_M] = reward_M + discount_M * value_M
        level_M = self._level_N[node_M] + 1
        self._open_NA[arm_M] = goes_on_M & (level_M < self._bottom)
        for level, count in enumerate(torch.bincount(level_M[goes_on_M], minlength=self._bottom + 1).tolist()):
            self.nodes_per_level[level] += count
        check_nodes(sum(self.nodes_per_level), self._max_nodes)

    def _select(self, node_L: Int[Tensor, "L"]) -> Int[Tensor, "L"]:
        """The best action with something to expand below it, by the tree rule among those that a node has."""
        q_LA = self.q_NA[node_L]
        prior_LA = self._prior_NA[node_L].masked_fill(q_LA == -torch.inf, 0.0)
        return self._selection.best(
            q_NA=q_LA,
            visits_NA=self.visits_NA[node_L],
            prior_NA=prior_LA / prior_LA.sum(1, keepdim=True),
            open_NA=self._open_NA[node_L],
        )

    def _back_up(self, node_L: Tensor, action_L: Tensor) -> None:
        """q of these actions from the nodes that stand for what follows, and what that changes in their own nodes."""
        arm_L, below_L = (node_L, action_L), self._below_NA[node_L, action_L]
        self.q_NA[arm_L] = self._reward_NA[arm_L] + self._discount_NA[arm_L] * self._v_N[below_L]
        self._open_NA[arm_L] = self._open_N[below_L]
        self._sum_up(node_L)

    def _sum_up(self, node_L: Int[Tensor, "L"]) -> None:
        """v of nodes, and whether something is left to expand there."""
        self._v_N[node_L] = self.q_NA[node_L].amax(1)
        self._open_N[node_L] = (self._has_N[node_L] < self.A) | self._open_NA[node_L].any(1)

    def pruned(self, node_B: Int[Tensor, "B"]) -> Float[Tensor, "B A"]:
        """`Lookahead.pruned_BA`: 0 where nothing is left to expand below an action, else inf, because a maximum over
        some of the actions is no value that the critic gave."""
        return torch.where(self._open_NA[node_B], torch.inf, 0.0)


def calls_of_simulation(widening: float) -> int:
    """For how many actions a simulation below the root queries the model, at most: a new node has ceil(C)."""
    return max(1, math.ceil(widening))


def drawn_actions(model: Model, options: MCTS) -> DrawnActions:
    """The model, if its actions are drawn; else PgtsError."""
    if not isinstance(model, DrawnActions):
        raise PgtsError(
            f"search.widening is {options.widening}, which is for actions that are drawn (policy.type gaussian); those "
            f"of {type(model).__name__} are numbered"
        )
    return model
