"""The command line's parser, the types of its arguments, its help and its output."""

import argparse
import difflib
import itertools
import json
import math
import sys
import textwrap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from pgts_torch import files
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.ownership import is_earlier
from pgts_torch.options.fields import INT64_MAX
from pgts_torch.options.schema import Option

WIDTH = 79


class Parser(argparse.ArgumentParser):
    """An argparse parser that raises PgtsError in one line and takes no abbreviations."""

    def __init__(self, function: Callable[..., Any], **settings: Any) -> None:
        settings = {"prog": f"pgts {command_name(function)}", "description": summary(function)} | settings
        super().__init__(allow_abbrev=False, formatter_class=_Formatter, **settings)

    def print_help(self, file: Any = None) -> None:
        """As argparse, but a broken pipe raises an error."""
        (file or sys.stdout).write(self.format_help())

    def error(self, message: str) -> NoReturn:
        raise PgtsError(f"{message} (see {self.prog} --help)")


def command_name(function: Callable[..., Any]) -> str:
    return function.__name__.rstrip("_").replace("_", "-")


def summary(function: Callable[..., Any]) -> str:
    """Return the first line of its docstring."""
    return (function.__doc__ or "").partition("\n")[0]


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=WIDTH)


def describe_options(options: Sequence[Option]) -> Iterator[str]:
    """Yield the lines of --help about the keys of a configuration, by section."""
    yield "keys, each --KEY VALUE or --KEY=VALUE, with the value in YAML:"
    yield from _wrap(
        "A mapping replaces its whole section, as in --critic '{type: exact}', and so does a word, as in --critic "
        "exact; a single key changes only itself. true may be left out.",
        "  ",
        "  ",
    )
    sections = itertools.groupby(
        options, lambda option: option.key.partition(".")[0] if "." in option.key else "general"
    )
    for section, in_section in sections:
        yield from ("", section)
        for when, group in itertools.groupby(in_section, lambda option: option.when):
            if conditions := [f"{key} {'|'.join(values)}" for key, values in when]:
                yield f"  with {' and '.join(conditions)}:"
            for option in group:
                yield from _describe_option(option, "    " if when else "  ")


def _describe_option(option: Option, indent: str) -> Iterator[str]:
    deeper = indent + "    "
    yield from _wrap(f"--{option.key}  {option.requirement} (default: {_value(option.default)})", indent, deeper)
    yield from _wrap(option.meaning, deeper, deeper)
    for value, meaning in option.choices:
        yield from _wrap(f"{value}: {meaning}", deeper + "  ", deeper + "    ")


def _wrap(text: str, indent: str, further: str) -> list[str]:
    """Break a text into lines, the first of which has an indentation of its own."""
    return textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=further, break_on_hyphens=False)


def _value(value: Any) -> str:
    """Return a default as it is written on the command line."""
    if isinstance(value, str):
        return value
    return f"{value:_}" if type(value) is int else json.dumps(value)


def whole(least: int, word: str | None = None) -> Callable[[str], Any]:
    """An argparse type: a whole number of at least `least`, below 2**63; or the word."""

    def convert(text: str) -> int | str:
        if text == word:
            return text
        if not (text.isascii() and text.isdecimal() and len(text) < 20 and least <= int(text) <= INT64_MAX):
            whole_number = f"a whole number >= {least}"
            is_not = f"not {whole_number} and below 2**63" if word is None else f"neither {whole_number} nor {word}"
            raise argparse.ArgumentTypeError(f"{text!r} is {is_not}")
        return int(text)

    return convert


def listed(convert: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    """An argparse type: values separated by commas; each counts once."""
    return lambda text: tuple(dict.fromkeys(map(convert, text.split(","))))


def choice_of(text: str, known: Collection[str]) -> str:
    """Return the end of a message about an unknown word: the likeliest one, or all."""
    close = difflib.get_close_matches(text, known, n=1)
    return f"did you mean {close[0]}?" if close else f"choose from {', '.join(known)}"


def json_object(text: str) -> dict[str, Any]:
    """An argparse type: a JSON object."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"{text!r} is not a JSON object")
    return value


def unit_interval(text: str) -> float:
    """An argparse type: a number in [0, 1]."""
    return _real(text, lambda value: 0 <= value <= 1, "a number in [0, 1]")


def positive(text: str) -> float:
    """An argparse type: a number above 0."""
    return _real(text, lambda value: 0 < value < math.inf, "a number above 0")


def _real(text: str, is_fine: Callable[[float], bool], what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not is_fine(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value


def env_scale(text: str) -> tuple[str, tuple[float, float]]:
    """An argparse type: ENV=LOW,HIGH."""
    env, _, ends = text.rpartition("=")
    try:
        low, high = map(float, ends.split(","))
    except ValueError:
        low = high = math.nan
    if not (env and math.isfinite(high - low) and low < high):
        raise argparse.ArgumentTypeError(f"{text!r} is not ENV=LOW,HIGH, with two ascending numbers")
    return env, (low, high)


def path_kind(text: str) -> str | None:
    """Return what is at a path (`files.kind`); ArgumentTypeError where it cannot be looked up."""
    try:
        with files.named(f"{text!a}"):
            text.encode()  # bytes that the locale lacks were escaped, and can be looked up, but not written down
        return files.kind(text, follow=True)
    except PgtsError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def output_folder(text: str) -> Path:
    """An argparse type: a folder, which need not exist yet."""
    if path_kind(text) not in (None, "folder"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a folder")
    return Path(text)


def html_file(text: str) -> Path:
    """An argparse type: a path that ends in .html, in an existing folder."""
    if Path(text).suffix != ".html" or path_kind(text) == "folder":
        raise argparse.ArgumentTypeError(f"{text!r} is not a file that ends in .html")
    return file_path(text)


def file_path(text: str) -> Path:
    """An argparse type: the path of a file, which need not exist yet, in an existing folder."""
    path = Path(text)
    if path_kind(text) == "folder":
        raise argparse.ArgumentTypeError(f"{text!r} is a folder; it must be a file")
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r}: {str(path.parent)!r} is not a folder")
    return path


def film_path(text: str) -> Path:
    """An argparse type: a path that ends in .gif, .mp4 or .txt, in an existing folder."""
    if Path(text).suffix.lower() not in (".gif", ".mp4", ".txt"):
        raise argparse.ArgumentTypeError(f"{text!r} does not end in .gif, .mp4 or .txt")
    return file_path(text)


def run_folder(text: str) -> Path:
    """An argparse type: a folder that has the config.yaml of a run."""
    path = Path(text)
    if path_kind(text) != "folder":
        raise argparse.ArgumentTypeError(f"{text!r} is not a folder")
    if not (path / "config.yaml").is_file():
        raise argparse.ArgumentTypeError(f"{text!r} is not the folder of a run: it has no config.yaml")
    if is_earlier(path):
        raise argparse.ArgumentTypeError(
            f"{text!r} is the folder of a run of version 0.1: read it with that, or train again"
        )
    return path


def print_values(answer: Mapping[str, Any], *, as_json: bool) -> None:
    """Print named values, as one JSON object or as a table."""
    if as_json:
        print(json.dumps(answer))
        return
    rows = list(_rows(answer))
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        print(f"{name:<{width}}  {value:.6g}" if isinstance(value, float) else f"{name:<{width}}  {value}")


def _rows(answer: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) for nested values."""
    for name, value in answer.items():
        if isinstance(value, Mapping):
            yield from _rows(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", "none" if value is None else value
