"""Read a subset of YAML 1.2 as plain data, with the line of each value.

Anchors, aliases, tags, directives, several documents, duplicate keys and deep nesting are refused: a configuration
needs none of them, and each can be misread or make parsing take for ever.
"""

import io
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    Event,
    NodeEvent,
    ScalarEvent,
)
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

MAX_DEPTH = 32
"""The largest depth to which mappings and sequences may nest."""

_TOO_DEEP = f"values are nested more than {MAX_DEPTH} deep"
_DEEP = re.compile(rf"(?:[\[{{][ \t\r\n]*){{{MAX_DEPTH + 1}}}")
"""So many brackets in a row would cost the parser seconds, so they are refused before."""

KeyPath = tuple[str, ...]


class YamlMistake(Exception):
    """The text cannot be read: the reason, and the line (counted from 1; None where it is unknown)."""

    def __init__(self, reason: str, line: int | None) -> None:
        super().__init__(reason)
        self.reason, self.line = reason, line


class Place(NamedTuple):
    """The line of a key, counted from 1, and the text of its value as it was written; None: it is no scalar."""

    line: int
    text: str | None


@dataclass(frozen=True)
class Document:
    """One YAML document.

    Args:
        value: None, bool, int, float, str, and lists and dicts of them; the keys of dicts are text.
        places: of each key by its path, those within sequences left out; () is a document that is one scalar.
        mistakes: (line, reason) of each mistake after which the rest could still be read.
    """

    value: Any
    places: Mapping[KeyPath, Place] = field(default_factory=dict)
    mistakes: tuple[tuple[int, str], ...] = ()


def parse(text: str) -> Document:
    """Return the single document in `text`; the value of an empty text is None.

    Raises:
        YamlMistake: the text is not YAML, or uses features of YAML that are refused.
    """
    yaml = YAML(typ="safe", pure=True)
    try:
        _refuse(text, yaml.parse(text))
        reader = _Reader(yaml)
        node = yaml.compose(text)
        value = None if node is None else reader.value(node, ())
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        raise YamlMistake(
            f"this is not YAML: {_one_line(error.problem or error.context)}", mark and mark.line + 1
        ) from None
    except (YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise YamlMistake(f"this is not YAML: {_one_line(str(error))}", None) from None
    return Document(value, reader.places, tuple(reader.mistakes))


def dump(value: Any) -> str:
    """Return `value` as YAML in ASCII that `parse` reads back unchanged."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.allow_unicode = False
    yaml.representer.sort_base_mapping_type_on_output = False
    yaml.width = 2**16
    stream = io.StringIO()
    yaml.dump(value, stream)
    return stream.getvalue()


def _refuse(text: str, events: Iterable[Event]) -> None:
    """YamlMistake at the first feature of YAML that is refused.

    The parser makes its events without recursion and expands no aliases, so that neither deep nesting nor a bomb of
    aliases gets further.
    """
    for number, line in enumerate(text.splitlines(), start=1):
        if line.startswith("%"):
            raise YamlMistake("directives (%) are not allowed; the text is read as YAML 1.2", number)
    if nested := _DEEP.search(text):
        raise YamlMistake(_TOO_DEEP, 1 + text.count("\n", 0, nested.end()))
    documents = depth = 0
    for event in events:
        line = event.start_mark.line + 1
        documents += isinstance(event, DocumentStartEvent)
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        if documents > 1:
            raise YamlMistake("a second document starts here; only one is allowed", line)
        if depth > MAX_DEPTH:
            raise YamlMistake(_TOO_DEEP, line)
        if isinstance(event, AliasEvent) or (isinstance(event, NodeEvent) and event.anchor is not None):
            raise YamlMistake("anchors (&) and aliases (*) are not allowed; write the value out", line)
        if isinstance(event, ScalarEvent | CollectionStartEvent) and event.tag is not None:
            raise YamlMistake(f"tags are not allowed, here {_one_line(event.tag)}; write plain values", line)
        if isinstance(event, ScalarEvent) and any("\ud800" <= character <= "\udfff" for character in event.value):
            raise YamlMistake("text holds half of a surrogate pair, which is no character", line)


class _Reader:
    """Makes plain values of nodes, and remembers their places."""

    def __init__(self, yaml: YAML) -> None:
        self._constructor = yaml.constructor
        self.places: dict[KeyPath, Place] = {}
        self.mistakes: list[tuple[int, str]] = []

    def value(self, node: Node, path: KeyPath | None) -> Any:
        """Return the value of a node. `path` is None within sequences."""
        if isinstance(node, SequenceNode):
            return [self.value(item, None) for item in node.value]
        if isinstance(node, MappingNode):
            return self._mapping(node, path)
        assert isinstance(node, ScalarNode)
        if path == ():
            self.places[path] = Place(_line(node), node.value)
        return self._scalar(node)

    def _mapping(self, node: MappingNode, path: KeyPath | None) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for key_node, child in node.value:
            key, line = key_node.value, _line(key_node)
            if not isinstance(key_node, ScalarNode):
                raise YamlMistake("a key must be a word, not a mapping or a sequence", line)
            if key in mapping:
                self.mistakes.append((line, f"the key {'.'.join((*(path or ()), key))} is given twice"))
                continue
            below = None if path is None else (*path, key)
            if below is not None:
                self.places[below] = Place(line, child.value if isinstance(child, ScalarNode) else None)
            mapping[key] = self.value(child, below)
        return mapping

    def _scalar(self, node: ScalarNode) -> Any:
        """Return None, bool, int or float by the rules of YAML 1.2, else the text; dates stay text."""
        try:
            match str(node.tag).rpartition(":")[2]:
                case "null":
                    return None
                case "bool":
                    return node.value.lower() == "true"
                case "int":
                    return self._constructor.construct_yaml_int(node)
                case "float":
                    return self._constructor.construct_yaml_float(node)
        except ValueError:
            raise YamlMistake(f"a number cannot be read: {_one_line(node.value)}", _line(node)) from None
        return node.value


def _line(node: Node) -> int:
    return node.start_mark.line + 1


def _one_line(text: str, length: int = 60) -> str:
    words = " ".join(text.split())
    return words if len(words) <= length else f"{words[: length - 3]}..."
