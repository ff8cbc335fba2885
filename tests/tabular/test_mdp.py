"""How tabular MDPs are made, and what is refused."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.tabular import TabularMDP, exact
from tests.support import always, outcomes_of, random_policy, uniform_policy, weights, zoo

TOY_TEXT = ["FrozenLake-v1", "CliffWalking-v1", "Taxi-v4"]


def raw_optimal_values(P: dict, gamma: float, sweeps: int) -> np.ndarray:
    """v* by value iteration on the environment's own table, one number at a time."""
    v = np.zeros(len(P))
    for _ in range(sweeps):
        v = np.array(
            [
                max(sum(p * (r + gamma * v[t] * (not done)) for p, t, r, done in row) for row in P[s].values())
                for s in range(len(P))
            ]
        )
    return v


def ended_states(P: dict) -> list[int]:
    return sorted({int(t) for rows in P.values() for row in rows.values() for _, t, _, done in row if done})


def visited_states(P: dict, start_S: np.ndarray) -> list[int]:
    """States that an episode can be in before it ends."""
    found = frontier = set(np.flatnonzero(start_S).tolist())
    while frontier:
        frontier = {int(t) for s in frontier for row in P[s].values() for p, t, _, done in row if p and not done}
        frontier, found = frontier - found, found | frontier
    return sorted(found)


# From dense arrays


def test_a_dense_mdp_holds_the_given_arrays():
    random = np.random.default_rng(0)
    P, R = random.dirichlet(np.ones(4), size=(4, 3)), random.normal(size=(4, 3))
    P[0, 0], P[2, 1] = [0, 0, 1, 0], [0.5, 0, 0, 0.5]
    mdp = TabularMDP.from_dense(P, R, 0.8, start=[0.25, 0.75, 0, 0])
    np.testing.assert_allclose(weights(mdp), 0.8 * P, rtol=1e-15)
    assert np.array_equal(mdp.outcomes.reward_NA, R)
    assert mdp.start_S.tolist() == [0.25, 0.75, 0, 0]


def test_a_dense_mdp_keeps_only_successors_with_positive_probability():
    P = np.zeros((5, 1, 5))
    P[np.arange(5), 0, [3, 0, 1, 4, 2]] = 1
    mdp = TabularMDP.from_dense(P, np.zeros((5, 1)), 0.9)
    assert mdp.outcomes.num_outcomes == 1
    assert mdp.outcomes.child_NAK.flatten().tolist() == [3, 0, 1, 4, 2]


def test_the_mdp_does_not_share_memory_with_the_arrays_it_was_made_from():
    P, R, start = np.ones((1, 1, 1)), np.zeros((1, 1)), np.ones(1)
    mdp = TabularMDP.from_dense(P, R, 0.9, start=start)
    P[:], R[:], start[:] = 7, 7, 7
    assert mdp.outcomes.prob_NAK.item() == 1
    assert mdp.outcomes.reward_NA.item() == 0
    assert mdp.start_S.item() == 1


def test_the_start_is_a_state_a_distribution_or_uniform():
    def start_of(start: object) -> list[float]:
        return TabularMDP.from_dense(np.eye(4)[:, None], np.zeros((4, 1)), 0.9, start=start).start_S.tolist()

    assert start_of(None) == [0.25] * 4
    assert start_of(2) == start_of(np.int64(2)) == [0, 0, 1, 0]
    assert start_of([0.5, 0.5, 0, 0]) == [0.5, 0.5, 0, 0]


def test_names_and_shape_have_defaults():
    mdp = TabularMDP.from_dense(np.ones((3, 2, 3)) / 3, np.zeros((3, 2)), 0.9)
    assert mdp.action_names == ("0", "1")
    assert mdp.shape == (1, 3)


# From lists of transitions


def test_a_terminated_transition_has_discount_0_and_the_rest_have_gamma():
    P = [[[(0.5, 0, 1.0, False), (0.25, 1, 2.0, True), (0.25, 1, 4.0, False)]], [[(1.0, 0, 0.0, False)]]]
    mdp = TabularMDP.from_transitions(P, 0.9, start=0)
    assert outcomes_of(mdp, 0, 0) == {(0, 0.9): 0.5, (1, 0.0): 0.25, (1, 0.9): 0.25}
    assert mdp.outcomes.reward_NA[0, 0] == 0.5 * 1 + 0.25 * 2 + 0.25 * 4


