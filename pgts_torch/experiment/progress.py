"""Progress on the terminal while a training runs."""

import sys
from collections.abc import Mapping

from tqdm import tqdm

PLAIN_LINES = 20
"""About how many lines a run prints where there is no terminal to draw a progress bar on."""


class Reporter:
    """A progress bar on a terminal; elsewhere about `PLAIN_LINES` lines in all.

    Args:
        shown: False: print nothing.
    """

    def __init__(self, total_steps: int, *, shown: bool) -> None:
        self._total, self._shown = total_steps, shown
        self._terminal = shown and sys.stderr.isatty()
        self._bar = tqdm(total=total_steps, unit="step", disable=not self._terminal, dynamic_ncols=True)
        self._next = 0

    def line(self, step: int, tags: Mapping[str, float]) -> None:
        """Show return, J and gap of one iteration, those that there are."""
        shown_as = {"charts/episodic_return": "return", "exact/J": "J", "search/stationarity_gap": "gap"}
        numbers = {name: tags[tag] for tag, name in shown_as.items() if tag in tags}
        if self._terminal:
            self._bar.set_postfix({name: f"{value:.3g}" for name, value in numbers.items()}, refresh=False)
            self._bar.update(min(step, self._total) - self._bar.n)
        elif self._shown and step >= self._next:
            self._next = step + self._total // PLAIN_LINES
            shown = "  ".join(f"{name} {value:8.3f}" for name, value in numbers.items())
            print(f"step {step:>9}  {shown}", file=sys.stderr)

    def close(self) -> None:
        self._bar.close()
