"""Tree search as compiled loops: one simulation after another below each root, as `tree` does with waves of one.

The trees lie in slots. Slot w has the nodes w * room to w * room + room - 1, the first of which is a root; a node's
number within its slot is 0 for the root, and as a child 0 means: no node yet. A root takes a slot when its search
begins and leaves it when it ends. A search stops at states of which nothing is known yet, all roots as far as they
come, and goes on where it stopped.

Arrays are passed one by one, because numba counts references to those that are taken from a tuple, at each access.
"""

import math
from typing import NamedTuple

import numpy as np

from pgts_torch.compiled import inlined, jit
from pgts_torch.search.tree_records import NEW, WANTED

GUMBEL, PUCT, UCT = 0, 1, 2
"""The rules of `Selection`."""

_GRID = 2.0**20
_TIE = 1e-8
_TINY = float(np.finfo(np.float64).tiny)
_VISITS, _SCALE = 50.0, 0.1
"""As in `split`."""


class Rules(NamedTuple):
    """The options, as numbers. A node at level `bottom` is never expanded; `phases` of sequential halving, 0: none."""

    room: int
    bottom: int
    simulations: int
    phases: int
    rule: int
    exploration: float
    mean: bool
    max_nodes: int


@inlined
def _expand(reward, prob, discount, child, table_row, state, prior, node, arm, edge, valued_L, rules, n, s, level):  # type: ignore[no-untyped-def]
    """Make n a node of state s, which begins with the critic's values of its children; return v.

    `valued_L` counts the nodes that have a value by level, and all of them in its last place.
    """
    r = table_row[s]
    A, K = edge.shape[1:]
    # Below the last level nothing is expanded; only averages go there, to take its values again.
    is_last = level + 1 == rules.bottom and (level == 0 or not rules.mean)
    v, num_open, total = -np.inf, 0, 0
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
        x.q, x.reward, x.prior = q + reward[r, a], reward[r, a], prior[state[s].row, a]
        x.visits, x.open = 0, 0 if is_last else width
        num_open += x.open > 0
        total += width
        v = max(v, x.q)
    node[n].row, node[n].level, node[n].open = r, level, num_open
    valued_L[level + 1] += total
    valued_L[-1] += total
    return v


@inlined
def _scaled(arm, n):  # type: ignore[no-untyped-def]
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
def _select(arm, rules, n, score_A):  # type: ignore[no-untyped-def]
    """The action of a simulation that passes node n, by `Selection`; one of them is open."""
    A = arm.shape[1]
    high, span, scale, total = _scaled(arm, n)
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
        if arm[n, a].open > 0:
            score = score_A[a]
            if rules.rule == GUMBEL:
                score = np.rint((score / norm * (total + 1.0) - arm[n, a].visits) * _GRID)
            if score > best:
                best, chosen = score, a
    return chosen


@inlined
def _outcome(arm, edge, n, a):  # type: ignore[no-untyped-def]
    """The outcome that most lacks simulations, p_k (N_a + 1) - N_k, if something below can be expanded."""
    best, chosen = -np.inf, 0
    for k in range(edge.shape[2]):
        e = edge[n, a, k]
        if e.prob >= 0:
            lack = np.rint((e.prob * (arm[n, a].visits + 1.0) - e.visits) * _GRID)
            if lack > best:
                best, chosen = lack, k
    return chosen


@inlined
def _descend(node, arm, edge, slot, lane, rules, w, i, a, score_A):  # type: ignore[no-untyped-def]
    """Send simulation i of a slot down, by action a of the root, to the edge where it ends: its child is no node yet,
    is at the last level, or has nothing below."""
    n = w * rules.room
    while True:
        k = _outcome(arm, edge, n, a)
        below = w * rules.room + edge[n, a, k].below
        if edge[n, a, k].below == 0 or node[below].open == 0:
            break
        n = below
        a = _select(arm, rules, n, score_A)
    lane[w, i].node, lane[w, i].action, lane[w, i].k = n, a, k


