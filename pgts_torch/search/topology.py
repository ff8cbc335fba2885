"""Which states a lookahead meets at which level. Transitions do not depend on the policy: this outlives a call."""

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import NodeBudgetExceeded, PgtsError
from pgts_torch.models.base import EnumeratingModel

_REMEMBERED_ROOTS = 8
"""How many different batches of roots keep their levels."""


@dataclass(eq=False)
class Levels:
    """The frontiers that a batch of roots unfolds into, as far as anyone has asked.

    frontiers: the distinct states at level 0, 1, ...
    outcomes: outcomes[k] leads from frontier k to positions in frontier k + 1, or, in the last place once the search is
        closed, to positions in the closed set.
    closed: outcomes of the closed set in itself, once a level brings no new state; else None.
    closed_states: every state met so far, in the order of `closed`; complete once the search is closed.
    root_row_B: the position of each root in frontier 0.
    """

    frontiers: list[Int[Tensor, "N"]]
    root_row_B: Int[Tensor, "B"]
    outcomes: list[Outcomes] = field(default_factory=list)
    closed: Outcomes | None = None
    closed_states: Int[Tensor, "N"] = field(init=False)

    def __post_init__(self) -> None:
        self.closed_states = self.frontiers[0]

    def steps(self, expansions: int) -> Iterator[Outcomes]:
        """The outcomes of `expansions` levels, from the leaves up to the roots."""
        for _ in range(expansions - len(self.outcomes)):
            assert self.closed is not None
            yield self.closed
        yield from reversed(self.outcomes[:expansions])

    def leaves(self, expansions: int) -> Int[Tensor, "N"]:
        """The states at the bottom of `expansions` levels."""
        if self.closed is not None and expansions >= len(self.outcomes):
            return self.closed_states
        return self.frontiers[expansions]

    def nodes_per_level(self, expansions: int) -> tuple[int, ...]:
        """How many nodes each of the levels 0 .. expansions holds."""
        frontiers = [len(frontier) for frontier in self.frontiers[: expansions + 1]]
        return (*frontiers, *[len(self.closed_states)] * (expansions + 1 - len(frontiers)))

    def nodes(self, expansions: int) -> int:
        """How many nodes the levels 0 .. expansions hold together, without listing them."""
        frontiers = [len(frontier) for frontier in self.frontiers[: expansions + 1]]
        return sum(frontiers) + len(self.closed_states) * (expansions + 1 - len(frontiers))


