"""The direction that a sampled iteration moves in is an unbiased estimate of the exact one."""

import functools

import pytest
import torch
from torch import Tensor

from pgts_torch import PGTS
from pgts_torch.agent.critics import RolloutCritic
from pgts_torch.agent.policies import SimplexPolicy, SoftmaxPolicy
from pgts_torch.agent.updates import SoftmaxUpdate
from pgts_torch.bellman import Outcomes
from pgts_torch.models import TabularModel
from pgts_torch.options import RolloutValues, SoftmaxGradient
from pgts_torch.search import expectimax
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact, ladder, random_mdp
from pgts_torch.tabular.ascent import softmax_direction
from tests.agent.helpers import vector_env, z_scores
from tests.support import random_policy, right_with, uniform_policy

pytestmark = pytest.mark.usefixtures("unchecked_shapes")  # other tests check them; here they cost half the time

FAR = 5.5
"""Standard errors of a mean of 40; Student's t with 39 degrees of freedom lies farther off with probability 3e-6, so a
comparison of at most 20 numbers fails by chance with probability below 1e-4."""

REPEATS = 40

PROBLEMS: dict[str, tuple[TabularMDP, Tensor]] = {
    "ladder": (ladder(3, gamma=0.7), right_with(0.6, 0.4, 0.5)),
    "random": (random_mdp(5, 3, branching=2, gamma=0.7), random_policy(random_mdp(5, 3), seed=2)),
}


@functools.cache
def sampled_directions(problem: str, depth: int, critic: str) -> Tensor:
    """What single iterations from the same policy add to its logits, shape [REPEATS, S * A]."""
    mdp, pi_SA = PROBLEMS[problem]
    policy = SoftmaxPolicy(mdp.num_states, mdp.num_actions)
    algorithm = PGTS(
        vector_env(mdp, 150),
        depth=depth,
        policy=policy,
        critic=critic if critic == "exact" else {"type": critic, "samples": 64},
        update=SoftmaxUpdate(SoftmaxGradient(step_size=1.0)),
        horizon="geometric",
    )
    directions = []
    for _ in range(REPEATS):
        policy.load_state_dict({"logits_SA": pi_SA.log()})
        algorithm.iterate()
        directions.append((policy.logits_SA - pi_SA.log()).reshape(-1))
    return torch.stack(directions)


def exact_direction(problem: str, depth: int) -> Tensor:
    mdp, pi_SA = PROBLEMS[problem]
    truth = exact.evaluate(mdp, pi_SA)
    return softmax_direction(pi_SA, exact.lookahead(mdp, truth.q_SA, depth), truth.d_S).reshape(-1)


@pytest.mark.parametrize("depth", [0, 1, 3])
@pytest.mark.parametrize("problem", PROBLEMS)
def test_with_exact_values_the_sampled_direction_is_unbiased_at_every_depth(problem, depth):
    sample_BX = sampled_directions(problem, depth, "exact")
    assert z_scores(sample_BX, exact_direction(problem, depth)).abs().max() < FAR
    other = 1 if depth != 1 else 0
    assert z_scores(sample_BX, exact_direction(problem, other)).abs().max() > 2 * FAR


@pytest.mark.parametrize("problem", PROBLEMS)
def test_with_sampled_values_the_policy_gradient_is_unbiased(problem):
    sample_BX = sampled_directions(problem, 0, "rollout")
    assert z_scores(sample_BX, exact_direction(problem, 0)).abs().max() < FAR
    assert z_scores(sample_BX, exact_direction(problem, 1)).abs().max() > FAR


def test_at_depth_0_the_exact_direction_is_the_gradient_of_the_return():
    mdp, pi_SA = PROBLEMS["random"]
    direction_SA = exact_direction("random", 0).view_as(pi_SA)
    for s in range(mdp.num_states):
        for a in range(mdp.num_actions):
            up, down = pi_SA.log(), pi_SA.log()
            up[s, a] += 1e-5
            down[s, a] -= 1e-5
            slope = (exact.evaluate(mdp, up.softmax(-1)).J - exact.evaluate(mdp, down.softmax(-1)).J) / 2e-5
            assert float(direction_SA[s, a]) == pytest.approx(slope, abs=1e-8)


def side_by_side(mdp: TabularMDP, copies: int) -> TabularMDP:
    """Many copies of an MDP in one, so that one search makes as many lookaheads that share nothing."""
    outcomes = mdp.outcomes
    offset_N11 = torch.arange(copies).repeat_interleave(mdp.num_states)[:, None, None] * mdp.num_states
    return TabularMDP(
        Outcomes(
            outcomes.reward_NA.repeat(copies, 1),
            outcomes.prob_NAK.repeat(copies, 1, 1),
            outcomes.discount_NAK.repeat(copies, 1, 1),
            outcomes.child_NAK.repeat(copies, 1, 1) + offset_N11,
            copies * mdp.num_states,
        ),
        mdp.start_S.repeat(copies) / copies,
    )


def test_the_maximum_over_noisy_leaves_is_biased_upward_and_less_with_more_samples():
    # Mean errors of all 24 root values in 100 lookaheads; a normal mean is 5 standard errors off with probability 6e-7.
    mdp = random_mdp(3, 8, gamma=0.6)
    truth_SA = exact.evaluate(mdp, uniform_policy(mdp)).q_SA
    many = side_by_side(mdp, 100)

    def errors(depth: int, samples: int) -> Tensor:
        model = TabularModel(many)
        critic = RolloutCritic(model, RolloutValues(samples=samples, target="q"))
        critic.fit(SimplexPolicy(300, 8), None, generator=stream(samples, "critic"))
        look = expectimax(model, torch.arange(300), q_leaf=critic.q, depth=depth)
        return (look.q_BA.view(100, 3, 8) - exact.lookahead(mdp, truth_SA, depth)).mean((1, 2))[:, None]

    zero = torch.zeros(1, dtype=torch.float64)
    assert abs(z_scores(errors(0, 2), zero)) < 5
    biases = []
    for samples in (1, 4, 16):
        error_B = errors(2, samples)
        assert z_scores(error_B, zero) > 5
        biases.append(float(error_B.mean()))
    assert biases[0] > 1.5 * biases[1] > 1.5 * 1.5 * biases[2]
