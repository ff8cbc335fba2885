"""The search that chooses: by what the model can do, by how often paths meet, and by the budget."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.errors import MemoryBudgetExceeded, NodeBudgetExceeded, PgtsError, RandomOutcomes
from pgts_torch.models.base import EnumeratingModel, Model, SamplingModel
from pgts_torch.options.search import Auto, Sampled
from pgts_torch.search.engine import SampledSearch, Search
from pgts_torch.search.expectimax import search_levels
from pgts_torch.search.lookahead import Leaves, Lookahead
from pgts_torch.search.memory import tree_nodes
from pgts_torch.search.topology import Topology

MOST_SAMPLES = 32


@final
class AutoSearch(Search):
    """Picks the search by what the model can do, by how often paths meet, and by the budget; `str` says what it picked.

    - The model enumerates outcomes and the nodes that hold all paths fit into the budget: expectimax of full width,
    exact.
    - It enumerates them and they do not fit: expectimax of bounded width. The width is halved until a search fits;
    where it left room, the next one is twice as wide. Full width is not tried again for as many roots and levels.
    - `max_calls` is given, and the model may have more states: expectimax of the width W with which (roots + W (levels
    - 1)) A calls are not more.
    - It only samples outcomes, or turns out to be random where it should enumerate them: sampled, with as many samples
    of each action as fit if no two paths meet. Where paths met and left room, the next search takes twice as many, up
    to 32; for more roots or levels the number is chosen again, and is halved where a search turns out too large.

    Raises:
        NodeBudgetExceeded: from a search, where even one state a level, or one sample of each action, is too much.
        PgtsError: from a search, where that takes more than `max_calls`.
    """

    defers_checks = True
    choices = ("_width", "_too_much", "_samples", "_most_asked", "_picked")

    def __init__(self, model: Model, options: Auto = Auto()) -> None:  # noqa: B008 - frozen
        super().__init__(model)
        self.options = options
        self.topology = Topology(model, max_bytes=options.max_bytes) if isinstance(model, EnumeratingModel) else None
        self._width = options.max_nodes
        self._too_much: tuple[int, int] | None = None
        self._samples = 0
        self._most_asked = 0, 0
        self._picked = "nothing yet"

    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        if self.topology is not None:
            calls_before, roots, expansions = self.topology.table.model_calls, len(root_B), leaves.expansions
            widest = self._widest(root_B, expansions)
            self._width = min(self._width, widest or self._width)
            try:
                if widest is not None:
                    return self._narrowed(leaves, root_B, calls_before)
                if self._too_much is None or roots < self._too_much[0] or expansions < self._too_much[1]:
                    try:
                        full = search_levels(leaves, self.topology, root_B, max_nodes=self.options.max_nodes)
                        self._picked = _all_paths(full)
                        return full
                    except NodeBudgetExceeded:
                        self._too_much = roots, expansions
                return self._narrowed(leaves, root_B, calls_before)
            except RandomOutcomes:
                if not isinstance(self.model, SamplingModel):
                    raise
                self.topology = None
        return self._sampled(leaves, root_B, generator)

    def _widest(self, root_B: Int[Tensor, "B"], expansions: int) -> int | None:
        """The width with which a search of so many levels needs at most `max_calls` model calls; None: any width."""
        A, max_calls = self.model.num_actions, self.options.max_calls
        assert self.topology is not None
        if max_calls is None or expansions == 0:
            return None
        states = max_calls // A
        if self.topology.model.table is not None and self.model.num_states <= states:
            return None
        roots = len(root_B.unique())
        if states < roots + expansions - 1:
            raise PgtsError(
                f"search.max_calls is {max_calls}; {roots} states under {A} actions, and one below them on each of "
                f"{expansions - 1} levels, need {(roots + expansions - 1) * A}: visit fewer, set search.max_roots, or "
                "allow more"
            )
        return (states - roots) // (expansions - 1) if expansions > 1 else None

    def _narrowed(self, leaves: Leaves, root_B: Tensor, calls_before: int) -> Lookahead:
        """Expectimax of the largest width that fits.

        Args:
            calls_before: `topology.table.model_calls` before the search; what it tried in vain counts too.
        """
        assert self.topology is not None
        topology, max_nodes = self.topology, self.options.max_nodes
        calls_left_behind, is_emptied = 0, False
        while True:
            try:
                narrow = search_levels(leaves, topology, root_B, max_nodes=max_nodes, max_width=self._width)
                break
            except NodeBudgetExceeded as error:
                if isinstance(error, MemoryBudgetExceeded):
                    # What earlier searches, or this attempt, left in the topology takes memory too: try without it.
                    calls_left_behind += topology.table.model_calls - calls_before
                    is_full = topology.table.num_queried > 0
                    topology = self.topology = topology.fresh()
                    calls_before = 0
                    if is_full and not is_emptied:
                        is_emptied = True
                        continue
                if self._width == 1:
                    raise
                self._width //= 2
        if float(narrow.pruned_BA.max()) == 0:
            self._picked = _all_paths(narrow)
        else:
            self._picked = f"expectimax, {self._width} states a level: all paths need more than {max_nodes} nodes, " + (
                "or too much memory" if self.options.max_calls is None else "too much memory or too many calls"
            )
        if 2 * max(self._width, narrow.nodes) <= max_nodes:
            self._width *= 2
        return replace(narrow, model_calls=calls_left_behind + topology.table.model_calls - calls_before)

    def _sampled(self, leaves: Leaves, root_B: Tensor, generator: torch.Generator) -> Lookahead:
        """Sparse sampling with as many samples as fit."""
        roots, A, expansions = len(root_B), self.model.num_actions, leaves.expansions
        max_calls = math.inf if self.options.max_calls is None else self.options.max_calls

        def fits(samples: int) -> bool:
            calls = A * samples * tree_nodes(roots, A * samples, expansions - 1) if expansions else 0
            return tree_nodes(roots, A * samples, expansions) <= self.options.max_nodes and calls <= max_calls

        if roots > self._most_asked[0] or expansions > self._most_asked[1]:
            self._samples, self._most_asked = 0, (roots, expansions)
        while self._samples < MOST_SAMPLES and fits(2 * max(self._samples, 1)):
            self._samples = 2 * max(self._samples, 1)
        self._samples = max(self._samples, 1)
        if max_calls < math.inf and not fits(1):
            raise PgtsError(
                f"search.max_calls is {max_calls}; one sample of each of {A} actions, {expansions} levels below "
                f"{roots} states, may need more: visit fewer, set search.max_roots, or take a smaller depth or "
                "search.kind mcts"
            )
        while True:
            try:
                options = Sampled(
                    samples=self._samples, max_nodes=self.options.max_nodes, max_bytes=self.options.max_bytes
                )
                search = SampledSearch(self.model, options)
                look = search.look_ahead(leaves, root_B, generator)
                break
            except NodeBudgetExceeded:
                if self._samples == 1:
                    raise
                self._samples //= 2
        tree = tree_nodes(roots, A * self._samples, expansions)
        self._picked = (
            f"sampled, {self._samples} outcomes of each action: the model only samples, and {look.nodes} nodes hold "
            f"{tree:.3g} paths"
        )
        left = min(self.options.max_nodes / max(look.nodes, 1), max_calls / max(look.model_calls, 1))
        if self._samples < MOST_SAMPLES and 2**expansions <= left:
            self._samples *= 2
        return look

    @property
    def num_samples(self) -> int:
        return max(self._samples, 1)

    def most_states(self, roots: int, levels: int) -> float:
        max_calls = self.options.max_calls
        return self._within(math.inf if max_calls is None else max_calls // self.calls_of_state)

    def check_choices(self, choices: Mapping[str, Any]) -> None:
        super().check_choices(choices)
        counts = (choices["_width"], choices["_samples"], *choices["_most_asked"], *(choices["_too_much"] or ()))
        if any(type(count) is not int or count < 0 for count in counts) or choices["_width"] == 0:
            raise PgtsError(f"its width, samples and numbers of states are {counts}; they must be counts")
        if not isinstance(choices["_picked"], str) or len(choices["_most_asked"]) != 2:
            raise PgtsError("its choices are of another form")

    def __str__(self) -> str:
        return self._picked


def _all_paths(look: Lookahead) -> str:
    return f"expectimax: the model enumerates its outcomes, and {look.nodes} nodes hold all paths"
