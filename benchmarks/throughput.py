"""How fast is training without a lookahead beside SB3's, and what does a lookahead cost?

    python benchmarks/throughput.py [--json FILE] [--quick] [--only training|lookahead] [--device DEVICE]

Training: PPO and A2C at m = 0 with sampled advantages on CartPole against those of stable-baselines3 and against a loop
that does nothing else (`minimal_loop.py`), with the same networks, environments, transitions an update, passes,
minibatches and optimiser. Lookahead: seconds and model calls of an iteration by depth, in tables, in torch dynamics and
in simulators. The policy hardly moves there (its steps are 1e-9 long), so every depth looks from the same states.

One thread of one core. The peer needs stable-baselines3, DoorKey needs MiniGrid; without them they are left out.
"""

import importlib.util
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import gymnasium
import minimal_loop
import torch
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv

import pgts_torch.agent.visit as visit_module
from pgts_torch import PGTS
from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.ongoing import OngoingEpisodes
from pgts_torch.agent.policy_lookahead import PolicyLookahead
from pgts_torch.config import load
from pgts_torch.experiment.run import build

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
NUM_ENVS, HIDDEN, RATE, GAMMA, LAMBDA = 8, (64, 64), 3e-4, 0.99, 0.95
EPOCHS, MINIBATCH, CLIP = 10, 64, 0.5
WHOLE, WARM_STEPS = 500, 1_000
DEPTHS = (0, 1, 2, 3, 4, 8)
TABLE_DEPTHS = (0, 1, 2, 4, 8, 16, 64)
ITERATIONS = 4
MOST_SECONDS = 10.0
STILL = "1e-9"
SHORT = ["--rollout.horizon.length", "50"]


@dataclass(frozen=True)
class Case:
    """What both sides train.

    length: the steps of each environment between two updates, across which episodes go on; None: our episodes are
        whole, and the peers have as many transitions an update as ours had in the mean.
    steps: transitions of a training.
    """

    kind: str
    num_envs: int
    length: int | None
    steps: int

    def __str__(self) -> str:
        return f"{self.kind}, {self.num_envs} x " + ("episode" if self.length is None else str(self.length))


CASES = (
    Case("PPO", 8, None, 12_000),
    Case("PPO", 8, 128, 12_000),
    Case("PPO", 64, 8, 12_000),
    Case("A2C", 8, None, 20_000),
    Case("A2C", 8, 5, 40_000),
)


def our_training(case: Case, steps: int, seed: int) -> dict[str, float]:
    """PGTS at m = 0 with sampled advantages: PPO, or A2C (one gradient step for each batch)."""
    a2c = case.kind == "A2C"
    passes = {"num_epochs": 1, "minibatch_size": 10**6} if a2c else {"num_epochs": EPOCHS, "minibatch_size": MINIBATCH}
    rate = {"learning_rate": RATE, "max_grad_norm": CLIP}
    model = PGTS(
        "CartPole-v1",
        depth=0,
        estimator={"type": "sampled", "lambda": LAMBDA},
        policy={"type": "mlp", "hidden": HIDDEN},
        critic={
            "type": "network",
            "network": {"type": "mlp", "hidden": HIDDEN},
            "method": {"type": "td_lambda", "lambda": LAMBDA},
            "normalize_returns": False,
            **passes,
            **rate,
        },
        update={"type": "gradient", **rate} if a2c else {"type": "ppo", **passes, **rate},
        horizon={"type": "fixed", "length": WHOLE} if case.length is None else {"type": "steps", "length": case.length},
        num_envs=case.num_envs,
        gamma=GAMMA,
        seed=seed,
    )
    queries: list[int] = []
    collector = (visit_module, "rollout") if case.length is None else (OngoingEpisodes, "collect")
    with common.timed(*collector) as collecting:
        begin = time.process_time()
        model.learn(steps, callback=lambda _, iteration: queries.append(queried(case, iteration)))
        seconds = time.process_time() - begin
    return _figures(model.num_env_steps, len(queries), sum(queries), seconds, sum(collecting))


def peer_training(case: Case, steps: int, seed: int, batch: float) -> dict[str, float]:
    """The same by stable-baselines3: environments without a monitor, no logging, separate networks as by default.

    Args:
        batch: transitions an update, where the case leaves it open; taken in whole minibatches.
    """
    import stable_baselines3
    from stable_baselines3.common.vec_env import DummyVecEnv

    n_steps = length_of(case, batch)
    options: dict[str, Any] = {"n_steps": n_steps, "learning_rate": RATE, "gamma": GAMMA, "gae_lambda": LAMBDA}
    options |= {"max_grad_norm": CLIP, "ent_coef": 0.0, "seed": seed, "device": "cpu"}
    options |= {"n_epochs": EPOCHS, "batch_size": MINIBATCH} if case.kind == "PPO" else {"use_rms_prop": False}
    envs = DummyVecEnv([lambda: gymnasium.make("CartPole-v1", disable_env_checker=True)] * case.num_envs)
    network = {"net_arch": {"pi": list(HIDDEN), "vf": list(HIDDEN)}, "activation_fn": torch.nn.Tanh}
    model = getattr(stable_baselines3, case.kind)("MlpPolicy", envs, policy_kwargs=network, **options)
    with common.timed(model, "collect_rollouts") as collecting:
        begin = time.process_time()
        model.learn(steps)
        seconds = time.process_time() - begin
    return _figures(model.num_timesteps, len(collecting), model.num_timesteps, seconds, sum(collecting))