@inlined
def _backward(node, arm, edge, root, n, a, k, value, is_shut):  # type: ignore[no-untyped-def]
    """q of the edge of node n whose child has this value, and of those above; and where nothing is left below."""
    A = arm.shape[1]
    while True:
        e, x = edge[n, a, k], arm[n, a]
        e.value = value
        e.visits += 1
        x.visits += 1
        if is_shut:
            e.prob = -1.0
            x.open -= 1
            if x.open == 0:
                node[n].open -= 1
            is_shut = node[n].open == 0
        if n == root:
            _sum_up(arm, edge, n, a)
            break
        _sum_up(arm, edge, n, a)
        value = -np.inf
        for j in range(A):
            value = max(value, arm[n, j].q)
        n, a, k = root + node[n].parent, node[n].action, node[n].k


@inlined
def _sum_up(arm, edge, n, a):  # type: ignore[no-untyped-def]
    """q = r + sum_k p_k gamma_k v_k"""
    q = 0.0
    for k in range(edge.shape[2]):
        q += edge[n, a, k].weight * edge[n, a, k].value
    arm[n, a].q = q + arm[n, a].reward


@inlined
def _average(discount, node, arm, edge, root, n, a, k, value):  # type: ignore[no-untyped-def]
    """As `_backward`, with q = (q_0 + sum of returns) / (1 + N). Only outcomes that have weight are taken: gamma_k,
    times the probability that one has."""
    while True:
        e, x, weighed = edge[n, a, k], arm[n, a], 0.0
        for j in range(edge.shape[2]):
            weighed += max(0.0, edge[n, a, j].prob)
        value = x.reward + value * (discount[node[n].row, a, k] * weighed)
        x.q = (x.q * (1.0 + x.visits) + value) / (2.0 + x.visits)
        x.visits += 1
        e.visits += 1
        if n == root:
            break
        n, a, k = root + node[n].parent, node[n].action, node[n].k


@inlined
def _rank(arm, lane, rules, preference, w, b, count, score_A, class_A):  # type: ignore[no-untyped-def]
    """The best `count` actions of the root are those of the first lanes: survivors before the others, exhausted ones
    last."""
    n, A = w * rules.room, arm.shape[1]
    high, span, scale, _ = _scaled(arm, n)
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
        lane[w, i].action = best


