"""Inputs of networks from rows of observations, by the kind of each component."""

import math
from functools import cached_property
from typing import Any, final

import torch
from gymnasium import spaces
from gymnasium.spaces import Space
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pgts_torch.agent.components import Component, components, counts, image_shape, inputs, legal_in, row_shape
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.options.own import OwnModule
from pgts_torch.options.policies import CNN, MLP
from pgts_torch.ranks import ALONE, Ranks

_CLIP = 10.0


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
        return _normalised(x, self.mean_D, self._std_D()) if bool(self.count) else x

    def _std_D(self) -> Float[Tensor, "D"]:
        std_D = (self.square_D / self.count).sqrt()
        # a constant feature is not divided by its (rounding) deviation, so that it stays near 0
        return torch.where(std_D > 1e-6 * (1 + self.mean_D.abs()), std_D, 1.0)

    def fixed(self) -> "FixedNorm | None":
        """The same function, with the statistics as they are; None: it is the identity."""
        return FixedNorm(self.mean_D, self._std_D()) if bool(self.count) else None

    @torch.no_grad()
    def absorb(self, x: Tensor, ranks: Ranks = ALONE) -> None:
        """Add the rows of x, in all ranks, to the statistics; NotFinite, and nothing is added, unless they are
        finite."""
        rows, mean_D, square_D = ranks.moments("observations", x.reshape(-1, x.shape[-1]).double())
        total = self.count + rows
        if not bool(mean_D.isfinite().all()):
            message = f"the mean of the observations is {mean_D.tolist()}; observations must be finite"
            raise NotFinite(message, what="observation")
        apart_D = mean_D - self.mean_D
        self.square_D += square_D + apart_D.square() * self.count * rows / total
        self.mean_D += apart_D * rows / total
        self.count.copy_(total)


@final
class FixedNorm(nn.Module):
    """A `RunningNorm` whose statistics stay as they are, without a branch that depends on them."""

    mean_D: Tensor
    std_D: Tensor

    def __init__(self, mean_D: Float[Tensor, "D"], std_D: Float[Tensor, "D"]) -> None:
        super().__init__()
        self.register_buffer("mean_D", mean_D)
        self.register_buffer("std_D", std_D)

    def forward(self, x: Tensor) -> Tensor:
        return _normalised(x, self.mean_D, self.std_D)


def _normalised(x: Tensor, mean_D: Float[Tensor, "D"], std_D: Float[Tensor, "D"]) -> Tensor:
    return ((x - mean_D) / std_D).clamp(-_CLIP, _CLIP)


@final
class OneHot(nn.Module):
    """Numbers [N, *shape] as float32 one-hot rows, those of several numbers one after the other: [N, sum of counts]."""

    first: Tensor

    def __init__(self, component: spaces.Discrete | spaces.MultiDiscrete) -> None:
        super().__init__()
        each = counts(component)
        self.counts: list[int] = each.tolist()
        self.shape: tuple[int, ...] = (sum(self.counts),)
        self.register_buffer("first", torch.from_numpy(each.cumsum() - each), persistent=False)

    def forward(self, number_N: Tensor) -> Float[Tensor, "N D"]:
        column_NK = number_N.reshape(number_N.shape[0], -1).long() + self.first
        zeros_ND = torch.zeros(number_N.shape[0], *self.shape, dtype=torch.float32, device=number_N.device)
        return zeros_ND.scatter_(1, column_NK, 1.0)

    def examples(self, count: int, generator: torch.Generator) -> Float[Tensor, "N D"]:
        """Return random rows."""
        return self.forward(torch.stack([torch.randint(n, (count,), generator=generator) for n in self.counts], 1))


@final
class Values(nn.Module):
    """Numbers on a scale [N, *shape] as float32: an image as [N, C, H, W], everything else as [N, D], or in its own
    shape.

    shape: of what is returned, without N.   norm: the running statistics, of each channel or entry.

    Args:
        image: the height, width and channels that it is seen as; None: as a vector.
        normalize: whether there are running statistics.
        scale: by which values are divided; None: the largest that is possible in bytes and in images, else 1.
    """

    def __init__(
        self,
        component: Component,
        *,
        image: tuple[int, int, int] | None,
        normalize: bool,
        scale: float | None,
        keeps_shape: bool = False,
    ) -> None:
        super().__init__()
        shape = component.shape or (1,)
        self._is_image, self._layout = image is not None, image or (shape if keeps_shape else (math.prod(shape),))
        self.shape = self._layout if image is None else (image[2], *image[:2])
        self.scale = _scale_of(component) if scale is None else scale
        self.norm: RunningNorm | FixedNorm | None = RunningNorm(self._layout[-1]) if normalize else None

    def forward(self, x_N: Tensor) -> Float[Tensor, "N ..."]:
        x = self._scaled(x_N)
        x = (x if self.norm is None else self.norm(x)).float()
        return x.permute(0, 3, 1, 2) if self._is_image else x

    def examples(self, count: int, generator: torch.Generator) -> Float[Tensor, "N ..."]:
        """Return random inputs from [0, 1)."""
        return torch.rand(count, *self.shape, generator=generator, dtype=torch.float32)

    def absorb(self, x_N: Tensor, ranks: Ranks) -> None:
        """Add these to the running statistics, where there are any."""
        if isinstance(self.norm, RunningNorm):
            self.norm.absorb(self._scaled(x_N), ranks)

    def fix(self) -> None:
        """Keep the statistics as they are, as constants."""
        self.norm = self.norm.fixed() if isinstance(self.norm, RunningNorm) else self.norm

    def _scaled(self, x_N: Tensor) -> Tensor:
        x = x_N if x_N.shape[1:] == self._layout else x_N.reshape(x_N.shape[0], *self._layout)
        return x if self.scale == 1 else (x if x.is_floating_point() else x.float()) / self.scale


