"""Certificates: upper bounds on the optimality gap J* - J^pi, from what a lookahead has expanded."""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.critics import Critic, ExactCritic
from pgts_torch.agent.policies import fitting
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.roots import Roots
from pgts_torch.agent.world import ModelWorld
from pgts_torch.errors import PgtsError
from pgts_torch.ranks import Ranks
from pgts_torch.search.engine import Search
from pgts_torch.search.lookahead import Lookahead
from pgts_torch.search.upper import UpperBound

Trust = Literal["proved", "critic", "sampled starts", "posterior"]
"""How far a certificate can be trusted. "proved": it is a proof. "critic": up to the critic's error at start states.
"sampled starts": up to that error, and with 95 % confidence, because start states are known from episodes only.
"posterior": with a posterior probability, given what a learned table has counted (`PosteriorCertificate`)."""

CONFIDENCE = 0.95
"""The probability that all certificates of a run hold together, where start states are sampled."""


class Bound(NamedTuple):
    """Bounds on the optimality gap of a policy after a lookahead.

    certificate: an upper bound on J* - J^pi; infinite where there is none.
    visited: sum_s d(s) (v_hat(s) - v(s)) over the occupancy d of the visited states, an upper bound on their summed
        optimality gap, by which an adaptive depth is chosen; infinite where the model has no `highest_value`.
    """

    certificate: float
    visited: float


class _Starts(NamedTuple):
    """Start states, their probabilities (or frequencies among `num_episodes` episodes), and v there.

    v_N: None where v is unknown at some of them.
    """

    state_N: Int[Tensor, "N"]
    prob_N: Float[Tensor, "N"]
    v_N: Float[Tensor, "N"] | None
    num_episodes: int


