"""What TensorBoard shows of a training."""

import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, final

import numpy as np
import torch
from jaxtyping import Float, UInt8

from pgts_torch import files
from pgts_torch.agent.diagnostics import Counters, Diagnostics, Spread
from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.parts import Parts
from pgts_torch.envs.drawing import MOST_DRAWN, policy_pixels
from pgts_torch.errors import PgtsError
from pgts_torch.options.arguments import shortest
from pgts_torch.ranks import Ranks
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_BINS = 30
"""Bins of a histogram."""

PICTURE = "policy/evaluations"
"""The tag of the pictures of values and policy that are made when the policy is evaluated."""

MOST_PICTURES = 8
"""The most evaluations of a training at which a picture is made; TensorBoard shows ten of a tag."""


def event_writer() -> "type[SummaryWriter]":
    """TensorBoard's SummaryWriter; PgtsError where TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise PgtsError(
            f"TensorBoard cannot be imported ({error}): pip install tensorboard, or set run.tensorboard to false"
        ) from error
    return SummaryWriter


def hyperparameters(parts: Parts, *, env_kwargs: Mapping[str, Any] | None, seed: int) -> dict[str, float | str]:
    """The environment, discount, seed, depth and parts of a training, and all other options that are not the default,
    as `PGTS` calls them. Options of a part are dotted, as in "update.step_size"."""
    made = {"env": parts.source.name, "env_kwargs": env_kwargs or {}, "gamma": parts.world.gamma, "seed": seed}
    return {name: _scalar(value) for name, value in _flat(made | shortest(parts.options))}


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        key = prefix.rstrip(".") if prefix and name == "type" else prefix + name
        if isinstance(value, Mapping):
            yield from _flat(value, f"{key}.")
        else:
            yield key, value


def _scalar(value: Any) -> float | str:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return value if isinstance(value, str) or is_number else json.dumps(value, default=str)


@final
class Events:
    """Writes TensorBoard events into a folder. A context, which closes the file.

    is_new: whether the folder had no events before.

    Args:
        after_step: the step that the training goes on from; TensorBoard hides later events of a process that was
            killed. None: it begins.
        check: called before each write.

    Raises:
        PgtsError: from every method that writes, if the folder cannot be written to.
    """

    def __init__(self, folder: Path, *, after_step: int | None = None, check: Callable[[], None] | None = None) -> None:
        self._folder, self._check = folder, check
        writer = event_writer()
        self._thread_hook = threading.excepthook
        with self._writing():
            self.is_new = not event_files(folder)
            purge_step = None if after_step is None or self.is_new else after_step + 1
            self._writer = writer(str(folder), purge_step=purge_step, filename_suffix=files.EVENTS_SUFFIX)

    def __enter__(self) -> Self:
        threading.excepthook = self._on_thread_error
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        try:
            with self._writing():
                self._writer.close()
        except PgtsError:
            if error is None:
                raise
        finally:
            threading.excepthook = self._thread_hook

    def _on_thread_error(self, failed: threading.ExceptHookArgs) -> None:
        """Ignore an OSError of TensorBoard's writer thread: it is raised again in ours, as one line."""
        if not isinstance(failed.exc_value, OSError):
            self._thread_hook(failed)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn an OSError into a PgtsError that names the folder."""
        if self._check is not None:
            self._check()
        with files.named(f"{self._folder / 'events'} cannot be written to"):
            yield

    def begin(self, options: Mapping[str, float | str], text: str) -> None:
        """Write the hyper-parameters, and the configuration as text.

        TensorBoard shows all scalars beside hyper-parameters, and those of all runs. A list of our own of what to show
        would hide options that the first run of a folder does not have.
        """
        from torch.utils.tensorboard.summary import hparams

        with self._writing():
            self._writer._get_file_writer().add_summary(hparams(dict(options), {})[1])
            self._writer.add_text("configuration", f"```\n{text.strip()}\n```", 0)

    def scalars(self, step: int, tags: Mapping[str, float | None]) -> None:
        """Write numbers, all in one event, which takes a tenth of the time; None stands for one that is not finite."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        values = {tag: math.nan if value is None else value for tag, value in tags.items()}
        with self._writing():
            summary = Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()])
            self._writer._get_file_writer().add_summary(summary, step)

    def spread(self, step: int, found: Spread) -> None:
        """Write the histograms of an iteration."""
        nodes_L = np.array(found.nodes_L, dtype=np.float64)
        level_L = np.arange(len(nodes_L))
        with self._writing():
            if len(found.gap_N):
                self._writer.add_histogram("search/gap", found.gap_N, step, bins=_BINS)
            if nodes_L.any():
                self._writer.add_histogram_raw(
                    "search/depth_reached",
                    min=0,
                    max=int(level_L[nodes_L > 0][-1]),
                    num=nodes_L.sum(),
                    sum=nodes_L @ level_L,
                    sum_squares=nodes_L @ level_L**2,
                    bucket_limits=(level_L + 0.5).tolist(),
                    bucket_counts=nodes_L.tolist(),
                    global_step=step,
                )

    def picture(self, tag: str, pixels: UInt8[np.ndarray, "H W C"], step: int) -> None:
        with self._writing():
            self._writer.add_image(tag, pixels, step, dataformats="HWC")

    def policy(self, step: int, mdp: TabularMDP | None, pi_SA: Float[torch.Tensor, "S A"] | None) -> None:
        """Draw values and policy of a table, unless it is not known or has too many states."""
        if mdp is not None and pi_SA is not None and mdp.num_states <= MOST_DRAWN:
            evaluation = exact.evaluate(mdp, pi_SA)
            self.picture(PICTURE, policy_pixels(mdp, evaluation.v_S, pi_SA, evaluation.d_S > 0), step)

    def end(self, step: int, results: Mapping[str, float]) -> None:
        """Write the results of a training that is over, as final/*."""
        from torch.utils.tensorboard.summary import hparams

        self.scalars(step, {f"final/{name}": value for name, value in results.items()})
        with self._writing():
            self._writer._get_file_writer().add_summary(hparams({}, {})[2])

    def flush(self) -> None:
        with self._writing():
            self._writer.flush()


