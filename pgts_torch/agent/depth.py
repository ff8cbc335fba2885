"""How deep an iteration looks ahead, what it sees there, and what may be missing to the optimum."""

from collections.abc import Sequence
from typing import NamedTuple, final

from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.certificate import Certificates
from pgts_torch.agent.policy_lookahead import PolicyLookahead
from pgts_torch.agent.ranks import Draws
from pgts_torch.agent.rollout import Rollout
from pgts_torch.bellman import policy_mean
from pgts_torch.search.lookahead import Lookahead, check_finite


class Chosen(NamedTuple):
    """The lookahead of an iteration.

    depth: m.
    look: (T^m Q)(s, .) at the visited states.
    gap_N: max_a (T^m Q)(s, a) - v(s) >= 0 there.
    certificate: an upper bound on J* - J^pi.
    is_enough: whether it is at most `stop_at`, so that the policy may stay as it is.
    """

    depth: int
    look: Lookahead
    gap_N: Float[Tensor, "N"]
    certificate: float
    is_enough: bool


@final
class DepthChoice:
    """Looks m steps ahead from the visited states: to a fixed depth m, or to the smallest one that sees enough.

    A policy that is far from stationary at depth m deserves no deeper look. So depths are tried in order, until

        sum_s d(s) g_m(s) > tolerance * sum_s d(s) (v_hat(s) - v(s)),        g_m(s) = max_a (T^m Q)(s, a) - v(s)

    with the upper bound v_hat >= v* of the certificate, or until the certificate is at most `stop_at`.

    Args:
        look: the lookahead.
        certificates: bounds from what it has queried.
        depths: that are tried, in this order; of a fixed depth one.
        tolerance: which share of what may be missing a lookahead must see to be deep enough.
        stop_at: how much may be missing where training ends; None: nothing ends it.
    """

    def __init__(
        self,
        look: PolicyLookahead,
        certificates: Certificates,
        *,
        depths: Sequence[int],
        tolerance: float,
        stop_at: float | None,
    ) -> None:
        self.look, self._certificates = look, certificates
        self.depths, self.tolerance, self.stop_at = depths, tolerance, stop_at

    def __call__(self, experience: Rollout, pi_NA: Float[Tensor, "N A"], draws: Draws) -> Chosen:
        """The lookahead from the distinct visited states.

        Args:
            experience: episodes of the policy.
            pi_NA: the policy in the states, ascending.
            draws: of the iteration; all its searches see the same samples, so that their differences are not noise.

        Raises:
            NotFinite: v(s) = <pi(.|s), Q(s, .)> is not.
        """
        state_N, occupancy_N = experience.visits("occupancy")
        shallow = self.look.in_parts(state_N, 0, draws.search())
        v_N = policy_mean(pi_NA, shallow.q_BA)
        check_finite("value", "the policy's value", v_N, state_N)
        starts = self._certificates.starts(experience, state_N, v_N)
        for depth in self.depths:
            look = self.look.in_parts(state_N, depth, draws.search()) if depth else shallow
            gap_N = (look.q_BA.amax(-1) - v_N).clamp(min=0)
            bound = self._certificates.bound(starts, (state_N, v_N, occupancy_N), look, depth, draws.number + 1)
            is_enough = self.stop_at is not None and bound.certificate <= self.stop_at
            if is_enough or float(gap_N @ occupancy_N) > self.tolerance * bound.visited:
                break
        return Chosen(depth, look, gap_N, bound.certificate, is_enough)
