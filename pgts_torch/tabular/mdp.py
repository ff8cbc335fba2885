"""Finite Markov decision processes, validated when they are made."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import gymnasium
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from pgts_torch import files
from pgts_torch.bellman import Outcomes
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.tabular import npz
from pgts_torch.tabular.forms import EXACT, STORED, Order, normalised, outcomes_from

MEAN_TOLERANCE = 1e-8
"""How far the mean of the rewards of outcomes may be from r(s, a), as a share of the largest of them."""

_LARGEST_VALUE = torch.finfo(torch.float64).max / 8

Transition = tuple[float, int, float, bool]
"""(probability, next state, reward, terminated), as in the P tables of Gymnasium's toy-text environments."""


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """Outcomes over all S states and a start distribution, in float64.

    Args:
        outcomes: what may follow every state; children are states.
        start_S: start distribution mu [PGTS Sec. 2].
        action_names: one word an action, for pictures and messages. Default "0", "1", ...
        shape: (rows, columns) in which a picture lays the states out, row by row. Default one row.
        reward_SAK: reward of each outcome, where outcomes of one (s, a) differ in it; their mean is r(s, a). None: each
            outcome pays r(s, a). Values need the mean alone; what a single step may pay is `outcome_reward_SAK`.

    Raises:
        PgtsError: a row is not a distribution, a discount is outside [0, 1], a reward is not finite or so large that
            values are not, a child does not exist or a shape is wrong; the message names the first offending (s, a).
    """

    outcomes: Outcomes
    start_S: Float[Tensor, "S"]
    action_names: tuple[str, ...] = ()
    shape: tuple[int, int] = (0, 0)
    reward_SAK: Float[Tensor, "S A K"] | None = None

    def __post_init__(self) -> None:
        _check_outcomes(self.outcomes)
        if not self.action_names:
            object.__setattr__(self, "action_names", tuple(str(a) for a in range(self.num_actions)))
        if self.shape == (0, 0):
            object.__setattr__(self, "shape", (1, self.num_states))
        if self.outcomes.num_children != self.num_states:
            raise PgtsError(f"outcomes point into {self.outcomes.num_children} states; the MDP has {self.num_states}")
        _check_start(self.start_S, self.num_states)
        if len(self.action_names) != self.num_actions:
            raise PgtsError(f"{len(self.action_names)} action names for {self.num_actions} actions")
        if self.shape[0] * self.shape[1] != self.num_states:
            raise PgtsError(f"shape {self.shape} does not hold {self.num_states} states")
        if self.reward_SAK is not None:
            _check_rewards(self.reward_SAK, self.outcomes)

    @property
    def num_states(self) -> int:
        return self.outcomes.num_states

    @property
    def num_actions(self) -> int:
        return self.outcomes.num_actions

    @property
    def outcome_reward_SAK(self) -> Float[Tensor, "S A K"]:
        """What is paid where an outcome of positive probability happens; beside it the table of `outcomes` has the
        outcome's probability, discount and next state."""
        if self.reward_SAK is not None:
            return self.reward_SAK
        return self.outcomes.reward_NA.unsqueeze(-1).expand(self.outcomes.prob_NAK.shape)

    @classmethod
    def from_dense(
        cls, P: Any, R: Any, gamma: float, *, start: int | ArrayLike | None = None, order: Order | None = None
    ) -> Self:
        """An MDP from transitions and rewards as textbooks, pymdptoolbox and QuantEcon have them.

        Rows that sum to 1 within 1e-5, as those of float32 or of six digits, are divided by their sums.

        Args:
            P: probabilities of next states: an array [S, A, S] or [A, S, S]; or scipy.sparse matrices, a list of one
                [S, S] for each action, or a single one [S A, S] (`tabular.forms`). Sparse ones are never made dense.
            R: rewards: [S, A]; [S], where the action does not matter; or one of each entry of P, in the form of P.
            gamma: discount in [0, 1].
            start: a state, a distribution over states, or None for the uniform one.
            order: "SAS" if P[s, a] is a distribution, "ASS" if P[a, s] is. Needed only where shapes do not tell.

        Raises:
            PgtsError: as the class; or no such forms, or an order that nothing tells.
        """
        check_gamma(gamma)
        outcomes, reward_SAK = outcomes_from(P, R, gamma, order)
        return cls(outcomes, start_distribution(start, outcomes.num_states), reward_SAK=reward_SAK)

    @classmethod
    def from_transitions(
        cls,
        P: Mapping[int, Mapping[int, Sequence[Transition]]] | Sequence[Sequence[Sequence[Transition]]],
        gamma: float,
        *,
        start: int | ArrayLike | None = None,
        action_names: tuple[str, ...] = (),
        shape: tuple[int, int] = (0, 0),
    ) -> Self:
        """An MDP from lists of transitions, `P[s][a] = [(probability, next state, reward, terminated), ...]`.

        A successor that is listed twice is counted twice; with two rewards it is two outcomes. A terminated transition
        has discount 0. A state that, as far as `start` reaches it at all, is entered only by terminated transitions is
        terminal: nothing is earned from it, whatever its own rows say. Rounded rows are divided by their sums, as in
        `from_dense`.

        Args:
            P: transitions for states 0..S-1 and actions 0..A-1.
            gamma: discount in [0, 1] of the transitions that do not terminate.
            start: a state, a distribution over states, or None for the uniform one.
        """
        check_gamma(gamma)
        S = len(P)
        A = len(P[0]) if S else 0
        if S == 0 or A == 0:
            raise PgtsError("P is empty; it must hold at least one state and one action")
        rows = [[_merge_successors(P, s, a, S, A) for a in range(A)] for s in range(S)]
        start_S = start_distribution(start, S)
        for s in _terminal_states(rows, start_S):
            rows[s] = [(0.0, {(s, True, 0.0): 1.0}) for _ in range(A)]
        K = max(len(successors) for row in rows for _, successors in row)
        reward, outcome_reward = np.zeros((S, A)), np.zeros((S, A, K))
        prob, discount = np.zeros((S, A, K)), np.zeros((S, A, K))
        child = np.zeros((S, A, K), dtype=np.int64)
        for s, row in enumerate(rows):
            for a, (expected_reward, successors) in enumerate(row):
                reward[s, a] = outcome_reward[s, a] = expected_reward
                child[s, a] = s
                for k, ((next_state, terminated, paid), p) in enumerate(successors.items()):
                    prob[s, a, k], child[s, a, k], outcome_reward[s, a, k] = p, next_state, paid
                    discount[s, a, k] = 0.0 if terminated else gamma
        reward_SA, prob_SAK, discount_SAK, child_SAK = map(torch.from_numpy, (reward, prob, discount, child))
        reward_SAK = torch.from_numpy(outcome_reward) if (outcome_reward != reward[..., None]).any() else None
        return cls(Outcomes(reward_SA, prob_SAK, discount_SAK, child_SAK, S), start_S, action_names, shape, reward_SAK)

    @classmethod
    def from_gymnasium(cls, env: gymnasium.Env, gamma: float, *, start: int | ArrayLike | None = None) -> Self:
        """The MDP of a Gymnasium environment that publishes its transitions as `env.unwrapped.P`.

        Args:
            env: FrozenLake, CliffWalking, Taxi, or any environment with a P table of the same form.
            gamma: discount in [0, 1].
            start: a state or a distribution. Default: the environment's `initial_state_distrib`, or the uniform one.

        Raises:
            MissingModel: the environment has no P table.
        """
        unwrapped: Any = env.unwrapped
        table = getattr(unwrapped, "P", None)
        if table is None:
            raise MissingModel(f"{env} has no transition table: env.unwrapped.P is missing")
        if start is None:
            start = getattr(unwrapped, "initial_state_distrib", None)
        shape = getattr(unwrapped, "shape", (getattr(unwrapped, "nrow", 0), getattr(unwrapped, "ncol", 0)))
        try:
            laid_out = len(shape) == 2 and int(shape[0]) * int(shape[1]) == len(table)
        except (TypeError, ValueError):  # attributes of another meaning
            laid_out = False
        return cls.from_transitions(
            table, gamma, start=start, shape=(int(shape[0]), int(shape[1])) if laid_out else (0, 0)
        )

    def save_npz(self, path: str | Path) -> None:
        """Write the MDP as `load_npz` reads it, without names and shape of the picture. Only a file that `load_npz`
        reads is replaced, and an empty one; whoever reads it meanwhile finds the old MDP or the new one.

        Raises:
            PgtsError: the outcomes have several discounts (some end an episode, for instance), another file is there,
                or the file cannot be written.
        """
        outcomes = self.outcomes
        happens_SAK = outcomes.prob_NAK > 0
        gamma = float(outcomes.discount_NAK[happens_SAK][0])
        other = happens_SAK & (outcomes.discount_NAK != gamma)
        _refuse(
            other.any(-1),
            lambda s, a: (
                f"outcomes of ({s}, {a}) have discounts {outcomes.discount_NAK[s, a].tolist()}, others {gamma}; an npz "
                f"file holds one gamma: let an end lead to a state that earns 0 for ever"
            ),
        )
        P_SAS = torch.zeros(self.num_states, self.num_actions, self.num_states, dtype=torch.float64)
        P_SAS.scatter_add_(-1, outcomes.child_NAK, outcomes.prob_NAK)
        arrays: dict[str, ArrayLike] = {
            "P": P_SAS.numpy(),
            "R": outcomes.reward_NA.numpy(),
            "gamma": gamma,
            "start": self.start_S.numpy(),
        }
        npz.write_arrays(files.target(path, lambda _: self._is_npz(path), "an MDP that load_npz reads", most=1), arrays)

    @classmethod
    def _is_npz(cls, path: str | Path) -> bool:
        """Whether a file holds an MDP."""
        try:
            cls.load_npz(path)
        except PgtsError:
            return False
        return True

    @classmethod
    def load_npz(cls, path: str | Path) -> Self:
        """An MDP from the arrays in a file that `numpy.savez` wrote.

        P: [S, A, S], P[s, a] the distribution over next states.   R: [S, A], expected rewards.
        gamma: one number in [0, 1].   start (may be missing: uniform): a state, or a distribution [S].

        An end is written as a state that leads to itself and earns 0.

        Raises:
            PgtsError: the file cannot be read, holds pickled objects, lacks an array or holds an unknown one, would
                take more than 2 GiB of memory, or the arrays make no MDP; the message names the file, the array, the
                index and the value.
        """
        arrays = npz.read_arrays(path)
        try:
            gamma = npz.single_number("gamma", arrays["gamma"])
            start = npz.state_or_distribution(arrays.get("start"))
            return cls.from_dense(arrays["P"], arrays["R"], gamma, start=start, order="SAS")
        except PgtsError as error:
            raise PgtsError(f"{path}: {npz.in_words_of_the_file(str(error))}") from error


