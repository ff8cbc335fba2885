"""The command line's parser, arguments that several commands have, help and output."""

import argparse
import functools
import itertools
import json
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NoReturn

from pgts_torch.cli.types import json_object, run_folder, whole
from pgts_torch.errors import PgtsError
from pgts_torch.options.schema import Option

Arguments = Sequence[str]
WIDTH = 79

FAILED = 1
"""The exit code where a command has done its work and the answer is no."""


class Parser(argparse.ArgumentParser):
    """An argparse parser that raises PgtsError in one line and takes no abbreviations."""

    def __init__(self, function: Callable[..., Any], **settings: Any) -> None:
        settings = {"prog": f"pgts {command_name(function)}", "description": summary(function)} | settings
        formatter: Any = functools.partial(argparse.RawDescriptionHelpFormatter, width=WIDTH)
        super().__init__(allow_abbrev=False, formatter_class=formatter, **settings)

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
    yield from _wrap(f"--{option.key}  {option.requirement} (default: {value_text(option.default)})", indent, deeper)
    yield from _wrap(option.meaning, deeper, deeper)
    for value, meaning in option.choices:
        yield from _wrap(f"{value}: {meaning}", deeper + "  ", deeper + "    ")


def _wrap(text: str, indent: str, further: str) -> list[str]:
    """Break a text into lines, the first of which has an indentation of its own."""
    return textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=further, break_on_hyphens=False)


def value_text(value: Any) -> str:
    """Return a default as it is written on the command line."""
    if isinstance(value, str):
        return value
    return f"{value:_}" if type(value) is int else json.dumps(value)


def add_run(parser: Parser) -> None:
    """The folder of a run, and which of its checkpoints."""
    parser.add_argument("run_dir", metavar="RUN_DIR", type=run_folder, help="the folder of a run")
    parser.add_argument(
        "--checkpoint",
        metavar="WHICH",
        type=whole(0, "last", "best"),
        default="last",
        help="last (default); best, the best model by the evaluations of a run with eval.keep_best; or the number of "
        "environment steps after which one was kept",
    )
    add_trust(parser)


def add_trust(parser: Parser, when: str = "") -> None:
    parser.add_argument(
        "--trust-imports",
        action="store_true",
        help=f"{when}import the modules that the saved environment and model name, as MODULE:ID (see SECURITY.md)",
    )


def add_kwargs(parser: Parser) -> None:
    parser.add_argument(
        "--kwargs", metavar="JSON", type=json_object, default={}, help='for gymnasium.make, as {"is_slippery": false}'
    )


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
