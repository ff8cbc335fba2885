"""Each MDP of the zoo against a description written by hand."""

import math

import numpy as np
import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import (
    TabularMDP,
    combination_lock,
    corridor,
    deep_sea,
    exact,
    grid,
    ladder,
    mirage,
    random_mdp,
    river_swim,
    roundabout,
    tightrope,
)
from tests.support import always, outcomes_of, uniform_policy

LEFT, RIGHT, UP, DOWN = range(4)


def follows(mdp: TabularMDP) -> dict[tuple[int, int], int]:
    """The one successor of each (state, action) of a deterministic MDP."""
    table = {}
    for s in range(mdp.num_states):
        for a in range(mdp.num_actions):
            ((table[s, a], _),) = outcomes_of(mdp, s, a)
    return table


def rewards(mdp: TabularMDP) -> dict[tuple[int, int], float]:
    """The rewards that are not 0."""
    return {(s, a): float(mdp.outcomes.reward_NA[s, a]) for s, a in torch.nonzero(mdp.outcomes.reward_NA).tolist()}


# Ladder


def test_the_ladder_is_the_one_of_the_paper():
    mdp = ladder(5, gamma=0.8)
    assert follows(mdp) == {
        (0, 0): 0, (1, 0): 0, (2, 0): 1, (3, 0): 2, (4, 0): 3,
        (0, 1): 1, (1, 1): 2, (2, 1): 3, (3, 1): 4, (4, 1): 4,
    }  # fmt: skip
    assert rewards(mdp) == {(4, 1): 1}
    assert mdp.action_names == ("left", "right")
    assert torch.all(mdp.outcomes.discount_NAK == 0.8)
    assert mdp.start_S.tolist() == [1, 0, 0, 0, 0]


def test_the_ladder_of_one_state_is_all_top():
    assert rewards(ladder(1)) == {(0, 1): 1}


# Tightrope


def test_the_tightrope_is_the_one_of_the_paper():
    mdp = tightrope()
    assert follows(mdp) == {(0, 0): 0, (0, 1): 1, (1, 0): 3, (1, 1): 2, (2, 0): 2, (2, 1): 2, (3, 0): 3, (3, 1): 3}
    assert rewards(mdp) == {(2, 0): 1, (2, 1): 1, (3, 0): -10, (3, 1): -10}
    assert mdp.start_S.tolist() == [1, 0, 0, 0]
    assert tightrope(start=None).start_S.tolist() == [0.25] * 4


# Random


def test_the_same_seed_gives_the_same_mdp_and_neighbouring_seeds_share_nothing():
    one, again, next_one = (random_mdp(20, 3, branching=4, seed=seed).outcomes for seed in (5, 5, 6))
    for field in ("reward_NA", "prob_NAK", "child_NAK"):
        assert torch.equal(getattr(one, field), getattr(again, field))
        assert not torch.equal(getattr(one, field), getattr(next_one, field))
    assert not set(one.reward_NA.flatten().tolist()) & set(next_one.reward_NA.flatten().tolist())


@pytest.mark.parametrize("branching", [1, 2, 5, 19, 20, None])
def test_a_garnet_leads_to_as_many_distinct_states_as_it_branches(branching):
    mdp = random_mdp(20, 3, branching=branching)
    counts = {len({child for child, _ in outcomes_of(mdp, s, a)}) for s in range(20) for a in range(3)}
    assert counts == {branching or 20}


def test_the_successors_of_a_garnet_are_uniform_over_all_sets():
    # 6 sets of 2 out of 4 states, each 20,000/6 times: chi-squared with 5 degrees exceeds 37 with probability 6e-7.
    child = random_mdp(5000, 4, branching=2).outcomes.child_NAK.flatten(0, 1)
    small = random_mdp(4, 5000, branching=2, seed=3).outcomes.child_NAK.flatten(0, 1).sort(-1).values
    _, counts = small.unique(dim=0, return_counts=True)
    expected = len(small) / 6
    assert len(counts) == 6
    assert float(((counts - expected) ** 2 / expected).sum()) < 37
    assert child.min() == 0
    assert child.max() == 4999


def test_a_random_mdp_keeps_a_share_of_its_rewards_and_all_of_its_transitions():
    dense = random_mdp(9, 2, branching=2, seed=4).outcomes
    for share, kept in [(0.0, 1), (0.05, 1), (0.2, 4), (0.5, 9), (1.0, 18)]:
        sparse = random_mdp(9, 2, branching=2, reward_share=share, seed=4).outcomes
        stays_SA = sparse.reward_NA != 0
        assert int(stays_SA.sum()) == kept
        assert torch.equal(sparse.reward_NA[stays_SA], dense.reward_NA[stays_SA])
        assert torch.equal(sparse.child_NAK, dense.child_NAK)


def test_rewards_and_probabilities_of_a_random_mdp_are_uniform():
    # Means of 5,000 numbers, within 5 standard errors: wrong with probability 6e-7 each.
    outcomes = random_mdp(50, 100, branching=3, seed=2).outcomes
    assert 0 <= outcomes.reward_NA.min() <= outcomes.reward_NA.max() <= 1
    assert abs(outcomes.reward_NA.mean() - 0.5) < 5 * math.sqrt(1 / 12 / 5000)
    # p_1 of a uniform distribution on the simplex of 3 has mean 1/3, variance 1/18 and P(p_1 > 1/2) = 1/4.
    p = outcomes.prob_NAK[..., 0]
    assert abs(p.mean() - 1 / 3) < 5 * math.sqrt(1 / 18 / 5000)
    assert abs((p > 0.5).double().mean() - 0.25) < 5 * math.sqrt(3 / 16 / 5000)


# Grid


def test_an_inner_cell_of_the_grid_moves_as_intended_with_probability_0_9925():
    mdp = grid()
    s = 55
    for action, intended in [(LEFT, 54), (RIGHT, 56), (UP, 45), (DOWN, 65)]:
        expected = {(t, 0.9): 0.0025 for t in (54, 56, 45, 65)} | {(intended, 0.9): 0.99 + 0.0025}
        assert outcomes_of(mdp, s, action) == pytest.approx(expected, abs=1e-15)


def test_a_move_into_the_wall_of_the_grid_stays():
    mdp = grid()
    corner = {(0, 0.9): 0.99 + 2 * 0.0025, (1, 0.9): 0.0025, (10, 0.9): 0.0025}
    assert outcomes_of(mdp, 0, LEFT) == pytest.approx(corner, abs=1e-15)
    assert outcomes_of(mdp, 0, UP) == pytest.approx(corner, abs=1e-15)
    assert outcomes_of(mdp, 99, RIGHT)[99, 0.9] == pytest.approx(0.995)
    # The grid has edges: it does not wrap from the end of a row to the next.
    assert set(outcomes_of(mdp, 19, RIGHT)) == {(19, 0.9), (18, 0.9), (9, 0.9), (29, 0.9)}


def test_goal_and_traps_of_the_grid_pay_every_action():
    expected = {(99, a): 10.0 for a in range(4)} | {(s, a): -10.0 for s in (12, 32) for a in range(4)}
    assert rewards(grid()) == pytest.approx(expected, rel=1e-15)
    other = grid(traps=(11, 32), goal=98, goal_reward=1.0, trap_reward=-2.0)
    assert {s: r for (s, _), r in rewards(other).items()} == pytest.approx({98: 1.0, 11: -2.0, 32: -2.0}, rel=1e-15)


def test_the_plain_grid_goes_on_after_goal_and_traps():
    assert torch.all(grid().outcomes.discount_NAK[grid().outcomes.prob_NAK > 0] == 0.9)


def test_the_absorbing_grid_ends_when_goal_or_trap_is_left():
    mdp = grid(absorbing=True)
    assert rewards(mdp) == rewards(grid())
    for s in range(100):
        discounts = {discount for a in range(4) for _, discount in outcomes_of(mdp, s, a)}
        assert discounts == ({0.0} if s in (12, 32, 99) else {0.9})
    v_S = exact.evaluate(mdp, uniform_policy(mdp)).v_S
    assert v_S[[99, 12, 32]].tolist() == pytest.approx([10, -10, -10], rel=1e-14)
    assert exact.evaluate(grid(), uniform_policy(mdp)).v_S[99] > 10.5


def test_a_grid_without_slip_is_worth_the_shortest_path():
    mdp = grid(4, slip=0.0, traps=(), absorbing=True)
    assert exact.optimal(mdp).J == pytest.approx(10 * 0.9**6)
    assert (mdp.shape, mdp.action_names) == ((4, 4), ("left", "right", "up", "down"))


# Deep sea


class DeepSea:
    """The game by the rules of bsuite: reward, then column, then row; it ends below the last row."""

    def __init__(self, n: int, right_action: np.ndarray, row: int = 0, column: int = 0) -> None:
        self.n, self.right_action, self.row, self.column = n, right_action, row, column

    def step(self, action: int, wind: bool = False) -> tuple[float, bool]:
        goes_right = action == self.right_action[self.row, self.column]
        reward = 1.0 if goes_right and self.column == self.n - 1 else 0.0
        if goes_right:
            reward -= 0.01 / self.n
            self.column = self.column if wind else min(self.column + 1, self.n - 1)
        else:
            self.column = max(self.column - 1, 0)
        self.row += 1
        return reward, self.row == self.n


def right_actions(mdp: TabularMDP, n: int) -> np.ndarray:
    """Which action costs something, for each cell."""
    cost = mdp.outcomes.reward_NA != 0
    assert torch.all(cost.sum(-1) == 1)
    return cost.int().argmax(-1).view(n, n).numpy()


@pytest.mark.parametrize("stochastic", [False, True])
@pytest.mark.parametrize("mapping_seed", [None, 0, 1])
@pytest.mark.parametrize("n", [2, 5])
def test_deep_sea_follows_the_rules_of_bsuite(n, mapping_seed, stochastic):
    mdp = deep_sea(n, gamma=0.9, mapping_seed=mapping_seed, stochastic=stochastic)
    right_action = right_actions(mdp, n) if mapping_seed is not None else np.ones((n, n), dtype=int)
    for s in range(n * n):
        for a in range(2):
            expected, reward = {}, 0.0
            for wind, p in [(False, 1 - 1 / n), (True, 1 / n)] if stochastic else [(False, 1.0)]:
                game = DeepSea(n, right_action, *divmod(s, n))
                reward, ended = game.step(a, wind)
                key = (min(game.row, n - 1) * n + game.column, 0.0 if ended else 0.9)
                expected[key] = expected.get(key, 0.0) + p
            assert outcomes_of(mdp, s, a) == pytest.approx(expected)
            assert mdp.outcomes.reward_NA[s, a].item() == pytest.approx(reward, abs=1e-15)


def test_the_treasure_of_deep_sea_is_worth_its_discount_minus_the_way():
    n, gamma = 6, 0.95
    J = gamma ** (n - 1) - 0.01 / n * sum(gamma**k for k in range(n))
    assert exact.optimal(deep_sea(n, gamma=gamma)).J == pytest.approx(J, rel=1e-12)
    assert exact.optimal(deep_sea(n, gamma=gamma, mapping_seed=4)).J == pytest.approx(J, rel=1e-12)
    windy = deep_sea(n, gamma=1.0, stochastic=True)
    # bsuite: only the last of n moves needs no luck.
    assert exact.evaluate(windy, always(windy, RIGHT)).J == pytest.approx((1 - 1 / n) ** (n - 1) - 0.01, rel=1e-12)


@pytest.mark.usefixtures("unchecked_shapes")
def test_the_mapping_seed_of_deep_sea_chooses_which_action_is_right():
    maps = [right_actions(deep_sea(10, mapping_seed=seed), 10) for seed in (0, 0, 1)]
    assert np.array_equal(maps[0], maps[1])
    assert not np.array_equal(maps[0], maps[2])
    assert 25 < maps[0].sum() < 75  # 100 fair coins: wrong with probability 6e-7
    assert np.all(right_actions(deep_sea(10), 10) == 1)


# Mirage


@pytest.mark.parametrize(("width", "delta", "gamma"), [(10, 0.05, 0.9), (1, 0.3, 0.5), (4, 0.01, 0.99)])
def test_the_advantage_of_right_on_the_mirage_is_that_of_the_formula(width, delta, gamma):
    mdp = mirage(width, delta=delta, gamma=gamma)
    q_SA = exact.evaluate(mdp, always(mdp, 0)).q_SA
    for m in (0, 1, 2, 7, 30):
        left, right = exact.lookahead(mdp, q_SA, m)[0].tolist()
        assert right - left == pytest.approx(gamma / (1 - gamma) * (1 - (1 - delta) * (1 - gamma**m)))
    assert exact.optimal(mdp).J == pytest.approx(gamma / (1 - gamma))
    assert exact.evaluate(mdp, always(mdp, 1)).J == pytest.approx(gamma / (1 - gamma))


