"""Dynamics learned from steps."""

import math
import warnings
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from torch import nn

from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.base import Experience
from pgts_torch.models.ensemble import EnsembleModel
from pgts_torch.models.ensemble_networks import EnsembleNetworks
from pgts_torch.models.rewards import value_range
from pgts_torch.options import Ensemble
from pgts_torch.search import expectimax
from pgts_torch.seeding import stream

GAMMA = 0.9
SMALL = Ensemble(members=2, hidden=[32], first_updates=800)
BRIEF = SMALL.model_copy(update={"first_updates": 150})


def swing(count: int, seed: int = 0, *, hidden: bool = False, length: int = 40) -> Experience:
    """Steps of a linear system with two actions: it pays the first number, and ends where that is above 1.5.

    hidden: whether the second number, without which nothing can be predicted, is replaced by noise.
    """
    random = np.random.default_rng(seed)
    rows, state = [], np.zeros(2)
    for t in range(count):
        action = int(random.integers(2))
        after = np.array([state[0] + 0.3 * state[1], 0.9 * state[1] - 0.1 * state[0] + (action - 0.5) * 0.8])
        ended = after[0] > 1.5
        over = ended or t % length == length - 1
        rows.append((state, action, float(state[0]), 0.0 if ended else GAMMA, after, not over))
        state = random.normal(size=2) * 0.5 if over else after
    columns = [torch.from_numpy(np.array(column)) for column in zip(*rows, strict=True)]
    if hidden:
        columns[0][:, 1], columns[4][:, 1] = torch.from_numpy(random.normal(size=(2, count)))
    return Experience(*columns)


def trained(count: int = 600, *, seed: int = 0, options: Ensemble = SMALL) -> EnsembleModel:
    model = EnsembleModel(2, 2, gamma=GAMMA, options=options, seed=seed)
    model.learn(swing(count), generator=stream(seed, "learn"))
    return model


@pytest.fixture(scope="module")
def model() -> EnsembleModel:
    """One that has learned from 600 steps."""
    return trained()


@pytest.fixture(scope="module")
def of_four() -> EnsembleModel:
    """The same with four members."""
    return trained(options=SMALL.model_copy(update={"members": 4}))


def test_what_follows_is_learned(model):
    fresh = swing(400, seed=1)
    reward_N, discount_N, next_ND = model.step(fresh.observation_N.float(), fresh.action_N)
    change_ND = fresh.next_observation_N - fresh.observation_N
    assert float((next_ND - fresh.next_observation_N).square().mean() / change_ND.var()) < 0.01
    assert float((reward_N - fresh.reward_N).abs().mean()) < 0.05
    ended_N = fresh.discount_N == 0
    assert float((discount_N[ended_N, None] < discount_N[~ended_N]).double().mean()) > 0.98
    assert float(discount_N[~ended_N].mean()) > 0.98 * GAMMA
    # an untrained one says nothing of it
    untrained = EnsembleModel(2, 2, gamma=GAMMA, options=SMALL)
    off_ND = untrained.step(fresh.observation_N.float(), fresh.action_N)[2] - fresh.next_observation_N
    assert float(off_ND.square().mean() / change_ND.var()) > 0.3


def test_an_end_is_sampled_with_its_probability(model):
    state_N = model.number(torch.tensor([[1.4, 0.1]]).repeat(4000, 1))
    action_N = torch.ones(4000, dtype=torch.int64)
    discount = float(model.step(torch.tensor([[1.4, 0.1]]), action_N[:1])[1])
    assert 0 < discount < GAMMA
    sampled = model.sample(state_N, action_N, key_N=torch.arange(4000))
    share = float((sampled.discount_N > 0).double().mean())
    p = discount / GAMMA
    assert abs(share - p) < 5 * math.sqrt(p * (1 - p) / 4000)  # outside with a probability below 1e-6
    assert set(sampled.discount_N.tolist()) == {0.0, GAMMA}
    again = model.sample(state_N, action_N, key_N=torch.arange(4000))
    assert again.discount_N.equal(sampled.discount_N)


def test_members_differ_by_about_as_much_as_they_are_wrong(of_four):
    """For values that are as steep as the estimate allows, in 20 directions."""
    model, fresh = of_four, swing(400, seed=1)
    rewards, deviation_D = model.replay.rows("reward"), model.replay.rows("state").std(0, correction=0)
    low, high = value_range((float(rewards.min()), float(rewards.max())), GAMMA)
    direction_2V = nn.functional.normalize(torch.randn(2, 20, generator=stream(0, "test")), dim=0)

    def v(state_ND: torch.Tensor) -> torch.Tensor:
        return low + (high - low) * (0.5 + state_ND.float() / deviation_D @ direction_2V / 2**0.5).clamp(0, 1).double()

    reward_N, discount_N, next_ND = model.step(fresh.observation_N.float(), fresh.action_N)
    said_NV = reward_N[:, None] + discount_N[:, None] * v(next_ND)
    off_NV = (said_NV - fresh.reward_N[:, None] - fresh.discount_N[:, None] * v(fresh.next_observation_N)).abs()
    error_N1 = model.step_error(model.number(fresh.observation_N.float())).gather(1, fresh.action_N[:, None])
    assert float((off_NV <= error_N1).double().mean()) > 0.85
    assert float((off_NV <= error_N1 / 10).double().mean()) < 0.7  # less would not do
    near, far = (model.step_error(model.number(torch.tensor([[x, -x], [x, x]]))).mean() for x in (0.2, 8.0))
    assert far > 10 * near
    alone = trained(100, options=Ensemble(members=1, hidden=[8], first_updates=1))
    assert alone.step_error(alone.number(torch.zeros(1, 2))) is None


