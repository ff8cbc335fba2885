"""The types of options: values with their ranges."""

import math
import re
import sys
from collections.abc import Iterator
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, field_validator
from pydantic_core import PydanticCustomError

INT64_MAX = 2**63 - 1

Count = Annotated[int, Field(ge=1, le=INT64_MAX)]
Several = Annotated[int, Field(ge=2, le=INT64_MAX)]
Natural = Annotated[int, Field(ge=0, le=INT64_MAX)]
Positive = Annotated[float, Field(gt=0)]
AtLeastOne = Annotated[float, Field(ge=1)]
NonNegative = Annotated[float, Field(ge=0)]
UnitInterval = Annotated[float, Field(ge=0, le=1)]
Share = Annotated[float, Field(gt=0, le=1)]
Between = Annotated[float, Field(gt=0, lt=1)]
Clip = Positive | Literal["never"]


def limit(clip: float | str) -> float | None:
    """Return the number; None for "never"."""
    return None if isinstance(clip, str) else clip


def _as_list(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


Sizes = Annotated[list[Annotated[int, Field(ge=1, le=2**16)]], Field(max_length=16), BeforeValidator(_as_list)]


def _text(pattern: str, requirement: str, max_length: int) -> Any:
    """A string field; `requirement` describes the pattern in words."""
    return Field(pattern=pattern, max_length=max_length, json_schema_extra={"requirement": requirement})


Name = Annotated[str, _text(r"^[A-Za-z0-9][A-Za-z0-9._-]*$", "letters, digits, '.', '_', '-', at most 100", 100)]
EnvId = Annotated[str, _text(r"^[A-Za-z0-9_.:/-]+$", "the id of a Gymnasium environment", 200)]
Key = Annotated[str, _text(r"^[A-Za-z0-9_.:-]+$", "a key of dictionary observations", 100)]
Keys = Annotated[
    list[Key], Field(min_length=1, json_schema_extra={"requirement": "a list of keys"}), BeforeValidator(_as_list)
]
Entry = Annotated[str, _text(r"^[A-Za-z_][A-Za-z0-9_.]*:[A-Za-z_][A-Za-z0-9_]*$", "MODULE:NAME", 200)]
Folder = Annotated[str, _text(r"^[^\x00-\x1f\x7f]+$", "a folder", 4000)]
Device = Annotated[str, _text(r"^(cpu|cuda(:[0-9]{1,3})?)$", "cpu, cuda or cuda:N", 8)]

RESERVED_KWARGS = {
    "id": "env.id sets it",
    "gamma": "env.gamma sets it",
    "num_envs": "rollout.num_envs sets it",
    "max_episode_steps": "rollout.horizon ends episodes",
    "vectorization_mode": "the rollout sets it; slow environments are shared out by pgts train --processes N",
    "autoreset_mode": "the rollout sets it",
    "vector_kwargs": "the rollout sets it",
}
"""Arguments of gymnasium.make_vec that env.kwargs must not have, with the option to use in their place."""


def _check_kwargs(kwargs: dict[str, Any]) -> dict[str, Any]:
    for name in RESERVED_KWARGS.keys() & kwargs.keys():
        raise conflict(f"env.kwargs must not have the key {name}: {RESERVED_KWARGS[name]}", f"env.kwargs.{name}")
    return _check_arguments("env.kwargs", kwargs)


def _check_arguments(key: str, arguments: dict[str, Any]) -> dict[str, Any]:
    for name in arguments:
        if not name.isidentifier():
            raise conflict(f"{key} has the key {name!r}, which cannot be the name of an argument", f"{key}.{name}")
    for value in _plain_values(arguments):
        if isinstance(value, float) and not math.isfinite(value):
            raise conflict(f"{key} holds {value}; numbers must be finite", key)
        if not (value is None or isinstance(value, bool | int | float | str)):
            raise conflict(f"{key} holds {value!r}; values must be plain", key)
    return arguments


def _plain_values(value: Any) -> Iterator[Any]:
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _plain_values(item)
    else:
        yield value


KEY = "{key}"
"""In a `conflict`: the dotted key of the value that is refused, where it is not known, as one part is in several."""


def conflict(reason: str, *keys: str) -> PydanticCustomError:
    """An error whose message is a whole sentence.

    Args:
        keys: the dotted keys that can be changed to solve it, the likeliest first; none: those in the sentence.
    """
    found = keys or re.findall(r"\b[a-z_]+(?:\.[a-z_]+)+", reason)
    return PydanticCustomError("conflict", "{reason}", {"reason": reason, "keys": found})


def checks(*names: str) -> Any:
    """Makes a validator of these options of a method of the class, the value and what is known of the other options:
    those that are declared before."""
    return lambda method: field_validator(*names)(classmethod(method))


Kwargs = Annotated[dict[str, Any], AfterValidator(_check_kwargs)]
Arguments = Annotated[dict[str, Any], AfterValidator(partial(_check_arguments, KEY))]


def _by_name(value: Any) -> Any:
    """MODULE:NAME of a class or a function; everything else stays what it is."""
    if not callable(value):
        return value
    module, name = (str(getattr(value, each, "")) for each in ("__module__", "__qualname__"))
    if not name or getattr(sys.modules.get(module), name, None) is not value:
        raise conflict(
            f"{KEY} is {name or f'an object of the class {type(value).__name__}'}; it must be a class, or a function "
            "that makes one, at the top level of a module, so that it is found there by its name",
            KEY,
        )
    return f"{module}:{name}"


Make = Annotated[Entry | None, BeforeValidator(_by_name)]


def _check_ascending(pair: list[float]) -> list[float]:
    if pair[0] > pair[1]:
        raise conflict(f"the lower number comes first; this is {pair}")
    return pair


Ascending = Annotated[
    list[float],
    Field(min_length=2, max_length=2, json_schema_extra={"requirement": "a list of two ascending numbers"}),
    BeforeValidator(_as_list),
    AfterValidator(_check_ascending),
]


def _check_counts(value: Any, *, most: int, has_null: bool) -> Any:
    """A whole number, or a list of such and, if `has_null`, None; else ValueError."""
    is_list = isinstance(value, list) and len(value) > 0
    for count in value if is_list else [value]:
        if not ((type(count) is int and 1 <= count <= most) or (count is None and is_list and has_null)):
            raise ValueError
    return value


PerLayer = Annotated[
    Any,
    BeforeValidator(_as_list),
    AfterValidator(partial(_check_counts, most=2**16, has_null=False)),
    Field(json_schema_extra={"requirement": "a whole number in [1, 65536], or a list of such, one for each layer"}),
]

Samples = Annotated[
    Any,
    BeforeValidator(_as_list),
    AfterValidator(partial(_check_counts, most=INT64_MAX, has_null=True)),
    Field(json_schema_extra={"requirement": "a whole number >= 1, or a list of such and null, one for each level"}),
]
"""None in a list: all outcomes are enumerated at that level."""
