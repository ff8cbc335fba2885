"""What compiled loops know of states and nodes, as records."""

from typing import Any

import numpy as np

NEW, WANTED = -1, -2
"""The `row` of a state that no tree has reached, and of one that is to be made known."""

TOO_MANY, FULL, UNKNOWN, NOT_FINITE = -1, -2, -3, -4
"""What the loops return: there are more nodes than are allowed, or than there is room for; a state is unknown (in a
graph); one of the critic's values is not finite."""

STATE = np.dtype([("v", "f8"), ("row", "i8")])
"""v: the critic's value; NaN where it is not known, infinite where the critic is to be called.
row: of the prior, where the outcomes of the state and the values of its children are known too."""

NODE = np.dtype(
    [("v", "f8"), ("row", "i8"), ("place", "i8")] + [(x, "i4") for x in ("level", "open", "parent", "action", "k")]
)
"""v, place: in a graph, the largest q, and where the node is in `node_at`.   row: in the table of outcomes.   open: how
many actions are.   parent, action, k: in a tree, the edge that leads to the node; the parent of a root is -1. In a
graph the parent is what `node_at` said before."""

ARM = np.dtype([("q", "f8"), ("reward", "f8"), ("prior", "f8"), ("visits", "i4"), ("open", "i4")])
"""A node and an action.   open: how many outcomes have something below that is to be expanded."""

EDGE = np.dtype([("value", "f8"), ("weight", "f8"), ("prob", "f8"), ("below", "i4"), ("visits", "i4")])
"""A node, an action and an outcome.   value: what q is backed up from.   weight: p gamma, 0 for an outcome that does
not count.   prob: -1 where nothing below is to be expanded.   below: the child."""

SLOT = np.dtype(
    [(name, "i8") for name in ("root", "nodes", "used", "phase", "width", "phases", "waves", "ranked", "waiting")]
)
"""root: -1 where the slot is empty.   nodes: of a tree.   used: simulations.   phase, width, phases, waves: of
sequential halving, its round, how many actions it has, how many rounds there are, and simulations of each action are
left.   ranked: `width` when the actions were
last ranked.   waiting: simulations that are under way."""

LANE = np.dtype([(name, "i8") for name in ("survives", "first", "node", "action", "k")])
"""One for each slot and action. survives: whether the action is left in sequential halving.   first: the action of the
root that one of the simulations under way has taken.   node, action, k: the edge where it has ended."""

STEP = np.dtype([(name, "i8") for name in ("node", "action", "k")])
"""The edge that a simulation takes, one for each level of a graph."""


def as_bytes(x: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The same memory, for copies: numpy copies records field by field, which takes a hundred times as long."""
    return x.view(np.uint8)
