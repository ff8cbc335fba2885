"""All deterministic policies of small MDPs by plain numpy: the second route to the stationary sets."""

import functools
import itertools
from dataclasses import dataclass, replace

import numpy as np
import torch

from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, random_mdp, stationary_sets
from tests.support import weights

DEPTHS = range(5)
EXACT = 1e-9
"""What rounding may do to values of up to 100."""


@dataclass(frozen=True)
class Brute:
    """All deterministic policies of an MDP: their values, where they go, what a lookahead of each depth sees."""

    mdp: TabularMDP
    sets: stationary_sets.StationarySets
    action_PS: np.ndarray
    v_PS: np.ndarray
    sigma_PS: np.ndarray
    look_MPSA: np.ndarray

    @functools.cached_property
    def J_P(self) -> np.ndarray:
        return self.v_PS @ self.mdp.start_S.numpy()

    @functools.cached_property
    def lack_P(self) -> np.ndarray:
        return self.J_P.max() - self.J_P

    @functools.cached_property
    def gap_MP(self) -> np.ndarray:
        return np.where(self.sigma_PS, self.look_MPSA.max(-1) - self.v_PS, 0).max(-1)

    @property
    def member_MP(self) -> np.ndarray:
        return self.gap_MP <= EXACT

    @functools.cached_property
    def follows_SS(self) -> np.ndarray:
        """1 where an action leads from one state to the other."""
        return (weights(self.mdp) > 0).any(1).astype(int)

    def reached_S(self, steps: int) -> np.ndarray:
        """The states that some policy reaches in exactly so many steps."""
        return self.mdp.start_S.numpy() @ np.linalg.matrix_power(self.follows_SS, steps) > 0

    def pi_SA(self, p: int) -> torch.Tensor:
        return torch.eye(self.mdp.num_actions, dtype=torch.float64)[torch.from_numpy(self.action_PS[p])]


def brute(mdp: TabularMDP) -> Brute:
    weight_SAS, reward_SA = weights(mdp), mdp.outcomes.reward_NA.numpy()
    S, A = reward_SA.shape
    action_PS = np.array(list(itertools.product(range(A), repeat=S)))
    P_PSS, r_PS = weight_SAS[np.arange(S), action_PS], reward_SA[np.arange(S), action_PS]
    v_PS = np.linalg.solve(np.eye(S) - P_PSS, r_PS[..., None])[..., 0]
    sigma_PS = np.linalg.matrix_power(np.eye(S) + (P_PSS > 0), S).transpose(0, 2, 1) @ mdp.start_S.numpy() > 0
    look, best_PS = [], v_PS
    for _ in DEPTHS:
        look.append(reward_SA + np.einsum("sat,pt->psa", weight_SAS, best_PS))
        best_PS = look[-1].max(-1)
    return Brute(mdp, stationary_sets.enumerate_sets(mdp), action_PS, v_PS, sigma_PS, np.stack(look))


def with_ends(mdp: TabularMDP, seed: int) -> TabularMDP:
    """The MDP with some outcomes ending and some discounted more than the others."""
    random, discount = numpy_stream(seed, "with_ends"), mdp.outcomes.discount_NAK
    factor = torch.from_numpy(random.choice([0.0, 0.5, 1.0], p=[0.2, 0.1, 0.7], size=tuple(discount.shape)))
    return replace(mdp, outcomes=replace(mdp.outcomes, discount_NAK=discount * factor))


@functools.cache
def family() -> tuple[Brute, ...]:
    """Sparse random MDPs of 3 to 6 states: a fifth starts in two states, a fifth everywhere, a third has ends."""
    found = []
    for seed in range(210):
        random = numpy_stream(seed, "family")
        S = int(random.integers(3, 7))
        mdp = random_mdp(
            S,
            3 if S == 3 else 2,
            branching=int(random.integers(1, 4)),
            reward_share=float(random.choice([0.1, 0.3, 1.0])),
            gamma=float(random.choice([0.5, 0.9, 0.97])),
            seed=seed,
            start=None if seed % 5 == 0 else 0,
        )
        if seed % 5 == 1:
            mdp = replace(mdp, start_S=torch.tensor([0.25, 0.75] + [0.0] * (S - 2), dtype=torch.float64))
        found.append(brute(with_ends(mdp, seed) if seed % 3 == 0 else mdp))
    return tuple(found)


def stationary_ones(case: Brute) -> list[tuple[int, int]]:
    """(depth, policy) for a few stationary policies that are not optimal."""
    pairs = [(m, int(p)) for m in DEPTHS for p in np.flatnonzero(case.member_MP[m] & (case.lack_P > EXACT))]
    return pairs[:: max(1, len(pairs) // 4)]
