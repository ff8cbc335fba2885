"""Numbers that change in the course of a training, by its environment steps."""

import math
import re
from functools import partial
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, Field

_FORM = re.compile(r"(linear|cosine)\(\s*([^\s,]+)\s*,\s*([^\s,]+)\s*,\s*([^\s,]+)\s*\)")


def value_at(value: float | str, num_env_steps: int) -> float:
    """The number that a schedule has after so many environment steps n; a plain number stays what it is.

    linear(a, b, N):  a + (b - a) x,    cosine(a, b, N):  b + (a - b) (1 + cos(pi x)) / 2,     x = min(n / N, 1)
    """
    if not isinstance(value, str):
        return value
    shape, first, last, steps = _parts(value)
    share = min(num_env_steps / steps, 1.0)
    weight = 1 - share if shape == "linear" else (1 + math.cos(math.pi * share)) / 2
    return last + (first - last) * weight


def at(options: Any, num_env_steps: int) -> Any:
    """Options with the present values of their schedules; the same object where they have none."""
    assert isinstance(options, BaseModel)
    scheduled = {name: value for name, value in options if isinstance(value, str) and _FORM.fullmatch(value)}
    now = {name: value_at(value, num_env_steps) for name, value in scheduled.items()}
    return options.model_copy(update=now) if now else options


def _parts(text: str) -> tuple[str, float, float, float]:
    found = _FORM.fullmatch(text)
    if found is None:
        raise ValueError
    shape, *numbers = found.groups()
    first, last, steps = map(float, numbers)
    return shape, first, last, steps


def _check(value: Any, *, least: float) -> Any:
    """A number of at least `least`, or a schedule over a positive number of steps from or to one, with 0 or more at its
    other end; else ValueError."""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError
    _, first, last, steps = _parts(value) if isinstance(value, str) else ("", float(value), 0.0, 1.0)
    if not (0 <= first < math.inf and 0 <= last < math.inf and least <= max(first, last) and 1 <= steps < math.inf):
        raise ValueError
    return value if isinstance(value, str) else first


def _scheduled(words: str, least: float) -> Any:
    requirement = f"a number {words}, or linear(FROM, TO, STEPS) or cosine(FROM, TO, STEPS) by environment steps"
    return Annotated[
        Any,
        AfterValidator(partial(_check, least=least)),
        Field(json_schema_extra={"requirement": requirement}),
    ]


ScheduledPositive = _scheduled("> 0", math.ulp(0.0))
ScheduledNonNegative = _scheduled(">= 0", 0.0)
"""A number, or a schedule, which may begin or end at 0."""
