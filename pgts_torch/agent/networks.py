"""Networks from their options, with weights from a given generator, never from torch's global one.

    output(o) = head(trunk(encode(o)))

`encode` makes float32 inputs of observations: one-hot rows of states, vectors as they are, images scaled. It has no
weights, so a training loop encodes its batch once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, final

import torch
from gymnasium import spaces
from gymnasium.spaces import Space
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils import skip_init

from pgts_torch.agent.policies import fitting
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.options.policies import CNN, MLP

_ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}
_MOST_INPUTS = 2**24
_CLIP = 10.0

_LARGE_IMAGE = 32
"""The height and width from which on images are large."""


@final
class RunningNorm(nn.Module):
    """(x - mean) / standard deviation, clipped to [-10, 10], with the statistics of all rows absorbed so far; the
    identity before the first.

    Each entry of the last axis has its own statistics, in float64: mean and sum of squared deviations are merged batch
    by batch (Chan, Golub and LeVeque 1983). They change in `absorb` only.
    """

    count: Tensor
    mean_D: Tensor
    square_D: Tensor

    def __init__(self, num_features: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean_D", torch.zeros(num_features, dtype=torch.float64))
        self.register_buffer("square_D", torch.zeros(num_features, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        if not bool(self.count):
            return x
        std_D = (self.square_D / self.count).sqrt()
        # a constant feature is not divided by its (rounding) deviation, so that it stays near 0
        std_D = torch.where(std_D > 1e-6 * (1 + self.mean_D.abs()), std_D, 1.0)
        return ((x - self.mean_D) / std_D).clamp(-_CLIP, _CLIP)

    @torch.no_grad()
    def absorb(self, x: Tensor) -> None:
        """Add the rows of x to the statistics; NotFinite, and nothing is added, unless they are finite."""
        x_ND = x.reshape(-1, x.shape[-1]).double()
        mean_D, total = x_ND.mean(0), self.count + len(x_ND)
        if not bool(mean_D.isfinite().all()):
            message = f"the mean of the observations is {mean_D.tolist()}; observations must be finite"
            raise NotFinite(message, what="observation")
        apart_D = mean_D - self.mean_D
        self.square_D += (x_ND - mean_D).square().sum(0) + apart_D.square() * self.count * len(x_ND) / total
        self.mean_D += apart_D * len(x_ND) / total
        self.count.copy_(total)


@final
class Encoder(nn.Module):
    """Makes float32 inputs of the observations of a space.

    Discrete(n): one-hot rows [N, n].   Box (D,): [N, D].   Box (H, W, C): divided by `scale`, as [N, C, H, W].

    Raises:
        PgtsError: another space, or a normalisation of states.
    """

    def __init__(self, observation_space: Space[Any], *, normalize: bool, scale: float | None = None) -> None:
        super().__init__()
        self.num_states: int | None = None
        if isinstance(observation_space, spaces.Discrete) and observation_space.start == 0:
            if normalize:
                raise PgtsError("normalize is True; states are numbers without a scale, it must be False")
            self.num_states = int(observation_space.n)
            self.shape: tuple[int, ...] = (self.num_states,)
        elif isinstance(observation_space, spaces.Box) and len(observation_space.shape) in (1, 3):
            self.shape = observation_space.shape
        else:
            raise PgtsError(f"observations are {observation_space}; a network takes Discrete(n), vectors or images")
        self.scale = scale if scale is not None else 255.0 if observation_space.dtype == "uint8" else 1.0
        self.norm = RunningNorm(self.shape[-1]) if normalize else None

    @property
    def num_inputs(self) -> int:
        return math.prod(self.shape)

    def forward(self, observation_N: Tensor) -> Float[Tensor, "N ..."]:
        if self.num_states is not None:
            return nn.functional.one_hot(observation_N, self.num_states).float()
        x = self._scaled(observation_N)
        x = (x if self.norm is None else self.norm(x)).float()
        return x.permute(0, 3, 1, 2) if len(self.shape) == 3 else x

    def _scaled(self, observation_N: Tensor) -> Tensor:
        if observation_N.shape[1:] != self.shape:
            raise PgtsError(f"an observation has shape {tuple(observation_N.shape[1:])}; it must be {self.shape}")
        if self.scale == 1:
            return observation_N
        return (observation_N if observation_N.is_floating_point() else observation_N.float()) / self.scale

    def absorb(self, observation_N: Tensor) -> None:
        """Add these observations to the running statistics, where there are any."""
        if self.norm is not None:
            self.norm.absorb(self._scaled(observation_N))

    @property
    def fresh(self) -> bool:
        """Whether there are running statistics without any observation yet."""
        return self.norm is not None and not bool(self.norm.count)


@final
class Trunk(nn.Module):
    """All layers of a network but the last. A policy and a critic that have the same trunk share its weights."""

    def __init__(self, encoder: Encoder, layers: nn.Sequential, num_features: int) -> None:
        super().__init__()
        self.encoder, self.layers, self.num_features = encoder, layers, num_features


def default_network(space: Space[Any]) -> MLP | CNN:
    """Return the network for such observations where none is given: for images a CNN, with strides where they are
    large, or else the dense layer of Atari's (210, 160, 3) would have 266 million weights; for others an MLP."""
    shape = space.shape or ()
    if len(shape) != 3:
        return MLP()
    return CNN(kernel_size=3, stride=2) if min(shape[:2]) >= _LARGE_IMAGE else CNN()


