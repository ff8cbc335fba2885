"""Save and load the state of a training: a model with the same arguments continues from it."""

from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch

from pgts_torch.agent import saving
from pgts_torch.agent.certificate import Certificates
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.model_check import ModelCheck
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.ranks import Ranks
from pgts_torch.agent.states import NO_STATE, check_keys, take_over
from pgts_torch.agent.updates import Update
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.search.engine import Search
from pgts_torch.trust import check_imports

COUNTERS = ("num_iterations", "num_env_steps", "num_model_calls")


class Training(Protocol):
    """The parts of a training that have a state, and its counters."""

    policy: Policy
    critic: Critic
    update: Update
    world: World
    search: Search | None
    certificates: Certificates | None
    model_check: ModelCheck
    ranks: Ranks
    num_iterations: int
    num_env_steps: int
    num_model_calls: int


T = TypeVar("T", bound=Training)


def state_of(training: Training) -> dict[str, Any]:
    """Return the states of policy, critic, update and of each rank's search, and the counters: tensors on the CPU and
    plain values. If several processes train together all must call it."""
    searches = training.ranks.gather("searches", lambda: _search_state(training))
    return {
        "searches": dict(enumerate(searches)),
        "policy": training.policy.state_dict(),
        "critic": training.critic.state_dict(),
        "update": training.update.state_dict(),
        **{name: getattr(training, name) for name in COUNTERS},
        "model_check": training.model_check.state_dict(),
    }


@torch.inference_mode(False)
@torch.enable_grad()
def restore(training: Training, state: dict[str, Any]) -> None:
    """Load what `state_of` returned; nothing is loaded if it is no state of such a training.

    Raises:
        PgtsError: the part of it that does not fit is named.
    """
    parts: dict[str, Policy | Critic | Update] = {
        "policy": training.policy,
        "critic": training.critic,
        "update": training.update,
    }
    check_keys("the saved state", state, {"searches", "model_check", *parts, *COUNTERS})
    for name in COUNTERS:
        check_count(name, state[name], least=0)
    before = {name: part.state_dict() for name, part in parts.items()}
    try:
        for name, part in parts.items():
            take_over(name, state[name], part.load_state_dict, part.state_dict)
        training.update.check(training.policy)
        _restore_search(training, state["searches"])
        check = training.model_check
        take_over("model_check", state["model_check"], check.load_state_dict, check.state_dict, is_all=False)
    except PgtsError:
        for name, part in parts.items():
            part.load_state_dict(before[name])
        raise
    for name in COUNTERS:
        setattr(training, name, state[name])


def _search_state(training: Training) -> dict[str, Any]:
    """The state of this rank's search, and its upper bounds."""
    if training.search is None or training.certificates is None:
        return {}
    with_states = isinstance(training.world, ModelWorld) and training.world.keeps_numbers
    upper = training.certificates.state_dict(with_states=with_states)
    return {**training.search.state_dict(with_states=with_states), "upper": upper}


def _restore_search(training: Training, searches: Any) -> None:
    """Load the state of this rank's search."""
    if not isinstance(searches, Mapping) or set(searches) != set(range(len(searches))) or not searches:
        raise PgtsError("the saved state of searches is not one of each rank")
    rank, search, certificates = training.ranks.rank % len(searches), training.search, training.certificates
    if search is None or certificates is None:
        return

    def load(state: dict[str, Any]) -> None:
        search.load_state_dict(state)
        certificates.load_state_dict(state["upper"])

    take_over(f"searches.{rank}", searches[rank], load, lambda: _search_state(training), has_bounds=True)


def load_training(
    path: str | Path, make: type[T], *, env: Any, device: torch.device | str | None, trust_imports: bool
) -> T:
    """The training in a file that holds its arguments and its state.

    Args:
        make: its class.
        env: the environment, where it was given to the saved training as an object; else None.
        device: where to load it; None: the device it was saved from.
        trust_imports: whether the module that the id of its environment may name is imported.

    Raises:
        PgtsError: as `PGTS.load`.
    """
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
        check_imports(path, saved_env, arguments.get("env_kwargs"))
    arguments |= {"env": saved_env if env is None else env} | ({} if device is None else {"device": str(device)})
    try:
        training = make(**arguments)
    except NO_STATE as error:
        if isinstance(error, PgtsError):
            raise
        raise PgtsError(f"{path}: its arguments make no model: {type(error).__name__}: {error}") from error
    try:
        restore(training, content["state"])
    except PgtsError as error:
        raise PgtsError(f"{path}: {error}") from error
    return training