def start_distribution(start: int | ArrayLike | None, num_states: int) -> Float[Tensor, "S"]:
    """mu as a vector: one state, a given distribution, or None for the uniform one."""
    if start is None:
        return torch.full((num_states,), 1 / num_states, dtype=torch.float64)
    if isinstance(start, int | np.integer):
        if not 0 <= start < num_states:
            raise PgtsError(f"start state {start} does not exist; states are 0 to {num_states - 1}")
        return torch.nn.functional.one_hot(torch.tensor(int(start)), num_states).double()
    return torch.from_numpy(normalised(np.array(start, dtype=np.float64, ndmin=1)))


def check_gamma(gamma: float) -> None:
    """Raise PgtsError unless gamma is in [0, 1]."""
    if not 0 <= gamma <= 1:
        raise PgtsError(f"gamma is {gamma}; it must be in [0, 1]")


_Row = tuple[float, dict[tuple[int, bool, float], float]]
"""Expected reward of (s, a), and the probability of each (next state, terminated, reward) that it may lead to."""


def _merge_successors(P: Any, s: int, a: int, S: int, A: int) -> _Row:
    if len(P[s]) != A:
        raise PgtsError(f"P[{s}] has {len(P[s])} actions; P[0] has {A}")
    successors = dict[tuple[int, bool, float], float]()
    # Counted from the first reward, so that equal rewards have exactly this mean.
    first_reward = float(P[s][a][0][2]) if len(P[s][a]) else 0.0
    expected_reward = first_reward
    for p, next_state, reward, terminated in P[s][a]:
        if not 0 <= next_state < S:
            raise PgtsError(f"P[{s}][{a}] leads to state {next_state}; states are 0 to {S - 1}")
        if p < 0 or not np.isfinite(p):
            raise PgtsError(f"P[{s}][{a}] has probability {p}; probabilities are finite and at least 0")
        reward = float(reward)  # a float32 would turn the largest value into infinity
        if not abs(reward) <= _LARGEST_VALUE:
            raise PgtsError(f"P[{s}][{a}] has reward {reward}; rewards must be finite, at most {_LARGEST_VALUE:.2g}")
        if p > 0:
            key = (int(next_state), bool(terminated), reward)
            successors[key] = successors.get(key, 0.0) + float(p)
            expected_reward += float(p) * (reward - first_reward)
    if not successors:
        raise PgtsError(f"P[{s}][{a}] has no outcome with positive probability")
    total = sum(successors.values())
    if EXACT < abs(total - 1) <= STORED:  # as `normalised` does
        expected_reward = first_reward + (expected_reward - first_reward) / total
        successors = {key: p / total for key, p in successors.items()}
    return expected_reward, successors


