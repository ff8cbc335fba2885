"""Networks: what they are made of, what they see, and that nothing global is touched."""

import math

import numpy as np
import pytest
import torch
from gymnasium import spaces

from pgts_torch.agent import networks
from pgts_torch.agent.encoders import Encoder, RunningNorm
from pgts_torch.agent.networks import Network, default_network, make_trunk
from pgts_torch.errors import PgtsError
from pgts_torch.options import CNN, MLP, NatureCNN
from pgts_torch.seeding import stream

VECTORS = spaces.Box(-np.inf, np.inf, (3,), np.float64)
STATES = spaces.Discrete(5)
VIEWS = spaces.Box(0, 255, (7, 7, 3), np.uint8)


def network(description, space, *, outputs: int = 2, seed: int = 0) -> Network:
    generator = stream(seed, "network")
    return Network(make_trunk(description, space, generator=generator), outputs, gain=0.5, generator=generator)


def views(count: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, (count, 7, 7, 3), generator=stream(seed, "views"), dtype=torch.uint8)


@pytest.mark.parametrize("hidden", [(), (4,), (4, 6), (7, 4, 5)])
@pytest.mark.parametrize(("activation", "function"), [("tanh", torch.tanh), ("relu", torch.relu)])
def test_an_mlp_is_the_formula_of_its_weights(hidden, activation, function):
    net = network(MLP(hidden=hidden, activation=activation), VECTORS)
    x_ND = torch.randn(5, 3, generator=stream(0, "x"), dtype=torch.float64)
    weights = [value.double() for value in net.parameters()]
    assert [len(bias) for bias in weights[1::2]] == [*hidden, 2]
    h = x_ND
    for weight, bias in zip(weights[:-2:2], weights[1:-2:2], strict=True):
        h = function(h @ weight.T + bias)
    torch.testing.assert_close(net.outputs(x_ND).double(), h @ weights[-2].T + weights[-1], atol=1e-5, rtol=0)


@pytest.mark.parametrize("hidden", [(), (5,), (5, 9), (9, 5)])
def test_a_cnn_is_the_formula_of_its_weights(hidden):
    net = network(CNN(channels=(2, 3), kernel_size=3, stride=2, hidden=hidden), VIEWS)
    weights = [value.double() for value in net.parameters()]
    assert [len(bias) for bias in weights[1::2]] == [2, 3, *hidden, 2]
    h = views(4).permute(0, 3, 1, 2).double() / 255
    for weight, bias in zip(weights[:4:2], weights[1:4:2], strict=True):
        h = torch.nn.functional.conv2d(h, weight, bias, stride=2).relu()
    h = h.flatten(1)
    for weight, bias in zip(weights[4:-2:2], weights[5:-2:2], strict=True):
        h = (h @ weight.T + bias).relu()
    torch.testing.assert_close(net.outputs(views(4)).double(), h @ weights[-2].T + weights[-1], atol=1e-5, rtol=0)


@pytest.mark.parametrize(("description", "space"), [(MLP(hidden=(4, 6)), VECTORS), (CNN(hidden=(4, 6)), VIEWS)])
def test_layer_norm_normalises_the_outputs_of_each_dense_layer_before_the_activation(description, space):
    net = network(description.model_copy(update={"layer_norm": True}), space)
    plain = network(description, space)
    x_N = views(4) if space is VIEWS else torch.randn(4, 3, generator=stream(0, "x"))
    weights = [layer for layer in net.trunk.layers if isinstance(layer, torch.nn.Linear)]
    assert all(
        map(
            torch.equal,
            *([each.weight for each in one.trunk.layers if isinstance(each, torch.nn.Linear)] for one in (net, plain)),
        )
    )
    h_ND = plain.trunk.layers[: -2 * 2](plain.encode(x_N)) if space is VIEWS else x_N
    for linear in weights:
        raw_ND = linear(h_ND)
        raw_ND = (raw_ND - raw_ND.mean(1, keepdim=True)) / (raw_ND.var(1, correction=0, keepdim=True) + 1e-5).sqrt()
        h_ND = raw_ND.tanh() if space is VECTORS else raw_ND.relu()
    torch.testing.assert_close(net.outputs(x_N), net.head(h_ND))
    assert not torch.allclose(net.outputs(x_N), plain.outputs(x_N), atol=1e-3)