@inlined
def _begin_round(slot, rules, w, phase, width):  # type: ignore[no-untyped-def]
    """A round of sequential halving; the last one takes the simulations that are left."""
    slot[w].phase, slot[w].width = phase, width
    slot[w].waves = max(1, (rules.simulations - 1) // (max(1, rules.phases) * width))


@inlined
def _next_wave(node, arm, edge, slot, lane, rules, preference, w, score_A, class_A):  # type: ignore[no-untyped-def]
    """Send the next simulations below a root down, one for each action that is due; False where its search is over."""
    n, x = w * rules.room, slot[w]
    left = rules.simulations - 1 - x.used  # the first one has expanded the root
    if left < 1 or node[n].open == 0:
        return False
    count = 1
    if rules.phases == 0:
        lane[w, 0].action = _select(arm, rules, n, score_A)
    else:
        if x.ranked != x.width:  # a new round: the best `width` actions of those that are left go on
            _rank(arm, lane, rules, preference, w, x.root, x.width, score_A, class_A)
            x.ranked = x.width
            for a in range(arm.shape[1]):
                lane[w, a].survives = 0
            for i in range(x.width):
                lane[w, lane[w, i].action].survives = 1
        count = min(left, x.width, node[n].open)
        _rank(arm, lane, rules, preference, w, x.root, count, score_A, class_A)
        x.waves -= 1
        if x.waves == 0 and x.phase + 1 < rules.phases:
            _begin_round(slot, rules, w, x.phase + 1, max(2, x.width // 2))
    for i in range(count):
        _descend(node, arm, edge, slot, lane, rules, w, i, lane[w, i].action, score_A)
    x.waiting = count
    x.used += count
    return True


@inlined
def _open_mass(node, arm, edge, rules, root, count, mass_N, mass_BA, b):  # type: ignore[no-untyped-def]
    """As `Nodes.open_mass`, of one root."""
    A, K = edge.shape[1:]
    for i in range(count - 1, -1, -1):  # children come after their parents
        n, most = root + i, 0.0
        for a in range(A):
            mass = 0.0
            for k in range(K):
                below = edge[n, a, k].below
                mass += edge[n, a, k].weight * (mass_N[below] if below > 0 else 1.0)
            mass_BA[b, a] = mass if node[n].level + 1 < rules.bottom else 0.0
            most = max(most, mass_BA[b, a])
        mass_N[i] = most


@jit
def search(  # type: ignore[no-untyped-def]
    reward, prob, discount, child, table_row, state, prior, node, arm, edge, slot, lane, rules, root_B, preference,
    q_BA, mass_BA, wanted, begun, valued_L, mass_N, score_A, class_A,
):  # fmt: skip
    """Go on with all searches. Return how many states are wanted, which are listed in `wanted`; -1 where the nodes are
    too many. It is over when none is wanted. It is one function because parts of it as `inlined` ones cost a tenth of
    its time.

    Args:
        reward, prob, discount, child, table_row: the columns of the `OutcomeTable`.
        state, prior: what is known of states, and rows of priors.   node, arm, edge, slot, lane: see `tree_records`.
        preference: what is added to sigma(q) in sequential halving.
        root_B: states that are known.
        q_BA, mass_BA: what is found, as in `Lookahead`.
        begun: one number, how many roots have had a slot.
        mass_N, score_A, class_A: scratch.
    """
    num_wanted = 0
    for w in range(len(slot)):
        x, root = slot[w], w * rules.room
        while True:
            if x.root < 0:
                if begun[0] == len(root_B):
                    break
                x.root, x.nodes, x.used, x.waiting, x.ranked = begun[0], 1, 0, 0, 0
                begun[0] += 1
                node[root].parent = -1
                for a in range(arm.shape[1]):
                    lane[w, a].survives = 1
                _begin_round(slot, rules, w, 0, arm.shape[1])
                _expand(
                    reward, prob, discount, child, table_row, state, prior, node, arm, edge, valued_L, rules, root,
                    root_B[x.root], 0,
                )  # fmt: skip
            # The states that are to be expanded must all be known.
            waits = False
            for i in range(x.waiting):
                y = lane[w, i]
                if edge[y.node, y.action, y.k].below == 0 and node[y.node].level + 1 < rules.bottom:
                    s = child[node[y.node].row, y.action, y.k]
                    if state[s].row < 0:
                        waits = True
                        if state[s].row == NEW:
                            state[s].row = WANTED
                            wanted[num_wanted] = s
                            num_wanted += 1
            if waits:
                break
            for i in range(x.waiting):
                n, a, k = lane[w, i].node, lane[w, i].action, lane[w, i].k
                below, level, value = edge[n, a, k].below, node[n].level + 1, edge[n, a, k].value
                if below == 0 and level < rules.bottom:
                    below = x.nodes
                    x.nodes += 1
                    edge[n, a, k].below = below
                    value = _expand(
                        reward, prob, discount, child, table_row, state, prior, node, arm, edge, valued_L, rules,
                        root + below, child[node[n].row, a, k], level,
                    )  # fmt: skip
                    node[root + below].parent = n - root
                    node[root + below].action, node[root + below].k = a, k
                    edge[n, a, k].value = value
                if rules.mean:
                    _average(discount, node, arm, edge, root, n, a, k, value)
                else:
                    _backward(node, arm, edge, root, n, a, k, value, node[root + below].open == 0)
            x.waiting = 0
            if valued_L[-1] > rules.max_nodes:
                return -1
            if not _next_wave(node, arm, edge, slot, lane, rules, preference, w, score_A, class_A):
                for a in range(arm.shape[1]):
                    q_BA[x.root, a] = arm[root, a].q
                if not rules.mean:
                    _open_mass(node, arm, edge, rules, root, x.nodes, mass_N, mass_BA, x.root)
                x.root = -1
    return num_wanted
