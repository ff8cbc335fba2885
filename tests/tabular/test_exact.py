"""The exact theory: closed forms, second routes, theorems."""

import itertools
from collections import Counter
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.errors import PgtsError
from pgts_torch.seeding import numpy_stream, stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, improvement, ladder, random_mdp, tightrope
from tests.support import (
    ZOO,
    always,
    mdps,
    mdps_with_policy,
    random_policy,
    rewarded,
    tree_lookahead,
    uniform_policy,
    weights,
    zoo,
)

LEFT, RIGHT = 0, 1


def some_q(mdp: TabularMDP, seed: int = 0) -> Tensor:
    return torch.randn(mdp.num_states, mdp.num_actions, dtype=torch.float64, generator=stream(seed, "some_q"))


def assert_close(actual: object, expected: object, tolerance: float = 1e-11) -> None:
    expected = torch.as_tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(torch.as_tensor(actual, dtype=torch.float64), expected, rtol=tolerance, atol=tolerance)


def differs(a: Tensor, b: Tensor, least: float = 1e-6) -> bool:
    return bool((a - b).abs().max() > least)


# Closed forms


@pytest.mark.parametrize(("n", "gamma"), [(1, 0.9), (2, 0.5), (5, 0.9), (9, 0.99)])
def test_the_ladder_is_worth_gamma_to_the_n_minus_1_over_1_minus_gamma(n, gamma):
    mdp = ladder(n, gamma=gamma)
    J = gamma ** (n - 1) / (1 - gamma)
    assert exact.optimal(mdp).J == pytest.approx(J, rel=1e-12)
    assert exact.evaluate(mdp, always(mdp, RIGHT)).J == pytest.approx(J, rel=1e-12)
    assert exact.evaluate(mdp, always(mdp, LEFT)).J == 0


@pytest.mark.parametrize("gamma", [0.5, 0.9])
def test_the_tightrope_is_worth_gamma_squared_over_1_minus_gamma(gamma):
    mdp = tightrope(gamma=gamma)
    assert exact.optimal(mdp).J == pytest.approx(gamma**2 / (1 - gamma), rel=1e-12)
    falls = exact.evaluate(mdp, always(mdp, LEFT)).v_S
    assert_close(falls, [0, -10 * gamma / (1 - gamma), 1 / (1 - gamma), -10 / (1 - gamma)])


@pytest.mark.parametrize("name", ["ladder", "tightrope", "random, dense", "garnet", "grid"])
def test_the_occupancy_sums_to_1_over_1_minus_gamma(name):
    mdp = zoo(name)
    assert exact.occupancy(mdp, random_policy(mdp)).sum().item() == pytest.approx(1 / (1 - 0.9), rel=1e-12)


def test_the_occupancy_of_a_straight_walk_is_gamma_to_the_step():
    mdp = ladder(4, gamma=0.5)
    assert_close(exact.occupancy(mdp, always(mdp, RIGHT)), [1, 0.5, 0.25, 0.125 / (1 - 0.5)])