def test_each_convolution_may_have_a_kernel_size_and_a_stride_of_its_own():
    net = network(CNN(channels=(2, 3), kernel_size=[3, 2], stride=[2, 1], hidden=[]), VIEWS)
    first, first_bias, second, second_bias, weight, bias = net.parameters()
    h = views(4).permute(0, 3, 1, 2) / 255
    h = torch.nn.functional.conv2d(h, first, first_bias, stride=2).relu()
    h = torch.nn.functional.conv2d(h, second, second_bias, stride=1).relu()
    assert h.shape == (4, 3, 2, 2)
    torch.testing.assert_close(net.outputs(views(4)), h.flatten(1) @ weight.T + bias)
    alike = [network(CNN(channels=(2, 3), kernel_size=k), VIEWS).plain_state() for k in (2, [2, 2], [2, 3])]
    shapes = [{name: value.shape for name, value in state.items()} for state in alike]
    assert shapes[0] == shapes[1] != shapes[2]
    assert all(torch.equal(value, alike[1][name]) for name, value in alike[0].items())


def test_nature_cnn_has_the_layers_of_mnih_et_al():
    net = network(NatureCNN(), spaces.Box(0, 255, (84, 84, 4), np.uint8))
    shapes = [tuple(value.shape) for name, value in net.named_parameters() if name.endswith("weight")]
    assert shapes == [(32, 4, 8, 8), (64, 32, 4, 4), (64, 64, 3, 3), (512, 7 * 7 * 64), (2, 512)]
    assert [layer.stride[0] for layer in net.modules() if isinstance(layer, torch.nn.Conv2d)] == [4, 2, 1]
    assert net.outputs(torch.zeros(3, 84, 84, 4, dtype=torch.uint8)).shape == (3, 2)
    atari = spaces.Box(0, 255, (210, 160, 3), np.uint8)
    assert sum(value.numel() for value in network(NatureCNN(), atari).parameters()) == 11_611_810


@pytest.mark.parametrize(("description", "space"), [(MLP(), VECTORS), (MLP(hidden=(8,)), STATES), (CNN(), VIEWS)])
def test_weights_start_orthogonal_with_gain_sqrt_2_and_the_last_layer_with_its_own(description, space):
    net = network(description, space)
    layers = [layer for layer in net.modules() if isinstance(layer, torch.nn.Linear | torch.nn.Conv2d)]
    for layer, gain in zip(layers, [math.sqrt(2)] * (len(layers) - 1) + [0.5], strict=True):
        rows = layer.weight.detach().flatten(1)
        gram = rows @ rows.T if rows.shape[0] <= rows.shape[1] else rows.T @ rows
        torch.testing.assert_close(gram, gain**2 * torch.eye(len(gram)), atol=1e-5, rtol=0)
        assert not layer.bias.any()


@pytest.mark.parametrize(("description", "space"), [(MLP(), VECTORS), (CNN(), VIEWS)])
def test_weights_are_sampled_from_the_given_stream_and_not_from_torchs_own_generator(description, space):
    before = torch.get_rng_state()
    first, same, other = (network(description, space, seed=seed).plain_state() for seed in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(value, same[name]) for name, value in first.items())
    assert not any(torch.equal(value, other[name]) for name, value in first.items() if name.endswith("weight"))


