"""What one pass through the loop of Algorithm 1 saw and did."""

from dataclasses import dataclass

from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.rollout import Rollout
from pgts_torch.search.lookahead import Lookahead


@dataclass(frozen=True, eq=False)
class PolicyBatch:
    """What the policy pi_k is moved by.

    observation_N, weight_N: what it saw in the states that it visited, and what each of them counts for in the update;
        with sampled advantages every visit has a row of its own.
    state_N: these states; None with sampled advantages, which need none.
    pi_NA: pi_k at these states.
    advantage_NA: how much better each action is than the policy, with sum_a pi(a|s) A(s, a) = 0. Of a lookahead
        (T^m Q)(s, a) - <pi, T^m Q>; of what was sampled in expectation only.
    depth: m.
    look: (T^m Q)(s, .) at these states; None with sampled advantages.
    gap_N: max_a (T^m Q)(s, a) - v(s) >= 0, with v(s) = <pi(.|s), Q(s, .)> of the same critic.
    certificate: an upper bound on J* - J^{pi_k}. `PGTS.certificates.trust` says how far it can be trusted: it is a
        proof only if the start distribution is known, the critic exact and the model the environment; else it holds as
        far as the critic is right at the start states, and with 95 % where these are drawn. Infinite where nothing can
        be said: no largest value is known, the search is a sampled one, or too few starts were drawn.
    is_enough: whether the certificate is at most `stop_at`: then pi_k stays as it is, and the training ends.
    noise: root mean square of the standard errors of a sampled lookahead, in reward units; 0 where nothing was sampled
        or nothing is known of it.
    """

    observation_N: Shaped[Tensor, "N ..."]
    state_N: Int[Tensor, "N"] | None
    weight_N: Float[Tensor, "N"]
    pi_NA: Float[Tensor, "N A"]
    advantage_NA: Float[Tensor, "N A"]
    depth: int
    look: Lookahead | None
    gap_N: Float[Tensor, "N"]
    certificate: float
    is_enough: bool
    noise: float


@dataclass(frozen=True, eq=False)
class Iteration(PolicyBatch):
    """What one pass through the loop of Algorithm 1 saw and did.

    experience: the episodes of pi_k.
    losses: the critic's and the update's, by name.
    model_calls: (state, action) asked of the model in this pass, by the lookahead and by the critic.
    """

    experience: Rollout
    losses: dict[str, float]
    model_calls: int