def queried(case: Case, iteration: Iteration) -> int:
    """How many observations the policy was asked about in the episodes of an iteration."""
    return iteration.experience.alive_TB.numel() if case.length is None else iteration.num_steps


def length_of(case: Case, batch: float) -> int:
    """The steps of each environment between two updates of a peer."""
    return case.length or max(1, round(batch / MINIBATCH)) * MINIBATCH // case.num_envs


def loop_training(case: Case, steps: int, seed: int, batch: float) -> dict[str, float]:
    """The same by a minimal loop."""
    settings: dict[str, Any] = {"hidden": HIDDEN, "rate": RATE, "gamma": GAMMA, "lambda_": LAMBDA, "clip": CLIP}
    settings |= {"epochs": EPOCHS, "minibatch": MINIBATCH}
    made = minimal_loop.train(case.kind, case.num_envs, length_of(case, batch), steps, seed, **settings)
    return _figures(int(made["steps"]), int(made["updates"]), int(made["steps"]), made["seconds"], made["collecting"])


def _figures(steps: int, updates: int, queries: int, seconds: float, collecting: float) -> dict[str, float]:
    """Transitions an update, how often the policy was queried for each, and transitions a CPU second by part."""
    return {
        "batch": steps / updates,
        "queries": queries / steps,
        "whole": steps / seconds,
        "learning": steps / (seconds - collecting),
        "collecting": steps / collecting,
    }


def training(case: Case, quick: bool) -> dict[str, Any]:
    """All sides in turns, each repeat with a seed of its own; a first short one, in which caches fill, is not kept."""
    sides: dict[str, list[dict[str, float]]] = {"ours": [], "SB3": [], "loop": []}
    for seed in range(-1, 3 if quick else 5):
        length = WARM_STEPS if seed < 0 else case.steps // 2 if quick else case.steps
        made = {"ours": our_training(case, length, max(seed, 0))}
        made["SB3"] = peer_training(case, length, max(seed, 0), made["ours"]["batch"])
        made["loop"] = loop_training(case, length, max(seed, 0), made["ours"]["batch"])
        if seed >= 0:
            for side, figures in made.items():
                sides[side].append(figures)
    parts = {part: {side: [run[part] for run in runs] for side, runs in sides.items()} for part in sides["ours"][0]}
    ratios = {
        part: {peer: common.median_ratio(of["ours"], of[peer]) for peer in ("SB3", "loop")}
        for part, of in parts.items()
    }
    return {"case": str(case), "figures": parts, "ratios": ratios}


def training_line(row: dict[str, Any]) -> str:
    middle = {
        part: {side: statistics.median(values) for side, values in of.items()} for part, of in row["figures"].items()
    }
    batch = middle["batch"]
    line = f"{row['case']:17}{batch['ours']:7.0f}{batch['SB3']:6.0f}{middle['queries']['ours']:9.2f}"
    for part in ("whole", "learning", "collecting"):
        line += f"{middle[part]['ours']:9,.0f}" + "".join(
            f"{row['ratios'][part][peer]:6.2f}" for peer in ("SB3", "loop")
        )
    return line


class SimulatedCartPole(CartPoleEnv):
    """CartPole of which only the simulator is known: torch dynamics are for CartPoleEnv itself."""


class SimulatedAcrobot(AcrobotEnv):
    """As `SimulatedCartPole`."""


SIMULATED: dict[str, Callable[..., gymnasium.Env]] = {
    "SimulatedCartPole-v0": SimulatedCartPole,
    "SimulatedAcrobot-v0": SimulatedAcrobot,
}

PROBLEMS: dict[str, tuple[str, list[str], tuple[int, ...]]] = {
    "Grid, table": ("grid", [], TABLE_DEPTHS),
    "FrozenLake8x8, table": ("frozen_lake_8x8", [], TABLE_DEPTHS),
    "Taxi, table": ("taxi", [], TABLE_DEPTHS),
    "CartPole, dynamics": ("cartpole", [], DEPTHS),
    "CartPole, simulator": ("cartpole", ["--env.id", "SimulatedCartPole-v0"], DEPTHS),
    "Acrobot, dynamics": ("acrobot", SHORT, DEPTHS[:-1]),
    "Acrobot, simulator": ("acrobot", [*SHORT, "--env.id", "SimulatedAcrobot-v0"], DEPTHS[:-1]),
    "DoorKey-5x5, simulator": ("door_key", SHORT, (0, 1, 2)),
}
"""Which configuration, with which changes, at which depths."""


