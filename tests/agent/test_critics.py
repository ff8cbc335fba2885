"""Estimates of values, each held to the exact ones."""

import math
from dataclasses import replace

import pytest
import torch
from gymnasium import spaces

from pgts_torch.agent.advantages import critic_targets, lambda_returns
from pgts_torch.agent.critics import Critic, ExactCritic, RolloutCritic, TabularCritic
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.options import (
    MLP,
    FixedHorizon,
    GeometricHorizon,
    MonteCarlo,
    NetworkValues,
    RolloutValues,
    TabularValues,
    TDLambda,
)
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid, ladder, random_mdp
from tests.agent.helpers import by_hand, experience, following, z_scores
from tests.support import random_policy, right_with, uniform_policy, zoo

METHODS = [MonteCarlo(), TDLambda(lambda_=0.9)]
FAR = 5.0
"""Standard errors; a normal mean lies farther off with probability 6e-7, and no test compares more than 40."""


def fit(critic: Critic, mdp: TabularMDP, pi_SA, horizon, *, episodes: int, seed: int = 0) -> dict[str, float]:
    made = experience(mdp, pi_SA, horizon, episodes=episodes, seed=seed)
    return critic.fit(following(pi_SA), made, generator=stream(seed, "critic"))


def error(critic: Critic, mdp: TabularMDP, pi_SA) -> float:
    """Root mean square error over all states, or all states and actions."""
    truth, states = exact.evaluate(mdp, pi_SA), torch.arange(mdp.num_states)
    if critic.target == "q":
        return float((critic.q(states) - truth.q_SA).square().mean().sqrt())
    return float((critic.v(states) - truth.v_S).square().mean().sqrt())


def truncated_values(mdp: TabularMDP, pi_SA, length: int):
    """The expected discounted reward of the first `length` steps."""
    v_S = torch.zeros(mdp.num_states, dtype=torch.float64)
    for _ in range(length):
        outcomes = mdp.outcomes
        later_SA = (outcomes.prob_NAK * outcomes.discount_NAK * v_S[outcomes.child_NAK]).sum(-1)
        v_S = (pi_SA * (outcomes.reward_NA + later_SA)).sum(-1)
    return v_S


@pytest.mark.parametrize(
    ("lambda_", "expected"),
    [
        # V(s_{t+1}) is 10 everywhere.  lambda = 0: r + 0.5 * 10, and r alone where the episode terminated.
        (0.0, [[6.0, 7.0, 9.0], [6.0, 7.0, 4.0], [6.0, 7.0]]),
        # lambda = 1: all rewards, and 10 only where the episode was cut.
        (1.0, [[1 + 0.5 * (2 + 0.5 * 9), 2 + 0.5 * 9, 9.0], [1 + 0.5 * (2 + 0.5 * 4), 2 + 0.5 * 4, 4.0], [4.5, 7.0]]),
        # lambda = 1/2: G = r + 0.5 (5 + G' / 2).
        (
            0.5,
            [[1 + 0.5 * (5 + 6.75 / 2), 2 + 0.5 * (5 + 9 / 2), 9.0], [1 + 0.5 * (5 + 5.5 / 2), 5.5, 4.0], [5.25, 7.0]],
        ),
    ],
)
def test_lambda_returns_are_those_computed_by_hand(lambda_, expected):
    made = by_hand()
    returns_TB = lambda_returns(made, torch.full((3, 3), 10.0, dtype=torch.float64), made.discount_TB, lambda_)
    for b, column in enumerate(expected):
        torch.testing.assert_close(returns_TB[: len(column), b], torch.tensor(column, dtype=torch.float64))


