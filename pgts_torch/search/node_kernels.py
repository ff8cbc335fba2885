"""What compiled tree searches do at one node, and at a root: for trees (`tree_kernels`) and graphs (`graph_kernels`).

Arrays are passed one by one, because numba counts references to those that are taken from a tuple, at each access.
"""

import math
from typing import NamedTuple

import numpy as np

from pgts_torch.compiled import inlined

GUMBEL, PUCT, UCT = 0, 1, 2
"""The rules of `Selection`."""

_GRID = 2.0**20
_TIE = 1e-8
_TINY = float(np.finfo(np.float64).tiny)
_VISITS, _SCALE = 50.0, 0.1
"""As in `split`."""


class Rules(NamedTuple):
    """The options, as numbers. A node at level `bottom` is never expanded; `halves`: sequential halving at the root.
    `room`: nodes of a tree.   `uniform`: all states have one prior."""

    room: int
    bottom: int
    simulations: int
    halves: bool
    rule: int
    exploration: float
    mean: bool
    uniform: bool
    max_nodes: int


@inlined
def expand(reward, prob, discount, child, table_row, state, prior, node, arm, edge, rules, n, s, level):  # type: ignore[no-untyped-def]
    """Make n a node of state s, which begins with the critic's values of its children; its prior is that of the actions
    that are allowed. Return v, and how many outcomes have weight."""
    r = table_row[s]
    A, K = edge.shape[1:]
    # Below the last level nothing is expanded; only averages go there, to take its values again.
    is_last = level + 1 == rules.bottom and (level == 0 or not rules.mean)
    v, num_open, total, share, num_allowed = -np.inf, 0, 0, 0.0, 0
    for a in range(A):
        q, width, is_allowed = 0.0, 0, reward[r, a] > -np.inf
        for k in range(K):
            p, gamma, e = prob[r, a, k], discount[r, a, k], edge[n, a, k]
            if is_allowed and p > 0 and gamma > 0:
                e.value, e.weight, e.prob = state[child[r, a, k]].v, p * gamma, -1.0 if is_last else p
                q += e.weight * e.value
                width += 1
            else:
                e.value, e.weight, e.prob = 0.0, 0.0, -1.0
            e.below = e.visits = 0
        x = arm[n, a]
        x.q, x.reward, x.prior = q + reward[r, a], reward[r, a], prior[state[s].row, a] if is_allowed else 0.0
        share += x.prior
        num_allowed += is_allowed
        x.visits, x.open = 0, 0 if is_last else width
        num_open += x.open > 0
        total += width
        v = max(v, x.q)
    if num_allowed < A:
        for a in range(A):
            arm[n, a].prior /= share
    node[n].row, node[n].level, node[n].open = r, level, num_open
    return v, total


@inlined
def scaled(arm, n):  # type: ignore[no-untyped-def]
    """`split.scaled` is (q - high) / span, and `split.sigma` that times scale: return these, and all visits."""
    high, low, most, total = -np.inf, np.inf, 0, 0
    for a in range(arm.shape[1]):
        q, visits = arm[n, a].q, arm[n, a].visits
        high = max(high, q)
        if q > -np.inf:
            low = min(low, q)
        most = max(most, visits)
        total += visits
    return high, max(high - low + _TIE * abs(high), _TINY), (most + _VISITS) * _SCALE, total


@inlined
def select(arm, rules, n, score_A):  # type: ignore[no-untyped-def]
    """The action of a simulation that passes node n, by `Selection`; one of them is open."""
    A = arm.shape[1]
    high, span, scale, total = scaled(arm, n)
    best, chosen, norm = -np.inf, 0, 0.0
    for a in range(A):
        x = (arm[n, a].q - high) / span
        if rules.rule == GUMBEL:
            x = arm[n, a].prior * (math.exp(x * scale) if x < 0 else 1.0)
        elif rules.rule == PUCT:
            x += math.sqrt(total + 1.0) / (arm[n, a].visits + 1.0) * arm[n, a].prior * rules.exploration
        else:
            x += math.sqrt(math.log1p(float(total)) / (arm[n, a].visits + 1.0)) * rules.exploration
        norm += x
        score_A[a] = x
    norm = max(norm, _TINY)
    for a in range(A):
        score = score_A[a]
        if rules.rule == GUMBEL:
            score = np.rint((score / norm * (total + 1.0) - arm[n, a].visits) * _GRID)
        score = score if arm[n, a].open > 0 else -np.inf
        chosen = a if score > best else chosen
        best = max(best, score)
    return chosen


