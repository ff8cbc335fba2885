"""The levels of a lookahead: which states it has at which depth, and how values go up through them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from pgts_torch.bellman import Outcomes, back_up_steps, backup


class Plan(NamedTuple):
    """A search of so many levels, which stays the same once they are there.

    bottom: the states at the bottom.
    steps: the outcomes from there up, with how many levels have them.
    nodes_per_level, nodes: how many nodes each of the levels holds, from the roots on, and all of them.
    """

    bottom: Int[Tensor, "N"]
    steps: tuple[tuple[Outcomes, int], ...]
    nodes_per_level: tuple[int, ...]
    nodes: int


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
    plans: of the searches so far, by their number of levels.
    """

    frontiers: list[Int[Tensor, "N"]]
    root_row_B: Int[Tensor, "B"]
    outcomes: list[Outcomes] = field(default_factory=list)
    closed: Outcomes | None = None
    given_B: Int[Tensor, "B"] | None = None
    closed_states: Int[Tensor, "N"] = field(init=False)
    plans: dict[int, Plan] = field(init=False, default_factory=dict)

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

    def plan(self, expansions: int) -> Plan:
        """The search of so many levels, which are there."""
        if expansions not in self.plans:
            # Levels below the last frontier all are the closed set, which needs one table for all of them.
            last = min(expansions, len(self.outcomes))
            steps = [(self.outcomes[k], 1) for k in reversed(range(last))]
            if expansions > last:
                assert self.closed is not None
                steps.insert(0, (self.closed, expansions - last))
                if steps[1][0] is self.closed:  # the roots are closed
                    steps = [(self.closed, expansions)]
            # The last step leads into the closed set, not into a frontier.
            in_closed = self.closed is not None and expansions >= len(self.outcomes)
            bottom = self.closed_states if in_closed else self.frontiers[expansions]
            frontiers = [frontier.shape[0] for frontier in self.frontiers[: expansions + 1]]
            # Where levels are missing in `frontiers`, they are the closed set.
            missing = [self.closed_states.shape[0]] * (expansions + 1 - len(frontiers))
            nodes_per_level = *frontiers, *missing
            self.plans[expansions] = Plan(bottom, tuple(steps), nodes_per_level, sum(nodes_per_level))
        return self.plans[expansions]

    def sweeps(self, expansions: int) -> int:
        """How many of so many levels, counted from the leaves, are the closed set."""
        return max(0, expansions - len(self.outcomes))

    def back_up(
        self,
        v_N: Float[Tensor, "leaves"],
        expansions: int,
        *,
        check: Callable[[], None] | None = None,
        reward: Callable[[Tensor], Tensor | None] | None = None,
    ) -> Float[Tensor, "N A"]:
        """Values of all actions in frontier 0, from values v of the leaves below `expansions` >= 1 levels.

        Args:
            check: as in `back_up_steps`.
            reward: takes the place of the rewards of allowed actions; states [N] to [N, A], or to None: those stay.
        """
        steps: Sequence[tuple[Outcomes, int]] = self.plan(expansions).steps
        if reward is not None:
            above = reversed(self.frontiers[: min(expansions, len(self.outcomes))])
            states = *[self.closed_states] * (self.sweeps(expansions) > 0), *above
            rewards = [reward(state_N) for _, state_N in zip(steps, states, strict=False)]
            steps = [
                (outcomes if reward_NA is None else outcomes.paying(reward_NA), times)
                for (outcomes, times), reward_NA in zip(steps, rewards, strict=True)
            ]
        return back_up_steps(steps, v_N, check)

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