@final
class Topology:
    """What has been asked of a model so far: each (state, action) is asked once, in however many searches it occurs.

    Keep one beside a model and hand it to every search: a search over known states asks the model nothing, and a search
    over the same roots finds its levels ready, to any depth.

    Args:
        model: the model that answers.
    """

    def __init__(self, model: EnumeratingModel) -> None:
        self.model = model
        self.model_calls = 0
        self._known: Outcomes | None = None
        self._row_S = torch.empty(0, dtype=torch.int64, device=model.device)
        self._scratch_S = torch.empty(0, dtype=torch.int64, device=model.device)
        self._levels: OrderedDict[bytes, Levels] = OrderedDict()

    def levels(self, root_B: Int[Tensor, "B"], expansions: int, *, max_nodes: int) -> Levels:
        """The levels below `root_B`, at least `expansions` of them or a closed set.

        Args:
            root_B: states of the model, in any order, repeated or not.
            expansions: how many levels are to be expanded.
            max_nodes: the most nodes, summed over levels 0 .. expansions.

        Raises:
            PgtsError: no roots, or one that is not a state of the model.
            NodeBudgetExceeded: the levels hold more nodes than that; the model has not been asked about them.
        """
        key = root_B.cpu().numpy().tobytes()
        levels = self._levels.get(key)
        if levels is None:
            self._check_roots(root_B)
            self._grow_tables()
            roots = self._distinct(root_B)
            levels = Levels([roots], self._position(roots)[root_B])
            self._levels[key] = levels
            if len(self._levels) > _REMEMBERED_ROOTS:
                self._levels.popitem(last=False)
        self._levels.move_to_end(key)
        while levels.closed is None and len(levels.outcomes) < expansions:
            _check_budget(levels, len(levels.outcomes), max_nodes)
            self._expand(levels)
        _check_budget(levels, expansions, max_nodes)
        return levels

    def _expand(self, levels: Levels) -> None:
        """One more level: ask about the states of the last frontier that are new, and find their children."""
        frontier = levels.frontiers[-1]
        outcomes = self._outcomes(frontier)
        # What has weight 0 (a terminal outcome, or padding) counts for nothing and needs no node.
        counts_NAK = outcomes.prob_NAK * outcomes.discount_NAK > 0
        children = self._distinct(outcomes.child_NAK[counts_NAK])
        seen_S = self._position(levels.closed_states, default=-1)
        new = children[seen_S[children] < 0]
        if len(new) == 0:
            levels.outcomes.append(self._renumbered(outcomes, counts_NAK, levels.closed_states))
            inside = self._outcomes(levels.closed_states)
            inside_counts_NAK = inside.prob_NAK * inside.discount_NAK > 0
            levels.closed = self._renumbered(inside, inside_counts_NAK, levels.closed_states)
            return
        levels.outcomes.append(self._renumbered(outcomes, counts_NAK, children))
        levels.frontiers.append(children)
        levels.closed_states = torch.cat([levels.closed_states, new])

    def _outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """Outcomes in terms of states; the model is asked about those only that it has never been asked about."""
        missing = state_N[self._row_S[state_N] < 0]
        if len(missing):
            answer = self.model.outcomes(missing)
            self.model_calls += len(missing) * self.model.num_actions
            known = 0 if self._known is None else self._known.num_states
            self._known = answer if self._known is None else _concatenate(self._known, answer)
            self._grow_tables()
            self._row_S[missing] = torch.arange(known, known + len(missing), device=self.model.device)
        assert self._known is not None
        return self._known.rows(self._row_S[state_N])

    def _renumbered(self, outcomes: Outcomes, counts_NAK: Tensor, states: Int[Tensor, "C"]) -> Outcomes:
        """The same outcomes with children given by their position among `states`; those that do not count get 0."""
        position_NAK = self._position(states)[outcomes.child_NAK]
        return Outcomes(
            outcomes.reward_NA,
            outcomes.prob_NAK,
            outcomes.discount_NAK,
            torch.where(counts_NAK, position_NAK, 0),
            len(states),
        )

    def _distinct(self, state_N: Int[Tensor, "N"]) -> Int[Tensor, "N"]:
        """The states without repetition, ascending: one write and one read a state instead of sorting them all."""
        order_N = torch.arange(len(state_N), device=self.model.device)
        self._scratch_S[state_N] = order_N
        return state_N[self._scratch_S[state_N] == order_N].sort().values

    def _position(self, states: Int[Tensor, "N"], default: int | None = None) -> Int[Tensor, "S"]:
        """A table that holds, at each of `states`, its position among them; elsewhere `default`, or anything."""
        if default is not None:
            self._scratch_S.fill_(default)
        self._scratch_S[states] = torch.arange(len(states), device=self.model.device)
        return self._scratch_S

    def _grow_tables(self) -> None:
        """Room for the states that the model has numbered since."""
        missing = self.model.num_states - len(self._row_S)
        if missing > 0:
            unknown = torch.full((missing,), -1, dtype=torch.int64, device=self.model.device)
            self._row_S = torch.cat([self._row_S, unknown])
            self._scratch_S = torch.cat([self._scratch_S, unknown])

    def _check_roots(self, root_B: Int[Tensor, "B"]) -> None:
        if root_B.ndim != 1 or len(root_B) == 0:
            raise PgtsError(f"root_B has shape {tuple(root_B.shape)}; it must be a vector of at least one state")
        if root_B.dtype != torch.int64:
            raise PgtsError(f"root_B is {root_B.dtype}; states are int64")
        off = torch.nonzero((root_B < 0) | (root_B >= self.model.num_states)).flatten()
        if len(off):
            raise PgtsError(
                f"root_B[{int(off[0])}] is {int(root_B[off[0]])}; states are 0 to {self.model.num_states - 1}"
            )


def _check_budget(levels: Levels, expansions: int, max_nodes: int) -> None:
    nodes = levels.nodes(expansions)
    if nodes > max_nodes:
        raise NodeBudgetExceeded(
            f"the lookahead has {nodes} nodes on levels 0 to {expansions}; max_nodes is {max_nodes}: "
            "lower the depth, ask for fewer roots or raise the budget"
        )


def _concatenate(first: Outcomes, second: Outcomes) -> Outcomes:
    """The rows of both, padded to the larger K."""
    K = max(first.num_outcomes, second.num_outcomes)

    def joined(x: Tensor, y: Tensor) -> Tensor:
        pad = torch.nn.functional.pad
        return torch.cat([pad(x, (0, K - x.shape[-1])), pad(y, (0, K - y.shape[-1]))])

    return Outcomes(
        torch.cat([first.reward_NA, second.reward_NA]),
        joined(first.prob_NAK, second.prob_NAK),
        joined(first.discount_NAK, second.discount_NAK),
        joined(first.child_NAK, second.child_NAK),
        second.num_children,
    )
