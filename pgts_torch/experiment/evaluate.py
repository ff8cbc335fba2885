"""The data behind `pgts evaluate`: evaluate a checkpoint of a run."""

from pathlib import Path

import torch

from pgts_torch import files
from pgts_torch.agent.evaluate import Evaluation, Evaluator
from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.checkpoint import newest
from pgts_torch.experiment.ownership import BEST_FILE, checkpoints, is_earlier, read_mark

KINDS = {"deterministic": True, "sampled": False}
"""The kinds of evaluation: with the most probable actions (True), or with sampled ones."""


def evaluate_run(
    run: Path, *, checkpoint: str | int = "last", episodes: int, seed: int, trust_imports: bool = False
) -> dict[str, Evaluation]:
    """Evaluate a checkpoint of a run, as `checkpoint_of` takes it, with greedy and with sampled actions."""
    torch.set_num_threads(1)
    loaded = PGTS.load(checkpoint_of(run, checkpoint), trust_imports=trust_imports)
    with loaded as algorithm, Evaluator(episodes) as evaluator:
        return {kind: evaluator(algorithm, deterministic=greedy, seed=seed) for kind, greedy in KINDS.items()}


def checkpoint_of(run: Path, which: str | int) -> Path:
    """Return the path of a checkpoint of a run folder; PgtsError if there is none.

    Args:
        which: "last", the newest intact one; "best", the best model by its evaluations; or the number of environment
            steps after which it was written.
    """
    if which == "last":
        return last_checkpoint(run)
    kept = checkpoints(run)
    if which == "best":
        if files.kind(run / BEST_FILE) != "file":
            raise PgtsError(
                f"{run} holds no {BEST_FILE}, which eval.every with eval.keep_best leave"
                + ": take its last checkpoint" * bool(kept)
            )
        return run / BEST_FILE
    for path in kept:
        if int(path.stem) == which:
            return path
    steps = ", ".join(str(int(path.stem)) for path in kept)
    raise PgtsError(f"{run} holds no checkpoint of step {which}" + f"; it has those of {steps}" * bool(kept))


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
