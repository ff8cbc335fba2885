"""What a lookahead may ask of a model. Ask for the smallest ability: a signature says which.

A state is an integer below `num_states`. A model whose states are something else (snapshots, vectors) numbers them as
it meets them, equal states alike, so that a search can merge them.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.models.rewards import RewardRange


@dataclass(frozen=True, eq=False)
class Transitions:
    """One drawn outcome for each of N pairs (state, action).

    reward_N: in reward units.   discount_N: in [0, 1], 0 after a terminal outcome.   next_state_N: states of the model.
    """

    reward_N: Float[Tensor, "N"]
    discount_N: Float[Tensor, "N"]
    next_state_N: Int[Tensor, "N"]


@dataclass(frozen=True, eq=False)
class Happened:
    """N steps of an environment, in the states of a model; in numpy, where few numbers cost a third of what they do in
    torch.

    reward_N: in reward units.   discount_N: in [0, 1], 0 where the episode ended.
    follows_N: whether the episode went on with another step.
    """

    state_N: Int[np.ndarray, "N"]
    action_N: Int[np.ndarray, "N"]
    reward_N: Float[np.ndarray, "N"]
    discount_N: Float[np.ndarray, "N"]
    next_state_N: Int[np.ndarray, "N"]
    follows_N: Bool[np.ndarray, "N"]

    def part(self, at: Any) -> "Happened":
        """Those at some positions, or under a mask."""
        return Happened(*(column_N[at] for column_N in vars(self).values()))


DENIED, DRAWN, UNASKED = -1, -2, -3
"""What comes of holding a step to a model, in place of an outcome: there is none like it with a positive probability;
the model draws what follows and lists nothing to hold it to; the answer would have cost a call."""


class Model(ABC):
    """A finite action set over numbered states.

    exact: whether it claims to be the environment, as a table, dynamics or a simulator do, and a learned model does
        not: what the environment does is held to it, and a bound that it proves is called proved.
    highest_value: an upper bound of v* in every state; infinite where none is known.
    lowest_value: a lower bound of v^pi, of every policy in every state; -infinite where none is known.
    reward_range: what its rewards are held to; None: nothing.
    action_repeat: how often an action is taken in one outcome.
    is_certain: whether it is known that no action has more than one outcome.
    generation: how often the model has forgotten its states and begun to number them anew.
    """

    num_states: int
    num_actions: int
    exact: bool = False
    highest_value: float = math.inf
    lowest_value: float = -math.inf
    reward_range: RewardRange | None = None
    action_repeat: int = 1
    is_certain: bool = False
    generation: int = 0
    device: torch.device
    dtype: torch.dtype


class ExactModel(Model):
    """A model that claims to be the environment, and so can be held to what the environment does.

    kind: the word for it in a message.
    is_cheap: whether it can be held to all steps for next to nothing; else only to those that it was asked about, and
        to a few more.
    simulator_steps: how often a simulator behind it was stepped.
    """

    exact = True
    kind: str
    is_cheap: bool
    simulator_steps: int = 0

    @abstractmethod
    def hold(self, happened: Happened, *, ask_N: Bool[np.ndarray, "N"] | None = None) -> Int[np.ndarray, "N"]:
        """Which of its outcomes of positive probability each step was (0 where there is only one), the first of those
        that look like it: reward, discount and, unless the episode ended, next state are the same. Where there is none,
        DENIED, DRAWN or UNASKED.

        With repeated actions the model is held to its single steps.

        Args:
            ask_N: where an answer is worth a call. Default: everywhere.
        """

    @abstractmethod
    def shown(self, state: int) -> str:
        """A state in a message."""

    @abstractmethod
    def told(self, state: int, action: int) -> str:
        """What the model says of a state and an action, in a message."""


def promise(model: Model, reward_range: RewardRange, *, gamma: float) -> None:
    """Hold a model to a range of rewards, and bound what its states can be worth by it."""
    low, high = reward_range.values(gamma)
    model.reward_range = reward_range
    model.lowest_value, model.highest_value = max(model.lowest_value, low), min(model.highest_value, high)


class EnumeratingModel(Model):
    """A model that lists all outcomes of a state.

    num_outcomes: K; None: it is not known before the model is asked.
    samples_outcomes: whether it samples the outcomes that it enumerates, and remembers them.
    """

    num_outcomes: int | None = None
    samples_outcomes: bool = False

    @abstractmethod
    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """What may follow each state under every action; children are states of this model."""


class SamplingModel(Model):
    """A model that draws one outcome of a state and an action."""

    @abstractmethod
    def sample(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"], *, key_N: Int[Tensor, "N"]) -> Transitions:
        """One outcome of each (state, action): a function of state, action and key (`seeding.mix`) and of nothing else.

        So a search owns its randomness, cannot foresee what an environment will draw, and finds the same outcome
        however its batch is split or ordered.
        """


def step_text(reward: float, discount: float, then: str) -> str:
    """A step in a message: what it paid, and what came after it."""
    return f"reward {_exactly(reward)}, " + (
        "an end" if discount == 0 else f"discount {_exactly(discount)}, then {then}"
    )


def _exactly(x: float) -> str:
    short = f"{x:g}"
    return short if float(short) == x else repr(x)
