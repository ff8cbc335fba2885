"""Runs of a long benchmark, kept one JSON line each: what was interrupted goes on where it was."""

import json
import multiprocessing
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import torch

Key = Mapping[str, Any]
"""What names a run: method, task, seed."""

Record = dict[str, Any]
"""Its key, and what came of it."""


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
            record = {**key, **future.result()}
            file.write(json.dumps(record) + "\n")
            file.flush()
            kept.append(record)
            print(f"[{number}/{len(missing)}] {' '.join(map(str, key.values()))}", file=sys.stderr, flush=True)
    return [record for key in keys if (record := _find(kept, key)) is not None]


def _find(records: Sequence[Record], key: Key) -> Record | None:
    return next((record for record in records if all(record.get(name) == value for name, value in key.items())), None)


def _one_thread() -> None:
    torch.set_num_threads(1)
