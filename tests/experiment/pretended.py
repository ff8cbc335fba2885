"""A process that the launcher starts in place of one that trains, and that imports next to nothing: it does at once
what a training comes to in hours.

    python -m tests.experiment.pretended REPORTS PLACE WHAT WHAT ...

Each process does the WHAT of its rank, in its n-th start the n-th word of it: a number (ends by itself with this exit
code), kill, crash, hang (as a watchdog ends it), lost (has lost another one) or wait (for SIGTERM).
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from pgts_torch.errors import LOST

TOLD = list[int]()


def wait_for_sigterm(*, seconds: float) -> None:
    """Torchrun's agent sends it to the others once it has seen that a process is lost."""
    end = time.monotonic() + seconds
    while not TOLD and time.monotonic() < end:
        time.sleep(0.01)


def starts(place: Path, rank: int) -> int:
    """How often this process was started."""
    path = place / f"starts-{rank}"
    return len(path.read_text().splitlines()) if path.exists() else 0


def main() -> int:
    signal.signal(signal.SIGTERM, lambda number, frame: TOLD.append(number))
    reports, place, *what = sys.argv[1:]
    rank = int(os.environ["RANK"])
    with (Path(place) / f"starts-{rank}").open("a") as file:
        file.write(f"{os.environ['OMP_NUM_THREADS']}\n")
    count = starts(Path(place), rank)
    while any(starts(Path(place), other) < count for other in range(len(what))):
        time.sleep(0.01)  # none is lost before all have begun
    words = what[rank].split(",")
    word = words[min(count, len(words)) - 1]
    report = Path(reports) / str(rank)
    if word == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif word == "hang":
        return LOST
    elif word == "lost":
        wait_for_sigterm(seconds=1)
        report.write_text(json.dumps({"code": LOST, "lost": f"rank {rank} has lost another one"}))
        return LOST
    elif word == "crash":
        return 1
    elif word == "wait":
        (Path(place) / f"waits-{rank}").touch()
        wait_for_sigterm(seconds=60)
        report.write_text(json.dumps({"code": 143, "lost": ""}))
    else:
        report.write_text(json.dumps({"code": int(word), "lost": ""}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
