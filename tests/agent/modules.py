"""Networks as a user would write them, and some that no training can use."""

import functools
import math
import threading
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn


class Plain(nn.Module):
    """One hidden layer over the first component of a row, and a frozen buffer of each dtype."""

    def __init__(self, space: Any, num_outputs: int, width: int = 8) -> None:
        super().__init__()
        self.inputs = nn.LazyLinear(width)
        self.outputs = nn.Linear(width, num_outputs)
        self.outputs.weight.data.mul_(0.01)  # so that a policy is nearly uniform at first
        nn.init.zeros_(self.outputs.bias)
        self.register_buffer("shift", torch.full((width,), 0.5, dtype=torch.float64))
        self.register_buffer("order", torch.arange(width).flip(0))
        self.register_buffer("mask", torch.full((width,), -math.inf), persistent=False)

    def forward(self, first: Tensor, *others: Tensor) -> Tensor:
        hidden = torch.cat([first.flatten(1), *(each.flatten(1) for each in others)], 1)
        return self.outputs((self.inputs(hidden).tanh() + self.shift)[:, self.order].maximum(self.mask))


class Features(nn.Module):
    """Any number of features of a vector."""

    def __init__(self, space: spaces.Box, width: int = 8) -> None:
        super().__init__()
        self.layer, self.norm = nn.Linear(space.shape[0], width), nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.layer(x)).relu()


class Frozen(Features):
    """Features that stay as they are."""

    def __init__(self, space: spaces.Box) -> None:
        super().__init__(space)
        self.requires_grad_(False)


class Attention(nn.Module):
    """Attention between the two parts of an observation, an image and a one-hot row; some weights are tied, others
    frozen or not used."""

    def __init__(self, space: spaces.Tuple, num_outputs: int) -> None:
        super().__init__()
        (channels, _, _), (count,) = (part.shape for part in space)
        self.image, self.number = nn.Conv2d(channels, 8, 3), nn.Linear(count, 8)
        self.attention = nn.TransformerEncoderLayer(8, 2, 16, dropout=0.0, batch_first=True)
        self.outputs, self.unused = nn.Linear(8, num_outputs), nn.Linear(2, 2)
        self.tied = self.outputs
        self.number.weight.requires_grad_(False)

    def forward(self, image: Tensor, number: Tensor) -> Tensor:
        tokens = torch.stack([self.image(image).amax((2, 3)), self.number(number)], 1)
        return self.tied(self.attention(tokens).mean(1))


class Recurrent(nn.Module):
    """A GRU over the latest observations, from the oldest to the newest: [N, K, D]."""

    def __init__(self, space: spaces.Box, num_outputs: int, width: int = 16) -> None:
        super().__init__()
        self.memory = nn.GRU(space.shape[-1], width, batch_first=True)
        self.outputs = nn.Linear(width, num_outputs)

    def forward(self, x_NKD: Tensor) -> Tensor:
        return self.outputs(self.memory(x_NKD)[1][-1])


class Forgetful(nn.Module):
    """A GRU whose memory is kept from one call to the next."""

    def __init__(self, space: spaces.Box, num_outputs: int) -> None:
        super().__init__()
        self.memory, self.outputs = nn.GRUCell(space.shape[0], 8), nn.Linear(8, num_outputs)
        self.hidden: Tensor | None = None

    def forward(self, x: Tensor) -> Tensor:
        same = self.hidden is not None and len(self.hidden) == len(x)
        self.hidden = self.memory(x, self.hidden if same else None).detach()
        return self.outputs(self.memory(x, self.hidden))


class Wrong(nn.Module):
    """Does to the outputs of a dense layer what one of the cases below says."""

    def __init__(self, space: spaces.Box, num_outputs: int, how: str) -> None:
        super().__init__()
        self.layer, self.how = nn.Linear(space.shape[0], num_outputs), how
        self.dropout, self.norm = nn.Dropout(0.5), nn.BatchNorm1d(num_outputs)
        self.register_buffer("calls", torch.zeros(()))
        self.hidden = [nn.Linear(num_outputs, num_outputs)]
        self.table = nn.Embedding(1, num_outputs, sparse=True)
        if how == "no weights":
            self.requires_grad_(False)
        if how == "weights that lie on each other":
            self.layer.weight = nn.Parameter(torch.zeros(1, 1).expand(num_outputs, space.shape[0]))
        if how == "complex weights":
            self.more = nn.Parameter(torch.zeros(2, dtype=torch.complex64))
        if how == "numbers on no device":
            self.to("meta")
        if how == "infinite buffer":
            self.register_buffer("mask", torch.tensor(-math.inf))
        if how == "cannot be copied":
            self.lock = threading.Lock()
        if how == "fails when made":
            raise RuntimeError("no such layer")

    def get_extra_state(self) -> Any:
        return {} if self.how == "state of its own" else torch.zeros(())

    def set_extra_state(self, state: Any) -> None:
        """It has none."""

    def forward(self, x: Tensor) -> Any:
        y = self.layer(x)
        if self.how == "changes its input":
            x.mul_(2)
        if self.how == "counts calls":
            self.calls += 1
        return OUTPUTS.get(self.how, lambda _, y: y)(self, y)


class NoGradient(torch.autograd.Function):
    """It cannot be differentiated."""

    @staticmethod
    def forward(context: Any, y: Tensor) -> Tensor:
        return y.clone()


def _fails(module: Wrong, y: Tensor) -> Tensor:
    raise RuntimeError("mat1 and mat2")


OUTPUTS: dict[str, Any] = {
    "one row only": lambda _, y: y[:1],
    "one output more": lambda _, y: torch.cat([y, y[:, :1]], 1),
    "one axis": lambda _, y: y[:, 0],
    "float64": lambda _, y: y.double(),
    "integers": lambda _, y: y.long(),
    "an array": lambda _, y: y.detach().numpy(),
    "nothing": lambda _, y: None,
    "NaN": lambda _, y: y * math.nan,
    "infinity": lambda _, y: y / 0,
    "no gradient": lambda _, y: y.detach(),
    "noise of torch": lambda _, y: y + torch.rand_like(y),
    "noise of numpy": lambda _, y: y + float(np.random.rand()),  # noqa: NPY002
    "a draw that changes nothing": lambda _, y: y + 0 * torch.rand(()),
    "noise of its own": lambda _, y: y + torch.rand(y.shape, generator=GENERATOR),
    "dropout": lambda module, y: module.dropout(y),
    "batch norm": lambda module, y: module.norm(y),
    "rows mix": lambda _, y: y - y.mean(0),
    "layers in a list": lambda module, y: module.hidden[0](y),
    "sparse gradients": lambda module, y: y + module.table(torch.zeros(len(y), dtype=torch.int64)),
    "fails backward": lambda _, y: NoGradient.apply(y),
    "fails": _fails,
}
GENERATOR = torch.Generator()

MAKES_NONE = functools.partial(lambda space, num_outputs: None)


def makes_nothing(space: Any, num_outputs: int) -> None:
    """A factory that forgets to return."""


def linear(space: spaces.Box, num_outputs: int) -> nn.Module:
    """A dense layer whose weights start at 0."""
    layer = nn.Linear(space.shape[0], num_outputs)
    nn.init.zeros_(layer.weight)
    return layer


def deep(space: spaces.Box, num_outputs: int) -> nn.Module:
    """A function that makes a module."""
    return nn.Sequential(nn.Linear(space.shape[0], 8), nn.Tanh(), nn.Linear(8, num_outputs))
