"""The folder that a run leaves: its configuration, metrics, TensorBoard events and checkpoints."""

import json
import math
import platform
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from matplotlib.figure import Figure

from pgts_torch.errors import PgtsError

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.jsonl"
SUMMARY_FILE = "summary.json"
FAILURE_FILE = "failure.json"
VERSIONS_FILE = "versions.json"
CHECKPOINTS = "checkpoints"
BEST_FILE = "best.pt"
_PACKAGES = ("pgts_torch", "torch", "numpy", "scipy", "gymnasium", "tensorboard")


class RunFolder:
    """Writes what a run leaves. Use it as a context: leaving it closes the files.

    Args:
        path: the folder; made here, with all parents.
        tensorboard: write events beside metrics.jsonl.
    """

    def __init__(self, path: Path, *, tensorboard: bool) -> None:
        self.path = path
        (path / CHECKPOINTS).mkdir(parents=True)
        self._metrics = (path / METRICS_FILE).open("w", encoding="utf-8", buffering=1)
        self._events = event_writer()(str(path)) if tensorboard else None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._metrics.close()
        if self._events is not None:
            self._events.close()

    def log(self, step: int, tags: dict[str, float]) -> None:
        """One line of metrics.jsonl, and the same numbers as TensorBoard scalars."""
        line = {"step": step} | {tag: value if math.isfinite(value) else None for tag, value in tags.items()}
        self._metrics.write(json.dumps(line) + "\n")
        if self._events is not None:
            for tag, value in tags.items():
                self._events.add_scalar(tag, value, step)

    def text(self, name: str, content: str) -> None:
        """A text file."""
        (self.path / name).write_text(content, encoding="utf-8")

    def picture(self, name: str, figure: Figure, step: int) -> None:
        """`name`.png, and the same picture in TensorBoard."""
        figure.savefig(self.path / f"{name}.png", dpi=120)
        if self._events is not None:
            self._events.add_figure(name, figure, step)


def event_writer() -> "type[SummaryWriter]":
    """What writes TensorBoard events; PgtsError where TensorBoard is missing."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise PgtsError(
            f"TensorBoard cannot be imported ({error}): pip install tensorboard, or set run.tensorboard to false"
        ) from error
    return SummaryWriter


def prepare_folder(path: Path, *, overwrite: bool) -> None:
    """Make sure that `path` can become the folder of a new run.

    Raises:
        PgtsError: it is a file, or holds something and `overwrite` is not set or does not look like a run.
    """
    if path.is_dir() and any(path.iterdir()):
        if not (path / CONFIG_FILE).is_file():
            raise PgtsError(f"run.dir {path} holds files that no run has left; choose another folder")
        if not overwrite:
            raise PgtsError(f"run.dir {path} holds an earlier run; choose another folder, or set run.overwrite")
    elif path.exists() and not path.is_dir():
        raise PgtsError(f"run.dir {path} is a file; it must be a folder or not exist")


def versions() -> dict[str, Any]:
    """Python and the packages that numbers depend on; None: it is not installed."""
    return {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES}


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a run's metrics.jsonl."""
    return [json.loads(line) for line in (path / METRICS_FILE).read_text(encoding="utf-8").splitlines()]