def test_a_successor_that_is_listed_twice_is_counted_twice():
    P = [[[(1 / 3, 0, 0.0, False), (1 / 3, 1, 6.0, False), (1 / 3, 0, 3.0, False)]], [[(1.0, 1, 0.0, False)]]]
    mdp = TabularMDP.from_transitions(P, 0.9, start=0)
    assert outcomes_of(mdp, 0, 0) == pytest.approx({(0, 0.9): 2 / 3, (1, 0.9): 1 / 3})
    assert mdp.outcomes.reward_NA[0, 0] == pytest.approx(3.0)


def test_outcomes_that_pay_differently_are_kept_apart_and_have_the_expected_reward_as_their_mean():
    P = [
        [[(0.5, 1, 1.0, False), (0.25, 1, 3.0, False), (0.125, 1, 1.0, False), (0.125, 0, 8.0, True)]],
        [[(1, 1, 2.0, False)]],
    ]
    mdp = TabularMDP.from_transitions(P, 0.9, start=0)
    paid = zip(mdp.outcomes.prob_NAK[0, 0].tolist(), mdp.outcome_reward_SAK[0, 0].tolist(), strict=True)
    assert list(paid) == [(0.625, 1.0), (0.25, 3.0), (0.125, 8.0)]
    assert mdp.outcomes.reward_NA[0, 0] == 0.625 + 0.75 + 1.0
    assert mdp.outcome_reward_SAK[1, 0, 0] == 2.0


def test_where_every_outcome_pays_the_same_no_rewards_of_outcomes_are_kept():
    mdp = zoo("Taxi")
    assert mdp.reward_SAK is None
    assert (mdp.outcome_reward_SAK == mdp.outcomes.reward_NA[..., None]).all()


@pytest.mark.usefixtures("unchecked_shapes")
def test_rewards_of_outcomes_with_another_mean_are_refused():
    mdp = zoo("FrozenLake")
    with pytest.raises(PgtsError, match=r"reward_SAK\[14, 1\] has the mean 0\.33.*reward_NA must be the same"):
        replace(mdp, outcomes=replace(mdp.outcomes, reward_NA=-mdp.outcomes.reward_NA))
    with pytest.raises(PgtsError, match=r"must be torch.float64 with shape \(16, 4, 3\)"):
        replace(mdp, reward_SAK=mdp.outcomes.reward_NA)


def test_the_transitions_of_slippery_cliff_walking_are_those_of_its_table_with_their_rewards():
    env = gymnasium.make("CliffWalking-v1", is_slippery=True)
    mdp = TabularMDP.from_gymnasium(env, 0.9)
    table = env.unwrapped.P
    for s, a in [(36, 0), (24, 2), (30, 2)]:
        listed: dict[tuple[int, float], float] = {}
        for p, child, reward, _ in table[s][a]:
            listed[child, reward] = listed.get((child, reward), 0) + p
        prob, rewards = mdp.outcomes.prob_NAK[s, a], mdp.outcome_reward_SAK[s, a]
        kept = {
            (int(c), float(r)): float(p)
            for p, c, r in zip(prob, mdp.outcomes.child_NAK[s, a], rewards, strict=True)
            if p
        }
        assert kept == pytest.approx(listed)
        assert len(kept) == 3


def test_transitions_of_probability_0_are_left_out():
    P = [[[(1.0, 0, 1.0, False), (0.0, 1, 99.0, True)]], [[(1.0, 1, 0.0, False)]]]
    mdp = TabularMDP.from_transitions(P, 0.9, start=0)
    assert mdp.outcomes.num_outcomes == 1
    assert mdp.outcomes.reward_NA[0, 0] == 1


def test_nothing_is_earned_from_a_state_that_is_only_entered_by_terminated_transitions():
    P = [[[(1.0, 1, 1.0, True)]], [[(1.0, 1, 5.0, False)]]]
    one = torch.ones(2, 1, dtype=torch.float64)
    assert exact.evaluate(TabularMDP.from_transitions(P, 0.9, start=0), one).v_S.tolist() == [1, 0]
    alive = exact.evaluate(TabularMDP.from_transitions(P, 0.9, start=1), one)
    assert alive.v_S.tolist() == pytest.approx([1, 50])


