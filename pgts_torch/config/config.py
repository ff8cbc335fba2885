"""The configuration of a run.

This module and all it imports do not import torch, so that errors and help appear at once.
"""

from collections.abc import Sequence
from typing import Annotated, Any

from pydantic import Field, model_validator

from pgts_torch.config import strict_yaml
from pgts_torch.config.sections import EvalConfig, LogConfig, RunConfig
from pgts_torch.options import CMPO, CNN, MLP, PPO, Mirror, NetworkValues, OwnNetwork, Projected, Softmax, TabularValues
from pgts_torch.options.fields import Count, Device, Name, Natural
from pgts_torch.options.part import Part
from pgts_torch.options.policies import NETWORKS, TABLES, Network
from pgts_torch.options.search import Depth
from pgts_torch.options.training import Training


class General(Part):
    """Options of the whole run."""

    name: Name = "run"
    """The beginning of the name of the run's folder."""

    seed: Natural = 0
    """The seed of all random numbers."""

    total_steps: Count = 50_000
    """Environment steps to train for."""

    device: Device = "cpu"
    """The device of policy, critic and model."""

    threads: Annotated[int, Field(ge=1, le=1024)] = 1
    """The number of threads of torch."""


class Config(Training, General):
    """The configuration of a run."""

    log: LogConfig = LogConfig()
    eval: EvalConfig = EvalConfig()
    run: RunConfig = RunConfig()

    @model_validator(mode="before")
    @classmethod
    def _fill_types(cls, data: Any) -> Any:
        return with_types(data) if isinstance(data, dict) else data

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `PGTS`."""
        env, critic = dict(self.env), self.critic
        if (
            isinstance(critic, NetworkValues)
            and isinstance(critic.network, OwnNetwork)
            and isinstance(self.policy, Network)
        ):
            critic = critic.model_copy(update={"network": self.policy})
        depth = {name: getattr(self.search, name) for name in Depth.model_fields}
        search = {name: value for name, value in dict(self.search).items() if name not in Depth.model_fields}
        parts = {"policy": self.policy, "critic": critic, "update": self.update, "estimator": self.estimator}
        general = {"env": env.pop("id"), "env_kwargs": env.pop("kwargs"), "seed": self.seed, "device": self.device}
        return general | env | dict(self.rollout) | depth | {"search": search} | parts


NULL_ONCE = ("max_width", "samples", "share", "simulations", "merge")
"""Options of a kind of search that version 0.1 wrote as null for the other kinds, and for their default."""

MIRROR_OF_NETWORKS = Mirror.model_fields.keys() - {"type", *Mirror.standing("tables")}
"""Options of the mirror update that only networks have."""


def with_types(data: dict[str, Any]) -> dict[str, Any]:
    """Return the values with a type for policy, critic and update where these have other keys but no type.

    It is the first type that goes with the other values and has all these keys; if none has, the first that goes.
    """
    if isinstance(search := data.get("search"), dict):
        kept = {name: value for name, value in search.items() if value is not None or name not in NULL_ONCE}
        data = data | {"search": {"kind": "auto"} | kept}
    data = _typed(data, "policy", [Softmax, MLP, CNN])
    policy, sampled = _type(data, "policy"), _type(data, "estimator") == "sampled"
    tables, networks = policy not in NETWORKS, policy not in TABLES
    for_tables: list[type[Part]] = [Projected if policy == "simplex" else Mirror]
    for_networks: list[type[Part]] = [PPO] if sampled else [CMPO, PPO]
    critic = data.get("critic") or {}
    if policy in NETWORKS and isinstance(critic, dict):  # also where states are numbered
        data = data | {"critic": {"type": "network"} | critic}
    data = _typed(data, "critic", [TabularValues] * tables + [NetworkValues] * networks)
    return _typed(data, "update", for_tables * tables + for_networks * networks)


def _typed(data: dict[str, Any], name: str, kinds: Sequence[type[Part]]) -> dict[str, Any]:
    section = data.get(name)
    if not isinstance(section, dict) or "type" in section:
        return data
    known = [{str(field.validation_alias or key) for key, field in kind.model_fields.items()} for kind in kinds]
    known = [keys - MIRROR_OF_NETWORKS if kind is Mirror else keys for keys, kind in zip(known, kinds, strict=True)]
    first = next((n for n, keys in enumerate(known) if section.keys() <= keys), 0)
    kind = kinds[first].model_fields["type"].default if section else "auto"
    return data | {name: {"type": kind} | section}


def _type(data: dict[str, Any], name: str) -> Any:
    section = data.get(name)
    return section.get("type") if isinstance(section, dict) else None


def dump(config: Config) -> str:
    """Return all keys of the configuration as YAML, from which `loading.load` reads the same configuration."""
    return strict_yaml.dump(_tag_first(config.model_dump(by_alias=True)))


def _tag_first(section: dict[str, Any]) -> dict[str, Any]:
    ordered = {name: section[name] for name in ("type", "kind") if name in section} | section
    return {name: _tag_first(value) if isinstance(value, dict) else value for name, value in ordered.items()}
