"""A tree search with a network at its leaves, in dynamics whose states do not recur, beside mctx.

    python benchmarks/neural_leaves.py [--quick] [--repeats 9] [--json PATH]

CartPole from 128 roots, 64 simulations each, depth 8; the critic is a network of two layers of 64 units that knows
nothing. Both sides have the same network, dynamics and roots. Ours calls model and critic for the new states of all
roots together, and values all children of a state that it expands: two rows of the critic a simulation, where mctx has
one. So one line has half as many simulations, for as many rows. The critic's values are computed by a compiled loop, as
in a training from its 200th gradient step on, or by torch. How long the critic alone takes for so many rows is a line
of its own, and so is a search that knows all states, to which the model costs nothing: one call of the critic, and
loops over trees.

error: the mean of |q - T^m Q| over roots and actions, with T^m Q from a full search with the same critic. best: the
share of roots where the action with the largest q is the one with the largest T^m Q.

CPU time of one thread on one core for both sides, all forms in turns.
"""

import functools
import math
import statistics
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from common import Form, about, median_ratio, parser, take_turns, use_one_core, write
from gymnasium import spaces
from peers import POLICIES, Policy

from pgts_torch.agent.dense_forward import dense_outputs
from pgts_torch.agent.networks import Network, make_trunk
from pgts_torch.compiled import torch_only
from pgts_torch.models.classic import CartPole
from pgts_torch.options import MLP
from pgts_torch.search import Lookahead, Topology, expectimax, mcts
from pgts_torch.seeding import stream

ROOTS, SIMULATIONS, DEPTH, HIDDEN, GAMMA = 128, 64, 8, 64, 0.99
OURS, HALF, MERGED = "mcts, tree", "mcts, tree, half as many", "mcts, merged"

Critic = Callable[[torch.Tensor], torch.Tensor]


def make_critic() -> Network:
    generator, space = stream(0, "critic"), spaces.Box(-math.inf, math.inf, (4,))
    trunk = make_trunk(MLP(hidden=[HIDDEN, HIDDEN]), space, generator=generator)
    return Network(trunk, 1, gain=1.0, generator=generator)


def leaf_of(model: CartPole, critic: Critic) -> Critic:
    """The critic's values of numbered states."""
    return lambda state_N: critic(model.states(state_N).float()).squeeze(1).double()


def our_search(
    model: CartPole, critic: Critic, root_BD: torch.Tensor, known: Topology | None = None, **options: Any
) -> Lookahead:
    """A search that knows no state at first, or those of a topology."""
    if known is None:
        model.clear()
    given: dict[str, Any] = {"depth": DEPTH, "v_leaf": leaf_of(model, critic), "simulations": SIMULATIONS}
    return mcts(model, model.number(root_BD), topology=known, **given | options)


def peer_search(critic: Network, root_BD: torch.Tensor, policy: Policy) -> Form | None:
    """mctx over the same dynamics and network, jitted; None without mctx."""
    try:
        import jax
        import jax.numpy as jnp
        import mctx
    except ImportError:
        return None

    def step(state_BD: Any, action_B: Any) -> Any:
        x, x_dot, theta, theta_dot = state_BD.T
        cos, sin = jnp.cos(theta), jnp.sin(theta)
        push = (jnp.where(action_B == 1, 10.0, -10.0) + 0.05 * theta_dot**2 * sin) / 1.1
        theta_acc = (9.8 * sin - cos * push) / (0.5 * (4 / 3 - 0.1 * cos**2 / 1.1))
        x_acc = push - 0.05 * theta_acc * cos / 1.1
        after = x + 0.02 * x_dot, x_dot + 0.02 * x_acc, theta + 0.02 * theta_dot, theta_dot + 0.02 * theta_acc
        return jnp.stack(after, 1), (jnp.abs(after[0]) > 2.4) | (jnp.abs(after[2]) > 12 * 2 * np.pi / 360)

    def value(weights: Any, state_BD: Any) -> Any:
        for W, b in zip(weights[:-2:2], weights[1:-2:2], strict=True):
            state_BD = jnp.tanh(state_BD @ W.T + b)
        return (state_BD @ weights[-2].T + weights[-1])[:, 0]

    def answer(weights: Any, _: Any, action_B: Any, state_BD: Any) -> Any:
        next_BD, ends_B = step(state_BD, action_B)
        ones, logits_BA = jnp.ones(len(next_BD)), jnp.zeros((len(next_BD), 2))
        discount_B = jnp.where(ends_B, 0.0, GAMMA)
        v_B = value(weights, next_BD)
        return mctx.RecurrentFnOutput(reward=ones, discount=discount_B, prior_logits=logits_BA, value=v_B), next_BD

    run = mctx.gumbel_muzero_policy
    if policy == "muzero":
        run = functools.partial(mctx.muzero_policy, dirichlet_fraction=0.0)

    @jax.jit
    def search(weights: Any, state_BD: Any) -> Any:
        logits_BA, v_B = jnp.zeros((len(state_BD), 2)), value(weights, state_BD)
        root = mctx.RootFnOutput(prior_logits=logits_BA, value=v_B, embedding=state_BD)
        key, depth = jax.random.PRNGKey(0), DEPTH + 1
        found = run(weights, key, root, answer, num_simulations=SIMULATIONS, max_depth=depth)
        return found.search_tree.summary().qvalues

    weights = [jnp.asarray(x.detach().numpy()) for x in critic.parameters()]
    state_BD = jnp.asarray(root_BD.numpy(), jnp.float32)
    return lambda: np.asarray(search(weights, state_BD))


