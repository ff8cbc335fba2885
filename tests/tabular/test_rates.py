"""What docs/rates.md proves of iterations and samples, on hundreds of random MDPs, and that more would be wrong."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgts_torch.bellman import sweep
from pgts_torch.errors import PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.search import sampled
from pgts_torch.seeding import numpy_stream, stream
from pgts_torch.tabular import (
    TabularMDP,
    exact,
    ladder,
    mirage,
    random_mdp,
    rates,
    stationary,
    stationary_sets,
)
from pgts_torch.tabular.ascent import ascend, mirror_step, project_simplex, projected_step
from pgts_torch.tabular.stationary import worst_policy
from tests.support import always, random_policy, rewarded, uniform_policy

pytestmark = pytest.mark.usefixtures("unchecked_shapes")
EXACT = 1e-9


@functools.cache
def family() -> tuple[TabularMDP, ...]:
    """200 sparse random MDPs of 3 to 8 states that start in state 0."""
    found = []
    for seed in range(200):
        random = numpy_stream(seed, "rates")
        found.append(
            random_mdp(
                int(random.integers(3, 9)),
                int(random.integers(2, 4)),
                branching=int(random.integers(1, 4)),
                reward_share=float(random.choice([0.1, 0.3, 1.0])),
                gamma=float(random.choice([0.5, 0.8, 0.9])),
                seed=seed,
            )
        )
    return tuple(found)


# Proposition 1: large steps


def greedy(mdp, pi_SA, depth):
    return project_simplex(1e9 * exact.lookahead(mdp, exact.evaluate(mdp, pi_SA).q_SA, depth) + pi_SA)


def test_with_large_steps_everywhere_each_iteration_takes_m_plus_1_discounts_off():
    closest, too_much = 0.0, 0
    for seed, mdp in enumerate(family()):
        pi_SA, depth, best = random_policy(mdp, seed), seed % 4, exact.optimal(mdp)
        bound_K = rates.greedy_bound(mdp, pi_SA, depth, 4)
        one_more_K = rates.greedy_bound(mdp, pi_SA, depth + 1, 4)
        lack = float((best.v_S - exact.evaluate(mdp, pi_SA).v_S).max())
        gamma = float(mdp.outcomes.discount_NAK.max())
        for k in range(5):
            missing = best.J - exact.evaluate(mdp, pi_SA).J
            assert missing <= bound_K[k] + EXACT
            assert bound_K[k] <= gamma ** ((depth + 1) * k) * lack + EXACT
            if k and bound_K[k] > EXACT:
                closest = max(closest, missing / float(bound_K[k]))
            too_much += missing > one_more_K[k] + EXACT
            pi_SA = greedy(mdp, pi_SA, depth)
    assert closest > 0.5, "the bound is not idle"
    assert too_much > 0, "one discount more would be wrong"


def test_a_projected_step_is_greedy_from_a_finite_size_on():
    for seed in range(300):
        random = numpy_stream(seed, "greedy")
        pi_NA = torch.from_numpy(random.dirichlet(np.ones(3), size=1))
        q_NA = torch.from_numpy(random.random((1, 3)))
        best, second = q_NA.sort(descending=True).values[0, :2].tolist()
        step = 2 / (best - second)
        greedy_NA = torch.nn.functional.one_hot(q_NA.argmax(-1), 3)
        assert torch.equal(projected_step(pi_NA, q_NA, torch.ones(1), step), greedy_NA.double())
    worst = torch.tensor([[0.0, 1.0]])
    assert projected_step(worst, torch.tensor([[1.0, 0.0]]), torch.ones(1), 1.99)[0, 0] < 1


# Proposition 2: finite steps everywhere


@pytest.mark.parametrize(("update", "step"), [("projected", projected_step), ("mirror", mirror_step)])
def test_what_a_finite_step_leaves_is_bounded_by_its_size(update, step):
    above, without = 0.0, 0
    for seed, mdp in enumerate(family()):
        random, pi_SA, depth = numpy_stream(seed, "finite"), random_policy(mdp, seed), seed % 3
        step_S = torch.from_numpy(10 ** random.uniform(-1, 2) * random.uniform(0.1, 2, size=mdp.num_states))
        look_SA = exact.lookahead(mdp, exact.evaluate(mdp, pi_SA).q_SA, depth)
        next_SA = step(pi_SA, look_SA, step_S, 1.0)
        lack_S = exact.optimal(mdp).v_S - exact.policy_values(mdp, next_SA)
        bound_S = rates.finite_step_bound(mdp, pi_SA, next_SA, depth, step_S, update)
        assert (lack_S <= bound_S + EXACT).all()
        above = max(above, float((lack_S / bound_S.clamp(min=1e-12)).max()))
        without += bool(
            (lack_S > rates.finite_step_bound(mdp, pi_SA, next_SA, depth, 1e12 * step_S, update) + EXACT).any()
        )
    assert above > 0.5
    assert without > 30, "what the step leaves is needed in the bound"


# Propositions 3 and 4: deep enough for every policy


def test_at_the_certain_depth_every_policy_prefers_optimal_actions_by_the_margin():
    less = 0
    for seed, mdp in enumerate(family()[::2]):
        best_SA = exact.optimal(mdp).q_SA >= exact.optimal(mdp).v_S[:, None] - EXACT
        depth = rates.certain_depth(mdp)
        if mdp.num_actions**mdp.num_states <= 2**13:
            assert stationary_sets.enumerate_sets(mdp).sufficient_depth <= depth
        for trial in range(3):
            pi_SA = random_policy(mdp, 3 * seed + trial) if trial else worst_policy(mdp)
            q_SA = exact.evaluate(mdp, pi_SA).q_SA
            for m in (depth, max(depth - 2, 0)):
                look_SA, delta_S = exact.lookahead(mdp, q_SA, m), rates.margin(mdp, m)
                least_S = torch.where(best_SA, look_SA, math.inf).amin(-1)
                preferred_S = least_S - torch.where(best_SA, -math.inf, look_SA).amax(-1)
                assert (preferred_S >= delta_S - EXACT).all()
                less += bool((preferred_S < 0).any())
    assert less > 10, "at smaller depths some policies prefer others"


def test_a_projected_step_takes_half_its_length_off_the_actions_that_are_not_the_best():
    """The lemma of Proposition 4, for any number of best and other actions."""
    closest = math.inf
    for seed in range(2000):
        random = numpy_stream(seed, "lemma")
        A = int(random.integers(2, 6))
        best = random.random(A) < 0.4
        best[int(random.integers(A))], best[int(random.integers(A))] = True, False
        if not best.any():
            continue
        theta = float(10 ** random.uniform(-2, 0.5))
        u_A = np.where(best, random.random(A), -theta - random.random(A) * float(random.choice([0, 1])))
        pi_A = random.dirichlet(np.full(A, 0.5))
        next_A = project_simplex(torch.from_numpy(pi_A + u_A)[None])[0].numpy()
        before, after = pi_A[~best].sum(), next_A[~best].sum()
        assert after <= max(before - theta / 2, 0) + 1e-12 or after <= 1e-12
        if after > 1e-9:
            closest = min(closest, (before - after) / theta)
    assert closest < 0.55, "a larger share of the length would be wrong"


def test_exact_training_of_visited_states_is_optimal_within_the_bound():
    ran, sooner = 0, 0
    for seed, mdp in enumerate(family()[::2]):
        pi_SA, best, depth = random_policy(mdp, seed), exact.optimal(mdp), rates.certain_depth(mdp) + 2
        for step_size, weight in ((3.0, "occupancy"), (30.0, "occupancy")):
            K = rates.iteration_bound(mdp, pi_SA, depth=depth, step_size=step_size, state_weight=weight)
            if 1 <= K <= 40:
                J_K = ascend(mdp, pi_SA, depth=depth, step_size=step_size, iterations=int(K)).J_K
                assert J_K[-1] >= best.J - EXACT
                ran += 1
                sooner += bool(J_K[int(K) // 2] < best.J - EXACT)
    assert ran > 30
    assert sooner >= 3, "half as many iterations would be too few"


def test_the_bound_is_infinite_where_the_lookahead_may_be_misled():
    mdp = ladder(5)
    left_SA = always(mdp, 0)
    depth = rates.certain_depth(mdp)
    assert depth > stationary_sets.enumerate_sets(mdp).sufficient_depth == 4
    assert rates.iteration_bound(mdp, left_SA, depth=depth - 1, step_size=1.0) == math.inf
    assert rates.iteration_bound(mdp, left_SA, depth=depth, step_size=1.0) < math.inf
    alike = random_mdp(4, seed=1, reward_share=0.0)
    with pytest.raises(PgtsError, match="step_size is 0"):
        rates.iteration_bound(alike, uniform_policy(alike), depth=3, step_size=0.0)


@pytest.mark.parametrize("factor", [1e-3, 1e6])
def test_steps_in_units_of_rewards_take_as_many_iterations(factor):
    mdp = family()[3]
    other, depth = rewarded(mdp, factor=factor), rates.certain_depth(mdp) + 1
    assert rates.certain_depth(other) == rates.certain_depth(mdp)
    K = [
        rates.iteration_bound(one, uniform_policy(mdp), depth=depth, step_size=size)
        for one, size in ((mdp, 1.0), (other, 1 / factor))
    ]
    assert K[1] == pytest.approx(K[0], abs=3)


# Proposition 5: how much depth can slow


def test_depth_slows_at_most_by_the_spread_over_the_margin():
    mdp = mirage()
    pi_SA, best = always(mdp, 0), exact.optimal(mdp)
    q_SA, arrivals, spreads = exact.evaluate(mdp, pi_SA).q_SA, [], []
    for depth in (0, 5, 50):
        look_A = exact.lookahead(mdp, q_SA, depth)[0]
        spreads.append(float(look_A[1] - look_A[0]))
        J_K = ascend(mdp, pi_SA, depth=depth, step_size=0.03, iterations=140).J_K
        arrivals.append(int((J_K >= 0.99 * best.J).nonzero()[0]))
    gap = float(best.v_S[0] - best.q_SA[0, 0])
    ratio = arrivals[-1] / arrivals[0]
    assert 0.5 * spreads[0] / spreads[-1] < ratio <= (spreads[0] / gap) * (arrivals[0] + 1) / arrivals[0]
    assert arrivals == sorted(arrivals)


def test_a_projected_step_moves_no_more_than_the_spread_of_its_values():
    largest = 0.0
    for seed in range(1000):
        random = numpy_stream(seed, "spread")
        A = int(random.integers(2, 5))
        pi_NA, u_NA = torch.from_numpy(random.dirichlet(np.ones(A), 1)), torch.from_numpy(random.random((1, A)))
        moved = float((project_simplex(pi_NA + u_NA) - pi_NA).clamp(min=0).sum())
        share = moved / float(u_NA.amax() - u_NA.amin())
        assert share <= A / 4 + EXACT
        largest = max(largest, share)
    assert largest > 0.5


# Proposition 6: escape


def test_what_the_start_lacks_is_paid_for_by_visited_states():
    closest, alone = math.inf, 0
    for seed, mdp in enumerate(family()):
        pi_SA = worst_policy(mdp) if seed % 2 else random_policy(mdp, seed)
        evaluation, depth = exact.evaluate(mdp, pi_SA), seed % 4
        look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
        moved_by_S = look_SA.amax(-1) - (pi_SA * look_SA).sum(-1)
        gap_S = stationary.gap(mdp, pi_SA, depth)
        paid, start_gap = float(evaluation.d_S @ moved_by_S), float(mdp.start_S @ gap_S)
        assert paid >= start_gap - EXACT
        if start_gap > EXACT:
            closest = min(closest, paid / start_gap)
        alone += float((moved_by_S * (evaluation.d_S > 0)).max()) < start_gap - EXACT
        u_SA = 0.7 * evaluation.d_S[:, None] * look_SA
        length_S = (project_simplex(pi_SA + u_SA) - pi_SA).norm(dim=-1)
        size_S = (u_SA - u_SA.mean(-1, keepdim=True)).norm(dim=-1)
        assert (length_S >= 0.7 * evaluation.d_S * moved_by_S / (math.sqrt(2) + size_S) - EXACT).all()
    assert closest < 1.01
    assert alone > 10, "no state pays for it alone, without its weight"


# Proposition 7: samples of a lookahead


@pytest.mark.parametrize("share", ["none", "level", "search"])
def test_a_sampled_lookahead_is_within_its_bound_as_often_as_it_says(share):
    failures = loose = 0
    for seed in range(60):
        mdp = random_mdp(12, 2, branching=3, reward_share=0.5, seed=seed)
        evaluation, roots, depth, C = exact.evaluate(mdp, uniform_policy(mdp)), [0, 5], seed % 3, 3
        bound = rates.sample_bound(
            mdp, evaluation.v_S, roots, depth=depth, samples=C, failure=0.5, share=share, critic_error=0.1
        )
        look = sampled(
            TabularModel(mdp),
            torch.tensor(roots),
            depth=depth,
            v_leaf=lambda state_N, v_S=evaluation.v_S: v_S[state_N] + 0.1,
            samples=C,
            share=share,
            generator=stream(seed, "bound"),
            replicates=0,
        )
        off = float((look.q_BA - exact.lookahead(mdp, evaluation.q_SA, depth)[roots]).abs().max())
        failures += off > bound.error
        loose += off > bound.error / 6
        assert look.model_calls <= bound.model_calls
    assert failures <= 30
    assert loose > 20, "a sixth of the bound is exceeded"


def test_nothing_is_sampled_in_vain_where_nothing_is_left_to_chance():
    mdp = ladder(6)
    bound = rates.sample_bound(
        mdp, exact.evaluate(mdp, uniform_policy(mdp)).v_S, [0], depth=3, samples=1, critic_error=1
    )
    assert bound.error == pytest.approx(0.9**4)
    with pytest.raises(PgtsError, match="failure is 1"):
        rates.sample_bound(mdp, torch.zeros(6).double(), [0], depth=3, samples=1, failure=1)


# Proposition 8: rollouts


def visits(mdp, pi_SA, episodes, random):
    """Visits of episodes with a geometric horizon, by a plain loop over steps."""
    weight_SAS = mdp.outcomes.weight.to_dense().view(mdp.num_states, mdp.num_actions, -1).numpy()
    cumulated_SS = np.cumsum(np.einsum("sa,sat->st", pi_SA.numpy(), weight_SAS), -1)
    count_ES = np.zeros((episodes, mdp.num_states))
    state_E, alive_E = random.choice(mdp.num_states, size=episodes, p=mdp.start_S.numpy()), np.ones(episodes, bool)
    while alive_E.any():
        count_ES[np.flatnonzero(alive_E), state_E[alive_E]] += 1
        next_E = (random.random(episodes)[:, None] > cumulated_SS[state_E]).sum(-1)
        alive_E &= next_E < mdp.num_states
        state_E = np.where(alive_E, next_E, state_E)
    return count_ES


def test_the_direction_is_off_by_no_more_than_its_bound():
    shares, too_little = [], 0
    for seed, mdp in enumerate(family()[:60]):
        pi_SA, depth, n = random_policy(mdp, seed), seed % 3, 8
        evaluation = exact.evaluate(mdp, pi_SA)
        look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
        above_SA = look_SA - (pi_SA * look_SA).sum(-1, keepdim=True)
        random = numpy_stream(seed, "direction")
        weight_RS = visits(mdp, pi_SA, 400 * n, random).reshape(400, n, -1).mean(1)
        error_SA = torch.from_numpy(random.uniform(-0.01, 0.01, size=look_SA.shape))
        wrong_SA = above_SA + error_SA - (pi_SA * error_SA).sum(-1, keepdim=True)
        off_RSA = weight_RS[..., None] * wrong_SA.numpy() - (evaluation.d_S[:, None] * above_SA).numpy()
        off_R = np.abs(off_RSA).max(-1).sum(-1)
        bound = rates.gradient_bound(mdp, pi_SA, depth=depth, episodes=n, lookahead_error=0.01)
        noise = 4 * off_R.std() / 20
        assert off_R.mean() <= bound + noise
        shares.append(off_R.mean() / bound)
        more = rates.gradient_bound(mdp, pi_SA, depth=depth, episodes=25 * n, lookahead_error=0.01)
        too_little += off_R.mean() > more
    assert np.median(shares) > 0.3
    assert too_little > 20, "a bound for more episodes would be wrong"


# Proposition 9: a learned table with optimism


def optimistic(mdp, known_SA, worth):
    """The MDP whose unknown actions end and are worth `worth`."""
    outcomes = mdp.outcomes
    reward_SA = torch.where(known_SA, outcomes.reward_NA, worth)
    discount_SAK = torch.where(known_SA[..., None], outcomes.discount_NAK, 0.0)
    return TabularMDP(replace(outcomes, reward_NA=reward_SA, discount_NAK=discount_SAK), mdp.start_S)


def test_a_policy_that_rests_in_an_optimistic_table_is_good_or_finds_what_is_unknown():
    unseen = shallow = 0
    for seed, mdp in enumerate(family()):
        random, depth, gamma = numpy_stream(seed, "optimism"), seed % 4, float(mdp.outcomes.discount_NAK.max())
        top = 1 / (1 - gamma)
        known_SA = torch.from_numpy(random.random((mdp.num_states, mdp.num_actions)) < 0.7)
        model = optimistic(mdp, known_SA, top)
        J_optimal = exact.optimal(mdp).J
        for _ in range(3):
            action_S = torch.from_numpy(random.integers(mdp.num_actions, size=mdp.num_states))
            pi_SA = torch.eye(mdp.num_actions, dtype=torch.float64)[action_S]
            inside = exact.evaluate(model, pi_SA)
            seen_S = exact.lookahead(model, inside.q_SA, depth).amax(-1)
            gap = float(mdp.start_S @ (seen_S - inside.v_S))
            lack_S = exact.optimal(model).v_S - inside.v_S
            free = model.outcomes.paying(torch.zeros_like(model.outcomes.reward_NA))
            beyond = float(mdp.start_S @ sweep(free, lack_S.clamp(min=0), depth + 1))
            # What it finds: 1 where an unknown action is taken, which ends; discounted.
            finds = float(mdp.start_S @ exact.policy_values(_paying(model, (~known_SA).double()), pi_SA))
            lack = J_optimal - exact.evaluate(mdp, pi_SA).J
            assert lack <= gap + beyond + top * finds + EXACT
            unseen += lack > gap + beyond + EXACT
            shallow += lack > gap + top * finds + EXACT
    assert unseen > 10, "a policy may be worse where it finds what is unknown"
    assert shallow > 10, "a policy may rest and be worse where optimism is out of sight"


def _paying(mdp, reward_SA):
    return TabularMDP(mdp.outcomes.paying(reward_SA), mdp.start_S)
