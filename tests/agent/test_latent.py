"""A model of images, learned from steps."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn

from pgts_torch import PGTS, evaluate
from pgts_torch.agent.latent import LatentModel
from pgts_torch.agent.latent_losses import Unrolled, consistency_loss, equivalence_losses, outcome_losses
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.envs.images import Catch
from pgts_torch.errors import MemoryBudgetExceeded, MissingModel, NotFinite, PgtsError
from pgts_torch.models.base import Experience
from pgts_torch.models.held_out import sequences
from pgts_torch.models.replay import ReplayBuffer
from pgts_torch.options import CNN, MLP, Latent, StepsHorizon, UniformReplay
from pgts_torch.ranks import ALONE, Ranks, present_ranks
from pgts_torch.seeding import stream
from tests.forks import on_ranks

GAMMA = 0.9
SMALL = Latent(
    network=CNN(channels=[8], hidden=[32]), size=16, hidden=[32], first_updates=400, learning_rate=6e-3, unroll=3
)
TRAINING = {
    "depth": 1,
    "gamma": GAMMA,
    "model": SMALL,
    "replay": UniformReplay(updates_per_step=0.1, starts=8, length=5),
    "horizon": StepsHorizon(length=50, first=200),
    "policy": MLP(hidden=[16]),
}


def small_catch() -> Catch:
    return Catch(rows=4, columns=3)


def transitions() -> Experience:
    """Every step of Catch on 4 rows and 3 columns, by another route than the environment's, from each
    state that it can be in: the paddle begins in the middle."""
    rows = []

    def image(row: int, column: int, paddle: int) -> np.ndarray:
        made = np.zeros((4, 3, 1), np.uint8)
        made[row, column] = made[3, paddle] = 255
        return made

    for row in range(3):
        for column in range(3):
            for paddle in range(3) if row else [1]:
                for action in range(3):
                    moved = int(np.clip(paddle + (-1, 0, 1)[action], 0, 2))
                    over = row == 2
                    reward = 0.0 if not over else 1.0 if moved == column else -1.0
                    after = image(row + 1, column, moved)
                    rows.append((image(row, column, paddle), action, reward, 0.0 if over else GAMMA, after, False))
    return Experience(*(torch.from_numpy(np.array(column)) for column in zip(*rows, strict=True)))


def played(count: int, seed: int = 0) -> Experience:
    """Steps of random actions in the environment."""
    env, random, rows = small_catch(), np.random.default_rng(seed), []
    seen = env.reset(seed=seed)[0]
    for _ in range(count):
        action = int(random.integers(3))
        after, reward, over, _, _ = env.step(action)
        rows.append((seen, action, reward, 0.0 if over else GAMMA, after, not over))
        seen = env.reset()[0] if over else after
    return Experience(*(torch.from_numpy(np.array(column)) for column in zip(*rows, strict=True)))


@pytest.mark.fault("loss that is not finite")
def test_a_fit_in_which_a_loss_is_not_finite_is_taken_back(monkeypatch):
    model = untrained(Latent(network=CNN(channels=[4], hidden=[8]), size=8, hidden=[8], first_updates=5, unroll=2))
    model.learn(played(50), generator=stream(0, "learn"))
    before, steps, calls = model.state_dict(), played(50, seed=1), iter(range(100))

    def spoiled(unrolled: Unrolled) -> torch.Tensor:
        return consistency_loss(unrolled) * (torch.nan if next(calls) == 3 else 1.0)

    with monkeypatch.context() as patch:
        patch.setattr("pgts_torch.agent.latent.consistency_loss", spoiled)
        with pytest.raises(NotFinite, match="the model loss is nan; no parameter was changed"):
            model.learn(steps, generator=stream(1, "learn"))
    after = model.state_dict()
    for name in ("representation", "dynamics", "optimiser"):
        torch.testing.assert_close(after[name], before[name], rtol=0, atol=0)
    model.learn(steps, generator=stream(1, "learn"))
    assert model.state_dict()["optimiser"]["num_steps"] > before["optimiser"]["num_steps"]


def untrained(options: Latent = SMALL, *, seed: int = 0, **more) -> LatentModel:
    model = LatentModel(small_catch().observation_space, 3, gamma=GAMMA, options=options, seed=seed, **more)
    vectors = spaces.Box(-np.inf, np.inf, (options.size,))
    model.serve(NetworkCritic(vectors, 3, seed=seed), NetworkPolicy(vectors, 3, seed=seed))
    return model


@pytest.fixture(scope="module")
def learned() -> tuple[LatentModel, dict[str, float]]:
    """A model that has learned from 600 steps, and what it said of them."""
    model = untrained()
    return model, model.learn(played(600), generator=stream(0, "learn"))


@pytest.fixture
def trained(learned) -> LatentModel:
    return learned[0]


def with_updates(count: int) -> Latent:
    return SMALL.model_copy(update={"first_updates": count})


def agreement(model: LatentModel) -> tuple[float, float, float]:
    """The largest error of rewards, of discounts, and the share of next images that are told from all others, over all
    steps that there are."""
    truth = transitions()
    latent_ND = model.represent(truth.observation_N)
    reward_N, discount_N, next_ND = model.step(latent_ND, truth.action_N)
    on_N = truth.discount_N > 0
    images, which_N = truth.next_observation_N[on_N].unique(dim=0, return_inverse=True)
    nearest_N = torch.cdist(next_ND[on_N], model.represent(images)).argmin(-1)
    reward, discount = (reward_N - truth.reward_N).abs().max(), (discount_N - truth.discount_N).abs().max()
    return float(reward), float(discount), float((nearest_N == which_N).double().mean())


def test_what_follows_an_image_is_learned(trained):
    reward, discount, share = agreement(trained)
    assert reward < 0.3
    assert discount < 0.1
    assert share > 0.95
    reward, discount, share = agreement(untrained())
    assert reward > 0.9
    assert discount > 0.4
    assert share < 0.5


def test_vectors_have_mean_0_and_variance_1(trained):
    truth = transitions()
    latent_ND = trained.represent(truth.observation_N)
    for vectors_ND in (latent_ND, trained.step(latent_ND, truth.action_N)[2]):
        torch.testing.assert_close(vectors_ND.mean(-1), torch.zeros(63), rtol=0, atol=1e-5)
        torch.testing.assert_close(vectors_ND.var(-1, correction=0), torch.ones(63), rtol=1e-3, atol=0)


def test_an_end_is_sampled_with_its_probability():
    """Each step of a one-image environment ends the episode with probability 0.4, though ends are oversampled."""
    random, count = np.random.default_rng(0), 1500
    image_N, ended_N = torch.zeros(count, 4, 3, 1, dtype=torch.uint8), torch.from_numpy(random.random(count) < 0.4)
    steps = Experience(
        image_N, torch.zeros(count).long(), ended_N.double(), GAMMA * (~ended_N).double(), image_N, ~ended_N
    )
    model = untrained(with_updates(150))
    model.learn(steps, generator=stream(0, "learn"))
    reward_1, discount_1, _ = model.step(model.represent(image_N[:1]), torch.zeros(1).long())
    p = 1 - float(discount_1) / GAMMA
    # seven standard deviations of the share in 1,500 steps
    assert abs(p - 0.4) < 0.09
    assert abs(float(reward_1) - p) < 0.05  # it pays 1 if it ends
    state_N = model.number(model.represent(image_N[:1])).expand(4000)
    sampled = model.sample(state_N, torch.zeros(4000).long(), key_N=torch.arange(4000))
    share = float((sampled.discount_N == 0).double().mean())
    assert abs(share - p) < 5 * math.sqrt(p * (1 - p) / 4000)  # outside with a probability below 1e-6
    assert set(sampled.discount_N.tolist()) == {0.0, GAMMA}


def test_an_equal_image_is_no_other_image():
    vectors = nn.functional.layer_norm(torch.randn(1, 1, 16, generator=stream(0, "test")), (16,)).expand(1, 6, 16)
    goes_on = torch.ones(1, 6, dtype=torch.bool)
    same = Unrolled(vectors, vectors, torch.zeros(1, 6).long(), goes_on)
    assert float(consistency_loss(same)) == 0
    assert float(consistency_loss(same._replace(image_KN=torch.arange(6)[None]))) == pytest.approx(math.log(6))
    assert float(consistency_loss(same._replace(goes_on_KN=~goes_on))) == 0


def test_rewards_are_of_steps_that_end_an_episode_or_of_others():
    output_23 = torch.tensor([[1.0, 5.0, -30.0], [7.0, 2.0, 30.0]])
    losses = outcome_losses(output_23, torch.tensor([1.0, 2.0]), torch.tensor([0.0, 1.0]))
    assert [float(loss) for loss in losses.values()] == pytest.approx([0, 0], abs=1e-6)
    swapped = outcome_losses(output_23, torch.tensor([1.0, 2.0]), torch.tensor([1.0, 0.0]))
    assert [float(loss) for loss in swapped.values()] == pytest.approx([20.5, 30])


def test_values_and_policy_move_the_predicted_vectors_alone():
    vectors = spaces.Box(-np.inf, np.inf, (4,))
    critic, policy = NetworkCritic(vectors, 2, seed=0), NetworkPolicy(vectors, 2, seed=0)
    predicted, seen = (torch.randn(2, 3, 4, generator=stream(n, "test"), requires_grad=True) for n in (0, 1))
    steps = Unrolled(predicted, seen, torch.zeros(2, 3).long(), torch.ones(2, 3, dtype=torch.bool))
    losses = equivalence_losses(steps, critic.network, policy.network)
    said, is_said = (critic.network.outputs(vectors_KND.detach().view(-1, 4)) for vectors_KND in (predicted, seen))
    expected = (said - is_said).square().mean()
    assert float(losses["value"].detach()) == pytest.approx(float(expected), rel=1e-5)
    pi_MA, mu_MA = (policy.probs(x.detach().view(-1, 4)) for x in (seen, predicted))
    divergence = (pi_MA * (pi_MA / mu_MA).log()).sum(-1).mean()
    assert float(losses["policy"].detach()) == pytest.approx(float(divergence), rel=0.02)  # rounding
    gradients = torch.autograd.grad(sum(losses.values()), [predicted, seen], allow_unused=True)
    assert float(gradients[0].abs().min()) > 0
    assert gradients[1] is None
    same = equivalence_losses(steps._replace(predicted_KND=seen), critic.network, policy.network)
    assert [float(loss.detach()) for loss in same.values()] == pytest.approx([0, 0], abs=1e-9)


def test_sequences_stay_in_their_episode_and_out_of_what_is_held_out():
    buffer, follows = ReplayBuffer(8), torch.tensor([1, 1, 0, 1, 1, 1, 1, 0], dtype=torch.bool)
    buffer.add(follows=follows)
    held_out = torch.arange(8) == 6
    at_KN, counts_KN = sequences(buffer, held_out, torch.tensor([0, 1, 3, 7]), 4)
    assert at_KN.T.tolist() == [[0, 1, 2, 3], [1, 2, 3, 4], [3, 4, 5, 6], [7, 0, 1, 2]]
    assert counts_KN.T.long().tolist() == [[1, 1, 1, 0], [1, 1, 0, 0], [1, 1, 1, 0], [1, 0, 0, 0]]


def test_errors_are_of_held_out_steps_and_fall_with_training(learned):
    brief, losses = untrained(with_updates(1)).learn(played(600), generator=stream(0, "learn")), learned[1]
    assert set(losses) == {
        "reward",
        "end",
        "consistency",
        "value",
        "policy",
        "error_1",
    }  # no episode has four steps more
    assert losses["error_1"] < brief["error_1"] / 2


def test_images_are_kept_as_bytes():
    model = untrained(with_updates(1), capacity=1000)
    model.learn(played(100), generator=stream(0, "learn"))
    for name in ("state", "next_state"):
        assert model.replay.rows(name).dtype == torch.uint8
        assert model.replay.rows(name).nbytes == 100 * 12
    with pytest.raises(MemoryBudgetExceeded, match="set a smaller one"):
        untrained(capacity=10**13)


def test_a_policy_that_catches_the_ball_is_learned_from_images():
    longer = SMALL.model_copy(update={"first_updates": 800, "learning_rate": 3e-3})
    training = PGTS(small_catch, **TRAINING | {"model": longer})
    before = evaluate(training, episodes=20).episodic_return.mean
    training.learn(700)
    assert evaluate(training, episodes=20).episodic_return.mean > 0.9 > before
    image = small_catch().reset(seed=0)[0]
    assert training.predict(image) in (0, 1, 2)
    assert training.predict(np.stack([image, image])).shape == (2,)


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_latent_model_learns_on_ranks_as_one_process_does_from_the_steps_of_all(monkeypatch):
    steps, parts = played(60), 1
    columns = [*steps][:6]

    def sampled(high: int, shape: tuple[int], **_: Any) -> torch.Tensor:
        """Where one process samples for two, what both sample from their halves of the steps."""
        own = torch.arange(shape[0] // parts) * 7 % (high // parts)
        return torch.cat([own + part * (high // parts) for part in range(parts)])

    def fitted(ranks: Ranks, own: slice) -> tuple[torch.Tensor, dict[str, float]]:
        model = untrained(with_updates(5).model_copy(update={"minibatch_size": 16}))
        losses = model.learn(Experience(*(column[own] for column in columns), ranks), generator=stream(0, "learn"))
        return torch.cat([x.flatten() for x in model.representation.tensors + model._dynamics.tensors]), losses

    monkeypatch.setattr(torch, "randint", sampled)
    halves = on_ranks(2, lambda: fitted(ranks := present_ranks(), slice(30 * ranks.rank, 30 * ranks.rank + 30)))
    parts = 2
    (alone, losses), (half, _) = fitted(ALONE, slice(60)), fitted(ALONE, slice(30))
    assert torch.equal(halves[0][0], halves[1][0])
    for weights, found in halves:
        assert {name: found[name] for name in losses} == pytest.approx(losses, rel=1e-3)
        torch.testing.assert_close(weights, alone, rtol=1e-3, atol=2e-4)
    assert (half - alone).abs().max() > 2e-3


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_latent_training_of_two_processes_is_used_by_one_but_does_not_go_on_there(tmp_path):
    brief = TRAINING | {"model": with_updates(3), "num_envs": 2, "horizon": StepsHorizon(length=20, first=40)}
    image_N = played(30).observation_N

    def trained() -> list[torch.Tensor]:
        training = PGTS(small_catch, **brief)
        for _ in range(2):
            training.iterate()
        training.save(tmp_path / "model.pt")
        return [training.policy.probs(training.world.perceive(image_N)), training.world.model.replay.rows("reward")]

    (one, its), (other, others) = on_ranks(2, trained)
    assert torch.equal(one, other)
    assert not torch.equal(its, others)
    loaded = PGTS.load(tmp_path / "model.pt", env=small_catch)
    assert torch.equal(loaded.policy.probs(loaded.world.perceive(image_N)), one)
    assert loaded.predict(image_N[0].numpy()) == int(one[0].argmax())
    assert evaluate(loaded, episodes=4).episodes == 4
    for use in (loaded.iterate, lambda: loaded.save(tmp_path / "again.pt")):
        with pytest.raises(PgtsError, match=r"of 2 processes, which go on in the environments of each; .* take"):
            use()


def test_a_saved_training_goes_on_bit_for_bit(tmp_path):
    brief = TRAINING | {"model": with_updates(20)}
    training = PGTS(small_catch, **brief).learn(220)
    training.save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt", env=small_catch)
    for _ in range(2):
        mine, its = training.iterate(), loaded.iterate()
        assert mine.losses == its.losses
        assert mine.experience.observation_UB.equal(its.experience.observation_UB)
    for name, value in training.policy.state_dict().items():
        assert value.equal(loaded.policy.state_dict()[name])


def test_what_does_not_fit_is_refused_with_a_way_out():
    with pytest.raises(MissingModel, match=r"'ensemble', which learns from vectors.*take 'latent'"):
        PGTS(small_catch, model="ensemble")
    with pytest.raises(MissingModel, match=r"'latent', which learns from images.*take 'ensemble'"):
        PGTS("CartPole-v1", model="latent")
    with pytest.raises(MissingModel, match=r"'latent', which learns from images.*take 'counts'"):
        PGTS("FrozenLake-v1", model="latent")
    with pytest.raises(PgtsError, match=r"policy\.type is cnn; with model\.type latent .* must be mlp"):
        PGTS(small_catch, model="latent", policy="cnn")
    with pytest.raises(PgtsError, match=r"search\.doubt is true, and model\.type is latent"):
        PGTS(small_catch, model="latent", search={"type": "expectimax", "doubt": True})
    with pytest.raises(PgtsError, match="table of numbered states"):
        PGTS(small_catch, model=SMALL, policy="softmax")
    with pytest.raises(PgtsError, match="more than 32 steps"):
        PGTS(small_catch, model=SMALL, replay=UniformReplay(capacity=32))
    steps = played(50)
    with pytest.raises(PgtsError, match=r"discount 0\.5; .* gamma is 0\.9"):
        untrained().learn(steps._replace(discount_N=torch.full((50,), 0.5)), generator=stream(0, "learn"))
    with pytest.raises(NotFinite, match="the mean of rewards is"):
        untrained().learn(steps._replace(reward_N=torch.full((50,), torch.nan)), generator=stream(0, "learn"))
