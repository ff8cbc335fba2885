"""The configuration of a run, held to the defaults."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pgts_torch.experiment.config import Config
from pgts_torch.experiment.resume import flat
from pgts_torch.experiment.schema import Schema


@dataclass(frozen=True)
class Setting:
    """A key of the configuration. `default` is what it would be with the types that were chosen; None for kwargs."""

    key: str
    value: Any
    default: Any
    is_default: bool


def settings(config: Config) -> Iterator[Setting]:
    """Every key, in the order of the configuration."""
    values = flat(config)
    defaults = {option.key: option.default for option in Schema(Config).options() if _applies(option.when, values)}
    for key, value in values.items():
        yield Setting(key, value, defaults.get(key), key in defaults and value == defaults[key])


def _applies(when: str, values: Mapping[str, Any]) -> bool:
    """Whether a condition of `Option.when` holds."""
    conditions = (condition.split(" ") for condition in when.split(" and ") if condition)
    return all(values.get(key) in choices.split("|") for key, choices in conditions)