def test_steps_on_which_members_differ_are_not_trusted(of_four):
    bold = EnsembleModel(2, 2, gamma=GAMMA, options=of_four.options.model_copy(update={"max_disagreement": 1.0}))
    bold.load_state_dict(of_four.state_dict())

    def trusted(far: float, model: EnsembleModel) -> float:
        """The share of steps that are trusted in 200 states so many deviations from the mean."""
        state_ND = far * nn.functional.normalize(torch.randn(200, 2, generator=stream(0, "test")))
        zero_N = torch.zeros(200, dtype=torch.int64)
        found = model.sample(model.number(state_ND), zero_N, key_N=torch.arange(200)).trusted_N
        assert found is not None
        return float(found.double().mean())

    assert trusted(0.5, of_four) > 0.9
    assert trusted(8.0, of_four) < 0.1
    assert trusted(8.0, bold) == 1


def test_new_moments_change_no_prediction():
    torch.manual_seed(0)
    networks = EnsembleNetworks(3, 2, 2, [8], generator=torch.Generator().manual_seed(1), device=torch.device("cpu"))

    def seen(times: float, more: float) -> dict[str, torch.Tensor]:
        return {
            name: times * torch.randn(300, size) + more for name, size in zip(networks.moments, (3, 3, 1), strict=True)
        }

    networks.measure(seen(1.0, 0.0), rescale=False)
    asked = torch.randn(50, 3), torch.randint(2, (50,))
    said = networks.predict(*asked, 0.0)
    others = seen(3.0, 1.0)
    networks.measure(others, rescale=True)
    for now, before in zip(networks.predict(*asked, 0.0), said, strict=True):
        torch.testing.assert_close(now, before, rtol=1e-4, atol=1e-4)
    networks.measure(seen(1.0, 0.0), rescale=False)  # with other moments the same weights say something else
    assert bool((networks.predict(*asked, 0.0).next_END - said.next_END).abs().mean() > 0.1)


def test_each_member_has_a_bootstrap_sample_of_the_steps_and_all_ends():
    options = Ensemble(members=2, hidden=[8], first_updates=1)
    model = trained(1900, options=options)
    copies_RE, ended_R = model.replay.rows("copies"), model.replay.rows("end") > 0
    assert int(ended_R.sum()) > 20
    assert bool((copies_RE[ended_R] == 1).all())
    drawn_RE = copies_RE[~ended_R]
    count = len(drawn_RE)  # each of the three statistics is within 5 deviations with a probability above 1 - 1e-5
    assert float((drawn_RE.mean(0) - 1).abs().max()) < 5 / count**0.5
    assert float(((drawn_RE == 0).double().mean(0) - math.exp(-1)).abs().max()) < 5 * 0.49 / count**0.5
    assert abs(float(torch.corrcoef(drawn_RE.T)[0, 1])) < 5 / count**0.5
    alone = trained(100, options=Ensemble(members=1, hidden=[8], first_updates=1)).replay.rows("copies")
    assert bool((alone == 1).all())


def test_a_lookahead_in_it_is_that_of_its_means(model):
    roots = model.number(torch.tensor([[0.1, 0.2], [0.5, -0.5]]))
    look = expectimax(model, roots, v_leaf=lambda state_N: model.states(state_N)[:, 0].double(), depth=1)
    state_ND, action_N = model.states(roots).repeat_interleave(2, 0), torch.tensor([0, 1]).repeat(2)
    reward_N, discount_N, next_ND = model.step(state_ND, action_N)
    pairs_ND, actions_N = next_ND.repeat_interleave(2, 0), torch.tensor([0, 1]).repeat(4)
    after_N, then_N, last_ND = model.step(pairs_ND, actions_N)
    best_N = (after_N + then_N * last_ND[:, 0].double()).view(-1, 2).amax(-1)
    torch.testing.assert_close(look.q_BA, (reward_N + discount_N * best_N).view(2, 2), rtol=1e-5, atol=1e-6)


