"""The lookahead T^m Q at the visited states: how far, and how it is made."""

from collections.abc import Sequence
from typing import Any, Literal

from pydantic import ValidationInfo, field_validator

from pgts_torch.options.fields import Count, Natural, NonNegative, Samples, conflict
from pgts_torch.options.part import Part, null

MAX_NODES = 10_000_000
MAX_BYTES = 4 * 2**30


class Budget(Part):
    """What one search may take."""

    max_nodes: Count = MAX_NODES
    """The most nodes of one search. One that needs more is narrowed by auto and refused by the others."""

    max_bytes: Count = MAX_BYTES
    """The most memory that a search may take at its peak, with what is remembered for the next ones. One that needs
    more is treated likewise, before it takes it."""


class Auto(Budget):
    """Picks by what the model can do and by the budget."""

    kind: Literal["auto"] = "auto"


class Expectimax(Budget):
    """Looks at all outcomes of all actions."""

    kind: Literal["expectimax"] = "expectimax"

    max_width: Count | None = None
    """The most states of a level that are expanded; null: all."""


class Sampled(Budget):
    """Looks at outcomes that are drawn."""

    kind: Literal["sampled"] = "sampled"

    samples: Samples = 4
    """Outcomes drawn of each state and action."""

    share: Literal["none", "level", "search"] = "level"
    """What shares them: nothing, paths that meet at one level, or all that meet."""


class MCTS(Budget):
    """Looks where it seems worth while."""

    kind: Literal["mcts"] = "mcts"

    simulations: Count = 64
    """States expanded below each root."""

    root: Literal["gumbel", "rule"] = "gumbel"
    """How a root shares out its simulations. gumbel: sequential halving of its actions (Danihelka et al. 2022); rule:
    as below it."""

    rule: Literal["gumbel", "puct", "uct"] = "gumbel"
    """How actions are selected below the root."""

    exploration: NonNegative | None = None
    """c of puct and uct; null: 1.25."""

    wave: Count | None = None
    """The most simulations of one action of a root (with root rule: of the root) that are under way before values are
    backed up; 1 is the ordinary search, null the fastest."""

    prior: Literal["uniform", "policy"] = "uniform"
    """The probabilities that a search starts from: the same for all actions, or those of the current policy, as in
    AlphaZero."""

    backup: Literal["max", "mean"] = "max"
    """What the value of a node is: the maximum over its actions, or, for comparison, the mean of the returns seen."""

    merge: bool | None = None
    """Whether paths that meet are one node; null: with backup max."""

    samples: Count | None = None
    """How many sampled outcomes of each action stand for all, fresh ones in each search; null: all are enumerated, or 4
    sampled where the model cannot enumerate them."""

    @field_validator("exploration")
    @classmethod
    def _has_exploration(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("rule") == "gumbel":
            raise conflict(
                "search.exploration is {value}; search.rule gumbel has none, it must be puct or uct",
                "search.exploration",
                "search.rule",
                value=str(value),
            )
        return value

    @field_validator("prior")
    @classmethod
    def _is_used(cls, value: Any, info: ValidationInfo) -> Any:
        if value == "policy" and (info.data.get("root"), info.data.get("rule")) == ("rule", "uct"):
            raise conflict(
                "search.prior is policy, which search.rule uct with search.root rule does not use",
                "search.prior",
                "search.rule",
                "search.root",
            )
        return value

    @field_validator("merge")
    @classmethod
    def _has_returns_of_its_own(cls, value: Any, info: ValidationInfo) -> Any:
        if value and info.data.get("backup") == "mean":
            raise conflict(
                "search.merge is true, which needs search.backup max: a node that several paths share has no return of "
                "its own",
                "search.merge",
                "search.backup",
            )
        return value


Kind = Auto | Expectimax | Sampled | MCTS
"""Each is an argument of `PGTS`, and what `search.kind` chooses in a configuration."""


class Depth(Part):
    """The lookahead T^m Q at the visited states."""

    depth: Natural | Literal["adaptive"] = 4
    """m, how often the Bellman optimality operator is applied; 0 is plain policy gradient. adaptive: in each iteration
    the smallest m that sees most of what may be missing, see tolerance."""

    max_depth: Natural | None = null(adaptive=64)
    """The largest adaptive depth."""

    tolerance: NonNegative | None = null(adaptive=0.7)
    """An adaptive depth is enough if the gap that it sees, summed over the occupancy, is more than this share of
    what may be missing at the visited states."""

    stop_at: NonNegative | None = None
    """Training ends once the certificate says that the policy is this close to the optimal return; null: never. It is a
    proof if the start distribution is known, the critic exact and the model the environment; else an estimate."""

    action_repeat: Count = 1
    """How often the lookahead takes an action before it takes the next, so that it sees as many times further. Not in
    numbered environments."""

    model_check: Literal["error", "warn", "off"] = "error"
    """Each step of the environment is held to its model. error: the first contradiction stops the training; warn: it is
    said and counted; off: nobody looks."""

    @property
    def depths(self) -> Sequence[int]:
        """The depths that an iteration tries, in order."""
        return range(self.filled("adaptive").max_depth + 1) if self.depth == "adaptive" else (self.depth,)

    @field_validator("max_depth", "tolerance")
    @classmethod
    def _only_adaptive(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("depth", "adaptive") != "adaptive":
            raise conflict(
                "search.{name} is {value}, which only search.depth adaptive heeds; search.depth is {depth}",
                f"search.{info.field_name}",
                "search.depth",
                name=str(info.field_name),
                value=str(value),
                depth=str(info.data["depth"]),
            )
        return value


class AutoSearch(Auto, Depth):
    """Picks by what the model can do and by the budget."""


class ExpectimaxSearch(Expectimax, Depth):
    """Looks at all outcomes of all actions."""


class SampledSearch(Sampled, Depth):
    """Looks at outcomes that are drawn."""


class MCTSSearch(MCTS, Depth):
    """Looks where it seems worth while."""


Search = AutoSearch | ExpectimaxSearch | SampledSearch | MCTSSearch
"""The section `search` of a configuration."""