def _terminal_states(rows: list[list[_Row]], start_S: Tensor) -> set[int]:
    """States entered by terminated transitions only, as far as the start distribution reaches them."""
    frontier = torch.nonzero(start_S).flatten().tolist()
    alive, ended = set(frontier), set[int]()
    while frontier:
        s = frontier.pop()
        for _, successors in rows[s]:
            for next_state, terminated, _ in successors:
                if terminated:
                    ended.add(next_state)
                elif next_state not in alive:
                    alive.add(next_state)
                    frontier.append(next_state)
    return ended - alive


def _check_start(start_S: Tensor, num_states: int) -> None:
    if start_S.shape != (num_states,):
        raise PgtsError(f"start_S has shape {tuple(start_S.shape)}; the MDP needs ({num_states},)")
    off = torch.nonzero(~torch.isfinite(start_S) | (start_S < 0)).flatten()
    if len(off):
        raise PgtsError(f"start_S[{off[0]}] is {start_S[off[0]]}; probabilities are finite and at least 0")
    if abs(float(start_S.sum()) - 1) > EXACT:
        raise PgtsError(f"start_S is not a distribution: it sums to {float(start_S.sum())}")


def _check_rewards(reward_SAK: Tensor, outcomes: Outcomes) -> None:
    """Raise PgtsError with the first offending (s, a) unless these are rewards of the outcomes, with their means."""
    if reward_SAK.shape != outcomes.prob_NAK.shape or reward_SAK.dtype != torch.float64:
        raise PgtsError(
            f"reward_SAK is {reward_SAK.dtype} with shape {tuple(reward_SAK.shape)}; it must be torch.float64 with "
            f"shape {tuple(outcomes.prob_NAK.shape)}"
        )
    finite_SA = torch.isfinite(reward_SAK).all(-1)
    _refuse(~finite_SA, lambda s, a: f"reward_SAK[{s}, {a}] is {reward_SAK[s, a].tolist()}; rewards must be finite")
    mean_SA, largest_SA = (outcomes.prob_NAK * reward_SAK).sum(-1), reward_SAK.abs().amax(-1)
    _refuse(
        (mean_SA - outcomes.reward_NA).abs() > MEAN_TOLERANCE * largest_SA,
        lambda s, a: (
            f"reward_SAK[{s}, {a}] has the mean {mean_SA[s, a]}; reward_NA is {outcomes.reward_NA[s, a]}: give both, "
            "or reward_SAK=None where each outcome pays the mean"
        ),
    )


