"""The data behind `pgts watch`: episodes of the policy of a run, as a file or in the terminal."""

import os
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.recording import Seen, noted
from pgts_torch.agent.showing import text
from pgts_torch.agent.watching import NoPicture
from pgts_torch.experiment.evaluate import checkpoint_of


def watch_run(
    run: Path,
    out: Path | None,
    *,
    checkpoint: str | int,
    episodes: int,
    fps: float | None,
    quiet: bool,
    trust_imports: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Record episodes of a run, or print them; they are printed, too, where the environment cannot be drawn.

    Args:
        checkpoint: as `checkpoint_of` takes it.
        fps: of a file; in a terminal the most steps a second, by default as many as there are.
        quiet: whether nothing is printed in place of the text form.
        options: others of `PGTS.record`.

    Returns:
        "file": the path, None where they were printed; "episodes": what `PGTS.record` returns.

    Raises:
        PgtsError: as `PGTS.load` and `PGTS.record`, or there is no such checkpoint.
    """
    torch.set_num_threads(1)
    with PGTS.load(checkpoint_of(run, checkpoint), device="cpu", trust_imports=trust_imports) as model:
        seen: list[Seen] = []
        if out is not None:
            try:
                seen = model.record(out, episodes=episodes, fps=fps, **options)
            except NoPicture as error:
                print(f"note: {error}; these are the same episodes as text", file=sys.stderr)
                out = None
        if out is None:
            with closing(model.watching(mode="ansi", **options)) as watching:
                for moment in noted(watching(episodes), seen):
                    if not quiet:
                        print(text(moment, coloured=sys.stdout.isatty() and "NO_COLOR" not in os.environ), flush=True)
                        time.sleep(0 if fps is None else 1 / fps)
    return {"file": None if out is None else str(out), "episodes": [each._asdict() for each in seen]}


def describe(answer: dict[str, Any]) -> str:
    """The answer in lines: episodes, and the file."""
    lines = [
        f"episode {k}, seed {each.seed}: {each.length} steps, return {each.episodic_return:.6g}, {each.ended}"
        for k, each in enumerate(Seen(**each) for each in answer["episodes"])
    ]
    return "\n".join([*lines, *([] if answer["file"] is None else [answer["file"]])])
