"""Folders as runs leave them, without a training: what is compared and summed up takes no time to make."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pgts_torch.agent.evaluate import Evaluation, Score
from pgts_torch.config import Config, dump, load
from pgts_torch.experiment.summary import Summary

Line = Mapping[str, Any]


def summary(config: Config, *, J: float | None, env_steps: int, greedy: float = 20.0, **more: Any) -> Summary:
    """What a finished run says, with greedy and sampled (half as good) episodes."""
    length = Score(20.0, None)
    deterministic, sampled = (Evaluation(2, Score(mean, 1.0), Score(0.5, 1.0), length) for mean in (greedy, greedy / 2))
    depth = config.search.depth
    fields: dict[str, Any] = {"model_calls": 7, "seconds": 1.0, "ended_by": "total_steps"} | more
    return Summary(
        run=str(config.run.dir),
        seed=config.seed or 0,
        depth=depth if isinstance(depth, int) else 0,
        search="none",
        J=J,
        J_optimal=J,
        stationarity_gap=J,
        iterations=3,
        env_steps=env_steps,
        deterministic=deterministic,
        sampled=sampled,
        **fields,
    )


def leave(folder: Path, config: Config, lines: Sequence[Line], what: Summary | None = None) -> Path:
    """Write the files of a run, unfinished where there is no summary."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(dump(config))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if what is not None:
        (folder / "summary.json").write_text(json.dumps(asdict(what)))
    return folder


def run(
    folder: Path,
    *arguments: str,
    seed: int = 0,
    score: float = 1.0,
    steps: int = 1000,
    tag: str = "charts/episodic_return",
    calls: float = 2.0,
    finished: bool = True,
    ended_by: str = "total_steps",
) -> Path:
    """A run of 1,000 steps whose metric rises in ten even steps to a score, or that was cut off before.

    Args:
        steps: the last one of metrics.jsonl.
        calls: model calls for each environment step.
    """
    config = load(None, ["--total_steps", "1000", f"--seed={seed}", "--run.tensorboard=false", *arguments])
    lines = [
        {"step": step, tag: score * step / 1000, "search/model_calls": calls * step, "charts/SPS": 50.0}
        for step in range(100, steps + 1, 100)
    ]
    J = score if tag == "exact/J" else None
    what = summary(config, J=J, env_steps=steps, greedy=score, ended_by=ended_by) if finished else None
    return leave(folder, config, lines, what)
