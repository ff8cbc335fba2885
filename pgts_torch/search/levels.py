"""The levels of a lookahead: which states it has at which depth, and how values go up through them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.bellman import Outcomes, backup, sweep, swept_backup


@dataclass(eq=False)
class Levels:
    """The levels below a batch of roots, as far as a search has expanded them.

    frontiers: the distinct states at level 0, 1, ...
    outcomes: outcomes[k] leads from frontier k to positions in frontier k + 1; the last one, where there is a closed
        set, to positions in that.
    closed: outcomes of the closed set, with positions in it as children; None until a level brings no new state.
    closed_states: every state met so far, in the order of `closed`; all there are once there is a closed set.
    root_row_B: the position of each root in frontier 0.
    given_B: the tensor in which the roots were given last.
    """

    frontiers: list[Int[Tensor, "N"]]
    root_row_B: Int[Tensor, "B"]
    outcomes: list[Outcomes] = field(default_factory=list)
    closed: Outcomes | None = None
    given_B: Int[Tensor, "B"] | None = None
    closed_states: Int[Tensor, "N"] = field(init=False)

    _in_order: bool = field(init=False)

    def __post_init__(self) -> None:
        roots = self.closed_states = self.frontiers[0]
        self._in_order = torch.equal(self.root_row_B, torch.arange(len(roots), device=roots.device))

    def of_roots(self, q_NA: Shaped[Tensor, "N ..."]) -> Shaped[Tensor, "B ..."]:
        """The rows of the roots, of those of frontier 0."""
        return q_NA if self._in_order else q_NA.index_select(0, self.root_row_B)

    @property
    def rows(self) -> int:
        """How many rows of outcomes are kept."""
        closed = 0 if self.closed is None else self.closed.num_states
        return closed + sum(outcomes.num_states for outcomes in self.outcomes)

    def sweeps(self, expansions: int) -> int:
        """How many of `expansions` levels, counted from the leaves, are the closed set."""
        return max(0, expansions - len(self.outcomes))

    def bottom(self, expansions: int) -> Int[Tensor, "N"]:
        """The states at the bottom of `expansions` levels."""
        # The last step leads into the closed set, not into a frontier.
        if self.closed is not None and expansions >= len(self.outcomes):
            return self.closed_states
        return self.frontiers[expansions]

    def back_up(
        self, v_N: Float[Tensor, "leaves"], expansions: int, *, reward: Callable[[Tensor], Tensor | None] | None = None
    ) -> Float[Tensor, "N A"]:
        """Values of all actions in frontier 0, from values v of the leaves below `expansions` >= 1 levels.

        Args:
            reward: takes the place of the rewards of allowed actions; states [N] to [N, A], or to None: those stay.
        """

        if reward is None and len(self.outcomes) == 1 and self.closed is self.outcomes[0]:  # the roots are closed
            return swept_backup(self.closed, v_N, expansions - 1)

        def paying(outcomes: Outcomes, states: Tensor) -> Outcomes:
            reward_NA = None if reward is None else reward(states)
            return outcomes if reward_NA is None else outcomes.paying(reward_NA)

        # Levels below the last frontier all are the closed set, which needs one table for all of them.
        if sweeps := self.sweeps(expansions):
            assert self.closed is not None
            v_N = sweep(paying(self.closed, self.closed_states), v_N, sweeps)
        steps = range(min(expansions, len(self.outcomes)))
        return back_up((paying(self.outcomes[k], self.frontiers[k]) for k in reversed(steps)), v_N)

    def nodes_per_level(self, expansions: int) -> tuple[int, ...]:
        """How many nodes each of the levels 0 .. expansions holds."""
        frontiers = [len(frontier) for frontier in self.frontiers[: expansions + 1]]
        # Where levels are missing in `frontiers`, they are the closed set.
        return (*frontiers, *[len(self.closed_states)] * (expansions + 1 - len(frontiers)))

    def nodes(self, expansions: int) -> int:
        """How many these are together, in constant time for any depth of a closed set."""
        frontiers = [len(frontier) for frontier in self.frontiers[: expansions + 1]]
        return sum(frontiers) + len(self.closed_states) * (expansions + 1 - len(frontiers))


def back_up(outcomes: Iterable[Outcomes], v_N: Float[Tensor, "leaves"]) -> Float[Tensor, "N A"]:
    """Values of all actions of the highest level, from values v of the leaves.

    Args:
        outcomes: of at least one level, from the lowest up.
    """
    for step in outcomes:
        q_NA = backup(step, v_N)
        v_N = q_NA.amax(-1)
    return q_NA
