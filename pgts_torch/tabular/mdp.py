"""Finite Markov decision processes, validated when they are made."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import gymnasium
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from pgts_torch import files
from pgts_torch.bellman import Outcomes
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.tabular import npz, transitions
from pgts_torch.tabular.forms import EXACT, Order, Start, outcomes_from, start_distribution
from pgts_torch.tabular.transitions import LARGEST_VALUE, Transitions

MEAN_TOLERANCE = 1e-8
"""How far the mean of the rewards of outcomes may be from r(s, a), as a share of the largest of them."""


@dataclass(frozen=True, eq=False)
class TabularMDP:
    """Outcomes over all S states and a start distribution, in float64.

    Args:
        outcomes: what may follow every state; children are states. A reward of -inf says that an action is not allowed
            there: no policy takes it and its value is -inf. What follows it does not matter; it becomes what follows
            the first action that is allowed.
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
        object.__setattr__(self, "outcomes", _allowed_only(self.outcomes))
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
    def from_dense(cls, P: Any, R: Any, gamma: float, *, start: Start = None, order: Order | None = None) -> Self:
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
            PgtsError: as the class; or there is no such form, or shapes leave the order open and it is not given.
        """
        check_gamma(gamma)
        outcomes, reward_SAK = outcomes_from(P, R, gamma, order)
        return cls(outcomes, start_distribution(start, outcomes.num_states), reward_SAK=reward_SAK)

    @classmethod
    def from_transitions(
        cls,
        P: Transitions,
        gamma: float,
        *,
        start: Start = None,
        action_names: tuple[str, ...] = (),
        shape: tuple[int, int] = (0, 0),
    ) -> Self:
        """An MDP from lists of transitions, `P[s][a] = [(probability, next state, reward, terminated), ...]`.

        A successor that is listed twice is counted twice; with two rewards it is two outcomes. A terminated transition
        has discount 0. A state that, as far as `start` reaches it at all, is entered only by terminated transitions is
        terminal: nothing is earned from it, whatever its own rows say. Rounded rows are divided by their sums, as in
        `from_dense`.

        Args:
            P: transitions for states 0..S-1 and actions 0..A-1; a mapping P[s] may lack actions that are not allowed.
            gamma: discount of the transitions that do not terminate.
        """
        check_gamma(gamma)
        outcomes, start_S, reward_SAK = transitions.outcomes_of(P, gamma, start)
        return cls(outcomes, start_S, action_names, shape, reward_SAK)

    @classmethod
    def from_gymnasium(cls, env: gymnasium.Env, gamma: float, *, start: Start = None) -> Self:
        """The MDP of a Gymnasium environment that publishes its transitions as `env.unwrapped.P`.

        Args:
            env: FrozenLake, CliffWalking, Taxi, or any environment with a P table of the same form.
            start: as in `from_dense`. Default: the environment's `initial_state_distrib`, or the uniform one.

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
            rows, columns = map(int, shape)
        except (TypeError, ValueError):  # attributes of another meaning
            rows = columns = 0
        shape = (rows, columns) if rows * columns == len(table) else (0, 0)
        return cls.from_transitions(table, gamma, start=start, shape=shape)

    def save_npz(self, path: str | Path) -> None:
        """Write the MDP as `load_npz` reads it, without names and shape of the picture. Only a file that `load_npz`
        reads is replaced, and an empty one; a reader meanwhile finds the old MDP or the new one.

        Raises:
            PgtsError: the outcomes have several discounts (some end an episode, for instance), another file is there,
                or the file cannot be written.
        """
        outcomes = self.outcomes
        happens_SAK = outcomes.prob_NAK > 0
        gamma = float(outcomes.discount_NAK[happens_SAK][0])
        other_SA = (happens_SAK & (outcomes.discount_NAK != gamma)).any(-1)
        must = f"others have {gamma}, and an npz file holds one gamma: let an end lead to a state that earns 0 forever"
        _refuse(other_SA, "the outcomes of ({}, {}) have discounts", outcomes.discount_NAK, must)
        P_SAS = torch.zeros(self.num_states, self.num_actions, self.num_states, dtype=torch.float64)
        P_SAS.scatter_add_(-1, outcomes.child_NAK, outcomes.prob_NAK)

        def is_mdp(_: bytes) -> bool:
            try:
                self.load_npz(path)
            except PgtsError:
                return False
            return True

        target = files.target(path, is_mdp, "an MDP that load_npz reads", most=1)
        arrays: dict[str, ArrayLike] = {"P": P_SAS, "R": outcomes.reward_NA, "gamma": gamma, "start": self.start_S}
        npz.write(target, arrays)

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
        P, R, gamma, start = npz.read(path)
        try:
            return cls.from_dense(P, R, gamma, start=start, order="SAS")
        except PgtsError as error:
            raise PgtsError(f"{path}: {npz.in_words_of_the_file(str(error))}") from error


