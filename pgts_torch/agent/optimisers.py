"""Gradient steps on networks, which are taken back where one of them meets infinity or NaN."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal, final

import torch
from torch import Tensor, nn

from pgts_torch.agent.policies import fitting
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.readings import Readings

_BETAS = 0.9, 0.999
_EPSILON = 1e-8


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
        method: "adam" or "sgd".
    """

    def __init__(
        self, *, learning_rate: float, max_grad_norm: float | None, method: Literal["adam", "sgd"] = "adam"
    ) -> None:
        self.learning_rate, self.max_grad_norm, self.method = learning_rate, max_grad_norm, method
        self.num_steps = 0
        self._first_D: Tensor | None = None
        self._second_D: Tensor | None = None
        self._undo, self._readings = Undo(), Readings()

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
            loss: what is minimised.
            name: of the loss, in errors.

        Raises:
            PgtsError: the moments are those of other parameters.
        """
        with torch.no_grad():
            gradient_D = torch.cat([piece.reshape(-1) for piece in gradients])
            norm = torch.linalg.vector_norm(gradient_D)
            if self.max_grad_norm is not None:
                limit = torch.full_like(norm, self.max_grad_norm, dtype=torch.float64)
                gradient_D *= limit.div_(norm).clamp_(max=1)
            step_D = self._adam(gradient_D) if self.method == "adam" else gradient_D.mul_(-self.learning_rate)
            self._readings.check(loss, partial(_refuse, "loss", f"the {name} loss"))
            self._readings.check(norm, partial(_refuse, "gradient", f"the gradient of the {name} loss"))
            self._readings.check(step_D.sum(), partial(_refuse, "gradient", f"the step down the {name} loss"))
            moved: list[Tensor] = list(parameters)
            pieces = step_D.split([parameter.numel() for parameter in moved])
            torch._foreach_add_(moved, [piece.view_as(like) for piece, like in zip(pieces, moved, strict=True)])
        return norm

    def _adam(self, gradient_D: Tensor) -> Tensor:
        if self._first_D is None or self._second_D is None:
            self._first_D, self._second_D = torch.zeros_like(gradient_D), torch.zeros_like(gradient_D)
        if len(self._first_D) != len(gradient_D):
            raise PgtsError(
                f"the optimiser has moments of {len(self._first_D)} parameters; the network has {len(gradient_D)}"
            )
        first_D, second_D = self._first_D, self._second_D = self._first_D.to(gradient_D), self._second_D.to(gradient_D)
        self.num_steps += 1
        first_D.lerp_(gradient_D, 1 - _BETAS[0])
        second_D.mul_(_BETAS[1]).addcmul_(gradient_D, gradient_D, value=1 - _BETAS[1])
        # m / c1 / (sqrt(v / c2) + eps), with the corrections taken out of the vectors.
        mean_correction, square_correction = (1 - beta**self.num_steps for beta in _BETAS)
        root = math.sqrt(square_correction)
        scale_D = second_D.sqrt().add_(_EPSILON * root)
        return torch.div(first_D, scale_D).mul_(-self.learning_rate * root / mean_correction)

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


def _refuse(what: str, name: str, value: float) -> None:
    raise NotFinite(f"{name} is {value}; no parameter was changed", what=what)


def minibatches(columns: Sequence[Tensor], size: int, *, generator: torch.Generator) -> Iterator[tuple[Tensor, ...]]:
    """Yield the rows of all columns in one common random order, `size` at a time (the last batch may be smaller). If
    there are at most `size` rows they are one batch, in their own order."""
    if len(columns[0]) <= size:
        return iter([tuple(columns)])
    order_N = torch.randperm(len(columns[0]), generator=generator, device=generator.device)
    return zip(*(column[order_N.to(column.device)].split(size) for column in columns), strict=True)
