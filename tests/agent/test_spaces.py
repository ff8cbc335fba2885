"""Observations of every kind: what is seen of them, that all of it is learned from, and what is refused."""

import itertools
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array
from gymnasium.wrappers import TimeLimit

from pgts_torch import PGTS
from pgts_torch.agent.components import has_channels_first
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.networks import Network, default_network, make_trunk
from pgts_torch.agent.observations import Observations
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.options import CNN, MLP
from pgts_torch.options.environment import Observed
from pgts_torch.seeding import stream
from tests.agent.kinds import CELLS, KINDS, Corridor
from tests.support import same_values

SHORT: dict[str, Any] = {"num_envs": 2, "horizon": {"type": "fixed", "length": 4}}
NETWORKS: dict[str, dict[str, Any]] = {
    "mlp": {"type": "mlp", "hidden": [8], "normalize": False},
    "cnn": {"type": "cnn", "channels": [4, 4], "hidden": [8]},
    "module": {"type": "module", "make": "tests.agent.modules:Plain"},
}
SEARCHES: dict[str, dict[str, Any]] = {
    "lookahead": SHORT | {"depth": 1},
    "no lookahead": {"num_envs": 2, "horizon": {"type": "fixed", "length": 40}, "depth": 0, "estimator": "sampled"},
}
ONGOING: dict[str, Any] = {
    "depth": 1,
    "horizon": {"type": "steps", "length": 10, "first": 60},
    "replay": {"updates_per_step": 0.05, "starts": 4, "length": 4},
}
FITS: dict[str, Any] = {"hidden": [8], "first_updates": 3, "updates_per_step": 0.1}
LEARNED: dict[str, dict[str, Any]] = {
    "counts": ONGOING | {"model": "counts", "depth": 4, "replay": {"updates_per_step": 0.2}},
    "ensemble": ONGOING | {"model": FITS | {"type": "ensemble", "members": 2}},
    "latent": ONGOING | {"model": FITS | {"type": "latent", "size": 4, "unroll": 2, "minibatch_size": 4}},
}


def env_of(kind: str) -> Any:
    return lambda: TimeLimit(Corridor(kind), 10)


def seen(space: spaces.Space, options: Observed = Observed(), *, numbered: bool = False) -> Observations:  # noqa: B008
    class Shown(gymnasium.Env):
        observation_space, action_space = space, spaces.Discrete(2)

    env = SyncVectorEnv([Shown], autoreset_mode=AutoresetMode.DISABLED)
    return Observations(env, options, torch.device("cpu"), numbered=numbered)


def trunk_of(network: MLP | CNN, space: spaces.Space):
    return make_trunk(network, space, generator=stream(0, "trunk"))


# Every kind


