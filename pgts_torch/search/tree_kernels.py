"""Tree search as compiled loops: one simulation after another below each root, as `tree` does with waves of one.

The trees lie in slots. Slot w has the nodes w * room to w * room + room - 1, the first of which is a root; a node's
number within its slot is 0 for the root, and as a child 0 means: no node yet. A root takes a slot when its search
begins and leaves it when it ends. A search stops at states of which nothing is known yet, all roots as far as they
come, and goes on where it stopped.
"""

import numpy as np

from pgts_torch.compiled import inlined, jit
from pgts_torch.search.node_kernels import begin, due, expand, open_mass, outcome, select
from pgts_torch.search.state_kernels import is_known, learn
from pgts_torch.search.tree_records import NEW, NOT_FINITE, TOO_MANY, WANTED


@inlined
def _descend(node, arm, edge, lane, rules, w, i, a, score_A):  # type: ignore[no-untyped-def]
    """Send simulation i of a slot down, by action a of the root, to the edge where it ends: its child is no node yet,
    is at the last level, or has nothing below."""
    n = w * rules.room
    while True:
        k = outcome(arm, edge, n, a)
        below = w * rules.room + edge[n, a, k].below
        if edge[n, a, k].below == 0 or node[below].open == 0:
            break
        n = below
        a = select(arm, rules, n, score_A)
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
def _finish(node, arm, edge, slot, rules, w, q_BA, mass_BA, mass_N):  # type: ignore[no-untyped-def]
    """Write what a search has found, and leave its slot."""
    x, root = slot[w], w * rules.room
    for a in range(arm.shape[1]):
        q_BA[x.root, a] = arm[root, a].q
    if rules.mean:
        mass_BA[x.root] = np.inf
    else:
        for i in range(x.nodes - 1, -1, -1):  # children come after their parents
            mass_N[i] = open_mass(node, edge, rules, root + i, mass_N, mass_BA[x.root])
    x.root = -1


@jit
def search(  # type: ignore[no-untyped-def]
    reward, prob, discount, child, table_row, state, prior, node, arm, edge, slot, lane, rules, root_B, preference,
    q_BA, mass_BA, wanted, turn, valued_L, mass_N, score_A, class_A, child_C, v_C, learned, row, step,
):  # fmt: skip
    """Go on with all searches. Return how many states are wanted, which are listed in `wanted`, or why not. It is over
    when none is wanted. It is one function because parts of it as `inlined` ones cost a tenth of its time.

    Args:
        reward, prob, discount, child, table_row: the columns of the `OutcomeTable`.
        state, prior: what is known of states, and rows of priors.   node, arm, edge, slot, lane: see `tree_records`.
        preference: what is added to sigma(q) in sequential halving.
        root_B: states that are known.
        q_BA, mass_BA: what is found, as in `Lookahead`.
        turn: its first number is how many roots have had a slot.
        valued_L: counts the nodes that have a value by level, and all of them in its last place.
        mass_N, score_A, class_A: scratch.
        child_C, v_C, learned, row, step: what `learn` is to write first.
    """
    if not learn(state, child_C, v_C, learned, row, step):
        return NOT_FINITE
    num_wanted = 0
    for w in range(len(slot)):
        x, root = slot[w], w * rules.room
        while True:
            if x.root < 0:
                if turn[0] == len(root_B):
                    break
                x.nodes, node[root].parent = 1, -1
                _, width = expand(
                    reward, prob, discount, child, table_row, state, prior, node, arm, edge, rules, root,
                    root_B[turn[0]], np.int64(0),
                )  # fmt: skip
                begin(arm, slot, lane, rules, w, turn[0], root)
                turn[0] += 1
                valued_L[1] += width
                valued_L[-1] += width
            # The states that are to be expanded must all be known.
            waits = False
            for i in range(x.waiting):
                y = lane[w, i]
                if edge[y.node, y.action, y.k].below == 0 and node[y.node].level + 1 < rules.bottom:
                    s = child[node[y.node].row, y.action, y.k]
                    if not is_known(reward, prob, discount, child, table_row, state, rules, s):
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
                    value, width = expand(
                        reward, prob, discount, child, table_row, state, prior, node, arm, edge, rules, root + below,
                        child[node[n].row, a, k], level,
                    )  # fmt: skip
                    valued_L[level + 1] += width
                    valued_L[-1] += width
                    node[root + below].parent = n - root
                    node[root + below].action, node[root + below].k = a, k
                    edge[n, a, k].value = value
                if rules.mean:
                    _average(discount, node, arm, edge, root, n, a, k, value)
                else:
                    _backward(node, arm, edge, root, n, a, k, value, node[root + below].open == 0)
            x.waiting = 0
            if valued_L[-1] > rules.max_nodes:
                return TOO_MANY
            count = due(node, arm, slot, lane, rules, preference, w, root, score_A, class_A, False)
            for i in range(count):
                _descend(node, arm, edge, lane, rules, w, i, lane[w, i].first, score_A)
            if count == 0:
                _finish(node, arm, edge, slot, rules, w, q_BA, mass_BA, mass_N)
    return num_wanted