def is_drawn(step: int, num_steps: int, *, every: int, total_steps: int) -> bool:
    """Whether a picture goes with an evaluation after this step, in an iteration of so many steps.

    Args:
        every: environment steps from one evaluation to the next.
    """
    unit = every * -(-total_steps // (every * MOST_PICTURES))
    return step // unit > (step - num_steps) // unit


def event_files(folder: Path) -> list[str]:
    """The names of the event files in a folder; none where it does not exist."""
    if files.kind(folder, follow=True) is None:
        return []
    return sorted(path.name for path in folder.iterdir() if path.name.startswith(files.EVENTS_PREFIX))


@final
class Board:
    """Writes what `pgts train` writes, for a training by `PGTS.learn`. A context; all processes must make the same
    calls, and the first one writes.

    Args:
        options: its hyper-parameters.   text: its configuration.
        counters: where it begins.

    Raises:
        PgtsError: the folder cannot be one, or has events and the training begins.
    """

    def __init__(
        self,
        folder: str | Path,
        parts: Parts,
        ranks: Ranks,
        *,
        options: Mapping[str, float | str],
        text: str,
        total_steps: int,
        counters: Counters,
    ) -> None:
        self._diagnostics = Diagnostics(parts, total_steps=total_steps)
        self._clock = self._started = time.perf_counter()
        self._counters, self._total, self._num_steps = counters, total_steps, 0
        self._drawn_at = -1

        def opened() -> Events | None:
            if not ranks.leads:
                return None
            path = _folder(folder, begins=counters.env_steps == 0)
            events = Events(path, after_step=counters.env_steps or None)
            if events.is_new:
                events.begin(options, text)
            return events

        self._events = ranks.together("the folder of TensorBoard", opened)

    def __enter__(self) -> Self:
        if self._events is not None:
            self._events.__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        if self._events is not None:
            self._events.__exit__(*raised)

    def follow(self, iteration: Iteration, counters: Counters) -> None:
        """Write what is due after an iteration."""
        tags, found = self._diagnostics(iteration, counters, time.perf_counter() - self._clock)
        if self._events is not None:
            self._events.scalars(counters.env_steps, tags)
            if found is not None:
                self._events.spread(counters.env_steps, found)
        self._clock, self._counters, self._num_steps = time.perf_counter(), counters, iteration.num_steps

    def evaluated(self, tags: Mapping[str, float], *, every: int) -> None:
        """Write the scores of an evaluation, and draw the policy where that is due.

        Args:
            every: environment steps from one evaluation to the next.
        """
        step = self._counters.env_steps
        if self._events is not None:
            self._events.scalars(step, tags)
            if is_drawn(step, self._num_steps, every=every, total_steps=self._total):
                self._draw()

    def end(self) -> None:
        """Write the results of the training, and draw the policy."""
        if self._events is None:
            return
        results = {
            "env_steps": float(self._counters.env_steps),
            "model_calls": float(self._counters.model_calls),
            "seconds": time.perf_counter() - self._started,
        }
        truth, pi_SA = self._diagnostics.truth, self._diagnostics.policy_table()
        if truth is not None and pi_SA is not None:
            J = exact.evaluate(truth.mdp, pi_SA).J
            results |= {"J": J, "optimality_gap": max(truth.optimum.J - J, 0.0)}
        self._draw()
        self._events.end(self._counters.env_steps, results)

    def _draw(self) -> None:
        truth, events, step = self._diagnostics.truth, self._events, self._counters.env_steps
        if truth is not None and events is not None and self._drawn_at != step:
            events.policy(step, truth.mdp, self._diagnostics.policy_table())
            self._drawn_at = step


def _folder(given: str | Path, *, begins: bool) -> Path:
    """The folder for events; PgtsError where it is none, or has those of another training, or something else only."""
    if not isinstance(given, str | Path) or not str(given):
        raise PgtsError(f"tensorboard is {given!r}; it must be the path of a folder")
    path = Path(given)
    found = files.kind(path, follow=True)
    if found not in (None, "folder"):
        raise PgtsError(f"tensorboard is {str(path)!r}, which is a {found}; it must be a folder or not exist")
    with files.named(f"tensorboard {path} cannot be read"):
        there = event_files(path)
    if not there and found is not None and (foreign := files.names(path)):
        raise PgtsError(
            f"tensorboard {path} holds files, but no events ({files.listing(foreign)}); choose another folder, as "
            f"{path / 'events'}"
        )
    if begins and there:
        raise PgtsError(
            f"tensorboard {path} holds the events of another training ({there[0]}); choose another folder, or remove "
            "them"
        )
    return path
