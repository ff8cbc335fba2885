"""What is at hand: the shipped configurations, environments by how a lookahead can query them, and extras."""

import importlib.util
import textwrap
from typing import Any

import gymnasium

from pgts_torch.config.shipped import comment_of, shipped

_WIDTH = 79

_EXTRAS = {
    "envs": (("minigrid",), "MiniGrid"),
    "atari": (("ale_py", "cv2"), "Atari"),
    "mujoco": (("mujoco",), "MuJoCo"),
    "box2d": (("Box2D",), "LunarLander, BipedalWalker, CarRacing"),
    "video": (("imageio", "imageio_ffmpeg"), "pgts watch --out FILE.mp4"),
    "onnx": (("onnx", "onnxscript", "onnxruntime"), "pgts export --format onnx"),
    "tune": (("optuna",), "pgts tune"),
}
"""The packages that an extra installs, as they are imported, and what needs them."""


def at_hand() -> dict[str, Any]:
    """Return configurations with a sentence each; environments, by model; extras, what for and whether installed."""
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
        "extras": {
            extra: {"for": meaning, "installed": all(importlib.util.find_spec(package) for package in packages)}
            for extra, (packages, meaning) in _EXTRAS.items()
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
        "others: a simulator, if they can be restored; pgts check-model ID says so. What cannot, in retraced/Env-v0",
        _WIDTH,
        initial_indent="  ",
        subsequent_indent="    ",
    )
    lines += ["", "extras, pip install 'pgts_torch[EXTRA]':"]
    for extra, about in answer["extras"].items():
        lines.append(f"  {extra:<8}{'installed' if about['installed'] else 'missing':<11}{about['for']}")
    return "\n".join(lines)
