"""What every search takes and returns: leaf values in, values of all actions of the roots out."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist
from typing import Self, final

import scipy.special
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.errors import NotFinite, PgtsError, check_count
from pgts_torch.models.base import Model
from pgts_torch.readings import Readings
from pgts_torch.search.price import Meter

Leaf = Callable[[Tensor], Tensor]
"""A critic or a policy as a search calls it: states [N] to values of Q^pi [N, A] or of v^pi [N], or to pi [N, A]."""

_FAIR = 1e-3
"""By how much the probabilities of a prior may miss 1."""


@dataclass(frozen=True, eq=False)
class Lookahead:
    """Estimates of (T^m Q)(s, .) at the roots, how far they can be trusted, and what they cost.

    q_BA: lookahead values of all actions, in reward units and in the dtype of the model; they carry no gradient. -inf
        where the action is not allowed.
    stderr_BA: standard error of q that comes from sampled outcomes, in reward units: 0 where all outcomes were
        enumerated, NaN where it was not estimated.
    pruned_BA: in [0, 1]: the most discounted probability that any plan after (s, a) puts on nodes above the last level
        that the critic values in place of a deeper search. If the critic is off by at most e there, |q - T^m Q| <=
        pruned * e beside the sampling error; 0 for a search of full width.
    model_calls: for how many (state, action) the model was queried in this search.
    critic_calls: how often the critic was called, each time for many states together.
    nodes_per_level: how many nodes are backed up at each level, from the roots to the leaves.
    bias_BA: an estimate of how much q is too high because maxima were taken over sampled values, in reward units; None
        where nothing was sampled.
    samples: the fewest outcomes that were sampled of a (state, action); None where none were.
    doubt_BA: at least |q - T^m Q|, with T and Q of the environment, in reward units. None: not asked for, or the model
        does not say.
    value_range: between which numbers the model's values lie; both 0 where its actions have one outcome each.

    The doubt is what the model and the critic may be wrong by, added up along the best plan for errors,

        E_0 = error of the critic
        E_{j+1}(s, a) = e(s, a) + sum_k p_k gamma_k max_a' E_j(s'_k, a')

    with the error e of the model (`FallibleModel.step_error`), which may be an estimate.
    """

    q_BA: Float[Tensor, "B A"]
    stderr_BA: Float[Tensor, "B A"]
    pruned_BA: Float[Tensor, "B A"]
    model_calls: int
    critic_calls: int
    nodes_per_level: tuple[int, ...]
    bias_BA: Float[Tensor, "B A"] | None = None
    samples: int | None = None
    value_range: tuple[float, float] = (-math.inf, math.inf)
    doubt_BA: Float[Tensor, "B A"] | None = None

    @classmethod
    def enumerated(
        cls,
        q_BA: Float[Tensor, "B A"],
        *,
        pruned_BA: Float[Tensor, "B A"] | None = None,
        model_calls: int,
        critic_calls: int,
        nodes_per_level: tuple[int, ...],
        doubt_BA: Float[Tensor, "B A"] | None = None,
    ) -> Self:
        """What a search finds that enumerates outcomes: without sampling error, and by default of full width."""
        zero_BA = _zeros(q_BA.shape, q_BA.dtype, q_BA.device)
        if pruned_BA is None:
            pruned_BA = zero_BA
        return cls(q_BA, zero_BA, pruned_BA, model_calls, critic_calls, nodes_per_level, doubt_BA=doubt_BA)

    def interval(self, confidence: float = 0.95) -> tuple[Float[Tensor, "B A"], Float[Tensor, "B A"]]:
        """Lower and upper bounds of T^m Q, as far as sampled outcomes put it in doubt: q - bias -+ t stderr; and the
        doubt on both sides, where there is one: then they are bounds of T^m Q in the environment.

        t is the quantile of Student's distribution with C - 1 degrees of freedom, C = `samples`. Where samples agree so
        far that stderr is 0 the interval comes from the range [l, u] of the values instead (infinite without a range):

            q - f (q - l)  to  q + f (u - q),        f = 1 - (1 - confidence)^{1 / (C - 1)}

        C samples agree on a value of probability p < 1 - f with a probability of sum p^C <= (1 - f)^{C-1} = 1 -
        confidence; of a larger p the rest, at most f, lies between l and u. So this part is exact with one level.

        On random MDPs (`benchmarks/intervals.py`, docs/benchmarks.md) intervals of one level hold the truth at least as
        often as they say. Those of more levels hold it less often, where maxima over samples make q too high, most
        among tied actions, and where few of many outcomes carry most of a value and none of these was sampled. What was
        pruned is not in them, nor, without a doubt, what the critic gets wrong.

        Raises:
            PgtsError: confidence is not between 0 and 1.
        """
        if not 0 < confidence < 1:
            raise PgtsError(f"confidence is {confidence}; it must be above 0 and below 1")
        q_BA, C = self.q_BA, self.samples
        if C is None or C < 2:
            half_BA = NormalDist().inv_cdf((1 + confidence) / 2) * self.stderr_BA
            if self.doubt_BA is not None:
                half_BA = half_BA + self.doubt_BA
            return q_BA - half_BA, q_BA + half_BA
        center_BA = q_BA if self.bias_BA is None else q_BA - self.bias_BA
        half_BA = float(scipy.special.stdtrit(C - 1, (1 + confidence) / 2)) * self.stderr_BA
        rounding = 64 * torch.finfo(q_BA.dtype).eps * q_BA.abs()
        agree_BA = (self.stderr_BA <= rounding) & q_BA.isfinite()
        low, high = self.value_range
        share = 0.0 if low == high else 1 - (1 - confidence) ** (1 / (C - 1))
        least_BA = q_BA - share * (q_BA - q_BA.clamp(max=low)) if share else q_BA
        most_BA = q_BA + share * (q_BA.clamp(min=high) - q_BA) if share else q_BA
        return (
            torch.where(agree_BA, least_BA, center_BA - half_BA),
            torch.where(agree_BA, most_BA, center_BA + half_BA),
        )

    @property
    def noise(self) -> float:
        """Root mean square of the standard errors, in reward units; those that were not estimated count as 0."""
        return float(self.stderr_BA.double().nan_to_num(0.0).square().mean().sqrt())

    @property
    def nodes(self) -> int:
        """All nodes of all levels."""
        return sum(self.nodes_per_level)


@final
class Leaves:
    """The critic's values of the states of one search, and the policy it may start from, both checked.

    calls: how often the critic was called.
    readings: where the check of values waits that they are finite; None: it is made at once.
    meter: measures what the search costs; None: nothing does.
    expansions: how many levels are expanded: with Q at the bottom m, with v one more, for Q = r + gamma P v.

    Args:
        depth: m, a finite whole number of at least 0.
        q_leaf: an estimate of Q^pi: states [N] to [N, A]; -inf where an action is not allowed.
        v_leaf: an estimate of v^pi: states [N] to [N]. Exactly one of the two is given.
        prior: the policy, states [N] to probabilities [N, A]. Default: uniform.
        leaf_error: a bound of the critic's error, one number or of the shape of the critic's values.

    Raises:
        PgtsError: a bad depth, or not exactly one critic.
    """

    def __init__(
        self,
        model: Model,
        depth: int,
        q_leaf: Leaf | None,
        v_leaf: Leaf | None,
        prior: Leaf | None = None,
        leaf_error: float | Leaf | None = None,
        readings: Readings | None = None,
    ) -> None:
        if (q_leaf is None) == (v_leaf is None):
            raise PgtsError("give exactly one of q_leaf and v_leaf")
        self.calls = 0
        self.expansions = check_count("depth", depth, least=0) + (v_leaf is not None)
        self._model, self._q_leaf, self._v_leaf, self._prior = model, q_leaf, v_leaf, prior
        self.leaf_error, self.readings = leaf_error, readings
        self.meter: Meter | None = None

    def v(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"]:
        """v, or max_a Q(s, a); PgtsError, with the state, if the critic's values are of a wrong shape or not finite."""
        if self._v_leaf is None:
            return self.q(state_N).amax(-1)
        values = self._called(self._v_leaf, state_N, (state_N.shape[0],))
        self.check(values, state_N)
        return values

    def unchecked(self, state_N: Int[Tensor, "N"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N ..."]]:
        """v, which the caller checks; and the critic's values, for `check` where it is not finite."""
        if self._v_leaf is not None:
            values = self._called(self._v_leaf, state_N, (state_N.shape[0],))
            return values, values
        assert self._q_leaf is not None
        values = self._called(self._q_leaf, state_N, (state_N.shape[0], self._model.num_actions))
        return values.amax(-1), values

    def check(self, values: Float[Tensor, "N ..."], state_N: Int[Tensor, "N"]) -> None:
        """PgtsError, with the state, where the critic's values are not finite; at once or when `readings` are read."""
        check_finite("value", "the critic's value", values, state_N, self.readings)

    def q(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"]:
        """Q(s, .), -inf where an action is not allowed; as `v` otherwise. Only for critics of Q^pi."""
        assert self._q_leaf is not None
        values = self._called(self._q_leaf, state_N, (state_N.shape[0], self._model.num_actions))
        self.check(values, state_N)
        return values

    def errors(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N"] | Float[Tensor, "N A"]:
        """The bounds of the error of v, or of Q; PgtsError, with the state, if they cannot be bounds."""
        shape = (len(state_N),) if self._q_leaf is None else (len(state_N), self._model.num_actions)
        if callable(self.leaf_error):
            return checked_errors(self.leaf_error(state_N), shape, self._model, state_N, "the critic's error")
        assert self.leaf_error is not None
        error = torch.full(shape, self.leaf_error, dtype=self._model.dtype, device=self._model.device)
        return checked_errors(error, shape, self._model, state_N, "leaf_error")

    def prior(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"]:
        """pi(.|s), or uniform probabilities; PgtsError, with the state, if the policy's are no distribution."""
        N, A = len(state_N), self._model.num_actions
        if self._prior is None:
            return torch.full((N, A), 1 / A, dtype=self._model.dtype, device=self._model.device)
        prior_NA = self._prior(state_N).to(self._model.dtype)
        if prior_NA.shape != (N, A):
            raise PgtsError(f"the prior has shape {tuple(prior_NA.shape)}; for {N} states it must be {(N, A)}")
        off_N = ~((prior_NA >= 0).all(-1) & ((prior_NA.sum(-1) - 1).abs() <= _FAIR))
        if off_N.any():
            n = int(off_N.nonzero()[0, 0])
            raise PgtsError(f"the prior of state {int(state_N[n])} is {prior_NA[n].tolist()}; it is no distribution")
        return prior_NA

    def _called(self, leaf: Leaf, state_N: Tensor, shape: tuple[int, ...]) -> Tensor:
        self.calls += 1
        values = leaf(state_N)
        if values.dtype != self._model.dtype:
            values = values.to(self._model.dtype)
        if values.shape != shape:
            raise PgtsError(f"the critic's values have shape {tuple(values.shape)}; of {len(state_N)} leaves: {shape}")
        return values


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _zeros(shape: torch.Size, dtype: torch.dtype, device: torch.device) -> Tensor:
    """One number in memory."""
    return torch.zeros((), dtype=dtype, device=device).expand(shape)


def checked_errors(
    error_N: Tensor, shape: tuple[int, ...], model: Model, state_N: Int[Tensor, "N"], name: str
) -> Tensor:
    """Bounds of errors in the dtype of the model; PgtsError unless they have this shape, are finite and at least 0."""
    if error_N.shape != shape:
        raise PgtsError(f"{name} has shape {tuple(error_N.shape)}; of {len(state_N)} states: {shape}")
    off = torch.nonzero(~((error_N >= 0) & (error_N < torch.inf)))
    if len(off):
        row = int(off[0, 0])
        raise PgtsError(
            f"{name} in state {int(state_N[row])} is {error_N[row].tolist()}; it must be finite and at least 0"
        )
    return error_N.to(model.dtype)


def unexpanded(leaves: Leaves, root_B: Int[Tensor, "B"]) -> Lookahead:
    """The lookahead of no levels: the critic's Q at the roots, called once for the distinct ones."""
    state_N, row_B = torch.unique(root_B, return_inverse=True)
    q_BA = leaves.q(state_N)[row_B]
    return Lookahead.enumerated(q_BA, model_calls=0, critic_calls=leaves.calls, nodes_per_level=(len(state_N),))


def check_finite(
    what: str,
    name: str,
    value_N: Float[Tensor, "N ..."],
    state_N: Int[Tensor, "N"] | None,
    readings: Readings | None = None,
) -> None:
    """NotFinite if a value is, naming its state, or else its row. Of several values of a state the best must be finite,
    the others may be -inf: an action that is not allowed. With readings it is raised when these are read."""
    total = value_N.sum()  # one cheap call; only a sum that overflows makes it look closer in vain
    if readings is not None:
        readings.check(total, lambda _: check_finite(what, name, value_N, state_N))
        return
    if math.isfinite(total):
        return
    best_N = value_N if value_N.ndim == 1 else value_N.amax(-1)
    off = torch.nonzero(~best_N.isfinite())
    if len(off):
        row = int(off[0, 0])
        where = f"in row {row}" if state_N is None else f"of state {int(state_N[row])}"
        raise NotFinite(f"{name} {where} is {value_N[row].tolist()}; it must be finite", what=what)


def check_roots(root_B: Tensor, num_states: int) -> None:
    """PgtsError unless these are one or more states."""
    if root_B.ndim != 1 or len(root_B) == 0:
        raise PgtsError(f"root_B has shape {tuple(root_B.shape)}; it must be a vector of at least one state")
    if root_B.dtype != torch.int64:
        raise PgtsError(f"root_B is {root_B.dtype}; states are int64")
    if root_B.device.type == "cpu":  # a tenth of the time for a few roots
        states = root_B.numpy()
        if 0 <= states.min() and states.max() < num_states:
            return
    off = torch.nonzero((root_B < 0) | (root_B >= num_states)).flatten()
    if len(off):
        raise PgtsError(f"root_B[{int(off[0])}] is {int(root_B[off[0]])}; states are 0 to {num_states - 1}")