def test_the_exact_critic_is_the_exact_evaluation():
    mdp = zoo("garnet")
    pi_SA = random_policy(mdp, seed=3)
    critic, truth, states = ExactCritic(mdp), exact.evaluate(mdp, pi_SA), torch.tensor([4, 0, 4])
    assert critic.fit(following(pi_SA), by_hand(), generator=stream(0, "critic")) == {}
    torch.testing.assert_close(critic.v(states), truth.v_S[states], rtol=1e-13, atol=0)
    torch.testing.assert_close(critic.q(states), truth.q_SA[states], rtol=1e-13, atol=0)
    assert critic.model_calls == 0


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        # v(s_{t+1}) is 10: r + 5, and r alone where the episode terminated. The third episode was over in state 2.
        (TDLambda(lambda_=0.0), [6.0, 7.0, 9.0, 4.0]),
        # With a survival of 1: all rewards, and 10 where the first episode was cut.
        (MonteCarlo(), [17.0, 16.0, 14.0, 4.0]),
    ],
)
def test_targets_are_bootstrapped_where_an_episode_was_cut_and_not_where_it_terminated(method, expected):
    made = by_hand()
    target_V = critic_targets(made, torch.full((3, 3), 10.0, dtype=torch.float64), method)
    episode_V = made.of_visits(torch.arange(3).expand(3, 3))
    torch.testing.assert_close([*target_V[episode_V == 0].tolist(), float(target_V[episode_V == 1][2])], expected)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("horizon", [FixedHorizon(length=2), GeometricHorizon()], ids=["fixed", "geometric"])
@pytest.mark.parametrize("method", METHODS, ids=["Monte Carlo", "TD"])
@pytest.mark.parametrize("target", ["v", "q"])
@pytest.mark.parametrize("kind", ["table", "network"])
def test_critics_converge_to_the_values_of_a_fixed_policy(kind, target, method, horizon):
    # Where an episode is cut at its second step at the latest, a fit of the table leaves at most 1 - 0.2 (1 - 0.5) of
    # the error in its bootstrapped targets: 0.02 of the start after 40. The rest is the spread of about 1000 targets.
    mdp = random_mdp(6, 2, gamma=0.5, start=None)
    pi_SA = uniform_policy(mdp)
    options = {"target": target, "method": method}
    critic: Critic = TabularCritic(6, 2, TabularValues(**options, step_size=0.2, initial=0.0))
    fits, episodes, start = 40, 400, error(critic, mdp, pi_SA)
    if kind == "network":
        options |= {"network": MLP(hidden=()), "learning_rate": 0.03, "minibatch_size": 1024}
        critic, fits, episodes = NetworkCritic(spaces.Discrete(6), 2, NetworkValues(**options)), 8, 4000
    losses = [fit(critic, mdp, pi_SA, horizon, episodes=episodes, seed=seed)["value"] for seed in range(fits)]
    assert error(critic, mdp, pi_SA) < 0.05 < 0.06 * start
    assert losses[-1] < losses[0]
    # What two steps earn without the rest would be far off: the cut end of an episode is estimated, not left out.
    assert (truncated_values(mdp, pi_SA, 2) - exact.evaluate(mdp, pi_SA).v_S).abs().min() > 0.2


@pytest.mark.parametrize("method", METHODS)
def test_a_terminal_outcome_is_not_bootstrapped(method):
    mdp = deep_sea(3, gamma=0.9, stochastic=True)
    pi_SA = right_with(*[0.9] * 9)
    critic = TabularCritic(9, 2, TabularValues(method=method, step_size="mean", initial=100.0))
    for seed in range(5):
        fit(critic, mdp, pi_SA, FixedHorizon(length=3), episodes=2000, seed=seed)
    last_row = torch.tensor([6, 7, 8])
    truth_S = exact.evaluate(mdp, pi_SA).v_S
    torch.testing.assert_close(critic.v(last_row), truth_S[last_row], atol=0.02, rtol=0)


@pytest.mark.parametrize("target", ["v", "q"])
def test_an_unvisited_cell_keeps_the_initial_value(target):
    mdp = ladder(5)
    pi_SA = right_with(0.5, 0.0, 0.5, 0.5, 0.5)
    for initial in (0.0, 7.5):
        critic = TabularCritic(5, 2, TabularValues(target=target, initial=initial))
        fit(critic, mdp, pi_SA, FixedHorizon(length=30), episodes=20)
        asked = critic.v if target == "v" else critic.q
        assert (asked(torch.tensor([2, 3, 4])) == initial).all()
    assert not (asked(torch.tensor([0])) == 7.5).any()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("target", ["v", "q"])
