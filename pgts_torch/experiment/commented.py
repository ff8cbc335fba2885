"""A configuration as YAML in which every option is explained."""

import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pgts_torch.config import Config, strict_yaml
from pgts_torch.experiment.resume import flat, plain
from pgts_torch.options.schema import Option, schema_of

_ALWAYS = ("name", "total_steps", "env.id", "search.depth", "rollout.num_envs", "eval.every")
_WIDTH = 99


def commented(config: Config, head: Iterable[str]) -> str:
    """Return a configuration as YAML with comments, from which `load` reads it, under these sentences. Options that are
    as by default are there, too, commented out."""
    head = [*head, "Options behind # have their defaults: remove the # to change one."]
    lines = [f"# {line}" for each in head for line in textwrap.wrap(each, _WIDTH, break_on_hyphens=False)]
    values = flat(whole := plain(config)) | {"env.kwargs": whole["env"]["kwargs"]}
    tree: dict[str, Any] = {}
    for option in schema_of(Config).options():
        if option.exists(values):
            *above, last = option.key.split(".")
            section = tree
            for part in above:
                section = section.setdefault(part, {})
            section[last] = option
    for name, child in tree.items():
        lines += [""] * (not isinstance(child, Option) or name == "name")
        lines += _lines(name, child, values, "")
    return "\n".join(lines) + "\n"


def _lines(name: str, child: Any, values: Mapping[str, Any], indent: str) -> Iterator[str]:
    if isinstance(child, Option):
        value = values.get(child.key, child.default)
        is_live = value != child.default or child.key in _ALWAYS or name in ("type", "kind")
        yield f"{indent}# {_sentence(child.meaning)} ({child.requirement})"
        yield f"{'' if is_live else '#'}{indent}{name}: {_value(value)}"
        return
    within = [line for key, each in child.items() for line in _lines(key, each, values, indent + "  ")]
    is_live = any(not line.lstrip().startswith("#") for line in within)
    yield f"{'' if is_live else '#'}{indent}{name}:"
    yield from within


def _sentence(meaning: str) -> str:
    """The first sentence of a meaning."""
    return re.split(r"(?<! al)\. ", meaning, maxsplit=1)[0].rstrip(".")


def _value(value: Any) -> str:
    """Return a value as YAML in one line."""
    if isinstance(value, list | dict):
        return json.dumps(value)
    if type(value) is int:
        return f"{value:_}"
    return strict_yaml.dump({"key": value}).removeprefix("key: ").strip()
