"""Load a `Config` from a file and command-line overrides, and report all mistakes at once."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pgts_torch import files
from pgts_torch.config import strict_yaml
from pgts_torch.config.config import Config, with_types
from pgts_torch.config.strict_yaml import Document, YamlMistake
from pgts_torch.errors import PgtsError
from pgts_torch.options.mistakes import Mistake, escape, explain, quote, schema_of, show, what
from pgts_torch.options.schema import KeyPath, Node, Schema, is_nullable, is_text

MAX_BYTES = 2**15
"""A larger configuration file is refused."""

MAX_MISTAKES = 50
"""Messages list at most so many mistakes, and the number of the others."""


class ConfigError(PgtsError):
    """The mistakes in a configuration, a line for each."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__("\n".join(self.mistakes))


def load(path: str | Path | None = None, arguments: Sequence[str] = ()) -> Config:
    """Return the configuration: defaults, replaced by a file, replaced by command-line arguments.

    Args:
        path: a YAML file with some of the keys; None: none.
        arguments: overrides as on the command line, `--KEY VALUE` or `--KEY=VALUE`; later ones win. A mapping as the
            value replaces the whole section; a single key changes only itself.

    Raises:
        ConfigError: with every mistake in the file and in the arguments.
    """
    return _Loader().load(path, arguments)


@dataclass(frozen=True)
class _Origin:
    """The place where a value was given, its line if that is a file, and the text of a scalar as it was written."""

    where: str
    line: int = 0
    text: str | None = None


@dataclass(frozen=True)
class _Mistake:
    message: str
    origin: _Origin

    def __str__(self) -> str:
        return f"{self.origin.where}: {self.message}" if self.origin.where else self.message


@dataclass
class _Loader:
    """Collects values with their origins, and mistakes."""

    schema: Schema = field(default_factory=lambda: schema_of(Config))
    data: dict[str, Any] = field(default_factory=dict)
    origins: dict[KeyPath, _Origin] = field(default_factory=dict)
    mistakes: list[_Mistake] = field(default_factory=list)

    def load(self, path: str | Path | None, arguments: Sequence[str]) -> Config:
        file_is_read = path is None or self._read_file(Path(path))
        for key, text in self._flags(arguments):
            self._override(key, text)
        self.data = with_types(self.data)
        self.data = self.schema.with_tags(self.schema.root, self.data)
        config = self._validate(file_is_read)
        if self.mistakes or config is None:
            raise ConfigError(self._lines())
        return config

    def _refuse(self, message: str, where: str, line: int | None = None) -> None:
        self.mistakes.append(_Mistake(message, _Origin(f"{where}:{line}" if line else where, line or 0)))

    def _lines(self) -> list[str]:
        """The mistakes in the order of the file's lines, then those of the command line."""
        in_order = sorted(self.mistakes, key=lambda mistake: (not mistake.origin.line, mistake.origin.line))
        lines = list(dict.fromkeys(map(str, in_order)))
        rest = len(lines) - MAX_MISTAKES
        return lines if rest <= 0 else [*lines[:MAX_MISTAKES], f"and {rest} more"]

    def _read_file(self, path: Path) -> bool:
        """Whether the file could be read as YAML; what is in it goes to `data`."""
        try:
            document = strict_yaml.parse(_read(path))
            self.data = _mapping(document.value)
        except YamlMistake as mistake:
            self._refuse(mistake.reason, str(path), mistake.line)
            return False
        for line, reason in document.mistakes:
            self._refuse(reason, str(path), line)
        for key, line in document.line.items():
            self.origins[key] = _Origin(f"{path}:{line}", line, document.text.get(key))
        return True

    def _flags(self, arguments: Sequence[str]) -> Iterator[tuple[str, str | None]]:
        """(key, value) of each flag; a flag without a value has None."""
        waiting: str | None = None
        for argument in arguments:
            is_flag = argument.startswith("--")
            if waiting is not None:
                yield waiting, None if is_flag else argument
            elif not is_flag:
                self._refuse(f"{quote(argument)} belongs to no option; write --KEY VALUE", "")
            key, equals, text = argument.removeprefix("--").partition("=")
            if is_flag and equals:
                yield key, text
            waiting = key if is_flag and not equals else None
        if waiting is not None:
            yield waiting, None

    def _override(self, key: str, text: str | None) -> None:
        path = tuple(key.split("."))
        nodes = self.schema.find(path)
        if not all(path) or not nodes:
            return self._refuse(f"--{escape(key)} is unknown{self.schema.hint(key, '--')}", "")
        if text is None and nodes[0].get("type") == "boolean":
            text = "true"
        if text is None:
            return self._refuse(f"--{key} needs a value: {what(nodes[0])}", "")
        try:
            document = _argument(text, nodes)
        except YamlMistake as mistake:
            return self._refuse(f"{quote(text)}: {mistake.reason}", f"--{key}")
        for _, reason in document.mistakes:
            self._refuse(reason, f"--{key}")
        self._put(path, document)

    def _put(self, path: KeyPath, document: Document) -> None:
        """Set one key, and where it and what is below it come from."""
        section: Any = self.data
        for part in path[:-1]:
            section = section.setdefault(part, {})
            if not isinstance(section, dict):
                return  # the file has something else than a section here, which is reported by itself
        section[path[-1]] = document.value
        where = f"--{'.'.join(path)}"
        self.origins = {known: origin for known, origin in self.origins.items() if known[: len(path)] != path}
        for key in ((), *document.line):
            self.origins[(*path, *key)] = _Origin(where, text=document.text.get(key))

    def _validate(self, file_is_read: bool) -> Config | None:
        try:
            return Config.model_validate(self.data)
        except ValidationError as error:
            for each in explain(Config, error, lambda key: self._origin(key).text):
                depends_on_file = each.kind in ("conflict", "extra_forbidden")
                if file_is_read or not depends_on_file:
                    self.mistakes.append(self._located(each))
        return None

    def _located(self, mistake: Mistake) -> _Mistake:
        """With the place where it was made."""
        given = [self.origins[key] for key in mistake.keys if key in self.origins]
        origin = given[0] if given else self._origin(mistake.keys[0])
        if mistake.is_value and origin.where == f"--{'.'.join(mistake.keys[0])}":
            return _Mistake(f"--{mistake.message}", _Origin(""))
        return _Mistake(mistake.message, origin)

    def _origin(self, path: KeyPath) -> _Origin:
        """The origin of a key, or of what was given below it, or of the nearest section around it that was given."""
        below = [origin for key, origin in self.origins.items() if key[: len(path)] == path]
        if path and path not in self.origins and below:
            return below[0]
        for end in range(len(path), -1, -1):
            if path[:end] in self.origins:
                return self.origins[path[:end]]
        return _Origin("")


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


def _mapping(value: Any) -> dict[str, Any]:
    if value is None:
        raise YamlMistake("the configuration is empty; it must be a mapping of keys to values", None)
    if not isinstance(value, dict):
        raise YamlMistake(f"the configuration is {show(value)}; it must be a mapping of keys to values", None)
    return value


def _argument(text: str, nodes: Sequence[Node]) -> Document:
    """The value of a flag: text where the key asks for text, else YAML."""
    if all(is_text(node) for node in nodes):
        is_null = text == "null" and all(is_nullable(node) for node in nodes)
        return Document(None if is_null else text, text={(): text})
    return strict_yaml.parse(text) if text else Document(None, text={(): ""})
