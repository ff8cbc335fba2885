"""The study of random families."""

import pytest

from pgts_torch.tabular import exact, grid, ladder, random_mdp, stationary_sets, tightrope
from study.families import diameter, family_study


def test_a_family_has_a_row_for_each_mdp_and_the_rows_are_true():
    rows = family_study(branchings=(1, 3), reward_shares=(0.1, 1.0), gammas=(0.9,), sizes=(4,), seeds=(0, 5))
    sampled = [(row.seed, row.branching, row.num_states, row.reward_share, row.gamma) for row in rows]
    assert sampled == [
        (seed, branching, 4, share, 0.9) for seed in (0, 5) for branching in (1, 3) for share in (0.1, 1.0)
    ]
    for row in rows:
        mdp = random_mdp(4, branching=row.branching, reward_share=row.reward_share, seed=row.seed)
        sets = stationary_sets.enumerate_sets(mdp)
        assert (row.sufficient_depth, row.worst_return) == (sets.sufficient_depth, sets.worst_return(0))
        assert row.J_optimal == pytest.approx(exact.optimal(mdp).J)
        assert row.worst_return <= row.J_optimal + 1e-12


def test_the_same_seed_gives_the_same_family():
    few = {"branchings": (2,), "reward_shares": (0.2,), "gammas": (0.5, 0.99), "sizes": (5,)}
    assert family_study(seeds=(3,), **few) == family_study(seeds=(3, 4), **few)[:2]
    assert family_study(seeds=(3,), **few) != family_study(seeds=(4,), **few)


@pytest.mark.parametrize(
    ("mdp", "steps"),
    [(lambda: ladder(6), 5), (tightrope, 2), (lambda: grid(4, traps=(), slip=0.0), 6), (random_mdp, 1)],
)
def test_the_diameter_is_the_longest_of_the_shortest_finite_paths(mdp, steps):
    assert diameter(mdp()) == steps
