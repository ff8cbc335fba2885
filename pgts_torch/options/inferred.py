"""The types of parts that have other keys but no type."""

from collections.abc import Sequence
from typing import Any

from pgts_torch.options.critics import NetworkValues, TabularValues
from pgts_torch.options.models import Counts, Ensemble, Latent
from pgts_torch.options.own import Own, OwnModel, OwnModule, by_name
from pgts_torch.options.part import Part
from pgts_torch.options.policies import CNN, MLP, NETWORKS, TABLES, Gaussian, Softmax
from pgts_torch.options.replay import UniformReplay
from pgts_torch.options.rollouts import FixedHorizon, GeometricHorizon, StepsHorizon
from pgts_torch.options.updates import CMPO, MPO, PPO, Mirror, Projected


def with_types(data: dict[str, Any]) -> dict[str, Any]:
    """Return the values with a type for parts that have other keys but no type.

    It is the first type that goes with the other values and has all these keys; if none has, the first that goes.
    """
    kinds: dict[str, type[Own]] = {"model": OwnModel, "policy": OwnModule, "critic": OwnModule}
    data = data | {name: by_name(data[name], kind) for name, kind in kinds.items() if name in data}
    if _type(data, "critic") == "module":
        data |= {"critic": {"type": "network", "network": data["critic"]}}
    data = _with_type(_with_type(data, "model", [Ensemble, Counts, Latent, OwnModel]), "replay", [UniformReplay])
    replayed = _type(data, "replay") == "uniform" or _type(data, "model") in ("ensemble", "counts", "latent")
    sampled = _type(data, "estimator") == "sampled"
    horizons: list[type[Part]] = [FixedHorizon, GeometricHorizon, *[StepsHorizon] * sampled]
    if isinstance(rollout := data.get("rollout"), dict):
        data = data | {"rollout": _with_type(rollout, "horizon", [StepsHorizon] * replayed + horizons)}
    data = _with_type(data, "policy", [Softmax, MLP, CNN, OwnModule, Gaussian])
    policy = _type(data, "policy")
    tables, networks = policy not in NETWORKS, policy not in TABLES
    for_tables: list[type[Part]] = [Projected if policy == "simplex" else Mirror]
    for_networks: list[type[Part]] = [PPO] if sampled else [MPO if policy == "gaussian" else CMPO, PPO]
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
