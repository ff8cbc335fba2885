"""One level of a lookahead over a table of all states, as compiled loops; `topology` does the same in torch.

The table is given as `Outcomes.arrays`. Outcomes with weight are those with p gamma > 0 of actions that are allowed.
"""

import numpy as np

from pgts_torch.compiled import jit


@jit
def children(states, reward, weight, child, A, K, met, found):  # type: ignore[no-untyped-def]
    """How many distinct states the outcomes with weight lead to; they are marked in `met`, and listed in `found` as far
    as it goes."""
    count = 0
    for s in states:
        for m in range(s * A, s * A + A):
            if reward[m] > -np.inf:
                for i in range(m * K, m * K + K):
                    if weight[i] > 0 and not met[child[i]]:
                        met[child[i]] = True
                        if count < len(found):
                            found[count] = child[i]
                        count += 1
    return count


@jit
def gather(states, reward, weight, child, A, K, place, to_reward, to_weight, to_child):  # type: ignore[no-untyped-def]
    """The rows of these states, with place[child] for children; 0 where an outcome has no weight."""
    pair, outcome = 0, 0
    for s in states:
        for m in range(s * A, s * A + A):
            to_reward[pair] = reward[m]
            for i in range(m * K, m * K + K):
                to_weight[outcome] = weight[i]
                has_weight = weight[i] > 0 and reward[m] > -np.inf
                to_child[outcome] = place[child[i]] if has_weight else 0
                outcome += 1
            pair += 1