# From Gymnasium


@pytest.mark.parametrize("name", TOY_TEXT)
def test_the_optimum_equals_value_iteration_on_the_table_of_the_environment(name):
    env = gymnasium.make(name)
    mdp = TabularMDP.from_gymnasium(env, 0.5)
    P = env.unwrapped.P
    visited = visited_states(P, env.unwrapped.initial_state_distrib)
    v_S, raw = exact.optimal(mdp).v_S.numpy(), raw_optimal_values(P, 0.5, sweeps=40)
    np.testing.assert_allclose(v_S[visited], raw[visited], atol=20 * 0.5**40)  # |v*| <= 20 everywhere


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("name", ["CliffWalking-v1", "Taxi-v4"])
def test_ignoring_the_terminated_flag_gives_other_values(name):
    env = gymnasium.make(name)
    P = env.unwrapped.P
    unflagged = {s: {a: [(p, t, r, False) for p, t, r, _ in row] for a, row in rows.items()} for s, rows in P.items()}
    start = env.unwrapped.initial_state_distrib
    honoured = exact.optimal(TabularMDP.from_gymnasium(env, 0.8)).J
    assert abs(exact.optimal(TabularMDP.from_transitions(unflagged, 0.8, start=start)).J - honoured) > 0.1


@pytest.mark.parametrize("name", TOY_TEXT)
def test_a_terminal_state_is_worth_exactly_0_under_every_policy(name):
    env = gymnasium.make(name)
    mdp = TabularMDP.from_gymnasium(env, 0.9)
    ended = ended_states(env.unwrapped.P)
    assert ended
    for pi_SA in (uniform_policy(mdp), random_policy(mdp), always(mdp, 0)):
        evaluation = exact.evaluate(mdp, pi_SA)
        assert torch.all(evaluation.v_S[ended] == 0)
        assert torch.all(evaluation.q_SA[ended] == 0)


@pytest.mark.parametrize("gamma", [0.5, 0.9, 0.99, 1.0])
def test_the_best_walk_along_the_cliff_takes_13_steps(gamma):
    mdp = TabularMDP.from_gymnasium(gymnasium.make("CliffWalking-v1"), gamma)
    assert mdp.start_S.argmax() == 36
    assert exact.optimal(mdp).J == pytest.approx(-sum(gamma**k for k in range(13)), rel=1e-12)


def test_the_optimum_of_frozen_lake_is_14_of_17_without_a_time_limit():
    mdp = TabularMDP.from_gymnasium(gymnasium.make("FrozenLake-v1"), 1.0)
    assert exact.optimal(mdp).J == pytest.approx(14 / 17, rel=1e-12)
    within_100_steps = exact.lookahead(mdp, torch.zeros(16, 4, dtype=torch.float64), 100)
    assert within_100_steps[0].max() == pytest.approx(0.7442, abs=5e-5)


def test_a_taxi_picks_up_and_sets_down():
    # The passenger waits beside the taxi at R and wants to G; a wall forces the way through row 2: down, right and up.
    env = gymnasium.make("Taxi-v4")
    start = env.unwrapped.encode(0, 0, 0, 1)
    optimum = exact.optimal(TabularMDP.from_gymnasium(env, 1.0, start=start))
    moves = 2 + 4 + 2
    assert optimum.J == pytest.approx(-1 - moves + 20, rel=1e-12)


def test_gymnasium_gives_the_start_and_the_picture():
    mdp = zoo("CliffWalking")
    assert mdp.shape == (4, 12)
    assert zoo("FrozenLake").shape == (4, 4)
    assert zoo("Taxi").start_S.count_nonzero() == 300
    assert TabularMDP.from_gymnasium(gymnasium.make("FrozenLake-v1"), 0.9, start=3).start_S.argmax() == 3


def test_an_environment_without_a_table_is_refused():
    with pytest.raises(MissingModel, match="CartPole"):
        TabularMDP.from_gymnasium(gymnasium.make("CartPole-v1"), 0.9)


# What is refused, and with which words


