"""Tree search with merging as compiled loops: a node is a (state, level), whatever the path and the root (Czech et al.
2021). Simulations come one after another, as in `tree` with waves of one: in each round the roots have their turns,
in which each of their actions that are due gets one.

Nodes 0 to B - 1 are the roots; 0 as a child means: no node yet. `node_at` says which node a (state, level) is, at
state * (bottom + 1) + level: -1 where the critic has valued the state but nothing has expanded it. A search stops at a
state of which nothing is known yet. So that all roots go on together, it then runs ahead to the end of the round, with
nodes of which only the critic's value is known, to see which states the other simulations may want.
"""

import numpy as np

from pgts_torch.compiled import inlined, jit
from pgts_torch.search.node_kernels import begin, due, expand, open_mass, outcome, select
from pgts_torch.search.state_kernels import is_known, learn
from pgts_torch.search.tree_records import FULL, NEW, NOT_FINITE, TOO_MANY, UNKNOWN, WANTED


@inlined
def _refresh(child, node, arm, edge, node_at, rules, n):  # type: ignore[no-untyped-def]
    """q and v of a node, and what is open there, from the children that there are now, whoever expanded them."""
    if node[n].row < 0:
        return
    A, K = edge.shape[1:]
    r, level, v = node[n].row, node[n].level + 1, -np.inf
    for a in range(A):
        x, q = arm[n, a], 0.0
        for k in range(K):
            e = edge[n, a, k]
            if e.weight > 0:
                if e.below == 0 and level < rules.bottom:
                    e.below = max(0, node_at[child[r, a, k] * (rules.bottom + 1) + level])
                if e.below > 0:
                    e.value = node[e.below].v
                    if e.prob >= 0 and node[e.below].open == 0:
                        e.prob = -1.0
                        x.open -= 1
                        if x.open == 0:
                            node[n].open -= 1
                q += e.weight * e.value
        x.q = q + x.reward
        v = max(v, x.q)
    node[n].v = v


@inlined
def _count_children(child, node, edge, rules, valued_L, node_at, n):  # type: ignore[no-untyped-def]
    """Count the children of a node that are valued for the first time at their level."""
    A, K = edge.shape[1:]
    level = node[n].level + 1
    for a in range(A):
        for k in range(K):
            if edge[n, a, k].weight > 0:
                place = child[node[n].row, a, k] * (rules.bottom + 1) + level
                if node_at[place] == 0:
                    node_at[place] = -1
                    valued_L[level] += 1
                    valued_L[-1] += 1


@inlined
def _add_roots(  # type: ignore[no-untyped-def]
    reward, prob, discount, child, table_row, state, prior, node, arm, edge, slot, lane, rules, root_B, valued_L,
    node_at,
):  # fmt: skip
    for b in range(len(root_B)):
        node[b].v, _ = expand(
            reward, prob, discount, child, table_row, state, prior, node, arm, edge, rules, b, root_B[b], np.int64(0),
        )  # fmt: skip
        begin(arm, slot, lane, rules, b, b, b)
        _count_children(child, node, edge, rules, valued_L, node_at, b)


@inlined
def _descend(child, node, arm, edge, path, node_at, rules, n, a, score_A):  # type: ignore[no-untyped-def]
    """Send a simulation down by an action of root n. Return the level of the node where it ends, whose edge in `path`
    leads to a child that is no node yet; or, as the second number, where nothing is left to expand: the child."""
    level = 0
    while True:
        k = outcome(arm, edge, n, a)
        path[level].node, path[level].action, path[level].k = n, a, k
        below = max(0, node_at[child[node[n].row, a, k] * (rules.bottom + 1) + level + 1])
        if below == 0:
            return level, 0
        _refresh(child, node, arm, edge, node_at, rules, below)  # what other paths have found below it counts
        if node[below].open == 0 or node[below].row < 0:
            return level, below
        n, level = below, level + 1
        a = select(arm, rules, n, score_A)


@inlined
def _backward(child, node, arm, edge, path, node_at, rules, level, is_used):  # type: ignore[no-untyped-def]
    """Back up the nodes of a path from this level up, and count the simulation where it could be used."""
    for j in range(level, -1, -1):
        y = path[j]
        edge[y.node, y.action, y.k].visits += is_used
        arm[y.node, y.action].visits += is_used
        _refresh(child, node, arm, edge, node_at, rules, y.node)


@inlined
def _begin_round(child, node, arm, edge, slot, lane, rules, preference, score_A, class_A, node_at):  # type: ignore[no-untyped-def]
    """Back up the roots. Return how many simulations all of them are to send in the next round."""
    under_way = 0
    for b in range(len(slot)):
        _refresh(child, node, arm, edge, node_at, rules, b)
        slot[b].waiting = due(node, arm, slot, lane, rules, preference, b, b, score_A, class_A, True)
        under_way += slot[b].waiting
    return under_way


