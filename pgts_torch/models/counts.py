"""A table that counts what followed each state and action, and is optimistic about what it has not seen."""

import copy
import math
from collections import Counter
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.models.base import (
    EnumeratingModel,
    Experience,
    FallibleModel,
    LearningModel,
    SamplingModel,
    Transitions,
)
from pgts_torch.models.optimism import (
    Probabilities,
    extra_visits,
    lasting_worth,
    probabilities,
    reward_limits,
    sampled_probabilities,
)
from pgts_torch.models.outcome_counts import OutcomeCounts
from pgts_torch.models.steps import check_rewards
from pgts_torch.options.models import Counts
from pgts_torch.seeding import uniform
from pgts_torch.tabular.mdp import check_gamma


class _Memory:
    """What a model and its `plain` form have in common.

    sampled: the probabilities that the last `learn` has sampled; None: it samples none.
    since: the visits of each pair after the last `learn`, as far as `is_news` was told of them.
    """

    def __init__(self, sampled: Probabilities | None) -> None:
        self.generation, self.since = 0, Counter[int]()
        self.counts, self.sampled = OutcomeCounts.nothing(), sampled

    def replace(self, counts: OutcomeCounts, sampled: Probabilities | None) -> None:
        self.counts, self.sampled = counts, sampled
        self.generation += 1
        self.since.clear()


