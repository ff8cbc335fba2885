"""The search that chooses: by what the model can do, by how often paths meet, and by the budget."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, final

import torch
from torch import Tensor

from pgts_torch.errors import MemoryBudgetExceeded, NodeBudgetExceeded, PgtsError, RandomOutcomes
from pgts_torch.models.base import EnumeratingModel, Model, SamplingModel
from pgts_torch.search.engine import SampledSearch, Search
from pgts_torch.search.expectimax import expectimax
from pgts_torch.search.lookahead import MAX_BYTES, MAX_NODES, Leaf, Leaves, Lookahead
from pgts_torch.search.topology import Topology, tree_nodes

MOST_SAMPLES = 32


@final
class AutoSearch(Search):
    """Picks the search by what the model can do, by how often paths meet, and by the budget; `str` says what it picked.

    - Outcomes can be listed and the nodes that hold all paths fit into the budget: expectimax of full width, exact.
    - They can be listed and do not fit: expectimax that unfolds as many states of each level as fit. The width is
      halved until they do; where they left room, the next search is twice as wide. Full width is not tried again for
      as many roots and levels as were too many the last time.
    - They can only be drawn, or turn out to be random where they should be listed: sampled, with as many samples of
      each action as fit if no two paths meet. Where paths met and left room, the next search draws twice as many, up
      to 32; one of more roots or levels begins anew, and one that turns out too large is done again with half.

    Args:
        model: what is asked.
        max_nodes: the most nodes of one search.
        max_bytes: the most memory that a search may take.

    Raises:
        NodeBudgetExceeded: from a search, where even one state a level, or one sample of each action, is too much.
    """

    choices = ("_width", "_too_much", "_samples", "_most_asked", "_picked")

    def __init__(self, model: Model, *, max_nodes: int = MAX_NODES, max_bytes: int = MAX_BYTES) -> None:
        super().__init__(model)
        self.max_nodes, self.max_bytes = max_nodes, max_bytes
        self.topology = Topology(model, max_bytes=max_bytes) if isinstance(model, EnumeratingModel) else None
        self._width = max(1, max_nodes)
        self._too_much: tuple[int, int] | None = None
        self._samples = 0
        self._most_asked = 0, 0
        self._picked = "nothing yet"

    def _look(
        self, root_B: Tensor, depth: int, q_leaf: Leaf | None, v_leaf: Leaf | None, generator: torch.Generator
    ) -> Lookahead:
        expansions = Leaves(self.model, depth, q_leaf, v_leaf).expansions
        if self.topology is not None:
            try:
                return self._listed(root_B, depth, expansions, q_leaf, v_leaf)
            except RandomOutcomes:
                if not isinstance(self.model, SamplingModel):
                    raise
                self.topology = None
        return self._sampled(root_B, depth, expansions, q_leaf, v_leaf, generator)

    def _listed(
        self, root_B: Tensor, depth: int, expansions: int, q_leaf: Leaf | None, v_leaf: Leaf | None
    ) -> Lookahead:
        assert self.topology is not None
        topology: Topology = self.topology
        calls_before, calls_left_behind = topology.model_calls, 0

        def look(max_width: int | None) -> Lookahead:
            return expectimax(
                topology.model,
                root_B,
                depth=depth,
                q_leaf=q_leaf,
                v_leaf=v_leaf,
                topology=topology,
                max_nodes=self.max_nodes,
                max_width=max_width,
            )

        too_much = self._too_much
        if too_much is None or len(root_B) < too_much[0] or expansions < too_much[1]:
            try:
                full = look(None)
                self._picked = f"expectimax: the model lists its outcomes, and {full.nodes} nodes hold all paths"
                return full
            except NodeBudgetExceeded:
                self._too_much = len(root_B), expansions
        begun_anew = False
        while True:
            try:
                narrow = look(self._width)
                break
            except NodeBudgetExceeded as error:
                if isinstance(error, MemoryBudgetExceeded):
                    # What was found before, or by this attempt, takes memory too; the next one begins without it.
                    calls_left_behind += topology.model_calls - calls_before
                    is_full = topology.num_expanded > 0
                    topology = self.topology = topology.anew()
                    calls_before = 0
                    if is_full and not begun_anew:
                        begun_anew = True
                        continue
                if self._width == 1:
                    raise
                self._width //= 2
        if float(narrow.pruned_BA.max()) == 0:
            self._picked = f"expectimax: the model lists its outcomes, and {narrow.nodes} nodes hold all paths"
        else:
            self._picked = (
                f"expectimax, {self._width} states a level: all paths need more than {self.max_nodes} nodes, "
                "or too much memory"
            )
        if 2 * max(self._width, narrow.nodes) <= self.max_nodes:
            self._width *= 2
        return replace(narrow, model_calls=calls_left_behind + topology.model_calls - calls_before)

    def _sampled(
        self,
        root_B: Tensor,
        depth: int,
        expansions: int,
        q_leaf: Leaf | None,
        v_leaf: Leaf | None,
        generator: torch.Generator,
    ) -> Lookahead:
        roots, A = len(root_B), self.model.num_actions
        if roots > self._most_asked[0] or expansions > self._most_asked[1]:
            self._samples, self._most_asked = 0, (roots, expansions)
        while (
            self._samples < MOST_SAMPLES
            and tree_nodes(roots, A * 2 * max(self._samples, 1), expansions) <= self.max_nodes
        ):
            self._samples = 2 * max(self._samples, 1)
        self._samples = max(self._samples, 1)
        while True:
            try:
                search = SampledSearch(
                    self.model, samples=self._samples, max_nodes=self.max_nodes, max_bytes=self.max_bytes
                )
                look = search(root_B, depth=depth, q_leaf=q_leaf, v_leaf=v_leaf, generator=generator)
                break
            except NodeBudgetExceeded:
                if self._samples == 1:
                    raise
                self._samples //= 2
        tree = tree_nodes(roots, A * self._samples, expansions)
        self._picked = (
            f"sampled, {self._samples} outcomes of each action: the model only draws, and {look.nodes} nodes hold "
            f"{tree:.3g} paths"
        )
        if self._samples < MOST_SAMPLES and look.nodes * 2**expansions <= self.max_nodes:
            self._samples *= 2
        return look

    def check_choices(self, choices: Mapping[str, Any]) -> None:
        super().check_choices(choices)
        counts = (choices["_width"], choices["_samples"], *choices["_most_asked"], *(choices["_too_much"] or ()))
        if any(type(count) is not int or count < 0 for count in counts) or choices["_width"] == 0:
            raise PgtsError(f"its width, samples and numbers of states are {counts}; they must be counts")
        if not isinstance(choices["_picked"], str) or len(choices["_most_asked"]) != 2:
            raise PgtsError("its choices are of another form")

    def forget(self) -> None:
        if self.topology is not None:
            self.topology = self.topology.anew()

    def __str__(self) -> str:
        return self._picked