@final
class Encoder(nn.Module):
    """Makes float32 inputs of rows of observations: one-hot rows of numbers, bits and vectors as they are, images
    scaled.

    Of a single component [N, D], or [N, C, H, W] of an image under a cnn; of several [N, D], one after the other.

    space: of the rows.   shapes: of the inputs of each component.

    Args:
        network: a cnn sees images as such if its convolutions fit in, an mlp all entries alike, a module of the
            caller's own always.

    Raises:
        PgtsError: another space, a normalisation where nothing has a scale, or a cnn where there is no image that its
            convolutions fit in.
    """

    def __init__(self, space: Space[Any], network: MLP | CNN | OwnModule) -> None:
        super().__init__()
        parts = inputs(space)
        if network.normalize and not any(isinstance(part, spaces.Box) for part in parts):
            raise PgtsError(f"normalize is True; observations are {space}, without a scale: it must be False")
        self.space, self.row_shape = space, row_shape(space)
        self.parts = nn.ModuleList(_encoder(part, network) for part in parts)
        self.shapes: list[tuple[int, ...]] = [part.shape for part in self.parts]  # type: ignore[misc]
        self._sizes = [math.prod(part.shape or ()) for part in components(space)]
        if isinstance(network, CNN) and all(len(shape) == 1 for shape in self.shapes):
            images = any(map(image_shape, parts))
            raise PgtsError(
                f"images of {space} are too small for {network!r}"
                if images
                else f"a cnn takes images, not {space}; use an mlp"
            )

    @property
    def num_inputs(self) -> int:
        return sum(map(math.prod, self.shapes))

    @cached_property
    def _each(self) -> list[Any]:
        return list(self.parts)

    def forward(self, observation_N: Tensor) -> Float[Tensor, "N ..."]:
        # plain calls of plain attributes, because those of modules cost as much as a small layer
        return _joined([part.forward(x_N) for part, x_N in zip(self._each, self._split(observation_N), strict=False)])

    def examples(self, count: int, generator: torch.Generator) -> Float[Tensor, "N ..."]:
        """Return random inputs: one-hot rows of numbers, all else from [0, 1)."""
        return _joined([part.examples(count, generator) for part in self._each])

    def _split(self, observation_N: Tensor) -> tuple[Tensor, ...]:
        """The entries of each component, the legal actions too."""
        if observation_N.shape[1:] != self.row_shape:
            raise PgtsError(f"an observation has shape {tuple(observation_N.shape[1:])}; it must be {self.row_shape}")
        return (observation_N,) if len(self._sizes) == 1 else observation_N.split(self._sizes, 1)

    def legal(self, observation_N: Tensor) -> Bool[Tensor, "N A"] | None:
        """The legal actions in these observations; None where all are."""
        return legal_in(self.space, observation_N)

    def absorb(self, observation_N: Tensor, ranks: Ranks = ALONE) -> None:
        """Add these observations, in all ranks, to the running statistics, where there are any."""
        for part, x_N in zip(self._each, self._split(observation_N), strict=False):
            if isinstance(part, Values):
                part.absorb(x_N, ranks)

    @property
    def norm(self) -> RunningNorm | None:
        """The first running statistics; None where there are none."""
        norms = (part.norm for part in self._each if isinstance(part, Values))
        return next((norm for norm in norms if isinstance(norm, RunningNorm)), None)

    @property
    def fresh(self) -> bool:
        """Whether there are running statistics without any observation yet."""
        return self.norm is not None and not bool(self.norm.count)


def _joined(encoded: list[Tensor]) -> Float[Tensor, "N ..."]:
    return encoded[0] if len(encoded) == 1 else torch.cat([x_N.flatten(1) for x_N in encoded], 1)


def convolved(image: tuple[int, int, int], network: CNN) -> tuple[int, int] | None:
    """Return the height and width of what the convolutions leave of an image; None where it is too small for them."""
    height, width, _ = image
    for _, kernel_size, stride in network.convolutions:
        height, width = ((side - kernel_size) // stride + 1 for side in (height, width))
        if min(height, width) < 1:
            return None
    return height, width


def _encoder(component: Component, network: MLP | CNN | OwnModule) -> OneHot | Values:
    if isinstance(component, spaces.Discrete | spaces.MultiDiscrete):
        return OneHot(component)
    keeps_shape = isinstance(network, OwnModule)
    if isinstance(component, spaces.MultiBinary):
        return Values(component, image=None, normalize=False, scale=1.0, keeps_shape=keeps_shape)
    image = None if isinstance(network, MLP) else image_shape(component)
    if image is not None and isinstance(network, CNN) and convolved(image, network) is None:
        image = None
    if image is not None and isinstance(network, CNN):
        return Values(component, image=image, keeps_shape=keeps_shape, normalize=network.normalize, scale=network.scale)
    return Values(component, image=image, keeps_shape=keeps_shape, normalize=network.normalize, scale=None)


def _scale_of(component: Component) -> float:
    """The largest size of bytes and of what is in images, where that is bounded; 1 of everything else."""
    if not isinstance(component, spaces.Box) or not component.is_bounded():
        return 1.0
    if component.dtype != "uint8" and image_shape(component) is None:
        return 1.0
    return float(max(abs(component.low).max(), abs(component.high).max())) or 1.0