# What is refused


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ladder(0), "n is 0; it must be a whole number of at least 1"),
        (lambda: ladder(gamma=1.5), "gamma is 1.5"),
        (lambda: ladder(3, start=3), "start state 3 does not exist"),
        (lambda: random_mdp(0), "num_states is 0"),
        (lambda: random_mdp(3, 0), "num_actions is 0"),
        (lambda: random_mdp(3, branching=0), "branching is 0; it must be between 1 and num_states = 3"),
        (lambda: random_mdp(3, branching=4), "branching is 4"),
        (lambda: random_mdp(gamma=-0.1), "gamma is -0.1"),
        (lambda: random_mdp(reward_share=math.nan), r"reward_share is nan; it must be in \[0, 1\]"),
        (lambda: mirage(0), "width is 0"),
        (lambda: mirage(delta=0.0), "delta is 0.0; it must be above 0 and below 1"),
        (lambda: mirage(delta=1.0), "delta is 1.0; it must be above 0 and below 1"),
        (lambda: mirage(gamma=2.0), "gamma is 2.0"),
        (lambda: roundabout(0), "depth is 0; it must be a whole number of at least 1"),
        (lambda: roundabout(gamma=1.0), "gamma is 1.0; with depth 1 nothing goes round there"),
        (lambda: roundabout(cost=5.0), "cost is 5.0; with depth 1 and gamma 0.9 it must be above 0.64"),
        (lambda: roundabout(cost=math.nan), "cost is nan"),
        (lambda: grid(0), "size is 0"),
        (lambda: grid(5), "trap 32 is not on the grid; states are 0 to 24"),
        (lambda: grid(goal=100), "goal 100 is not on the grid"),
        (lambda: grid(goal=12), "state 12 is both goal and trap"),
        (lambda: grid(slip=1.5), "slip is 1.5"),
        (lambda: deep_sea(0), "n is 0"),
        (lambda: corridor(slip=math.nan), "slip is nan"),
        (lambda: combination_lock(num_actions=1), "num_actions is 1"),
    ],
)
def test_a_zoo_mdp_that_cannot_exist_is_refused_with_the_value(make, message):
    with pytest.raises(PgtsError, match=message):
        make()


# Combination lock


def test_one_action_of_each_state_of_a_combination_lock_goes_on_and_all_others_go_back():
    mdp = combination_lock(6, 3, seed=4)
    onward = [next(a for a in range(3) if s == 5 or (1.0, s + 1) in [*successors(mdp, s, a)]) for s in range(6)]
    for s in range(5):
        assert [successors(mdp, s, a) for a in range(3) if a != onward[s]] == [[(1.0, 0)]] * 2
    assert list(rewards(mdp).values()) == [1.0]
    ((s, right),) = rewards(mdp)
    assert (s, float(mdp.outcomes.discount_NAK[s, right].max())) == (5, 0.0)
    assert len({tuple(map(tuple, rewards(combination_lock(9, 4, seed=seed)))) for seed in range(9)}) > 1


def test_a_combination_lock_is_worth_the_discount_of_its_length_and_by_chance_nearly_nothing():
    mdp = combination_lock()
    assert exact.optimal(mdp).J == pytest.approx(0.99**11)
    assert 0 < exact.evaluate(mdp, uniform_policy(mdp)).J < 100 * 4.0**-12


def successors(mdp: TabularMDP, s: int, a: int) -> list[tuple[float, int]]:
    """(probability, next state) of what may follow."""
    return sorted((p, child) for (child, _), p in outcomes_of(mdp, s, a).items())


# River swim


def test_river_swim_has_the_current_of_strehl_and_littman_and_the_rewards_of_osband_and_others():
    mdp = river_swim(6)
    assert [successors(mdp, s, LEFT) for s in range(6)] == [[(1.0, max(s - 1, 0))] for s in range(6)]
    assert [successors(mdp, s, RIGHT) for s in (0, 2, 5)] == [
        [(0.3, 1), (0.7, 0)],
        [(0.1, 1), (0.3, 3), (0.6, 2)],
        [(0.3, 5), (0.7, 4)],
    ]
    assert rewards(mdp) == {(0, LEFT): 0.005, (5, RIGHT): 1.0}


# Corridor


def test_a_step_in_the_corridor_slips_to_either_side_and_off_the_long_sides_one_is_back_at_the_start():
    mdp = corridor(3, 25)
    assert (mdp.start_S.argmax(), mdp.shape) == (25, (3, 25))
    assert successors(mdp, 25 + 7, RIGHT) == [(0.1, 7), (0.1, 57), (0.8, 33)]
    assert successors(mdp, 7, RIGHT) == [(0.1, 25), (0.1, 32), (0.8, 8)]
    assert successors(mdp, 7, UP) == [(0.1, 6), (0.1, 8), (0.8, 25)]
    assert successors(mdp, 25, LEFT) == [(0.1, 0), (0.1, 50), (0.8, 25)]
    assert successors(mdp, 25 + 23, RIGHT) == [(0.1, 23), (0.1, 73), (0.8, 49)]
    assert float(mdp.outcomes.discount_NAK[48, RIGHT].min()) == 0.0


def test_a_corridor_pays_at_its_end_alone():
    reward_SA = corridor(3, 5).outcomes.reward_NA.view(3, 5, 4)
    assert not reward_SA[:, :3].any()
    torch.testing.assert_close(reward_SA[:, 3], torch.tensor([[0.0, 0.8, 0.1, 0.1]] * 3, dtype=torch.float64))
