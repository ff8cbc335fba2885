"""Messages about invalid options."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from pgts_torch.options.fields import INT64_MAX, KEY
from pgts_torch.options.schema import KeyPath, Node, Schema, is_text, requirement, schema_of, tag_of


@dataclass(frozen=True)
class Mistake:
    """An invalid option, or options that do not go together.

    Args:
        message: a whole sentence.
        keys: the options that can be changed to solve it, the likeliest first.
        is_value: whether a value was refused for itself, whatever the others are; the message then begins with its key.
    """

    message: str
    keys: tuple[KeyPath, ...]
    is_value: bool = False


def explain(
    model: type[BaseModel],
    error: ValidationError,
    written: Callable[[KeyPath], str | None] = lambda key: None,
) -> Iterator[Mistake]:
    """Yield a `Mistake` for each error of pydantic.

    Args:
        written: returns the text of a scalar as it was written, where it was read from text.
    """
    for each in error.errors(include_url=False):
        yield _mistake(schema_of(model), each, written)


def _mistake(schema: Schema, error: ErrorDetails, written: Callable[[KeyPath], str | None]) -> Mistake:
    path, node, section = schema.locate(error["loc"])
    if error["type"] == "conflict":
        dotted = ".".join(path)
        keys = tuple(tuple(key.replace(KEY, dotted).split(".")) for key in error["ctx"]["keys"])
        return Mistake(error["ctx"]["reason"].replace(KEY, dotted), keys or (path,))
    if node is None:
        return Mistake(_unknown(schema, path, section), (path,))
    value, must = error["input"], what(node)
    if error["type"] == "union_tag_invalid":
        tag = tag_of(node)
        path, must = (*path, tag), requirement(node)
        value = value[tag] if isinstance(value, dict) else getattr(value, tag)
    is_or_holds = "holds" if isinstance(error["loc"][-1], int) else "is"
    sentence = f"{'.'.join(path)} {is_or_holds} {show(value, written(path))}; it must be {must}{_advice(node, value)}"
    return Mistake(sentence, (path,), is_value=True)


def _unknown(schema: Schema, path: KeyPath, section: Node) -> str:
    key = ".".join(path)
    if not schema.find(path):
        return f"{escape(key)} is unknown{schema.hint(key)}"
    # Another variant has it. A variant is told by the one key that has a single value.
    name, value = next((name, child["const"]) for name, child in section["properties"].items() if "const" in child)
    tag = ".".join((*path[:-1], name))
    return f"{key} does not belong to {tag} {value}; it must be left out, or {tag} changed"


def what(node: Node) -> str:
    """Return what a value, or a section, must be, in words."""
    return requirement(node) + (f", or a mapping with such a {tag}" if (tag := tag_of(node)) else "")


def _advice(node: Node, value: Any) -> str:
    """Return how to write the value that was probably meant; empty where that is unknown."""
    if isinstance(value, bool):
        return ""
    if isinstance(value, int) and value > INT64_MAX:
        return " and below 2**63" if node.get("maximum") == INT64_MAX else ""
    if isinstance(value, float) and value.is_integer() and node.get("type") == "integer" and abs(value) < 1e15:
        return f" (write {int(value)})"
    if isinstance(value, int | float) and is_text(node):
        return " (in quotes, to make it text)"
    return ""


def show(value: Any, text: str | None = None) -> str:
    """Return a value as one short line; numbers as they were written, text in quotes."""
    if isinstance(value, dict | list):
        return "a mapping" if isinstance(value, dict) else "a list"
    if text == "":
        return "empty"
    if isinstance(value, str):
        return quote(value)
    if text is None:
        text = json.dumps(value) if isinstance(value, int | None) else repr(value)
    return escape(text)


def quote(text: str) -> str:
    return f"'{escape(text)}'"


def escape(text: str, length: int = 60) -> str:
    """Escape all characters that cannot be printed, and shorten long text."""
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[: length + 1])
    return shown if len(shown) <= length else f"{shown[:length]}..."