@pytest.mark.parametrize("kind", KINDS)
def test_an_mlp_sees_what_gymnasium_flattens(kind):
    space, observe, *_ = KINDS[kind]
    observations, cells = seen(space), [observe(cell) for cell in range(CELLS)]
    input_ND = trunk_of(MLP(), observations.space).encoder(torch.stack([observations.encode(one) for one in cells]))
    assert input_ND.dtype == torch.float32
    assert len(input_ND.unique(dim=0)) == CELLS
    if "channels first" in kind or "two images" in kind:
        return  # whose channels come last here, see below
    flat_ND = torch.from_numpy(np.array([spaces.flatten(space, one) for one in cells]).astype(np.float64))
    at_most = 255.0 if "uint8" in str(space) and input_ND.max() < 1 else 9.0 if kind == "an image of floats" else 1.0
    torch.testing.assert_close(input_ND.double() * at_most, flat_ND, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_observations_alone_and_many_at_once_are_encoded_alike(kind):
    space, observe, *_ = KINDS[kind]
    observations, envs = seen(space), SyncVectorEnv([env_of(kind)] * 3, autoreset_mode=AutoresetMode.DISABLED)
    first, _ = envs.reset()
    moved, *_ = envs.step(np.array([0, 1, 1]))
    for batch, cells in ((first, [0, 0, 0]), (moved, [0, 1, 1])):
        assert same_values(observations.encode(batch), torch.stack([observations.encode(observe(at)) for at in cells]))
    assert not torch.equal(observations.encode(first), observations.encode(moved))


TYPICAL = {"a tuple of numbers", "a vector", "an image", "an image, channels first"}


def cases(short: bool) -> Iterator[tuple[str, str, str]]:
    """Each kind with each of its networks, with and without a lookahead, and with the model that is learned of it.

    short: each kind once, so that all networks come with both; a learned model with typical kinds alone.
    """
    for number, (kind, (_, _, policies, learned)) in enumerate(KINDS.items()):
        given = [*itertools.product([kind], [*policies, "module"], SEARCHES)]
        yield from [given[(number + 2) % len(given)]] if short else given
        if learned and (kind in TYPICAL or not short):
            yield kind, "auto" if learned == "counts" else "mlp", learned


def marked() -> Iterator[Any]:
    short = [*cases(short=True)]
    for case in cases(short=False):
        yield pytest.param(*case, marks=[] if case in short else pytest.mark.long)


def test_the_short_form_has_each_network_with_and_without_a_lookahead_and_each_learned_model():
    short = {(policy, search) for _, policy, search in cases(short=True)}
    assert short >= {(policy, search) for _, policy, search in cases(short=False)}
    assert short > {*itertools.product(NETWORKS, SEARCHES)}


@pytest.mark.parametrize(("kind", "policy", "search"), [*marked()])
def test_each_kind_trains_is_saved_loaded_evaluated_and_resumed_with_the_same_bits(kind, policy, search, tmp_path):
    training = PGTS(env_of(kind), seed=1, policy=NETWORKS.get(policy), **(SEARCHES | LEARNED)[search])
    first = training.policy.state_dict()
    training.learn(8 if search in SEARCHES else 80)
    training.save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt", env=env_of(kind), trust_imports=True)
    training.iterate()
    loaded.iterate()
    assert same_values(training.state_dict(), loaded.state_dict())
    assert not same_values(training.policy.state_dict(), first)
    assert evaluate(training, episodes=1) == evaluate(loaded, episodes=1)
    space, observe, *_ = KINDS[kind]
    assert [int(training.predict(observe(cell))) for cell in range(CELLS)] == training.predict(
        concatenate(space, [observe(cell) for cell in range(CELLS)], create_empty_array(space, CELLS))
    ).tolist()


@pytest.mark.parametrize("kind", KINDS)
def test_a_network_is_chosen_that_sees_images_as_such(kind):
    space, _, policies, _ = KINDS[kind]
    chosen = default_network(seen(space).space)
    assert chosen.type == policies[0]
    trunk_of(chosen, seen(space).space)
    if "cnn" not in policies:
        with pytest.raises(PgtsError, match=r"use an mlp|too small"):
            trunk_of(CNN(), seen(space).space)


# Parts


class Signpost(gymnasium.Env):
    """One step: the right action is shown beside an image that shows nothing."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Dict(image=spaces.Box(0, 255, (6, 6, 3), np.uint8), sign=spaces.Discrete(2))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.sign = int(self.np_random.integers(2))
        return self.seen(), {}

    def seen(self):
        return {"image": np.zeros((6, 6, 3), np.uint8), "sign": self.sign}

    def step(self, action):
        return self.seen(), float(action == self.sign), True, False, {}


@pytest.mark.parametrize(
    ("keys", "known"), [(None, True), (["sign", "image"], True), (["sign"], True), (["image"], False)]
)
def test_a_policy_learns_from_the_parts_that_it_sees_and_from_no_others(keys, known):
    network = {} if keys == ["sign"] else {"policy": NETWORKS["cnn"]}
    model = PGTS(
        Signpost, depth=0, estimator="sampled", horizon={"type": "fixed", "length": 1}, num_envs=32,
        observation_keys=keys, update={"type": "ppo", "learning_rate": 0.02}, **network,
    )  # fmt: skip
    model.learn(32 * 12)
    action = [int(model.predict(Signpost.seen(Signed(sign)))) for sign in (0, 1)]
    assert (action == [0, 1]) == known


class Signed:
    def __init__(self, sign: int) -> None:
        self.sign = sign


def test_the_entries_of_a_row_are_those_of_the_parts_in_order_in_the_smallest_dtype():
    parts = spaces.Dict(image=spaces.Box(0, 255, (2, 4, 4), np.uint8), at=spaces.MultiDiscrete([4, 300], start=[1, 0]))
    image = np.arange(32, dtype=np.uint8).reshape(2, 4, 4)
    row = seen(parts, Observed(observation_keys=["image", "at"])).encode({"image": image, "at": np.array([3, 299])})
    assert row.dtype == torch.int32  # 300 numbers are no bytes
    assert row.tolist() == [*np.moveaxis(image, 0, -1).reshape(-1).tolist(), 2, 299]
    assert (
        seen(spaces.Dict(parts.spaces | {"at": spaces.Discrete(4)})).encode({"image": image, "at": 2}).dtype
        == torch.uint8
    )


def test_every_image_has_convolutions_of_its_own_beside_the_rest():
    space = spaces.Tuple([spaces.Box(0, 255, (7, 7, 3), np.uint8), spaces.Discrete(3), spaces.Box(0, 1, (5, 6, 1))])
    network = CNN(channels=[2], hidden=[4])
    trunk = trunk_of(network, space)
    random = stream(1, "x")
    first = torch.randint(0, 256, (5, 7, 7, 3), generator=random)
    number, second = torch.tensor([0, 1, 2, 1, 0]), torch.rand(5, 5, 6, 1, generator=random)
    row_ND = torch.cat([first.flatten(1).float(), number[:, None].float(), second.flatten(1)], 1)
    weights = [value.detach() for value in trunk.parameters()]
    images = (first / 255, weights[0], weights[1]), (second, weights[2], weights[3])
    a, b = (torch.nn.functional.conv2d(x.permute(0, 3, 1, 2), w, v).relu().flatten(1) for x, w, v in images)
    joined = torch.cat([a, torch.nn.functional.one_hot(number, 3).float(), b], 1)
    expected = (joined @ weights[4].T + weights[5]).relu()
    torch.testing.assert_close(trunk.layers(trunk.encoder(row_ND)), expected)
    assert trunk.encoder(row_ND).shape == (5, 147 + 3 + 30)


def test_each_box_has_running_statistics_and_numbers_have_none():
    space = spaces.Tuple([spaces.Discrete(3), spaces.Box(-9, 9, (2,)), spaces.Box(0, 255, (4, 4, 2), np.uint8)])
    encoder = trunk_of(CNN(channels=[2], normalize=True), space).encoder
    row_ND = torch.rand(50, 35, generator=stream(0, "rows")) * 2
    row_ND[:, 0] = row_ND[:, 0].floor()
    assert encoder.fresh
    encoder.absorb(row_ND)
    input_ND = encoder(row_ND)
    assert not encoder.fresh
    assert set(input_ND[:, :3].unique().tolist()) == {0.0, 1.0}
    torch.testing.assert_close(input_ND[:, 3:5].mean(0), torch.zeros(2), atol=1e-5, rtol=0)
    image = input_ND[:, 5:].reshape(50, 2, 16)
    torch.testing.assert_close(image.mean((0, 2)), torch.zeros(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(image.std((0, 2)), torch.ones(2), atol=2e-3, rtol=0)


# Images


@pytest.mark.parametrize(
    ("shape", "first"),
    [
        ((84, 84, 4), False),
        ((4, 84, 84), True),
        ((210, 160, 3), False),
        ((3, 210, 160), True),
        ((4, 128, 64), True),
        ((4, 4, 16), False),  # a one-hot board
        ((1, 8, 8), True),
        ((7, 3, 3), False),
        ((3, 3, 3), False),
        ((5, 6, 7), True),
    ],
)
def test_channels_are_where_the_shape_says(shape, first):
    assert has_channels_first(spaces.Box(0, 1, shape), None) == first


@pytest.mark.parametrize("shape", [(8, 8, 8), (16, 4, 4), (5, 9, 5), (6, 4, 5)])
def test_channels_that_no_shape_tells_are_asked_for(shape):
    space = spaces.Box(0, 255, shape, np.uint8)
    with pytest.raises(PgtsError, match=r"may have their channels first or last: set image_channels to 'first'"):
        seen(space)
    image = np.arange(space.low.size, dtype=np.uint8).reshape(shape)
    assert torch.equal(seen(space, Observed(image_channels="last")).encode(image), torch.from_numpy(image))
    first = seen(space, Observed(image_channels="first"))
    assert first.space.shape == (*shape[1:], shape[0])
    assert torch.equal(first.encode(image), torch.from_numpy(image).permute(1, 2, 0))


def test_a_stack_of_frames_is_convolved_over_height_and_width():
    space = spaces.Box(0, 255, (4, 36, 40), np.uint8)
    network = default_network(seen(space).space)
    convolution = trunk_of(network, seen(space).space).layers[0]
    assert (network.type, convolution.in_channels) == ("cnn", 4)


# What is refused


@pytest.mark.parametrize(
    ("space", "network", "weights"),
    [
        (spaces.Box(0, 255, (210, 160, 3), np.uint8), CNN(), "266,231,808"),
        (spaces.Box(0, 255, (84, 84, 84, 4), np.uint8), MLP(), "151,732,224"),
        (spaces.Discrete(10**9), MLP(), "64,000,000,000"),
        (spaces.MultiDiscrete([2**31, 5]), MLP(), "137,438,953,792"),
    ],
)
def test_a_layer_too_large_for_the_observations_is_refused_before_it_is_made(space, network, weights):
    with pytest.raises(PgtsError, match=rf"{weights} weights would be needed for observations of"):
        trunk_of(network, space)


def test_no_table_of_weights_is_too_large_for_a_network_without_layers_either():
    with pytest.raises(PgtsError, match="30,000,000 weights"):
        Network(trunk_of(MLP(hidden=[]), spaces.Discrete(10**7)), 3, gain=1, generator=stream(0, "head"))


@pytest.mark.parametrize(
    ("space", "options", "message"),
    [
        (spaces.Text(9), {}, "are Text, which no network takes: make numbers of them"),
        (spaces.Sequence(spaces.Discrete(3)), {}, "are Sequence, which no network takes"),
        (spaces.Graph(spaces.Box(0, 1, (2,)), None), {}, "are Graph, which no network takes"),
        (spaces.Tuple([spaces.Discrete(3), spaces.Text(9)]), {}, "are Text, which no network takes"),
        (
            spaces.Dict(a=spaces.Discrete(3), said=spaces.Tuple([spaces.Text(9)]), b=spaces.Discrete(2)),
            {},
            r"in their part 'said': set observation_keys to those to learn from, \['a', 'b'\]",
        ),
        (spaces.Dict(a=spaces.Discrete(3)), {"observation_keys": ["c"]}, "have no part 'c'; they have a"),
        (spaces.Tuple([spaces.Discrete(3)]), {"observation_keys": ["c"]}, "have no part 'c'; they are Tuple"),
        (spaces.Discrete(3), {"image_channels": "last"}, "image_channels is 'last'; .* without an image"),
    ],
)
def test_what_cannot_be_seen_is_refused_with_a_way_out(space, options, message):
    with pytest.raises(PgtsError, match=message):
        seen(space, Observed(**options))


@pytest.mark.parametrize(
    ("kind", "observation", "message"),
    [
        ("bits", np.array([0, 2, 0]), "holds 2, where its space"),
        ("bits", np.array([0.0, 1, 0]), "states are integers"),
        ("several numbers", np.array([6, 0]), "holds 6, where its space"),
        ("several numbers", np.array([1, -2]), "holds -2, where its space"),
        ("several numbers", np.array([1]), r"has shape \(1,\)"),
        ("a vector of bytes", np.full(8, 256), "holds 256, which uint8 cannot hold"),
        ("a vector of int64", np.full(8, 0.5), "holds 0.5, which int64 cannot hold"),
        ("a vector", np.full(4, "x"), "is of <U1"),
        ("a tuple of numbers", (1, 9, np.zeros(3, np.int8)), "state 9 does not exist; states are 7 to 8"),
        ("a tuple of numbers", (1, 7), "it has no part"),
        (
            "a tuple of numbers",
            (np.array([1, 2]), np.array([7]), np.zeros((1, 3), np.int8)),
            "parts .* have the shapes",
        ),
        ("a dictionary with an image", {"image": np.zeros((6, 6, 3), np.uint8)}, "it has no part"),
    ],
)
def test_an_observation_that_is_not_in_its_space_is_refused_by_name(kind, observation, message):
    with pytest.raises(PgtsError, match=message):
        seen(KINDS[kind].space).encode(observation)


@pytest.mark.parametrize("kind", KINDS)
def test_a_learned_model_of_other_observations_is_refused_with_the_one_that_fits(kind):
    fits = KINDS[kind].learned
    way_out = f"take '{fits}'" if fits else "make them such by a wrapper"
    for model in LEARNED.keys() - {fits}:
        with pytest.raises(MissingModel, match=f"(?s)model is '{model}', which learns from .*{way_out}"):
            PGTS(env_of(kind), model=model)


def test_combinations_of_numbers_are_numbered_for_a_table():
    space = spaces.Tuple([spaces.Discrete(4, start=1), spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(2)])
    observations, shape = seen(space, numbered=True), (4, 3, 2, 2, 2)
    assert observations.space == spaces.Discrete(96)
    rows = np.array(list(np.ndindex(shape)))
    batch = (rows[:, 0] + 1, rows[:, 1:3], rows[:, 3:].astype(np.int8))
    assert observations.encode(batch).tolist() == np.ravel_multi_index(tuple(rows.T), shape).tolist()
    training = PGTS(env_of("a tuple of numbers"), model="counts", depth=2, num_envs=1)
    assert training.policy_table().shape == (CELLS * 2 * 8, 2)
