"""Save and load the state of a training: a model with the same arguments continues from it."""

from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from gymnasium.vector import VectorEnv

from pgts_torch.agent import saving
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.dyna import Dyna
from pgts_torch.agent.parts import Parts
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.posterior_certificate import PosteriorCertificate
from pgts_torch.agent.states import NO_STATE, check_keys, load_checked
from pgts_torch.agent.updates import Update
from pgts_torch.agent.world import ModelWorld
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.ranks import Ranks
from pgts_torch.trust import check_imports

COUNTERS = ("num_iterations", "num_env_steps", "num_model_calls")


class Loadable(Protocol):
    """A model that can load what its `state_dict` returned."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """PgtsError, and nothing is loaded, unless it fits."""


T = TypeVar("T", bound=Loadable)


def state_of(parts: Parts, ranks: Ranks) -> dict[str, Any]:
    """Return the states of the parts of a training: tensors on the CPU and plain values."""
    searches = ranks.gather("searches", lambda: _search_state(parts))
    learned = {name: part.state_dict() for name, part in _learned(parts).items()}
    episodes = ranks.gather("episodes", lambda: {} if parts.episodes is None else parts.episodes.state_dict())
    if parts.dyna is not None and ranks.size > 1:  # each process has kept steps of its own
        learned["dyna"] = {"ranks": dict(enumerate(ranks.gather("what was kept", parts.dyna.state_dict)))}
    return {
        **learned,
        "searches": dict(enumerate(searches)),
        "episodes": dict(enumerate(episodes)),
        "model_check": parts.model_check.state_dict(),
    }


@torch.inference_mode(False)
@torch.enable_grad()
def restore(parts: Parts, ranks: Ranks, state: dict[str, Any]) -> tuple[tuple[int, int, int], str | None]:
    """Load what `state_of` returned; nothing is loaded if it is no state of such a training.

    Returns:
        The counters; and, where it is of another number of processes, each of which has kept something of its own, what
        is missing: the policy acts as the saved one, but training cannot go on. None: nothing is.

    Raises:
        PgtsError: the part of it that does not fit is named.
    """
    learned, check = _learned(parts), parts.model_check
    check_keys("the saved state", state, {*learned, "searches", "episodes", "model_check", *COUNTERS})
    lacks = None
    if parts.dyna is not None:
        own, lacks = _kept(ranks, state["dyna"])
        state = {**state, "dyna": own}
    for name in COUNTERS:
        check_count(name, state[name], least=0)
    before = {name: part.state_dict() for name, part in learned.items()}
    try:
        for name, part in learned.items():
            load_checked(name, state[name], part.load_state_dict, part.state_dict)
        parts.update.check(parts.policy)
        _restore_search(parts, ranks, state["searches"])
        lacks = _restore_episodes(parts, ranks, state["episodes"]) or lacks
        load_checked("model_check", state["model_check"], check.load_state_dict, check.state_dict, is_all=False)
    except PgtsError:
        for name, part in learned.items():
            part.load_state_dict(before[name])
        raise
    return (state["num_iterations"], state["num_env_steps"], state["num_model_calls"]), lacks


def _learned(parts: Parts) -> dict[str, Policy | Critic | Update | Dyna | PosteriorCertificate]:
    """The parts that learn, of which all ranks have the same state."""
    names = ("policy", "critic", "update", "dyna", "posterior")
    return {name: part for name in names if (part := getattr(parts, name)) is not None}


def _kept(ranks: Ranks, state: Any) -> tuple[Any, str | None]:
    """The replay of this rank, with the learned model, which is that of all; and what is missing."""
    saved = state.get("ranks", {0: state}) if isinstance(state, Mapping) else {0: state}
    _check_ranks(saved, "the saved replay is not one of each rank")
    missing = _missing(ranks, len(saved), "the replay", "each of which has kept its own steps")
    return saved[ranks.rank % len(saved)], missing


def _check_ranks(saved: Any, message: str) -> None:
    """PgtsError unless something is saved for each of the ranks 0, 1, ..."""
    if not isinstance(saved, Mapping) or set(saved) != set(range(len(saved))) or not saved:
        raise PgtsError(message)


def _missing(ranks: Ranks, count: int, what: str, why: str) -> str | None:
    """Why training cannot go on from a state of `count` processes; None where it can."""
    if count == ranks.size:
        return None
    return f"the saved state has {what} of {count} processes, {why}; this training has {ranks.size}: take as many"


def _search_state(parts: Parts) -> dict[str, Any]:
    """The state of this rank's search, and its upper bounds."""
    if parts.search is None or parts.certificates is None:
        return {}
    with_states = isinstance(parts.world, ModelWorld) and parts.world.keeps_numbers
    upper = parts.certificates.state_dict(with_states=with_states)
    return {**parts.search.state_dict(with_states=with_states), "upper": upper}


def _restore_search(parts: Parts, ranks: Ranks, searches: Any) -> None:
    """Load the state of this rank's search."""
    _check_ranks(searches, "the saved state of searches is not one of each rank")
    rank, search, certificates = ranks.rank % len(searches), parts.search, parts.certificates
    if search is None or certificates is None:
        return

    def load(state: dict[str, Any]) -> None:
        search.load_state_dict(state)
        certificates.load_state_dict(state["upper"])

    load_checked(f"searches.{rank}", searches[rank], load, lambda: _search_state(parts), has_bounds=True)


def _restore_episodes(parts: Parts, ranks: Ranks, states: Any) -> str | None:
    """Restore the episodes of this rank that go on. Return what is missing."""
    if parts.episodes is None:
        return None
    _check_ranks(states, "the saved episodes are not those of each rank")
    missing = _missing(ranks, len(states), "the episodes", "which go on in the environments of each")
    if missing is None:
        load_checked(
            f"episodes.{ranks.rank}", states[ranks.rank], parts.episodes.load_state_dict, parts.episodes.state_dict
        )
    return missing


def load_training(
    path: str | Path, make: type[T], *, env: Any, device: torch.device | str | None, trust_imports: bool
) -> T:
    """Return the model in a file that holds its arguments and its state, as `PGTS.load`; `make` is its class."""
    content = saving.read(path)
    if content.keys() - {"notes"} != {"arguments", "state"}:
        raise PgtsError(f"{path} holds {sorted(map(str, content))}, not a model")
    arguments = content["arguments"]
    check_keys(f"{path}: arguments", arguments, {"env"}, others=set(signature(make).parameters))
    saved_env = arguments["env"]
    if (env is None) == (saved_env is None):
        raise PgtsError(
            f"{path} names no environment, for it was given as an object: load it with env=..."
            if env is None
            else f"env is {env!r}; {path} has its own, {saved_env}"
        )
    if not trust_imports:
        parts = {name: arguments.get(name) for name in ("model", "policy", "critic")}
        check_imports(path, saved_env, arguments.get("env_kwargs"), **parts)
    arguments |= {"env": saved_env if env is None else env} | ({} if device is None else {"device": str(device)})
    arguments |= {"num_envs": None} if isinstance(env, VectorEnv) else {}
    try:
        model = make(**arguments)
    except NO_STATE as error:
        if isinstance(error, PgtsError):
            raise
        raise PgtsError(f"{path}: its arguments make no model: {type(error).__name__}: {error}") from error
    try:
        model.load_state_dict(content["state"])
    except PgtsError as error:
        raise PgtsError(f"{path}: {error}") from error
    return model
