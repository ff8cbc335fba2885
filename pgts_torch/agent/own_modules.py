"""Networks of the caller's own: modules that are made by their name, tried once, and then called as they are."""

import copy
import math
from collections.abc import Iterator, Sequence
from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces import Space
from jaxtyping import Float
from torch import Tensor, nn

from pgts_torch.agent.encoders import Encoder
from pgts_torch.errors import PgtsError, failure
from pgts_torch.options.own import OwnModule
from pgts_torch.seeding import SharedGenerators
from pgts_torch.trust import made_by

_ROWS = 5
_ROUNDING = 1e-3


@final
class OwnLayers(nn.Module):
    """A module of the caller's own, which is called with the inputs of each component of the rows, in their order.

    num_outputs: for each row.

    Args:
        name: of the module, in errors.
        shapes: of the inputs of each component, without N.
        num_outputs: None: as many as there are in the first call.
    """

    def __init__(
        self, name: str, module: nn.Module, shapes: Sequence[tuple[int, ...]], num_outputs: int | None
    ) -> None:
        super().__init__()
        self.name, self.module, self._shapes = name, module, shapes
        self._sizes = [math.prod(shape) for shape in shapes]
        self._num_outputs = num_outputs

    @property
    def num_outputs(self) -> int:
        assert self._num_outputs is not None
        return self._num_outputs

    def pieces(self, input_N: Float[Tensor, "N ..."]) -> list[Tensor]:
        """What the module is called with: the inputs of each component."""
        if len(self._shapes) == 1:
            return [input_N]
        each = zip(input_N.split(self._sizes, 1), self._shapes, strict=True)
        return [piece.reshape(-1, *shape) for piece, shape in each]

    def forward(self, input_N: Float[Tensor, "N ..."]) -> Float[Tensor, "N D"]:
        """Raises PgtsError where the module fails, or does not return float32 of the shape (N, outputs)."""
        if not len(input_N):  # some modules cannot do without rows
            return input_N.new_zeros(0, self.num_outputs)
        pieces = self.pieces(input_N)
        try:
            output = self.module(*pieces)
        except Exception as error:
            shapes = " and ".join(str(tuple(piece.shape)) for piece in pieces)
            raise failure(f"{self.name} failed with inputs of the shape {shapes}", error) from error
        found = (
            f"{output.dtype} of the shape {tuple(output.shape)}"
            if isinstance(output, Tensor)
            else f"a {type(output).__name__}"
        )
        if isinstance(output, Tensor) and output.ndim == 2 and self._num_outputs is None:
            self._num_outputs = output.shape[1]
        shape = (len(input_N), self._num_outputs)
        if not isinstance(output, Tensor) or output.shape != shape or output.dtype != input_N.dtype:
            must = f"{len(input_N)}, {'features' if self._num_outputs is None else self._num_outputs}"
            asked = " (num_outputs is 1 for a critic, also where the policy's module makes it)"
            raise PgtsError(
                f"{self.name} returned {found} for {len(input_N)} rows; it must return {input_N.dtype} of the shape "
                f"({must}){asked * (self._num_outputs == 1)}"
            )
        return output


def own_layers(options: OwnModule, encoder: Encoder, num_outputs: int | None, generator: torch.Generator) -> OwnLayers:
    """Make a module of the caller's own, on the CPU in float32, and try it on random inputs.

    Its factory is called with the space of the inputs that a call will have, without N, a Tuple where there are several
    components, and with the number of outputs. Random numbers that it takes from global generators are those of
    `generator`. It is in evaluation mode always: what is trained is what acts.

    Args:
        num_outputs: None: the factory is not given it, and the module returns features, as many as it likes.

    Raises:
        PgtsError: it is no module that is a function of each row alone, with weights that a gradient reaches.
    """
    assert options.make is not None
    boxes: list[Space[Any]] = [spaces.Box(-np.inf, np.inf, shape, np.float32) for shape in encoder.shapes]
    given = [boxes[0] if len(boxes) == 1 else spaces.Tuple(boxes)] + ([] if num_outputs is None else [num_outputs])
    seed, name = int(torch.randint(2**31, (), generator=generator)), f"the module {options.make}"
    input_N = encoder.examples(_ROWS, generator)
    with SharedGenerators(seed, "module"):
        module = made_by("the network is", options.make, *given, **options.arguments)
        if not isinstance(module, nn.Module):
            raise PgtsError(f"{name} made a {type(module).__name__}; it must be a torch.nn.Module")
        _check_state(name, module)
        layers = OwnLayers(name, module, encoder.shapes, num_outputs)
        try:
            layers = layers.to("cpu", torch.float32).eval()
            layers(input_N)  # some layers make their weights in their first call
            layers.load_state_dict(copy.deepcopy(layers).state_dict())
        except (RuntimeError, TypeError, NotImplementedError, AttributeError) as error:
            raise failure(f"{name} cannot be moved to the CPU in float32 and copied", error) from error
    _check_weights(layers, are_needed=not options.head)
    _check_function(layers, input_N)
    return layers


