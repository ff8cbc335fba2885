"""Which states a lookahead meets at which level. Transitions do not depend on the policy, so this outlives a search."""

import functools
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Protocol, final

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.bellman import COMPILED_FROM, Outcomes
from pgts_torch.compiled import can_compile
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import EnumeratingModel
from pgts_torch.options.search import MAX_BYTES
from pgts_torch.readings import Readings
from pgts_torch.search.levels import Levels
from pgts_torch.search.lookahead import check_roots
from pgts_torch.search.memory import Sizes, check_memory, check_nodes, search_bytes, tree_nodes
from pgts_torch.search.outcome_table import OutcomeTable, has_weight
from pgts_torch.search.positions import Positions

_REMEMBERED_ROOTS = 8
"""How many different batches of roots keep their levels."""


class Kept(Protocol):
    """Something that takes memory between searches."""

    num_bytes: int


@final
class Topology:
    """What a model has answered so far: it is queried once for a (state, action), in however many searches that occurs.

    Keep one beside a model and hand it to every search: a search over known states makes no model calls, and a search
    from the same roots finds its levels ready, to any depth.

    table: the answers.
    forest: what the last tree search has left for the next one, if it is little.

    Args:
        max_bytes: the most memory that a search may take, with all that is remembered here (`memory.search_bytes`).
    """

    def __init__(self, model: EnumeratingModel, *, max_bytes: int = MAX_BYTES) -> None:
        self.model, self.max_bytes = model, max_bytes
        self.table = OutcomeTable(model)
        self._positions = Positions(model)
        self._generation = model.generation
        # By the roots; the least recently used first.
        self._levels: OrderedDict[Hashable, Levels] = OrderedDict()
        self.forest: Kept | None = None

    def fresh(self) -> "Topology":
        """An empty one of the same model and limits."""
        return Topology(self.model, max_bytes=self.max_bytes)

    def levels(
        self, root_B: Int[Tensor, "B"], expansions: int, *, max_nodes: int, readings: Readings | None = None
    ) -> Levels:
        """The levels below `root_B`, at least `expansions` of them or a closed set.

        Args:
            root_B: states of the model, in any order, repeated or not.
            max_nodes: the most nodes, summed over levels 0 .. expansions.
            readings: with them roots in the tensor of an earlier search are taken to be the same without being read,
                and the check of that waits.

        Raises:
            PgtsError: no roots, or one that is not a state of the model; the model has been reset since.
            NodeBudgetExceeded: the levels hold more nodes than that, or what follows them would take more memory than
                `max_bytes`; the model has not been queried for them.
        """
        self._check_generation()
        key = None if readings is None else self._recognised(root_B, readings)
        if key is None:
            key = root_B.dtype, root_B.shape, (root_B if root_B.is_cpu else root_B.cpu()).numpy().tobytes()
        levels = self._levels.get(key)
        if levels is None:
            levels = self._levels[key] = self._start(root_B)
            if len(self._levels) > _REMEMBERED_ROOTS:
                self._levels.popitem(last=False)
        levels.given_B = root_B
        self._levels.move_to_end(key)
        if levels.closed is None and len(levels.outcomes) < expansions:
            self._grow(levels, expansions, max_nodes)
        plan = levels.plans.get(expansions)
        if plan is None or plan.nodes > max_nodes:
            self._check_nodes(levels, expansions, expansions, max_nodes)
        return levels

    def _recognised(self, root_B: Int[Tensor, "B"], readings: Readings) -> Hashable | None:
        """The key of the levels whose roots were given in this tensor; None where there are none."""
        for key, levels in self._levels.items():
            if levels.given_B is root_B:
                differ = torch.ne(root_B, levels.of_roots(levels.frontiers[0])).any()
                readings.check(differ, _refuse_roots, is_good=lambda number: number == 0)
                return key
        return None

    # What these methods make outlives the call: ordinary tensors, also where the caller is in inference mode.
    @torch.inference_mode(False)
    @torch.no_grad()
    def _start(self, root_B: Int[Tensor, "B"]) -> Levels:
        check_roots(root_B, self.model.num_states)
        roots = self._positions.distinct(root_B)
        return Levels([roots], self._positions.of(roots)[root_B])

    @torch.inference_mode(False)
    @torch.no_grad()
    def _grow(self, levels: Levels, expansions: int, max_nodes: int) -> None:
        # Level by level: the nodes are counted, and their memory is found, before the model is queried.
        while levels.closed is None and len(levels.outcomes) < expansions:
            self._check_nodes(levels, len(levels.outcomes), expansions, max_nodes)
            self._afford(levels.frontiers[-1], levels, f"level {len(levels.outcomes)} of the {expansions}")
            self._expand(levels)

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
        self._afford(state_N, None, "one level", kept=kept)
        outcomes, weighs_NAK, children = self._answers(state_N)
        return self._with_positions(outcomes, weighs_NAK, children), children

    @torch.inference_mode(False)
    @torch.no_grad()
    def query(self, state_N: Int[Tensor, "N"]) -> None:
        """Have rows of these distinct states in the table; raises as `step` does."""
        self._check_generation()
        self._afford(state_N, None, "one level")
        self.table.query(state_N)

    @torch.inference_mode(False)
    @torch.no_grad()
    def preload(self, state_N: Int[Tensor, "N"]) -> None:
        """Have the outcomes of these states ready, as after an earlier query that does not count as a model call."""
        calls_before = self.table.model_calls
        if len(state_N):
            check_roots(state_N, self.model.num_states)
            self.table.query(state_N)
        self.table.model_calls = calls_before

    def bytes(self, new: int, *, looked_up: int = 0, kept: int = 0, **counts: int) -> int:
        """`search_bytes` of a search that queries the model for so many new states and looks up so many."""
        sizes = _sizes(self.model.num_actions, self._num_outcomes, self.model.dtype)
        states, remembered = max(self.model.num_states, len(self.table.row_S)), self.table.count + new
        if self.model.samples_outcomes:
            # Such a model keeps what it has sampled, and the bootstrap resamples a level as a whole.
            rows = [step.num_states for each in self._levels.values() for step in each.outcomes]
            counts |= {"sampled": remembered, "sampling": new, "resampled": max([looked_up, *rows])}
        left = 0 if self.forest is None else self.forest.num_bytes
        return left + search_bytes(
            sizes, states=states, remembered=remembered, looked_up=looked_up, kept=kept, **counts
        )

    def _expand(self, levels: Levels) -> None:
        """One more level: query the model for the states of the last frontier that are new, and find their children."""
        children, with_positions = self._children(levels.frontiers[-1])
        # Without new children all states met so far lead to each other: the closed set, in which `step` then points.
        new = self._positions.missing(children, levels.closed_states)
        step = with_positions(children if len(new) else levels.closed_states)
        # `levels` changes only after the last thing that may fail for want of memory.
        if len(new):
            levels.closed_states = torch.cat([levels.closed_states, new])
            levels.frontiers.append(children)
        elif len(levels.frontiers) == 1:  # the roots are closed by themselves
            levels.closed = step
        else:
            self._afford(levels.closed_states, levels, "the closed set", kept=step.num_states)
            _, with_positions = self._children(levels.closed_states)
            levels.closed = with_positions(levels.closed_states)
        levels.outcomes.append(step)

    def _children(
        self, state_N: Int[Tensor, "N"]
    ) -> tuple[Int[Tensor, "children"], Callable[[Int[Tensor, "C"]], Outcomes]]:
        """The distinct children of these states, ascending; and the outcomes with positions among the states C."""
        table = self._own_table
        if table is not None:
            self.table.read(state_N)
            return _children_in(table, state_N), lambda states: self._gathered(table, state_N, states)
        outcomes, weighs_NAK, children = self._answers(state_N)
        return children, lambda states: self._with_positions(outcomes, weighs_NAK, states)

    def _answers(self, state_N: Int[Tensor, "N"]) -> tuple[Outcomes, Bool[Tensor, "N A K"], Int[Tensor, "children"]]:
        """A copy of the outcomes, which of them have weight, and their distinct children, ascending."""
        outcomes = self.table.outcomes(state_N)
        # Children are those of outcomes with weight: nothing below the others can change a value.
        weighs_NAK = has_weight(outcomes)
        return outcomes, weighs_NAK, self._positions.distinct(outcomes.child_NAK.masked_select(weighs_NAK))

    @property
    def _own_table(self) -> Outcomes | None:
        """The table of the model, where its levels are found by compiled loops."""
        table = self.model.table
        compiles = table is not None and table.child_NAK.numel() >= COMPILED_FROM and can_compile(table.device)
        return table if compiles else None

    def _gathered(self, table: Outcomes, state_N: Int[Tensor, "N"], states: Int[Tensor, "C"]) -> Outcomes:
        """Rows of the table with children given by their position among `states`, as small as they can be: p gamma
        stands for p and 1 for gamma, and the sparse weight is in the same memory."""
        from pgts_torch.search import level_kernels

        N, A, K = len(state_N), table.num_actions, table.num_outcomes
        index = table.weight.col_indices().dtype
        reward_NA = torch.empty(N, A, dtype=table.dtype)
        weight, child = torch.empty(N * A * K, dtype=table.dtype), torch.empty(N * A * K, dtype=index)
        to = reward_NA.view(-1), weight, child
        place_S = self._positions.of(states)
        level_kernels.gather(state_N.numpy(), *table.arrays, place_S.numpy(), *(x.numpy() for x in to))
        return Outcomes.of_rows(reward_NA, weight, child, K, len(states))

    def _with_positions(
        self, outcomes: Outcomes, weighs_NAK: Bool[Tensor, "N A K"], states: Int[Tensor, "C"]
    ) -> Outcomes:
        """The same outcomes with children given by their position among `states`; those without weight get 0."""
        # Children without weight need not be among `states`: the number read for them is replaced.
        position_NAK = self._positions.of(states)[outcomes.child_NAK]
        return replace(outcomes, child_NAK=torch.where(weighs_NAK, position_NAK, 0), num_children=len(states))

    def _check_nodes(self, levels: Levels, level: int, expansions: int, max_nodes: int) -> None:
        """NodeBudgetExceeded if levels 0 to `level` hold too many nodes; it says how many all levels may hold."""
        nodes, more = levels.nodes(level), ""
        if level < expansions and nodes > max_nodes:
            # As many as if no two paths met below this level.
            last, children = len(levels.frontiers[level]), self.model.num_actions * self._num_outcomes
            most = nodes - last + tree_nodes(last, children, expansions - level)
            more = f", and levels 0 to {expansions} hold up to {most:.3g}"
        check_nodes(nodes, max_nodes, f" on levels 0 to {level}", more)

    def _afford(self, state_N: Int[Tensor, "N"], levels: Levels | None, which: str, *, kept: int = 0) -> None:
        """Make room for the outcomes of these states by dropping levels of other roots.

        Args:
            levels: those of the search under way, which stay.

        Raises:
            NodeBudgetExceeded: they would not fit all the same.
        """
        reads_table = levels is not None and self._own_table is not None
        missing, looked_up = 0 if reads_table else len(self.table.missing(state_N)), len(state_N)
        own = 0 if levels is None else levels.rows

        def needed() -> int:
            others = sum(each.rows for each in self._levels.values() if each is not levels)
            if reads_table:
                return self.bytes(0, gathered=kept + own + others + looked_up, gathering=looked_up)
            return self.bytes(missing, looked_up=looked_up, kept=kept + own + others + looked_up)

        def check(num_bytes: int) -> None:
            size = f"{looked_up} nodes, {self.model.num_actions} actions, {self._num_outcomes} outcomes of each"
            check_memory(num_bytes, self.max_bytes, f"the outcomes of {which} of the lookahead ({size})")

        if (num_bytes := needed()) > self.max_bytes:
            # Levels of other roots only save time: they go first, the least recently used before the others.
            self.forest = None
            spare = [key for key, each in self._levels.items() if each is not levels]
            while (num_bytes := needed()) > self.max_bytes and spare:
                self._levels.pop(spare.pop(0))
        check(num_bytes)
        if missing > 1 and self.table.count == 0 and self.model.num_outcomes is None:
            # Only the answer of the model tells K: one state is queried alone, and the memory counted once more.
            self.table.query(state_N[:1])
            check(needed())

    @property
    def _num_outcomes(self) -> int:
        """K, as far as it is known by now."""
        return max(self.model.num_outcomes or 1, self.table.num_outcomes)

    def _check_generation(self) -> None:
        if self.model.generation != self._generation:
            raise PgtsError("the model has been reset since this topology was made: make a new topology")


_sizes = functools.lru_cache(maxsize=64)(Sizes)


def _children_in(table: Outcomes, state_N: Int[Tensor, "N"]) -> Int[Tensor, "children"]:
    """The distinct children of states of the table, ascending."""
    from pgts_torch.search import level_kernels

    met_S = torch.zeros(table.num_children, dtype=torch.bool)
    # Few are sorted; many are read from their marks.
    found = torch.empty(
        min(len(state_N) * table.num_actions * table.num_outcomes, len(met_S) // 32 + 1), dtype=torch.int64
    )
    count = level_kernels.children(state_N.numpy(), *table.arrays, met_S.numpy(), found.numpy())
    return found[:count].sort().values if count <= len(found) else torch.nonzero(met_S).flatten()


def _refuse_roots(_: float) -> None:
    raise PgtsError("the tensor of the roots has been written to since an earlier search: give each search its own")


def topology_of(model: EnumeratingModel, topology: Topology | None) -> Topology:
    """The topology that a caller gave, or a fresh one; PgtsError if it belongs to another model."""
    topology = topology or Topology(model)
    if topology.model is not model:
        raise PgtsError("the topology belongs to another model")
    return topology