@inlined
def _finish(child, node, arm, edge, node_at, rules, nodes, q_BA, mass_BA, mass_N):  # type: ignore[no-untyped-def]
    """Back up the whole graph once from the bottom, and find `q_BA` and `mass_BA` of the roots."""
    for level in range(rules.bottom - 1, -1, -1):
        for n in range(nodes):
            if node[n].level == level:
                _refresh(child, node, arm, edge, node_at, rules, n)
                # That of the last root is written last, after those of all nodes that are no roots.
                mass_N[n] = open_mass(node, edge, rules, n, mass_N, mass_BA[min(n, len(mass_BA) - 1)])
    for b in range(len(q_BA)):
        for a in range(arm.shape[1]):
            q_BA[b, a] = arm[b, a].q


@jit
def search(  # type: ignore[no-untyped-def]
    reward, prob, discount, child, table_row, state, prior, node, arm, edge, slot, lane, rules, root_B, preference,
    q_BA, mass_BA, wanted, turn, valued_L, mass_N, score_A, class_A, child_C, v_C, learned, row, step, node_at, path,
):  # fmt: skip
    """Go on with all searches. Return 0 where they are over, or why not. After UNKNOWN it is called once more, to run
    ahead: then it returns how many states are wanted, which are listed in `wanted`, and what it has changed in `node`,
    `arm`, `edge`, `slot` and `path` is to be taken back.

    Args:
        turn: how many nodes there are, whether a round is under way, the root and its action that are next in it,
            whether to run ahead, and 1 + the level at which the next simulation has ended already, or 0.
        slot, lane: of each root.
        node_at, path: see above; `path` has room for a simulation.   All others as in `tree_kernels.search`.
    """
    if not learn(state, child_C, v_C, learned, row, step):
        return NOT_FINITE
    if turn[0] == 0:
        turn[0] = len(root_B)
        _add_roots(
            reward, prob, discount, child, table_row, state, prior, node, arm, edge, slot, lane, rules, root_B,
            valued_L, node_at,
        )  # fmt: skip
    while valued_L[-1] <= rules.max_nodes:
        if turn[1] == 0:
            if _begin_round(child, node, arm, edge, slot, lane, rules, preference, score_A, class_A, node_at) == 0:
                _finish(child, node, arm, edge, node_at, rules, turn[0], q_BA, mass_BA, mass_N)
                return 0
            turn[1], turn[2], turn[3] = 1, 0, 0
        num_wanted, nodes, i, runs_ahead, level_after = 0, turn[0], turn[3], turn[4] == 1, turn[5]
        if not runs_ahead:
            turn[5] = 0
        for b in range(turn[2], len(root_B)):
            while i < slot[b].waiting:
                root_arm = arm[b, lane[b, i].first]
                if root_arm.open == 0:  # other roots have expanded all below it
                    slot[b].used -= 1
                    i += 1
                    continue
                # On its way down a simulation brings nodes up to date, so that a second time it may go another way.
                level, below = level_after - 1, 0
                if level_after == 0:
                    level, below = _descend(child, node, arm, edge, path, node_at, rules, b, lane[b, i].first, score_A)
                level_after, is_used = 0, below == 0 or node[below].row < 0
                if below == 0:
                    below, y = nodes, path[level]
                    s = child[node[y.node].row, y.action, y.k]
                    known = is_known(reward, prob, discount, child, table_row, state, rules, s)
                    if not runs_ahead and (below == len(node) or not known):
                        turn[0], turn[2], turn[3], turn[5] = nodes, b, i, level + 1
                        return FULL if below == len(node) else UNKNOWN
                    if below == len(node):
                        break
                    nodes += 1
                    place = s * (rules.bottom + 1) + level + 1
                    node[below].place, node[below].parent, node_at[place] = place, node_at[place], below
                    if known:
                        node[below].v, _ = expand(
                            reward, prob, discount, child, table_row, state, prior, node, arm, edge, rules, below, s,
                            level + 1,
                        )  # fmt: skip
                        if not runs_ahead:
                            _count_children(child, node, edge, rules, valued_L, node_at, below)
                    else:
                        node[below].row, node[below].open, node[below].v = -1, 1, state[s].v
                        if state[s].row == NEW:
                            state[s].row = WANTED
                            wanted[num_wanted] = s
                            num_wanted += 1
                _backward(child, node, arm, edge, path, node_at, rules, level, is_used)
                slot[b].used -= not is_used  # it can be sent again
                if valued_L[-1] > rules.max_nodes:
                    return TOO_MANY
                i += 1
            i = 0
        if runs_ahead:
            for n in range(turn[0], nodes):
                node_at[node[n].place] = node[n].parent
            return num_wanted
        turn[0], turn[1] = nodes, 0
    return TOO_MANY
