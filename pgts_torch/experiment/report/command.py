"""The data behind `pgts report`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from pgts_torch.agent import saving
from pgts_torch.experiment.report.facts import gather
from pgts_torch.experiment.report.page import page
from pgts_torch.experiment.report.reading import REPORT_FILE


def write(run: Path, out: Path | None) -> dict[str, Any]:
    """Write the page about a run, by default into its folder.

    Returns:
        What the page shows, but for the pictures of the policy, as plain values; and where it is, as "page".

    Raises:
        PgtsError: the configuration of the run cannot be read, or the page cannot be written.
    """
    torch.set_num_threads(1)
    out = run / REPORT_FILE if out is None else out
    facts, trained = gather(run)
    saving.replace(out, page(facts, trained).encode())
    return {"page": str(out), **asdict(facts)}
