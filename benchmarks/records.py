"""Long benchmarks of many runs, kept one JSON line each: what was interrupted goes on where it was."""

import argparse
import json
import multiprocessing
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

Key = Mapping[str, Any]
"""What names a run: method, task, seed."""

Record = dict[str, Any]
"""Its key, and what came of it."""


def benchmark(
    doc: str,
    arguments: list[str] | None,
    problem: str,
    problems: Sequence[Any],
    methods: Sequence[str],
    runs: Path,
    run: Callable[[Key], Record],
    describe: Callable[[list[Record]], str],
    draw: Callable[[list[Record]], Figure],
    applies: Callable[[Key], bool] = lambda key: True,
) -> None:
    """A command line that makes the runs of some methods on some problems with some seeds, and prints what they say.

    Args:
        doc: what `--help` says first.
        problem, problems: what a problem is called, as `size`, and which there are.
        runs: where the runs are kept by default.
        applies: whether there is such a run.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument(f"--{problem}s", dest="problems", help=f"default: {','.join(map(str, problems))}")
    parser.add_argument("--methods", help=f"default: {','.join(methods)}")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time, each in one thread; 0: none")
    parser.add_argument("--runs", type=Path, default=runs, help="finished runs, kept and not made again")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args(arguments)

    def chosen(text: str | None, known: Sequence[Any]) -> list[Any]:
        asked = text.split(",") if text else [str(each) for each in known]
        if unknown := set(asked) - {str(each) for each in known}:
            parser.error(f"{', '.join(sorted(unknown))} is not among {', '.join(map(str, known))}")
        return [each for each in known if str(each) in asked]

    torch.set_num_threads(1)
    keys = [
        {"method": method, problem: each, "seed": seed}
        for seed in range(given.seeds)
        for method in chosen(given.methods, methods)
        for each in chosen(given.problems, problems)
        if applies({"method": method, problem: each})
    ]
    records = measure(keys, run, path=given.runs, jobs=given.jobs)
    if given.json:
        given.json.write_text(json.dumps(records, indent=1) + "\n")
    if given.picture:
        draw(records).savefig(given.picture, dpi=120)
    print(describe(records))


def measure(keys: Sequence[Key], run: Callable[[Key], Record], *, path: Path, jobs: int) -> list[Record]:
    """The records of all these runs, in their order; those that the file has not are made and appended, `jobs` at a
    time, in processes of one thread each. With 0 jobs none is made."""
    kept = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    missing = [key for key in keys if jobs and _find(kept, key) is None]
    path.parent.mkdir(parents=True, exist_ok=True)
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs or 1, context, initializer=_one_thread)
    with pool, path.open("a", encoding="utf-8") as file:
        waiting = {pool.submit(run, key): key for key in missing}
        for number, future in enumerate(as_completed(waiting), 1):
            key = waiting[future]
            made = {**key, **future.result()}
            file.write(json.dumps(made) + "\n")
            file.flush()
            kept.append(made)
            print(f"[{number}/{len(missing)}] {' '.join(map(str, key.values()))}", file=sys.stderr, flush=True)
    return [record for key in keys if (record := _find(kept, key)) is not None]


def _find(records: Sequence[Record], key: Key) -> Record | None:
    return next((record for record in records if all(record.get(name) == value for name, value in key.items())), None)


def _one_thread() -> None:
    torch.set_num_threads(1)
