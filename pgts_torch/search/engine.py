"""Searches as objects: one way to look ahead in one model, with what it remembers from one search to the next."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.errors import MissingModel, PgtsError, check_count
from pgts_torch.models.base import EnumeratingModel, Model, SamplingModel
from pgts_torch.search.empirical import Drawn, Share
from pgts_torch.search.expectimax import expectimax
from pgts_torch.search.lookahead import MAX_BYTES, MAX_NODES, Leaf, Lookahead, check_finite
from pgts_torch.search.mcts import mcts
from pgts_torch.search.sampled import plan_levels, sampled
from pgts_torch.search.topology import Topology
from pgts_torch.seeding import draw_keys

DEFAULT_SAMPLES = 4


class Search(ABC):
    """(T^m Q)(s, .) at the roots of one model.

    model_calls: how many (state, action) it has asked so far.
    topology: what it has asked of a model that lists outcomes; None: it remembers no outcomes.
    choices: the names of the attributes by which earlier searches decide how later ones are made.
    """

    topology: Topology | None = None
    choices: tuple[str, ...] = ()

    def __init__(self, model: Model) -> None:
        self.model = model
        self.model_calls = 0

    def __call__(
        self,
        root_B: Int[Tensor, "B"],
        *,
        depth: int,
        q_leaf: Leaf | None = None,
        v_leaf: Leaf | None = None,
        generator: torch.Generator,
    ) -> Lookahead:
        """One search; the arguments are those of `expectimax`.

        Args:
            generator: drawn from only by searches that draw outcomes or noise; equal states of it give equal searches.

        Raises:
            NotFinite: the value of the best action of a root is not finite.
        """
        look = self._look(root_B, depth, q_leaf, v_leaf, generator)
        check_finite("lookahead", "the lookahead", look.q_BA, root_B)
        self.model_calls += look.model_calls
        return look

    @abstractmethod
    def _look(
        self, root_B: Tensor, depth: int, q_leaf: Leaf | None, v_leaf: Leaf | None, generator: torch.Generator
    ) -> Lookahead: ...

    @abstractmethod
    def forget(self) -> None:
        """Forget what was asked: the model has begun to number its states anew."""

    def state_dict(self, *, with_states: bool) -> dict[str, Any]:
        """What later searches depend on: plain values, and a tensor on the CPU.

        Args:
            with_states: whether states keep their numbers, so that those it asked about can be named.
        """
        asked = self.topology.asked.cpu() if with_states and self.topology is not None else torch.empty(0).long()
        return {
            "choices": {name: getattr(self, name) for name in self.choices},
            "lists": self.topology is not None,
            "asked": asked,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave: later searches are, and count, those of the search that gave it.

        Raises:
            PgtsError: it is that of another search.
        """
        self.check_choices(state["choices"])
        if state["asked"].dtype != torch.int64 or state["asked"].ndim != 1:
            raise PgtsError("asked is no list of states")
        for name in self.choices:
            setattr(self, name, state["choices"][name])
        if not state["lists"]:
            self.topology = None
        elif self.topology is not None:
            self.topology.recall(state["asked"].to(self.model.device))

    def check_choices(self, choices: Mapping[str, Any]) -> None:
        """PgtsError unless earlier searches can have chosen this."""
        if set(choices) != set(self.choices):
            raise PgtsError(f"its choices are {sorted(choices)}; {type(self).__name__} makes {sorted(self.choices)}")

    @abstractmethod
    def __str__(self) -> str:
        """What it does, in a few words, and why if it chose that itself."""


