"""The configurations in configs/."""

from pathlib import Path

CONFIGS = Path(__file__).parents[2] / "configs"
SHIPPED = {"_".join(path.relative_to(CONFIGS).with_suffix("").parts): path for path in sorted(CONFIGS.rglob("*.yaml"))}
"""By name: that of the file, after that of its folder."""