def test_an_unvisited_cell_has_the_mean_of_the_targets(target, method):
    mdp = random_mdp(30, 2, branching=2, seed=4, gamma=0.9)
    critic = TabularCritic(30, 2, TabularValues(target=target, method=method, step_size=1.0))
    made = experience(mdp, uniform_policy(mdp), FixedHorizon(length=3), episodes=6)
    critic.fit(following(uniform_policy(mdp)), made, generator=stream(0, "critic"))
    count_C, value_C = critic.state_dict()["count_C"], critic.state_dict()["value_C"]
    unseen = count_C == 0
    assert 3 < int(unseen.sum()) < len(count_C) - 3
    # With a step of 1 each visited cell holds the mean of its targets.
    mean = (count_C * value_C).sum() / count_C.sum()
    torch.testing.assert_close(value_C[unseen], mean.expand(int(unseen.sum())))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("target", ["v", "q"])
def test_a_constant_in_all_rewards_adds_the_same_to_all_values_visited_or_not(target, method):
    mdp = random_mdp(30, 2, branching=2, seed=4, gamma=0.9)

    def values(factor: float, constant: float) -> torch.Tensor:
        critic = TabularCritic(30, 2, TabularValues(target=target, method=method))
        for seed in range(3):
            made = experience(mdp, uniform_policy(mdp), FixedHorizon(length=3), episodes=4, seed=seed)
            made = replace(made, reward_TB=factor * made.reward_TB + constant)
            critic.fit(following(uniform_policy(mdp)), made, generator=stream(0, "critic"))
        return critic.state_dict()["value_C"]

    unseen = values(1.0, 0.0)
    if method == METHODS[-1]:
        torch.testing.assert_close(values(1.0, -3.0), unseen - 30)
    assert torch.equal(values(2.0**-17, 0.0), 2.0**-17 * unseen)


def test_unvisited_cells_are_0_where_all_targets_are_bootstrapped_in_them():
    mdp = ladder(5, gamma=1.0)
    critic = TabularCritic(5, 2, TabularValues(method=TDLambda(lambda_=0.0)))
    fit(critic, mdp, right_with(*[1.0] * 5), FixedHorizon(length=1), episodes=2)
    assert critic.v(torch.arange(1, 5)).tolist() == [0.0] * 4


def test_a_step_moves_each_value_toward_the_mean_of_its_targets():
    made = by_hand()
    critic = TabularCritic(4, 1, TabularValues(method=TDLambda(lambda_=0.0), step_size=0.25, initial=0.0))
    value_S = torch.tensor([8.0, 10.0, 10.0, 10.0], dtype=torch.float64)
    critic.load_state_dict({"value_C": value_S, "count_C": torch.zeros(4, dtype=torch.float64)})
    loss = critic.fit(following(torch.ones(4, 1, dtype=torch.float64)), made, generator=stream(0, "critic"))
    # Targets: 6 at state 0, 7 at state 1, 9 and 4 at state 2 (the third episode was over by then).
    expected_S = torch.tensor([8 - 0.25 * 2, 10 - 0.25 * 3, 10 - 0.25 * 3.5, 10.0], dtype=torch.float64)
    torch.testing.assert_close(critic.v(torch.arange(4)), expected_S)
    assert loss["value"] == pytest.approx((3 * 2**2 + 3 * 3**2 + 1**2 + 6**2) / 8)


@pytest.mark.parametrize("initial", [0.0, "mean"])
def test_targets_that_are_not_finite_leave_the_table_as_it_is(initial):
    made = by_hand()
    critic = TabularCritic(4, 1, TabularValues(initial=initial))
    before = critic.state_dict()
    spoiled = replace(made, reward_TB=made.reward_TB + math.nan)
    with pytest.raises(NotFinite):
        critic.fit(following(torch.ones(4, 1, dtype=torch.float64)), spoiled, generator=stream(0, "critic"))
    assert all(torch.equal(value, before[name]) for name, value in critic.state_dict().items())


def test_v_of_a_q_critic_is_the_mean_of_q_under_the_policy():
    mdp = ladder(3)
    pi_SA = right_with(0.2, 0.5, 0.9)
    critic = TabularCritic(3, 2, TabularValues(target="q"))
    fit(critic, mdp, pi_SA, FixedHorizon(length=20), episodes=30)
    states = torch.arange(3)
    torch.testing.assert_close(critic.v(states), (pi_SA * critic.q(states)).sum(-1))
    with pytest.raises(PgtsError, match="learns v"):
        TabularCritic(3, 2).q(states)


def test_the_rollout_critic_is_unbiased_also_where_the_policy_never_goes():
    mdp = ladder(5, gamma=0.8)
    pi_SA = right_with(0.0, 0.6, 0.6, 0.6, 0.6)
    truth, repeats = exact.evaluate(mdp, pi_SA), 500
    assert (truth.d_S[1:] == 0).all()
    critic = RolloutCritic(TabularModel(mdp), RolloutValues(samples=4))
    critic.fit(following(pi_SA), by_hand(), generator=stream(0, "critic"))
    states = torch.arange(5).repeat(repeats)
    assert z_scores(critic.v(states).view(repeats, 5), truth.v_S).abs().max() < FAR
    q_BX = critic.q(states).view(repeats, 10)
    assert z_scores(q_BX, truth.q_SA.reshape(-1)).abs().max() < FAR
    assert z_scores(q_BX, exact.bellman(mdp, truth.q_SA).reshape(-1)).abs().max() > 2 * FAR


def test_a_short_fixed_horizon_leaves_out_later_rewards():
    mdp = random_mdp(6, 2, gamma=0.7)
    pi_SA = random_policy(mdp, seed=1)
    critic = RolloutCritic(TabularModel(mdp), RolloutValues(samples=4, horizon=FixedHorizon(length=3)))
    critic.fit(following(pi_SA), by_hand(), generator=stream(0, "critic"))
    v_BS = critic.v(torch.arange(6).repeat(1000)).view(1000, 6)
    assert z_scores(v_BS, truncated_values(mdp, pi_SA, 3)).abs().max() < FAR
    assert z_scores(v_BS, exact.evaluate(mdp, pi_SA).v_S).abs().min() > 2 * FAR


def test_the_rollout_critic_counts_its_model_calls():
    mdp = grid(4, traps=(5,))
    critic = RolloutCritic(TabularModel(mdp), RolloutValues(samples=3, horizon=FixedHorizon(length=7)))
    critic.fit(following(uniform_policy(mdp)), by_hand(), generator=stream(0, "critic"))
    assert critic.model_calls == 0
    critic.v(torch.arange(5))
    assert critic.model_calls == 5 * 3 * 7
    critic.q(torch.arange(5))
    assert critic.model_calls == 5 * 3 * 7 + 5 * 4 * 3 * 7

    ending = RolloutCritic(TabularModel(deep_sea(4)), RolloutValues(samples=2, horizon=FixedHorizon(length=50)))
    ending.fit(following(uniform_policy(deep_sea(4))), by_hand(), generator=stream(0, "critic"))
    ending.v(torch.tensor([0, 15]))
    assert ending.model_calls == 2 * 4 + 2 * 1


@pytest.mark.parametrize("target", ["v", "q"])
def test_a_loaded_tabular_critic_continues_like_the_saved_one(target):
    mdp = ladder(4)
    pi_SA = uniform_policy(mdp)
    critic, other = (TabularCritic(4, 2, TabularValues(target=target, step_size="mean")) for _ in range(2))
    fit(critic, mdp, pi_SA, FixedHorizon(length=20), episodes=5)
    state = critic.state_dict()
    other.load_state_dict(state)
    for seed in (1, 2):
        for each in (critic, other):
            fit(each, mdp, pi_SA, FixedHorizon(length=20), episodes=5, seed=seed)
    assert all(torch.equal(value, other.state_dict()[name]) for name, value in critic.state_dict().items())
    assert not torch.equal(state["value_C"], critic.state_dict()["value_C"])


def test_a_state_that_does_not_fit_a_critic_is_refused():
    critic = TabularCritic(4, 2)
    state = critic.state_dict()
    for wrong in [
        {},
        {"value_C": state["value_C"]},
        state | {"count_C": torch.zeros(8)},
        state | {"value_C": [0.0] * 4},
    ]:
        with pytest.raises(PgtsError, match="_C is"):
            critic.load_state_dict(wrong)
    for forgetful in (ExactCritic(ladder()), RolloutCritic(TabularModel(ladder()))):
        forgetful.load_state_dict(forgetful.state_dict())
        with pytest.raises(PgtsError, match="value_C"):
            forgetful.load_state_dict(state)


def test_a_critic_that_is_queried_before_its_first_fit_says_so():
    states = torch.arange(3)
    for critic in (
        ExactCritic(ladder()),
        RolloutCritic(TabularModel(ladder())),
        TabularCritic(5, 2, TabularValues(target="q")),
    ):
        with pytest.raises(PgtsError, match="has no values yet"):
            critic.v(states)
