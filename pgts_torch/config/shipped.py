"""The configurations that come with the package."""

import os
from functools import cache
from pathlib import Path


@cache
def shipped() -> dict[str, Path]:
    """The files by name, as in `ladder` and `learned/cartpole`: those of the installed package, or of the checkout."""
    package = Path(__file__).parents[1]
    folder = next(path for path in (package / "configs", package.parent / "configs") if path.is_dir())
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in sorted(folder.rglob("*.yaml"))}


def found(path: str | Path) -> Path:
    """The file that is meant by a path or, where there is no such file, by the name of a shipped configuration."""
    return Path(path) if os.path.lexists(path) else shipped().get(str(path), Path(path))


def comment_of(path: Path) -> str:
    """The first sentence of a file's comment."""
    lines = path.read_text(encoding="utf-8").splitlines()
    text = " ".join(line.removeprefix("#").strip() for line in lines if line.startswith("#"))
    return f"{text.partition('. ')[0].rstrip('.')}."
