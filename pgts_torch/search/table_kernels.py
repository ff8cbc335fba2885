"""New rows of an `OutcomeTable` as a compiled loop: checked and written in one pass."""

import numpy as np

from pgts_torch.compiled import jit


@jit
def write(  # type: ignore[no-untyped-def]
    first, num_states, tolerance, state_N, reward_NA, prob_NAK, discount_NAK, child_NAK, to_reward, to_prob,
    to_discount, to_child, row_S,
):  # fmt: skip
    """Write the rows of these states from `first` on, whose other outcomes are padding. False where `check_outcomes`
    may object: then nothing that was written counts."""
    N, A, K = child_NAK.shape
    for n in range(N):
        highest = -np.inf
        for a in range(A):
            reward, total = reward_NA[n, a], 0.0
            if not reward < np.inf:
                return False
            highest = max(highest, reward)
            to_reward[first + n, a] = reward
            for k in range(to_child.shape[2]):
                p, gamma, s = 0.0, 0.0, 0
                if k < K:
                    p, gamma, s = prob_NAK[n, a, k], discount_NAK[n, a, k], child_NAK[n, a, k]
                total += p
                if not (0 <= p <= 1 + tolerance and 0 <= gamma <= 1 and 0 <= s < num_states):
                    return False
                to_prob[first + n, a, k], to_discount[first + n, a, k], to_child[first + n, a, k] = p, gamma, s
            if reward > -np.inf and not abs(total - 1) <= tolerance:
                return False
        if highest == -np.inf:
            return False
    for n in range(N):
        row_S[state_N[n]] = first + n
    return True


@jit
def missing(state_N, row_S, missing_N):  # type: ignore[no-untyped-def]
    """List the states that have no row; how many there are."""
    count = 0
    for s in state_N:
        if row_S[s] < 0:
            missing_N[count] = s
            count += 1
    return count
