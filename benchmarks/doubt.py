"""How deep should a lookahead in a learned model go, and where should it leave a state to the critic?

    python benchmarks/doubt.py [--tasks cartpole mountain_car frozen_lake] [--steps 500] [--seed 0]

A training from the steps of the environment alone (depth 1), and then, for m = 0 to 3 at 64 states of its replay, means
over states and actions:

    spread    max_a - min_a of T^m Q in the learned model.   doubt    its `doubt_BA`, with the critic's error E_0
    error     |T^m Q in the learned model - T^m Q in the environment|, with the same critic at the leaves
    left      the same error where states below the root are left to the critic if the model's error under their best
              action is among the highest 10 % or 50 % of the states of the replay

E_0 is the root mean square of what the returns of imagined episodes differ by from the critic. A rule that takes the
depth with the largest spread / doubt takes the row that is marked.
"""

import argparse
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pgts_torch import PGTS
from pgts_torch.agent.advantages import gae
from pgts_torch.agent.draws import Draws
from pgts_torch.bellman import backup
from pgts_torch.models.base import EnumeratingModel, FallibleModel
from pgts_torch.models.tensor import TensorModel
from pgts_torch.options import Counts
from pgts_torch.search import expectimax
from pgts_torch.seeding import stream

TASKS: dict[str, tuple[str, Any]] = {
    "cartpole": ("CartPole-v1", "ensemble"),
    "mountain_car": ("MountainCar-v0", "ensemble"),
    "frozen_lake": ("FrozenLake-v1", Counts(value_range=[0.0, 1.0], confidence=0.95)),
}
STATES, DEPTHS, LEFT = 64, (0, 1, 2, 3), (0.1, 0.5)
Leaf = Callable[[Tensor], Tensor]


def critic_in(training: PGTS, model: Any) -> Leaf:
    """v of the critic of a training, in states of a model whose states are the observations."""
    observe: Leaf = lambda state_N: model.states(state_N).float() if isinstance(model, TensorModel) else state_N  # noqa: E731
    critic = training.critic
    return lambda state_N: (
        critic.v(observe(state_N)) if critic.target == "v" else critic.q(observe(state_N)).amax(-1)
    ).double()


def leaving(model: Any, v: Leaf, state_N: Tensor, levels: int, most: float) -> Tensor:
    """Q after so many levels, where the critic values every state whose best action has an error above `most`."""
    outcomes = model.outcomes(state_N)
    child_C, place_NAK = outcomes.child_NAK.unique(return_inverse=True)
    v_C = v(child_C)
    if levels > 1:
        q_CA = leaving(model, v, child_C, levels - 1, most)
        error_C = model.step_error(child_C).gather(1, q_CA.argmax(-1, keepdim=True))[:, 0]
        v_C = torch.where(error_C > most, v_C, q_CA.amax(-1))
    here = type(outcomes)(outcomes.reward_NA, outcomes.prob_NAK, outcomes.discount_NAK, place_NAK, len(child_C))
    return backup(here, v_C)


def critic_error(training: PGTS) -> float:
    """The root mean square of return - v in imagined episodes."""
    assert training.dyna is not None
    draws = Draws.of(training.ranks, training.seed, training.num_iterations, training.device)
    imagined, _ = next(training.dyna.rollouts(draws))
    returns_TB = gae(imagined, *training.critic.values(imagined), 1.0)
    return float(returns_TB[imagined.alive_TB].square().mean().sqrt())


def report(task: str, steps: int, seed: int) -> None:
    """Train, and print a row for each depth."""
    env, options = TASKS[task]
    training = PGTS(env, model=options, depth=1, seed=seed, gamma=0.99).learn(steps)
    assert training.dyna is not None
    truth = PGTS(env, gamma=0.99, num_envs=1).world.model
    learned = training.world.model
    assert isinstance(learned, EnumeratingModel)
    assert isinstance(truth, EnumeratingModel)
    assert isinstance(learned, FallibleModel)
    error = critic_error(training)
    replay = training.dyna.replay
    chosen = replay.rows("state", replay.sample(STATES, generator=stream(seed, "states")))
    roots, true_roots = (
        model.number(chosen.to(model.state_dtype)) if isinstance(model, TensorModel) else chosen
        for model in (learned, truth)
    )
    v, true_v = critic_in(training, learned), critic_in(training, truth)
    each = [expectimax(learned, roots, depth=m, v_leaf=v, leaf_error=error) for m in DEPTHS]
    errors_N = learned.step_error(roots)
    assert errors_N is not None
    limits = [float(errors_N.quantile(1 - share)) for share in LEFT]
    ratios = [float(spread_of(look.q_BA) / look.doubt_BA.mean()) for look in each if look.doubt_BA is not None]
    print(
        f"\n{env}, seed {seed}, {training.num_env_steps} steps, E_0 {error:.3g}, {training.options.critic.type} critic"
    )
    print("  m    spread     doubt   spread / doubt     error   " + "   ".join(f"left {x:.0%}" for x in LEFT))
    for m, look in zip(DEPTHS, each, strict=True):
        true_BA = expectimax(truth, true_roots, depth=m, v_leaf=true_v).q_BA
        left = [leaving(learned, v, roots, m + 1, limit) for limit in limits]
        off = "   ".join(f"{float((q_BA - true_BA).abs().mean()):8.3g}" for q_BA in (look.q_BA, *left))
        mark = "*" if ratios[m] == max(ratios) else " "
        assert look.doubt_BA is not None
        print(f"{m:3d}  {spread_of(look.q_BA):8.3g}  {look.doubt_BA.mean():8.3g}  {ratios[m]:14.3g} {mark}  {off}")


def spread_of(q_BA: Tensor) -> Tensor:
    """The mean of max_a q - min_a q."""
    return (q_BA.amax(-1) - q_BA.amin(-1)).mean()


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--steps", type=int, nargs="+", default=[500, 1500])
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    for task in given.tasks:
        for steps in given.steps:
            report(task, steps, given.seed)


if __name__ == "__main__":
    main()