def _check_outcomes(outcomes: Outcomes) -> None:
    """Raise PgtsError with the first offending (s, a) unless the table is one of valid outcomes."""
    reward, prob = outcomes.reward_NA, outcomes.prob_NAK
    if outcomes.child_NAK.ndim != 3:
        raise PgtsError(f"child_NAK has shape {tuple(outcomes.child_NAK.shape)}; it must have three axes")
    N, A, K = outcomes.child_NAK.shape
    if min(N, A, K) == 0:
        raise PgtsError(f"outcomes have shape {(N, A, K)}; each side must be at least 1")
    for name, tensor, shape in [
        ("reward_NA", reward, (N, A)),
        ("prob_NAK", prob, (N, A, K)),
        ("discount_NAK", outcomes.discount_NAK, (N, A, K)),
    ]:
        if tensor.shape != shape:
            raise PgtsError(f"{name} has shape {tuple(tensor.shape)}; child_NAK needs {shape}")
        if tensor.dtype != torch.float64:
            raise PgtsError(f"{name} is {tensor.dtype}; the exact world is float64")
    _refuse(~torch.isfinite(reward), lambda s, a: f"R_SA[{s}, {a}] is {reward[s, a]}; rewards must be finite")
    _refuse(
        ~((prob >= 0) & (prob <= 1 + EXACT)).all(-1),
        lambda s, a: f"P_SAS[{s}, {a}] has probabilities {prob[s, a].tolist()}; each must be in [0, 1]",
    )
    total = prob.sum(-1)
    _refuse(
        (total - 1).abs() > EXACT,
        lambda s, a: f"P_SAS[{s}, {a}] is not a distribution: it sums to {float(total[s, a]):.10g}",
    )
    discount = outcomes.discount_NAK
    _refuse(
        ~((discount >= 0) & (discount <= 1)).all(-1),
        lambda s, a: f"discount of ({s}, {a}) is {discount[s, a].tolist()}; each must be in [0, 1]",
    )
    most = _largest_reward(float(discount.max()))
    _refuse(
        reward.abs() > most,
        lambda s, a: (
            f"R_SA[{s}, {a}] is {reward[s, a]}; with discounts up to {discount.max():.6g} rewards may be {most:.2g} in "
            "size: beyond that values are no numbers"
        ),
    )
    child = outcomes.child_NAK
    _refuse(
        ((child < 0) | (child >= outcomes.num_children)).any(-1),
        lambda s, a: f"children of ({s}, {a}) are {child[s, a].tolist()}; states are 0 to {outcomes.num_children - 1}",
    )


def _largest_reward(discount: float) -> float:
    """The largest size of rewards with which no value, and no difference of values, overflows."""
    steps = 1 / (1 - discount) if discount < 1 else math.inf
    return _LARGEST_VALUE / min(steps, 1e100)


def _refuse(bad_SA: Tensor, message: Any) -> None:
    if bad_SA.any():
        raise PgtsError(message(*torch.nonzero(bad_SA)[0].tolist()))
