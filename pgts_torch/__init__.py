"""Policy gradient with tree search: policies trained toward what an m-step lookahead sees.

A tensor's name ends in its axes: S states, A actions, K outcomes of one (s, a), C children (the values that a backup
reads), B batch or roots, N nodes, T time, D features.

Importing this package registers the `pgts/` environments with Gymnasium and does not import torch; the names below
are loaded when they are first used.
"""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from pgts_torch.agent.callbacks import EvalCallback
    from pgts_torch.agent.evaluate import evaluate
    from pgts_torch.agent.pgts import PGTS

    __version__: str

_SUBPACKAGES = ("agent", "envs", "models", "search", "tabular")

_NAMES = {"PGTS": "agent.pgts", "EvalCallback": "agent.callbacks", "evaluate": "agent.evaluate"}
"""What is offered here, and the module that it is loaded from."""

__all__ = ["PGTS", "EvalCallback", "__version__", "agent", "envs", "evaluate", "models", "search", "tabular"]


def __getattr__(name: str) -> Any:
    if name in _NAMES:
        return getattr(importlib.import_module(f"pgts_torch.{_NAMES[name]}"), name)
    if name == "__version__":
        return importlib.metadata.version("pgts_torch")
    if name in _SUBPACKAGES:
        return importlib.import_module(f"pgts_torch.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)


def _register_environments() -> None:
    """Every environment of the zoo in two forms, one and many, and those seen as images. DeepSea and those end by
    themselves and have no time limit."""
    for name, entry_point, max_episode_steps in [
        ("Ladder", "ladder", 100),
        ("Tightrope", "tightrope", 100),
        ("Random", "random_mdp", 100),
        ("Grid", "grid", 200),
        ("DeepSea", "deep_sea", None),
        ("CombinationLock", "combination_lock", 100),
        ("RiverSwim", "river_swim", 200),
        ("Corridor", "corridor", 200),
    ]:
        # Registering an id twice makes Gymnasium warn, and a reload of this module is no mistake of the user.
        if f"pgts/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                f"pgts/{name}-v0",
                entry_point=f"pgts_torch.envs.entry_points:{entry_point}",
                vector_entry_point=f"pgts_torch.envs.entry_points:{entry_point}_vector",
                max_episode_steps=max_episode_steps,
            )
    for id, entry_point in [
        ("images/Catch-v0", "images:Catch"),
        ("images/Minigrid-v0", "images:minigrid"),
        ("images/Atari-v0", "images:atari"),
        ("retraced/Env-v0", "retraced:retraced"),
    ]:
        if id not in gymnasium.registry:
            gymnasium.register(id, entry_point=f"pgts_torch.envs.{entry_point}")


_register_environments()
