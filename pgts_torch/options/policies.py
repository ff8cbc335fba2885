"""Options of policies: tables and networks."""

import math
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo

from pgts_torch.options.fields import Natural, PerLayer, Positive, Share, Sizes, checks, conflict
from pgts_torch.options.own import OwnModule, by_name
from pgts_torch.options.part import Part


class Uniform(Part):
    """All actions equally likely."""

    type: Literal["uniform"] = "uniform"


class Random(Part):
    """Action probabilities sampled from the uniform distribution over the simplex."""

    type: Literal["random"] = "random"


class Biased(Part):
    """One action preferred in every state; the others share the rest."""

    type: Literal["biased"] = "biased"

    action: Natural = 0
    """The preferred action."""

    probability: Share = 0.99
    """Its probability; 1 only with policy.type simplex."""


Init = Uniform | Random | Biased


class AutoPolicy(Part):
    """By the environment: softmax where observations are numbered states, cnn where there are images, else mlp."""

    type: Literal["auto"] = "auto"


class TabularPolicy(Part):
    """A table, for environments whose observations are numbered states."""

    init: Init = Field(default=Uniform(), discriminator="type")
    """The policy before the first update."""


class Softmax(TabularPolicy):
    """A table of logits, for environments whose observations are numbered states."""

    type: Literal["softmax"] = "softmax"

    @checks("init")
    def _finite_logits(cls, init: Any) -> Any:
        if isinstance(init, Biased) and init.probability == 1:
            raise conflict(
                "policy.init.probability is 1, which policy.type softmax cannot represent (infinite logits); "
                "it must be below 1, or policy.type simplex"
            )
        return init


class Simplex(TabularPolicy):
    """A table of probabilities, for environments whose observations are numbered states."""

    type: Literal["simplex"] = "simplex"


class MLP(Part):
    """Fully connected layers over observations of any kind, as one vector."""

    type: Literal["mlp"] = "mlp"

    hidden: Sizes = Field(default=[64, 64])
    """Sizes of the hidden layers."""

    activation: Literal["tanh", "relu"] = "tanh"
    """The activation function after each hidden layer."""

    layer_norm: bool = False
    """Normalise the outputs of each fully connected layer, before the activation (Ba et al. 2016)."""

    normalize: bool = False
    """Subtract the running mean of vectors and divide by their running deviation; only where there are some."""


class CNN(Part):
    """Convolutions over images, then fully connected layers over what they return and all else that is seen."""

    type: Literal["cnn"] = "cnn"

    channels: Sizes = Field(default=[16, 32, 64])
    """Channels of the convolutions, one after the other."""

    kernel_size: PerLayer = 2
    """Height and width of the kernels: of all convolutions, or of each."""

    stride: PerLayer = 1
    """Stride: of all convolutions, or of each."""

    hidden: Sizes = Field(default=[128])
    """Sizes of the fully connected layers."""

    activation: Literal["tanh", "relu"] = "relu"
    """The activation function after each layer."""

    layer_norm: bool = False
    """Normalise the outputs of each fully connected layer, before the activation (Ba et al. 2016)."""

    normalize: bool = False
    """Subtract the running mean of each channel, or entry of a vector, and divide by its running deviation."""

    scale: Positive | None = None
    """By which images are divided; null: the largest value that they declare. MiniGrid's codes are at most 10."""

    @checks("kernel_size", "stride")
    def _one_for_each(cls, value: Any, info: ValidationInfo) -> Any:
        channels = info.data.get("channels")
        if channels is not None and isinstance(value, list) and len(value) != len(channels):
            raise conflict(
                f"{info.field_name} is {value}; there are {len(channels)} convolutions, of the channels {channels}: it "
                "must have one number for each of them, or be one number for all"
            )
        return value

    @property
    def convolutions(self) -> list[tuple[int, int, int]]:
        """The channels, kernel size and stride of each convolution."""
        each = (
            [value] * len(self.channels) if isinstance(value, int) else value
            for value in (self.kernel_size, self.stride)
        )
        return list(zip(self.channels, *each, strict=True))


class NatureCNN(CNN):
    """The cnn that is usual for Atari (Mnih et al. 2015), over images of 36 x 36 and more."""

    type: Literal["nature_cnn"] = "nature_cnn"  # type: ignore[assignment]  # another tag of the same options

    channels: Sizes = Field(default=[32, 64, 64])
    """Channels of the convolutions, one after the other."""

    kernel_size: PerLayer = Field(default=[8, 4, 3])
    """Height and width of the kernels: of all convolutions, or of each."""

    stride: PerLayer = Field(default=[4, 2, 1])
    """Stride: of all convolutions, or of each."""

    hidden: Sizes = Field(default=[512])
    """Sizes of the fully connected layers."""


class AutoLayers(Part):
    """By the environment: cnn where there are images, else mlp."""

    type: Literal["auto"] = "auto"


class Gaussian(Part):
    """A normal distribution over continuous actions, which are squashed into their bounds by tanh."""

    type: Literal["gaussian"] = "gaussian"

    network: Annotated[
        AutoLayers | MLP | CNN | NatureCNN | OwnModule,
        Field(discriminator="type"),
        BeforeValidator(partial(by_name, kind=OwnModule)),
    ] = AutoLayers()
    """The network that returns means, and as many numbers more of which standard deviations are made."""

    std: Positive = 1.0
    """The standard deviation at first, before tanh."""

    min_std: Positive = 0.05
    """The smallest standard deviation; below std."""

    @checks("min_std")
    def _is_smaller(cls, value: Any, info: ValidationInfo) -> Any:
        if value >= info.data.get("std", math.inf):
            raise conflict(f"policy.min_std is {value}; it must be below policy.std, {info.data['std']}")
        return value


Table = Softmax | Simplex
Network = MLP | CNN | NatureCNN | OwnModule

TABLES, NETWORKS = ("softmax", "simplex"), ("mlp", "cnn", "nature_cnn", "module", "gaussian")
"""The types of tables and of what is made of networks; auto, which the environment decides, is in neither."""
