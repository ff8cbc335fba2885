"""Continuous actions: how the lookahead over K drawn actions tends to that over all, and learning beside PPO and SAC.

    python benchmarks/continuous.py draws
    python benchmarks/continuous.py search
    python benchmarks/continuous.py learning --env Pendulum-v1 --seeds 5 --steps 5000

`draws`: on the double integrator, whose values have a closed form, by how much max_k q falls short of max_a q, and how
far sum_k pi_hat q is from E_pi q: mean over states (bias) and standard deviation (spread).
`search`: there too, m = 1 and 2 steps ahead of v = 2 v*, which is below T v as values of policies are, by how much the
action that a search chooses is below the best of all in T^m q: of full width over K actions, and by mcts with as many
model calls over 16.
`learning`: the mean return of ten greedy episodes after so many environment steps, of this package and of PPO and SAC
of Stable-Baselines3 with their defaults, seed by seed, with the CPU seconds of the training.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from linear import LinearQuadratic

from pgts_torch import PGTS
from pgts_torch.agent.evaluate import Evaluator
from pgts_torch.agent.gaussian import GaussianPolicy, MixtureProposal
from pgts_torch.models.drawn_actions import DrawnActions
from pgts_torch.search import expectimax, mcts

GAMMA, STATES, _ACTIONS = 0.9, 500, 16
SIMULATED: dict[str, Any] = {
    "policy": {"type": "gaussian", "network": {"type": "mlp", "normalize": True}},
    "depth": 0,
    "num_envs": 4,
    "horizon": {"type": "fixed", "length": 250},
    "max_roots": 400,
}
UPHILL: dict[str, Any] = SIMULATED | {
    "depth": 3,
    "action_repeat": 20,
    "actions": 8,
    "proposal_scale": 3.0,
    "search": {"kind": "mcts", "widening": 1, "simulations": 80},
    "num_envs": 1,
    "max_roots": 100,
    "update": {
        "type": "mpo",
        "kl_mean": 0.3,
        "kl_std": 1e-4,
        "learning_rate": 3e-3,
        "minibatch_size": 32,
        "num_epochs": 20,
    },
}
HOPPING: dict[str, Any] = {
    "policy": SIMULATED["policy"],
    "depth": 0,
    "actions": 8,
    "num_envs": 2,
    "horizon": {"type": "steps", "length": 500},
    "replay": {
        "type": "uniform",
        "capacity": 20_000,
        "updates_per_step": 0.007,
        "starts": 32,
        "length": 32,
        "search_every": 8,
        "polyak": 1.0,
    },
    "update": {"type": "mpo", "kl_std": 2e-4, "learning_rate": "linear(2e-3, 2e-4, 100000)", "minibatch_size": 32},
}
OURS: dict[str, dict[str, Any]] = {
    "Pendulum-v1": {"policy": "gaussian", "depth": 0, "replay": "uniform"},
    "MountainCarContinuous-v0": UPHILL,
    "InvertedPendulum-v5": SIMULATED | {"horizon": {"type": "fixed", "length": 100}},
    "InvertedPendulum-v5 ensemble": {"policy": "gaussian", "depth": 0, "model": "ensemble"},
    "Hopper-v5": HOPPING,
    "HalfCheetah-v5": SIMULATED,
    "HalfCheetah-v5 replay": HOPPING,
}
"""Our settings, by environment, and by a word where it has two; all others are the defaults."""


class _Observed:
    """The states of the integrator as observations."""

    def __init__(self, model: LinearQuadratic) -> None:
        self.model = model

    def observe(self, state_N: torch.Tensor) -> torch.Tensor:
        return self.model.states(state_N).float()


def draws(counts: list[int]) -> None:
    """Print a row for each K."""
    model = LinearQuadratic.double_integrator(gamma=GAMMA)
    policy = GaussianPolicy(spaces.Box(-np.inf, np.inf, (2,)), 1)
    P_DD = model.optimal()
    generator = torch.Generator().manual_seed(0)
    state_ND = torch.randn(STATES, 2, generator=generator, dtype=torch.float64)
    state_N, normals = model.number(state_ND), policy.normals(state_ND.float())
    price = float(model.N_XX + GAMMA * model.G_DX.T @ P_DD @ model.G_DX)
    mean_N = model.q(P_DD, state_ND, normals.mean_NX) - price * normals.std_NX[:, 0].double().square()
    best_N = model.v(P_DD, state_ND)
    print("    K   short of the maximum: mean, largest   mean under pi: bias, spread")
    for count in counts:
        proposal = MixtureProposal(_Observed(model), policy, count, 2.0, torch.tensor([1]))  # type: ignore[arg-type]
        action_NKX, prob_NK = proposal(state_N)
        q_N = model.q(P_DD, state_ND.repeat_interleave(count, 0), action_NKX.flatten(0, 1))
        q_NK = q_N.view(-1, count)
        short_N, off_N = best_N - q_NK.amax(-1), (prob_NK.double() * q_NK).sum(-1) - mean_N
        print(f"{count:5}{short_N.mean():25.5f}{short_N.max():9.5f}{off_N.mean():24.5f}{off_N.std():9.5f}")


def search(roots: int) -> None:
    """Print a row for each depth and number of calls."""
    model = LinearQuadratic.double_integrator(gamma=GAMMA)
    policy = GaussianPolicy(spaces.Box(-np.inf, np.inf, (2,)), 1)
    root_B = model.number(torch.randn(roots, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    state_ND, leaf = model.states(root_B), 2 * model.optimal()
    widened: dict[str, Any] = {"C = 1": {"widening": 1}, "C = 3": {"widening": 3}}
    print("  m   K   calls   full width    mcts" + "".join(f"   mcts, {name}" for name in widened))
    for depth, count in ((1, 8), (1, 12), (1, 16), (2, 4), (2, 6), (2, 8)):
        P_DD = leaf
        for _ in range(depth):
            P_DD = model.improved(P_DD)
        best_N = model.v(model.improved(P_DD), state_ND)

        def searched(num_actions: int, find: Callable[..., Any]) -> tuple[float, int]:
            drawn = DrawnActions(model, num_actions)
            proposal = MixtureProposal(_Observed(model), policy, num_actions, 2.0, torch.tensor([1]))  # type: ignore[arg-type]
            drawn.redraw(proposal)
            v_leaf = lambda state_N: model.v(leaf, model.states(state_N))  # noqa: E731
            look = find(drawn, root_B, depth=depth, v_leaf=v_leaf)  # noqa: B023
            action_NX = proposal(root_B).action_NKX[torch.arange(roots), look.q_BA.argmax(-1)]
            short = best_N - model.q(P_DD, state_ND, action_NX)  # noqa: B023
            return float(short.mean()), look.model_calls // roots

        wide, calls = searched(count, expectimax)
        cells = [searched(_ACTIONS, partial(mcts, simulations=max(1, calls // _ACTIONS)))[0]]
        for options in widened.values():
            # A simulation takes at least a call, and C where it reaches a new node.
            least = calls - _ACTIONS + 1
            while True:
                short, taken = searched(_ACTIONS, partial(mcts, simulations=least, **options))
                if taken <= calls:
                    break
                least = min(least - 1, least * calls // taken)
            cells.append(short)
        print(
            f"{depth:3}{count:4}{calls:8}{wide:13.4f}{cells[0]:8.4f}" + "".join(f"{cell:14.4f}" for cell in cells[1:])
        )


def ours(env: str, steps: int, every: int, seed: int) -> Iterator[tuple[int, float]]:
    model = PGTS(env.split()[0], seed=seed, **OURS[env])
    with Evaluator(10) as score:
        while model.num_env_steps < steps:
            model.learn(min(model.num_env_steps - model.num_env_steps % every + every, steps))
            yield model.num_env_steps, score(model).episodic_return.mean


def stable_baselines(name: str) -> Callable[[str, int, int, int], Iterator[tuple[int, float]]]:
    def run(env: str, steps: int, every: int, seed: int) -> Iterator[tuple[int, float]]:
        import stable_baselines3
        from stable_baselines3.common.evaluation import evaluate_policy

        model = getattr(stable_baselines3, name)("MlpPolicy", gymnasium.make(env.split()[0]), seed=seed, device="cpu")
        judged = stable_baselines3.common.monitor.Monitor(gymnasium.make(env.split()[0]))
        while model.num_timesteps < steps:
            model.learn(min(every, steps - model.num_timesteps), reset_num_timesteps=False)
            judged.reset(seed=0)
            yield model.num_timesteps, float(evaluate_policy(model, judged, n_eval_episodes=10)[0])

    return run


LEARNERS = {"pgts": ours, "PPO": stable_baselines("PPO"), "SAC": stable_baselines("SAC")}


def learning(args: argparse.Namespace) -> None:
    """Print a row for each learner and seed, the return at each multiple of `every` steps."""
    for name in args.learners:
        for seed in range(args.seeds):
            begin = time.process_time()
            print(f"{args.env} {name:5} seed {seed}", end="", flush=True)
            for steps, mean in LEARNERS[name](args.env, args.steps, args.every, seed):
                print(f"  {steps}: {mean:.0f}", end="", flush=True)
            print(f"  ({time.process_time() - begin:.0f} s)", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["draws", "search", "learning"])
    parser.add_argument("--counts", type=int, nargs="+", default=[2, 4, 8, 16, 32, 64, 128])
    parser.add_argument("--roots", type=int, default=100)
    parser.add_argument("--env", default="Pendulum-v1", choices=list(OURS))
    parser.add_argument("--learners", nargs="+", default=list(LEARNERS), choices=list(LEARNERS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--every", type=int, default=1000, help="environment steps between evaluations")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.what == "draws":
        draws(args.counts)
    elif args.what == "search":
        search(args.roots)
    else:
        learning(args)


if __name__ == "__main__":
    main()
