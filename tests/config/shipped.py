"""The configurations in configs/."""

from pathlib import Path

SHIPPED = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))
