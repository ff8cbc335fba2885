"""The visits that a lookahead starts from where they are drawn: what they stand for, and how many there are."""

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.roots import Roots, roots_of
from pgts_torch.errors import PgtsError
from pgts_torch.ranks import ALONE

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

FAR = 6.0
"""Standard errors, of at most 400 means each."""

TABLE = {"env": "pgts/Grid-v0", "num_envs": 4, "horizon": {"type": "fixed", "length": 60}}
NETWORK = {"env": "CartPole-v1", "depth": 1, "num_envs": 3, "horizon": {"type": "fixed", "length": 40}}
MERGING = NETWORK | {"env": "CliffWalking-v1", "policy": {"type": "mlp", "hidden": [8]}, "gamma": 0.95}


def draws(number: int) -> Draws:
    return Draws.of(ALONE, 0, number, torch.device("cpu"))


def roots(model: PGTS, experience, weight: str, *, max_roots: int | None, number: int = 0) -> Roots:
    return roots_of(experience, model.world, weight, max_roots, draws(number))


@pytest.mark.parametrize("weight", ["occupancy", "visits", "uniform"])
@pytest.mark.parametrize("arguments", [TABLE, NETWORK, MERGING])
def test_drawn_visits_weigh_in_the_mean_as_all_visits_do(arguments, weight):
    model = PGTS(**arguments)
    experience = model.iterate().experience
    whole = roots(model, experience, weight, max_roots=None)
    count, drawn = len(whole.state_N), 400
    weight_DN, occupancy_DN, plain_DN = torch.zeros(3, drawn, count, dtype=torch.float64)
    for number in range(drawn):
        some = roots(model, experience, weight, max_roots=count // 3, number=number)
        assert 0 < len(some.state_N) <= count // 3
        place_N = torch.searchsorted(whole.state_N, some.state_N)
        assert whole.state_N[place_N].equal(some.state_N)
        assert whole.observation_N[place_N].equal(some.observation_N)
        weight_DN[number, place_N] = some.weight_N
        occupancy_DN[number, place_N] = some.occupancy_N
        plain_DN[number, place_N] = whole.weight_N[place_N]  # as if those drawn stood for themselves

    def z_scores(sample_DN: torch.Tensor, truth_N: torch.Tensor) -> torch.Tensor:
        return (sample_DN.mean(0) - truth_N) / (sample_DN.std(0) / drawn**0.5).clamp(min=1e-12)

    assert z_scores(weight_DN, whole.weight_N).abs().max() < FAR
    assert z_scores(occupancy_DN, whole.occupancy_N).abs().max() < FAR
    assert z_scores(plain_DN, whole.weight_N).abs().max() > 2 * FAR


@pytest.mark.parametrize("arguments", [TABLE, NETWORK])
def test_the_policy_gradient_of_drawn_visits_is_that_of_all_in_the_mean(arguments):
    model = PGTS(**arguments)
    experience = model.iterate().experience
    model.estimator.evaluate(experience, draws(0))

    def gradient(max_roots: int | None, number: int) -> torch.Tensor:
        """sum_s w(s) A(s, .) by action: what every gradient of the policy is linear in."""
        model.estimator._max_roots = max_roots
        batch = model.estimator(experience, draws(number))
        return batch.weight_N @ batch.advantage_NA.double()

    whole_A = gradient(None, 0)
    some_DA = torch.stack([gradient(20, number) for number in range(200)])
    error_A = some_DA.std(0) / 200**0.5
    assert ((some_DA.mean(0) - whole_A) / error_A).abs().max() < FAR
    assert ((0.1 * some_DA.mean(0) - whole_A) / error_A).abs().max() > 2 * FAR
    assert not some_DA[0].equal(some_DA[1])


def test_no_more_states_are_searched_than_there_may_be_roots_and_all_where_they_are_no_more():
    calls = {}
    for max_roots in (None, 10, 10_000):
        model = PGTS(**NETWORK, max_roots=max_roots)
        iteration = model.iterate()
        calls[max_roots] = iteration.model_calls
        if max_roots == 10:
            assert len(iteration.state_N) == 10
            assert iteration.model_calls <= 10 * (2 + 4)
    assert calls[10_000] == calls[None] > 4 * calls[10]


def test_with_replay_each_update_draws_its_own_roots(monkeypatch):
    replay = {"type": "uniform", "updates_per_step": 0.1, "starts": 4, "length": 8, "search_every": 2}
    model = PGTS(**NETWORK | {"replay": replay, "horizon": "auto", "num_envs": 1, "max_roots": 5})
    search, searched = model.search.look_ahead, list[int]()

    def counted(leaves, root_B, generator):
        searched.append(len(root_B))
        return search(leaves, root_B, generator)

    monkeypatch.setattr(model.search, "look_ahead", counted)
    model.iterate()
    assert set(searched) == {5}
    assert len(searched) == 2 * 50  # at depths 0 and 1


def test_a_certificate_that_needs_all_start_states_is_refused_with_drawn_roots():
    given = {"reward_range": (0, 1), "stop_at": 1e6, "depth": 1, "max_roots": 10}
    with pytest.raises(
        PgtsError, match=r"stop_at is .* and max_roots is 10; start states are known from episodes only"
    ):
        PGTS("CartPole-v1", **given)
    PGTS("pgts/Ladder-v0", stop_at=0.1, max_roots=2).iterate()  # where they are known there is one


def test_an_adaptive_depth_is_chosen_from_drawn_roots_too():
    iteration = PGTS("CartPole-v1", reward_range=(0, 1), depth="adaptive", max_depth=2, max_roots=10).iterate()
    assert len(iteration.state_N) == 10
    assert iteration.certificate == float("inf")
