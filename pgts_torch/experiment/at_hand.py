"""What can be trained here: the shipped configurations, and environments by how a lookahead can query them."""

import importlib.util
import textwrap
from typing import Any

import gymnasium

from pgts_torch.config.shipped import comment_of, shipped

_WIDTH = 79

_EXTRAS = {"minigrid": "envs", "ale_py": "atari", "mujoco": "mujoco", "Box2D": "box2d"}
"""Packages of environments, and the extra that installs them."""


def at_hand() -> dict[str, Any]:
    """Return names with a sentence each: configurations; environments of this package, by model; missing extras."""
    own = sorted(name for name in gymnasium.registry if name.startswith(("pgts/", "images/")) and "Vector" not in name)
    return {
        "configurations": {name: comment_of(path) for name, path in shipped().items()},
        "environments": {
            "table": [
                *(name for name in own if name.startswith("pgts/")),
                "FrozenLake-v1",
                "CliffWalking-v1",
                "Taxi-v4",
            ],
            "dynamics in torch": ["CartPole-v1", "Acrobot-v1", "MountainCar-v0", "Pendulum-v1"],
            "learned from images": [name for name in own if name.startswith("images/")],
        },
        "extras that are not installed": {
            extra: package for package, extra in _EXTRAS.items() if importlib.util.find_spec(package) is None
        },
    }


def describe(answer: dict[str, Any]) -> str:
    """Return the answer as lines of at most 79 characters."""
    lines = ["configurations, pgts train --config NAME:"]
    width = max(map(len, answer["configurations"])) + 2
    for name, comment in answer["configurations"].items():
        lines += textwrap.wrap(
            f"{name:<{width}}{comment}", _WIDTH, initial_indent="  ", subsequent_indent=" " * (width + 2)
        )
    lines += ["", "environments, pgts train --env.id ID, and what the lookahead queries:"]
    for model, names in answer["environments"].items():
        lines += textwrap.wrap(f"{model}: {', '.join(names)}", _WIDTH, initial_indent="  ", subsequent_indent="    ")
    lines += textwrap.wrap(
        "others: a simulator, if they can be restored; pgts check-model ID says so", _WIDTH, initial_indent="  "
    )
    missing = answer["extras that are not installed"]
    if missing:
        lines += [
            "",
            *(f"not installed: {package} (pip install 'pgts_torch[{extra}]')" for extra, package in missing.items()),
        ]
    return "\n".join(lines)