@final
class ExpectimaxSearch(Search):
    """`expectimax` over one topology: each (state, action) is asked once in however many searches.

    Args:
        model: lists outcomes.
        max_nodes: the most nodes of one search.
        max_width: the most states of a level that are unfolded. Default: all.
        max_bytes: the most memory that a search may take, with what is remembered.
    """

    def __init__(
        self,
        model: Model,
        *,
        max_nodes: int = MAX_NODES,
        max_width: int | None = None,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        super().__init__(model)
        self.topology: Topology = Topology(listing(model, "expectimax"), max_bytes=max_bytes)
        if max_width is not None:
            check_count("max_width", max_width)
        self.max_nodes, self.max_width = max_nodes, max_width

    def _look(
        self, root_B: Tensor, depth: int, q_leaf: Leaf | None, v_leaf: Leaf | None, generator: torch.Generator
    ) -> Lookahead:
        return expectimax(
            self.topology.model,
            root_B,
            depth=depth,
            q_leaf=q_leaf,
            v_leaf=v_leaf,
            topology=self.topology,
            max_nodes=self.max_nodes,
            max_width=self.max_width,
        )

    def forget(self) -> None:
        self.topology = self.topology.anew()

    def __str__(self) -> str:
        return "expectimax" if self.max_width is None else f"expectimax, {self.max_width} states a level"


@final
class SampledSearch(Search):
    """`sampled`, with fresh samples in each search, and without standard errors.

    Args:
        model: draws outcomes.
        samples: outcomes of each (state, action), one number or one for each level.
        share: what shares them, "none", "level" or "search".
        max_nodes: the most nodes of one search.
        max_bytes: the most memory that a search may take.
    """

    def __init__(
        self,
        model: Model,
        *,
        samples: int | Sequence[int | None] = DEFAULT_SAMPLES,
        share: Share = "level",
        max_nodes: int = MAX_NODES,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        super().__init__(model)
        self._model = drawing(model, "sampled")
        plan_levels(samples, 1, share, model)
        self.samples, self.share, self.max_nodes, self.max_bytes = samples, share, max_nodes, max_bytes

    def _look(
        self, root_B: Tensor, depth: int, q_leaf: Leaf | None, v_leaf: Leaf | None, generator: torch.Generator
    ) -> Lookahead:
        return sampled(
            self._model,
            root_B,
            depth=depth,
            q_leaf=q_leaf,
            v_leaf=v_leaf,
            samples=self.samples,
            share=self.share,
            generator=generator,
            replicates=0,
            max_nodes=self.max_nodes,
            max_bytes=self.max_bytes,
        )

    def forget(self) -> None:
        """It remembers nothing."""

    def __str__(self) -> str:
        return f"sampled, {self.samples} outcomes of each action, shared by {self.share}"


@final
class MCTSSearch(Search):
    """`mcts` with maximum backups, and with uniform priors: those of the policy would look where it goes already.

    Args:
        model: lists outcomes, or draws them.
        simulations: of each root.
        merge: whether paths that meet are one node.
        samples: how many drawn outcomes of each action stand for all, anew in each search. Default: all are listed, or
            4 where the model only draws.
        max_nodes: the most nodes of one search.
        max_bytes: the most memory that a search may take, with what is remembered.
    """

    def __init__(
        self,
        model: Model,
        *,
        simulations: int = 64,
        merge: bool = True,
        samples: int | None = None,
        max_nodes: int = MAX_NODES,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        super().__init__(model)
        self.simulations, self.merge, self.max_nodes, self.max_bytes = simulations, merge, max_nodes, max_bytes
        check_count("simulations", simulations)
        if samples is not None:
            check_count("samples", samples)
        lists = samples is None and isinstance(model, EnumeratingModel)
        self.topology = Topology(listing(model, "mcts"), max_bytes=max_bytes) if lists else None
        self.samples = samples or DEFAULT_SAMPLES
        if not lists:
            drawing(model, "mcts")

    def _look(
        self, root_B: Tensor, depth: int, q_leaf: Leaf | None, v_leaf: Leaf | None, generator: torch.Generator
    ) -> Lookahead:
        topology, calls_each = self.topology, 1
        if topology is None:
            key = draw_keys(1, generator=generator).to(self.model.device)
            drawn = Drawn(drawing(self.model, "mcts"), samples=self.samples, key=key)
            topology = Topology(drawn, max_bytes=self.max_bytes)
            calls_each = self.samples
        look = mcts(
            topology.model,
            root_B,
            depth=depth,
            q_leaf=q_leaf,
            v_leaf=v_leaf,
            simulations=self.simulations,
            merge=self.merge,
            topology=topology,
            generator=generator,
            max_nodes=self.max_nodes,
        )
        return replace(look, model_calls=look.model_calls * calls_each)

    def forget(self) -> None:
        if self.topology is not None:
            self.topology = self.topology.anew()

    def __str__(self) -> str:
        drawn = "" if self.topology is not None else f", {self.samples} drawn outcomes of each action"
        return f"mcts, {self.simulations} simulations{', merged' if self.merge else ''}{drawn}"


def listing(model: Model, kind: str) -> EnumeratingModel:
    """The model, if it lists outcomes; else MissingModel."""
    if not isinstance(model, EnumeratingModel):
        raise MissingModel(
            f"the search {kind!r} needs a model that lists its outcomes; {type(model).__name__} does not"
        )
    return model


def drawing(model: Model, kind: str) -> SamplingModel:
    """The model, if it draws outcomes; else MissingModel."""
    if not isinstance(model, SamplingModel):
        raise MissingModel(f"the search {kind!r} needs a model that draws outcomes; {type(model).__name__} does not")
    return model