def a_valid_table(S: int = 3, A: int = 2, K: int = 2) -> dict[str, torch.Tensor]:
    return {
        "reward_NA": torch.zeros(S, A, dtype=torch.float64),
        "prob_NAK": torch.full((S, A, K), 1 / max(K, 1), dtype=torch.float64),
        "discount_NAK": torch.full((S, A, K), 0.9, dtype=torch.float64),
        "child_NAK": torch.zeros(S, A, K, dtype=torch.int64),
    }


def mdp_of(table: dict[str, torch.Tensor], num_children: int = 3, **more: object) -> TabularMDP:
    return TabularMDP(Outcomes(**table, num_children=num_children), **{"start_S": torch.ones(3).double() / 3, **more})


def test_a_valid_table_is_accepted():
    assert mdp_of(a_valid_table()).num_states == 3


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("prob_NAK", 0.4, r"P_SAS\[1, 1\] is not a distribution: it sums to 0.9"),
        ("prob_NAK", -0.5, r"P_SAS\[1, 1\] has probabilities \[-0.5, 0.5\]"),
        ("prob_NAK", float("nan"), r"P_SAS\[1, 1\] has probabilities \[nan, 0.5\]"),
        ("prob_NAK", 1.5, r"P_SAS\[1, 1\] has probabilities \[1.5, 0.5\]"),
        ("reward_NA", float("nan"), r"R_SA\[1, 1\] is nan"),
        ("reward_NA", float("inf"), r"R_SA\[1, 1\] is inf"),
        ("discount_NAK", 1.01, r"discount_NAK\[1, 1\] is \[1.01, 0.9\]"),
        ("discount_NAK", -0.1, r"discount_NAK\[1, 1\] is \[-0.1, 0.9\]"),
        ("discount_NAK", float("nan"), r"discount_NAK\[1, 1\] is \[nan, 0.9\]"),
        ("child_NAK", 3, r"child_NAK\[1, 1\] is \[3, 0\]; states are 0 to 2"),
        ("child_NAK", -1, r"child_NAK\[1, 1\] is \[-1, 0\]; states are 0 to 2"),
    ],
)
def test_a_bad_table_is_refused_with_its_first_bad_state_and_action(field, value, message):
    table = a_valid_table()
    for s, a in [(2, 0), (1, 1)]:
        table[field][s, a].view(-1)[0] = value
    with pytest.raises(PgtsError, match=message):
        mdp_of(table)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"reward_NA": torch.zeros(2, 2).double()}, r"reward_NA has shape \(2, 2\); child_NAK needs \(3, 2\)"),
        ({"prob_NAK": torch.ones(3, 2, 1).double()}, r"prob_NAK has shape \(3, 2, 1\)"),
        ({"discount_NAK": torch.ones(3, 2).double()}, r"discount_NAK has shape \(3, 2\)"),
        ({"child_NAK": torch.zeros(3, 2, dtype=torch.int64)}, r"child_NAK has shape \(3, 2\); it must have three axes"),
        ({"prob_NAK": torch.ones(3, 2, 2)}, "prob_NAK is torch.float32; the exact world is float64"),
        (a_valid_table(0, 2, 2), "each side must be at least 1"),
        (a_valid_table(3, 0, 2), "each side must be at least 1"),
        (a_valid_table(3, 2, 0), "each side must be at least 1"),
    ],
)
def test_a_table_of_another_shape_or_dtype_is_refused_by_name(changed, message):
    with pytest.raises(PgtsError, match=message):
        mdp_of(a_valid_table() | changed)


def test_a_table_P_of_numpy_scalars_is_that_of_plain_numbers():
    plain = {0: {0: [(0.25, 1, 0.5, False), (0.75, 0, -2.0, False)]}, 1: {0: [(1.0, 1, 1e30, True)]}}
    numpy = {
        np.int64(s): {np.int8(a): [(np.float32(p), np.int32(n), np.float32(r), np.bool_(end)) for p, n, r, end in rows]}
        for s, actions in plain.items()
        for a, rows in actions.items()
    }
    numpy[1][0] = plain[1][0]  # 1e30 is no float32
    mdp, same = (TabularMDP.from_transitions(P, 0.5) for P in (plain, numpy))
    assert torch.equal(mdp.outcomes.reward_NA, same.outcomes.reward_NA)
    assert np.array_equal(weights(mdp), weights(same))
    numpy[1][0] = [(1.0, 1, np.float32("inf"), True)]
    with pytest.raises(PgtsError, match=r"P\[1\]\[0\] has reward inf; rewards must be finite"):
        TabularMDP.from_transitions(numpy, 0.5)


