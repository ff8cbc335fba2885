"""Actions drawn from a policy and a wider proposal: their weights, and the lookahead over them against closed forms."""

import pytest
import torch
from scipy import stats

from benchmarks.linear import LinearQuadratic
from pgts_torch.agent.gaussian import Normals
from pgts_torch.search import expectimax
from pgts_torch.search.mcts import mcts
from tests.agent.continuous import GAMMA, drawing, gaussian, some_states


def test_the_closed_form_is_a_fixed_point_and_the_maximum_over_a_fine_grid_of_forces():
    model = LinearQuadratic.double_integrator(gamma=GAMMA)
    P_DD = model.optimal()
    assert torch.allclose(model.improved(P_DD), P_DD, rtol=1e-12)
    state_ND, force_AX = torch.tensor([[1.0, -0.5]]).double(), torch.linspace(-4, 4, 80_001).double()[:, None]
    best = model.q(P_DD, state_ND.expand(len(force_AX), 2), force_AX).max()
    assert float(best) == pytest.approx(float(model.v(P_DD, state_ND)), abs=1e-7)


def lookahead_error(count: int, depth: int, states: int = 40) -> float:
    """By how much T_K^m q is below T^m q on average, with v = -|s|^2 at the leaves."""
    model = LinearQuadratic.double_integrator(gamma=GAMMA)
    root_B, P_DD = some_states(model, states), torch.eye(2).double()
    drawn = drawing(model, gaussian(), count, scale=3.0)
    action_BKX = drawn.drawn(root_B).action_NKX
    found = expectimax(drawn, root_B, depth=depth, v_leaf=lambda state_N: model.v(P_DD, model.states(state_N)))
    for _ in range(depth):
        P_DD = model.improved(P_DD)
    state_RD = model.states(root_B).repeat_interleave(count, 0)
    truth_BK = model.q(P_DD, state_RD, action_BKX.flatten(0, 1)).view(-1, count)
    short_BK = truth_BK - found.q_BA
    assert float(short_BK.min()) > -1e-9  # a maximum over some actions is never above that over all
    return float(short_BK.mean())


def test_without_a_maximum_the_lookahead_over_drawn_actions_is_exact():
    assert lookahead_error(5, depth=0) < 1e-12


def test_the_lookahead_over_drawn_actions_tends_to_that_over_all_with_the_square_of_their_number():
    few, many = lookahead_error(8, depth=1), lookahead_error(64, depth=1)
    assert few > 1e-3
    assert many < few / 30  # 8^2 = 64 in the limit


def test_two_steps_ahead_it_tends_to_the_closed_form_too():
    few, many = lookahead_error(4, depth=2, states=10), lookahead_error(24, depth=2, states=10)
    assert many < few / 10


def test_in_the_limit_it_is_the_lookahead_over_a_fine_grid_of_actions():
    grid_AX = torch.linspace(-6, 6, 241)[:, None]
    drawn_model = LinearQuadratic.double_integrator(gamma=GAMMA)
    grid_model = LinearQuadratic.double_integrator(gamma=GAMMA, action_AX=grid_AX)
    root_B = some_states(drawn_model, 10)
    grid_root_B = grid_model.number(drawn_model.states(root_B))
    drawn = drawing(drawn_model, gaussian(), 200, scale=3.0)

    def best(model, root_B, inner):
        look = expectimax(model, root_B, depth=1, v_leaf=lambda state_N: -inner.states(state_N).square().sum(-1))
        return look.q_BA.amax(-1)

    apart_B = best(drawn, root_B, drawn_model) - best(grid_model, grid_root_B, grid_model)
    assert float(apart_B.abs().max()) < 5e-3


