"""Texts and pictures of a tabular MDP with one state occupied."""

import math
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP

MAX_SIDE = 512
"""Longest side of a picture in pixels, and so the most rows or columns that one can have."""

MAX_CELL = 64
LONGEST_LINE = 32
"""A chain of more states than this is wrapped."""

PAPER = np.array([250, 250, 248], dtype=np.float64)
SHADE = np.array([226, 226, 222], dtype=np.float64)
LINE = np.array([205, 205, 200], dtype=np.float64)
GOAL = np.array([46, 160, 67], dtype=np.float64)
TRAP = np.array([207, 54, 54], dtype=np.float64)
START = np.array([31, 111, 235], dtype=np.float64)
AGENT = np.array([36, 41, 47], dtype=np.float64)


@final
class Drawing:
    """The states of an MDP, laid out as `mdp.shape` says, except that a long chain is wrapped into lines.

    A state is a goal if some action earns a positive reward in it, and a trap if every action costs. Starts are marked
    unless an episode can begin everywhere. States that no episode enters are left out.
    """

    def __init__(self, mdp: TabularMDP) -> None:
        self.mdp = mdp
        self.rows, self.columns = _layout(mdp)
        self.reached_S = _entered(mdp)
        self.reward_S = mdp.outcomes.reward_NA.amax(-1).numpy()
        start_S = mdp.start_S.numpy() > 0
        self.start_S = start_S & ~start_S.all()
        self._background: Float[np.ndarray, "height width 3"] | None = None

    def text(self, state: int, *, last_action: int | None, num_steps: int) -> str:
        """The step, the last action and the states: `+` goal, `-` trap, `S` start, `.` other, the agent in brackets."""
        marks = [~self.reached_S, self.reward_S > 0, self.reward_S < 0, self.start_S]
        symbol_S = np.select(marks, [" ", "+", "-", "S"], ".")
        cells = [f"[{symbol}]" if s == state else f" {symbol} " for s, symbol in enumerate(symbol_S)]
        lines = ["".join(cells[first : first + self.columns]).rstrip() for first in range(0, len(cells), self.columns)]
        action = "" if last_action is None else f", action {self.mdp.action_names[last_action]}"
        return "\n".join([f"step {num_steps}{action}", *lines, ""])

    def picture(self, state: int) -> UInt8[np.ndarray, "height width 3"]:
        """Goals green and traps red, the stronger the deeper; starts outlined in blue; the agent as a dark disc.

        Raises:
            PgtsError: the layout has more than 512 rows or columns.
        """
        if self._background is None:
            self._background = self._draw_background()
        cover = _disc(self._background.shape[:2], divmod(state, self.columns), self._cell)[..., None]
        return (self._background * (1 - cover) + AGENT * cover).round().astype(np.uint8)

    @property
    def _cell(self) -> int:
        """The side of a cell in pixels."""
        return min(MAX_CELL, MAX_SIDE // max(self.rows, self.columns))

    def _draw_background(self) -> Float[np.ndarray, "height width 3"]:
        """Everything but the agent."""
        if max(self.rows, self.columns) > MAX_SIDE:
            raise PgtsError(
                f"a picture has at most {MAX_SIDE} rows and columns; the MDP has {self.rows} x {self.columns}"
            )
        image = self._spread(self._colours(), LINE)
        if self._cell >= 8:  # in smaller cells the lines would hide the colours
            border = _border_distance(self.rows, self.columns, self._cell)
            image[border == 0] = LINE
            image[self._spread(self.start_S, False) & (border >= 1) & (border < 2 + self._cell // 16)] = START
        return image

    def _colours(self) -> Float[np.ndarray, "S 3"]:
        """Paper mixed with green or red: a quarter where the reward is near 0, all where it is the strongest."""
        colour_S3 = np.where(self.reached_S[:, None], PAPER, SHADE)
        for mask_S, colour in [(self.reward_S > 0, GOAL), (self.reward_S < 0, TRAP)]:
            mask_S = mask_S & self.reached_S
            if mask_S.any():
                strength = np.abs(self.reward_S[mask_S, None])
                share = 0.25 + 0.75 * strength / strength.max()
                colour_S3[mask_S] = PAPER * (1 - share) + colour * share
        return colour_S3

    def _spread(self, value_S: np.ndarray, beyond: np.ndarray | bool) -> np.ndarray:
        """Values of the states as pixels; places beyond the last state hold `beyond`."""
        shape = value_S.shape[1:]
        full = np.full((self.rows * self.columns, *shape), beyond, dtype=value_S.dtype)
        full[: len(value_S)] = value_S
        cells = full.reshape(self.rows, self.columns, *shape)
        return cells.repeat(self._cell, axis=0).repeat(self._cell, axis=1)


def _layout(mdp: TabularMDP) -> tuple[int, int]:
    """(rows, columns): the shape of the MDP, a chain that is too long for one line wrapped into a square."""
    rows, columns = mdp.shape
    if rows > 1 or columns <= LONGEST_LINE:
        return rows, columns
    columns = math.isqrt(mdp.num_states - 1) + 1
    return -(-mdp.num_states // columns), columns


def _entered(mdp: TabularMDP) -> Bool[np.ndarray, "S"]:
    """The states that some episode enters, the terminal ones included."""
    legal_SA = mdp.outcomes.legal_NA.double()
    uniform_SA = legal_SA / legal_SA.sum(-1, keepdim=True)
    entered_S = exact.support(mdp, uniform_SA)
    outcomes = mdp.outcomes.rows(entered_S.nonzero().flatten())
    entered_S[outcomes.child_NAK[outcomes.prob_NAK > 0]] = True
    return entered_S.numpy()


def _border_distance(rows: int, columns: int, cell: int) -> Int[np.ndarray, "height width"]:
    """How many pixels lie between each pixel and the border of its cell."""
    offset = np.arange(cell)
    distance = np.minimum(offset, cell - 1 - offset)
    return np.tile(np.minimum.outer(distance, distance), (rows, columns))


def _disc(size: tuple[int, ...], place: tuple[int, int], cell: int) -> Float[np.ndarray, "height width"]:
    """How much of each pixel a disc in one cell covers; visible also where cells are a pixel wide."""
    vertical, horizontal = (
        np.arange(side) + 0.5 - (position + 0.5) * cell for side, position in zip(size, place, strict=True)
    )
    radius = max(0.3 * cell, 2.0)
    return np.clip(radius + 0.5 - np.hypot(vertical[:, None], horizontal), 0.0, 1.0)
