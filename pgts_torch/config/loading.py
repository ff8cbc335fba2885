"""Load a `Config` from a file and command-line overrides, and report all mistakes at once."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pgts_torch import files
from pgts_torch.config import strict_yaml
from pgts_torch.config.config import Config
from pgts_torch.config.shipped import found
from pgts_torch.config.strict_yaml import Document, Place, YamlMistake
from pgts_torch.errors import PgtsError
from pgts_torch.options.mistakes import escape, explain, quote, show, what
from pgts_torch.options.schema import KeyPath, Node, is_nullable, is_text, schema_of, tag_of

MAX_BYTES = 2**15
"""A larger configuration file is refused."""

MAX_MISTAKES = 50
"""Messages list at most so many mistakes, and the number of the others."""


class ConfigError(PgtsError):
    """The mistakes in a configuration, a line for each."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__("\n".join(self.mistakes))

    def __reduce__(self) -> tuple[type["ConfigError"], tuple[Sequence[str]]]:
        """Arrives whole where another process raised it."""
        return ConfigError, (self.mistakes,)


def load(path: str | Path | None = None, arguments: Sequence[str] = ()) -> Config:
    """Return the configuration: defaults, replaced by a file, replaced by command-line arguments.

    Args:
        path: a YAML file with some of the keys, or the name of a shipped one; None: none.
        arguments: overrides as on the command line, `--KEY VALUE` or `--KEY=VALUE`; later ones win. A mapping as the
            value replaces the whole section; a single key changes only itself.

    Raises:
        ConfigError: with every mistake in the file and in the arguments.
    """
    given = _Given()
    is_read = path is None or given.read_file(found(path))
    given.read_arguments(arguments)
    config = given.validated(is_whole=is_read)
    if given.mistakes or config is None:
        raise ConfigError(given.lines())
    return config


@dataclass(frozen=True)
class _Source:
    """Where a value was given.

    Args:
        name: of the file with the line, or of the flag.
        line: in the file; 0 for a flag.
        text: a scalar as it was written.
    """

    name: str
    line: int = 0
    text: str | None = None


