"""What is tuned: options with the values that they may take, as they are written on the command line."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pgts_torch.config import Config, ConfigError, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.sweep import SET_BY_MANY, check_overrides

Value = float | int | str
Values = Mapping[str, Value]

FORMS = "uniform(LOW,HIGH), log(LOW,HIGH), int(LOW,HIGH), logint(LOW,HIGH) or several values, as in 1,2,4"
_MEASURES = ("env.id", "env.kwargs", "total_steps", "eval", "log", "run")
_EVALUATIONS = 10


@dataclass(frozen=True)
class Option:
    """An option and its values.

    kind: uniform, log, int, logint, or choice.
    choices: of kind choice, as they are written on the command line.
    """

    key: str
    spec: str
    kind: str
    low: float = 0.0
    high: float = 0.0
    choices: tuple[str, ...] = ()

    @property
    def is_whole(self) -> bool:
        return self.kind in ("int", "logint")

    @property
    def is_log(self) -> bool:
        return self.kind in ("log", "logint")

    @property
    def ends(self) -> tuple[Value, ...]:
        """The values between which all others lie, or all of them."""
        if self.kind == "choice":
            return self.choices
        return (int(self.low), int(self.high)) if self.is_whole else (self.low, self.high)


def option(text: str) -> Option:
    """Read KEY=VALUES.

    Raises:
        PgtsError: it is not of this form.
    """
    key, equals, spec = text.partition("=")
    key = key.removeprefix("--")
    if not (key and equals):
        raise PgtsError(f"--option {text} is not KEY=VALUES, with {FORMS}")
    if ranged := re.fullmatch(r"(uniform|log|int|logint)\(([^(),]+),([^(),]+)\)", spec.replace(" ", "")):
        kind = ranged[1]
        try:
            low, high = (float(end) for end in ranged.groups()[1:])
        except ValueError:
            low = high = math.nan
        found = Option(key, spec, kind, low, high)
        if not (low < high and math.isfinite(high - low)):
            raise PgtsError(f"--option {text}: the ends must be two ascending numbers")
        if found.is_whole and not (low.is_integer() and high.is_integer()):
            raise PgtsError(f"--option {text}: the ends must be whole numbers")
        if found.is_log and low <= 0:
            raise PgtsError(f"--option {text}: on a logarithmic scale the ends must be above 0")
        return found
    choices = tuple(_split(spec))
    if len(choices) < 2 or len(set(choices)) < len(choices) or "" in choices:
        raise PgtsError(f"--option {text}: VALUES must be {FORMS}, each once")
    return Option(key, spec, "choice", choices=choices)


def _split(text: str) -> Iterator[str]:
    """The parts between commas that are not in brackets or quotes."""
    depth, quote, start = 0, "", 0
    for at, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "([{":
            depth += 1
        elif letter in ")]}":
            depth -= 1
        elif letter == "," and depth == 0:
            yield text[start:at].strip()
            start = at + 1
    yield text[start:].strip()


@dataclass(frozen=True)
class Plan:
    """A tuning.

    path, overrides: of the configuration, as `load` takes them.
    seeds: so many runs make a trial, with the seeds 0, 1, ...
    metric: the tag of metrics.jsonl by which trials are compared, higher is better.
    batch: so many trials are proposed at once, and trained side by side.
    """

    path: str | None
    overrides: tuple[str, ...]
    options: tuple[Option, ...]
    seeds: int
    metric: str
    out: Path
    batch: int = 1

    def arguments(self, values: Values, own: Mapping[str, Any]) -> tuple[str, ...]:
        """The overrides of a run with these values, and keys of its own."""
        chosen = (f"--{key}={value if isinstance(value, str) else repr(value)}" for key, value in values.items())
        return (*self.overrides, *chosen, *(f"--{key}={value}" for key, value in own.items()))

    def config(self, values: Values, own: Mapping[str, Any] | None = None) -> Config:
        """ConfigError where the values are out of the options' ranges, or do not go together."""
        return load(self.path, self.arguments(values, own or {}))

    @property
    def base(self) -> Config:
        """The configuration with the first value of each option."""
        return self.config({option.key: option.ends[0] for option in self.options})


def plan(
    path: str | None,
    overrides: Sequence[str],
    *,
    options: Sequence[str],
    seeds: int,
    metric: str,
    out: Path,
    batch: int,
) -> Plan:
    """A tuning whose values are all in the ranges of their options.

    Raises:
        ConfigError: a configuration is wrong.
        PgtsError: an option cannot be tuned, or is set elsewhere.
    """
    check_overrides(overrides, SET_BY_MANY, "tuning")
    if not options:
        raise PgtsError(f"nothing is tuned: give --option KEY=VALUES, with {FORMS}")
    found = tuple(option(text) for text in options)
    for each in found:
        if sum(each.key == other.key for other in found) > 1:
            raise PgtsError(f"--option {each.key} is given twice")
        if each.key in SET_BY_MANY:
            raise PgtsError(f"--option {each.key} is set by the tuning: {SET_BY_MANY[each.key]}")
        if any(each.key == key or each.key.startswith(f"{key}.") for key in _MEASURES):
            raise PgtsError(f"--option {each.key} would change what is measured, so trials could not be compared")
        if any(given.partition("=")[0] == f"--{each.key}" for given in overrides):
            raise PgtsError(f"--{each.key} is tuned by --option {each.key}={each.spec}; give one of the two")
    made = Plan(path, tuple(overrides), found, seeds, metric, out, batch)
    first = {each.key: each.ends[0] for each in found}
    for each in found:
        for end in each.ends:
            try:
                made.config(first | {each.key: end})
            except ConfigError as error:
                where = f"--option {each.key}={each.spec}: "  # mistakes in a file name it themselves
                in_file = path is not None and all(line.startswith(f"{path}:") for line in error.mistakes)
                raise PgtsError("\n".join(f"{'' if in_file else where}{line}" for line in error.mistakes)) from None
    base = made.base
    if base.eval.every is None:
        every = max(1, base.total_steps // _EVALUATIONS)
        made = replace(made, overrides=(*overrides, f"--eval.every={every}"))
    return made
