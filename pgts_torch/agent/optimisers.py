"""Gradient steps on networks, which are taken back where one of them meets infinity or NaN."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal, final

import numpy as np
import torch
from torch import Tensor, nn

from pgts_torch.agent.policies import fitting
from pgts_torch.compiled import can_compile
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.ranks import Share
from pgts_torch.readings import Readings

BETAS = 0.9, 0.999
_EPSILON = 1e-8

_SHORT, _MANY = 2**15, 200
"""Steps of dense networks with up to so many weights are compiled (`dense_steps`), because calls of torch take longer
than the numbers; and only from so many steps on, because a shorter training is over before the loops are loaded."""


@final
class Optimiser:
    """Steps down a gradient, after clipping its norm:

        adam:   theta <- theta - learning_rate m / (sqrt(v) + 1e-8),   bias-corrected moments (Kingma and Ba 2015)
        sgd:    theta <- theta - learning_rate g

    All gradients are concatenated into one vector, because for a small network the calls cost more than the numbers.
    A step reads nothing back from the device; what is not finite is found when the steps of an `attempt` are over.

    Args:
        learning_rate: above 0.
        max_grad_norm: gradients longer than this are shortened to it; None: never.
    """

    def __init__(
        self, *, learning_rate: float, max_grad_norm: float | None, method: Literal["adam", "sgd"] = "adam"
    ) -> None:
        self.learning_rate, self.max_grad_norm, self.method = learning_rate, max_grad_norm, method
        self.num_steps = 0
        self._first_D: Tensor | None = None
        self._second_D: Tensor | None = None
        self._undo, self._readings = Undo(), Readings()
        self._parameters: Sequence[Tensor] = ()
        self._step_D, self._moved, self._pieces = torch.empty(0), list[Tensor](), list[Tensor]()

    @contextmanager
    def attempt(self, tensors: Sequence[Tensor]) -> Iterator[Readings]:
        """A context of steps, at the end of which their numbers are read, with all others that were added.

        Args:
            tensors: what is changed in the context. They and the optimiser are as before where it raises PgtsError.

        Raises:
            NotFinite: the loss of a step, its gradient or the step is not finite. It is raised in place of an error
                that such a step has led to in the context.
        """
        self._readings = readings = Readings()
        self._undo.keep(tensors, self)
        try:
            try:
                yield readings
            finally:
                readings.read()
        except PgtsError:
            self._undo.restore(self)
            raise

    def step(
        self,
        parameters: Sequence[nn.Parameter],
        gradients: Sequence[Tensor],
        loss: Tensor,
        name: str,
    ) -> Tensor:
        """Take a step, inside an `attempt`; the parameters must be the same in each call. Return the norm of the
        gradient before clipping.

        Args:
            gradients: of the loss, one for each parameter.
            name: of the loss, in errors.

        Raises:
            PgtsError: the moments are those of other parameters.
        """
        with torch.no_grad():
            gradient_D = torch.cat([piece.reshape(-1) for piece in gradients])
            norm = torch.linalg.vector_norm(gradient_D)
            if self._parameters is not parameters:
                self._prepare(parameters)
            total = self._move(gradient_D, norm)
            self._readings.check(loss, partial(refuse, "loss", f"the {name} loss"))
            self._readings.check(norm, partial(refuse, "gradient", f"the gradient of the {name} loss"))
            self._readings.check(total, partial(refuse, "gradient", f"the step down the {name} loss"))
            torch._foreach_add_(self._moved, self._pieces)
        return norm

    def compiles_all_of(self, count: int, like: Tensor) -> bool:
        """Whether the next step of so many weights like these is a compiled loop, with its gradient."""
        is_short = count <= _SHORT and like.dtype == torch.float32
        return is_short and self.method == "adam" and self.num_steps >= _MANY and can_compile(like.device)

    def _prepare(self, parameters: Sequence[Tensor]) -> None:
        """Make room for steps of these parameters, which is kept."""
        sizes, like = [each.numel() for each in parameters], parameters[0]
        self._step_D = torch.empty(sum(sizes), dtype=like.dtype, device=like.device)
        pieces = zip(self._step_D.split(sizes), parameters, strict=True)
        self._parameters, self._moved = parameters, list(parameters)
        self._pieces = [piece.view_as(each) for piece, each in pieces]

    def _move(self, gradient_D: Tensor, norm: Tensor) -> Tensor:
        """Write the step for a gradient of this norm. Return the sum of its numbers."""
        if self.max_grad_norm is not None:
            limit = torch.full_like(norm, self.max_grad_norm, dtype=torch.float64)
            gradient_D *= limit.div_(norm).clamp_(max=1)
        if self.method == "sgd":
            return torch.mul(gradient_D, -self.learning_rate, out=self._step_D).sum()
        first_D, second_D = self._moments(gradient_D)
        first_D.lerp_(gradient_D, 1 - BETAS[0])
        second_D.mul_(BETAS[1]).addcmul_(gradient_D, gradient_D, value=1 - BETAS[1])
        epsilon, rate = self._corrected()
        return torch.div(first_D, second_D.sqrt().add_(epsilon), out=self._step_D).mul_(rate).sum()

    def next_step(self, like_D: Tensor) -> tuple[Tensor, Tensor, float, float, float]:
        """Count one more step of Adam, which the caller takes. Return the moments, which it changes in place, the
        longest gradient, and e and c (`_corrected`)."""
        longest = math.inf if self.max_grad_norm is None else self.max_grad_norm
        return *self._moments(like_D), longest, *self._corrected()

    def _corrected(self) -> tuple[float, float]:
        """e and c for which c m / (sqrt(v) + e) is the step: the corrections of moments, taken out of the vectors."""
        mean_correction, square_correction = (1 - beta**self.num_steps for beta in BETAS)
        root = math.sqrt(square_correction)
        return _EPSILON * root, -self.learning_rate * root / mean_correction

    def _moments(self, like_D: Tensor) -> tuple[Tensor, Tensor]:
        """The moments before one more step, which is counted."""
        if self._first_D is None or self._second_D is None:
            self._first_D, self._second_D = torch.zeros_like(like_D), torch.zeros_like(like_D)
        if len(self._first_D) != len(like_D):
            raise PgtsError(
                f"the optimiser has moments of {len(self._first_D)} parameters; the network has {len(like_D)}"
            )
        self._first_D, self._second_D = self._first_D.to(like_D), self._second_D.to(like_D)
        self.num_steps += 1
        return self._first_D, self._second_D

    @property
    def moments(self) -> list[Tensor]:
        """The moments, which steps change in place; none before the first step."""
        return [] if self._first_D is None or self._second_D is None else [self._first_D, self._second_D]

    def state_dict(self) -> dict[str, Any]:
        """Return the moments and the number of steps; empty before the first step."""
        if self._first_D is None or self._second_D is None:
            return {}
        return {
            "num_steps": self.num_steps,
            "first_D": self._first_D.cpu().clone(),
            "second_D": self._second_D.cpu().clone(),
        }

    def rewind(self, num_steps: int) -> None:
        """Count steps as before later ones that were taken back; before the first there are no moments."""
        self.num_steps = num_steps
        if num_steps == 0:
            self._first_D = self._second_D = None

    def check_fits(self, parameters: Sequence[Tensor]) -> None:
        """PgtsError unless the moments, if there are any, have the size and dtype of these parameters."""
        size, dtype = sum(each.numel() for each in parameters), parameters[0].dtype
        if self._first_D is not None and (self._first_D.shape != (size,) or self._first_D.dtype != dtype):
            found = f"{self._first_D.dtype} of shape {tuple(self._first_D.shape)}"
            raise PgtsError(f"the moments of the optimiser are {found}; the network has {size} parameters in {dtype}")

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned; PgtsError if it is something else."""
        if not state:
            self.num_steps, self._first_D, self._second_D = 0, None, None
            return
        num_steps, first_D = state.get("num_steps"), state.get("first_D")
        if type(num_steps) is not int or num_steps < 1 or not isinstance(first_D, Tensor) or self.method == "sgd":
            raise PgtsError(f"{self.method} cannot load {sorted(state)} with num_steps = {num_steps}")
        second_D = fitting(state, "second_D", first_D)
        if not bool((second_D >= 0).all()):
            raise PgtsError("second_D has negative squares")
        self.num_steps, self._first_D, self._second_D = num_steps, first_D.clone(), second_D