@inlined
def outcome(arm, edge, n, a):  # type: ignore[no-untyped-def]
    """The outcome that most lacks simulations, p_k (N_a + 1) - N_k, if something below can be expanded."""
    best, chosen = -np.inf, 0
    for k in range(edge.shape[2]):
        e = edge[n, a, k]
        lack = np.rint((e.prob * (arm[n, a].visits + 1.0) - e.visits) * _GRID)
        lack = lack if e.prob >= 0 else -np.inf
        chosen = k if lack > best else chosen
        best = max(best, lack)
    return chosen


@inlined
def _rank(arm, lane, preference, w, b, n, count, score_A, class_A):  # type: ignore[no-untyped-def]
    """The best `count` actions of root n are those of the first lanes: survivors before the others, exhausted ones
    last."""
    A = arm.shape[1]
    high, span, scale, _ = scaled(arm, n)
    for a in range(A):
        score_A[a] = preference[b, a] + (arm[n, a].q - high) / span * scale
        class_A[a] = 0 if arm[n, a].open == 0 else 1 + lane[w, a].survives
    for i in range(count):
        best = -1
        for a in range(A):
            if class_A[a] >= 0 and (
                best < 0 or class_A[a] > class_A[best] or (class_A[a] == class_A[best] and score_A[a] > score_A[best])
            ):
                best = a
        class_A[best] = -1
        lane[w, i].first = best


@inlined
def begin(arm, slot, lane, rules, w, b, n):  # type: ignore[no-untyped-def]
    """The search below root b, which is node n, begins in slot w."""
    x, num_allowed = slot[w], 0
    x.root, x.used, x.waiting, x.ranked, x.phases = b, 0, 0, 0, 1
    for a in range(lane.shape[1]):
        lane[w, a].survives = 1
        num_allowed += arm[n, a].q > -np.inf
    while 1 << x.phases < num_allowed:
        x.phases += 1
    _begin_round(slot, rules, w, np.int64(0), num_allowed)


@inlined
def _begin_round(slot, rules, w, phase, width):  # type: ignore[no-untyped-def]
    """A round of sequential halving; the last one takes the simulations that are left."""
    slot[w].phase, slot[w].width = phase, width
    slot[w].waves = max(1, (rules.simulations - 1) // (slot[w].phases * width))


@inlined
def _go_on(arm, lane, w, n, count):  # type: ignore[no-untyped-def]
    """Whether so many of the first lanes have actions that are left and not exhausted."""
    for i in range(count):
        a = lane[w, i].first
        if lane[w, a].survives == 0 or arm[n, a].open == 0:
            return False
    return True


@inlined
def due(node, arm, slot, lane, rules, preference, w, n, score_A, class_A, in_order):  # type: ignore[no-untyped-def]
    """Each action of root n that is due gets one of the next simulations; how many, 0 where its search is over. They
    are those of the first lanes, the best first if `in_order`."""
    x = slot[w]
    left = rules.simulations - 1 - x.used  # the first one has expanded the root
    if left < 1 or node[n].open == 0:
        return 0
    count = 1
    if not rules.halves:
        lane[w, 0].first = select(arm, rules, n, score_A)
    else:
        if x.ranked != x.width:  # a new round: the best `width` actions of those that are left go on
            _rank(arm, lane, preference, w, x.root, n, x.width, score_A, class_A)
            x.ranked = x.width
            for a in range(arm.shape[1]):
                lane[w, a].survives = 0
            for i in range(x.width):
                lane[w, lane[w, i].first].survives = 1
        count = min(left, x.width, node[n].open)
        # Where all that are left are due, they are in the lanes already.
        if in_order or count < x.width or not _go_on(arm, lane, w, n, count):
            _rank(arm, lane, preference, w, x.root, n, count, score_A, class_A)
        x.waves -= 1
        if x.waves == 0 and x.phase + 1 < x.phases:
            _begin_round(slot, rules, w, x.phase + 1, max(2, x.width // 2))
    x.waiting = count
    x.used += count
    return count


@inlined
def open_mass(node, edge, rules, n, mass_N, mass_A):  # type: ignore[no-untyped-def]
    """As `Nodes.open_mass`, of node n, whose children have theirs: of its actions in `mass_A`, and return the most.
    `mass_N` is by the numbers that edges have of nodes."""
    A, K = edge.shape[1:]
    most = 0.0
    for a in range(A):
        mass = 0.0
        for k in range(K):
            below = edge[n, a, k].below
            mass += edge[n, a, k].weight * (mass_N[below] if below > 0 else 1.0)
        mass_A[a] = mass if node[n].level + 1 < rules.bottom else 0.0
        most = max(most, mass_A[a])
    return most
