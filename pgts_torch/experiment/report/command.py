"""The data behind `pgts report`."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from pgts_torch import files
from pgts_torch.experiment.ownership import REPORT_FILE
from pgts_torch.experiment.report.facts import gather
from pgts_torch.experiment.report.page import is_page, page


def write(run: Path, out: Path | None, *, trust_imports: bool = False) -> dict[str, Any]:
    """Write the page about a run, by default into its folder.

    Returns:
        What the page shows, but for the pictures of the policy, as plain values; and where it is, as "page".

    Raises:
        PgtsError: the configuration of the run cannot be read, or the page cannot be written, as where a file is that
            is no such page.
    """
    torch.set_num_threads(1)
    out = files.target(run / REPORT_FILE if out is None else out, is_page, "a page of pgts report")
    facts, trained = gather(run, trust_imports=trust_imports)
    files.replace(out, page(facts, trained).encode())
    return {"page": str(out), **asdict(facts)}
