"""The data behind `pgts evaluate`: evaluate the last checkpoint of a run."""

from pathlib import Path

import torch

from pgts_torch import files
from pgts_torch.agent.evaluate import Evaluation, Evaluator
from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.checkpoint import newest
from pgts_torch.experiment.ownership import BEST_FILE, is_earlier, read_mark

KINDS = {"deterministic": True, "sampled": False}
"""The kinds of evaluation: with the most probable actions (True), or with sampled ones."""


def evaluate_run(run: str | Path, *, episodes: int, seed: int, trust_imports: bool = False) -> dict[str, Evaluation]:
    """Evaluate the last checkpoint of a run, with greedy and with sampled actions."""
    torch.set_num_threads(1)
    loaded = PGTS.load(last_checkpoint(Path(run)), trust_imports=trust_imports)
    with loaded as algorithm, Evaluator(episodes) as evaluator:
        return {kind: evaluator(algorithm, deterministic=greedy, seed=seed) for kind, greedy in KINDS.items()}


def checkpoint_of(run: Path, which: str) -> Path:
    """Return the path of the best model of a run folder, or of its newest intact checkpoint; PgtsError if there is
    none.

    Args:
        which: "best" or "last".
    """
    if which == "last":
        return last_checkpoint(run)
    if files.kind(run / BEST_FILE) != "file":
        raise PgtsError(
            f"{run} holds no {BEST_FILE}, which eval.every with eval.keep_best leave"
            + ": take its last checkpoint" * (newest(run) is not None)
        )
    return run / BEST_FILE


def last_checkpoint(run: Path) -> Path:
    """Return the path of the newest intact checkpoint of a run folder; PgtsError if there is none."""
    found = newest(run)
    if found is None and is_earlier(run):
        raise PgtsError(f"{run} is the folder of a run of version 0.1, which this version does not read: train again")
    if found is None:
        if read_mark(run) is not None:
            raise PgtsError(f"{run} is a run that has left no checkpoint yet: go on with it (pgts train --resume)")
        raise PgtsError(f"{run} holds no checkpoint; it must be the folder of a run")
    return found[0]