def test_states_are_encoded_as_one_hot_rows():
    net = network(MLP(hidden=()), STATES)
    output_ND = net.outputs(torch.tensor([4, 0, 4]))
    expected_ND = net.head.weight.T[[4, 0, 4]] + net.head.bias
    torch.testing.assert_close(output_ND, expected_ND.detach())
    assert torch.equal(net.encode(torch.tensor([2])), torch.tensor([[0.0, 0, 1, 0, 0]]))


def test_images_are_scaled_and_their_channels_come_first():
    image_N = views(2)
    input_N = network(CNN(), VIEWS).encode(image_N)
    assert input_N.dtype == torch.float32
    torch.testing.assert_close(input_N[1, 2, 3, 4], image_N[1, 3, 4, 2] / 255)
    torch.testing.assert_close(network(CNN(scale=10), VIEWS).encode(image_N), input_N * 25.5)
    floats = spaces.Box(0, 1, (7, 7, 3), np.float32)
    assert torch.equal(network(CNN(), floats).encode(image_N / 2).permute(0, 2, 3, 1), image_N / 2)


def test_the_default_convolutions_of_a_minigrid_view_leave_4_by_4_by_64():
    net = network(CNN(), VIEWS)
    assert net.trunk.layers[:7](net.encode(views(3))).shape == (3, 64 * 4 * 4)
    assert net.outputs(views(3)).shape == (3, 2)
    wide = network(
        CNN(channels=(8, 8), kernel_size=4, stride=2, hidden=(5,)), spaces.Box(0, 255, (40, 30, 1), np.uint8)
    )
    assert wide.trunk.layers[:5](torch.zeros(1, 1, 40, 30)).shape == (1, 8 * 8 * 6)


def test_outputs_do_not_depend_on_the_size_of_the_batch(monkeypatch):
    net, x_ND = network(MLP(), VECTORS), torch.randn(10, 3, generator=stream(0, "x"))
    whole_ND = net.outputs(x_ND)
    monkeypatch.setattr(networks, "_MOST_INPUTS", 3 * 64)
    torch.testing.assert_close(net.outputs(x_ND), whole_ND)


def test_running_statistics_are_those_of_all_rows_absorbed():
    norm = RunningNorm(3)
    x_ND = torch.randn(100, 3, generator=stream(0, "x"), dtype=torch.float64) * torch.tensor([1.0, 50, 1e-3]) + 1e4
    assert torch.equal(norm(x_ND), x_ND)
    for piece in x_ND.split([1, 60, 39]):
        norm.absorb(piece)
    expected_ND = (x_ND - x_ND.mean(0)) / x_ND.std(0, correction=0)
    torch.testing.assert_close(norm(x_ND)[:, :2], expected_ND[:, :2])
    # The third feature moves by a ten-millionth of its size: it is centred and not blown up.
    assert norm(x_ND)[:, 2].abs().max() < 0.01


def test_normalised_observations_are_clipped_at_10():
    norm = RunningNorm(1)
    norm.absorb(torch.tensor([[-1.0], [1.0]]))
    torch.testing.assert_close(norm(torch.tensor([[9.0], [50.0], [-50.0]])).flatten().tolist(), [9.0, 10.0, -10.0])


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_observations_that_are_not_finite_spoil_no_statistics(value):
    norm = RunningNorm(2)
    norm.absorb(torch.tensor([[-1.0, 0.0], [1.0, 3.0]]))
    before = {name: buffer.clone() for name, buffer in norm.named_buffers()}
    with pytest.raises(PgtsError, match=rf"mean of the observations is \[1.0, {value}\]"):
        norm.absorb(torch.tensor([[1.0, value]]))
    assert all(torch.equal(buffer, before[name]) for name, buffer in norm.named_buffers())


