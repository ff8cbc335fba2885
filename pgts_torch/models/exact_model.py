"""Models that claim to be the environment, and what an environment does that may contradict them."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Num

from pgts_torch.models.base import Model

CONTRADICTED, RANDOM, NOT_QUERIED = -1, -2, -3
"""What `ExactModel.outcome_of` returns in place of an outcome: the model has none like this step with a positive
probability; the model samples what follows, and enumerates nothing to compare with; the answer would cost a call."""


@dataclass(frozen=True, eq=False)
class Happened:
    """N steps of an environment, in the states of a model; in numpy, where operations on few numbers cost a third of
    what they do in torch.

    reward_N: in reward units.   discount_N: in [0, 1], 0 where the episode ended.
    follows_N: whether the episode went on with another step.
    """

    state_N: Int[np.ndarray, "N"]
    action_N: Num[np.ndarray, "N ..."]
    reward_N: Float[np.ndarray, "N"]
    discount_N: Float[np.ndarray, "N"]
    next_state_N: Int[np.ndarray, "N"]
    follows_N: Bool[np.ndarray, "N"]

    def part(self, at: Any) -> "Happened":
        """The steps at some positions, or under a mask."""
        return Happened(*(column_N[at] for column_N in vars(self).values()))


class ExactModel(Model):
    """A model that claims to be the environment, so that what the environment does can contradict it.

    kind: the word for it in a message.
    is_cheap: whether it can be compared with all steps at almost no cost; else only with those that it was queried for,
        and a few more.
    simulator_steps: how often a simulator behind it was stepped.
    """

    exact = True
    kind: str
    is_cheap: bool
    simulator_steps: int = 0

    @abstractmethod
    def outcome_of(self, happened: Happened, *, query_N: Bool[np.ndarray, "N"] | None = None) -> Int[np.ndarray, "N"]:
        """Which of its outcomes of positive probability each step was (0 where there is only one), the first of those
        with the same reward, discount and, unless the episode ended, next state; else CONTRADICTED, RANDOM or
        NOT_QUERIED.

        With repeated actions these are the outcomes of single steps.

        Args:
            query_N: where an answer is worth a call. Default: everywhere.
        """

    @abstractmethod
    def state_text(self, state: int) -> str:
        """A state in a message."""

    @abstractmethod
    def outcomes_text(self, state: int, action: int) -> str:
        """The outcomes of a state and an action, in a message."""

    def contradiction(self, happened: Happened) -> str:
        """The first of some steps that are none of its outcomes, and what it has instead, in a message."""
        state, action, reward, discount, next_state, follows = (
            column[0].tolist() for column in vars(happened).values()
        )
        gave = step_text(reward, discount, self.state_text(next_state))
        gave += ", and the episode went on" * (follows and not self.is_cheap)
        return (
            f"{self.state_text(state)} under action {action} gave {gave}; the {self.kind} says "
            f"{self.outcomes_text(state, action)}"
        )


def step_text(reward: float, discount: float, then: str) -> str:
    """A step in a message: its reward, and what came after it."""
    reward_text, discount_text = (f"{x:g}" if float(f"{x:g}") == x else repr(x) for x in (reward, discount))
    return f"reward {reward_text}, " + ("an end" if discount == 0 else f"discount {discount_text}, then {then}")
