"""Which states a lookahead meets at which level. Transitions do not depend on the policy: this outlives a call."""

import math
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import final

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import NodeBudgetExceeded, NotFinite, PgtsError
from pgts_torch.models.base import EnumeratingModel, Model
from pgts_torch.search.lookahead import MAX_BYTES, check_states, check_vector
from pgts_torch.search.memory import GROWTH, Sizes, check_memory, search_bytes

_REMEMBERED_ROOTS = 8
"""How many different batches of roots keep their levels."""

_TOLERANCE = 1e-4
"""By how much the probabilities of a model may miss 1: enough for many of them in float32."""


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

    @property
    def rows(self) -> int:
        """How many rows of outcomes are kept."""
        closed = 0 if self.closed is None else self.closed.num_states
        return closed + sum(outcomes.num_states for outcomes in self.outcomes)

    def sweeps(self, expansions: int) -> int:
        """How many of `expansions` levels, counted from the leaves, are the closed set."""
        return max(0, expansions - len(self.outcomes))

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


class _Rows:
    """Outcomes to which rows are added. Room doubles when it is full: a row costs the same however many there are."""

    def __init__(self) -> None:
        self._table: Outcomes | None = None
        self.count = 0

    @property
    def num_outcomes(self) -> int:
        """The largest K so far; 1 where nothing was added."""
        return 1 if self._table is None else self._table.num_outcomes

    def rows(self, row_N: Int[Tensor, "N"]) -> Outcomes:
        """Some of the rows that were added, in the order asked for."""
        assert self._table is not None
        return self._table.rows(row_N)

    def all(self) -> Outcomes:
        """All rows, in the memory where they lie."""
        assert self._table is not None
        table, n = self._table, self.count
        return Outcomes(
            table.reward_NA[:n], table.prob_NAK[:n], table.discount_NAK[:n], table.child_NAK[:n], table.num_children
        )

    def append(self, more: Outcomes) -> Int[Tensor, "N"]:
        """Add copies of these rows, padded to the largest K so far, and say where they are."""
        first, last = self.count, self.count + more.num_states
        row_N = torch.arange(first, last, device=more.device)
        columns = [*_tensors(self._table or more.rows(row_N[:0]))]
        room, K = len(columns[0]), max(columns[1].shape[-1], more.num_outcomes)
        room = room if last <= room else max(last, int(GROWTH * room))
        self._table = None
        for i, given in enumerate(_tensors(more)):  # one after the other, so that only one is there twice
            columns[i] = _padded(columns[i], room, K)
            columns[i][first:last, ..., : given.shape[-1]] = given
        reward_NA, prob_NAK, discount_NAK, child_NAK = columns
        self._table = Outcomes(reward_NA, prob_NAK, discount_NAK, child_NAK, more.num_children)
        self.count = last
        return row_N


def _padded(x: Tensor, N: int, K: int) -> Tensor:
    """The same column with room for N states, and for K outcomes if it is one of outcomes."""
    by_outcome = x.ndim == 3
    if len(x) == N and (not by_outcome or x.shape[-1] == K):
        return x
    more = (0, K - x.shape[-1], 0, 0, 0, N - len(x)) if by_outcome else (0, 0, 0, N - len(x))
    return torch.nn.functional.pad(x, more)


def _tensors(outcomes: Outcomes) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return outcomes.reward_NA, outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK


@final
class Topology:
    """What has been asked of a model so far: each (state, action) is asked once, in however many searches it occurs.

    Keep one beside a model and hand it to every search: a search over known states asks the model nothing, and a search
    over the same roots finds its levels ready, to any depth.

    Args:
        model: the model that answers.
        max_bytes: the most memory that a search may take, with all that is remembered here (`memory.search_bytes`).
    """

    def __init__(self, model: EnumeratingModel, *, max_bytes: int = MAX_BYTES) -> None:
        self.model, self.max_bytes = model, max_bytes
        self.model_calls = 0
        self._generation = model.generation
        self._known = _Rows()
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
            PgtsError: no roots, or one that is not a state of the model; the model has forgotten its states since.
            NodeBudgetExceeded: the levels hold more nodes than that, or what follows them would take more memory than
                `max_bytes`; the model has not been asked about them.
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
        while levels.closed is None and len(levels.outcomes) < expansions:
            self._check_nodes(levels, len(levels.outcomes), expansions, max_nodes)
            self._afford(levels.frontiers[-1], levels, f"level {len(levels.outcomes)} of the {expansions}")
            self._expand(levels)
        self._check_nodes(levels, expansions, expansions, max_nodes)
        return levels

    # What these make outlives the call: it must be ordinary tensors even if the caller is in inference mode.
    @torch.inference_mode(False)
    @torch.no_grad()
    def step(self, state_N: Int[Tensor, "N"], *, kept: int = 0, beside: int = 0) -> tuple[Outcomes, Int[Tensor, "C"]]:
        """What follows these states, in terms of positions among their distinct children; and these, ascending.

        Nothing but the answers of the model is remembered. Where every outcome ends there are no children, and the
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
        counts_NAK = counting(outcomes)
        children = self._distinct(outcomes.child_NAK.masked_select(counts_NAK))
        return self._renumbered(outcomes, counts_NAK, children), children

    def fresh(self) -> "Topology":
        """An empty one of the same model and limits."""
        return Topology(self.model, max_bytes=self.max_bytes)

    @property
    def num_outcomes(self) -> int:
        """K, as far as it is known by now."""
        return max(self.model.num_outcomes or 1, self._known.num_outcomes)

    @property
    def queried(self) -> Int[Tensor, "N"]:
        """The states that the model has been asked about, ascending."""
        return torch.nonzero(self._row_S >= 0).flatten()

    @property
    def num_expanded(self) -> int:
        """How many states these are."""
        return self._known.count

    def expanded(self) -> tuple[Int[Tensor, "X"], Outcomes]:
        """The states that the model has been asked about, in the order of asking, and what follows them, in terms of
        states and in the memory where it lies."""
        queried = self.queried
        state_X = torch.empty_like(queried)
        state_X[self._row_S[queried]] = queried
        return state_X, replace(self._known.all(), num_children=self.model.num_states)

    @torch.inference_mode(False)
    @torch.no_grad()
    def preload(self, state_N: Int[Tensor, "N"]) -> None:
        """Have the outcomes of these states ready, as if they had been asked about before; `model_calls` does not
        count them."""
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
        """One more level: ask about the states of the last frontier that are new, and find their children."""
        frontier = levels.frontiers[-1]
        outcomes = self._outcomes(frontier)
        counts_NAK = counting(outcomes)
        children = self._distinct(outcomes.child_NAK.masked_select(counts_NAK))
        new = self._missing(children, levels.closed_states)
        step = self._renumbered(outcomes, counts_NAK, children if len(new) else levels.closed_states)
        # Nothing is changed before the last thing that may fail for want of memory.
        if len(new):
            levels.closed_states = torch.cat([levels.closed_states, new])
            levels.frontiers.append(children)
        elif len(levels.frontiers) == 1:  # the roots are closed by themselves
            levels.closed = step
        else:
            self._afford(levels.closed_states, levels, "the closed set")
            inside = self._outcomes(levels.closed_states)
            levels.closed = self._renumbered(inside, counting(inside), levels.closed_states)
        levels.outcomes.append(step)

    def _outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """Outcomes in terms of states; the model is asked about those only that it has never been asked about."""
        missing = state_N[self._row_S[state_N] < 0]
        if len(missing):
            answer = self.model.outcomes(missing)
            self.model_calls += len(missing) * self.model.num_actions
            self._grow_tables()
            check_answer(self.model, missing, answer)
            self._row_S[missing] = self._known.append(answer)
        return self._known.rows(self._row_S[state_N])

    def _renumbered(self, outcomes: Outcomes, counts_NAK: Bool[Tensor, "N A K"], states: Int[Tensor, "C"]) -> Outcomes:
        """The same outcomes with children given by their position among `states`; those that do not count get 0."""
        position_NAK = self._position(states)[outcomes.child_NAK]
        return Outcomes(
            outcomes.reward_NA,
            outcomes.prob_NAK,
            outcomes.discount_NAK,
            torch.where(counts_NAK, position_NAK, 0),
            len(states),
        )

    def _distinct(self, state_N: Int[Tensor, "N"]) -> Int[Tensor, "distinct"]:
        """The states without repetition, ascending: one write and one read a state instead of sorting them all."""
        order_N = torch.arange(len(state_N), device=self.model.device)
        self._scratch_S[state_N] = order_N
        return state_N[self._scratch_S[state_N] == order_N].sort().values

    def _missing(self, state_N: Int[Tensor, "N"], among: Int[Tensor, "C"]) -> Int[Tensor, "missing"]:
        """Those of the states that are not `among` others."""
        self._scratch_S[state_N] = -1
        return state_N[self._position(among)[state_N] < 0]

    def _position(self, states: Int[Tensor, "N"]) -> Int[Tensor, "S"]:
        """A table that holds, at each of `states`, its position among them, and elsewhere what it held before; valid
        until the next call."""
        self._scratch_S[states] = torch.arange(len(states), device=self.model.device)
        return self._scratch_S

    def _check_nodes(self, levels: Levels, level: int, expansions: int, max_nodes: int) -> int:
        """How many nodes there are on levels 0 to `level`; NodeBudgetExceeded, saying how many there may be on all of
        them, if these are more than `max_nodes`."""
        nodes = levels.nodes(level)
        if nodes <= max_nodes:
            return nodes
        size = f"the lookahead has {nodes} nodes on levels 0 to {level}; max_nodes is {max_nodes}"
        if level < expansions:
            last, children = len(levels.frontiers[level]), self.model.num_actions * self.num_outcomes
            most = nodes - last + tree_nodes(last, children, expansions - level)
            size += f", and levels 0 to {expansions} hold up to {most:.3g}"
        raise NodeBudgetExceeded(f"{size}: {_SMALLER}")

    def _afford(self, state_N: Int[Tensor, "N"], levels: Levels | None, which: str, *, kept: int = 0) -> None:
        """NodeBudgetExceeded if what follows these states would not fit. Levels of other roots make room before."""
        missing = int((self._row_S[state_N] < 0).sum())
        own = 0 if levels is None else levels.rows

        def needed() -> int:
            remembered = sum(each.rows for each in self._levels.values() if each is not levels)
            return self.bytes(missing, asked=len(state_N), kept=kept + own + remembered + len(state_N))

        while needed() > self.max_bytes and any(each is not levels for each in self._levels.values()):
            self._levels.pop(next(key for key, each in self._levels.items() if each is not levels))
        check_memory(needed(), self.max_bytes, self._told(which, len(state_N)))
        if missing > 1 and self._known.count == 0 and self.model.num_outcomes is None:
            self._probe(state_N[:1])  # one alone, to learn K
            check_memory(needed(), self.max_bytes, self._told(which, len(state_N)))

    @torch.inference_mode(False)
    @torch.no_grad()
    def _probe(self, state_N: Int[Tensor, "1"]) -> None:
        self._outcomes(state_N)

    def _told(self, which: str, states: int) -> str:
        A, K = self.model.num_actions, self.num_outcomes
        return f"the outcomes of {which} of the lookahead ({states} nodes, {A} actions, {K} outcomes of each)"

    def bytes(self, new: int, *, asked: int = 0, kept: int = 0, **counts: int) -> int:
        """`search_bytes` of a search that asks about so many new states and looks up so many."""
        sizes = Sizes(self.model.num_actions, self.num_outcomes, self.model.dtype)
        numbered, answered = max(self.model.num_states, len(self._row_S)), self._known.count + new
        if self.model.draws:
            rows = [step.num_states for each in self._levels.values() for step in each.outcomes]
            counts |= {"drawn": answered, "drawing": new, "resampled": max([asked, *rows])}
        return search_bytes(sizes, numbered=numbered, answered=answered, asked=asked, kept=kept, **counts)

    def _check_generation(self) -> None:
        if self.model.generation != self._generation:
            raise PgtsError("the model has forgotten its states since this topology was made: make a new topology")

    def _grow_tables(self) -> None:
        """Room for the states that the model has numbered since, and for as many again: growing is rare."""
        room = len(self._row_S)
        if self.model.num_states > room:
            missing = max(self.model.num_states, 2 * room) - room
            unknown = torch.full((missing,), -1, dtype=torch.int64, device=self.model.device)
            self._row_S = torch.cat([self._row_S, unknown])
            self._scratch_S = torch.cat([self._scratch_S, unknown])


def topology_of(model: EnumeratingModel, topology: Topology | None) -> Topology:
    """The topology that a caller gave, or a fresh one; PgtsError if it belongs to another model."""
    topology = topology or Topology(model)
    if topology.model is not model:
        raise PgtsError("the topology belongs to another model")
    return topology


def counting(outcomes: Outcomes) -> Bool[Tensor, "N A K"]:
    """Where an outcome has weight. A terminal outcome, an action that is not allowed and padding have none, and what
    follows them needs no node."""
    allowed_NA1 = outcomes.reward_NA.unsqueeze(-1) > -torch.inf
    return (outcomes.prob_NAK > 0) & (outcomes.discount_NAK > 0) & allowed_NA1


def check_answer(model: Model, state_N: Int[Tensor, "N"], answer: Outcomes) -> None:
    """PgtsError, naming the state, unless these may be the outcomes of so many states of the model."""
    asked, given = (len(state_N), model.num_actions), tuple(answer.reward_NA.shape)
    if given != asked:
        raise PgtsError(f"the model answered for {given} states and actions; it was asked for {asked}")
    for name, x in (("reward", answer.reward_NA), ("prob", answer.prob_NAK), ("discount", answer.discount_NAK)):
        if x.dtype != model.dtype:
            raise PgtsError(f"the model's {name} is {x.dtype}; its dtype is {model.dtype}")
    best_N = answer.reward_NA.amax(-1)
    if not bool(best_N.isfinite().all()):
        n = int(torch.nonzero(~best_N.isfinite())[0, 0])
        raise NotFinite(
            f"the model's rewards in state {int(state_N[n])} are {answer.reward_NA[n].tolist()}; they must be "
            "numbers, or -inf where an action is not allowed, and one action must be",
            what="reward",
        )
    total_NA = torch.where(answer.reward_NA > -torch.inf, answer.prob_NAK.sum(-1), 1.0)
    fair_NA = (total_NA - 1).abs() <= _TOLERANCE
    if not bool(fair_NA.all()):
        n, a = torch.nonzero(~fair_NA)[0].tolist()
        raise PgtsError(
            f"the model's probabilities of what follows state {int(state_N[n])} and action {a} sum to "
            f"{float(total_NA[n, a])}"
        )
    most = 1 + _TOLERANCE
    for name, x_NAK, highest in (("probability", answer.prob_NAK, most), ("discount", answer.discount_NAK, 1.0)):
        off_NAK = ~((x_NAK >= 0) & (x_NAK <= highest))
        if bool(off_NAK.any()):
            n, a, k = torch.nonzero(off_NAK)[0].tolist()
            raise PgtsError(
                f"the model's {name} of outcome {k} of state {int(state_N[n])} and action {a} is "
                f"{float(x_NAK[n, a, k])}; it must be in [0, 1]"
            )
    child_NAK = answer.child_NAK
    off_NAK = (child_NAK < 0) | (child_NAK >= model.num_states)
    if off_NAK.any():
        n, a, k = torch.nonzero(off_NAK)[0].tolist()
        raise PgtsError(
            f"the model leads from state {int(state_N[n])} by action {a} to {int(child_NAK[n, a, k])}; "
            f"states are 0 to {model.num_states - 1}"
        )


_SMALLER = "set a smaller depth or max_width, fewer environments, or the search sampled with fewer samples"


def tree_nodes(roots: int, children: int, expansions: int) -> float:
    """Nodes of trees in which no two paths meet."""
    if children == 1:
        return roots * (expansions + 1.0)
    try:
        return roots * (float(children) ** (expansions + 1) - 1) / (children - 1)
    except OverflowError:
        return math.inf