def lookahead(config: str, changes: list[str], depth: int, device: str) -> dict[str, list[float]]:
    """Of each of the first iterations of a fresh model: CPU seconds, those of its lookahead, model calls and states."""
    path = str(CONFIGS / f"{config}.yaml")
    still = "--update.step_size" if load(path).critic.type == "tabular" else "--update.learning_rate"
    search = ["--search.kind", "expectimax", "--search.depth", str(depth), "--device", device]
    model = build(load(path, [*changes, still, STILL, *search]))
    found: dict[str, list[float]] = {"seconds": [], "looking": [], "calls": [], "states": []}
    while len(found["seconds"]) < ITERATIONS and sum(found["seconds"]) < MOST_SECONDS:
        begin = time.process_time()
        with common.timed(PolicyLookahead, "__call__") as looks:
            iteration = model.iterate()
        found["seconds"].append(time.process_time() - begin)
        found["looking"].append(sum(looks))
        found["calls"].append(iteration.model_calls)
        found["states"].append(len(iteration.observation_N))
    return found


def lookahead_line(name: str, depth: int, found: dict[str, list[float]], base: dict[str, list[float]]) -> str:
    """What the first and a later iteration cost, and the latter's ratio to one of `base`."""
    later = {part: statistics.median(values[1:] or values) for part, values in found.items()}
    ratio = later["seconds"] / statistics.median(base["seconds"][1:] or base["seconds"])
    line = f"{name:24}{depth:3}{found['states'][0]:10}{found['seconds'][0]:10.3f}{later['seconds']:10.3f}"
    line += f"{ratio:10.2f}{later['looking']:11.3f}"
    return line + "".join(f"{common.short(calls):>10}" for calls in (found["calls"][0], later["calls"]))


def main(arguments: list[str] | None = None) -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--only", choices=("training", "lookahead"), help="one of the two")
    args = parser.parse_args(arguments)
    common.use_one_core()
    report: dict[str, Any] = {"about": common.about(args)}
    if args.only != "lookahead":
        if importlib.util.find_spec("stable_baselines3"):
            print("CartPole-v1, m = 0, sampled advantages; transitions a CPU second, medians")
            print(f"{'':17}{'batch':>13}{'queries':>9}{'whole training':>21}{'learning':>21}{'collecting':>21}")
            print(f"{'':17}{'ours':>7}{'SB3':>6}{'ours':>9}" + f"{'ours':>9}{'/SB3':>6}{'/loop':>6}" * 3)
            report["training"] = []
            for case in CASES:
                report["training"].append(training(case, args.quick))
                print(training_line(report["training"][-1]), flush=True)
            print(TRAINING_NOTE)
        else:
            print("stable-baselines3 is not installed: training is left out", file=sys.stderr)
    if args.only != "training":
        for name, env in SIMULATED.items():
            gymnasium.register(name, entry_point=env)
        print("CPU seconds and model calls of one iteration, full search, untrained policy")
        columns = ("states", "first s", "later s", "to m = 0", " looking s", "calls", "later")
        print(f"{'':24}{'m':>3}" + "".join(f"{title:>10}" for title in columns))
        report["lookahead"] = {}
        for name, (config, changes, depths) in PROBLEMS.items():
            if config == "door_key" and not importlib.util.find_spec("minigrid"):
                print("MiniGrid is not installed: DoorKey is left out", file=sys.stderr)
                continue
            by_depth = {m: lookahead(config, changes, m, args.device) for m in (depths[:3] if args.quick else depths)}
            for depth, found in by_depth.items():
                print(lookahead_line(name, depth, found, by_depth[0]), flush=True)
            report["lookahead"][name] = by_depth
        print(LOOKAHEAD_NOTE)
    common.write(report, args.json)


TRAINING_NOTE = """batch: transitions an update. queries: of our policy, for each transition; an environment whose
episode is over rests until the longest one ends, and what the policy returns for it is not kept. learning: all but
collecting, which in SB3 and the loop includes values and GAE. 8 x episode: whole episodes of 8 environments; 64 x 8: 64
environments, 8 steps each, and episodes go on in the next update. /SB3, /loop: our speed divided by theirs.
"""

LOOKAHEAD_NOTE = """first: nothing is known of the model yet; later: median of the next iterations.
to m = 0: ratio of the later ones. looking: the lookahead's part of a later iteration. calls: of the model in the
first iteration, and in a later one. Acrobot and DoorKey: episodes of 50 steps."""


if __name__ == "__main__":
    main()
