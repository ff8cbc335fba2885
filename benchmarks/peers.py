"""mctx's tree searches over a tabular MDP, asked for the values of the root's actions."""

import functools
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import torch

from pgts_torch.tabular import TabularMDP

Policy = Literal["muzero", "gumbel"]
POLICIES: tuple[Policy, ...] = ("muzero", "gumbel")


def mctx_searcher(
    mdp: TabularMDP,
    v_S: torch.Tensor,
    root_B: torch.Tensor,
    *,
    policy: Policy,
    simulations: int,
    max_depth: int,
) -> Callable[[], torch.Tensor] | None:
    """A search that answers with the values of all actions of the roots, [B, A]; None without mctx.

    A node is one sampled outcome of its edge, as in MuZero; its value is v and its prior the uniform policy. An action
    that was never tried has the value of the root. The root's Dirichlet noise is off, all else is mctx's default. A
    simulation asks the model once, for one outcome of one (state, action).

    Args:
        v_S: values of the leaves.
        max_depth: the most edges from the root to a leaf: m + 1 where T^m Q for Q = r + gamma P v is asked for.
    """
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        return None
    outcomes = mdp.outcomes
    tables = tuple(
        jnp.asarray(table.cpu().numpy())
        for table in (outcomes.reward_NA, outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK, v_S, root_B)
    )
    search, key = _compiled(policy, simulations), jax.random.PRNGKey(0)
    return lambda: torch.from_numpy(np.array(search(key, max_depth, *tables)))  # which waits for the answer


@functools.cache
def _compiled(policy: Policy, simulations: int) -> Any:
    """One jitted search; XLA compiles it once for each shape of the tables."""
    import jax
    import jax.numpy as jnp
    import mctx

    def search(
        key: Any,
        max_depth: Any,
        reward_SA: Any,
        prob_SAK: Any,
        discount_SAK: Any,
        child_SAK: Any,
        v_S: Any,
        root_B: Any,
    ) -> Any:
        logits_SAK, priors_BA = jnp.log(prob_SAK), jnp.zeros((len(root_B), reward_SA.shape[1]))

        def step(_: Any, key: Any, action_B: Any, state_B: Any) -> Any:
            k_B = jax.random.categorical(key, logits_SAK[state_B, action_B])
            next_B = child_SAK[state_B, action_B, k_B]
            answer = mctx.RecurrentFnOutput(
                reward=reward_SA[state_B, action_B],
                discount=discount_SAK[state_B, action_B, k_B],
                prior_logits=priors_BA,
                value=v_S[next_B],
            )
            return answer, next_B

        root = mctx.RootFnOutput(prior_logits=priors_BA, value=v_S[root_B], embedding=root_B)
        run = functools.partial(mctx.muzero_policy, dirichlet_fraction=0.0)
        run = run if policy == "muzero" else mctx.gumbel_muzero_policy
        answer = run((), key, root, step, num_simulations=simulations, max_depth=max_depth)
        summary = answer.search_tree.summary()
        return jnp.where(summary.visit_counts > 0, summary.qvalues, v_S[root_B][:, None])

    return jax.jit(search)