@dataclass
class _Given:
    """The values that were given so far, where each of them was, and the mistakes that were found.

    Args:
        mistakes: (line in the file, or 0; message).
    """

    data: dict[str, Any] = field(default_factory=dict)
    sources: dict[KeyPath, _Source] = field(default_factory=dict)
    mistakes: list[tuple[int, str]] = field(default_factory=list)

    def read_file(self, path: Path) -> bool:
        """Add the values in a file. Whether it could be read as YAML."""
        try:
            document = strict_yaml.parse(_read(path))
            if not isinstance(document.value, dict):
                given = "empty" if document.value is None else show(document.value)
                raise YamlMistake(f"the configuration is {given}; it must be a mapping of keys to values", None)
        except YamlMistake as mistake:
            where = f"{path}:{mistake.line}" if mistake.line else path
            self.mistakes.append((mistake.line or 0, f"{where}: {mistake.reason}"))
            return False
        self.data = document.value
        self.mistakes += [(line, f"{path}:{line}: {reason}") for line, reason in document.mistakes]
        self.sources = {key: _Source(f"{path}:{at.line}", at.line, at.text) for key, at in document.places.items()}
        return True

    def read_arguments(self, arguments: Sequence[str]) -> None:
        """Add the values of flags, `--KEY VALUE` or `--KEY=VALUE`."""
        left = list(arguments)
        while left:
            flag = left.pop(0)
            key, equals, text = flag.removeprefix("--").partition("=")
            if not flag.startswith("--"):
                self._report(f"{quote(flag)} belongs to no option; write --KEY VALUE")
            elif equals:
                self._read_flag(key, text)
            else:
                self._read_flag(key, left.pop(0) if left and not left[0].startswith("--") else None)

    def _read_flag(self, key: str, text: str | None) -> None:
        schema, path = schema_of(Config), tuple(key.split("."))
        nodes = schema.find(path)
        if not all(path) or not nodes:
            return self._report(f"--{escape(key)} is unknown{schema.hint(key, '--')}")
        if text is None and nodes[0].get("type") == "boolean":
            text = "true"
        if text is None:
            return self._report(f"--{key} needs a value: {what(nodes[0])}")
        try:
            document = _value(text, nodes)
        except YamlMistake as mistake:
            return self._report(f"--{key}: {quote(text)}: {mistake.reason}")
        for _, reason in document.mistakes:
            self._report(f"--{key}: {reason}")
        self._set(path, document)

    def _set(self, path: KeyPath, document: Document) -> None:
        """Replace the value of one key, and where it and what is below it come from."""
        section: Any = self.data
        for end, part in enumerate(path[:-1], start=1):
            value = section.get(part, {})
            tags = [tag for node in schema_of(Config).find(path[:end]) if (tag := tag_of(node))]
            if isinstance(value, str) and tags:
                value = {tags[0]: value}  # the word stands for a mapping with this type
            if not isinstance(value, dict):
                return  # the file has something else than a section here, which is reported by itself
            section[part] = section = value
        section[path[-1]] = document.value
        self.sources = {key: source for key, source in self.sources.items() if key[: len(path)] != path}
        flag = f"--{'.'.join(path)}"
        places = {(): None} | {key: at.text for key, at in document.places.items()}
        self.sources |= {(*path, *key): _Source(flag, text=text) for key, text in places.items()}

    def validated(self, *, is_whole: bool) -> Config | None:
        """Return the configuration; None after mistakes.

        Args:
            is_whole: whether all that the user gave is known; if not, only values are refused that are wrong by
                themselves.
        """
        try:
            return Config.model_validate(self.data)
        except ValidationError as error:
            for mistake in explain(Config, error, lambda key: self._source(key).text):
                if not is_whole and not mistake.is_value:
                    continue
                exact = [self.sources[key] for key in mistake.keys if key in self.sources]
                source = exact[0] if exact else self._source(mistake.keys[0])
                flag = f"--{'.'.join(mistake.keys[0])}"
                if mistake.is_value and source.name == flag:
                    self._report(f"--{mistake.message}")
                else:
                    self._report(f"{source.name}: {mistake.message}" if source.name else mistake.message, source.line)
        return None

    def _source(self, path: KeyPath) -> _Source:
        """Return where a key was given, or what is below it, or the nearest section around it."""
        below = [source for key, source in self.sources.items() if key[: len(path)] == path]
        if path and path not in self.sources and below:
            return below[0]
        around = (self.sources.get(path[:end]) for end in range(len(path), -1, -1))
        return next(filter(None, around), _Source(""))

    def _report(self, message: str, line: int = 0) -> None:
        self.mistakes.append((line, message))

    def lines(self) -> list[str]:
        """Return the mistakes in the order of the file's lines, then those of the command line."""
        in_order = sorted(self.mistakes, key=lambda mistake: (not mistake[0], mistake[0]))
        lines = list(dict.fromkeys(message for _, message in in_order))
        rest = len(lines) - MAX_MISTAKES
        return lines if rest <= 0 else [*lines[:MAX_MISTAKES], f"and {rest} more"]


def _read(path: Path) -> str:
    try:
        content = files.read(path, most=MAX_BYTES + 1, name="the configuration")
    except PgtsError as error:
        raise YamlMistake(str(error), None) from None
    if len(content) > MAX_BYTES:
        raise YamlMistake(f"the configuration is larger than {MAX_BYTES} bytes", None)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise YamlMistake(f"the configuration is not UTF-8 (at byte {error.start})", None) from None


def _value(text: str, nodes: Sequence[Node]) -> Document:
    """Return the value of a flag: text where the key asks for text, else YAML."""
    if not all(is_text(node) for node in nodes):
        return strict_yaml.parse(text) if text else Document(None, {(): Place(1, "")})
    is_null = text == "null" and all(is_nullable(node) for node in nodes)
    return Document(None if is_null else text, {(): Place(1, text)})
