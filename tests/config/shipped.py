"""The configurations in configs/."""

from pathlib import Path

import pytest

from pgts_torch.config import load

CONFIGS = Path(__file__).parents[2] / "configs"
SHIPPED = {"_".join(path.relative_to(CONFIGS).with_suffix("").parts): path for path in sorted(CONFIGS.rglob("*.yaml"))}
"""By name: that of the file, after that of its folder."""

_PACKAGES = {"minigrid": ("minigrid",), "atari": ("ale_py", "cv2"), "mujoco": ("mujoco",), "lunar": ("Box2D",)}


def skip_unless_installed(name: str) -> None:
    """Skip the test where a package is missing that this configuration needs."""
    words = f"{name} {load(SHIPPED[name]).env.id}".lower()
    for package in (each for word, packages in _PACKAGES.items() if word in words for each in packages):
        pytest.importorskip(package, exc_type=ImportError)
