"""The results of one iteration of Algorithm 1."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.models.drawn_actions import Drawn
from pgts_torch.ranks import ALONE, Ranks
from pgts_torch.search.lookahead import Lookahead


@dataclass(frozen=True, eq=False)
class Batch:
    """The batch that an update of a policy is computed from.

    observation_N: the observation in each distinct visited state; with sampled advantages, in each visit.
    advantage_NA: with sum_a pi(a|s) A(s, a) = 0. Of a lookahead: (T^m Q)(s, a) - <pi, T^m Q>(s). Sampled advantages
        have this mean in expectation only.
    weight_N: w(s), the weight of each row in the update.
    noise: the standard error of the advantages of a sampled lookahead (root mean square), in reward units, by which
        normalised steps divide at least; 0 where nothing was sampled or no standard errors are computed.
    policy: the policy pi that the batch is of, from which updates of networks start; None: the one that is updated.
    ranks: the processes that have the other rows: an update is that from the rows of all.
    legal_NA: the legal actions of each row, by which updates of networks leave the others out; None: all are legal.
        They find it in the observations.
    drawn: the A actions of each row, and pi over them, where these are drawn vectors; None: they are numbered.
    """

    observation_N: Shaped[Tensor, "N ..."]
    advantage_NA: Float[Tensor, "N A"]
    weight_N: Float[Tensor, "N"]
    noise: float = 0.0
    policy: Policy | None = None
    ranks: Ranks = ALONE
    legal_NA: Bool[Tensor, "N A"] | None = None
    drawn: Drawn | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PolicyBatch(Batch):
    """A batch of the policy pi_k, and where it is from.

    state_N: the states of the rows; None with sampled advantages, which need none.
    pi_NA: pi_k in each row.
    depth: m.
    look: (T^m Q)(s, .) at these states; None with sampled advantages.
    gap_N: max_a (T^m Q)(s, a) - v(s) >= 0, with v(s) = <pi(.|s), Q(s, .)> of the same critic.
    certificate: an upper bound on J* - J^{pi_k}. `PGTS.certificates.trust` says how far it can be trusted: it is a
        proof only if the start distribution is known, the critic exact and the model the environment; else it holds up
        to the critic's error at the start states, and with 95 % confidence where these are sampled. Infinite where the
        model has no `highest_value`, the search samples outcomes, or there are too few episodes.
    gap_bound: an estimate of an upper bound from the gap (`Certificates.gap_bound`), where there is no certificate;
        else infinite.
    is_enough: whether the certificate is at most `stop_at`: then pi_k is not updated, and training ends.
    """

    state_N: Int[Tensor, "N"] | None
    pi_NA: Float[Tensor, "N A"]
    depth: int
    look: Lookahead | None
    gap_N: Float[Tensor, "N"]
    certificate: float
    gap_bound: float
    is_enough: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Iteration(PolicyBatch):
    """The results of one iteration of Algorithm 1.

    experience: the episodes of pi_k; like the rows of the batch, those of this process.
    num_steps: the environment steps of all processes.
    losses: the critic's and the update's, by name.
    model_calls: the number of (state, action) that lookahead and critic have queried in this iteration.
    posterior: a bound on J* - J^{pi_{k+1}} from a learned table alone (`PosteriorCertificate`), by which `is_enough` is
        decided then; None: there is none in this iteration.
    """

    experience: Rollout
    num_steps: int
    losses: dict[str, float]
    model_calls: int
    posterior: float | None = None
