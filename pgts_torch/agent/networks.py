"""Networks from their options, with weights from a given generator, never from torch's global one.

    output(o) = head(trunk(encode(o)))

`encode` makes float32 inputs of observations (`encoders`). It has no weights: a training loop encodes its batch once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces import Space
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import skip_init

from pgts_torch.agent.components import components, image_shape
from pgts_torch.agent.dense_forward import DenseForm, dense_outputs
from pgts_torch.agent.encoders import Encoder, convolved
from pgts_torch.agent.own_modules import OwnLayers, own_layers
from pgts_torch.agent.policies import fitting
from pgts_torch.errors import PgtsError
from pgts_torch.options.own import OwnModule
from pgts_torch.options.policies import CNN, MLP

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}
_MOST_INPUTS = 2**24

_MOST_WEIGHTS = 20_000_000
"""Of one layer. More are hardly ever meant: without strides an Atari frame takes 266 million."""

_LARGE_IMAGE = 32
"""The height and width from which on images are large."""


@final
class Trunk(nn.Module):
    """All layers of a network but the last. A policy and a critic that have the same trunk share its weights.

    returns_outputs: whether it is a module of the caller's own that returns what otherwise the last layer does.
    """

    def __init__(
        self, encoder: Encoder, layers: nn.Sequential, num_features: int, *, returns_outputs: bool = False
    ) -> None:
        super().__init__()
        self.encoder, self.layers, self.num_features = encoder, layers, num_features
        self.returns_outputs = returns_outputs


def default_network(space: Space[Any], *, normalize: bool = False) -> MLP | CNN:
    """Return the network for such observations where none is given: a CNN where there are images that its convolutions
    fit in, an MLP for all others. On large images the CNN has strides: without them the dense layer behind Atari's
    frames, (210, 160, 3), would have 266 million weights.

    Args:
        normalize: whether an MLP normalises what has a scale.
    """
    parts = components(space)
    images = [image for image in map(image_shape, parts) if image is not None]
    large = any(min(image[:2]) >= _LARGE_IMAGE for image in images)
    cnn = CNN(kernel_size=3, stride=2) if large else CNN()
    if any(convolved(image, cnn) for image in images):
        return cnn
    return MLP(normalize=normalize and any(isinstance(part, spaces.Box) for part in parts))


def make_trunk(
    network: MLP | CNN | OwnModule, observation_space: Space[Any], *, generator: torch.Generator, num_outputs: int = 1
) -> Trunk:
    """Make a trunk on the CPU, with orthogonal weights of gain sqrt(2) (Saxe et al. 2014) and biases 0.

    Convolutions are over channels-last images without padding, each image with its own, beside what is no image; those
    of `CNN()` are the usual ones for the 7x7x3 views of MiniGrid (Chevalier-Boisvert et al. 2023).

    Args:
        observation_space: of the rows: a `Component`, or a Tuple of some.
        num_outputs: of a module of the caller's own that returns outputs.

    Raises:
        PgtsError: the network does not take such observations, a layer would have more than 20 million weights, or a
            module of the caller's own cannot be used.
    """
    encoder = Encoder(observation_space, network)
    if isinstance(network, OwnModule):
        own = own_layers(network, encoder, None if network.head else num_outputs, generator)
        return Trunk(encoder, nn.Sequential(own), own.num_outputs, returns_outputs=not network.head)
    flat, layers = encoder.num_inputs, list[nn.Module]()
    if isinstance(network, CNN):
        branches = [_convolutions(network, shape, generator) for shape in encoder.shapes]
        flat = sum(outputs for outputs, _ in branches)
        beside = [nn.Sequential(*convolutions) for _, convolutions in branches]
        layers = branches[0][1] if len(branches) == 1 else [Join(beside, encoder.shapes)]
    for outputs in network.hidden:
        linear = _linear(flat, outputs, math.sqrt(2), generator, observation_space)
        norm = [nn.LayerNorm(outputs, dtype=torch.float32)] if network.layer_norm else []
        layers += [linear, *norm, _ACTIVATIONS[network.activation]()]
        flat = outputs
    return Trunk(encoder, nn.Sequential(*layers), flat)


@final
class Join(nn.Module):
    """Layers for each component of encoded rows, and what they return, one after the other: [N, D] -> [N, D']."""

    def __init__(self, branches: Sequence[nn.Module], shapes: Sequence[tuple[int, ...]]) -> None:
        super().__init__()
        self.branches, self._shapes = nn.ModuleList(branches), shapes

    def forward(self, input_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N D2"]:
        pieces = input_ND.split([*map(math.prod, self._shapes)], 1)
        each = zip(self.branches, pieces, self._shapes, strict=True)
        return torch.cat([branch(piece.reshape(-1, *shape)) for branch, piece, shape in each], 1)


def _convolutions(network: CNN, shape: tuple[int, ...], generator: torch.Generator) -> tuple[int, list[nn.Module]]:
    """Return the number of outputs of the convolutions over inputs of this shape, and their layers; those of a vector
    are none."""
    if len(shape) == 1:
        return shape[0], []
    inputs, height, width = shape
    layers: list[nn.Module] = []
    for outputs, kernel_size, stride in network.convolutions:
        conv = skip_init(nn.Conv2d, inputs, outputs, kernel_size, stride, dtype=torch.float32)
        layers += [_orthogonal(conv, math.sqrt(2), generator), _ACTIVATIONS[network.activation]()]
        inputs = outputs
    left = convolved((height, width, inputs), network)
    assert left is not None  # or the encoder would not have made an image of it
    return math.prod(left) * inputs, [*layers, nn.Flatten()]


@final
class Scaled(nn.Module):
    """weight * x + bias, for each output; at first x."""

    def __init__(self, num_outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(num_outputs, dtype=torch.float32))
        self.bias = nn.Parameter(torch.zeros(num_outputs, dtype=torch.float32))

    def forward(self, output_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
        return torch.addcmul(self.bias, output_ND, self.weight)


@final
class Network(nn.Module):
    """A trunk and a head. It must not be moved to another device after its first use.

    The head is linear. Where the trunk returns outputs there is none, or `Scaled` if the outputs are rescaled, as those
    of a critic are with the scale of its targets.

    loops: whether outputs are computed by compiled loops; only where it `is_dense`.

    Args:
        trunk: may be shared with another network.
        gain: of the head's orthogonal weights; its biases are 0.
    """

    def __init__(
        self, trunk: Trunk, num_outputs: int, *, gain: float, generator: torch.Generator, rescaled: bool = False
    ) -> None:
        super().__init__()
        self.trunk = trunk
        if trunk.returns_outputs:
            self.head: nn.Module = Scaled(num_outputs) if rescaled else nn.Identity()
        else:
            self.head = _linear(trunk.num_features, num_outputs, gain, generator, trunk.encoder.space)
        self._most_rows = max(1, _MOST_INPUTS // max(trunk.encoder.num_inputs, trunk.num_features))
        self.loops: Callable[[], bool] = lambda: False
        self._packed = 0, np.zeros(0, np.float32)

    @cached_property
    def weights(self) -> list[nn.Parameter]:
        """All parameters that are trained, the trunk's first."""
        return [weight for weight in self.parameters() if weight.requires_grad]

    @cached_property
    def num_weights(self) -> int:
        return sum(weight.numel() for weight in self.weights)

    @property
    def theta_D(self) -> Float[np.ndarray, "P"]:
        """All weights as one vector, on the CPU, in which they lie, so that each changes with the other. Weights that
        lie elsewhere, because another network has the same trunk or because this one is a copy, are moved into a new
        one.
        """
        place, theta_D = self._packed
        if self.weights[0].data_ptr() != place:
            with torch.inference_mode(False):  # or it could not be changed outside of that mode
                vector_D = torch.cat([weight.detach().view(-1) for weight in self.weights])
            pieces = vector_D.split([weight.numel() for weight in self.weights])
            for weight, piece in zip(self.weights, pieces, strict=True):
                weight.data = piece.view_as(weight)
            theta_D = vector_D.numpy()
            self._packed = vector_D.data_ptr(), theta_D
        return theta_D

    @cached_property
    def tensors(self) -> list[Tensor]:
        """Weights and running statistics."""
        return list(self._named.values())

    @cached_property
    def encoder(self) -> Encoder:
        return self.trunk.encoder

    @cached_property
    def layers(self) -> list[nn.Module]:
        """The layers of the trunk, and the head."""
        return [*self.trunk.layers, self.head]

    @cached_property
    def is_dense(self) -> bool:
        """Whether all layers are dense ones or activations."""
        return all(isinstance(layer, nn.Linear | nn.Tanh | nn.ReLU) for layer in self.layers)

    @cached_property
    def dense_form(self) -> DenseForm:
        """The layers of a dense network."""
        dense = [layer for layer in self.layers if isinstance(layer, nn.Linear)]
        sizes = dense[0].in_features, *(layer.out_features for layer in dense)
        return sizes, any(isinstance(layer, nn.Tanh) for layer in self.layers)

    @cached_property
    def functions(self) -> list[Callable[[Tensor], Tensor]]:
        """The layers as plain functions, because calling a module costs as much as a small layer."""
        return [
            partial(nn.functional.linear, weight=layer.weight, bias=layer.bias)
            if isinstance(layer, nn.Linear)
            else (layer if isinstance(layer, OwnLayers) else layer.forward)
            for layer in self.layers
        ]

    @cached_property
    def _named(self) -> dict[str, Tensor]:
        """Weights and running statistics, by name, without copies."""
        return self.state_dict(keep_vars=True)

    def encode(self, observation_N: Tensor) -> Float[Tensor, "N ..."]:
        """Return the inputs that `forward` takes, without gradient."""
        return self.encoder.forward(observation_N)

    def forward(self, input_N: Float[Tensor, "N ..."]) -> Float[Tensor, "N D"]:
        for function in self.functions:
            input_N = function(input_N)
        return input_N

    def plain(self, input_N: Float[Tensor, "N ..."]) -> Float[Tensor, "N D"]:
        """As `forward`, without gradient."""
        if self.loops():
            return dense_outputs(self.theta_D, self.dense_form, input_N)
        with torch.no_grad():
            return self.forward(input_N)

    def outputs(self, observation_N: Tensor) -> Float[Tensor, "N D"]:
        """Return the outputs without gradient, computed in pieces so that memory is bounded."""
        if observation_N.shape[0] <= self._most_rows:
            return self.plain(self.encode(observation_N))
        return torch.cat([self.plain(self.encode(piece)) for piece in observation_N.split(self._most_rows)])

    @torch.no_grad()
    def follow(self, other: "Network", rate: float) -> None:
        """Move the weights toward those of a network of the same shape by this share of the difference, and take over
        its running statistics."""
        for moved, aim in zip(self.weights, other.weights, strict=True):
            moved.lerp_(aim, rate)
        for statistic, present in zip(self.buffers(), other.buffers(), strict=True):
            statistic.copy_(present)

    @torch.no_grad()
    def plain_state(self) -> dict[str, Tensor]:
        """Return weights and running statistics, copied to the CPU."""
        return {name: value.to("cpu", copy=True) for name, value in self._named.items()}

    @torch.no_grad()
    def load_plain_state(self, state: Mapping[str, Any]) -> None:
        """Load what `plain_state` returned; PgtsError, and nothing is changed, unless all of it fits."""
        own = self._named
        if unknown := sorted(set(state) - set(own)):
            raise PgtsError(f"{unknown[0]} belongs to another network; this one has {sorted(own)}")
        found = {name: fitting(dict(state), name, like) for name, like in own.items()}
        for name, value in found.items():
            is_statistic = name.startswith("trunk.encoder.") and name.rpartition(".")[2] in ("count", "square_D")
            if is_statistic and bool((value < 0).any()):
                raise PgtsError(f"{name} is negative")
        for name, value in found.items():
            own[name].copy_(value)


def _linear(inputs: int, outputs: int, gain: float, generator: torch.Generator, space: Space[Any]) -> nn.Linear:
    """A dense layer; PgtsError if it would be too large for the observations that it is made for."""
    if (count := inputs * outputs) > _MOST_WEIGHTS:
        raise PgtsError(
            f"a layer of {inputs:,} x {outputs:,} = {count:,} weights would be needed for observations of the shape "
            f"{_shape_text(space)}; more than {_MOST_WEIGHTS:,} are never made: take nature_cnn, a cnn with a larger "
            "stride, or smaller or fewer images (gymnasium.wrappers.ResizeObservation), or smaller hidden layers"
        )
    linear: nn.Linear = _orthogonal(skip_init(nn.Linear, inputs, outputs, dtype=torch.float32), gain, generator)
    return linear


def _shape_text(space: Space[Any]) -> str:
    shapes = [
        f"({part.n} numbers)" if isinstance(part, spaces.Discrete) else str(part.shape) for part in components(space)
    ]
    return " and ".join(shapes)


def _orthogonal(layer: Any, gain: float, generator: torch.Generator) -> Any:
    nn.init.orthogonal_(layer.weight, gain, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer
