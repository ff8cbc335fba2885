"""What `python -m study` does: compute parts, keep their data, draw the pictures, write the document."""

import io
import json
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from pgts_torch import files
from pgts_torch.errors import PgtsError
from study import PARTS, bounds, depth, figure, grid, ladder, random_mdp, sets, tightrope
from study.document import claim_rows, document, is_document
from study.drawing import pictures
from study.figure import Effort, Report
from study.sampled import WORKERS, executor

FULL = Effort(quick=False, seeds=10, workers=WORKERS)
QUICK = Effort(quick=True, seeds=3, workers=WORKERS)
DOTS_PER_INCH = 110
WIDTH = 79

CURVES = {one.FIGURE.name: one.FIGURE for one in (ladder, random_mdp, tightrope, grid)}
OTHERS = {"stationary": sets.compute, "depth": depth.compute, "bounds": bounds.compute}


def run(*, only: str | None, effort: Effort, out: Path) -> dict[str, Any]:
    """Compute one part or all, write everything to `out`, and return the data of what was computed.

    Raises:
        PgtsError: `out` cannot be written to, or holds data that cannot be read, or files that this has not made under
            names of those that it makes.
    """
    torch.set_num_threads(1)
    folder = out / "figures"
    with files.named(f"--out {out}"):
        folder.mkdir(parents=True, exist_ok=True)
    before = stored(folder)  # what cannot be read is better known now than after all the work
    page = files.target(out / "reproduction.md", is_document, "a document of python -m study")
    for name in PARTS if only is None else (only,):
        for picture in pictures(name):
            files.target(folder / f"{picture}.png", lambda _: name in before, f"a picture of figures/{name}.json")  # noqa: B023
    started = time.perf_counter()

    def report(message: str) -> None:
        print(f"{time.perf_counter() - started:6.0f} s  {message}", file=sys.stderr, flush=True)

    made = {}
    for name, data in _compute(PARTS if only is None else (only,), effort, report):
        # By way of JSON, so that what is drawn now is what would be drawn from the file.
        text = json.dumps(data, separators=(",", ":"))
        made[name] = json.loads(text)
        files.replace(folder / f"{name}.json", f"{text}\n".encode())
        for picture, draw in pictures(name).items():
            png = io.BytesIO()
            draw(made[name]).savefig(png, dpi=DOTS_PER_INCH)
            files.replace(folder / f"{picture}.png", png.getvalue())
        files.replace(page, document(stored(folder)).encode())
    report(f"wrote {out / 'reproduction.md'}")
    return {name: made[name] for name in PARTS if name in made}


def _compute(names: Sequence[str], effort: Effort, report: Report) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each part with its data. Sampled runs are begun first and waited for last: they go on beside all the rest."""
    with executor(effort.workers) as pool:
        try:
            pending = {name: figure.start(CURVES[name], effort, pool) for name in names if name in CURVES}
            for name in (name for name in names if name in OTHERS):
                yield name, OTHERS[name](effort, report)
            for name, runs in pending.items():
                yield name, figure.finish(CURVES[name], effort, runs, report)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def stored(folder: Path) -> dict[str, Any]:
    """The data of all parts that have been computed into this folder, by name."""
    parts = {}
    for name in PARTS:
        path = folder / f"{name}.json"
        if files.kind(path) is not None:
            try:
                parts[name] = json.loads(files.read(path))
                if not isinstance(parts[name], dict) or parts[name].get("part") != name:
                    raise PgtsError("it is not the data of this part")
            except (ValueError, RecursionError) as error:
                raise PgtsError(
                    f"{path} cannot be read: {error}; remove it or run python -m study --only {name}"
                ) from error
    return parts


def describe(parts: Mapping[str, Any]) -> str:
    """The statements and verdicts within 80 columns."""
    return "\n".join(_lines(parts))


def _lines(parts: Mapping[str, Any]) -> Iterator[str]:
    part = None
    for name, claim in claim_rows(parts):
        if name != part:
            yield ("" if part is None else "\n") + parts[name]["title"]
        part = name
        yield from textwrap.wrap(f"{claim['verdict']:<15}{claim['text']}", WIDTH, subsequent_indent=" " * 15)
        detail = claim["condition"] or ("" if claim["verdict"] == "holds" else claim["measured"])
        if detail:
            yield from textwrap.wrap(detail, WIDTH, initial_indent=" " * 17, subsequent_indent=" " * 17)
