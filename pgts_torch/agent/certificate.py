"""What a lookahead proves: an upper bound on what is missing to the optimum."""

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.critics import Critic, ExactCritic
from pgts_torch.agent.policies import fitting
from pgts_torch.agent.ranks import Ranks
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import ModelWorld
from pgts_torch.errors import PgtsError
from pgts_torch.search.engine import Search
from pgts_torch.search.lookahead import Lookahead
from pgts_torch.search.upper import UpperBound

Trust = Literal["proved", "critic", "drawn starts"]
"""How far a certificate can be trusted: it is a proof; it is off by what the critic is off at the start states; the
same, and with a confidence of 95 % only, because the starts are known from episodes."""

CONFIDENCE = 0.95
"""Of all certificates of a run together, where starts are drawn."""


class Bound(NamedTuple):
    """certificate: an upper bound on J* - J^pi; infinite where there is none.

    visited: what may be missing at the visited states, sum_s d(s) (v_hat(s) - v(s)) over their occupancy d, by which an
        adaptive depth is chosen; infinite where no largest value is known.
    """

    certificate: float
    visited: float


class _Starts(NamedTuple):
    """Start states, the share of each, v there (None: v is unknown at some of them), and the episodes they are of."""

    state_N: Int[Tensor, "N"]
    share_N: Float[Tensor, "N"]
    v_N: Float[Tensor, "N"] | None
    num_episodes: int