def make_trunk(network: MLP | CNN, observation_space: Space[Any], *, generator: torch.Generator) -> Trunk:
    """Make a trunk on the CPU, with orthogonal weights of gain sqrt(2) (Saxe et al. 2014) and biases 0.

    MLP: without hidden layers, and with one-hot states, the network is a table. CNN: convolutions without padding over
    channels-last images; `CNN()` is the usual one for the 7x7x3 views of MiniGrid (Chevalier-Boisvert et al. 2023).

    Raises:
        PgtsError: the network does not take such observations.
    """
    if isinstance(network, MLP):
        encoder = Encoder(observation_space, normalize=network.normalize)
        if len(encoder.shape) != 1:
            raise PgtsError(f"an mlp takes states or vectors, not images of shape {encoder.shape}; use a cnn")
        flat, layers = encoder.num_inputs, list[nn.Module]()
    else:
        encoder = Encoder(observation_space, normalize=network.normalize, scale=network.scale)
        if len(encoder.shape) != 3:
            raise PgtsError(f"a cnn takes images (H, W, C), not {observation_space}; use an mlp")
        flat, layers = _convolutions(network, encoder, generator)
    layers += _dense(flat, network.hidden, network.activation, generator)
    return Trunk(encoder, nn.Sequential(*layers), (flat, *network.hidden)[-1])


def _convolutions(network: CNN, encoder: Encoder, generator: torch.Generator) -> tuple[int, list[nn.Module]]:
    """Return the number of outputs of the convolutions, and their layers."""
    height, width, inputs = encoder.shape
    layers: list[nn.Module] = []
    for outputs in network.channels:
        height, width = ((side - network.kernel_size) // network.stride + 1 for side in (height, width))
        if min(height, width) < 1:
            raise PgtsError(f"images of shape {encoder.shape} are too small for {network!r}")
        conv = skip_init(nn.Conv2d, inputs, outputs, network.kernel_size, network.stride, dtype=torch.float32)
        layers += [_orthogonal(conv, math.sqrt(2), generator), _ACTIVATIONS[network.activation]()]
        inputs = outputs
    return height * width * inputs, [*layers, nn.Flatten()]


@final
class Network(nn.Module):
    """A trunk and a linear head. It must not be moved to another device after its first use.

    Args:
        trunk: may be shared with another network.
        num_outputs: of the head.
        gain: of the head's orthogonal weights; its biases are 0.
    """

    def __init__(self, trunk: Trunk, num_outputs: int, *, gain: float, generator: torch.Generator) -> None:
        super().__init__()
        self.trunk = trunk
        head = skip_init(nn.Linear, trunk.num_features, num_outputs, dtype=torch.float32)
        self.head: nn.Linear = _orthogonal(head, gain, generator)
        self._most_rows = max(1, _MOST_INPUTS // max(trunk.encoder.num_inputs, trunk.num_features))

    @cached_property
    def weights(self) -> list[nn.Parameter]:
        """All parameters, the trunk's first."""
        return list(self.parameters())

    @cached_property
    def tensors(self) -> list[Tensor]:
        """Weights and running statistics."""
        return list(self._named.values())

    @cached_property
    def layers(self) -> list[nn.Module]:
        """The layers of the trunk, and the head."""
        return [*self.trunk.layers, self.head]

    @cached_property
    def is_dense(self) -> bool:
        """Whether all layers are dense ones or activations."""
        return all(isinstance(layer, nn.Linear | nn.Tanh | nn.ReLU) for layer in self.layers)

    @cached_property
    def functions(self) -> list[Callable[[Tensor], Tensor]]:
        """The layers as plain functions, because calling a module costs as much as a small layer."""
        return [
            partial(nn.functional.linear, weight=layer.weight, bias=layer.bias)
            if isinstance(layer, nn.Linear)
            else layer.forward
            for layer in self.layers
        ]

    @cached_property
    def _named(self) -> dict[str, Tensor]:
        """Weights and running statistics, by name, without copies."""
        return self.state_dict(keep_vars=True)

    def encode(self, observation_N: Tensor) -> Float[Tensor, "N ..."]:
        """Return the inputs that `forward` takes, without gradient."""
        return self.trunk.encoder(observation_N)

    def forward(self, input_N: Float[Tensor, "N ..."]) -> Float[Tensor, "N D"]:
        for function in self.functions:
            input_N = function(input_N)
        return input_N

    @torch.no_grad()
    def outputs(self, observation_N: Tensor) -> Float[Tensor, "N D"]:
        """Return the outputs without gradient, computed in pieces so that memory is bounded."""
        if len(observation_N) <= self._most_rows:
            return self.forward(self.encode(observation_N))
        return torch.cat([self.forward(self.encode(piece)) for piece in observation_N.split(self._most_rows)])

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
            if name.rpartition(".")[2] in ("count", "square_D") and bool((value < 0).any()):
                raise PgtsError(f"{name} is negative")
        for name, value in found.items():
            own[name].copy_(value)


def _dense(inputs: int, hidden: Sequence[int], activation: str, generator: torch.Generator) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for outputs in hidden:
        linear = skip_init(nn.Linear, inputs, outputs, dtype=torch.float32)
        layers += [_orthogonal(linear, math.sqrt(2), generator), _ACTIVATIONS[activation]()]
        inputs = outputs
    return layers


def _orthogonal(layer: Any, gain: float, generator: torch.Generator) -> Any:
    nn.init.orthogonal_(layer.weight, gain, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer
