"""What a policy lacks, from its gap: with exact values, and with errors of critic, baseline, model and search."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from pgts_torch.models import TabularModel
from pgts_torch.search import expectimax, sampled
from pgts_torch.seeding import numpy_stream, stream
from pgts_torch.tabular import TabularMDP, exact, ladder, random_mdp, stationary
from tests.search.models import all_states
from tests.search.test_doubt import WrongModel
from tests.support import always, random_policy, weights
from tests.tabular.brute import DEPTHS, EXACT, Brute, family

fast = pytest.mark.usefixtures("unchecked_shapes")
LEFT = 0


def behind(case: Brute, lack_PS: np.ndarray, steps: int) -> np.ndarray:
    """mu^T U^n x of each policy, by plain numpy."""
    weight_SAS = weights(case.mdp)
    for _ in range(steps):
        lack_PS = np.einsum("sat,pt->psa", weight_SAS, lack_PS).max(-1)
    return lack_PS @ case.mdp.start_S.numpy()


def test_no_policy_lacks_more_than_its_gap_and_what_is_behind_the_horizon():
    pairs, no_gap, nothing_behind, one_more = 0, 0, 0, 0
    for case in family():
        lack_PS = case.v_PS.max(0) - case.v_PS
        for depth in DEPTHS:
            seen_P = (case.look_MPSA[depth].max(-1) - case.v_PS) @ case.mdp.start_S.numpy()
            behind_P = behind(case, lack_PS, depth + 1)
            assert np.all(case.lack_P <= seen_P + behind_P + EXACT)
            pairs += len(seen_P)
            no_gap += int((case.lack_P > behind_P + EXACT).sum())
            nothing_behind += int((case.lack_P > seen_P + EXACT).sum())
            one_more += int((case.lack_P > seen_P + behind(case, lack_PS, depth + 2) + EXACT).sum())
    assert pairs > 20_000
    assert min(no_gap, nothing_behind, one_more) > 500, "no term can be left out, and no discount added"


@fast
def test_the_library_says_the_same_and_without_the_optimum_no_more_than_allows_the_certificate():
    looser = 0
    for seed, case in enumerate(family()[::3]):
        lack_PS, p = case.v_PS.max(0) - case.v_PS, int(numpy_stream(seed, "policy").integers(len(case.v_PS)))
        for depth in (0, 2):
            seen = (case.look_MPSA[depth][p].max(-1) - case.v_PS[p]) @ case.mdp.start_S.numpy()
            bound = stationary.gap_bound(case.mdp, case.pi_SA(p), depth, lack_S=torch.from_numpy(lack_PS[p]))
            assert bound == pytest.approx(seen + behind(case, lack_PS, depth + 1)[p], abs=1e-9)
            known = stationary.gap_bound(case.mdp, case.pi_SA(p), depth)
            proved = stationary.certificate(case.mdp, case.pi_SA(p), depth)
            assert case.lack_P[p] - EXACT <= proved <= known + EXACT
            looser += known > proved + EXACT
            mixed_SA = random_policy(case.mdp, seed)
            lacks = exact.optimal(case.mdp).J - exact.evaluate(case.mdp, mixed_SA).J
            assert lacks <= stationary.gap_bound(case.mdp, mixed_SA, depth) + EXACT
    assert looser > 20
    assert stationary.gap_bound(ladder(5), always(ladder(5), LEFT), 3) == pytest.approx(10 * 0.9**4)


@fast
def test_with_what_the_residual_says_of_the_leaves_the_bound_never_grows_with_depth():
    grown = 0
    for seed, case in enumerate(family()[1::3]):
        p = int(numpy_stream(seed, "policy").integers(len(case.v_PS)))
        largest = (case.look_MPSA[0][p].max(-1) - case.v_PS[p]).max()
        gamma = float(case.mdp.outcomes.discount_NAK.max())

        def bounds(factor: float, p: int = p, case: Brute = case, lack: float = largest / (1 - gamma)) -> list[float]:
            lack_S = torch.full((case.mdp.num_states,), factor * lack, dtype=torch.float64)
            return [stationary.gap_bound(case.mdp, case.pi_SA(p), m, lack_S=lack_S) for m in range(6)]

        assert np.all(np.diff(bounds(1.0)) <= EXACT)
        grown += bool(np.any(np.diff(bounds(0.2)) > EXACT))
    assert grown > 10, "with less it may"


# Proposition 13: searches with errors, all states as roots


def wrong(truth: TabularMDP, seed: int) -> tuple[TabularMDP, Tensor]:
    """A model with other rewards and probabilities, and by how much a step in it is too low for the optimal values."""
    random, shape = numpy_stream(seed, "wrong"), tuple(truth.outcomes.prob_NAK.shape)
    share_SAK = torch.from_numpy(random.dirichlet(np.ones(shape[2]), size=shape[:2]))
    outcomes = replace(
        truth.outcomes,
        reward_NA=truth.outcomes.reward_NA + 0.1 * torch.from_numpy(random.normal(size=shape[:2])),
        prob_NAK=0.9 * truth.outcomes.prob_NAK + 0.1 * share_SAK,
    )
    model, v_S = replace(truth, outcomes=outcomes, reward_SAK=None), exact.optimal(truth).v_S
    low_SA = exact.bellman(truth, v_S[:, None]) - exact.bellman(model, v_S[:, None])
    return model, low_SA.clamp(min=0)


@fast
def test_the_recursion_of_all_errors_bounds_what_is_lacking_and_none_can_be_left_out():
    violated = np.zeros(3, dtype=int)
    for seed in range(250):
        random = numpy_stream(seed, "errors")
        truth = random_mdp(int(random.integers(2, 6)), 2, branching=2, reward_share=0.5, seed=seed)
        pi_SA, depth = random_policy(truth, seed), int(random.integers(0, 6))
        if seed % 2:  # nearly optimal policies leave less room
            pi_SA = 0.1 * pi_SA + 0.9 * exact.optimal(truth).pi_SA
        v_S, best_S = exact.policy_values(truth, pi_SA), exact.optimal(truth).v_S
        model, low_SA = wrong(truth, seed)
        leaf_S = v_S + torch.from_numpy(random.uniform(-1, 1, size=len(v_S)))
        baseline_S = v_S + torch.from_numpy(random.uniform(-1, 1, size=len(v_S)))
        above_S = (baseline_S - v_S).clamp(min=0)

        def bounds(error_SA: Tensor, lack_S: Tensor) -> Tensor:
            arguments = {"depth": depth, "v_leaf": lambda s: leaf_S[s], "leaf_error": lambda s: lack_S[s]}  # noqa: B023
            look = expectimax(WrongModel(model, error_SA), all_states(truth), **arguments)  # noqa: B023
            return look.q_BA.amax(-1) + look.doubt_BA.amax(-1) - baseline_S  # noqa: B023

        lack_S = (best_S - leaf_S).clamp(min=0)
        right_S = bounds(low_SA, lack_S) + above_S
        assert bool((best_S - v_S <= right_S + 1e-9).all())
        without = (
            bounds(torch.zeros_like(low_SA), lack_S) + above_S,  # the model's error
            bounds(low_SA, torch.zeros_like(v_S)) + above_S,  # what the leaves lack
            bounds(low_SA, lack_S),  # the baseline's error
        )
        violated += [bool((best_S - v_S > bound_S + 1e-6).any()) for bound_S in without]
    assert violated.min() > 10, violated


@fast
def test_depth_removes_the_error_of_the_leaves_and_not_that_of_the_baseline():
    mdp = random_mdp(6, 2, branching=2, seed=3)
    pi_SA = random_policy(mdp)
    v_S, best_S = exact.policy_values(mdp, pi_SA), exact.optimal(mdp).v_S
    excess = []
    for depth in (0, 20, 200):
        look = expectimax(TabularModel(mdp), all_states(mdp), depth=depth, v_leaf=lambda s: v_S[s] - 3.0)
        bound_S = look.q_BA.amax(-1) + 0.9 ** (depth + 1) * (best_S - v_S + 3.0).max() - (v_S + 0.5) + 0.5 + 0.5
        excess.append(float((bound_S - (best_S - v_S)).max()))
    assert excess[0] > excess[1] + 0.2
    assert excess[1] > excess[2] + 0.01
    assert excess[2] == pytest.approx(0.5, abs=1e-6), "a baseline that may be off by 0.5 both ways costs that much"


@fast
def test_what_was_pruned_is_lacking_where_it_was_pruned():
    left_out = 0
    for seed in range(200):
        mdp = random_mdp(8, 2, branching=2, reward_share=0.3, seed=seed)
        v_S, best_S = exact.policy_values(mdp, random_policy(mdp, seed)), exact.optimal(mdp).v_S
        depth, lack = 1 + seed % 4, float((best_S - v_S).max())
        root = torch.tensor([0])
        look = expectimax(TabularModel(mdp), root, depth=depth, v_leaf=lambda s: v_S[s], max_width=1 + seed % 2)  # noqa: B023
        behind_horizon = 0.9 ** (depth + 1) * lack
        assert float(best_S[0]) <= float(look.q_BA.max() + behind_horizon + look.pruned_BA.max() * lack) + 1e-9
        left_out += float(best_S[0]) > float(look.q_BA.max()) + behind_horizon + 1e-9
    assert left_out > 5


@fast
def test_a_sampled_lookahead_bounds_what_is_lacking_as_often_as_it_says():
    missed, idle, samples, low, high = 0, 0, 8, 0.0, 2.0
    for seed in range(80):
        mdp = random_mdp(5, 2, branching=2, reward_share=0.5, gamma=0.5, seed=seed)
        v_S, best_S, depth = exact.policy_values(mdp, random_policy(mdp, seed)), exact.optimal(mdp).v_S, 2
        look = sampled(
            TabularModel(mdp),
            torch.tensor([0]),
            depth=depth,
            v_leaf=lambda s: v_S[s],  # noqa: B023
            samples=samples,
            replicates=2,
            generator=stream(seed, "sampled"),
        )
        pairs = 2 * sum(look.nodes_per_level[:-1])
        error = (high - low) * np.sqrt(np.log(pairs * (pairs + 1) / 0.5) / (2 * samples))
        seen = float(look.q_BA.max()) + 0.5 ** (depth + 1) * float((best_S - v_S).max())
        missed += float(best_S[0]) > seen + error * (1 + 0.5 + 0.25) + 1e-9
        idle += float(best_S[0]) > seen + 1e-9
    assert missed <= 40
    assert idle > 2, "without the error of samples it is no bound"