@final
class Certificates:
    """Computes upper bounds on J* - J^pi from the outcomes that a search has queried, without further model calls.

    Where the start distribution mu is known, with v_hat that of `UpperBound`,

        J* - J^pi <= sum_s mu(s) [ v_hat(s) - v(s) ]        [docs/theory.md, Prop. 6]

    over all start states. The bound is right up to the error of v against v^pi there, and a proof if the critic is
    exact and the model is the environment. Rounding is added: the critic's own `error`, and (N + 2) eps sum_s mu(s)
    (|v_hat(s)| + |v(s)|) for the sum over N start states. The absolute differences are summed, because a critic whose v
    exceeds v_hat is wrong by at least the difference.

    Where mu is not known, the starts of the n episodes are independent samples from it, made after pi was fixed, and f
    = T^n w - v^pi has values in [0, w - l], with l the model's `lowest_value`. So with a probability of 95 % for all
    iterations k = 1, 2, ... and all D depths that each may try (Hoeffding 1963)

        J* - J^pi <= mean f + (w - l) sqrt( ln(1 / alpha_k) / 2n ),        alpha_k = 0.05 (6 / pi^2 k^2) / D

    with v in place of v^pi: the error of the critic at the sampled starts comes on top. The certificate is infinite
    where the bound is no smaller than the trivial one, w - l, and where the lookahead has pruned nodes, because T^n w
    would then depend on the other start states.

    Each of several processes computes v_hat from what it has queried itself. Where they number states alike the
    smallest is used; else each has it at the states that it has visited, and sums are over all.

    Args:
        world: gives the start distribution.
        search: the bounds are computed from the outcomes that it has queried.
        critic: gives v.
        num_depths: D.
        ranks: all of them get the same bounds.
        samples_starts: whether the episodes begin in start states; if not, and mu is not known, there is no bound.
    """

    def __init__(
        self,
        world: ModelWorld,
        search: Search,
        critic: Critic,
        *,
        num_depths: int,
        ranks: Ranks,
        samples_starts: bool = True,
    ) -> None:
        self._world, self._search, self._critic, self._samples_starts = world, search, critic, samples_starts
        self._num_depths, self._ranks = num_depths, ranks
        self._upper: UpperBound | None = None

    @property
    def trust(self) -> Trust:
        """How far the certificates can be trusted."""
        if self._world.start_S is None:
            return "sampled starts"
        return "proved" if self._critic.is_exact and self._search.model.exact else "critic"

    def check(self, wanted: str) -> None:
        """PgtsError if all certificates of this search and model are infinite.

        Args:
            wanted: the option that needs a finite one, as the beginning of the message.
        """
        model = self._search.model
        if self._world.start_S is None and not self._samples_starts:
            raise PgtsError(
                f"{wanted}; with replay no upper bound on the optimality gap is known, because start states are known "
                "from episodes only, and imagined ones begin elsewhere: take a fixed depth without stop_at"
            )
        if self._search.topology is None:
            raise PgtsError(
                f"{wanted}; a search that samples outcomes gives no upper bound on the optimality gap: take a search "
                "that enumerates outcomes, or a fixed depth without stop_at"
            )
        if model.highest_value < math.inf:
            return
        if getattr(model, "action_repeat", 1) > 1:
            why = f"action_repeat is {model.action_repeat}, and values of repeated actions have no bound: take 1"
        elif self._world.gamma >= 1 and (model.reward_range is None or model.reward_range.high > 0):
            why = (
                "gamma is 1, with which rewards may add up without limit: take a gamma below 1, or, if no reward is "
                "positive, a reward_range (env.reward_range) up to 0"
            )
        else:
            why = (
                "that needs the largest reward, which the model of this environment does not know: set reward_range "
                "(env.reward_range) to the lowest and the highest reward of a single step"
            )
        raise PgtsError(
            f"{wanted}, which needs an upper bound on the optimality gap. But {why}; or take a fixed depth without "
            "stop_at"
        )

    def starts(self, experience: Rollout, roots: Roots, v_N: Float[Tensor, "N"]) -> _Starts:
        """Return the start states and v there: all of them where mu is known, else those of the episodes, if the
        lookahead starts from them.

        Args:
            roots: the visited states that this process looks ahead from.
            v_N: v there, from the lookahead of depth 0.
        """
        start_S, num_episodes, ranks = self._world.start_S, experience.whole.episodes, experience.ranks
        if start_S is None and not roots.are_all:
            return _Starts(roots.state_N[:0], roots.weight_N[:0].double(), None, 0)
        if start_S is None:
            first_B = experience.state_TB[0]
            if experience.searched_TB is not None:
                first_B = first_B[experience.searched_TB[0]]
            if self._world.keeps_numbers:
                [first_B] = ranks.rows("first states", first_B)
            starts, count_N = first_B.unique(return_counts=True)
            total = len(first_B) if self._world.keeps_numbers else int(ranks.totals("starts", len(first_B))[0])
            v_of_starts = self._of_visited(roots, v_N, ranks)(starts)
            assert v_of_starts is not None
            return _Starts(starts, count_N.double() / total, v_of_starts.double(), total)
        starts = torch.nonzero(start_S).flatten()
        if not self._critic.samples_when_queried:
            v_of_starts = self._critic.v(self._world.observe(starts))
        else:
            v_of_starts = self._of_visited(roots, v_N, ranks)(starts)
        return _Starts(starts, start_S[starts], None if v_of_starts is None else v_of_starts.double(), num_episodes)

    def _of_visited(self, roots: Roots, v_N: Tensor, ranks: Ranks) -> Callable[[Tensor], Tensor | None]:
        """v of states, from its values at those that were visited; None where some were not."""
        state_N = roots.state_N
        if self._world.keeps_numbers and ranks.size > 1:
            state_N, v_N = ranks.rows("values", state_N, v_N)
            state_N, order_N = state_N.sort()
            v_N = v_N[order_N]

        def read(asked_N: Tensor) -> Tensor | None:
            return v_N[torch.searchsorted(state_N, asked_N)] if bool(torch.isin(asked_N, state_N).all()) else None

        return read

    def bound(
        self,
        starts: _Starts,
        roots: Roots,
        root_v_N: Float[Tensor, "N"],
        look: Lookahead,
        depth: int,
        number: int,
    ) -> Bound:
        """Return upper bounds on the optimality gap after a lookahead.

        Args:
            starts: what `starts` returned.
            root_v_N: v where this process looks ahead.
            depth: its depth m; n is m, or m + 1 where the critic learns v.
            number: of the iteration, from 1.
        """
        state_N, prob_N, v_N, num_episodes = starts
        if self._search.topology is None:
            return Bound(math.inf, math.inf)
        expansions = depth + (self._critic.target == "v")
        both_N = torch.cat([state_N, roots.visited_M])

        def tightened(upper: UpperBound) -> Tensor:
            upper.tighten(expansions)
            return upper.at(both_N)

        upper_N, upper_M = self._smallest(tightened).split([len(state_N), len(roots.visited_M)])
        above_N = (upper_M[roots.own_N] - root_v_N.double()).abs()
        [gap] = self._ranks.totals("missing", roots.occupancy_N.double() @ above_N)
        if v_N is None:
            return Bound(math.inf, gap)
        if self._world.start_S is not None:
            return Bound(self._over_all(prob_N, upper_N, v_N), gap)
        estimate = self._sum(prob_N @ (upper_N - v_N).abs())
        span = self._search.model.highest_value - self._search.model.lowest_value
        width = self.width(num_episodes, number)
        is_complete = self._ranks.totals("pruned", (look.pruned_BA > 0).sum()) == [0]
        # T^n w is no smaller than v_hat
        if not (self._samples_starts and is_complete and estimate + width < span):
            return Bound(math.inf, gap)
        swept_N = self._smallest(lambda upper: upper.swept(state_N, expansions))
        certificate = self._sum(prob_N @ (swept_N - v_N).abs()) + width
        return Bound(certificate if certificate < span else math.inf, gap)

    def gap_bound(self, starts: _Starts, roots: Roots, look: Lookahead, depth: int, number: int) -> float:
        """An estimate of an upper bound on J* - J^pi for any search, from the gap alone [docs/theory.md, Prop. 13]

            sum_s mu(s) min( max_a [ upper end of q(s, a) ] + (gamma^n + pruned(s)) (w - l) - v(s),  w - v(s) )

        with the upper end of `Lookahead.interval`; w - v(s) where this iteration has not looked ahead from s. It is
        what is seen, and what may lie behind the n expanded levels or what was pruned. It leaves out by how much v
        exceeds v^pi, which a run does not know, and adds the confidence term where starts are sampled. Infinite where
        values have no known range, and where it is no smaller than the mean of w - v(s).

        Args: those of `bound`.
        """
        state_N, prob_N, v_N, num_episodes = starts
        model, is_known = self._search.model, self._world.start_S is not None
        w, span = model.highest_value, model.highest_value - model.lowest_value
        if v_N is None or not math.isfinite(span) or not (is_known or self._samples_starts):
            return math.inf
        upper_N = torch.full_like(v_N, w)
        if len(roots.state_N):
            pruned_BA = torch.where(look.q_BA > -math.inf, look.pruned_BA, 0.0)
            unseen_B = self._world.gamma ** (depth + (self._critic.target == "v")) + pruned_BA.amax(-1).double()
            most_B = (look.interval()[1].amax(-1).double() + unseen_B * span).nan_to_num(math.inf).clamp(max=w)
            row_N = torch.searchsorted(roots.state_N, state_N).clamp(max=len(roots.state_N) - 1)
            upper_N = torch.where(roots.state_N[row_N] == state_N, most_B[row_N], upper_N)
        if self._world.keeps_numbers:
            upper_N = self._ranks.least("upper ends", upper_N)
        bound = self._sum(prob_N @ (upper_N - v_N)) + (0.0 if is_known else self.width(num_episodes, number))
        return bound if bound < self._sum(prob_N @ (w - v_N)) else math.inf

    def _sum(self, missing: Tensor) -> float:
        """What is missing at all start states, from that at those of this process."""
        return float(missing) if self._world.keeps_numbers else self._ranks.totals("starts", missing)[0]

    def width(self, num_episodes: int, number: int = 1) -> float:
        """The confidence term (w - l) sqrt( ln(1 / alpha_k) / 2n ); no certificate from sampled starts is below it."""
        alpha = (1 - CONFIDENCE) * 6 / (math.pi * number) ** 2 / self._num_depths
        span = self._search.model.highest_value - self._search.model.lowest_value
        return span * math.sqrt(-math.log(alpha) / (2 * num_episodes))

    def of(self, pi_SA: Float[Tensor, "S A"]) -> float:
        """The certificate of a policy, from all outcomes that this rank has queried; infinite unless it is a proof."""
        start_S, critic = self._world.start_S, self._critic
        if self.trust != "proved" or self._search.topology is None:
            return math.inf
        assert isinstance(critic, ExactCritic)
        assert start_S is not None
        critic.solve(pi_SA)
        starts = torch.nonzero(start_S).flatten()
        return self._over_all(start_S[starts], self._own_bound().at(starts), critic.v(starts))

    def _over_all(self, prob_N: Tensor, upper_N: Tensor, v_N: Tensor) -> float:
        """sum_s mu(s) [ v_hat(s) - v(s) ], rounded up; infinite where a term is."""
        rounding = (len(prob_N) + 2) * torch.finfo(torch.float64).eps
        size = float(prob_N @ (upper_N.abs() + v_N.abs()))
        error = self._critic.error if self._critic.is_exact else 0.0
        return float(prob_N @ (upper_N - v_N).abs()) + rounding * size + error

    def state_dict(self, *, with_states: bool) -> dict[str, Any]:
        """Return the state that later certificates depend on.

        Args:
            with_states: whether states keep their numbers; else the bounds last for one iteration and are not saved.
        """
        is_known = self._upper is not None and self._upper.w < math.inf
        return self._upper.state_dict() if self._upper is not None and is_known and with_states else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned. The state of the search must have been loaded before."""
        self._upper = None
        if state:
            assert self._search.topology is not None
            each = torch.empty(len(self._search.topology.table.queried), dtype=torch.float64)
            values = {name: fitting(state, name, each) for name in ("bound", "below")}
            if not all(bool(value.isfinite().all()) for value in values.values()):
                raise PgtsError("the upper bounds of a saved search are not finite")
            self._own_bound().load_state_dict(
                {**values, **{name: state.get(name) is True for name in ("settled", "current")}}
            )

    def _smallest(self, read: Callable[[UpperBound], Tensor]) -> Float[Tensor, "N"]:
        """The values that `read` returns of the upper bound; where all processes number states alike, the elementwise
        minimum over theirs."""
        own_N = read(self._own_bound())
        return self._ranks.least("upper bounds", own_N) if self._world.keeps_numbers else own_N

    def _own_bound(self) -> UpperBound:
        """The upper bound from what this rank has queried; a new one after the search was reset."""
        topology, model = self._search.topology, self._search.model
        assert topology is not None
        if self._upper is None or self._upper.topology is not topology:
            self._upper = UpperBound(topology, model.highest_value, gamma=self._world.gamma)
        return self._upper
