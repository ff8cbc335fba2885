"""Convert the arguments of `PGTS` to options, and back."""

import re
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from pgts_torch.errors import PgtsError
from pgts_torch.options.environment import Observed
from pgts_torch.options.mistakes import explain
from pgts_torch.options.part import Part
from pgts_torch.options.rollouts import Rollouts
from pgts_torch.options.search import LookaheadOptions
from pgts_torch.options.training import Training

_FLAT = {
    "env": tuple(Observed.model_fields),
    "rollout": tuple(Rollouts.model_fields),
    "search": tuple(LookaheadOptions.model_fields),
}
"""The sections whose options are arguments of `PGTS` of their own."""

_PARTS = ("policy", "critic", "estimator", "update", "model", "replay")

_PREFIX = re.compile(rf"\b(?:env|rollout|search)\.({'|'.join(name for names in _FLAT.values() for name in names)})\b")


def read(arguments: Mapping[str, Any]) -> Training:
    """Return the options in the arguments of `PGTS`.

    Parts may be given as options, names, plain mappings or objects that were made from options. None, and objects of
    the caller's own classes, count as auto.

    Raises:
        PgtsError: one line for each mistake.
    """
    data: dict[str, Any] = {
        section: {name: arguments[name] for name in names if name in arguments} for section, names in _FLAT.items()
    }
    parts = {name: _options_of(arguments.get(name)) for name in _PARTS}
    data |= {name: _with_never(value) for name, value in parts.items() if value is not None}
    search = arguments["search"]
    search = search.plain() if isinstance(search, Part) else search if isinstance(search, Mapping) else {"kind": search}
    data["search"] |= {"kind" if name == "type" else name: value for name, value in search.items()}
    return checked(data)


def checked(options: Mapping[str, Any]) -> Training:
    """Return a training with these options; PgtsError, which names them as arguments of `PGTS`, if they are invalid."""
    try:
        return Training.model_validate(dict(options))
    except ValidationError as error:
        lines = dict.fromkeys(_PREFIX.sub(r"\1", mistake.message) for mistake in explain(Training, error))
        raise PgtsError("\n".join(lines)) from None


def described(options: Training) -> dict[str, Any]:
    """Return plain arguments from which `read` returns the same options."""
    plain = options.plain()
    kind = {name: value for name, value in plain["search"].items() if name not in LookaheadOptions.model_fields}
    flat = {name: getattr(getattr(options, section), name) for section, names in _FLAT.items() for name in names}
    return flat | {name: plain[name] for name in _PARTS} | {"search": kind, "horizon": plain["rollout"]["horizon"]}


def shortest(options: Training) -> dict[str, Any]:
    """Return the arguments from which `read` returns the same options: the parts, and of other options those that are
    not the default. A part is a word, or a mapping with what is not its default."""
    given = {
        name: getattr(part, name)
        for section, names in _FLAT.items()
        for name in names
        if getattr(part := getattr(options, section), name) != type(part).model_fields[name].default or name == "depth"
    }
    if "horizon" in given:
        given["horizon"] = _short(options.rollout.horizon)
    kind = {
        name: value for name, value in _changed(options.search).items() if name not in LookaheadOptions.model_fields
    }
    parts = {name: _short(getattr(options, name)) for name in _PARTS}
    parts["search"] = {"type": options.search.kind} | kind if kind else options.search.kind
    return given | {name: word for name, word in parts.items() if word != _MOSTLY.get(name)}


_MOSTLY = {"estimator": "lookahead", "model": "auto", "replay": "none", "search": "auto"}
"""Parts that need not be named."""


def _short(part: Any) -> Any:
    changed = _changed(part)
    return {"type": part.type} | changed if changed else part.type


def _changed(part: Part) -> dict[str, Any]:
    """Return the options of a part that are not the default, without its type."""
    changed = {}
    for name, field in type(part).model_fields.items():
        value = getattr(part, name)
        if name not in ("type", "kind") and value is not None and value != field.default:
            changed[field.alias or name] = _short(value) if isinstance(value, Part) else value
    return changed


def _options_of(part: Any) -> Any:
    """The options of an object that was made from some; a class of the caller's own, and all else, as it is."""
    return part if isinstance(part, type) else getattr(part, "options", part)


def _with_never(value: Any) -> Any:
    """Return a part with None replaced by never, where a plain mapping says so of a clip."""
    if not isinstance(value, Mapping):
        return value
    return {key: "never" if item is None and key in ("floor", "max_grad_norm") else item for key, item in value.items()}