def test_errors_are_of_held_out_steps_and_fall_with_data():
    few, many = (
        EnsembleModel(2, 2, gamma=GAMMA, options=Ensemble(members=2, hidden=[32], first_updates=count // 2)).learn(
            swing(count), generator=stream(0, "learn")
        )
        for count in (350, 1600)
    )
    assert {"loss", "unexplained", "error_1", "error_4", "error_16"} <= set(many)
    assert many["error_1"] < many["error_16"]
    assert many["error_4"] < few["error_4"]


def test_observations_that_are_no_states_are_noticed():
    model = EnsembleModel(2, 2, gamma=GAMMA, options=BRIEF)
    with pytest.warns(UserWarning, match="the observation may not be the state"):
        model.learn(swing(2500, hidden=True), generator=stream(0, "learn"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(swing(100, seed=2, hidden=True), generator=stream(1, "learn"))  # said once
        EnsembleModel(2, 2, gamma=GAMMA, options=BRIEF).learn(swing(2500), generator=stream(0, "learn"))


def test_rare_jumps_are_no_reason_to_doubt_the_observation():
    """One step in 100 lands far away, which nothing in the observation tells: nearly all of the variance of changes."""
    steps = swing(2500)
    jumps_N = torch.arange(2500) % 100 == 99
    moved = steps._replace(next_observation_N=steps.next_observation_N + 50.0 * jumps_N[:, None])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        losses = EnsembleModel(2, 2, gamma=GAMMA, options=BRIEF).learn(moved, generator=stream(0, "learn"))
    assert losses["unexplained"] < 0.25  # with all of each error it would be near 1


def test_a_constant_number_and_a_constant_reward_are_learned_exactly():
    steps = swing(200)
    constant = steps._replace(
        observation_N=torch.cat([steps.observation_N, torch.full((200, 1), 7.0)], 1),
        next_observation_N=torch.cat([steps.next_observation_N, torch.full((200, 1), 7.0)], 1),
        reward_N=torch.full((200,), 1e-3, dtype=torch.float64),
    )
    model = EnsembleModel(3, 2, gamma=GAMMA, options=BRIEF)
    model.learn(constant, generator=stream(0, "learn"))
    reward_N, _, next_ND = model.step(constant.observation_N.float(), constant.action_N)
    assert next_ND[:, 2].tolist() == [7.0] * 200
    torch.testing.assert_close(reward_N, constant.reward_N, rtol=1e-6, atol=0)


def test_a_loaded_model_goes_on_bit_for_bit():
    one, other = trained(300, options=BRIEF), EnsembleModel(2, 2, gamma=GAMMA, options=BRIEF, seed=5)
    other.load_state_dict(one.state_dict())
    losses = [model.learn(swing(100, seed=3), generator=stream(7, "learn")) for model in (one, other)]
    assert losses[0] == losses[1]
    state_ND, action_N = torch.randn(8, 2, generator=stream(0, "test")), torch.arange(8) % 2
    for mine, its in zip(one.step(state_ND, action_N), other.step(state_ND, action_N), strict=True):
        assert mine.equal(its)


@pytest.mark.parametrize("spoiled", [False, True])
def test_steps_down_a_loss_that_is_not_finite_are_left_out_and_refused_when_all_losses_are_read(spoiled, monkeypatch):
    model = EnsembleModel(2, 2, gamma=GAMMA, options=Ensemble(members=2, hidden=[32], first_updates=20))
    plain, calls = EnsembleNetworks.outputs, iter(range(10**6))

    def outputs(networks: EnsembleNetworks, x: torch.Tensor) -> torch.Tensor:
        return plain(networks, x) * (math.nan if spoiled and next(calls) >= 3 else 1.0)

    monkeypatch.setattr(EnsembleNetworks, "outputs", outputs)
    before = model.state_dict()["weights"]
    with pytest.raises(NotFinite, match="the loss of the learned model is nan") if spoiled else nullcontext():
        model.learn(swing(50), generator=stream(0, "learn"))
    after = model.state_dict()["weights"]
    assert all(weight.isfinite().all() for weight in after)
    assert not torch.equal(before[0], after[0])
    assert all(int(each["step"]) == (3 if spoiled else 20) for each in model.state_dict()["optimiser"].values())


def test_what_cannot_be_learned_is_refused():
    model, steps = EnsembleModel(2, 2, gamma=GAMMA, options=SMALL), swing(50)
    with pytest.raises(PgtsError, match=r"shape \(3,\); .* vectors of 2 numbers"):
        model.learn(steps._replace(observation_N=torch.zeros(50, 3)), generator=stream(0, "learn"))
    with pytest.raises(PgtsError, match=r"discount 0\.5; .* gamma is 0\.9"):
        model.learn(steps._replace(discount_N=torch.full((50,), 0.5)), generator=stream(0, "learn"))
    with pytest.raises(NotFinite, match="the mean of rewards is"):
        model.learn(steps._replace(reward_N=torch.full((50,), torch.nan)), generator=stream(0, "learn"))
