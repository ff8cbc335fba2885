"""Upper bounds of v* from what a search has asked: above the truth at any time, and equal to Proposition 6 at last."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pgts_torch.bellman import Outcomes
from pgts_torch.models import TabularModel
from pgts_torch.models.base import EnumeratingModel
from pgts_torch.search import upper
from pgts_torch.search.expectimax import expectimax
from pgts_torch.search.topology import Topology
from pgts_torch.search.upper import UpperBound
from pgts_torch.tabular import TabularMDP, exact, grid, random_mdp, stationary
from tests.support import mdps, random_policy, zoo

SETTLES = 400
"""Calls after which nothing changes any more."""


def expanded(mdp: TabularMDP, levels: int, dtype: torch.dtype = torch.float64) -> Topology:
    """What a lookahead of so many levels from the start states asks."""
    model = TabularModel(mdp, dtype=dtype)
    topology = Topology(model)
    starts = torch.nonzero(mdp.start_S).flatten()
    expectimax(model, starts, depth=levels, q_leaf=lambda s: torch.zeros(len(s), mdp.num_actions), topology=topology)
    return topology


def bound(topology: Topology, mdp: TabularMDP, calls: int = SETTLES) -> UpperBound:
    made = UpperBound(topology, topology.model.highest_value, gamma=float(mdp.outcomes.discount_NAK.max()))
    for _ in range(calls):
        made.tighten(1)
    return made


EVERY_KIND = ["ladder", "tightrope", "garnet", "grid", "deep_sea", "FrozenLake", "CliffWalking", "Taxi"]


@pytest.mark.parametrize("name", EVERY_KIND)
@pytest.mark.parametrize("levels", [1, 3, 12])
def test_it_comes_down_to_the_certificate_of_the_exact_world(name, levels):
    mdp = zoo(name)
    every = torch.arange(mdp.num_states)
    pi_SA = random_policy(mdp)
    truth = stationary.certificate(mdp, pi_SA, levels - 1)
    found = float(mdp.start_S @ (bound(expanded(mdp, levels), mdp).at(every) - exact.policy_values(mdp, pi_SA)))
    assert found == pytest.approx(truth, rel=1e-7, abs=1e-7)


def test_fewer_expanded_states_give_a_higher_bound():
    """The negative control: the certificate of another depth is another number."""
    mdp, every = zoo("deep_sea"), torch.arange(zoo("deep_sea").num_states)
    shallow, deep = (float(mdp.start_S @ bound(expanded(mdp, levels), mdp).at(every)) for levels in (3, 6))
    assert shallow > deep + 0.1


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_it_is_above_the_optimal_values_at_any_time_and_never_rises(scale, monkeypatch):
    monkeypatch.setattr(upper, "MOST_SWEEPS", 1)
    for seed in range(8):
        mdp = random_mdp(20, 3, branching=2, seed=seed, gamma=0.97, start=0)
        mdp = replace(mdp, outcomes=replace(mdp.outcomes, reward_NA=scale * mdp.outcomes.reward_NA))
        every, v_S = torch.arange(mdp.num_states), exact.optimal(mdp).v_S
        topology = Topology(TabularModel(mdp))
        made = UpperBound(topology, topology.model.highest_value, gamma=0.97)
        before_S = made.at(every)
        for step in range(60):
            if step % 6 == 0:  # another state is expanded now and then
                topology.preload(torch.tensor([step // 3]))
            made.tighten(1)
            now_S = made.at(every)
            assert bool((now_S >= v_S).all())
            assert bool((now_S <= before_S).all())
            before_S = now_S
        assert float((now_S - v_S).mean()) < 0.99 * float((made.w - v_S).mean())


@given(mdps(), st.integers(0, 3))
def test_it_is_above_the_optimal_values_whatever_the_outcomes(mdp, levels):
    made = bound(expanded(mdp, levels), mdp, calls=3)
    assert bool((made.at(torch.arange(mdp.num_states)) >= exact.optimal(mdp).v_S - 1e-12).all())


def test_it_sweeps_no_more_than_its_budget_and_no_more_at_all_once_it_has_settled(monkeypatch):
    mdp = zoo("FrozenLake")
    monkeypatch.setattr(upper, "MOST_SWEEPS", 16)
    made = bound(expanded(mdp, 8), mdp, calls=0)
    assert [made.tighten(4), made.tighten(5)] == [16, 16]
    for _ in range(SETTLES):
        made.tighten(1)
    assert made.tighten(1) == 0


def test_after_as_many_sweeps_as_levels_it_is_no_higher_than_T_to_the_n_of_the_highest_value(monkeypatch):
    monkeypatch.setattr(upper, "MOST_SWEEPS", 1)
    mdp = grid(6, gamma=0.95)
    topology = expanded(mdp, 5)
    made, start = bound(topology, mdp, calls=0), torch.tensor([0])
    hoped_SA = torch.full((mdp.num_states, mdp.num_actions), topology.model.highest_value).double()
    backed_up = float(exact.lookahead(mdp, hoped_SA, 5)[0].max())
    assert float(made.swept(start, 5)) == pytest.approx(backed_up, rel=1e-10)
    made.tighten(5)
    assert float(made.at(start)) <= backed_up + 1e-9


def test_T_to_the_n_of_the_highest_value_does_not_depend_on_what_else_was_queried():
    mdp = grid(6, gamma=0.95)
    little, much = expanded(mdp, 3), expanded(mdp, 12)
    swept = [float(bound(topology, mdp, calls=0).swept(torch.tensor([0]), 3)) for topology in (little, much)]
    assert swept[0] == swept[1]
    assert float(bound(much, mdp).at(torch.tensor([0]))) < swept[1] - 0.1


def test_where_gamma_is_1_costs_are_bounded_and_rewards_are_not():
    walk = [[[(1.0, s + 1, -1.0, s == 3)], [(1.0, 0, -1.0, False)]] for s in range(4)] + [[[(1.0, 4, 0.0, True)]] * 2]
    costs = TabularMDP.from_transitions(walk, 1.0, start=0)
    made = bound(expanded(costs, 8), costs)
    assert made.at(torch.tensor([0, 3])).tolist() == pytest.approx([-4, -1], abs=1e-9)
    rewards = random_mdp(3, 2, gamma=1.0)
    assert bound(expanded(rewards, 2), rewards).at(torch.tensor([0])).tolist() == [math.inf]


def test_a_state_that_may_stay_for_nothing_undiscounted_bounds_nothing_and_leaves_others_their_bound():
    """As one in which an episode was truncated: T says nothing of it."""
    stays = Outcomes(
        torch.tensor([[0.0, 1.0], [0.0, -math.inf]]).double(),
        torch.ones(2, 2, 1).double(),
        torch.tensor([[0.9, 0.9], [1.0, 0.0]], dtype=torch.float64).unsqueeze(-1),
        torch.tensor([[0, 1], [1, 1]]).unsqueeze(-1),
        2,
    )
    topology = Topology(Listed(stays))
    topology.preload(torch.tensor([0, 1]))
    made = UpperBound(topology, 10.0, gamma=0.9)
    for _ in range(SETTLES):
        made.tighten(1)
    assert made.at(torch.tensor([0, 1])).tolist() == pytest.approx([10.0, 10.0])
    assert bool((made.at(torch.tensor([0, 1])) >= 10.0).all())


def test_a_saved_bound_goes_on_with_the_same_bits():
    mdp, every = random_mdp(40, 3, branching=2, seed=3, gamma=0.98, start=0), torch.arange(40)
    first = bound(expanded(mdp, 2), mdp, calls=2)
    topology = Topology(TabularModel(mdp))
    topology.preload(first.topology.table.queried)
    second = bound(topology, mdp, calls=0)
    second.load_state_dict(first.state_dict())
    for one in (first, second):
        one.tighten(1)
        one.topology.preload(torch.tensor([5, 6, 7]))
    assert torch.equal(first.at(every), second.at(every))
    third = bound(topology, mdp, calls=0)
    third.load_state_dict(first.state_dict())  # after the topology has grown, which `first` has not taken in yet
    for one in (first, second, third):
        one.tighten(1)
    assert torch.equal(first.at(every), second.at(every))
    assert torch.equal(first.at(every), third.at(every))


def test_it_is_an_upper_bound_also_with_rewards_in_float32():
    mdp = random_mdp(20, 3, branching=1, seed=2, gamma=0.97, start=0)
    made = bound(expanded(mdp, 20, torch.float32), mdp)
    rounded = replace(mdp, outcomes=mdp.outcomes.to(dtype=torch.float32).to(dtype=torch.float64))
    v_S = exact.optimal(rounded).v_S
    reached_S = made.at(torch.arange(20)) < made.w
    assert int(reached_S.sum()) > 5
    assert bool((made.at(torch.arange(20)) >= v_S).all())
    assert made.at(torch.arange(20))[reached_S].tolist() == pytest.approx(v_S[reached_S].tolist(), abs=1e-4)


class Listed(EnumeratingModel):
    """Some outcomes."""

    def __init__(self, table: Outcomes) -> None:
        self.table, self.num_states, self.num_actions = table, table.num_states, table.num_actions
        self.device, self.dtype = table.device, table.dtype

    def outcomes(self, state_N):
        return self.table.rows(state_N)