def test_weights_give_the_expectation_under_the_policy_whatever_the_proposal():
    model, policy = LinearQuadratic.double_integrator(gamma=GAMMA), gaussian()
    state_N, P_DD = some_states(model, 300), torch.eye(2).double()
    normals = policy.normals(model.states(state_N).float())
    force_NX, scale = normals.mean_NX.double(), normals.std_NX.double()
    # E q(s, a) = q(s, mean) - (N + gamma G^T P G) std^2
    price = float(model.N_XX + GAMMA * model.G_DX.T @ P_DD @ model.G_DX)
    truth_N = model.q(P_DD, model.states(state_N), force_NX) - price * scale[:, 0].square()
    # The standard deviation of q is 1.5 under the policy, so 64 independent actions would be off by 0.19.
    for width, count, most in ((1.0, 64, 0.1), (3.0, 64, 0.06), (3.0, 512, 0.01)):
        action_NKX, prob_NK = drawing(model, policy, count, scale=width).drawn(state_N)
        q_NK = model.q(P_DD, model.states(state_N).repeat_interleave(count, 0), action_NKX.flatten(0, 1)).view(
            -1, count
        )
        error_N = (prob_NK.double() * q_NK).sum(-1) - truth_N
        assert float(error_N.square().mean().sqrt()) < most
        unweighted_N = q_NK.mean(-1) - truth_N
        assert width == 1 or float(unweighted_N.mean()) < -0.5  # the wide draws alone would be worse


def test_every_draw_has_the_distribution_that_it_is_drawn_from():
    model, policy = LinearQuadratic.double_integrator(gamma=GAMMA), gaussian(2)
    state_N = some_states(model, 2000)
    normals = policy.normals(model.states(state_N).float())
    action_NKX = drawing(model, policy, 5, scale=2.5).drawn(state_N).action_NKX
    z_NKX = normals.standardised(action_NKX).double()
    for k, scale in enumerate([1.0, 2.5, 1.0, 2.5, 1.0]):
        for x in range(2):
            # 10 tests; each of a right sampler falls below this once in 10^5.
            assert stats.kstest(z_NKX[:, k, x].numpy() / scale, "norm").pvalue > 1e-5
    assert stats.kstest(z_NKX[:, 1, 0].numpy(), "norm").pvalue < 1e-5


def test_a_state_has_the_same_actions_until_they_are_drawn_again_also_after_an_update():
    model, policy = LinearQuadratic.double_integrator(gamma=GAMMA), gaussian()
    state_N = some_states(model, 6)
    drawn = drawing(model, policy, 4)
    first = drawn.drawn(state_N).action_NKX
    for weight in policy.network.weights:
        weight.data += 1
    assert torch.equal(drawn.drawn(state_N[[3, 1]]).action_NKX, first[[3, 1]])
    assert not torch.equal(drawing(model, policy, 4).drawn(state_N).action_NKX, first)
    assert not torch.equal(first[0], first[1])


def test_a_tree_search_over_drawn_actions_with_all_simulations_is_expectimax():
    model = LinearQuadratic.double_integrator(gamma=GAMMA)
    root_B, drawn = some_states(model, 3), drawing(model, gaussian(), 3)
    v_leaf = lambda state_N: -model.states(state_N).square().sum(-1)  # noqa: E731
    wide = expectimax(drawn, root_B, depth=2, v_leaf=v_leaf).q_BA
    tree = mcts(drawn, root_B, depth=2, v_leaf=v_leaf, simulations=200)
    assert torch.allclose(tree.q_BA, wide, rtol=1e-12)


def test_log_densities_entropies_and_divergences_are_those_of_torch():
    generator = torch.Generator().manual_seed(1)
    mean_2NX, std_2NX = torch.randn(2, 5, 3, generator=generator), torch.rand(2, 5, 3, generator=generator) + 0.1
    one, other = (Normals(mean_2NX[i], std_2NX[i]) for i in range(2))
    theirs = [torch.distributions.Independent(torch.distributions.Normal(*each), 1) for each in (one, other)]
    action_NKX = torch.randn(5, 4, 3, generator=generator)
    expected_NK = theirs[0].log_prob(action_NKX.transpose(0, 1)).T
    assert torch.allclose(one.log_density(action_NKX), expected_NK, rtol=1e-5)
    assert torch.allclose(one.entropy(), theirs[0].entropy(), rtol=1e-5)
    assert torch.allclose(one.divergence(other), torch.distributions.kl_divergence(*theirs), rtol=1e-5)