@given(mdps_with_policy())
def test_the_return_is_the_occupancy_times_the_rewards(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    evaluation = exact.evaluate(mdp, pi_SA)
    assert_close(evaluation.d_S @ (pi_SA * mdp.outcomes.reward_NA).sum(-1), evaluation.J)


@given(mdps_with_policy())
def test_v_is_the_mean_of_q_and_q_is_one_step_above_v(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    evaluation = exact.evaluate(mdp, pi_SA)
    assert_close(evaluation.v_S, (pi_SA * evaluation.q_SA).sum(-1))
    one_step = mdp.outcomes.reward_NA.numpy() + weights(mdp) @ evaluation.v_S.numpy()
    assert_close(evaluation.q_SA, one_step)


# Evaluation by second routes


@pytest.mark.parametrize("name", ZOO)
def test_policy_values_are_the_limit_of_policy_iteration_sweeps(name):
    mdp = zoo(name)
    pi_SA = random_policy(mdp)
    v_S = torch.zeros(mdp.num_states, dtype=torch.float64)
    W, r_S = mdp.outcomes.weight, (pi_SA * mdp.outcomes.reward_NA).sum(-1)
    for _ in range(3000):  # 0.99 ** 3000 < 1e-13
        v_S = r_S + (pi_SA * torch.mv(W, v_S).view(pi_SA.shape)).sum(-1)
    assert_close(exact.policy_values(mdp, pi_SA), v_S, 1e-9)


def simulated_occupancy(mdp: TabularMDP, pi_SA: Tensor, episodes: int, steps: int, seed: int) -> np.ndarray:
    """[episodes, S]: discounted visits to each state, a sum whose mean over episodes is the occupancy."""
    random = numpy_stream(seed, "simulated_occupancy")

    def pick(rows: np.ndarray) -> np.ndarray:
        return (rows.cumsum(-1) < random.random((len(rows), 1))).sum(-1).clip(max=rows.shape[-1] - 1)

    outcomes, each = mdp.outcomes, np.arange(episodes)
    prob, discount, child = (x.numpy() for x in (outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK))
    s, weight = pick(mdp.start_S.numpy()[None].repeat(episodes, 0)), np.ones(episodes)
    visits = np.zeros((episodes, mdp.num_states))
    for _ in range(steps):
        visits[each, s] += weight
        a = pick(pi_SA.numpy()[s])
        k = pick(prob[s, a])
        weight = weight * discount[s, a, k]
        s = child[s, a, k]
    return visits


@pytest.mark.parametrize("name", ["ladder", "garnet", "deep_sea"])
def test_the_occupancy_lies_in_the_confidence_region_of_simulated_visits(name):
    # Each state within 5.5 standard errors: all of at most 36 states, with an error probability below 2e-6.
    mdp = zoo(name)
    pi_SA = random_policy(mdp)
    visits = simulated_occupancy(mdp, pi_SA, episodes=4000, steps=150, seed=0)  # 0.9 ** 150 / 0.1 < 2e-6 is cut off
    error = 5.5 * visits.std(0) / np.sqrt(len(visits)) + 2e-6
    assert np.all(np.abs(exact.occupancy(mdp, pi_SA).numpy() - visits.mean(0)) < error)
    other_policy = exact.occupancy(mdp, random_policy(mdp, seed=1)).numpy()
    assert np.any(np.abs(other_policy - visits.mean(0)) > error)


@pytest.mark.parametrize("name", ZOO)
def test_the_sparse_solver_agrees_with_the_dense_one_both_ways(name, monkeypatch):
    mdp = zoo(name)
    pi_SA = random_policy(mdp)
    dense, optimum = exact.evaluate(mdp, pi_SA), exact.optimal(mdp)
    monkeypatch.setattr(exact, "DENSE_LIMIT", 0)
    sparse = exact.evaluate(mdp, pi_SA)
    assert_close(sparse.v_S, dense.v_S, 1e-9)
    assert_close(sparse.d_S, dense.d_S, 1e-9)
    assert_close(exact.optimal(mdp).J, optimum.J, 1e-9)
    assert torch.equal(sparse.d_S == 0, dense.d_S == 0)
    assert differs(sparse.d_S, exact.occupancy(mdp, uniform_policy(mdp)))


def test_the_sparse_solver_is_the_one_that_large_mdps_use_and_reports_that_it_did_not_converge(monkeypatch):
    mdp = zoo("garnet")
    monkeypatch.setattr(exact, "SOLVE_TOLERANCE", 0.0)
    monkeypatch.setattr(exact, "DENSE_LIMIT", mdp.num_states)
    exact.evaluate(mdp, random_policy(mdp))
    monkeypatch.setattr(exact, "DENSE_LIMIT", mdp.num_states - 1)
    with pytest.raises(PgtsError, match="the iterative solve of 30 states stopped at a residual"):
        exact.evaluate(mdp, random_policy(mdp))


# Support


@pytest.mark.parametrize("limit", [0, 1500])
def test_a_state_that_is_visited_very_rarely_is_in_the_support(limit, monkeypatch):
    monkeypatch.setattr(exact, "DENSE_LIMIT", limit)
    mdp = ladder(40, gamma=0.9)
    pi_SA = torch.tensor([1 - 1e-6, 1e-6], dtype=torch.float64).repeat(40, 1)  # the top has occupancy 1e-236
    assert torch.all(exact.occupancy(mdp, pi_SA) > 0)
    assert exact.support(mdp, pi_SA).all()


def test_states_that_the_policy_never_reaches_are_not_in_the_support():
    mdp, pi_SA = ladder(5, start=1), always(ladder(5), LEFT)
    assert exact.support(mdp, pi_SA).tolist() == [True, True, False, False, False]
    assert (exact.occupancy(mdp, pi_SA) == 0).tolist() == [False, False, True, True, True]
    assert exact.support(mdp, uniform_policy(mdp)).all()


def test_nothing_beyond_the_end_of_an_episode_is_in_the_support():
    mdp = TabularMDP.from_transitions([[[(1.0, 1, 1.0, True)]], [[(1.0, 1, 0.0, False)]]], 0.9, start=0)
    one = torch.ones(2, 1, dtype=torch.float64)
    assert exact.evaluate(mdp, one).d_S.tolist() == [1, 0]


@given(mdps_with_policy())
def test_the_support_is_where_the_occupancy_is_positive(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    pi_SA = (pi_SA * (pi_SA > 0.4)) / (pi_SA * (pi_SA > 0.4)).sum(-1, keepdim=True)
    pi_SA = torch.where(pi_SA.isnan(), 1 / mdp.num_actions, pi_SA)
    power, reach = mdp.start_S.numpy() > 0, np.einsum("sa,sat->st", pi_SA.numpy(), weights(mdp)) > 0
    for _ in range(mdp.num_states):
        power = power | (power @ reach)
    assert np.array_equal(exact.support(mdp, pi_SA).numpy(), power)
    assert np.array_equal(exact.occupancy(mdp, pi_SA).numpy() > 0, power)


# The optimum


@given(mdps(max_states=4, max_actions=3))
def test_the_optimum_is_the_best_of_all_deterministic_policies_in_every_state(mdp):
    identity = np.eye(mdp.num_actions)
    W, R, S = weights(mdp), mdp.outcomes.reward_NA.numpy(), mdp.num_states
    values = []
    for actions in itertools.product(range(mdp.num_actions), repeat=S):
        pi = identity[list(actions)]
        P_S = np.einsum("sa,sat->st", pi, W)
        values.append(np.linalg.solve(np.eye(S) - P_S, (pi * R).sum(-1)))
    optimum = exact.optimal(mdp)
    assert_close(optimum.v_S, np.max(values, axis=0), 1e-9)
    assert_close(optimum.J, max(mdp.start_S.numpy() @ v for v in values), 1e-9)


@pytest.mark.parametrize("name", ZOO)
def test_the_optimum_is_the_fixed_point_of_t_and_its_policy_attains_it(name):
    mdp = zoo(name)
    optimum = exact.optimal(mdp)
    assert_close(exact.bellman(mdp, optimum.q_SA), optimum.q_SA, 1e-9)
    attained = exact.evaluate(mdp, optimum.pi_SA)
    assert_close(attained.v_S, optimum.v_S)
    assert attained.J == pytest.approx(optimum.J)
    assert exact.evaluate(mdp, random_policy(mdp)).J < optimum.J
    assert optimum.pi_SA.sum(-1).tolist() == [1] * mdp.num_states


WAYS = {"compiled": 1, "torch": 10**12}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("share", [1e-2, 1e-5, 1e-9])
@pytest.mark.parametrize("name", ["ladder", "tightrope", "garnet", "grid", "deep_sea", "random, dense"])
def test_within_a_tolerance_values_are_so_near_to_the_optimum_and_the_policy_loses_at_most_twice_as_much(
    name, share, unit, way, monkeypatch
):
    monkeypatch.setattr("pgts_torch.bellman.COMPILED_FROM", WAYS[way])
    monkeypatch.setattr("pgts_torch.bellman._KERNELS", "as if not loaded")
    mdp = rewarded(zoo(name), factor=unit)
    truth = exact.optimal(mdp)
    tolerance = share * float(truth.v_S.abs().max())
    near = exact.optimal(mdp, tolerance)
    slack = 1e-11 * float(truth.q_SA.abs().max())  # of the truth
    assert (near.v_S - truth.v_S).abs().max() <= tolerance + slack
    assert (near.q_SA - truth.q_SA).abs().max() <= tolerance + slack
    assert abs(near.J - truth.J) <= tolerance + slack
    assert (truth.v_S - exact.policy_values(mdp, near.pi_SA)).max() <= 2 * tolerance + slack


@given(mdps(), st.floats(1e-6, 1.0), st.floats(-5, 5))
def test_the_tolerance_holds_with_ends_many_discounts_and_rewards_of_any_sign(mdp, tolerance, constant):
    mdp = rewarded(mdp, constant=constant)
    if improvement.total_weights(mdp.outcomes)[1] >= 0.999:
        return
    truth, near = exact.optimal(mdp), exact.optimal(mdp, tolerance)
    assert (near.v_S - truth.v_S).abs().max() <= tolerance + 1e-9
    assert (truth.v_S - exact.policy_values(mdp, near.pi_SA)).max() <= 2 * tolerance + 1e-9


def test_the_error_that_is_proved_is_not_far_above_the_true_one_and_less_sweeping_would_miss_it():
    mdp = random_mdp(40, 3, branching=2, seed=3, gamma=0.99)
    truth = exact.optimal(mdp).v_S
    found = [improvement.improve(mdp.outcomes, error=error) for error in (1.0, 1e-3, 1e-6)]
    off = [float((each.v_S - truth).abs().max()) for each in found]
    assert all(true <= each.error for true, each in zip(off, found, strict=True))
    assert off[0] > 1e-6  # what the loosest has not reached


def test_a_tolerance_that_float64_cannot_prove_is_refused_with_one_that_it_can():
    mdp = zoo("garnet")
    with pytest.raises(PgtsError, match=r"tolerance is 1e-16; what float64 proves for this MDP is \d\.\de-1\d: choose"):
        exact.optimal(mdp, 1e-16)
    assert exact.optimal(mdp, 1e-11).J == pytest.approx(exact.optimal(mdp).J, abs=1e-11)
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(PgtsError, match="tolerance is"):
            exact.optimal(mdp, bad)


def test_a_tolerance_is_refused_where_an_action_does_not_discount():
    with pytest.raises(PgtsError, match="a tolerance is proved only where every action discounts"):
        exact.optimal(deep_sea(4, gamma=1.0), 1e-3)


def test_a_large_mdp_is_solved_to_rounding_from_what_modified_policy_iteration_finds():
    mdp = random_mdp(exact.DENSE_LIMIT + 500, 3, branching=4, seed=2, gamma=0.97)
    optimum = exact.optimal(mdp)
    assert_close(exact.bellman(mdp, optimum.q_SA), optimum.q_SA, 1e-10)
    solves = Counter()
    patched = partial(solved, solves, exact._solve_iterative)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exact, "_solve_iterative", patched)
        exact.optimal(mdp)
    assert solves["solves"] == 1  # policy iteration from the best rewards takes several


def solved(solves: Counter, solve: Callable, *arguments: object) -> np.ndarray:
    solves["solves"] += 1
    return solve(*arguments)


# Lookahead


@pytest.mark.parametrize("depth", range(7))
@pytest.mark.parametrize(
    "mdp",
    [ladder(4), tightrope(), random_mdp(3, 2, branching=2, seed=5), random_mdp(2, 3, branching=1, seed=1)],
    ids=["ladder", "tightrope", "two successors", "three actions"],
)
def test_lookahead_equals_the_walk_over_all_paths(mdp, depth):
    q_SA = some_q(mdp)
    expected = tree_lookahead(mdp, q_SA, depth)
    assert_close(exact.lookahead(mdp, q_SA, depth), expected, 1e-12)
    assert differs(exact.lookahead(mdp, q_SA, depth + 1), expected)


@given(mdps(), st.integers(0, 3))
def test_lookahead_with_ends_and_many_discounts_equals_the_walk_over_all_paths(mdp, depth):
    q_SA = some_q(mdp)
    assert_close(exact.lookahead(mdp, q_SA, depth), tree_lookahead(mdp, q_SA, depth), 1e-12)


def h_pmd_values(mdp: TabularMDP, v: np.ndarray, h: int) -> np.ndarray:
    """Q_h(s, a) = r(s, a) + gamma sum_s' P(s'|s, a) (T^(h-1) v)(s'), as in policy mirror descent with lookahead."""
    W, R = weights(mdp), mdp.outcomes.reward_NA.numpy()
    for _ in range(h - 1):
        v = (R + W @ v).max(-1)
    return R + W @ v


@pytest.mark.parametrize("depth", range(6))
@pytest.mark.parametrize("name", ["ladder", "garnet", "FrozenLake", "grid"])
def test_lookahead_at_depth_m_is_q_h_of_h_pmd_with_h_one_more(name, depth):
    mdp = zoo(name)
    evaluation = exact.evaluate(mdp, uniform_policy(mdp))
    look_SA, v = exact.lookahead(mdp, evaluation.q_SA, depth), evaluation.v_S.numpy()
    assert_close(look_SA, h_pmd_values(mdp, v, h=depth + 1))
    assert differs(look_SA, torch.from_numpy(h_pmd_values(mdp, v, h=depth + 2)))


def test_depth_0_is_the_identity():
    q_SA = some_q(zoo("garnet"))
    assert torch.equal(exact.lookahead(zoo("garnet"), q_SA, 0), q_SA)


def test_deep_lookahead_ends_at_the_optimum():
    mdp = zoo("garnet")
    assert_close(exact.lookahead(mdp, some_q(mdp), 400), exact.optimal(mdp).q_SA)  # 0.9 ** 400 < 1e-18


# Theorems on T


@given(mdps(), st.integers(0, 1000))
def test_t_contracts_the_maximum_norm_by_the_largest_discount(mdp, seed):
    q_SA, other_SA = some_q(mdp, seed), some_q(mdp, seed + 1)
    modulus = float(mdp.outcomes.discount_NAK.max())
    distance = (exact.bellman(mdp, q_SA) - exact.bellman(mdp, other_SA)).abs().max()
    assert distance <= modulus * (q_SA - other_SA).abs().max() + 1e-12


@given(st.integers(1, 8), st.integers(1, 3), st.integers(0, 1000), st.floats(0, 1))
def test_the_modulus_gamma_is_attained_by_a_constant(num_states, num_actions, seed, gamma):
    mdp = random_mdp(num_states, num_actions, seed=seed, gamma=gamma)
    q_SA = some_q(mdp)
    assert_close(exact.bellman(mdp, q_SA + 1) - exact.bellman(mdp, q_SA), torch.full_like(q_SA, gamma))


@given(mdps(), st.integers(0, 1000))
def test_t_is_monotone(mdp, seed):
    q_SA = some_q(mdp, seed)
    above_SA = q_SA + some_q(mdp, seed + 1).abs()
    assert torch.all(exact.bellman(mdp, above_SA) >= exact.bellman(mdp, q_SA) - 1e-12)


@given(mdps_with_policy())
def test_lookahead_above_q_pi_grows_with_depth_up_to_the_optimum(mdp_and_policy):
    mdp, pi_SA = mdp_and_policy
    look_SA = exact.evaluate(mdp, pi_SA).q_SA
    optimum = exact.optimal(mdp).q_SA
    for _ in range(8):
        deeper_SA = exact.bellman(mdp, look_SA)
        assert torch.all(deeper_SA >= look_SA - 1e-11)
        look_SA = deeper_SA
    assert torch.all(look_SA <= optimum + 1e-9)


def test_lookahead_above_any_q_does_not_grow_with_depth():
    mdp = zoo("garnet")
    q_SA = 100 * some_q(mdp).abs()
    assert torch.any(exact.bellman(mdp, q_SA) < q_SA)


garnets = st.builds(
    random_mdp, st.integers(1, 8), st.integers(1, 3), seed=st.integers(0, 1000), gamma=st.sampled_from([0.0, 0.5, 0.9])
)


@given(garnets, st.floats(-10, 10), st.integers(0, 5))
def test_a_constant_above_all_rewards_adds_the_discounted_sum_of_it(mdp, c, depth):
    # T^m Q gains c + gamma c + ... + gamma^(m-1) c;   Q^pi, a fixed point, gains c / (1 - gamma) at every depth.
    gamma, q_SA, pi_SA = float(mdp.outcomes.discount_NAK[0, 0, 0]), some_q(mdp), random_policy(mdp)
    richer = rewarded(mdp, constant=c)
    gain_SA = exact.lookahead(richer, q_SA, depth) - exact.lookahead(mdp, q_SA, depth)
    assert_close(gain_SA, torch.full_like(q_SA, c * sum(gamma**k for k in range(depth))))
    old, new = exact.evaluate(mdp, pi_SA), exact.evaluate(richer, pi_SA)
    gain_SA = exact.lookahead(richer, new.q_SA, depth) - exact.lookahead(mdp, old.q_SA, depth)
    assert_close(gain_SA, torch.full_like(q_SA, c / (1 - gamma)), 1e-10)


@given(garnets, st.floats(-10, 10), st.integers(0, 5))
def test_a_constant_above_the_leaves_is_discounted_once_a_level(mdp, c, depth):
    gamma, q_SA = float(mdp.outcomes.discount_NAK[0, 0, 0]), some_q(mdp)
    gain_SA = exact.lookahead(mdp, q_SA + c, depth) - exact.lookahead(mdp, q_SA, depth)
    assert_close(gain_SA, torch.full_like(q_SA, gamma**depth * c))


@given(mdps(), st.floats(0, 10), st.integers(0, 5))
def test_lookahead_scales_with_rewards_and_leaves(mdp, factor, depth):
    q_SA = some_q(mdp)
    scaled = rewarded(mdp, factor=factor)
    assert_close(exact.lookahead(scaled, factor * q_SA, depth), factor * exact.lookahead(mdp, q_SA, depth))


def test_lookahead_does_not_scale_with_a_negative_factor():
    mdp = zoo("garnet")
    scaled, q_SA = rewarded(mdp, factor=-1), some_q(mdp)
    assert differs(exact.lookahead(scaled, -q_SA, 1), -exact.lookahead(mdp, q_SA, 1))


# gamma = 1


def test_without_discount_an_episode_that_ends_has_a_value():
    n = 6
    mdp = deep_sea(n, gamma=1.0)
    assert exact.optimal(mdp).J == pytest.approx(1 - 0.01, rel=1e-12)
    assert exact.evaluate(mdp, always(mdp, RIGHT)).J == pytest.approx(0.99, rel=1e-12)
    evaluation = exact.evaluate(mdp, uniform_policy(mdp))
    assert evaluation.J == pytest.approx(0.5**n - n * 0.5 * 0.01 / n, rel=1e-12)
    assert evaluation.d_S.sum().item() == pytest.approx(n)


@pytest.mark.parametrize("limit", [0, 1500])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_without_discount_and_without_end_a_policy_is_refused_with_its_first_state(limit, dtype, monkeypatch):
    # A float32 third sums to 1 - 3e-8 at best: rounding must not pass for an end.
    monkeypatch.setattr(exact, "DENSE_LIMIT", limit)
    P = [
        [[(1.0, 1, 0.0, True)], [(1.0, 1, 0.0, False)], [(1.0, 0, 0.0, False)]],
        [[(1.0, 2, 1.0, False)]] * 3,
        [[(1.0, 1, 1.0, False)]] * 3,
    ]
    mdp = TabularMDP.from_transitions(P, 1.0, start=0)
    with pytest.raises(PgtsError, match=r"no finite value in state 1: .* neither discounts .* nor terminates"):
        exact.evaluate(mdp, torch.full((3, 3), 1 / 3, dtype=dtype))


def test_without_discount_it_is_the_policy_that_must_end():
    P = [[[(1.0, 0, 0.0, False)], [(1.0, 0, 2.0, True)]]]
    mdp = TabularMDP.from_transitions(P, 1.0, start=0)
    assert exact.evaluate(mdp, uniform_policy(mdp)).J == pytest.approx(2)
    with pytest.raises(PgtsError, match="no finite value in state 0"):
        exact.evaluate(mdp, always(mdp, 0))


def test_without_discount_the_optimum_is_the_best_policy_that_ends():
    # Waiting is the first choice by reward; leaving costs 1 now and earns 5 after one more step.
    P = [
        [[(1.0, 0, 0.0, False)], [(1.0, 1, -1.0, False)]],
        [[(1.0, 1, -0.5, False)], [(0.5, 1, 5.0, True), (0.5, 0, 5.0, False)]],
    ]
    optimum = exact.optimal(TabularMDP.from_transitions(P, 1.0, start=0))
    assert optimum.v_S.tolist() == pytest.approx([8, 9])
    assert optimum.pi_SA.argmax(-1).tolist() == [1, 1]


def test_without_discount_a_return_that_grows_for_ever_is_refused():
    P = [[[(1.0, 0, 1.0, False)], [(1.0, 0, 0.0, True)]]]
    with pytest.raises(PgtsError, match="no finite value in state 0"):
        exact.optimal(TabularMDP.from_transitions(P, 1.0, start=0))
    with pytest.raises(PgtsError, match="no finite value in state 0"):
        exact.optimal(ladder(3, gamma=1.0))


# What is refused


@pytest.mark.parametrize(
    "row", [[0.5, 0.6], [-0.5, 1.5], [float("nan"), 1.0], [0.0, 0.0], [float("inf"), 0.0]], ids=str
)
def test_a_policy_that_is_no_distribution_is_refused_with_its_first_bad_row(row):
    pi_SA = uniform_policy(zoo("ladder"))
    pi_SA[2] = pi_SA[4] = torch.tensor(row, dtype=torch.float64)
    with pytest.raises(PgtsError, match=r"pi_SA\[2\] is not a distribution: \["):
        exact.evaluate(zoo("ladder"), pi_SA)


@pytest.mark.parametrize("shape", [(4, 2), (5, 3)])
def test_a_policy_of_another_shape_is_refused(shape):
    with pytest.raises(PgtsError, match=rf"pi_SA has shape \({shape[0]}, {shape[1]}\); the MDP needs \(5, 2\)"):
        exact.evaluate(zoo("ladder"), torch.full(shape, 1 / shape[1], dtype=torch.float64))


@pytest.mark.parametrize("depth", [-1, 1.0, 2.5, True, float("inf"), "3", None])
def test_a_depth_that_is_no_whole_number_is_refused_with_its_value(depth):
    with pytest.raises(PgtsError, match=f"depth is {depth!r}"):
        exact.lookahead(zoo("ladder"), some_q(zoo("ladder")), depth)


def test_a_float32_policy_is_evaluated_to_float32_accuracy_and_carries_no_gradient():
    mdp = zoo("garnet")
    pi_SA = random_policy(mdp)
    single = exact.evaluate(mdp, pi_SA.float().requires_grad_())
    assert_close(single.v_S, exact.evaluate(mdp, pi_SA).v_S, 1e-5)
    assert single.v_S.dtype == torch.float64
    assert not single.q_SA.requires_grad
    assert single.d_S.sum().item() == pytest.approx(10, rel=1e-12)


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_the_optimum_does_not_depend_on_the_unit_of_reward(unit):
    assert exact.optimal(rewarded(ladder(5), factor=unit)).J == pytest.approx(6.561 * unit, rel=1e-12)