@final
class CountsModel(EnumeratingModel, SamplingModel, LearningModel, FallibleModel):
    """A table of S numbered states, which are also the observations, learned by counting.

        P(s', d | s, a) = (1 - u) (n(s, a, s', d) + 1) / (n(s, a) + k),        r(s, a) = sum P r(s, a, s', d) + u worth

    for each of the k outcomes (next state s', discount d) that the pair has had: the mean of the posterior, if all
    their probabilities are equally likely at first (Laplace). With probability u (`Counts.optimism`) there is an
    unknown outcome of discount 0, which pays what it is worth. So optimism (Brafman and Tennenholtz 2002; Strehl and
    Littman 2008; Osband, Russo and Van Roy 2013) is in the outcomes alone.

    Without `value_range` values are at most what the rewards seen so far allow,

        max(0, largest reward at an end, largest other reward / (1 - gamma)),

    and where that is 0 although some reward was 0, max |r| / (1 - gamma), or 1 where all rewards were 0: until
    something is better than nothing, the unknown is. The lower end of the range is the min of the same three. The
    unknown is worth the upper end, and at least twice what the largest reward that ends nothing is worth for ever: else
    it would never be worth leaving the place that pays it.

    A learned table is not exact, has no highest value, and is never certain. Memory grows with the distinct outcomes
    seen.

    Args:
        num_states, num_actions: S and A.
        gamma: discount in [0, 1], for the value range that follows from rewards.
        device: of what it returns; counts are kept on the CPU.

    Raises:
        PgtsError: gamma is 1, and there is no `value_range`.
    """

    dtype = torch.float64
    learns_after_episodes = True

    def __init__(
        self,
        num_states: int,
        num_actions: int,
        *,
        gamma: float,
        options: Counts = Counts(),  # noqa: B008 - frozen
        device: torch.device | str = "cpu",
    ) -> None:
        check_gamma(gamma)
        if gamma == 1 and options.value_range is None:
            raise PgtsError("gamma is 1, so rewards do not bound values: give value_range")
        self.num_states = check_count("num_states", num_states)
        self.num_actions = check_count("num_actions", num_actions)
        self.gamma, self.device = gamma, torch.device(device)
        self.options = options.filled(options.optimism)
        empty = np.empty(0)
        self._memory = _Memory((empty, empty) if options.optimism == "posterior" else None)
        self._columns: tuple[int, tuple[Tensor, ...]] = (-1, ())
        self._errors: tuple[int, Tensor] = (-1, torch.empty(0))

    @property
    def generation(self) -> int:  # type: ignore[override]
        return self._memory.generation

    @property
    def counts(self) -> OutcomeCounts:
        """What was seen so far."""
        return self._memory.counts

    @property
    def num_outcomes(self) -> int:  # type: ignore[override]
        """The largest number of outcomes that a pair has had, and the unknown one."""
        return self.counts.most + 1

    @property
    def value_range(self) -> tuple[float, float]:
        """The lowest and the highest value of a state: as given, or what the rewards seen so far allow."""
        if self.options.value_range is not None:
            return self.options.value_range[0], self.options.value_range[1]
        return reward_limits(self.counts, self.gamma)

    @property
    def unknown_worth(self) -> float:
        """What an unknown outcome is worth."""
        low, high = self.value_range
        if self.options.optimism == "none":
            return low
        return high if self.options.value_range is not None else max(high, 2 * lasting_worth(self.counts, self.gamma))

    def plain(self) -> "CountsModel":
        """The same table without optimism. It goes on learning with this one, and so needs a `Topology` of its own."""
        plain = copy.copy(self)
        plain.options = self.options.model_copy(update={"optimism": "none", "strength": None})
        plain._columns, plain._errors = (-1, ()), (-1, torch.empty(0))
        return plain

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The outcomes seen, and last the unknown one."""
        action_A = torch.arange(self.num_actions, device=self.device)
        return Outcomes(*self._rows(state_N[:, None], action_A), self.num_states)

    def sample(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"], *, key_N: Int[Tensor, "N"]) -> Transitions:
        """One outcome of each (state, action) by inverting the distribution function; the reward is r(s, a)."""
        reward_N, prob_NK, discount_NK, child_NK = self._rows(state_N, action_N)
        cumulative_NK = prob_NK.cumsum(-1)
        # The first k whose cumulative probability exceeds u < total always has positive probability.
        level_N1 = uniform(key_N, self.dtype).unsqueeze(-1) * cumulative_NK[:, -1:]
        k_N1 = (cumulative_NK <= level_N1).sum(-1, keepdim=True)
        return Transitions(reward_N, discount_NK.gather(-1, k_N1)[:, 0], child_NK.gather(-1, k_N1)[:, 0])

    def step_error(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"] | None:
        """e(s, a) for the value range [l, u] and `Counts.confidence` c; None without them. With probability c

            e(s, a) = (u - l) min(1, sqrt( ln(2^{S+1} S A n (n + 1) / (1 - c)) / 2n ) + TV)

        bounds the error for all v in [l, u]^S, all pairs and all n, so whatever the visits were chosen by; n is the
        number of visits, TV the distance in total variation from the shares that were seen (docs/theory.md,
        Sec. 8; Hoeffding's inequality over the corners of the cube, as in Weissman et al. 2003).
        """
        confidence = self.options.confidence
        if confidence is None:
            return None
        if self._errors[0] != self.generation:
            self._errors = self.generation, self._made_errors(confidence)
        return self._errors[1][state_N]

    def learn(self, experience: Experience, *, generator: torch.Generator) -> dict[str, float]:
        """Count these steps; many calls give the bits of one. With optimism posterior also sample new probabilities.

        Returns:
            new_outcomes: how many outcomes had not been seen before. unknown_worth: as it is now.

        Raises:
            PgtsError: they are no steps of numbered states and actions; NotFinite: a reward is not finite. Nothing is
                learned then.
        """
        pair_N, next_N, discount_N, reward_N = self._checked(experience)
        memory, known = self._memory, len(self.counts.pair_C)
        if len(pair_N):
            counts = memory.counts.with_steps(pair_N, next_N, discount_N, reward_N)
            samples = memory.sampled is not None
            memory.replace(counts, sampled_probabilities(self.options, counts, generator) if samples else None)
        return {"new_outcomes": len(memory.counts.pair_C) - known, "unknown_worth": self.unknown_worth}

    def is_news(self, observation_B: Int[Tensor, "B"], action_B: Int[Tensor, "B"]) -> bool:
        """Note steps that are to be learned later. Return whether learning them now would change much.

        It would where a pair is new (with rmax: becomes known), and where a pair has been visited as often since the
        last `learn` as before it, unless no pair has had two outcomes so far.
        """
        memory, news = self._memory, False
        least = 1 + math.floor(extra_visits(self.options, memory.counts)) if self.options.optimism == "rmax" else 1
        for pair in (observation_B * self.num_actions + action_B).tolist():
            memory.since[pair] += 1
            before = memory.counts.visits(pair)
            now = before + memory.since[pair]
            news |= now >= least and (before < least or (memory.counts.most > 1 and now >= 2 * before))
        return news

    def state_dict(self) -> dict[str, Any]:
        """Return counts and rewards of the outcomes seen, and probabilities that were sampled."""
        sampled = dict(zip(("share_C", "unknown_C"), self._memory.sampled or (), strict=False))
        return self.counts.state_dict() | {name: torch.from_numpy(x_C.copy()) for name, x_C in sampled.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned.

        Raises:
            PgtsError: it is not the state of such a table; nothing is loaded.
        """
        counts = OutcomeCounts.from_state_dict(state, self.num_states, self.num_actions)
        sampled: list[np.ndarray] = []
        for name in () if self._memory.sampled is None else ("share_C", "unknown_C"):
            x_C = state.get(name)
            if not isinstance(x_C, Tensor) or x_C.shape != counts.pair_C.shape or not bool((x_C >= 0).all()):
                raise PgtsError(f"{name} is no sampled probability of each outcome, which optimism posterior has")
            sampled.append(x_C.cpu().numpy().copy())
        self._memory.replace(counts, (sampled[0], sampled[1]) if sampled else None)

    def _rows(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Reward, and probability, discount and next state of the outcomes, of pairs in any shape X."""
        if self._columns[0] != self.generation:
            self._columns = self.generation, self._made_columns()
        pair_C, share_C, unknown_C, reward_C, worth_C, discount_C, next_C = self._columns[1]
        pair_X = state * self.num_actions + action
        first_X = torch.searchsorted(pair_C, pair_X)
        # Rows of pairs of fewer outcomes, and of none, end in the row behind all others, which has probability 0.
        row_XK = first_X.unsqueeze(-1) + torch.arange(self.num_outcomes, device=self.device)
        row_XK = row_XK.clamp(max=len(pair_C) - 1)
        row_XK = torch.where(pair_C[row_XK] == pair_X.unsqueeze(-1), row_XK, len(pair_C) - 1)
        reward_X = reward_C[row_XK].sum(-1) + worth_C[row_XK[..., 0]]
        # No pair fills all places: the last one is that of the unknown outcome, of discount 0.
        prob_XK = share_C[row_XK]
        prob_XK[..., -1] = unknown_C[row_XK[..., 0]]
        child_XK = torch.where(row_XK < len(pair_C) - 1, next_C[row_XK], state.unsqueeze(-1))
        return reward_X, prob_XK, discount_C[row_XK], child_XK

    def _made_columns(self) -> tuple[Tensor, ...]:
        """Pair, probability, probability of the unknown, what the outcome and the unknown add to r(s, a), discount and
        next state of each outcome; and last of a pair that was never visited."""
        counts, worth = self.counts, self.unknown_worth
        share_C, unknown_C = self._probabilities()
        reward_C, worth_C = share_C * counts.reward_C, unknown_C * worth
        columns = counts.pair_C, share_C, unknown_C, reward_C, worth_C, counts.discount_C, counts.next_C
        last = self.num_states * self.num_actions, 0, 1, 0, worth, 0, 0
        padded = (np.append(x_C, np.asarray(x, dtype=x_C.dtype)) for x_C, x in zip(columns, last, strict=True))
        return tuple(torch.from_numpy(x_C).to(self.device) for x_C in padded)

    def _probabilities(self) -> Probabilities:
        if self.options.optimism != "posterior":
            return probabilities(self.options, self.counts)
        assert self._memory.sampled is not None
        return self._memory.sampled

    def _made_errors(self, confidence: float) -> Float[Tensor, "S A"]:
        """`step_error` of all states, as a share of the range for each pair, times its width."""
        counts, (low, high) = self.counts, self.value_range
        pairs = self.num_states * self.num_actions
        share_C, unknown_C = self._probabilities()
        n_C = counts.summed(counts.count_C).astype(np.float64)
        surely = math.inf if confidence == 1 else -math.log1p(-confidence)
        log_C = (self.num_states + 1) * math.log(2) + np.log(pairs * n_C * (n_C + 1)) + surely
        moved_C = counts.summed(np.abs(share_C - counts.count_C / n_C)) + unknown_C
        error_P = np.ones(pairs)
        error_P[counts.pair_C] = np.minimum(1, np.sqrt(log_C / (2 * n_C)) + moved_C / 2)
        error_SA = torch.from_numpy((high - low) * error_P).view(self.num_states, self.num_actions)
        return error_SA.to(self.device)

    def _checked(self, experience: Experience) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Pairs, next states, discounts and rewards."""
        S, A = self.num_states, self.num_actions
        limits = {"observation_N": S, "action_N": A, "next_observation_N": S}
        steps = experience.of_all()._asdict()
        columns = {name: column.cpu().numpy() for name, column in steps.items() if name != "ranks"}
        shape = columns["action_N"].shape
        for name, limit in limits.items():
            number_N = columns[name]
            if number_N.ndim != 1 or number_N.shape != shape or not np.issubdtype(number_N.dtype, np.integer):
                raise PgtsError(
                    f"{name} is {number_N.dtype} of shape {number_N.shape}; a table of counts needs numbered states "
                    "and actions; take the model ensemble for vectors"
                )
            off = np.flatnonzero((number_N < 0) | (number_N >= limit))
            if len(off):
                raise PgtsError(f"{name}[{off[0]}] is {number_N[off[0]]}; it must be 0 to {limit - 1}")
        reward_N, discount_N = (columns[name].astype(np.float64) for name in ("reward_N", "discount_N"))
        check_rewards(reward_N)
        off = np.flatnonzero(~((discount_N >= 0) & (discount_N <= 1)))
        if len(off):
            raise PgtsError(f"discount_N[{off[0]}] is {discount_N[off[0]]}; it must be in [0, 1]")
        if needs_range := [name for name in ("confidence", "certificate") if getattr(self.options, name) is not None]:
            # What a step makes of the lowest and of the highest value.
            (low, high), slack = self.value_range, 1e-9 * sum(map(abs, self.value_range))
            off = np.flatnonzero(
                (reward_N + discount_N * low < low - slack) | (reward_N + discount_N * high > high + slack)
            )
            if len(off):
                raise PgtsError(
                    f"reward_N[{off[0]}] is {reward_N[off[0]]}, with discount {discount_N[off[0]]}: from a value in "
                    f"value_range, which is {[low, high]}, such a step leads out of it, which {needs_range[0]} rules "
                    "out: widen it"
                )
        pair_N = columns["observation_N"].astype(np.int64) * A + columns["action_N"]
        return pair_N, columns["next_observation_N"].astype(np.int64), discount_N, reward_N
