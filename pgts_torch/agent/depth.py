"""The choice of the lookahead's depth in an iteration: fixed, or the smallest that improves the policy enough."""

import math
from collections.abc import Sequence
from typing import NamedTuple, final

from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.certificate import Certificates
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.policy_lookahead import PolicyLookahead
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.roots import Roots
from pgts_torch.bellman import policy_mean
from pgts_torch.readings import Readings
from pgts_torch.search.lookahead import Lookahead, check_finite


class Chosen(NamedTuple):
    """The lookahead of an iteration, at the depth chosen.

    depth: m.
    look: (T^m Q)(s, .) at the visited states.
    gap_N: max_a (T^m Q)(s, a) - v(s) >= 0 there.
    certificate: an upper bound on J* - J^pi.
    gap_bound: an estimate of one from the gap, where there is no certificate; else infinite.
    is_enough: whether the certificate is at most `stop_at`, so that the policy needs no further update.
    """

    depth: int
    look: Lookahead
    gap_N: Float[Tensor, "N"]
    certificate: float
    gap_bound: float
    is_enough: bool


@final
class DepthChoice:
    """Computes the lookahead from the visited states at a fixed depth m, or at the smallest that finds a large gap.

    A policy that is far from stationary at depth m needs no deeper lookahead. So depths are tried in order, until

        sum_s d(s) g_m(s) > tolerance * sum_s d(s) (v_hat(s) - v(s)),        g_m(s) = max_a (T^m Q)(s, a) - v(s)

    with the upper bound v_hat >= v* of the certificate, or until the certificate is at most `stop_at`.

    Args:
        certificates: upper bounds from the outcomes that it has queried.
        depths: the depths that are tried, in this order; a single one if it is fixed.
        tolerance: the fraction of the bound that the gap must exceed for a depth to be chosen.
        stop_at: training ends once the certificate is at most this; None: it does not.
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

    def __call__(self, experience: Rollout, roots: Roots, pi_NA: Float[Tensor, "N A"], draws: Draws) -> Chosen:
        """Return the lookahead from distinct visited states. All processes choose the same depth.

        Args:
            draws: the random generators of the iteration; all its searches get the same samples, so that their
                differences are not noise.

        Raises:
            NotFinite: v(s) = <pi(.|s), Q(s, .)> is not finite.
        """
        state_N, ranks, readings = roots.state_N, experience.ranks, Readings()
        shallow = self.look(state_N, depth=0, generator=draws.search(), readings=readings)
        v_N = policy_mean(pi_NA, shallow.q_BA)
        check_finite("value", "the policy's value", v_N, state_N, readings)
        readings.read()
        starts = self._certificates.starts(experience, roots, v_N)
        for depth in self.depths:
            look = self.look(state_N, depth=depth, generator=draws.search(), readings=readings) if depth else shallow
            readings.read()
            gap_N = (look.q_BA.amax(-1) - v_N).clamp(min=0)
            bound = self._certificates.bound(starts, roots, v_N, look, depth, draws.number + 1)
            is_enough = self.stop_at is not None and bound.certificate <= self.stop_at
            if is_enough or depth == self.depths[-1]:
                break
            [gap] = ranks.totals("gap", gap_N.double() @ roots.occupancy_N)
            if gap > self.tolerance * bound.visited:
                break
        estimate = math.inf
        if math.isinf(bound.certificate):
            estimate = self._certificates.gap_bound(starts, roots, look, depth, draws.number + 1)
        return Chosen(depth, look, gap_N, bound.certificate, estimate, is_enough)
