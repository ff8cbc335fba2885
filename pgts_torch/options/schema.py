"""The keys of options with their requirements, defaults and meanings, for help and messages.

All are read from the JSON schema of the pydantic model, so help and messages agree with what is accepted.
"""

import difflib
import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel

from pgts_torch.options.fields import INT64_MAX

Node = dict[str, Any]
"""A JSON schema with its reference resolved."""

KeyPath = tuple[str, ...]


@dataclass(frozen=True)
class Option:
    """One key.

    Args:
        key: dotted, for instance "search.depth".
        requirement: what its value must be, in words.
        default: its value where none is given.
        meaning: one sentence.
        choices: (value, meaning) for each value, where values have meanings.
        when: (key, values), for instance ("critic.type", ("tabular", "rollout")): the option exists only where each of
            these keys has one of its values.
    """

    key: str
    requirement: str
    default: Any
    meaning: str
    choices: tuple[tuple[str, str], ...] = ()
    when: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def exists(self, values: Mapping[str, Any]) -> bool:
        """Whether the option exists beside these values, by dotted keys."""
        return all(values.get(key) in allowed for key, allowed in self.when)


class Schema:
    """The tree of keys of a model."""

    def __init__(self, model: type[BaseModel]) -> None:
        schema = model.model_json_schema(by_alias=True)
        self._definitions = schema.get("$defs", {})
        self.root = self._follow(schema)

    def fields(self, node: Node) -> dict[str, Node]:
        """Return the keys directly below a section; {} for other nodes."""
        return {name: self._follow(child) for name, child in node.get("properties", {}).items()}

    def variants(self, node: Node) -> dict[str, Node]:
        """Return the sections between which a tag (`type` or `kind`) chooses, in order; {} for other nodes."""
        nodes = [self._follow(variant) for variant in node.get("oneOf", ())]
        return {variant["properties"][tag_of(node)]["const"]: variant for variant in nodes}

    def find(self, path: Sequence[str]) -> list[Node]:
        """Return the nodes of a path, one for each variant that has it. Below kwargs any path is valid, as node {}."""
        nodes = [self.root]
        for part in path:
            if any(node.get("additionalProperties") is True for node in nodes):
                return [{}]
            sections = [section for node in nodes for section in (node, *self.variants(node).values())]
            nodes = [fields[part] for fields in map(self.fields, sections) if part in fields]
        return nodes

    def locate(self, location: Sequence[str | int]) -> tuple[KeyPath, Node | None, Node]:
        """Find the place of a pydantic error, whose location also has union tags and type names.

        Returns:
            its key, the node of that key (None: there is no such key), and the section around it.
        """
        path: KeyPath = ()
        node = section = self.root
        for part in location:
            if variants := self.variants(node):
                node = variants[str(part)]
                continue
            fields = self.fields(node)
            if not fields:
                break
            path, section = (*path, str(part)), node
            if part not in fields:
                return path, None, section
            node = fields[str(part)]
        return path, node, section

    def hint(self, key: str, prefix: str = "") -> str:
        """Return the end of the message about an unknown key, with the key that was probably meant: one with the same
        last part, or with a similar spelling. The variant of a section is its `type`, or its `kind`."""
        section, _, end = key.rpartition(".")
        tags = [f"{section}.type", f"{section}.kind"] if end in ("type", "kind") else []
        same_end = [known for known in self._keys if known in tags]
        same_end = same_end or [known for known in self._keys if known.rpartition(".")[2] == end]
        close = difflib.get_close_matches(key, same_end or self._keys, n=1, cutoff=0.0 if same_end else 0.7)
        return f"; did you mean {prefix}{close[0]}?" if close else "; `pgts train --help` lists all keys"

    @functools.cached_property
    def _keys(self) -> list[str]:
        """All dotted keys, also of sections."""
        parts = [option.key.split(".") for option in self.options()]
        return list(dict.fromkeys(".".join(part[:end]) for part in parts for end in range(1, len(part) + 1)))

    def options(self) -> list[Option]:
        """Return all keys that have a value, in the order of the model."""
        return list(self._options(self.root, ()))

    def _options(self, section: Node, path: KeyPath) -> Iterator[Option]:
        for name, node in self.fields(section).items():
            child = (*path, name)
            key, meaning = ".".join(child), _sentence(node)
            if variants := self.variants(node):
                tag = tag_of(node)
                choices = tuple((value, _sentence(variant)) for value, variant in variants.items())
                yield Option(f"{key}.{tag}", requirement(node), node["default"][tag], meaning, choices)
                yield from self._options_of_variants(f"{key}.{tag}", variants, child)
            elif self.fields(node):
                yield from self._options(node, child)
            else:
                yield Option(key, requirement(node), node["default"], meaning)

    def _options_of_variants(self, tag: str, variants: dict[str, Node], path: KeyPath) -> Iterator[Option]:
        """Yield the options of all variants, without duplicates, grouped by condition."""
        distinct: dict[str, tuple[Option, list[str]]] = {}
        for value, variant in variants.items():
            for option in self._options(variant, path):
                if option.key != tag:
                    distinct.setdefault(repr(option), (option, []))[1].append(value)
        groups: dict[Any, list[Option]] = {}
        for option, values in distinct.values():
            condition = ((tag, tuple(values)),) if len(values) < len(variants) else ()
            option = replace(option, when=condition + option.when)
            groups.setdefault(option.when, []).append(option)
        for group in groups.values():
            yield from group

    def _follow(self, node: Node) -> Node:
        """Return the node with its reference resolved; keys beside the reference have precedence."""
        [inner] = node.get("allOf", [node])
        if "$ref" not in inner:
            return node
        return self._definitions[inner["$ref"].rpartition("/")[2]] | {
            name: value for name, value in node.items() if name not in ("$ref", "allOf")
        }


