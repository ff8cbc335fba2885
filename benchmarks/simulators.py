"""What does a call of a simulator cost, beside the environment's own step?

    python benchmarks/simulators.py [--json FILE] [--quick]

A call is what a lookahead pays for one state and action: restore, step, check, take a snapshot, number it. Not all of
them are simulated where states differ in MiniGrid's clock alone. The step alone is that of the bare environment, with
and without its observation where the model makes none; it walks on by random actions and is reset where an episode
ends. Restored: a snapshot is taken and put back before each of these steps, which is what a call takes at least. The
emulator alone is ALE's or MuJoCo's, for as many frames as a step of the environment has. Full search without
a critic, so that no observation of MiniGrid is drawn. CPU microseconds of one thread, medians of repeats in turns after
a first one, which does not count. What is not installed is left out.
"""

import importlib.util
import math
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import common
import gymnasium
import numpy as np
import torch
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv

from pgts_torch.models import SimulatorModel
from pgts_torch.models.actions import all_actions, sampled_actions
from pgts_torch.models.adapters import adapter_for
from pgts_torch.models.environments import EnvSource
from pgts_torch.search import Topology, expectimax

STICKY = {"repeat_action_probability": 0.0}
CASES: dict[str, tuple[str, Any, dict[str, Any], int, int]] = {
    "CartPole": ("gymnasium", CartPoleEnv, {}, 8, 8),
    "Acrobot": ("gymnasium", AcrobotEnv, {}, 5, 8),
    "Taxi": ("gymnasium", "Taxi-v4", {}, 8, 8),
    "DoorKey-5x5": ("minigrid", "MiniGrid-DoorKey-5x5-v0", {}, 5, 10),
    "Breakout, RAM": ("ale_py", "ALE/Breakout-v5", STICKY | {"obs_type": "ram"}, 3, 2),
    "Breakout": ("ale_py", "ALE/Breakout-v5", STICKY, 2, 2),
    "InvertedPendulum": ("mujoco", "InvertedPendulum-v5", {}, 2, 4),
    "Ant": ("mujoco", "Ant-v5", {}, 2, 2),
}
"""What must be installed, what is made with which arguments, the depth m and the number of roots."""

ACTIONS = 4
"""How many actions are taken of continuous ones."""

STEPS = 400


def made(case: tuple[str, Any, dict[str, Any], int, int]) -> Callable[[], gymnasium.Env]:
    """What makes the bare environment."""
    _, kind, kwargs, _, _ = case
    return kind if callable(kind) else lambda: EnvSource.of(kind, kwargs=kwargs).make_one()


def actions_of(env: gymnasium.Env) -> list[Any]:
    space = env.action_space
    return sampled_actions(space, ACTIONS, seed=0) if isinstance(space, gymnasium.spaces.Box) else [*all_actions(space)]


def step_cost(env: Any, *, is_blind: bool = False, is_restored: bool = False) -> float:
    """CPU microseconds of a step of the environment itself.

    Args:
        is_blind: its steps make no observation; not a number if the model's do.
        is_restored: a snapshot is taken and put back before each step, which makes an observation as the model's do.
    """
    adapter = adapter_for(env)
    if (is_blind or is_restored) and adapter.skip_observations(env) is None and is_blind:
        return float("nan")
    random, actions = np.random.default_rng(0), actions_of(env)
    chosen = random.integers(len(actions), size=STEPS)
    env.reset(seed=0)
    spent = 0.0
    for a in chosen:
        begin = time.thread_time()
        if is_restored:
            adapter.set_state(env, adapter.get_state(env).data)
        _, _, terminated, truncated, _ = env.step(actions[a])
        spent += time.thread_time() - begin
        if terminated or truncated:
            env.reset()
    return spent / STEPS * 1e6


def emulator_cost(env: Any) -> float:
    """CPU microseconds of what ALE or MuJoCo do in a step; not a number in other environments."""
    env.reset(seed=0)
    if hasattr(env, "ale"):
        frames = range(env._frameskip)
        advance = lambda: [env.ale.act(0) for _ in frames]  # noqa: E731
    elif hasattr(env, "frame_skip"):
        import mujoco

        advance = lambda: mujoco.mj_step(env.model, env.data, nstep=env.frame_skip)  # noqa: E731
    else:
        return float("nan")
    begin = time.thread_time()
    for _ in range(STEPS):
        advance()
    return (time.thread_time() - begin) / STEPS * 1e6


def call_cost(case: tuple[str, Any, dict[str, Any], int, int]) -> tuple[float, int, int]:
    """CPU microseconds of a call in a full search that begins with a new model; how many there were, and how many of
    them were simulated."""
    make, (*_, depth, roots) = made(case), case
    model, envs = SimulatorModel(make, gamma=0.99, actions=actions_of(make())), [make() for _ in range(roots)]
    seen = [env.reset(seed=seed)[0] for seed, env in enumerate(envs)]
    root_B = model.roots(envs, seen)
    begin = time.thread_time()
    zero = lambda state_N: torch.zeros(len(state_N))  # noqa: E731
    calls = expectimax(model, root_B, depth=depth, v_leaf=zero, topology=Topology(model)).model_calls
    return (time.thread_time() - begin) / calls * 1e6, calls, model.simulator_steps


def main(arguments: list[str] | None = None) -> None:
    args = common.parser(__doc__).parse_args(arguments)
    common.use_one_core()
    report: dict[str, Any] = {"about": common.about(args)}
    columns = "calls", "simulated", "a call", "a step", "blind", "restored", "emulator", "ratio"
    print(f"{'us':18}{'m':>3}" + "".join(f"{column:>10}" for column in columns))
    for name, case in CASES.items():
        if not importlib.util.find_spec(case[0]):
            print(f"{case[0]} is not installed: {name} is left out", file=sys.stderr)
            continue
        base, blind, restored = (made(case)().unwrapped for _ in range(3))
        rounds = [
            (
                *call_cost(case),
                *(step_cost(base), step_cost(blind, is_blind=True), step_cost(restored, is_restored=True)),
                emulator_cost(base),
            )
            for _ in range(3 if args.quick else 6)
        ][1:]
        call, calls, simulated, *alone = (statistics.median(column) for column in zip(*rounds, strict=True))
        report[name] = {"call": call, "calls": calls, "simulated": simulated}
        report[name] |= dict(zip(("step", "blind", "restored", "emulator"), alone, strict=True))
        times = "".join(f"{'-' if math.isnan(cost) else f'{cost:.1f}':>10}" for cost in (call, *alone))
        ratio = call / (alone[0] if math.isnan(alone[1]) else alone[1])
        print(f"{name:18}{case[3]:3}{calls:10.0f}{simulated:10.0f}{times}{ratio:10.1f}", flush=True)
    common.write(report, args.json)


if __name__ == "__main__":
    main()
