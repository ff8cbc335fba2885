"""How much memory and how many nodes a search takes, counted and limited in one place."""

import functools
import math
from dataclasses import dataclass

import torch

from pgts_torch.errors import MemoryBudgetExceeded, NodeBudgetExceeded

GROWTH = 1.5
"""By how much a table that is full becomes longer."""

RESAMPLED = 96
"""Bytes of a resampled outcome, with all that is made on the way."""


@dataclass(frozen=True)
class Sizes:
    """What one state, or one node, takes: A actions with K outcomes each, numbers in `dtype`.

    outcomes: a row of `Outcomes`, or of the `OutcomeTable`.
    """

    num_actions: int
    num_outcomes: int
    dtype: torch.dtype

    @property
    def outcomes(self) -> int:
        s, A, E = self._parts
        return A * s + E * (2 * s + 8)

    @property
    def known(self) -> int:
        """The row of `KnownStates`."""
        s, A, E = self._parts
        return 2 * s + 16 + A * (4 * s + 8) + E * 2 * s

    @property
    def node(self) -> int:
        """The row of `Nodes`."""
        s, A, E = self._parts
        return 2 * s + 24 + A * (2 * s + 8) + E * (2 * s + 16)

    @property
    def grown(self) -> int:
        """A node of the trees of `Forest`."""
        _, A, E = self._parts
        return 44 + 32 * A + 32 * E

    @property
    def fixed(self) -> int:
        """A node, or a state, of `FixedTrees`."""
        _, A, E = self._parts
        return 16 + 40 * A + 40 * E

    @property
    def _parts(self) -> tuple[int, int, int]:
        return self.dtype.itemsize, self.num_actions, self.num_actions * self.num_outcomes


@functools.lru_cache(maxsize=256)
def search_bytes(
    sizes: Sizes,
    *,
    states: int = 0,
    remembered: int = 0,
    looked_up: int = 0,
    kept: int = 0,
    gathered: int = 0,
    gathering: int = 0,
    sampled: int = 0,
    sampling: int = 0,
    resampled: int = 0,
    learned: int = 0,
    nodes: int = 0,
    grown: int = 0,
    fixed: int = 0,
    places: int = 0,
    arms: int = 0,
) -> int:
    """The most memory, in bytes, that a search holds at once while it takes its next step.

    Tables that grow are at worst longer than needed by the factor `GROWTH`, and while a column is copied its old form
    is there too. What a step makes and drops again (masks, positions, sorted children, products) is counted at its
    peak.

    Args:
        states: of the model, for which a topology has two tables.
        remembered: rows of the `OutcomeTable`, after the step.
        looked_up: states whose outcomes the step reads, new or not.
        kept: rows of outcomes of levels, with their sparse weights, after the step.
        gathered: rows of levels read from the model's own table, after the step.   gathering: those of the step.
        sampled: nodes whose outcomes were sampled, after the step.   sampling: those that the step samples.
        resampled: nodes that the bootstrap samples again at once.
        learned: rows of `KnownStates`.
        nodes: rows of `Nodes`.   grown: nodes for which a `Forest` has room.   fixed: nodes, states and lanes of
            `FixedTrees`.
        places: of tables by level, by state and by both.   arms: that a wave passes at once.
    """
    s, A, E = sizes.dtype.itemsize, sizes.num_actions, sizes.num_actions * sizes.num_outcomes
    widest = max(s, 8) * E
    total = 32.0 * states  # two tables of int64, twice while they grow
    total += remembered * (GROWTH * sizes.outcomes + widest)
    total += looked_up * (sizes.outcomes + 56 * E + 4 * A * s + 64)
    total += kept * (sizes.outcomes + E * (s + 4) + A * (2 * s + 4) + 24)
    if gathered:
        # The sparse weights of the whole table, marks of what was met, and a list of some of that, sorted.
        total += states * (E * (s + 4) + 8 * A + 1 + 1)
        total += gathered * (A * (2 * s + 4) + E * (s + 4) + 2 * s + 24) + gathering * 8 * A
        total += min(states, gathering * E) * (3 * s + 48)  # children: states, positions, what is new, values
    total += sampled * (2 * (s + 16) * E + 48) + sampling * 64 * E + resampled * RESAMPLED * E
    total += learned * (GROWTH * sizes.known + widest)
    total += nodes * (GROWTH * sizes.node + widest + E * (4 * s + 16) + 40 * A)
    total += 2 * grown * sizes.grown  # twice, as outcomes of an action may become more
    total += fixed * (2 * sizes.fixed + 32 * E)
    total += 8.0 * places
    total += arms * (96 * sizes.num_outcomes + 160)
    return int(total)


_SMALLER = "set a smaller depth or max_width, fewer simulations, samples or environments, or a larger"


def check_memory(needed: int, most: int, what: str) -> None:
    """MemoryBudgetExceeded if a search would take more than that."""
    if needed > most:
        size, limit = (f"{num_bytes / 2**30:.3g} GiB" for num_bytes in (needed, most))
        raise MemoryBudgetExceeded(f"{what} would take up to {size}; the limit is {limit}: {_SMALLER} max_bytes")


def check_nodes(nodes: int, most: int, where: str = "", more: str = "") -> None:
    """NodeBudgetExceeded if a search has more nodes than that.

    Args:
        where: on which levels they are.
        more: how many there may be on others.
    """
    if nodes > most:
        raise NodeBudgetExceeded(
            f"the lookahead has {nodes} nodes{where}; max_nodes is {most}{more}: {_SMALLER} max_nodes"
        )


def tree_nodes(roots: int, children: int, expansions: int) -> float:
    """Nodes of trees in which no two paths meet."""
    if children == 1:
        return roots * (expansions + 1.0)
    try:
        return roots * (float(children) ** (expansions + 1) - 1) / (children - 1)
    except OverflowError:
        return math.inf
