"""Write the files of a run while it trains: metrics, TensorBoard events, texts and pictures."""

import hashlib
import io
import json
import math
import os
import platform
from collections.abc import Mapping
from contextlib import AbstractContextManager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, final

import numpy as np

from pgts_torch import files
from pgts_torch.agent.board import Events, event_files
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.ownership import BEST_FILE, FAILURE_FILE, METRICS_FILE, is_events

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PACKAGES = ("pgts_torch", "torch", "numpy", "scipy", "gymnasium", "tensorboard")


@final
class RunFolder:
    """Writes the files of a run. Use it as a context: leaving it closes the files.

    Args:
        lock: of the folder; checked before each write, so that nothing is written into a folder that replaced it.
        tensorboard: write events beside metrics.jsonl. Where there are none yet, those of the kept metrics come first.
        metrics_bytes: metrics.jsonl is truncated to this length.
        after_step: the step that the run resumes from; TensorBoard hides later events of a process that was killed.

    Raises:
        PgtsError: from every method that writes, if the disk is full.
    """

    def __init__(
        self, lock: RunLock, *, tensorboard: bool, metrics_bytes: int = 0, after_step: int | None = None
    ) -> None:
        self.path, self._lock = lock.path, lock
        path = self.path
        (path / FAILURE_FILE).unlink(missing_ok=True)
        self._metrics = (path / METRICS_FILE).open("ab", buffering=0)
        self._metrics.truncate(metrics_bytes)
        self._growing: dict[str, GrowingDigest] = {}
        self.events = Events(path, after_step=after_step, check=lock.check) if tensorboard else None
        if self.events is not None and self.events.is_new:
            for line in read_metrics(path):
                self.events.scalars(line.pop("step"), line)

    def __enter__(self) -> Self:
        if self.events is not None:
            self.events.__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        self._metrics.close()
        if self.events is not None:
            self.events.__exit__(*raised)

    def _writing(self, what: str) -> AbstractContextManager[None]:
        """Check the lock, then turn an OSError into a PgtsError that names the file."""
        self._lock.check()
        return files.named(f"{self.path / what} cannot be written to")

    def log(self, step: int, tags: dict[str, float]) -> None:
        """Write one line of metrics.jsonl, and the same numbers as TensorBoard scalars."""
        line = {"step": step} | {tag: value if math.isfinite(value) else None for tag, value in tags.items()}
        raw = json.dumps(line).encode() + b"\n"
        try:
            is_written = self._metrics.write(raw) == len(raw)
        except OSError:
            is_written = False
        if not is_written:
            raise PgtsError(f"{self.path / METRICS_FILE} cannot be written to at step {step}; is the disk full?")
        if self.events is not None:
            self.events.scalars(step, tags)

    def flush(self) -> dict[str, tuple[int, str]]:
        """Flush everything to the disk; the length and SHA-256 of the metrics, event files and best model, by name."""
        names = [METRICS_FILE]
        if self.events is not None:
            self.events.flush()
            names += filter(is_events, event_files(self.path))
        with self._writing("its files"):
            os.fsync(self._metrics.fileno())
            states = {name: self._growing.setdefault(name, GrowingDigest(self.path / name)).now() for name in names}
            if files.kind(self.path / BEST_FILE) is not None:
                states[BEST_FILE] = GrowingDigest(self.path / BEST_FILE).now()
        return states

    def json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a file of JSON atomically."""
        with self._writing(name):
            files.replace(self.path / name, (json.dumps(content, indent=2) + "\n").encode())

    def picture(self, name: str, figure: "Figure", step: int) -> None:
        """Write `name`.png, and the same picture to TensorBoard."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.image import imsave

        figure.set_dpi(120)
        canvas, png = FigureCanvasAgg(figure), io.BytesIO()
        canvas.draw()  # once for both: it takes as long as a short training
        pixels = np.asarray(canvas.buffer_rgba())
        imsave(png, pixels, format="png", dpi=120)
        with self._writing(f"{name}.png"):
            files.replace(self.path / f"{name}.png", png.getvalue())
        if self.events is not None:
            self.events.picture(name, pixels, step)


@final
class GrowingDigest:
    """Length and SHA-256 of a file that is only appended to; each byte is read once."""

    def __init__(self, path: Path) -> None:
        self._path, self._hash, self._bytes = path, hashlib.sha256(), 0

    def now(self, most: int | None = None) -> tuple[int, str]:
        """Length and SHA-256 of the whole file, or of its first `most` bytes."""
        with self._path.open("rb") as file:
            file.seek(self._bytes)
            while chunk := file.read(2**20 if most is None else min(2**20, most - self._bytes)):
                self._hash.update(chunk)
                self._bytes += len(chunk)
        return self._bytes, self._hash.hexdigest()


def versions() -> dict[str, Any]:
    """Versions of Python and of the packages that results depend on; None: not installed."""
    return {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The lines of a run's metrics.jsonl; PgtsError where one is damaged."""
    lines = []
    for number, raw in enumerate(files.read(path / METRICS_FILE).splitlines(), start=1):
        try:
            lines.append(dict(json.loads(raw)))
        except (ValueError, TypeError, RecursionError) as error:
            raise PgtsError(f"{path / METRICS_FILE}:{number} is damaged: {error}") from error
    return lines