@functools.cache
def schema_of(model: type[BaseModel]) -> Schema:
    return Schema(model)


def tag_of(node: Node) -> str:
    """Return the key by which a node chooses between variants; empty where it has none."""
    return node["discriminator"]["propertyName"] if "oneOf" in node else ""


def requirement(node: Node) -> str:
    """Return what a value must be, in words, as "a whole number >= 1"."""
    if "requirement" in node:
        return node["requirement"]
    if "anyOf" in node:
        return " or ".join(requirement(each) for each in node["anyOf"])
    if "oneOf" in node:
        return either(list(node["discriminator"]["mapping"]))
    if "const" in node or "enum" in node:
        return either(node.get("enum") or [node["const"]])
    match node.get("type"):
        case None:
            return "a plain value"
        case "integer":
            return f"a whole number{_bounds(node)}"
        case "number":
            return f"a number{_bounds(node)}"
        case "boolean":
            return "true or false"
        case "null":
            return "null"
        case "array":
            assert node["items"]["type"] == "integer", "a list of other things than whole numbers has no words yet"
            return f"a list of at most {node['maxItems']} whole numbers{_bounds(node['items'])}"
        case kind:
            assert kind == "object", f"a configuration key of type {kind} has no words yet"
            keys = ", ".join(node.get("properties", ()))
            return f"a mapping with the keys {keys}" if keys else "a mapping"


def is_text(node: Node) -> bool:
    """Whether all values but null are text."""
    kinds = {each.get("type") for each in node.get("anyOf", [node])}
    return "string" in kinds and kinds <= {"string", "null"}


def is_nullable(node: Node) -> bool:
    return any(each.get("type") == "null" for each in node.get("anyOf", ()))


def _bounds(node: Node) -> str:
    """Return the bounds of a number as an interval or a comparison; empty where there are none."""
    low, above = node.get("minimum"), node.get("exclusiveMinimum")
    high, below = node.get("maximum"), node.get("exclusiveMaximum")
    if below is not None and above is not None:
        return f" in ({above:g}, {below:g})"
    if high is None and low is None and above is None:
        return ""
    if high is None or high == INT64_MAX:
        return f" >= {low:g}" if above is None else f" > {above:g}"
    return f" in {'[' if above is None else '('}{low if above is None else above:g}, {high:g}]"


def either(values: list[str]) -> str:
    *others, last = values
    return f"{', '.join(others)} or {last}" if others else last


def _sentence(node: Node) -> str:
    """Return the meaning of a node, with the values that null stands for."""
    meaning = " ".join(node.get("description", "").split())
    if "null" not in node:
        return meaning
    standing = [
        f"{value if isinstance(value, str) else json.dumps(value)} for {case}" for case, value in node["null"].items()
    ]
    return f"{meaning} null: {', '.join(standing)}; without effect for others."