def neural_leaves(repeats: int) -> dict[str, Any]:
    """Milliseconds of a search, rows of the critic, and mctx's time to it."""
    critic = make_critic()

    def compiled(observation_ND: torch.Tensor) -> torch.Tensor:
        return dense_outputs(critic.theta_D, critic.dense_form, critic.encode(observation_ND))

    root_BD = (torch.rand(ROOTS, 4, generator=stream(0, "roots"), dtype=torch.float64) - 0.5) / 10
    model = CartPole(gymnasium.make("CartPole-v1"), gamma=GAMMA)
    found = our_search(model, critic.outputs, root_BD)
    rows = sum(found.nodes_per_level) - ROOTS

    def in_torch() -> None:
        with torch_only():
            our_search(model, critic.outputs, root_BD)

    other, full = (CartPole(gymnasium.make("CartPole-v1"), gamma=GAMMA) for _ in range(2))
    true_BA = expectimax(full, full.number(root_BD), depth=DEPTH, v_leaf=leaf_of(full, compiled)).q_BA
    known = Topology(other)
    our_search(other, compiled, root_BD, known=known)
    batch_ND = torch.zeros(rows // found.critic_calls, 4)

    def alone(critic: Critic) -> None:
        for _ in range(found.critic_calls):
            critic(batch_ND)

    forms: dict[str, Form] = {
        OURS: lambda: our_search(model, compiled, root_BD),
        HALF: lambda: our_search(model, compiled, root_BD, simulations=SIMULATIONS // 2),
        MERGED: lambda: our_search(model, compiled, root_BD, merge=True),
        f"{OURS}, states known": lambda: our_search(other, compiled, root_BD, known=known),
        "the critic alone": lambda: alone(compiled),
        f"{OURS}, critic by torch": lambda: our_search(model, critic.outputs, root_BD),
        "that critic alone": lambda: alone(critic.outputs),
        "nothing compiled": in_torch,
    }
    peers = {f"mctx, {policy}": peer_search(critic, root_BD, policy) for policy in POLICIES}
    forms |= {name: peer for name, peer in peers.items() if peer}
    times = take_turns(forms, repeats)
    searches = {form: forms[form] for form in (OURS, HALF, MERGED)} | {
        name: peer for name, peer in peers.items() if peer
    }
    found_BA = {name: _q_values(search()) for name, search in searches.items()}
    return {
        "critic_calls": found.critic_calls,
        "critic_rows": rows,
        "forms": {
            form: {"milliseconds": statistics.median(times[form])}
            | {
                f"{policy}_time_ratio": median_ratio(times[f"mctx, {policy}"], times[form])
                for policy in POLICIES
                if f"mctx, {policy}" in times
            }
            | (_against(true_BA, found_BA[form]) if form in found_BA else {})
            for form in forms
        },
    }


def _q_values(found: Any) -> torch.Tensor:
    return found.q_BA if isinstance(found, Lookahead) else torch.from_numpy(np.array(found)).double()


def _against(true_BA: torch.Tensor, q_BA: torch.Tensor) -> dict[str, float]:
    best = (q_BA.argmax(1) == true_BA.argmax(1)).double().mean()
    return {"error": float((q_BA - true_BA).abs().mean()), "best": float(best)}


def main() -> None:
    options = parser(__doc__)
    options.add_argument("--repeats", type=int, help="turns that each form takes; default 9")
    args = options.parse_args()
    use_one_core()
    report = about(args) | neural_leaves(args.repeats or (3 if args.quick else 9))
    print(f"CartPole, {ROOTS} roots, {SIMULATIONS} simulations, depth {DEPTH}")
    print(f"ours: {report['critic_rows']} rows of the critic in {report['critic_calls']} calls")
    print(f"{'':<28}{'CPU ms':>9}{'to muzero':>11}{'to gumbel':>11}{'error':>9}{'best':>7}")
    for form, row in report["forms"].items():
        ratios = (f"{row[key]:.2f}" if (key := f"{policy}_time_ratio") in row else "" for policy in POLICIES)
        line = f"{form:<28}{row['milliseconds']:>9.1f}" + "".join(f"{ratio:>11}" for ratio in ratios)
        print(line + (f"{row['error']:>9.4f}{row['best']:>7.0%}" if "error" in row else ""))
    print("to muzero, to gumbel: mctx's time with that policy to this time; above 1, this is faster.")
    print(f"half as many: {SIMULATIONS // 2} simulations. states known: no call of the model, one of the critic.")
    write(report, args.json)


if __name__ == "__main__":
    main()
