"""Options of the lookahead T^m Q: its depth, and the search that computes it."""

from collections.abc import Sequence
from typing import Any, Literal

from pydantic import ValidationInfo

from pgts_torch.options.fields import (
    AtLeastOne,
    Count,
    Natural,
    NonNegative,
    Samples,
    Several,
    UnitInterval,
    checks,
    conflict,
)
from pgts_torch.options.part import Part, null

MAX_NODES = 10_000_000
MAX_BYTES = 4 * 2**30


class Budget(Part):
    """The limits of one search."""

    max_nodes: Count = MAX_NODES
    """The largest number of nodes of one search. With auto a search that needs more is narrowed; otherwise it is an
    error."""

    max_bytes: Count = MAX_BYTES
    """The most memory of one search at its peak, with what is kept for the next ones. With auto a search that needs
    more is narrowed; otherwise it is an error, before the memory is used."""


class Auto(Budget):
    """The search that suits the model and the budget."""

    kind: Literal["auto"] = "auto"

    max_calls: Count | None = None
    """The largest number of model calls of one search. One that may need more expands fewer states of each level, or
    samples fewer outcomes; null: as many as it takes."""


class Expectimax(Budget):
    """Enumerates all outcomes of all actions."""

    kind: Literal["expectimax"] = "expectimax"

    max_width: Count | None = None
    """The largest number of states that are expanded at a level; null: all."""

    doubt: bool = False
    """Whether to compute by how much lookahead values may be off because the model is (`search/doubt`); 0 for exact
    models."""

    @checks("doubt")
    def _is_of_full_width(cls, value: Any, info: ValidationInfo) -> Any:
        if value and info.data.get("max_width") is not None:
            raise conflict(
                f"search.doubt needs all states of a level, but search.max_width is {info.data['max_width']}"
            )
        return value


class Sampled(Budget):
    """Samples outcomes of all actions."""

    kind: Literal["sampled"] = "sampled"

    samples: Samples = 4
    """Sampled outcomes of each state and action."""

    share: Literal["none", "level", "search"] = "level"
    """Which paths use the same samples of a state. none: each path has its own; level: those that meet at one level;
    search: all that meet."""