@final
class Undo:
    """Takes back gradient steps. The copies lie in memory that is kept from one update to the next."""

    def __init__(self) -> None:
        self._tensors: list[Tensor] = []
        self._copies: list[Tensor] = []
        self._num_steps = 0

    @torch.no_grad()
    def keep(self, tensors: Sequence[Tensor], optimiser: Optimiser) -> None:
        """Remember the weights, which are changed in place, and the optimiser."""
        self._tensors, self._num_steps = [*tensors, *optimiser.moments], optimiser.num_steps
        if [like.shape for like in self._copies] != [each.shape for each in self._tensors]:
            self._copies = [torch.empty_like(each) for each in self._tensors]
        torch._foreach_copy_(self._copies, self._tensors)

    @torch.no_grad()
    def restore(self, optimiser: Optimiser) -> None:
        """Put them back as they were in the latest `keep`."""
        torch._foreach_copy_(self._tensors, self._copies)
        optimiser.rewind(self._num_steps)


def refuse(what: str, name: str, value: float) -> None:
    raise NotFinite(f"{name} is {value}; no parameter was changed", what=what)


def minibatches(
    columns: Sequence[Tensor], size: int, share: Share, *, generator: torch.Generator
) -> Iterator[tuple[int, tuple[Tensor, ...]]]:
    """Yield minibatches of the rows of all processes, in one common random order, `size` at a time (the last one may be
    smaller): how many rows it has, and in all columns those of this process. If there are at most `size` rows they are
    one batch, in their own order.

    Args:
        share: which rows these are among those of all.
        generator: the same in all processes.
    """
    if share.total <= size:
        return iter([(share.total, tuple(columns))])
    order_N = torch.randperm(share.total, generator=generator, device=generator.device)
    counts = own_counts = [len(piece) for piece in order_N.split(size)]
    if share.ranks.size > 1:
        order_N = order_N.cpu()
        own_N = (order_N >= share.first) & (order_N < share.first + len(columns[0]))
        own_counts = np.add.reduceat(own_N.numpy(), np.arange(0, share.total, size), dtype=np.int64).tolist()
        order_N = order_N[own_N] - share.first
    rows = zip(*(column[order_N.to(column.device)].split(own_counts) for column in columns), strict=True)
    return zip(counts, rows, strict=True)
