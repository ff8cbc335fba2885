"""The configuration of a run: all options of its training, and those of the run itself."""

from collections.abc import Sequence
from typing import Any

from pydantic import model_validator

from pgts_torch.config import strict_yaml
from pgts_torch.config.sections import EvalConfig, General, LogConfig, RunConfig
from pgts_torch.options import CMPO, CNN, MLP, PPO, Mirror, NetworkValues, Projected, Softmax, TabularValues
from pgts_torch.options.arguments import described
from pgts_torch.options.part import Part
from pgts_torch.options.policies import NETWORKS, TABLES
from pgts_torch.options.training import Training


class Config(Training, General):
    """The configuration of a run."""

    log: LogConfig = LogConfig()
    eval: EvalConfig = EvalConfig()
    run: RunConfig = RunConfig()

    @model_validator(mode="before")
    @classmethod
    def _infer_types(cls, data: Any) -> Any:
        return _with_types(data) if isinstance(data, dict) else data

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `PGTS`."""
        env = dict(self.env)
        renamed = {"env": env.pop("id"), "env_kwargs": env.pop("kwargs"), "seed": self.seed, "device": self.device}
        return described(self) | env | renamed


NULL_ONCE = ("max_width", "samples", "share", "simulations", "merge")
"""Options of a kind of search that version 0.1 wrote as null for the other kinds, and for their default."""


def _with_types(data: dict[str, Any]) -> dict[str, Any]:
    """Return the values with a type for policy, critic and update where these have other keys but no type.

    It is the first type that goes with the other values and has all these keys; if none has, the first that goes.
    """
    if isinstance(search := data.get("search"), dict):
        kept = {name: value for name, value in search.items() if value is not None or name not in NULL_ONCE}
        data = data | {"search": kept}
    data = _with_type(data, "policy", [Softmax, MLP, CNN])
    policy, sampled = _type(data, "policy"), _type(data, "estimator") == "sampled"
    tables, networks = policy not in NETWORKS, policy not in TABLES
    for_tables: list[type[Part]] = [Projected if policy == "simplex" else Mirror]
    for_networks: list[type[Part]] = [PPO] if sampled else [CMPO, PPO]
    critic = data.get("critic") or {}
    if policy in NETWORKS and isinstance(critic, dict):  # also where states are numbered
        data = data | {"critic": {"type": "network"} | critic}
    data = _with_type(data, "critic", [TabularValues] * tables + [NetworkValues] * networks)
    return _with_type(data, "update", for_tables * tables + for_networks * networks)


def _with_type(data: dict[str, Any], name: str, kinds: Sequence[type[Part]]) -> dict[str, Any]:
    section = data.get(name)
    if not section or not isinstance(section, dict) or "type" in section:
        return data
    kind = next((kind for kind in kinds if section.keys() <= _keys(kind)), kinds[0])
    return data | {name: {"type": kind.model_fields["type"].default} | section}


def _keys(kind: type[Part]) -> set[str]:
    """Return the keys of a part; of the mirror update only those of tables, because cmpo has the others."""
    names = {"type", *Mirror.standing("tables")} if kind is Mirror else kind.model_fields
    return {str(kind.model_fields[name].validation_alias or name) for name in names}


def _type(data: dict[str, Any], name: str) -> Any:
    section = data.get(name)
    return section.get("type") if isinstance(section, dict) else section


def dump(config: Config) -> str:
    """Return all keys of the configuration as YAML, from which `load` reads the same configuration."""
    return strict_yaml.dump(_tag_first(config.model_dump(by_alias=True)))


def _tag_first(section: dict[str, Any]) -> dict[str, Any]:
    ordered = {name: section[name] for name in ("type", "kind") if name in section} | section
    return {name: _tag_first(value) if isinstance(value, dict) else value for name, value in ordered.items()}