def test_each_channel_of_an_image_has_statistics_of_its_own():
    encoder = Encoder(VIEWS, CNN(normalize=True))
    image_N = views(20) // torch.tensor([1, 2, 50], dtype=torch.uint8)
    encoder.absorb(image_N)
    input_N = encoder(image_N)
    torch.testing.assert_close(input_N.mean((0, 2, 3)), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(input_N.std((0, 2, 3)), torch.ones(3), atol=1e-3, rtol=0)


def test_computing_outputs_changes_no_statistics():
    net = network(MLP(normalize=True), VECTORS)
    x_ND = torch.randn(10, 3, generator=stream(0, "x"))
    before = net.plain_state()
    net.outputs(x_ND)
    assert all(torch.equal(value, before[name]) for name, value in net.plain_state().items())
    net.trunk.encoder.absorb(x_ND)
    assert not torch.equal(
        net.plain_state()["trunk.encoder.parts.0.norm.mean_D"], before["trunk.encoder.parts.0.norm.mean_D"]
    )


def test_weights_and_statistics_survive_the_round_trip_and_what_does_not_fit_changes_nothing():
    first, second = (network(MLP(normalize=True), VECTORS, seed=seed) for seed in (0, 1))
    x_ND = torch.randn(10, 3, generator=stream(0, "x")) * 7
    first.trunk.encoder.absorb(x_ND)
    state, before = first.plain_state(), second.plain_state()
    for wrong in [
        {},
        state | {"head.bias": torch.zeros(3)},
        state | {"head.bias": state["head.bias"].double()},
        state | {"more": torch.zeros(1)},
        {name: value for name, value in state.items() if name != "trunk.encoder.parts.0.norm.count"},
    ]:
        with pytest.raises(
            PgtsError, match=r"is None|head.bias is torch.float(32 of shape \(3,\)|64)|more belongs to another network"
        ):
            second.load_plain_state(wrong)
    assert all(torch.equal(value, before[name]) for name, value in second.plain_state().items())
    second.load_plain_state(state)
    assert torch.equal(first.outputs(x_ND), second.outputs(x_ND))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MLP(hidden=(64, 0)), "hidden holds 0"),
        (lambda: MLP(hidden=64), "hidden is 64"),
        (lambda: MLP(activation="gelu"), "activation is 'gelu'"),
        (lambda: CNN(channels=[16, 2.5]), "channels holds 2.5"),
        (lambda: CNN(scale=0), "scale is 0"),
        (lambda: CNN(kernel_size=[2, 2]), r"kernel_size is \[2, 2\]; there are 3 convolutions.* one number for each"),
        (lambda: NatureCNN(channels=[8, 8]), r"kernel_size is \[8, 4, 3\]; there are 2 convolutions"),
        (lambda: CNN(stride=[1, 0, 1]), "stride is a list; it must be a whole number in .* one for each layer"),
        (lambda: network(CNN(), VECTORS), "use an mlp"),
        (lambda: network(NatureCNN(), spaces.Box(0, 255, (35, 35, 3), np.uint8)), "too small"),
        (lambda: network(CNN(kernel_size=5), VIEWS), "too small"),
        (lambda: network(MLP(normalize=True), STATES), "without a scale: it must be False"),
        (lambda: network(MLP(), spaces.Text(3)), "observations are Text"),
        (lambda: network(MLP(), VECTORS).outputs(torch.zeros(2, 4)), r"shape \(4,\); it must be \(3,\)"),
    ],
)
def test_invalid_networks_and_observation_spaces_are_refused(make, message):
    with pytest.raises(PgtsError, match=message):
        make()


def test_by_default_large_images_are_strided_so_that_a_network_stays_small():
    assert default_network(VIEWS) == CNN()
    assert default_network(VECTORS) == default_network(STATES) == MLP()
    atari = spaces.Box(0, 255, (210, 160, 3), np.uint8)
    assert sum(value.numel() for value in network(default_network(atari), atari).parameters()) < 5_000_000


def test_sizes_may_be_lists():
    assert MLP(hidden=[64, 64]) == MLP(hidden=(64, 64)) == MLP()
    assert CNN(channels=[16, 32, 64], hidden=[128]) == CNN()