def test_outcomes_that_point_into_another_table_are_refused():
    with pytest.raises(PgtsError, match="outcomes point into 4 states; the MDP has 3"):
        mdp_of(a_valid_table(), num_children=4)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ([0.5, 0.5], r"start_S has shape \(2,\); the MDP needs \(3,\)"),
        ([0.5, 0.6, 0.0], "start_S is not a distribution: it sums to 1.1"),
        ([0.5, -0.5, 1.0], r"start_S\[1\] is -0.5"),
        ([0.5, 0.5, float("nan")], r"start_S\[2\] is nan"),
    ],
)
def test_a_bad_start_distribution_is_refused(start, message):
    with pytest.raises(PgtsError, match=message):
        mdp_of(a_valid_table(), start_S=torch.tensor(start, dtype=torch.float64))


@pytest.mark.parametrize("start", [-1, 3])
def test_a_start_state_that_does_not_exist_is_refused(start):
    with pytest.raises(PgtsError, match=rf"start state {start} does not exist; states are 0 to 2"):
        TabularMDP.from_dense(np.ones((3, 1, 3)) / 3, np.zeros((3, 1)), 0.9, start=start)


@pytest.mark.parametrize("gamma", [-0.1, 1.1, float("nan"), float("inf")])
def test_a_gamma_outside_0_to_1_is_refused(gamma):
    with pytest.raises(PgtsError, match=rf"gamma is {gamma}; it must be in \[0, 1\]"):
        TabularMDP.from_dense(np.ones((1, 1, 1)), np.zeros((1, 1)), gamma)
    with pytest.raises(PgtsError, match=rf"gamma is {gamma}; it must be in \[0, 1\]"):
        TabularMDP.from_transitions([[[(1.0, 0, 0.0, False)]]], gamma)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ([(1.0, 2, 0.0, False)], r"P\[1\]\[0\] leads to state 2; states are 0 to 1"),
        ([(1.0, -1, 0.0, False)], r"P\[1\]\[0\] leads to state -1"),
        ([(-0.5, 0, 0.0, False), (1.5, 1, 0.0, False)], r"P\[1\]\[0\] has probability -0.5"),
        ([(float("nan"), 0, 0.0, False)], r"P\[1\]\[0\] has probability nan"),
        ([], r"P\[1\]\[0\] has no outcome"),
        ([(0.0, 0, 0.0, False)], r"P\[1\]\[0\] has no outcome"),
        ([(0.9, 0, 0.0, False)], r"P_SAS\[1, 0\] is not a distribution: it sums to 0.9"),
        ([(1.0, 0, float("inf"), False)], r"P\[1\]\[0\] has reward inf"),
    ],
)
def test_bad_transitions_are_refused_with_their_state_and_action(row, message):
    fine = [(1.0, 0, 0.0, False)]
    with pytest.raises(PgtsError, match=message):
        TabularMDP.from_transitions([[fine, fine], [row, fine]], 0.9)


def test_a_state_with_another_number_of_actions_is_refused():
    fine = [(1.0, 0, 0.0, False)]
    with pytest.raises(PgtsError, match=r"P\[1\] has 1 actions; P\[0\] has 2"):
        TabularMDP.from_transitions([[fine, fine], [fine]], 0.9)


@pytest.mark.parametrize("P", [[], {}, [[]], {0: {}}])
def test_an_empty_list_of_transitions_is_refused(P):
    with pytest.raises(PgtsError, match="P is empty"):
        TabularMDP.from_transitions(P, 0.9)


def test_action_names_and_shape_must_fit():
    with pytest.raises(PgtsError, match="3 action names for 2 actions"):
        mdp_of(a_valid_table(), action_names=("a", "b", "c"))
    with pytest.raises(PgtsError, match=r"shape \(2, 2\) does not hold 3 states"):
        mdp_of(a_valid_table(), shape=(2, 2))
