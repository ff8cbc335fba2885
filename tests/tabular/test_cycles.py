"""Whether Algorithm 1 comes to rest: MDPs on which it goes round for ever, in fractions, and what excludes that."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, exact, ladder, roundabout, stationary, tightrope
from pgts_torch.tabular.ascent import ascend, floored, mirror_step, projected_step
from tests.support import always, random_policy
from tests.tabular.brute import EXACT, family

LEFT, RIGHT = 0, 1


def floored_mirror_step(pi_NA, q_NA, weight_N, step_size):
    """A mirror step as training takes it: no probability falls below about exp(-12), and so none is rounded to 0."""
    best_NA = q_NA - q_NA.amax(-1, keepdim=True)
    return floored(pi_NA.log(), step_size * weight_N[:, None] * best_NA, 12.0).softmax(-1)


fast = pytest.mark.usefixtures("unchecked_shapes")


class Deterministic:
    """Two actions and certain next states, in fractions: the projected update at the states that are visited."""

    def __init__(self, mdp: TabularMDP, gamma: Fraction, reward_SA: list[list[Fraction]]) -> None:
        self.child_SA = mdp.outcomes.child_NAK[..., 0].tolist()
        self.gamma, self.reward_SA = gamma, reward_SA
        self.states = range(len(reward_SA))

    def q(self, v_S: list[Fraction]) -> list[list[Fraction]]:
        return [[self.reward_SA[s][a] + self.gamma * v_S[self.child_SA[s][a]] for a in (0, 1)] for s in self.states]

    def values(self, right_S: list[Fraction]) -> list[Fraction]:
        """(I - gamma P^pi)^-1 R^pi by elimination."""
        rows = []
        for s in self.states:
            row = [Fraction(int(t == s)) for t in self.states] + [Fraction(0)]
            for a, p in ((0, 1 - right_S[s]), (1, right_S[s])):
                row[self.child_SA[s][a]] -= self.gamma * p
                row[-1] += p * self.reward_SA[s][a]
            rows.append(row)
        return solved(rows)

    def occupancy(self, right_S: list[Fraction]) -> list[Fraction]:
        rows = [[Fraction(int(t == s)) for t in self.states] + [Fraction(int(s == 0))] for s in self.states]
        for s in self.states:
            for a, p in ((0, 1 - right_S[s]), (1, right_S[s])):
                rows[self.child_SA[s][a]][s] -= self.gamma * p
        return solved(rows)

    def updated(self, right_S: list[Fraction], depth: int, step: Fraction | None, *, weighted: bool) -> list[Fraction]:
        """One iteration; step None: infinite. proj[(1 - p, p) + (x, y)] is p + (y - x) / 2, kept in [0, 1]."""
        look = self.q(self.values(right_S))
        for _ in range(depth):
            look = self.q([max(row) for row in look])
        answer = list(right_S)
        for s, d in enumerate(self.occupancy(right_S)):
            if d > 0:
                better = look[s][1] - look[s][0]
                far = (2 if better > 0 else -2) if better else 0
                move = Fraction(far) if step is None else step * (d if weighted else 1) * better
                answer[s] = min(max(right_S[s] + move / 2, Fraction(0)), Fraction(1))
        return answer


def solved(rows: list[list[Fraction]]) -> list[Fraction]:
    """Gauss and Jordan; the last column is the right-hand side."""
    for i, row in enumerate(rows):
        pivot = next(j for j in range(i, len(rows)) if rows[j][i])
        rows[i], rows[pivot] = rows[pivot], row
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for j in range(len(rows)):
            if j != i:
                rows[j] = [x - rows[j][i] * y for x, y in zip(rows[j], rows[i], strict=True)]
    return [row[-1] for row in rows]


def exact_roundabout(depth: int, gamma: Fraction, cost: Fraction) -> Deterministic:
    mdp = roundabout(depth, gamma=float(gamma), cost=float(cost))
    earned = {(0, 0): -cost, (0, 1): -cost, (2, 1): Fraction(1)}
    rewards = [[earned.get((s, a), Fraction(0)) for a in (0, 1)] for s in range(mdp.num_states)]
    np.testing.assert_allclose(mdp.outcomes.reward_NA, np.array(rewards, dtype=float))
    return Deterministic(mdp, gamma, rewards)


# Going round


@pytest.mark.parametrize(
    ("depth", "gamma", "cost", "step"),
    [
        (1, Fraction(9, 10), Fraction(1), None),
        (1, Fraction(9, 10), Fraction(1), Fraction(12)),
        (2, Fraction(9, 10), Fraction(5, 2), None),
        (2, Fraction(9, 10), Fraction(5, 2), Fraction(9)),
        (6, Fraction(97, 100), Fraction(5), Fraction(3)),
        (12, Fraction(99, 100), Fraction(4), None),
    ],
)
@pytest.mark.parametrize("weighted", [True, False])
def test_on_the_roundabout_each_of_two_policies_leads_to_the_other_in_exact_fractions(
    depth, gamma, cost, step, weighted
):
    mdp = exact_roundabout(depth, gamma, cost)
    left = [Fraction(0)] * (depth + 2)
    right = [Fraction(1), *left[1:]]
    assert mdp.updated(left, depth, step, weighted=weighted) == right
    assert mdp.updated(right, depth, step, weighted=weighted) == left
    returns = [mdp.values(policy)[0] for policy in (left, right, [Fraction(1)] * (depth + 2))]
    assert returns == [-cost, -cost / (1 - gamma ** (depth + 1)), gamma / (1 - gamma) - cost]
    # By plain policy gradient the return never falls: it does not go round.
    assert mdp.values(mdp.updated(right, 0, step, weighted=weighted))[0] >= returns[1]


def test_a_smaller_step_or_depth_0_or_another_depth_does_not_go_round_on_the_roundabout():
    mdp = exact_roundabout(1, Fraction(9, 10), Fraction(1))
    left, right = [Fraction(0)] * 3, [Fraction(1), Fraction(0), Fraction(0)]
    # 2 / 0.171 = 11.7 is the least step that moves state 0 all the way
    assert mdp.updated(left, 1, Fraction(11), weighted=True) != right
    assert mdp.updated(left, 2, None, weighted=True) != right or mdp.updated(right, 2, None, weighted=True) != left
    assert mdp.updated(left, 0, None, weighted=True) == left, "it is stationary at depth 0"
    end = ascend(roundabout(cost=1.0), always(roundabout(), LEFT), depth=1, step_size=3.0, iterations=100)
    assert float(end.J_K[-1]) == pytest.approx(8.0)


def test_the_library_goes_round_with_the_fractions():
    for depth, gamma, step_size in ((1, 0.9, 30.0), (2, 0.9, 30.0), (10, 0.98, 5.0)):
        mdp = roundabout(depth, gamma=gamma)
        end = ascend(mdp, always(mdp, LEFT), depth=depth, step_size=step_size, iterations=200)
        cost = -float(mdp.outcomes.reward_NA[0, 0])
        assert end.J_K[::2].tolist() == pytest.approx([-cost] * 101)
        assert end.J_K[1::2].tolist() == pytest.approx([-cost / (1 - gamma ** (depth + 1))] * 100)
        assert exact.optimal(mdp).J == pytest.approx(gamma / (1 - gamma) - cost)


def test_mirror_steps_go_round_too_from_inside_the_simplex():
    mdp = roundabout(4, gamma=0.97)
    pi_SA = torch.tensor([[0.999, 0.001]], dtype=torch.float64).repeat(6, 1)
    J_K = ascend(mdp, pi_SA, depth=4, step_size=30.0, iterations=400, step=floored_mirror_step).J_K
    assert float(J_K[-50:].max() - J_K[-50:].min()) > 1
    assert float(J_K[-50:].max()) < exact.optimal(mdp).J - 20


def test_a_roundabout_exists_where_the_discount_of_the_depth_is_large_enough():
    for depth, gamma in itertools.product((1, 2, 5, 20, 47, 60), (0.5, 0.8, 0.9, 0.97, 0.99)):
        exists = (1 - gamma ** (depth + 1)) ** 2 * gamma**depth < (1 - gamma**depth) * (2 * gamma ** (depth + 1) - 1)
        if exists:
            mdp = roundabout(depth, gamma=gamma)
            policies = [always(mdp, LEFT)]
            for _ in range(2):
                policies.append(ascend(mdp, policies[-1], depth=depth, step_size=1e9, iterations=1).pi_SA)
            assert torch.equal(policies[0], policies[2])
            assert not torch.equal(policies[0], policies[1])
        else:
            with pytest.raises(PgtsError, match="take one nearer to 1"):
                roundabout(depth, gamma=gamma)


# What comes to rest


@fast
def test_at_depth_0_no_step_of_any_size_lowers_the_value_of_any_state():
    for seed, case in enumerate(family()[::4]):
        pi_SA = random_policy(case.mdp, seed)
        for step, step_size in itertools.product((projected_step, mirror_step), (0.1, 10.0)):
            before, policy_SA = exact.policy_values(case.mdp, pi_SA), pi_SA
            for _ in range(5):
                policy_SA = ascend(case.mdp, policy_SA, depth=0, step_size=step_size, iterations=1, step=step).pi_SA
                after = exact.policy_values(case.mdp, policy_SA)
                assert bool((after >= before - 1e-9).all())
                before = after


def deep_enough(case) -> int:
    """The first m with gamma^{m+1} max_s (v* - v_min)(s) < Delta: what the best action lacks that is not optimal."""
    v_S, low_S = case.v_PS.max(0), case.v_PS.min(0)
    optimum = exact.optimal(case.mdp)
    lack_SA = (optimum.v_S[:, None] - optimum.q_SA).numpy()
    worse = lack_SA[lack_SA > EXACT]
    if not len(worse) or (v_S - low_S).max() <= EXACT:
        return 0
    gamma = float(case.mdp.outcomes.discount_NAK.max())
    return next(m for m in itertools.count() if gamma ** (m + 1) * (v_S - low_S).max() < worse.min() - EXACT)


@fast
def test_from_some_depth_on_as_many_iterations_as_states_suffice():
    slower, depths = 0, []
    for seed, case in enumerate(family()[:150]):
        depth, S = deep_enough(case), case.mdp.num_states
        start_SA = case.pi_SA(int(numpy_stream(seed, "start").integers(len(case.J_P))))
        end = ascend(case.mdp, start_SA, depth=depth, step_size=1e12, iterations=S)
        assert float(end.J_K[-1]) >= case.J_P.max() - 1e-7
        slower += (
            float(ascend(case.mdp, start_SA, depth=0, step_size=1e12, iterations=S).J_K[-1]) < case.J_P.max() - 1e-7
        )
        depths.append(depth)
    assert slower > 5, "at depth 0 they do not"
    assert max(depths) > 20


# A rule that excludes going round


@pytest.mark.parametrize("step", [projected_step, floored_mirror_step])
@pytest.mark.parametrize(("depth", "gamma"), [(1, 0.9), (2, 0.9), (10, 0.98)])
def test_with_patience_the_roundabout_is_left_for_the_optimum(depth, gamma, step):
    mdp = roundabout(depth, gamma=gamma)
    rare = 0.0 if step is projected_step else 1e-4
    start_SA = (1 - rare) * always(mdp, LEFT) + rare * always(mdp, RIGHT)
    end = ascend(mdp, start_SA, depth=depth, step_size=100.0, iterations=300, step=step, patience=5)
    assert float(end.J_K[-1]) == pytest.approx(exact.optimal(mdp).J, rel=0.01)
    assert depth < end.depth
    assert end.depth <= depth + 60


@fast
def test_with_patience_every_run_reaches_the_optimum():
    stuck, deepened = 0, 0
    for seed, case in enumerate(family()):
        if case.sets.sufficient_depth == 0 or (needed := deep_enough(case)) > 25:
            continue
        start_SA = case.pi_SA(int(numpy_stream(seed, "start").integers(len(case.J_P))))
        arguments = {"depth": 0, "step_size": 1e6, "iterations": 4 * needed + 30}
        end = ascend(case.mdp, start_SA, **arguments, patience=3)
        assert float(end.J_K[-1]) >= case.J_P.max() - 1e-6
        stuck += float(ascend(case.mdp, start_SA, **arguments).J_K[-1]) < case.J_P.max() - 1e-6
        deepened += end.depth > 0
    assert stuck > 5, "without patience they do not"
    assert deepened > stuck


def test_patience_leaves_alone_what_still_improves():
    for mdp, depth in ((ladder(5), 4), (tightrope(), 1)):
        arguments = {"depth": depth, "step_size": 0.1, "iterations": 60}
        plain = ascend(mdp, always(mdp, LEFT), **arguments)
        patient = ascend(mdp, always(mdp, LEFT), **arguments, patience=30)
        assert plain.J_K.tolist()[:30] == patient.J_K.tolist()[:30]
        assert plain.depth == depth
    with pytest.raises(PgtsError, match="patience is 0"):
        ascend(ladder(5), always(ladder(5), LEFT), depth=1, step_size=1.0, iterations=1, patience=0)
    assert stationary.is_stationary(ladder(5), always(ladder(5), RIGHT), 4)


# Small steps


def turns(J_K: torch.Tensor, least: float = 1e-3) -> int:
    """How often the returns turn from rising to falling or back, each time by more than this."""
    count, edge, direction = 0, float(J_K[0]), 0
    for J in J_K.tolist():
        if direction * (J - edge) > 0:
            edge = J
        elif abs(J - edge) > least:
            count, edge, direction = count + 1, J, 1 if J > edge else -1
    return count


@fast
def test_by_small_steps_nothing_goes_round_where_two_states_have_a_choice():
    for depth, gamma in ((1, 0.9), (2, 0.9), (6, 0.97)):
        mdp = roundabout(depth, gamma=gamma)
        for seed in range(3):
            J_K = ascend(mdp, random_policy(mdp, seed), depth=depth, step_size=0.05, iterations=300).J_K
            assert turns(J_K[100:]) <= 1
        large = ascend(mdp, always(mdp, LEFT), depth=depth, step_size=100.0, iterations=40).J_K
        assert turns(large) >= 38, "by large ones it does"
