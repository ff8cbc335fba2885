"""Searches as objects: one way to look ahead in one model, with what it remembers from one search to the next."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, final, get_args

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.errors import MissingModel, PgtsError, check_count
from pgts_torch.models.base import EnumeratingModel, Model, SamplingModel
from pgts_torch.search.empirical import FixedSamples, Share
from pgts_torch.search.expectimax import full_width
from pgts_torch.search.lookahead import MAX_BYTES, MAX_NODES, Leaf, Leaves, Lookahead, check_finite
from pgts_torch.search.mcts import Root, check_options, grow
from pgts_torch.search.pruned import pruned
from pgts_torch.search.sampled import plan_levels, sparse
from pgts_torch.search.split import Rule
from pgts_torch.search.topology import Topology
from pgts_torch.search.tree import Backup
from pgts_torch.seeding import draw_keys

DEFAULT_SAMPLES = 4
REPLICATES = 8
"""Of the bootstrap of a sampled search: enough for the size of all standard errors together, which shortens steps."""

Prior = Literal["uniform", "policy"]
"""The probabilities that a tree search starts from: the same for all actions, or those of the current policy."""


class Search(ABC):
    """(T^m Q)(s, .) at the roots of one model.

    model_calls: for how many (state, action) it has queried the model so far.
    topology: what it remembers of a model that enumerates outcomes; None: it remembers no outcomes.
    choices: the names of the attributes by which earlier searches decide how later ones are made.
    uses_prior: whether it starts from the probabilities of the current policy.
    """

    topology: Topology | None = None
    choices: tuple[str, ...] = ()
    uses_prior: bool = False

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
    ) -> Lookahead:
        """One search; the arguments are those of `expectimax`.

        Args:
            prior: the current policy, states [N] to probabilities [N, A]; for a search that `uses_prior`.
            generator: used only by searches that sample outcomes or noise; equal states of it give equal searches.

        Raises:
            NotFinite: the value of the best action of a root is not finite.
            PgtsError: the search uses a prior, and none is given.
        """
        if self.uses_prior and prior is None:
            raise PgtsError("the prior of the search is that of the policy: give prior")
        leaves = Leaves(self.model, depth, q_leaf, v_leaf, prior if self.uses_prior else None)
        look = self.look_ahead(leaves, root_B, generator)
        check_finite("lookahead", "the lookahead", look.q_BA, root_B)
        self.model_calls += look.model_calls
        return look

    @abstractmethod
    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        """The search itself: `__call__` checks its values and counts its model calls."""

    @abstractmethod
    def reset(self) -> None:
        """Drop what was learned of the model's states: their ids have been given to other states."""

    def state_dict(self, *, with_states: bool) -> dict[str, Any]:
        """What later searches depend on: plain values, and a tensor on the CPU.

        Args:
            with_states: whether states keep their ids, so that the queried ones can be named.
        """
        queried = self.topology.queried.cpu() if with_states and self.topology is not None else torch.empty(0).long()
        return {
            "choices": {name: getattr(self, name) for name in self.choices},
            "lists": self.topology is not None,
            "asked": queried,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned: later searches, and their model calls, are those of the search that
        returned it.

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
            self.topology.preload(state["asked"].to(self.model.device))

    def check_choices(self, choices: Mapping[str, Any]) -> None:
        """PgtsError unless earlier searches can have chosen this."""
        if set(choices) != set(self.choices):
            raise PgtsError(f"its choices are {sorted(choices)}; {type(self).__name__} makes {sorted(self.choices)}")

    @abstractmethod
    def __str__(self) -> str:
        """What it does, in a few words, and why if it chose that itself."""


@final
class ExpectimaxSearch(Search):
    """`expectimax` over one topology: each (state, action) is queried once in however many searches.

    Args:
        model: enumerates outcomes.
        max_nodes: the most nodes of one search.
        max_width: the most states of a level that are expanded. Default: all.
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
        self.topology: Topology = Topology(enumerating(model, "expectimax"), max_bytes=max_bytes)
        if max_width is not None:
            check_count("max_width", max_width)
        self.max_nodes, self.max_width = max_nodes, max_width

    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        if self.max_width is None:
            return full_width(leaves, self.topology, root_B, max_nodes=self.max_nodes)
        return pruned(leaves, self.topology, root_B, max_width=self.max_width, max_nodes=self.max_nodes)

    def reset(self) -> None:
        self.topology = self.topology.fresh()

    def __str__(self) -> str:
        return "expectimax" if self.max_width is None else f"expectimax, {self.max_width} states a level"


@final
class SampledSearch(Search):
    """`sampled`, with fresh samples in each search, and with standard errors from a few replicates.

    Args:
        model: samples outcomes.
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
        self._model = sampling(model, "sampled")
        plan_levels(samples, 1, share, model)
        self.samples, self.share, self.max_nodes, self.max_bytes = samples, share, max_nodes, max_bytes

    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        return sparse(
            leaves,
            self._model,
            root_B,
            samples=self.samples,
            share=self.share,
            generator=generator,
            replicates=REPLICATES,
            max_nodes=self.max_nodes,
            max_bytes=self.max_bytes,
        )

    def reset(self) -> None:
        """It remembers nothing."""

    def __str__(self) -> str:
        return f"sampled, {self.samples} outcomes of each action, shared by {self.share}"


@final
class MCTSSearch(Search):
    """`mcts`, by default with maximum backups and uniform priors: those of the policy look first where it goes already.

    Args:
        model: enumerates outcomes, or samples them.
        simulations: of each root.
        root, rule, exploration, wave, backup: see `mcts`.
        prior: "uniform", or "policy": the probabilities of the current policy, as in AlphaZero.
        merge: whether paths that meet are one node. Default: with maximum backups.
        samples: how many sampled outcomes of each action stand for all, fresh ones in each search. Default: all are
            enumerated, or 4 are sampled where the model cannot enumerate them.
        max_nodes: the most nodes of one search.
        max_bytes: the most memory that a search may take, with what is remembered.
    """

    def __init__(
        self,
        model: Model,
        *,
        simulations: int = 64,
        root: Root = "gumbel",
        rule: Rule = "gumbel",
        exploration: float | None = None,
        wave: int | None = None,
        prior: Prior = "uniform",
        backup: Backup = "max",
        merge: bool | None = None,
        samples: int | None = None,
        max_nodes: int = MAX_NODES,
        max_bytes: int = MAX_BYTES,
    ) -> None:
        super().__init__(model)
        if prior not in get_args(Prior):
            raise PgtsError(f"prior is {prior!r}; it must be one of {', '.join(map(repr, get_args(Prior)))}")
        self.simulations, self.root, self.rule, self.exploration = simulations, root, rule, exploration
        self.wave, self.backup, self.uses_prior = wave, backup, prior == "policy"
        self.max_nodes, self.max_bytes = max_nodes, max_bytes
        self.merge = backup == "max" if merge is None else merge
        check_options(
            simulations=simulations,
            root=root,
            rule=rule,
            exploration=exploration,
            wave=wave,
            has_prior=self.uses_prior,
            backup=backup,
            merge=self.merge,
        )
        if samples is not None:
            check_count("samples", samples)
        enumerates = samples is None and isinstance(model, EnumeratingModel)
        self.topology = Topology(enumerating(model, "mcts"), max_bytes=max_bytes) if enumerates else None
        self.samples = samples or DEFAULT_SAMPLES
        if not enumerates:
            sampling(model, "mcts")

    def look_ahead(self, leaves: Leaves, root_B: Int[Tensor, "B"], generator: torch.Generator) -> Lookahead:
        topology, calls_each = self.topology, 1
        if topology is None:
            key = draw_keys(1, generator=generator).to(self.model.device)
            samples = FixedSamples(sampling(self.model, "mcts"), samples=self.samples, key=key)
            topology = Topology(samples, max_bytes=self.max_bytes)
            calls_each = self.samples
        look = grow(
            leaves,
            topology,
            root_B,
            simulations=self.simulations,
            root=self.root,
            rule=self.rule,
            exploration=self.exploration,
            wave=self.wave,
            backup=self.backup,
            merge=self.merge,
            generator=generator if self.root == "gumbel" else None,
            max_nodes=self.max_nodes,
        )
        return replace(look, model_calls=look.model_calls * calls_each)

    def reset(self) -> None:
        if self.topology is not None:
            self.topology = self.topology.fresh()

    def __str__(self) -> str:
        parts = [
            f"mcts, {self.simulations} simulations",
            f"{self.rule} at the root too" if self.root == "rule" else self.rule * (self.rule != "gumbel"),
            "the policy as prior" * self.uses_prior,
            "mean backups" * (self.backup == "mean"),
            "merged" * self.merge,
            f"{self.samples} sampled outcomes of each action" * (self.topology is None),
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
