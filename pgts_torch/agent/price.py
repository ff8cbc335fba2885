"""What an iteration costs, said before it is paid; and what makes it cheaper."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import final

from tqdm import tqdm

from pgts_torch import compiled
from pgts_torch.agent.dyna import Dyna
from pgts_torch.options.replay import UniformReplay
from pgts_torch.options.rollouts import GeometricHorizon
from pgts_torch.options.search import MCTS, AutoSection, ExpectimaxSection, MCTSSection, SampledSection
from pgts_torch.options.training import Training
from pgts_torch.ranks import Ranks
from pgts_torch.search.engine import MCTSSearch, Search
from pgts_torch.search.price import Meter

LONG = 30.0
"""An iteration that takes more seconds is said to take long, with what makes it shorter."""

PATIENCE = 3.0
"""What the episodes of an iteration will take is foreseen after so many seconds."""

SHORT = 1.0
"""What an iteration costs that takes fewer seconds is not said of tables, which are read without model calls."""

_AIM = 10.0
"""So many seconds an iteration are to take with the numbers that are named."""


@dataclass(frozen=True)
class Price:
    """What an iteration costs: all its model calls, and its seconds.

    is_bound: whether they may be less, as in a tree search whose paths meet.
    search: what is searched within a number of calls that was set; empty: there is none, or it is not known yet.
    advice: options that make a long iteration shorter.
    """

    calls: float
    seconds: float
    is_bound: bool = False
    search: str = ""
    advice: tuple[str, ...] = ()

    def __str__(self) -> str:
        """In a sentence."""
        about = "up to" if self.is_bound else "about"
        calls = f"{round(_round(self.calls, 3)):,} model calls and " if self.calls else ""
        said = f"an iteration takes {about} {calls}{_seconds(self.seconds)}"
        said += f", by {self.search}" * bool(self.search)
        return said + (f"; cheaper: {', '.join(self.advice)}" if self.advice else "")


@final
class Pricing:
    """Finds out what an iteration of a training costs: from its first states where that is much, else from its second
    iteration, in which nothing is done for the first time.

    price: None as long as it is not known.
    looking: the seconds of the lookaheads of the latest iteration.
    meter: what the search is measured by; None where nothing is measured.

    Args:
        search: that of the policy that is trained; None: there is none, and no price.
        dyna: makes several updates of an iteration; None: there is one.
        levels: how many levels the deepest search of an update expands; None: that depends.
        calls: returns the number of model calls so far in this process.
        has_table: whether the model is a table, given or counted.
        ranks: the processes that train together; the first one speaks, and takes the others to be alike.
    """

    def __init__(
        self,
        options: Training,
        search: Search | None,
        dyna: Dyna | None,
        *,
        levels: int | None,
        calls: Callable[[], int],
        has_table: bool,
        ranks: Ranks,
    ) -> None:
        self._options, self._search, self._dyna, self._calls, self._ranks = options, search, dyna, calls, ranks
        self._levels, self._has_table, self._iterations, self._updates = levels, has_table, 0, 0
        self._calls_before, self._seconds_before = 0, 0.0
        self.looking, self._begun, self._has_told = 0.0, 0.0, False
        self.price: Price | None = None
        self.meter: Meter | None = None

    def begin(self) -> None:
        """An iteration begins."""
        self.looking, self._begun = 0.0, compiled.clock()
        self._calls_before, self._iterations, self._updates = self._calls(), self._iterations + 1, 0
        if self._search is not None and self.price is None:
            self.meter = self._search.meter = Meter(self._foresee, self._levels)

    def stepped(self, steps: int, most: int | None) -> None:
        """The episodes of an iteration have made so many steps, of `most`. Once it is said if they take long."""
        if self._has_told or not steps or most is None or (seconds := compiled.clock() - self._begun) < PATIENCE:
            return
        self._has_told = True
        if (total := seconds * most / steps) > LONG and self._ranks.leads:
            tqdm.write(
                f"note: the episodes of an iteration take up to {_seconds(total)}; cheaper: fewer rollout.num_envs, a "
                "shorter rollout.horizon.length, pgts train --processes N",
                file=sys.stderr,
            )

    def update(self) -> None:
        """An update begins."""
        if self.meter is not None:
            self.meter.update()
            self._updates += 1
            if self._updates == 1:
                self._seconds_before = self.meter.seconds

    @contextmanager
    def lookahead(self) -> Iterator[None]:
        """The lookahead of an update."""
        begun = compiled.clock()
        yield
        self.looking += compiled.clock() - begun

    def end(self, model_calls: int) -> None:
        """An iteration is over, with so many model calls of all processes."""
        if self._search is None or self.meter is None:
            return
        if self.price is None and self._iterations == 2:
            section = self._options.search
            picked = isinstance(section, AutoSection) and section.max_calls is not None
            self.price = Price(model_calls, self.meter.seconds, search=str(self._search) * picked)
            if self.price.seconds > SHORT or not self._has_table:
                self.say()
        self.meter = self._search.meter = None

    def say(self) -> None:
        """Print the price."""
        if self._ranks.leads:
            tqdm.write(f"note: {self.price}", file=sys.stderr)

    def _foresee(self, states: float, seconds: float) -> None:
        """Say the price of the iteration under way, as long as its episodes are as now.

        Args:
            states: how many states the model will have been queried for in this update.
            seconds: what that takes from now on.
        """
        meter, search = self.meter, self._search
        assert meter is not None
        assert search is not None
        calls = states * search.calls_of_state
        # With replay several updates follow; they are taken to cost what those so far do.
        of_all = 1.0 if self._dyna is None else 1 + (self._dyna.num_due - 1) / self._updates
        all_calls = (self._calls() - self._calls_before + calls) * of_all * self._ranks.size
        updates = (meter.seconds + seconds - self._seconds_before) * of_all
        total = self._seconds_before + updates
        advice: tuple[str, ...] = ()
        if total > LONG and updates > total / 2:
            advice = cheaper(self._options, search, roots=meter.roots, calls=calls, share=_AIM / total)
        self.price = Price(all_calls, total, isinstance(search, MCTSSearch), advice=advice)
        self.say()


def cheaper(options: Training, search: Search, *, roots: int, calls: float, share: float) -> tuple[str, ...]:
    """Options that make an update cheaper than it is, as they are called in a configuration.

    Args:
        roots: how many states its lookahead starts from.
        calls: its model calls.
        share: what part of it a number that is named should cost.
    """
    section, found = options.search, list[str]()
    if isinstance(section.depth, int) and section.depth > 0 and not isinstance(section, MCTSSection):
        found.append(f"search.depth {section.depth - 1}")
    if (fewer := _round(roots * share, 1)) < roots:
        found.append(f"search.max_roots {max(fewer, 1):,} (now {roots:,})")
    if isinstance(section, AutoSection) and (budget := _round(calls * share, 1)) > 2 * roots * search.calls_of_state:
        found.append(f"search.max_calls {budget:,}")
    if isinstance(section, ExpectimaxSection) and section.max_width is None and section.depth != 0:
        found.append("search.max_width")
    if isinstance(section, SampledSection) and search.num_samples > 1:
        found.append(f"search.samples {search.num_samples // 2}")
    if isinstance(section, MCTSSection) and section.simulations > 1:
        found.append(f"search.simulations {max(1, _round(section.simulations * share, 1))}")
    elif section.depth != 0 and (tree := roots * MCTS().simulations * search.calls_of_state) < calls / 2:
        found.append(f"search.kind mcts (at most {_round(tree, 2):,} model calls)")
    if section.action_repeat > 1:
        found.append(f"search.action_repeat {section.action_repeat // 2}")
    if isinstance(options.replay, UniformReplay):
        found.append(f"replay.updates_per_step {_round(options.replay.updates_per_step or 0, 1) / 2:g}")
    elif not isinstance(options.rollout.horizon, GeometricHorizon):
        found.append("a shorter rollout.horizon.length")
    return tuple(found)


def _round(number: float, digits: int) -> int | float:
    """To so many significant digits."""
    rounded = float(f"{number:.{digits}g}")
    return int(rounded) if rounded >= 1 else rounded


def _seconds(seconds: float) -> str:
    return f"{_round(seconds, 2):,} s"