class MCTS(Budget):
    """A tree search that expands the most promising states (Monte-Carlo tree search)."""

    kind: Literal["mcts"] = "mcts"

    simulations: Count = 64
    """States expanded below each root."""

    root: Literal["gumbel", "rule"] = "gumbel"
    """How simulations are distributed over the actions of a root. gumbel: sequential halving (Danihelka et al. 2022);
    rule: as below the root."""

    rule: Literal["gumbel", "puct", "uct"] = "gumbel"
    """How actions are selected below the root."""

    exploration: NonNegative | None = None
    """c of puct and uct; null: 1.25."""

    wave: Count | None = None
    """The largest number of simulations of one action of a root (with root rule: of the root) between two backups of
    values; 1 is the ordinary search. null: 1 on the CPU, where loops are compiled, else as many as possible."""

    prior: Literal["uniform", "policy"] = "uniform"
    """The prior probabilities of actions: uniform, or those of the current policy, as in AlphaZero."""

    backup: Literal["max", "mean"] = "max"
    """The value of a node: the maximum over its actions or, for comparison, the mean return of its simulations."""

    merge: bool | None = None
    """Whether paths that meet in a state share one node; null: true with backup max."""

    samples: Count | None = None
    """The number of sampled outcomes of each action, new ones in each search; null: all outcomes are enumerated, or 4
    sampled where the model cannot enumerate them."""

    widening: AtLeastOne | None = None
    """C of progressive widening: a node that was visited N times has the first C N^alpha of the actions that are drawn
    for it, and the model is queried for these alone (Couetoux et al. 2011); null: all at once. Only with policy.type
    gaussian."""

    widening_power: UnitInterval | None = None
    """alpha of progressive widening; null: 0.5."""

    @property
    def merges(self) -> bool:
        """Whether paths that meet in a state share one node, also where `merge` is null."""
        return self.backup == "max" and self.widening is None if self.merge is None else self.merge

    @checks("widening")
    def _widens_trees_of_maxima(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None:
            for name, allowed in (
                ("wave", (None, 1)),
                ("backup", ("max",)),
                ("merge", (None, False)),
                ("samples", (None,)),
            ):
                if (other := info.data.get(name)) not in allowed:
                    raise conflict(
                        f"search.widening is {value}, which needs search.{name} {allowed[-1]}; it is {other}: nodes "
                        "get their actions one simulation after another, in trees with maxima"
                    )
        return value

    @checks("widening_power")
    def _is_of_widening(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("widening", ...) is None:
            raise conflict(f"search.widening_power is {value}, which only search.widening uses")
        return value

    @checks("exploration")
    def _has_exploration(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("rule") == "gumbel":
            raise conflict(f"search.exploration is {value}; search.rule gumbel has none, it must be puct or uct")
        return value

    @checks("prior")
    def _is_used(cls, value: Any, info: ValidationInfo) -> Any:
        if value == "policy" and (info.data.get("root"), info.data.get("rule")) == ("rule", "uct"):
            raise conflict("search.prior is policy, which search.rule uct with search.root rule does not use")
        return value

    @checks("merge")
    def _has_returns_of_its_own(cls, value: Any, info: ValidationInfo) -> Any:
        if value and info.data.get("backup") == "mean":
            raise conflict(
                "search.merge is true, which needs search.backup max: a node that several paths share has no return of "
                "its own"
            )
        return value


Kind = Auto | Expectimax | Sampled | MCTS
"""The values of the argument `search` of `PGTS`, between which `search.kind` chooses in a configuration."""


class LookaheadOptions(Part):
    """The lookahead T^m Q at the visited states."""

    depth: Natural | Literal["adaptive"] = 4
    """m, how often the Bellman optimality operator is applied; 0 is plain policy gradient. adaptive: in each iteration
    the smallest m whose lookahead finds a large enough improvement, see tolerance."""

    max_depth: Natural | None = null(adaptive=64)
    """The largest adaptive depth."""

    tolerance: NonNegative | None = null(adaptive=0.7)
    """An adaptive depth is enough if its stationarity gap, summed over the occupancy, is more than this fraction of the
    upper bound on the optimality gap of the visited states."""

    stop_at: NonNegative | None = None
    """Training ends once the certificate, an upper bound on the optimality gap, is at most this; null: never. It is a
    proof if the start distribution is known, the critic exact and the model the environment; else an estimate."""

    max_roots: Count | None = None
    """The most visits that the lookahead of an update starts from, where more different states were visited: they are
    drawn evenly from all visits and weigh as much as these together, so that the gradient is right in the mean. null:
    all."""

    action_repeat: Count = 1
    """How often the lookahead repeats each action, so that it looks as many times further ahead. Not in environments
    with numbered states."""

    actions: Several | None = null(gaussian=16)
    """The number of actions that are drawn in each state of the lookahead where the policy is gaussian; of a single one
    nothing could be learned."""

    proposal_scale: AtLeastOne | None = null(gaussian=2.0)
    """The standard deviation of half of the drawn actions, in that of the policy, which draws the others."""

    model_check: Literal["error", "warn", "off"] = "error"
    """Whether each step of the environment is checked against its model. error: the first contradiction stops the
    training; warn: it is a warning and is counted; off: steps are not checked."""

    @property
    def depths(self) -> Sequence[int]:
        """The depths that an iteration tries, in order."""
        return range(self.filled("adaptive").max_depth + 1) if self.depth == "adaptive" else (self.depth,)

    @checks("max_depth", "tolerance")
    def _only_adaptive(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("depth", "adaptive") != "adaptive":
            name, depth = info.field_name, info.data["depth"]
            raise conflict(f"search.{name} is {value}, which only search.depth adaptive uses; search.depth is {depth}")
        return value


class AutoSection(Auto, LookaheadOptions):
    """The search that suits the model and the budget."""


class ExpectimaxSection(Expectimax, LookaheadOptions):
    """Enumerates all outcomes of all actions."""


class SampledSection(Sampled, LookaheadOptions):
    """Samples outcomes of all actions."""


class MCTSSection(MCTS, LookaheadOptions):
    """A tree search that expands the most promising states (Monte-Carlo tree search)."""


SearchSection = AutoSection | ExpectimaxSection | SampledSection | MCTSSection
"""The section `search` of a configuration."""
