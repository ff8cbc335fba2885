"""A trained policy as a program of its own, for torch or ONNX, which acts without this package."""

import copy
import io
import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, final

import torch
from torch import Tensor, nn

from pgts_torch import files
from pgts_torch.agent.components import legal_only
from pgts_torch.agent.encoders import Values
from pgts_torch.agent.gaussian import GaussianPolicy
from pgts_torch.agent.latent import LatentModel, standardised
from pgts_torch.agent.networks import Network
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.own_modules import OwnLayers
from pgts_torch.agent.policies import Policy, TabularPolicy
from pgts_torch.agent.world import World
from pgts_torch.errors import PgtsError, failure
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.masks import KEY, ActionMasks

Format = Literal["torch", "onnx"]
SUFFIXES: dict[Format, str] = {"torch": ".pt2", "onnx": ".onnx"}
"""The formats, each with the end of the name of its files."""

_MARK = "exported by pgts_torch"


def export(
    path: str | Path, format: Format | None, *, world: World, source: EnvSource, policy: Policy, notes: dict[str, Any]
) -> dict[str, Any]:
    """Write a policy as a program; the arguments and what is raised are those of `PGTS.export`.

    Args:
        notes: plain values for the file.

    Returns:
        The notes, with the dtypes and shapes of inputs and outputs by their names.
    """
    kind = _format(path, format)
    place = files.target(path, lambda raw: _MARK.encode() in raw, "a policy that pgts_torch has exported")
    acts, name = Exported(world, source, policy), source.name
    inputs = acts.examples()
    with _silent(), torch.no_grad():
        try:
            batch = {"given": {key: {0: torch.export.Dim("batch")} for key in inputs}}
            program = torch.export.export(acts, (inputs,), dynamic_shapes=batch, strict=False)
            named = {"inputs": inputs, "outputs": acts(inputs)}
        except Exception as error:
            raise _failure(f"the policy of {name} cannot be traced by torch.export", error) from error
        notes = notes | {what: {name: describe(x) for name, x in each.items()} for what, each in named.items()}
        content = json.dumps(notes | {"version": version("pgts_torch")})
        raw = _torch_bytes(program, content) if kind == "torch" else _onnx_bytes(program, acts, content, name)
    files.replace(place, raw)
    return notes


def describe(example: Tensor) -> str:
    """The dtype and the shape of a named tensor, as in "float32 (batch, 4)"."""
    return f"{str(example.dtype).removeprefix('torch.')} ({', '.join(['batch', *map(str, example.shape[1:])])})"


