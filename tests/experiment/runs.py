"""A small run of the command line, what it leaves, and signals to it while it trains."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.pgts import PGTS
from pgts_torch.cli.main import main
from pgts_torch.experiment import checkpoint, ownership, run
from pgts_torch.experiment.tracking import read_metrics

assert run.train  # imported before any process is forked, so that none has to
SMALL = ["--env.id", "CartPole-v1", "--policy.type", "mlp", "--policy.hidden", "[8]", "--search.depth", "1"]
SHORT = ["--total_steps", "100", "--rollout.num_envs", "3", "--rollout.horizon.length", "8", "--eval.episodes", "2"]
TAGS = {
    "charts/episodic_return",
    "charts/discounted_return",
    "charts/episodic_length",
    "charts/SPS",
    "losses/entropy",
    "losses/value",
    "search/depth",
    "search/model_calls",
}
"""What every run logs."""
OFTEN = ["--log.checkpoint_every", "1", "--eval.every", "20", "--eval.keep_best", "--run.tensorboard", "false"]


def arguments(folder: Path, *more: str) -> list[str]:
    return ["train", *SMALL, *SHORT, *OFTEN, "--run.dir", str(folder), *more]


def train_with_signals(folder: Path, *numbers: int, rank: int = 0, more: Sequence[str] = ()) -> int:
    """Train, and get these signals in the third iteration; the exit code. Only for a process that ends after it.

    Args:
        rank: the one of several processes that gets them.
        more: further arguments.
    """
    iterate = PGTS.iterate

    def iterate_with_signals(self: PGTS) -> Iteration:
        for number in numbers if self.num_iterations == 2 and self.ranks.rank == rank else ():
            os.kill(os.getpid(), number)
        return iterate(self)

    PGTS.iterate = iterate_with_signals  # type: ignore[method-assign]
    return main(arguments(folder, *more))


def dumped(content: Any) -> Any:
    """Every bit of what a checkpoint holds beside its notes, whichever of its objects are the same one."""
    if isinstance(content, torch.Tensor):
        return content.dtype, content.shape, content.contiguous().numpy().tobytes()
    if isinstance(content, dict):
        return {name: dumped(value) for name, value in content.items()}
    return [dumped(value) for value in content] if isinstance(content, list | tuple) else repr(content)


def left(folder: Path) -> dict[str, Any]:
    """Every byte that a run leaves, without what the clock, the process and the name of the folder change."""
    files: dict[str, Any] = {name: (folder / name).read_bytes() for name in ("best.pt", "versions.json")}
    files |= {path.name: dumped(checkpoint.read(path)[1]) for path in ownership.checkpoints(folder)}
    summary = json.loads((folder / "summary.json").read_text())
    lines = read_metrics(folder)
    for line in lines:
        line.pop("charts/SPS", None)
    files |= {"summary": {name: summary[name] for name in summary if name not in ("seconds", "run")}, "metrics": lines}
    return files | {"names": sorted(path.name for path in folder.iterdir())}


def tree(folder: Path) -> dict[str, bytes | str | None]:
    """Every entry of a folder, with its bytes, or where a symbolic link leads; None: a folder."""
    return {
        str(path.relative_to(folder)): os.readlink(path)
        if path.is_symlink()
        else path.read_bytes()
        if path.is_file()
        else None
        for path in folder.rglob("*")
    }


def put(folder: Path, **files: str) -> None:
    for name, content in files.items():
        path = folder / name.replace("__", "/").replace("_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
