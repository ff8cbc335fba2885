"""Read a subset of YAML 1.2 as plain data, with the line of each value.

Anchors, aliases, tags, directives, several documents, duplicate keys and deep nesting are refused: a configuration
needs none of them, and each can be misread or make parsing take for ever.
"""

import io
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentEndEvent,
    DocumentStartEvent,
    Event,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
    SequenceStartEvent,
)
from ruamel.yaml.nodes import ScalarNode

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


@dataclass(frozen=True)
class Document:
    """One YAML document.

    Args:
        value: None, bool, int, float, str, and lists and dicts of them; the keys of dicts are text.
        line: the line of each key, by its path; keys inside sequences are left out.
        text: the text of each scalar as it was written, by its path.
        mistakes: (line, reason) of each mistake after which the rest could still be read.
    """

    value: Any
    line: Mapping[KeyPath, int] = field(default_factory=dict)
    text: Mapping[KeyPath, str] = field(default_factory=dict)
    mistakes: tuple[tuple[int, str], ...] = ()


def parse(text: str) -> Document:
    """Return the single document in `text`; the value of an empty text is None.

    Raises:
        YamlMistake: the text is not YAML, or uses features of YAML that are refused.
    """
    return _Reader().document(text)


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


class _Reader:
    """Builds a document from the parser's events, which expand no aliases and are made without recursion."""

    def __init__(self) -> None:
        self._yaml = YAML(typ="safe", pure=True)
        self._line: dict[KeyPath, int] = {}
        self._text: dict[KeyPath, str] = {}
        self._mistakes: list[tuple[int, str]] = []

    def document(self, text: str) -> Document:
        try:
            value = self._documents(self._events(text))
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            raise YamlMistake(
                f"this is not YAML: {_one_line(error.problem or error.context)}", mark and mark.line + 1
            ) from None
        except (YAMLError, ValueError, OverflowError, RecursionError) as error:
            raise YamlMistake(f"this is not YAML: {_one_line(str(error))}", None) from None
        return Document(value, self._line, self._text, tuple(self._mistakes))

    def _events(self, text: str) -> Iterator[Event]:
        """Yield the parser's events; YamlMistake at the first feature of YAML that is refused."""
        for number, line in enumerate(text.splitlines(), start=1):
            if line.startswith("%"):
                raise YamlMistake("directives (%) are not allowed; the text is read as YAML 1.2", number)
        if nested := _DEEP.search(text):
            raise YamlMistake(_TOO_DEEP, 1 + text.count("\n", 0, nested.end()))
        for event in self._yaml.parse(text):
            if isinstance(event, AliasEvent) or (isinstance(event, NodeEvent) and event.anchor is not None):
                raise YamlMistake("anchors (&) and aliases (*) are not allowed; write the value out", _line_of(event))
            if isinstance(event, ScalarEvent | CollectionStartEvent) and event.tag is not None:
                raise YamlMistake(
                    f"tags are not allowed, here {_one_line(event.tag)}; write plain values", _line_of(event)
                )
            if isinstance(event, ScalarEvent) and not _is_unicode(event.value):
                raise YamlMistake("text holds half of a surrogate pair, which is no character", _line_of(event))
            yield event

    def _documents(self, events: Iterator[Event]) -> Any:
        value, count = None, 0
        for event in events:
            if isinstance(event, DocumentStartEvent):
                count += 1
                if count > 1:
                    raise YamlMistake("a second document starts here; only one is allowed", _line_of(event))
            elif isinstance(event, NodeEvent):
                value = self._value(event, events, (), 0)
            else:
                assert not isinstance(event, CollectionEndEvent | DocumentEndEvent) or count == 1
        return value

    def _value(self, event: Event, events: Iterator[Event], path: KeyPath | None, depth: int) -> Any:
        """Return the value that starts with `event`. `path` is None inside sequences."""
        if isinstance(event, ScalarEvent):
            if path is not None:
                self._text[path] = event.value
            return self._scalar(event)
        if depth == MAX_DEPTH:
            raise YamlMistake(_TOO_DEEP, _line_of(event))
        if isinstance(event, SequenceStartEvent):
            return [self._value(item, events, None, depth + 1) for item in _until_end(events)]
        assert isinstance(event, MappingStartEvent)
        return self._mapping(events, path, depth)

    def _mapping(self, events: Iterator[Event], path: KeyPath | None, depth: int) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for key_event in _until_end(events):
            if not isinstance(key_event, ScalarEvent):
                raise YamlMistake("a key must be a word, not a mapping or a sequence", _line_of(key_event))
            key, line = key_event.value, _line_of(key_event)
            if key in mapping:
                self._mistakes.append((line, f"the key {'.'.join((*(path or ()), key))} is given twice"))
                self._value(next(events), events, None, depth + 1)
                continue
            child = None if path is None else (*path, key)
            if child is not None:
                self._line[child] = line
            mapping[key] = self._value(next(events), events, child, depth + 1)
        return mapping

    def _scalar(self, event: ScalarEvent) -> Any:
        """Return None, bool, int or float by the rules of YAML 1.2, else the text; dates stay text."""
        tag = str(self._yaml.resolver.resolve(ScalarNode, event.value, event.implicit)).rpartition(":")[2]
        node = ScalarNode(tag, event.value)
        try:
            match tag:
                case "null":
                    return None
                case "bool":
                    return event.value.lower() == "true"
                case "int":
                    return self._yaml.constructor.construct_yaml_int(node)
                case "float":
                    return self._yaml.constructor.construct_yaml_float(node)
        except ValueError:
            raise YamlMistake(f"a number cannot be read: {_one_line(event.value)}", _line_of(event)) from None
        return event.value


def _until_end(events: Iterator[Event]) -> Iterator[Event]:
    """Yield the events up to the end of the current collection."""
    for event in events:
        if isinstance(event, CollectionEndEvent):
            return
        yield event


def _is_unicode(text: str) -> bool:
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _line_of(event: Event) -> int:
    return event.start_mark.line + 1


def _one_line(text: str, length: int = 60) -> str:
    words = " ".join(text.split())
    return words if len(words) <= length else f"{words[: length - 3]}..."