@final
class Exported(nn.Module):
    """From named tensors to named tensors, a row for each of N observations, in operations of torch that can be traced:

        observations (with their legal actions) -> probs, action               of numbered actions
                                                -> mean, std, action           of a gaussian policy

    `action` is the most probable action, or the squashed mean, in the form of the environment: what `PGTS.predict`
    returns. mean and std are those of the vectors before they are squashed.

    Raises:
        PgtsError: the policy is of a class of the caller's own.
    """

    def __init__(self, world: World, source: EnvSource, policy: Policy) -> None:
        super().__init__()
        self._observations, self._squash = world.observations, source.squash(world.env)
        self._masks = world.masks if isinstance(world.masks, ActionMasks) and world.shows_masks else None
        self._legal_of = world.legal_of
        own_actions = source.own_actions(world.env)
        if own_actions is not None and own_actions.dtype.kind != "f":
            own_actions = own_actions.astype("int64")
        self.own_actions: Tensor | None
        self.register_buffer("own_actions", None if own_actions is None else torch.from_numpy(own_actions))
        self.network = self.representation = table_SA = None
        if isinstance(policy, NetworkPolicy | GaussianPolicy):
            self.network = _Plain(policy.network)
        elif isinstance(policy, TabularPolicy):
            table_SA = policy.table()
        else:
            raise PgtsError(
                f"the policy is a {type(policy).__name__}, a class of your own, whose code no file holds: tables, "
                "networks (also your own modules) and gaussian policies can be exported"
            )
        if isinstance(world.model, LatentModel):
            self.representation = _Plain(world.model.representation)
        self.table_SA: Tensor | None
        self.register_buffer("table_SA", table_SA)
        self._gaussian = policy if isinstance(policy, GaussianPolicy) else None

    def examples(self) -> dict[str, Tensor]:
        """Two rows of each input."""
        if self._masks is None:
            return dict(self._observations.examples)
        mask = torch.ones(2, self._masks.num_entries, dtype=torch.bool)
        if KEY in self._observations.examples:
            raise PgtsError(f"observations have a part named {KEY!r}, which is the name of the input for masks")
        return self._observations.examples | {KEY: mask}

    @property
    def outputs(self) -> tuple[str, ...]:
        """The names of what is returned."""
        return ("probs", "action") if self._gaussian is None else ("mean", "std", "action")

    def forward(self, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        legal_NA = None
        if self._masks is not None:
            legal_NA = given[KEY][:, torch.from_numpy(self._masks.index_AJ)].all(-1)
        row_N = self._observations.row_tensors(given, legal_NA)
        if self._legal_of is not None:
            row_N = torch.cat([row_N, self._legal_of(row_N).to(row_N)], -1)
        if self.representation is not None:
            row_N = standardised(self.representation(row_N))
        if self._gaussian is not None:
            assert self.network is not None
            assert self._squash is not None
            normals = self._gaussian.read(self.network(row_N))
            named = normals.mean_NX, normals.std_NX, self._squash.of_tensors(normals.mean_NX)
            return dict(zip(self.outputs, named, strict=True))
        if self.table_SA is not None:
            probs_NA = self.table_SA[row_N]
        else:
            assert self.network is not None
            probs_NA = legal_only(self.network(row_N), self.network.encoder.legal(row_N)).softmax(-1)
        action_N = probs_NA.argmax(-1)
        action_N = action_N if self.own_actions is None else self.own_actions[action_N]
        return dict(zip(self.outputs, (probs_NA, action_N), strict=True))


@final
class _Plain(nn.Module):
    """A copy of a network on the CPU, which is not trained any more, as calls of modules."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        copied = copy.deepcopy(network).cpu().requires_grad_(False)
        self.encoder, self.layers = copied.trunk.encoder, nn.ModuleList(copied.layers)
        for part in self.encoder.parts:
            if isinstance(part, Values):
                part.fix()

    def forward(self, row_N: Tensor) -> Tensor:
        x = self.encoder(row_N)
        for layer in self.layers:
            x = layer.module(*layer.pieces(x)) if isinstance(layer, OwnLayers) else layer(x)
        return x


def _format(path: str | Path, format: Format | None) -> Format:
    """The format that is given, or that the name of the file says."""
    suffix = files.as_path(path).suffix
    found = format or next((each for each, end in SUFFIXES.items() if suffix == end), None)
    if found is None or found not in SUFFIXES:
        given = f"{path} ends in {suffix!r}" if format is None else f"format is {format!r}"
        raise PgtsError(f"{given}; a policy is exported as torch ({SUFFIXES['torch']}) or onnx ({SUFFIXES['onnx']})")
    return found


def _torch_bytes(program: "torch.export.ExportedProgram", content: str) -> bytes:
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={_MARK: content})
    return buffer.getvalue()


def _onnx_bytes(program: "torch.export.ExportedProgram", acts: Exported, content: str, name: str) -> bytes:
    missing = [package for package in ("onnx", "onnxscript") if find_spec(package) is None]
    if missing:
        raise PgtsError(f"the format onnx needs {' and '.join(missing)}: pip install 'pgts_torch[onnx]'")
    inputs, outputs = list(acts.examples()), list(acts.outputs)
    try:
        made = torch.onnx.export(program, dynamo=True, verbose=False, input_names=inputs, output_names=outputs)
    except Exception as error:
        raise _failure(f"the policy of {name} cannot be converted to ONNX", error) from error
    assert made is not None
    proto = made.model_proto
    for each in (*proto.graph.input, *proto.graph.output):
        each.type.tensor_type.shape.dim[0].dim_param = "batch"
    proto.metadata_props.add(key=_MARK, value=content)
    return proto.SerializeToString()


def _failure(where: str, error: Exception) -> Exception:
    """What torch says of it, but for the pages after the first line."""
    first = str(error).strip().partition("\n")[0] or type(error).__name__
    return failure(where, RuntimeError(first))


@contextmanager
def _silent() -> Iterator[None]:
    """A context in which converters say nothing of what they have not found, and warn of nothing."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)
