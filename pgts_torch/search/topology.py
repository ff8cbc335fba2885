"""Which states a lookahead meets at which level. Transitions do not depend on the policy, so this outlives a search."""

import math
from collections import OrderedDict
from typing import final

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import NodeBudgetExceeded, PgtsError
from pgts_torch.models.base import EnumeratingModel
from pgts_torch.options.search import MAX_BYTES
from pgts_torch.search.levels import Levels
from pgts_torch.search.lookahead import check_states, check_vector
from pgts_torch.search.memory import Sizes, check_memory, search_bytes
from pgts_torch.search.outcome_table import OutcomeTable, check_outcomes, has_weight

_REMEMBERED_ROOTS = 8
"""How many different batches of roots keep their levels."""


@final
class Topology:
    """What a model has answered so far: it is queried once for a (state, action), in however many searches that occurs.

    Keep one beside a model and hand it to every search: a search over known states makes no model calls, and a search
    from the same roots finds its levels ready, to any depth.

    table: the outcomes, in the order of the queries.
    row_S: the row of a state in `table`; -1 where the model was not queried. It may be longer than there are states.
    model_calls: for how many (state, action) the model was queried.

    Args:
        model: enumerates outcomes.
        max_bytes: the most memory that a search may take, with all that is remembered here (`memory.search_bytes`).
    """

    def __init__(self, model: EnumeratingModel, *, max_bytes: int = MAX_BYTES) -> None:
        self.model, self.max_bytes = model, max_bytes
        self.model_calls = 0
        self._generation = model.generation
        self.table = OutcomeTable(model)
        self.row_S = torch.empty(0, dtype=torch.int64, device=model.device)
        # One number for each state, written and read within a method: positions, see `_position` and `_distinct`.
        self._scratch_S = torch.empty(0, dtype=torch.int64, device=model.device)
        # By the bytes of the roots; the least recently used first.
        self._levels: OrderedDict[bytes, Levels] = OrderedDict()

    def levels(self, root_B: Int[Tensor, "B"], expansions: int, *, max_nodes: int) -> Levels:
        """The levels below `root_B`, at least `expansions` of them or a closed set.

        Args:
            root_B: states of the model, in any order, repeated or not.
            expansions: how many levels are to be expanded.
            max_nodes: the most nodes, summed over levels 0 .. expansions.

        Raises:
            PgtsError: no roots, or one that is not a state of the model; the model has been reset since.
            NodeBudgetExceeded: the levels hold more nodes than that, or what follows them would take more memory than
                `max_bytes`; the model has not been queried for them.
        """
        self._check_generation()
        check_vector(root_B)
        key = root_B.cpu().numpy().tobytes()
        levels = self._levels.get(key)
        if levels is None:
            levels = self._levels[key] = self._start(root_B)
            if len(self._levels) > _REMEMBERED_ROOTS:
                self._levels.popitem(last=False)
        self._levels.move_to_end(key)
        # Level by level: the nodes are counted, and their memory is found, before the model is queried.
        while levels.closed is None and len(levels.outcomes) < expansions:
            self._check_nodes(levels, len(levels.outcomes), expansions, max_nodes)
            self._afford(levels.frontiers[-1], levels, f"level {len(levels.outcomes)} of the {expansions}")
            self._expand(levels)
        self._check_nodes(levels, expansions, expansions, max_nodes)
        return levels

    # Methods whose tensors outlive the call leave inference mode: they must be ordinary ones for any later caller.
    @torch.inference_mode(False)
    @torch.no_grad()
    def step(self, state_N: Int[Tensor, "N"], *, kept: int = 0) -> tuple[Outcomes, Int[Tensor, "C"]]:
        """The outcomes of these states, with positions among their distinct children; and these children, ascending.

        Only the answers of the model are remembered. Where every outcome is terminal there are no children, and the
        outcomes cannot be backed up.

        Args:
            kept: how many rows of earlier steps the caller holds.

        Raises:
            NodeBudgetExceeded: what follows these states would take more memory than `max_bytes`.
        """
        self._check_generation()
        self._grow_tables()
        self._afford(state_N, None, "one level", kept=kept)
        outcomes = self._outcomes(state_N)
        # Children are those of outcomes with weight: nothing below the others can change a value.
        weighs_NAK = has_weight(outcomes)
        children = self._distinct(outcomes.child_NAK.masked_select(weighs_NAK))
        return self._with_positions(outcomes, weighs_NAK, children), children

    def fresh(self) -> "Topology":
        """An empty one of the same model and limits."""
        return Topology(self.model, max_bytes=self.max_bytes)

    @property
    def num_outcomes(self) -> int:
        """K, as far as it is known by now."""
        return max(self.model.num_outcomes or 1, self.table.num_outcomes)

    @property
    def queried(self) -> Int[Tensor, "N"]:
        """The states that the model was queried for, ascending."""
        return torch.nonzero(self.row_S >= 0).flatten()

    @property
    def num_expanded(self) -> int:
        """How many states these are."""
        return self.table.count

    def expanded(self) -> tuple[Int[Tensor, "X"], Outcomes]:
        """The states that the model was queried for, in that order, and their outcomes, with states as children and in
        the memory of the table."""
        queried = self.queried
        # The inverse of `row_S`: the state of each row.
        state_X = torch.empty_like(queried)
        state_X[self.row_S[queried]] = queried
        return state_X, self.table.all(self.model.num_states)

    @torch.inference_mode(False)
    @torch.no_grad()
    def preload(self, state_N: Int[Tensor, "N"]) -> None:
        """Have the outcomes of these states ready, as after an earlier query; `model_calls` does not count them."""
        self._grow_tables()
        calls_before = self.model_calls
        if len(state_N):
            check_states(state_N, self.model.num_states)
            self._outcomes(state_N)
        self.model_calls = calls_before

    @torch.inference_mode(False)
    @torch.no_grad()
    def _start(self, root_B: Int[Tensor, "B"]) -> Levels:
        """Level 0: the distinct roots."""
        check_states(root_B, self.model.num_states)
        self._grow_tables()
        roots = self._distinct(root_B)
        return Levels([roots], self._position(roots)[root_B])

    @torch.inference_mode(False)
    @torch.no_grad()
    def _expand(self, levels: Levels) -> None:
        """One more level: query the model for the states of the last frontier that are new, and find their children."""
        frontier = levels.frontiers[-1]
        outcomes = self._outcomes(frontier)
        weighs_NAK = has_weight(outcomes)
        children = self._distinct(outcomes.child_NAK.masked_select(weighs_NAK))
        # Without new children all states met so far lead to each other: the closed set, in which `step` then points.
        new = self._missing(children, levels.closed_states)
        step = self._with_positions(outcomes, weighs_NAK, children if len(new) else levels.closed_states)
        # `levels` changes only after the last thing that may fail for want of memory.
        if len(new):
            levels.closed_states = torch.cat([levels.closed_states, new])
            levels.frontiers.append(children)
        elif len(levels.frontiers) == 1:  # the roots are closed by themselves
            levels.closed = step
        else:
            self._afford(levels.closed_states, levels, "the closed set")
            inside = self._outcomes(levels.closed_states)
            levels.closed = self._with_positions(inside, has_weight(inside), levels.closed_states)
        levels.outcomes.append(step)

    def _outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """Outcomes with states as children; the model is queried for new states only."""
        # Callers pass states without repetition, so that none is queried, or added to the table, twice.
        missing = state_N[self.row_S[state_N] < 0]
        if len(missing):
            answer = self.model.outcomes(missing)
            self.model_calls += len(missing) * self.model.num_actions
            # The model may have met new states; their ids are checked, and given room, before they are used.
            self._grow_tables()
            check_outcomes(self.model, missing, answer)
            self.row_S[missing] = self.table.append(answer)
        return self.table.rows(self.row_S[state_N], self.model.num_states)

    def _with_positions(
        self, outcomes: Outcomes, weighs_NAK: Bool[Tensor, "N A K"], states: Int[Tensor, "C"]
    ) -> Outcomes:
        """The same outcomes with children given by their position among `states`; those without weight get 0."""
        # Children without weight need not be among `states`: their position is stale, and replaced below.
        position_NAK = self._position(states)[outcomes.child_NAK]
        return Outcomes(
            outcomes.reward_NA,
            outcomes.prob_NAK,
            outcomes.discount_NAK,
            torch.where(weighs_NAK, position_NAK, 0),
            len(states),
        )

    def _distinct(self, state_N: Int[Tensor, "N"]) -> Int[Tensor, "distinct"]:
        """The states without repetition, ascending: one write and one read a state instead of sorting them all."""
        # Every state's entry says where it occurs, in the end at one place only: that occurrence stays.
        order_N = torch.arange(len(state_N), device=self.model.device)
        self._scratch_S[state_N] = order_N
        return state_N[self._scratch_S[state_N] == order_N].sort().values

    def _missing(self, state_N: Int[Tensor, "N"], among: Int[Tensor, "C"]) -> Int[Tensor, "missing"]:
        """Those of the states that are not `among` others."""
        # -1 stays where `among` writes no position.
        self._scratch_S[state_N] = -1
        return state_N[self._position(among)[state_N] < 0]

    def _position(self, states: Int[Tensor, "N"]) -> Int[Tensor, "S"]:
        """A table that holds, at each of `states`, its position among them, and elsewhere what it held before; valid
        until the next call."""
        self._scratch_S[states] = torch.arange(len(states), device=self.model.device)
        return self._scratch_S

    def _check_nodes(self, levels: Levels, level: int, expansions: int, max_nodes: int) -> int:
        """How many nodes there are on levels 0 to `level`.

        Raises:
            NodeBudgetExceeded: more than `max_nodes`; the message says how many there may be on all levels.
        """
        nodes = levels.nodes(level)
        if nodes <= max_nodes:
            return nodes
        size = f"the lookahead has {nodes} nodes on levels 0 to {level}; max_nodes is {max_nodes}"
        if level < expansions:
            # As many as if no two paths met below this level.
            last, children = len(levels.frontiers[level]), self.model.num_actions * self.num_outcomes
            most = nodes - last + tree_nodes(last, children, expansions - level)
            size += f", and levels 0 to {expansions} hold up to {most:.3g}"
        raise NodeBudgetExceeded(f"{size}: {_SMALLER}")

    def _afford(self, state_N: Int[Tensor, "N"], levels: Levels | None, which: str, *, kept: int = 0) -> None:
        """Make room for the outcomes of these states by dropping levels of other roots.

        Args:
            levels: those of the search under way, which stay.

        Raises:
            NodeBudgetExceeded: they would not fit all the same.
        """
        missing = int((self.row_S[state_N] < 0).sum())
        own = 0 if levels is None else levels.rows

        def needed() -> int:
            remembered = sum(each.rows for each in self._levels.values() if each is not levels)
            return self.bytes(missing, looked_up=len(state_N), kept=kept + own + remembered + len(state_N))

        # Levels of other roots only save time: they go first, the least recently used before the others.
        while needed() > self.max_bytes and any(each is not levels for each in self._levels.values()):
            self._levels.pop(next(key for key, each in self._levels.items() if each is not levels))
        check_memory(needed(), self.max_bytes, self._described(which, len(state_N)))
        if missing > 1 and self.table.count == 0 and self.model.num_outcomes is None:
            # Only the answer of the model tells K: one state is queried alone, and the memory counted once more.
            self._probe(state_N[:1])
            check_memory(needed(), self.max_bytes, self._described(which, len(state_N)))

    @torch.inference_mode(False)
    @torch.no_grad()
    def _probe(self, state_N: Int[Tensor, "1"]) -> None:
        self._outcomes(state_N)

    def _described(self, which: str, states: int) -> str:
        A, K = self.model.num_actions, self.num_outcomes
        return f"the outcomes of {which} of the lookahead ({states} nodes, {A} actions, {K} outcomes of each)"

    def bytes(self, new: int, *, looked_up: int = 0, kept: int = 0, **counts: int) -> int:
        """`search_bytes` of a search that queries the model for so many new states and looks up so many."""
        sizes = Sizes(self.model.num_actions, self.num_outcomes, self.model.dtype)
        states, remembered = max(self.model.num_states, len(self.row_S)), self.table.count + new
        if self.model.samples_outcomes:
            # Such a model keeps what it has sampled, and the bootstrap resamples a level as a whole.
            rows = [step.num_states for each in self._levels.values() for step in each.outcomes]
            counts |= {"sampled": remembered, "sampling": new, "resampled": max([looked_up, *rows])}
        return search_bytes(sizes, states=states, remembered=remembered, looked_up=looked_up, kept=kept, **counts)

    def _check_generation(self) -> None:
        if self.model.generation != self._generation:
            raise PgtsError("the model has been reset since this topology was made: make a new topology")

    def _grow_tables(self) -> None:
        """Room for the states that the model has met since, and for as many again: growing is rare."""
        room = len(self.row_S)
        if self.model.num_states > room:
            # At least doubled; -1 is a state that was not queried.
            missing = max(self.model.num_states, 2 * room) - room
            unknown = torch.full((missing,), -1, dtype=torch.int64, device=self.model.device)
            self.row_S = torch.cat([self.row_S, unknown])
            self._scratch_S = torch.cat([self._scratch_S, unknown])


def topology_of(model: EnumeratingModel, topology: Topology | None) -> Topology:
    """The topology that a caller gave, or a fresh one; PgtsError if it belongs to another model."""
    topology = topology or Topology(model)
    if topology.model is not model:
        raise PgtsError("the topology belongs to another model")
    return topology


_SMALLER = "set a smaller depth or max_width, fewer environments, or the search sampled with fewer samples"


def tree_nodes(roots: int, children: int, expansions: int) -> float:
    """Nodes of trees in which no two paths meet."""
    if children == 1:
        return roots * (expansions + 1.0)
    try:
        return roots * (float(children) ** (expansions + 1) - 1) / (children - 1)
    except OverflowError:
        return math.inf
