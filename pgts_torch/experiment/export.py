"""The data behind `pgts export`: write the policy of a run as a program."""

from pathlib import Path
from typing import Any

import torch

from pgts_torch.agent.exporting import Format
from pgts_torch.agent.pgts import PGTS
from pgts_torch.experiment.evaluate import checkpoint_of
from pgts_torch.experiment.ownership import EXPORT_FILES


def export_run(
    run: Path, out: Path | None, *, format: Format | None, checkpoint: str | int, trust_imports: bool = False
) -> dict[str, Any]:
    """Export the policy of a checkpoint, by default into the folder of the run.

    Args:
        format: default: by the end of `out`, or torch.
        checkpoint: as `checkpoint_of` takes it.

    Returns:
        What the file says of itself; "file" is its path.

    Raises:
        PgtsError: as `PGTS.load` and `PGTS.export`, or there is no such checkpoint.
    """
    torch.set_num_threads(1)
    if out is None:
        format = format or "torch"
        out = run / EXPORT_FILES[format]
    with PGTS.load(checkpoint_of(run, checkpoint), device="cpu", trust_imports=trust_imports) as model:
        return {"file": str(out), "checkpoint": checkpoint, **model.export(out, format=format)}