def _check_state(name: str, module: nn.Module) -> None:
    """PgtsError unless all that is saved is tensors of real numbers."""
    for key, value in module.state_dict().items():
        if not isinstance(value, Tensor):
            raise PgtsError(f"{name} has the state {key}, a {type(value).__name__}; only tensors are saved")
        if value.is_complex():
            raise PgtsError(f"{name} has complex numbers in {key}; networks compute in torch.float32")


def _check_weights(layers: OwnLayers, *, are_needed: bool) -> None:
    """PgtsError unless all that is saved is finite, and, where they are needed, some weights are trained."""
    for name, value in layers.module.state_dict().items():
        if not bool(value.isfinite().all()):
            raise PgtsError(
                f"{layers.name} holds {name}, which is not finite; register it as a buffer with persistent=False"
            )
    if are_needed and not _trained(layers):
        raise PgtsError(f"{layers.name} has no weights that are trained (nn.Parameter with requires_grad)")


def _trained(layers: OwnLayers) -> list[nn.Parameter]:
    return [weight for weight in layers.parameters() if weight.requires_grad]


def _check_function(layers: OwnLayers, input_N: Float[Tensor, "N ..."]) -> None:
    """PgtsError unless the module is a function of each row alone."""
    name, kept_N = layers.name, input_N.clone()
    before = {key: value.clone() for key, value in layers.state_dict().items()}
    with SharedGenerators() as generators:
        output_ND = layers(input_N)
        again_ND, one_by_one_ND = layers(input_N), torch.cat([layers(row_1) for row_1 in input_N.split(1)])
    now = layers.state_dict()
    if not torch.equal(input_N, kept_N) or any(not torch.equal(value, now[key]) for key, value in before.items()):
        raise PgtsError(f"{name} changes its inputs or its buffers when it is called; it must not")
    if not output_ND.isfinite().all():
        raise PgtsError(f"{name} returned {output_ND.flatten()[:3].tolist()} for inputs from 0 to 1; it must be finite")
    if generators.used or not _same(output_ND, again_ND):
        raise PgtsError(
            f"{name} returns something else each time; it must be the same function of its inputs (to remember, "
            "let it read the latest observations: gymnasium.wrappers.FrameStackObservation)"
        )
    if not _same(output_ND, one_by_one_ND):
        raise PgtsError(f"{name} returns other values for a row where there are others beside it; rows must not mix")
    _check_gradient(layers, output_ND)
    with SharedGenerators() as generators:
        trained_ND = layers.train()(input_N)
    layers.eval()
    if generators.used or not _same(output_ND, trained_ND):
        raise PgtsError(
            f"{name} acts otherwise in training mode, as dropout and batch norm do; networks here have one mode, in "
            "which those would do nothing: take them out, or nn.LayerNorm or nn.GroupNorm in their place"
        )


def _check_gradient(layers: OwnLayers, output_ND: Float[Tensor, "N D"]) -> None:
    """PgtsError unless a gradient reaches the weights of the module, and none else."""
    name, trained = layers.name, _trained(layers)
    if output_ND.requires_grad and not set(_reached(output_ND)) <= set(trained):
        raise PgtsError(
            f"{name} computes with weights that are not its own, so that they would be neither trained nor saved: keep "
            "layers in nn.ModuleList or nn.ModuleDict, tensors as nn.Parameter"
        )
    if not trained:
        return
    if not output_ND.requires_grad:
        raise PgtsError(f"{name} returns values from which no gradient reaches its weights")
    try:
        found = torch.autograd.grad(output_ND.sum(), trained, allow_unused=True)
    except RuntimeError as error:
        raise failure(f"{name} has no gradient", error) from error
    if any(gradient is not None and gradient.layout != torch.strided for gradient in found):
        raise PgtsError(f"{name} has sparse gradients; they must be dense (nn.Embedding with sparse=False)")


def _reached(output_ND: Float[Tensor, "N D"]) -> Iterator[Tensor]:
    """The tensors that a gradient reaches."""
    nodes, seen = [output_ND.grad_fn], set()
    while nodes:
        if (node := nodes.pop()) is None or node in seen:
            continue
        seen.add(node)
        if (leaf := getattr(node, "variable", None)) is not None:
            yield leaf
        nodes += [before for before, _ in node.next_functions]


def _same(one_ND: Tensor, other_ND: Tensor) -> bool:
    """Whether two outputs are equal up to rounding."""
    scale = max(float(one_ND.detach().abs().max()), 1.0)
    return bool(((one_ND - other_ND).abs() <= _ROUNDING * scale).all())
