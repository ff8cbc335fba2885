"""Searches as objects: one kind of lookahead in one model, with what it remembers from one search to the next."""

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.base import EnumeratingModel, FallibleModel, Model, SamplingModel
from pgts_torch.options.search import MCTS, Expectimax, Sampled
from pgts_torch.readings import Readings
from pgts_torch.search.empirical import FixedSamples
from pgts_torch.search.expectimax import search_levels
from pgts_torch.search.lookahead import Leaf, Leaves, Lookahead, check_finite
from pgts_torch.search.mcts import search_tree
from pgts_torch.search.memory import tree_nodes
from pgts_torch.search.price import Meter
from pgts_torch.search.sampled import plan_levels, search_samples
from pgts_torch.search.topology import Topology
from pgts_torch.search.widening import calls_of_simulation, drawn_actions
from pgts_torch.seeding import sample_keys

DEFAULT_SAMPLES = Sampled().samples
REPLICATES = 8
"""Of the bootstrap of a sampled search: enough for the size of all standard errors together, which shortens steps."""


class Search(ABC):
    """(T^m Q)(s, .) at the roots of one model.

    model_calls: for how many (state, action) it has queried the model so far.
    options: its options, with its limits.
    topology: what it remembers of a model that enumerates outcomes; None: it remembers no outcomes.
    choices: the names of the attributes by which earlier searches decide how later ones are made.
    uses_prior: whether it starts from the probabilities of the current policy.
    defers_checks: whether it goes on without harm from values that are not finite.
    leaf_error: the error of the critic from which the doubt of the lookahead is computed; None: it is not.
    meter: measures what it costs; None: nothing does.
    """

    topology: Topology | None = None
    choices: tuple[str, ...] = ()
    uses_prior: bool = False
    defers_checks: bool = False
    options: Any
    leaf_error: float | None = None
    meter: Meter | None = None

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
        prior: Leaf | None = None,
        generator: torch.Generator,
        readings: Readings | None = None,
    ) -> Lookahead:
        """One search; the arguments are those of `expectimax`.

        Args:
            prior: the current policy, states [N] to probabilities [N, A]; for a search that `uses_prior`.
            generator: used only by searches that sample outcomes or noise; equal states of it give equal searches.
            readings: where the checks wait whether values are finite; None: they are made at once.

        Raises:
            NotFinite: the value of the best action of a root is not finite.
            PgtsError: the search uses a prior, and none is given.
        """
        if self.uses_prior and prior is None:
            raise PgtsError("the prior of the search is that of the policy: give prior")
        own_prior, waiting = prior if self.uses_prior else None, readings if self.defers_checks else None
        leaves = Leaves(self.model, depth, q_leaf, v_leaf, own_prior, self.leaf_error, waiting)
        if self.meter is not None:
            leaves.meter, is_tree = self.meter, isinstance(self, MCTSSearch)
            self.meter.search(len(root_B), leaves.expansions, self.most_states, self._fits, is_tree=is_tree)
        look = self.look_ahead(leaves, root_B, generator)
        check_finite("lookahead", "the lookahead", look.q_BA, root_B, readings)
        self.model_calls += look.model_calls
        return look

    @abstractmethod
    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        """The search itself: `__call__` checks its values and counts its model calls."""

    @property
    def calls_of_state(self) -> int:
        """How many model calls expand a state; 1 where nodes are widened, and the meter is told of each call."""
        if getattr(self.options, "widening", None) is not None:
            return 1
        return self.model.num_actions * (1 if self.topology is not None else self.num_samples)

    @property
    def num_samples(self) -> int:
        """How many outcomes of an action it samples, where it does."""
        return 1

    @abstractmethod
    def most_states(self, roots: int, levels: int) -> float:
        """The most states that it expands below so many roots, on so many levels."""

    def _fits(self, size: float, total: float) -> bool:
        """Whether a level of so many states, after so many on those above it, is within the limits."""
        states = int(min(size + total, sys.maxsize))
        if states > self.options.max_nodes or self.topology is None:
            return states <= self.options.max_nodes
        new = max(0, states - self.topology.table.count)
        return self.topology.bytes(new, looked_up=int(size), kept=states) <= self.options.max_bytes

    def _within(self, states: float) -> float:
        """At most `max_nodes`, and all states where the model has a table of them."""
        is_table = isinstance(self.model, EnumeratingModel) and self.model.table is not None
        return min(states, self.options.max_nodes, self.model.num_states if is_table else math.inf)

    def reset(self) -> None:
        """Drop what was learned of the model's states: their ids have been given to other states."""
        if self.topology is not None:
            self.topology = self.topology.fresh()

    def state_dict(self, *, with_states: bool) -> dict[str, Any]:
        """What later searches depend on: plain values, and a tensor on the CPU.

        Args:
            with_states: whether states keep their ids, so that the queried ones can be named.
        """
        queried = (
            self.topology.table.queried.cpu() if with_states and self.topology is not None else torch.empty(0).long()
        )
        return {
            "choices": {name: getattr(self, name) for name in self.choices},
            "enumerates": self.topology is not None,
            "queried": queried,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned: later searches, and their model calls, are those of the search that
        returned it.

        Raises:
            PgtsError: it is that of another search.
        """
        self.check_choices(state["choices"])
        if state["queried"].dtype != torch.int64 or state["queried"].ndim != 1:
            raise PgtsError("queried is no list of states")
        for name in self.choices:
            setattr(self, name, state["choices"][name])
        if not state["enumerates"]:
            self.topology = None
        elif self.topology is not None:
            self.topology.preload(state["queried"].to(self.model.device))

    def check_choices(self, choices: Mapping[str, Any]) -> None:
        """PgtsError unless earlier searches can have chosen this."""
        if set(choices) != set(self.choices):
            raise PgtsError(f"its choices are {sorted(choices)}; {type(self).__name__} makes {sorted(self.choices)}")

    @abstractmethod
    def __str__(self) -> str:
        """What it does, in a few words, and why if it chose that itself."""


@final
class ExpectimaxSearch(Search):
    """`expectimax` over one topology: each (state, action) is queried once in however many searches."""

    defers_checks = True

    def __init__(self, model: Model, options: Expectimax = Expectimax()) -> None:  # noqa: B008 - frozen
        super().__init__(model)
        self.options = options
        self.topology: Topology = Topology(enumerating(model, "expectimax"), max_bytes=options.max_bytes)
        if options.doubt and not (model.exact or isinstance(model, FallibleModel)):
            raise PgtsError(
                f"search.doubt needs a model that says its error, a FallibleModel; {type(model).__name__} does not"
            )
        self.leaf_error = 0.0 if options.doubt else None  # the doubt is that of the model

    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        max_nodes, max_width = self.options.max_nodes, self.options.max_width
        return search_levels(leaves, self.topology, root_B, max_nodes=max_nodes, max_width=max_width)

    def most_states(self, roots: int, levels: int) -> float:
        width = self.options.max_width
        return self._within(math.inf if width is None else roots + width * (levels - 1))

    def __str__(self) -> str:
        width = self.options.max_width
        return "expectimax" if width is None else f"expectimax, {width} states a level"


@final
class SampledSearch(Search):
    """`sampled`, with fresh samples in each search, and with standard errors from a few replicates."""

    def __init__(self, model: Model, options: Sampled = Sampled()) -> None:  # noqa: B008 - frozen
        super().__init__(model)
        self.options = options
        self._model = sampling(model, "sampled")
        plan_levels(options, 1, model)

    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        return search_samples(leaves, self._model, root_B, self.options, generator, replicates=REPLICATES)

    @property
    def num_samples(self) -> int:
        samples = self.options.samples
        return samples if isinstance(samples, int) else samples[0] or 1

    def most_states(self, roots: int, levels: int) -> float:
        return self.options.max_nodes

    def __str__(self) -> str:
        return f"sampled, {self.options.samples} outcomes of each action, shared by {self.options.share}"


@final
class MCTSSearch(Search):
    """`mcts`, by default with maximum backups and uniform priors: those of the policy prefer where it goes already."""

    def __init__(self, model: Model, options: MCTS = MCTS()) -> None:  # noqa: B008 - frozen
        super().__init__(model)
        self.options, self.uses_prior = options, options.prior == "policy"
        self._samples = options.samples or DEFAULT_SAMPLES
        if options.widening is not None:
            drawn_actions(model, options)
        if options.samples is None and isinstance(model, EnumeratingModel):
            self.topology = Topology(model, max_bytes=options.max_bytes)
        else:
            sampling(model, "mcts")

    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        topology, calls_each = self.topology, 1
        if topology is None:
            key = sample_keys(1, generator=generator).to(self.model.device)
            samples = FixedSamples(sampling(self.model, "mcts"), samples=self._samples, key=key)
            topology = Topology(samples, max_bytes=self.options.max_bytes)
            calls_each = self._samples
        look = search_tree(leaves, topology, root_B, self.options, generator)
        return replace(look, model_calls=look.model_calls * calls_each)

    @property
    def num_samples(self) -> int:
        return self._samples

    def most_states(self, roots: int, levels: int) -> float:
        outcomes = self._samples if self.topology is None else getattr(self.model, "num_outcomes", None) or 1
        in_tree, actions = tree_nodes(1, self.model.num_actions * outcomes, levels - 1), self.model.num_actions
        if (widening := self.options.widening) is not None:  # the first simulation expands the root
            below = (self.options.simulations - 1) * calls_of_simulation(widening)
            return float(roots * min(actions + below, actions * in_tree))
        return self._within(roots * min(self.options.simulations, in_tree))

    def __str__(self) -> str:
        rule = self.options.rule
        parts = [
            f"mcts, {self.options.simulations} simulations",
            f"{rule} at the root too" if self.options.root == "rule" else rule * (rule != "gumbel"),
            "the policy as prior" * self.uses_prior,
            "mean backups" * (self.options.backup == "mean"),
            "merged" * self.options.merges,
            f"nodes widened from {self.options.widening:g} actions" if self.options.widening else "",
            f"{self._samples} sampled outcomes of each action" * (self.topology is None),
        ]
        return ", ".join(filter(None, parts))


def enumerating(model: Model, kind: str) -> EnumeratingModel:
    """The model, if it enumerates outcomes; else MissingModel."""
    if not isinstance(model, EnumeratingModel):
        raise MissingModel(
            f"the search {kind!r} needs a model that enumerates its outcomes; {type(model).__name__} does not"
        )
    return model


def sampling(model: Model, kind: str) -> SamplingModel:
    """The model, if it samples outcomes; else MissingModel."""
    if not isinstance(model, SamplingModel):
        raise MissingModel(f"the search {kind!r} needs a model that samples outcomes; {type(model).__name__} does not")
    return model
