"""Models whose states are vectors and whose actions have one outcome: simulators written in torch."""

from abc import abstractmethod

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Num
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.compiled import pays
from pgts_torch.errors import NotFinite, PgtsError, check_count
from pgts_torch.models.base import EnumeratingModel, FollowingModel, Transitions
from pgts_torch.models.exact_model import CONTRADICTED, Happened, step_text
from pgts_torch.models.state_index import Merge, StateIndex, index_loops

_SURVEYED = {torch.float32, torch.float64, torch.int64}
"""Dtypes of what a compiled loop can look through."""

_ROUNDING = 1e-12
"""By how much dynamics that do the same arithmetic in another order, or on another device, may be off."""


class TensorModel(EnumeratingModel, FollowingModel):
    """Deterministic dynamics over vectors of D numbers. A subclass defines `step`; this class numbers states as it
    meets them, equal ones alike, so that a search merges them. Memory grows with every new state until `clear`.

    With `action_repeat` k > 1 an outcome is that of taking the same action k times, so that a search of little depth
    sees rewards that are far ahead:

        r = sum_{i<k} gamma_0 ... gamma_{i-1} r_i,    discount = gamma_0 ... gamma_{k-1},    next state s_k

    It ends early where an episode terminates (discount 0) and before a step in which the action is not allowed. T is
    then the optimality operator T_k of the semi-MDP of these options (Sutton, Precup and Singh 1999):

    - with `q_leaf` a search gives T_k^m Q^pi; with `v_leaf` T_k^m Q_k, where Q_k(s, a), the value of a taken k times
      and pi from there on, is not Q^pi;
    - every value is that of a plan which can be followed, so with an exact critic none is above q*. But pi may be
      better than each repeated action: max_a need not reach v^pi, and a gap of 0 does not put pi into Pi^m;
    - upper bounds of v* do not stay such under T_k, so there is no certificate, and `highest_value` must be infinite.

    A model call is one (state, action) however often it is repeated; `simulator_steps` counts the steps.

    forbids: whether it says which actions are legal, where the environment has no action masks: those whose reward is
        not -inf. A class sets it to True whose rewards may be -inf.

    Args:
        state_size: D, how many numbers a state has.
        num_actions: A; 0: actions are vectors.
        state_dtype: of the vectors: floating, or int64.
        dtype: of rewards, discounts and values.
        merge: whether equal states get one number (`StateIndex`).
        action_repeat: k, at least 1.
    """

    num_outcomes = 1
    forbids: bool = False

    def __init__(
        self,
        state_size: int,
        num_actions: int,
        *,
        state_dtype: torch.dtype = torch.float32,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        merge: Merge = "auto",
        action_repeat: int = 1,
    ) -> None:
        check_count("action_repeat", action_repeat)
        self._index = StateIndex(state_size, dtype=state_dtype, device=device, merge=merge)
        self.state_size, self.state_dtype = state_size, state_dtype
        self.num_actions = num_actions
        self.device = self._index.device
        self.dtype = dtype
        self.action_repeat = action_repeat
        self.is_certain = True
        # Rows n * A + a: n, a, and a probability.
        self._row_N = self._action_N = torch.empty(0, dtype=torch.int64)
        self._one_N = torch.empty(0)
        self.simulator_steps = 0
        """For how many (state, action) `step` was called."""

    @abstractmethod
    def step(
        self, state_ND: Num[Tensor, "N D"], action_N: Num[Tensor, "N ..."]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"], Num[Tensor, "N D"]]:
        """Reward, discount and next state of each (state, action): a function of these and of nothing else.

        Rewards and discounts are of the dtype of the model (`torch.where` of two Python numbers is float32), states of
        the dtype of states. The reward is -inf where the action is not allowed. After a terminal outcome, discount 0,
        the next state may be anything, also nan.
        """

    @torch.no_grad()
    def legal(self, state_ND: Num[Tensor, "N D"]) -> Bool[Tensor, "N A"]:
        """The actions that are allowed in these states, by their rewards; all where none is, as after an end."""
        N, A = state_ND.shape[0], self.num_actions
        reward_N, _, _ = self.step(state_ND.repeat_interleave(A, 0), torch.arange(A, device=self.device).repeat(N))
        legal_NA = (reward_N > -torch.inf).view(N, A)
        return legal_NA | ~legal_NA.any(-1, keepdim=True)

    @property
    def num_states(self) -> int:  # type: ignore[override]
        return self._index.count

    def number(self, state_ND: Num[Tensor, "N D"]) -> Int[Tensor, "N"]:
        """The number of each state; new ones get the next numbers.

        Raises:
            PgtsError: states of a wrong size or dtype, or with a nan (naming the row).
        """
        return self._index.number(state_ND)

    def states(self, state_N: Int[Tensor, "N"]) -> Num[Tensor, "N D"]:
        """The states with these numbers."""
        return self._index.rows(state_N)

    def clear(self) -> None:
        """Drop all states and free their memory. Their numbers are given to other states from here on: a `Topology` of
        this model refuses to go on, and a new one is to be made."""
        self._index.clear()
        self.generation += 1

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The one outcome of each action, K = 1.

        Raises:
            PgtsError: `step` returns a wrong shape or dtype, a discount outside [0, 1], or NaN in a state that counts.
        """
        # Rows n * A + a: every action in the first state, then in the second, ...
        N, A = state_N.shape[0], self.num_actions
        if N * A > self._action_N.shape[0]:
            self._row_N = torch.arange(2 * N, device=self.device).repeat_interleave(A)
            self._action_N = torch.arange(A, device=self.device).repeat(2 * N)
            self._one_N = torch.ones(2 * N * A, dtype=self.dtype, device=self.device)
        pairs = state_N.index_select(0, self._row_N[: N * A]), self._action_N[: N * A]
        reward_N, discount_N, next_N = self._followed(*pairs)
        certain_NAK = self._one_N[: N * A].view(N, A, 1)
        return Outcomes(
            reward_N.view(-1, A), certain_NAK, discount_N.view(-1, A, 1), next_N.view(-1, A, 1), self.num_states
        )

    def sample(
        self, state_N: Int[Tensor, "N"], action_N: Num[Tensor, "N ..."], *, key_N: Int[Tensor, "N"]
    ) -> Transitions:
        """The one outcome of each (state, action), whatever the key; raises as `outcomes` does."""
        return self.follow(state_N, action_N)

    def follow(self, state_N: Int[Tensor, "N"], action_N: Num[Tensor, "N ..."]) -> Transitions:
        return Transitions(*self._followed(state_N, action_N))

    @torch.no_grad()
    def outcome_of(self, happened: Happened, *, query_N: Bool[np.ndarray, "N"] | None = None) -> Int[np.ndarray, "N"]:
        """0 where a step is what `step` gives: the discount exactly, the reward and, unless the episode ended, every
        number of the next state within 1e-12 (1 + its size)."""
        columns = vars(happened).values()
        state_N, action_N, reward_N, discount_N, next_N, _ = (torch.from_numpy(x).to(self.device) for x in columns)
        paid_N, weight_N, ahead_ND = self.step(self.states(state_N), action_N)
        agrees_N = _close(paid_N, reward_N) & (weight_N == discount_N)
        agrees_N &= _close(ahead_ND, self.states(next_N)).all(-1) | (discount_N == 0)
        return torch.where(agrees_N, 0, CONTRADICTED).cpu().numpy()

    def state_text(self, state: int) -> str:
        return f"state {self.states(torch.tensor([state], device=self.device))[0].tolist()}"

    @torch.no_grad()
    def outcomes_text(self, state: int, action: int) -> str:
        state_1D, action_1 = self.states(torch.tensor([state], device=self.device)), torch.tensor([action])
        reward_1, discount_1, next_1D = self.step(state_1D, action_1.to(self.device))
        return step_text(float(reward_1), float(discount_1), f"state {next_1D[0].tolist()}")

    @torch.no_grad()
    def _followed(self, state_N: Tensor, action_N: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Reward, discount and number of the next state; where nothing counts after an outcome, the state itself."""
        reward_N, discount_N, next_ND, all_count = self._stepped(self.states(state_N), action_N)
        for _ in range(self.action_repeat - 1):
            # on: the pairs whose action is taken once more, and then those of them where it is allowed.
            on = torch.nonzero(_counts(reward_N, discount_N)).flatten()
            more_N, then_N, ahead_ND, more_count = self._stepped(
                next_ND.index_select(0, on), action_N.index_select(0, on)
            )
            all_count = all_count and more_count
            allowed_N = more_N > -torch.inf
            if not bool(allowed_N.all()):
                on, more_N, then_N, ahead_ND = (x[allowed_N] for x in (on, more_N, then_N, ahead_ND))
            weight_N = discount_N.index_select(0, on)
            reward_N = reward_N.index_add(0, on, weight_N * more_N)
            discount_N = discount_N.index_copy(0, on, weight_N * then_N)
            next_ND = next_ND.index_copy(0, on, ahead_ND)
        # Next states that count get a number; a terminal one may be anything, and is no state of the model.
        if all_count:
            return reward_N, discount_N, self.number(next_ND)
        counts_N = _counts(reward_N, discount_N)
        next_N = state_N.clone()
        next_N[counts_N] = self.number(next_ND[counts_N])
        return reward_N, discount_N, next_N

    def _stepped(self, state_ND: Tensor, action_N: Tensor) -> tuple[Tensor, Tensor, Tensor, bool]:
        """What `step` returns, checked; and whether all that follows counts."""
        self.simulator_steps += state_ND.shape[0]
        reward_N, discount_N, next_ND = answer = self.step(state_ND, action_N)
        given = reward_N.shape, discount_N.shape, next_ND.shape
        expected = action_N.shape[:1], action_N.shape[:1], state_ND.shape
        if given != expected:
            shapes, must_be = (tuple(map(tuple, each)) for each in (given, expected))
            raise PgtsError(
                f"step returned shapes {shapes}; for {len(action_N)} states and actions they must be {must_be}"
            )
        if not reward_N.dtype == discount_N.dtype == self.dtype:
            raise PgtsError(
                f"step returned rewards in {reward_N.dtype} and discounts in {discount_N.dtype}; "
                f"the dtype of the model is {self.dtype}"
            )
        if self.reward_range is not None:
            self.reward_range.check(reward_N.cpu())
        if {self.dtype, next_ND.dtype} <= _SURVEYED and pays(self.device, next_ND.numel()):
            kernels = index_loops()
            found = kernels.survey(*(x.detach().contiguous().numpy() for x in answer))
            if found < kernels.OFF:
                return *answer, found == kernels.ALL_COUNT
        self._check(state_ND, action_N, *answer)
        return *answer, bool(_counts(reward_N, discount_N).all())

    def _check(self, state_ND: Tensor, action_N: Tensor, reward_N: Tensor, discount_N: Tensor, next_ND: Tensor) -> None:
        """PgtsError if a discount is none, or a state that counts is not a number."""
        in_range = len(discount_N) == 0 or all(0 <= float(end) <= 1 for end in discount_N.aminmax())
        if not in_range:
            n = int(torch.nonzero(~((discount_N >= 0) & (discount_N <= 1)))[0, 0])
            raise PgtsError(
                f"step returned the discount {float(discount_N[n])} for state {state_ND[n].tolist()} and action "
                f"{action_N[n].tolist()}; it must be in [0, 1]"
            )
        # A sum is one cheap call; only where it is not a number single ones are looked at.
        if not bool(next_ND.sum().isnan()):
            return
        bad_N = next_ND.isnan().any(-1) & _counts(reward_N, discount_N)
        if bool(bad_N.any()):
            n = int(torch.nonzero(bad_N)[0, 0])
            raise NotFinite(
                f"step leads from state {state_ND[n].tolist()} by action {action_N[n].tolist()} to "
                f"{next_ND[n].tolist()}; what is not a number equals nothing",
                what="state",
            )


def _counts(reward_N: Tensor, discount_N: Tensor) -> Bool[Tensor, "N"]:
    """Which steps something counts after."""
    return (discount_N > 0) & (reward_N > -torch.inf)


def _close(x: Tensor, y: Tensor) -> Tensor:
    """Equal up to rounding."""
    return (x - y).abs() <= _ROUNDING * (1 + y.abs())