@final
class Certificates:
    """Bounds on what is missing to the optimum, from what a search has asked of its model. They ask it nothing.

    Where the start distribution mu is known, with v_hat that of `UpperBound`,

        J* - J^pi <= sum_s mu(s) [ v_hat(s) - v(s) ]        [docs/theory.md, Prop. 6]

    over all start states, whether an episode has begun there or not. It is true as far as v is v^pi there, and a proof
    if the critic is exact and the model is the environment. All sums are rounded outward: by the critic's own `error`,
    and by (N + 2) eps sum_s mu(s) (|v_hat(s)| + |v(s)|) for the sum over N starts. Where a critic says more than v_hat
    it is off by at least the difference, which then counts in place of what is missing.

    Where mu is not known the starts of the n episodes are fresh draws from it, made after pi was fixed. f = T^n w -
    v^pi is a function of the start that no draw has changed, with values in [0, w - l], l the model's `lowest_value`.
    So with a probability of 95 % for all iterations k = 1, 2, ... and all D depths that each may try (Hoeffding 1963)

        J* - J^pi <= mean f + (w - l) sqrt( ln(1 / alpha_k) / 2n ),        alpha_k = 0.05 (6 / pi^2 k^2) / D

    The certificate has v in place of v^pi, which the critic has fitted to these very episodes: it is off by the mean of
    v - v^pi over the drawn starts. A bound of w - l or more says nothing and is infinite, as it is where the lookahead
    has left out nodes: then T^n w would depend on what the other starts are.

    Several ranks have asked about different states. Each makes v_hat from its own, and the smallest counts.

    Args:
        world: says which starts there are.
        search: what it has asked is what the bounds stand on.
        critic: of v.
        num_depths: D.
        ranks: all of them get the same bounds.
    """

    def __init__(self, world: ModelWorld, search: Search, critic: Critic, *, num_depths: int, ranks: Ranks) -> None:
        self._world, self._search, self._critic = world, search, critic
        self._num_depths, self._ranks = num_depths, ranks
        self._upper: UpperBound | None = None

    @property
    def trust(self) -> Trust:
        """How far the certificates can be trusted."""
        if self._world.start_S is None:
            return "drawn starts"
        return "proved" if self._critic.is_exact and self._search.model.exact else "critic"

    def check(self, wanted: str) -> None:
        """PgtsError if there is no bound, and never will be.

        Args:
            wanted: what needs one.
        """
        model = self._search.model
        if self._search.topology is None:
            raise PgtsError(
                f"{wanted}; where outcomes are drawn nothing bounds what is missing to the optimum: take a search that "
                "lists outcomes, or a fixed depth without stop_at"
            )
        if model.highest_value < math.inf:
            return
        if getattr(model, "action_repeat", 1) > 1:
            why = f"action_repeat is {model.action_repeat}, and repeated actions bound nothing: take 1"
        elif self._world.gamma >= 1 and (model.reward_range is None or model.reward_range.high > 0):
            why = (
                "gamma is 1, with which rewards may add up without limit: take a gamma below 1, or, if no reward is "
                "positive, a reward_range (env.reward_range) up to 0"
            )
        else:
            why = (
                "it takes a largest reward, which the model of this environment does not know: set reward_range "
                "(env.reward_range) to the lowest and the highest reward of a single step"
            )
        raise PgtsError(
            f"{wanted}, for which what is missing to the optimum must be bounded. But {why}; or take a fixed "
            "depth without stop_at"
        )

    def starts(self, experience: Rollout, state_N: Int[Tensor, "N"], v_N: Float[Tensor, "N"]) -> _Starts:
        """The start states of an iteration, and v there.

        Args:
            experience: whose starts count where no others are known.
            state_N, v_N: the visited states, ascending, and v there by the lookahead of depth 0.
        """
        start_S, num_episodes = self._world.start_S, experience.num_episodes
        if start_S is None:
            starts, count_N = experience.state_TB[0].unique(return_counts=True)
            v_of_starts = v_N[torch.searchsorted(state_N, starts)]
            return _Starts(starts, count_N.double() / num_episodes, v_of_starts.double(), num_episodes)
        starts = torch.nonzero(start_S).flatten()
        if not self._critic.draws_when_asked:
            v_of_starts = self._critic.v(self._world.observe(starts))
        elif bool(torch.isin(starts, state_N).all()):
            v_of_starts = v_N[torch.searchsorted(state_N, starts)]
        else:
            return _Starts(starts, start_S[starts], None, num_episodes)
        return _Starts(starts, start_S[starts], v_of_starts.double(), num_episodes)

    def bound(
        self,
        starts: _Starts,
        visited: tuple[Int[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N"]],
        look: Lookahead,
        depth: int,
        number: int,
    ) -> Bound:
        """What is missing at most, after a lookahead.

        Args:
            starts: see `starts`.
            visited: the visited states, v there, and their occupancy.
            look: the lookahead.
            depth: m, of which it is; so n is m, or m + 1 where the critic learns v.
            number: of the iteration, from 1.
        """
        state_N, share_N, v_N, num_episodes = starts
        if self._search.topology is None:
            return Bound(math.inf, math.inf)
        expansions = depth + (self._critic.target == "v")
        visited_N, v_of_visited_N, occupancy_N = visited
        both_N = torch.cat([state_N, visited_N])

        def tightened(upper: UpperBound) -> Tensor:
            upper.tighten(expansions)
            return upper.at(both_N)

        upper_N, upper_of_visited_N = self._together(tightened).split([len(state_N), len(visited_N)])
        missing = float(occupancy_N.double() @ (upper_of_visited_N - v_of_visited_N.double()).abs())
        if v_N is None:
            return Bound(math.inf, missing)
        if self._world.start_S is not None:
            return Bound(self._over_all(share_N, upper_N, v_N), missing)
        estimate = float(share_N @ (upper_N - v_N).abs())
        span = self._search.model.highest_value - self._search.model.lowest_value
        width = self.width(num_episodes, number)
        is_complete = float(look.pruned_BA.max()) == 0
        if not (is_complete and estimate + width < span):  # T^n w is no smaller than v_hat
            return Bound(math.inf, missing)
        swept_N = self._together(lambda upper: upper.swept(state_N, expansions))
        certificate = float(share_N @ (swept_N - v_N).abs()) + width
        return Bound(certificate if certificate < span else math.inf, missing)

    def width(self, num_episodes: int, number: int = 1) -> float:
        """What drawn starts put in doubt in an iteration, which no certificate from them is below: see above."""
        alpha = (1 - CONFIDENCE) * 6 / (math.pi * number) ** 2 / self._num_depths
        span = self._search.model.highest_value - self._search.model.lowest_value
        return span * math.sqrt(-math.log(alpha) / (2 * num_episodes))

    def of(self, pi_SA: Float[Tensor, "S A"]) -> float:
        """The certificate of a policy, from all that this rank has asked so far; infinite unless it is a proof."""
        start_S, critic = self._world.start_S, self._critic
        if self.trust != "proved" or self._search.topology is None:
            return math.inf
        assert isinstance(critic, ExactCritic)
        assert start_S is not None
        critic.solve(pi_SA)
        starts = torch.nonzero(start_S).flatten()
        return self._over_all(start_S[starts], self._own().at(starts), critic.v(starts))

    def _over_all(self, share_N: Tensor, upper_N: Tensor, v_N: Tensor) -> float:
        """sum_s mu(s) [ v_hat(s) - v(s) ], rounded up; infinite where one of them is."""
        rounding = (len(share_N) + 2) * torch.finfo(torch.float64).eps
        size = float(share_N @ (upper_N.abs() + v_N.abs()))
        error = self._critic.error if self._critic.is_exact else 0.0
        return float(share_N @ (upper_N - v_N).abs()) + rounding * size + error

    def state_dict(self, *, with_states: bool) -> dict[str, Any]:
        """What later certificates depend on.

        Args:
            with_states: whether states keep their numbers; else nothing outlives an iteration.
        """
        is_known = self._upper is not None and self._upper.w < math.inf
        return self._upper.state_dict() if self._upper is not None and is_known and with_states else {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave; the search has taken over what it asked about."""
        self._upper = None
        if state:
            assert self._search.topology is not None
            each = torch.empty(len(self._search.topology.queried), dtype=torch.float64)
            values = {name: fitting(state, name, each) for name in ("bound", "below")}
            if not all(bool(value.isfinite().all()) for value in values.values()):
                raise PgtsError("the upper bounds of a saved search are not finite")
            self._own().load_state_dict(
                {**values, **{name: state.get(name) is True for name in ("settled", "current")}}
            )

    def _together(self, read: Callable[[UpperBound], Tensor]) -> Float[Tensor, "N"]:
        """The smallest of what is read from the bounds of all ranks."""
        each = self._ranks.gather("certificate", lambda: read(self._own()).cpu())
        return torch.stack(each).amin(0).to(self._world.device)

    def _own(self) -> UpperBound:
        """The bound over what this rank has asked; anew where states are numbered anew."""
        topology, model = self._search.topology, self._search.model
        assert topology is not None
        if self._upper is None or self._upper.topology is not topology:
            self._upper = UpperBound(topology, model.highest_value, gamma=self._world.gamma)
        return self._upper