def _allowed_only(outcomes: Outcomes) -> Outcomes:
    """The outcomes with those of the first action that is allowed in place of those of each action that is not. So what
    may follow a state at all is what follows the actions that are allowed."""
    if outcomes.reward_NA.ndim != 2 or outcomes.child_NAK.ndim != 3 or outcomes.reward_NA.shape[1] == 0:
        return outcomes  # which is no table
    legal_NA = outcomes.legal_NA
    if legal_NA.all() or legal_NA.shape != outcomes.child_NAK.shape[:2] or outcomes.reward_NA.isnan().any():
        return outcomes
    action_NA = torch.where(legal_NA, torch.arange(legal_NA.shape[1]), legal_NA.int().argmax(-1, keepdim=True))
    state_N1 = torch.arange(len(legal_NA))[:, None]
    prob_NAK, discount_NAK, child_NAK = (
        x[state_N1, action_NA] for x in (outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK)
    )
    return Outcomes(outcomes.reward_NA, prob_NAK, discount_NAK, child_NAK, outcomes.num_children)


def check_gamma(gamma: float) -> None:
    """Raise PgtsError unless gamma is in [0, 1]."""
    if not 0 <= gamma <= 1:
        raise PgtsError(f"gamma is {gamma}; it must be in [0, 1]")


def _check_start(start_S: Tensor, num_states: int) -> None:
    if start_S.shape != (num_states,):
        raise PgtsError(f"start_S has shape {tuple(start_S.shape)}; the MDP needs ({num_states},)")
    impossible_S = ~torch.isfinite(start_S) | (start_S < 0)
    _refuse(impossible_S, "start_S[{}] is", start_S, "probabilities are finite and at least 0")
    if abs(float(start_S.sum()) - 1) > EXACT:
        raise PgtsError(f"start_S is not a distribution: it sums to {float(start_S.sum())}")


def _check_rewards(reward_SAK: Tensor, outcomes: Outcomes) -> None:
    """PgtsError with the first offending (s, a) unless these are rewards of the outcomes, with their means."""
    if reward_SAK.shape != outcomes.prob_NAK.shape or reward_SAK.dtype != torch.float64:
        raise PgtsError(
            f"reward_SAK is {reward_SAK.dtype} with shape {tuple(reward_SAK.shape)}; it must be torch.float64 with "
            f"shape {tuple(outcomes.prob_NAK.shape)}"
        )
    off_SA = ~torch.isfinite(reward_SAK).all(-1) & outcomes.legal_NA
    _refuse(off_SA, "reward_SAK[{}, {}] is", reward_SAK, "rewards must be finite")
    mean_SA, largest_SA = (outcomes.prob_NAK * reward_SAK).sum(-1), reward_SAK.abs().amax(-1)
    off_SA = ((mean_SA - outcomes.reward_NA).abs() > MEAN_TOLERANCE * largest_SA) & outcomes.legal_NA
    must = "reward_NA must be the same; reward_SAK=None where each outcome pays the mean"
    _refuse(off_SA, "reward_SAK[{}, {}] has the mean", mean_SA, must)


def _check_outcomes(outcomes: Outcomes) -> None:
    """PgtsError with the first offending (s, a) unless the table is one of valid outcomes."""
    reward, prob, discount, child = outcomes.reward_NA, outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK
    if child.ndim != 3:
        raise PgtsError(f"child_NAK has shape {tuple(child.shape)}; it must have three axes")
    if 0 in child.shape:
        raise PgtsError(f"outcomes have shape {tuple(child.shape)}; each side must be at least 1")
    for name, tensor, axes in [("reward_NA", reward, 2), ("prob_NAK", prob, 3), ("discount_NAK", discount, 3)]:
        if tensor.shape != child.shape[:axes]:
            raise PgtsError(f"{name} has shape {tuple(tensor.shape)}; child_NAK needs {tuple(child.shape[:axes])}")
        if tensor.dtype != torch.float64:
            raise PgtsError(f"{name} is {tensor.dtype}; the exact world is float64")
    off_SA = ~torch.isfinite(reward) & (reward != -torch.inf)
    _refuse(off_SA, "R_SA[{}, {}] is", reward, "rewards must be finite, or -inf where an action is not allowed")
    _refuse(~outcomes.legal_NA.any(-1), "R_SA[{}] is", reward, "one action of each state must be allowed")
    off_SA = ~((prob >= 0) & (prob <= 1 + EXACT)).all(-1)
    _refuse(off_SA, "P_SAS[{}, {}] has probabilities", prob, "each must be in [0, 1]")
    total_SA = prob.sum(-1)
    off_SA = (total_SA - 1).abs() > EXACT
    _refuse(off_SA, "P_SAS[{}, {}] is not a distribution: it sums to", total_SA.round(decimals=10), "that must be 1")
    off_SA = ~((discount >= 0) & (discount <= 1)).all(-1)
    _refuse(off_SA, "discount_NAK[{}, {}] is", discount, "each must be in [0, 1]")
    # So that no value, 1 / (1 - discount) times a reward, and no difference of values is infinite.
    most = LARGEST_VALUE * max(1 - float(discount.max()), 1e-100)
    must = f"with discounts up to {discount.max():.6g} rewards may be at most {most:.2g} in size"
    _refuse((reward.abs() > most) & outcomes.legal_NA, "R_SA[{}, {}] is", reward, must)
    off_SA = ((child < 0) | (child >= outcomes.num_children)).any(-1)
    _refuse(off_SA, "child_NAK[{}, {}] is", child, f"states are 0 to {outcomes.num_children - 1}")


def _refuse(bad: Tensor, says: str, found: Tensor, must: str) -> None:
    """PgtsError with the first place where something is bad, what is found there, and what must be."""
    if bad.any():
        place = torch.nonzero(bad)[0].tolist()
        raise PgtsError(f"{says.format(*place)} {found[tuple(place)].tolist()}; {must}")
