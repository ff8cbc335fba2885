"""The search that chooses: by what the model can do, by how often paths meet, and by the budget."""

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
    - It enumerates them and they do not fit: expectimax that expands as many states of each level as fit. The width is
      halved until they do; where they left room, the next search is twice as wide. Full width is not tried again for
      as many roots and levels as were too many the last time.
    - It only samples outcomes, or turns out to be random where it should enumerate them: sampled, with as many samples
      of each action as fit if no two paths meet. Where paths met and left room, the next search takes twice as many, up
      to 32; for more roots or levels the number is chosen again, and a search that turns out too large is done again
      with half.

    Args:
        model: enumerates or samples outcomes.

    Raises:
        NodeBudgetExceeded: from a search, where even one state a level, or one sample of each action, is too much.
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
            try:
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
            self._picked = (
                f"expectimax, {self._width} states a level: all paths need more than {max_nodes} nodes, "
                "or too much memory"
            )
        if 2 * max(self._width, narrow.nodes) <= max_nodes:
            self._width *= 2
        return replace(narrow, model_calls=calls_left_behind + topology.table.model_calls - calls_before)

    def _sampled(self, leaves: Leaves, root_B: Tensor, generator: torch.Generator) -> Lookahead:
        """Sparse sampling with as many samples as fit."""
        roots, A, expansions = len(root_B), self.model.num_actions, leaves.expansions
        if roots > self._most_asked[0] or expansions > self._most_asked[1]:
            self._samples, self._most_asked = 0, (roots, expansions)
        while (
            self._samples < MOST_SAMPLES
            and tree_nodes(roots, A * 2 * max(self._samples, 1), expansions) <= self.options.max_nodes
        ):
            self._samples = 2 * max(self._samples, 1)
        self._samples = max(self._samples, 1)
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
        if self._samples < MOST_SAMPLES and look.nodes * 2**expansions <= self.options.max_nodes:
            self._samples *= 2
        return look

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
