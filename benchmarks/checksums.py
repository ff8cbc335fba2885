"""Whether a change of the code has changed a training: checksums of all shipped configurations, and of variants.

    python benchmarks/checksums.py > before.txt
    python benchmarks/checksums.py --against before.txt

Each training makes a few short iterations. Its checksum is over the parameters of the policy and, for each iteration,
the advantages, steps, model calls, losses and the certificate; names of anything are not in it. With --against the exit
code is 1 where a line differs.
"""

import hashlib
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pgts_torch.config import load
from pgts_torch.experiment.run import build

ROOT = Path(__file__).parent.parent
ITERATIONS = 3

SHORT = ["--rollout.num_envs", "4", "--rollout.horizon", "{type: fixed, length: 20}"]
ADAPTIVE = ["--search.depth", "adaptive", "--search.max_depth", "6"]

VARIANTS: dict[str, list[str]] = {
    "defaults, Taxi": ["--env.id", "Taxi-v4"],
    "defaults, adaptive": ["--env.id", "pgts/RiverSwim-v0", *ADAPTIVE],
    "defaults, CartPole": ["--env.id", "CartPole-v1", "--search.depth", "2"],
    "adaptive, CartPole": ["--env.id", "CartPole-v1", "--search.depth", "adaptive", "--search.max_depth", "2"],
    "Pendulum, actions divided": ["--env.id", "Pendulum-v1", "--env.actions_per_dimension", "3", "--search.depth", "1"],
    "action repeat": ["--env.id", "MountainCar-v0", "--search.action_repeat", "4", "--search.depth", "1"],
    "PPO": ["--env.id", "CartPole-v1", "--search.depth", "0", "--estimator.type", "sampled"],
    "A2C": [
        "--env.id",
        "CartPole-v1",
        "--search.depth",
        "0",
        "--estimator.type",
        "sampled",
        "--update.type",
        "gradient",
    ],
    "sampled": ["--env.id", "Taxi-v4", "--search.kind", "sampled", "--search.samples", "2"],
    "MCTS": ["--env.id", "Taxi-v4", "--search.kind", "mcts", "--search.simulations", "16"],
    "pruned": ["--env.id", "Taxi-v4", "--search.kind", "expectimax", "--search.max_width", "8"],
    "exact critic": ["--env.id", "pgts/Tightrope-v0", "--critic.type", "exact", "--search.stop_at", "0.01"],
    "ensemble": ["--env.id", "CartPole-v1", "--model.type", "ensemble", "--search.depth", "1"],
    "counts": ["--env.id", "FrozenLake-v1", "--model.type", "counts", "--search.depth", "16"],
    "dynamics with replay": ["--env.id", "CartPole-v1", "--replay.type", "uniform", "--search.depth", "1"],
    "simplex table": ["--env.id", "pgts/Ladder-v0", "--policy.type", "simplex"],
}


def main() -> int:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, metavar="FILE", help="what an earlier run has printed")
    against = parser.parse_args().against
    torch.set_num_threads(1)
    before = {} if against is None else dict(map(_split, against.read_text().splitlines()))
    differs = False
    for name, path, arguments in settings():
        digest = _digest(path, arguments)
        is_same = against is None or before.get(name) == digest
        differs |= not is_same
        print(f"{name:28}{digest}{'' if is_same else f'   was {before.get(name)}'}", flush=True)
    return int(differs)


def settings() -> Iterator[tuple[str, Path | None, list[str]]]:
    for path in sorted((ROOT / "configs").glob("*.yaml")):
        yield path.stem, path, SHORT
    for name, arguments in VARIANTS.items():
        yield name, None, SHORT + arguments


def _split(line: str) -> tuple[str, str]:
    return line[:28].strip(), line[28:44]


def _digest(path: Path | None, arguments: list[str]) -> str:
    model = build(load(path, arguments))
    digest = hashlib.sha256()
    for _ in range(ITERATIONS):
        seen = model.iterate()
        for number in (seen.experience.num_steps, seen.model_calls, seen.certificate, *sorted(seen.losses.values())):
            digest.update(repr(number).encode())
        digest.update(_bytes(seen.advantage_NA))
    for tensor in _tensors(model.policy.state_dict()):
        digest.update(_bytes(tensor))
    return digest.hexdigest()[:16]


def _bytes(tensor: Tensor) -> bytes:
    return tensor.detach().cpu().contiguous().numpy().tobytes()


def _tensors(state: Any) -> Iterator[Tensor]:
    if isinstance(state, Tensor):
        yield state
    elif isinstance(state, Mapping):
        for part in state.values():
            yield from _tensors(part)


if __name__ == "__main__":
    sys.exit(main())
