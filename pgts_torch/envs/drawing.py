"""Texts and pictures of a tabular MDP with one state occupied."""

import math
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP

MAX_SIDE = 512
"""Longest side of a picture in pixels, and so the most rows or columns that one can have."""

MAX_CELL = 64
LONGEST_LINE = 32
"""A chain of more states than this is wrapped."""

MOST_DRAWN = 1024
"""The most states of which values and policy are drawn."""

PAPER = np.array([250, 250, 248], dtype=np.float64)
SHADE = np.array([226, 226, 222], dtype=np.float64)
LINE = np.array([205, 205, 200], dtype=np.float64)
GOAL = np.array([46, 160, 67], dtype=np.float64)
TRAP = np.array([207, 54, 54], dtype=np.float64)
START = np.array([31, 111, 235], dtype=np.float64)
AGENT = np.array([36, 41, 47], dtype=np.float64)
BAR = np.array([31, 119, 180], dtype=np.float64)
VIRIDIS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64)

SMALLEST_WRITTEN = 32
"""Values are written in cells of at least so many pixels."""

MOST_OUTLINED = 20
"""Start states are not outlined beside values where there are more of them."""

DIRECTIONS = {"left": (-1, 0), "right": (1, 0), "up": (0, -1), "down": (0, 1)}
"""The actions that are directions, as steps to the right and down."""


@final
class Drawing:
    """The states of an MDP, laid out as `mdp.shape` says, except that a long chain is wrapped into lines.

    A state is a goal if some action earns a positive reward in it, and a trap if every action costs. Starts are marked
    unless an episode can begin everywhere. States that no episode enters are left out.

    Args:
        side, cell: the longest side of a picture and of a cell, in pixels.
    """

    def __init__(self, mdp: TabularMDP, *, side: int = MAX_SIDE, cell: int = MAX_CELL) -> None:
        self.mdp, self._side, self._most = mdp, side, cell
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
        cover = _disc(self._background.shape[:2], divmod(state, self.columns), self.cell)[..., None]
        return (self._background * (1 - cover) + AGENT * cover).round().astype(np.uint8)

    @property
    def cell(self) -> int:
        """The side of a cell in pixels."""
        return min(self._most, self._side // max(self.rows, self.columns))

    def _draw_background(self) -> Float[np.ndarray, "height width 3"]:
        """Everything but the agent."""
        if max(self.rows, self.columns) > MAX_SIDE:
            raise PgtsError(
                f"a picture has at most {MAX_SIDE} rows and columns; the MDP has {self.rows} x {self.columns}"
            )
        image = self.spread(self._colours(), LINE)
        self.draw_borders(image)
        return image

    def draw_borders(self, image: Float[np.ndarray, "height width 3"], *, outlines: bool = True) -> None:
        """Draw lines between the cells, and outline the starts."""
        if self.cell >= 8:  # in smaller cells the lines would hide the colours
            border = _border_distance(self.rows, self.columns, self.cell)
            image[border == 0] = LINE
            if outlines:
                image[self.spread(self.start_S, False) & (border >= 1) & (border < 2 + self.cell // 16)] = START

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

    def spread(self, value_S: np.ndarray, beyond: np.ndarray | bool) -> np.ndarray:
        """Values of the states as pixels; places beyond the last state hold `beyond`."""
        shape = value_S.shape[1:]
        full = np.full((self.rows * self.columns, *shape), beyond, dtype=value_S.dtype)
        full[: len(value_S)] = value_S
        cells = full.reshape(self.rows, self.columns, *shape)
        return cells.repeat(self.cell, axis=0).repeat(self.cell, axis=1)


def policy_pixels(
    mdp: TabularMDP, v_S: Float[Tensor, "S"], pi_SA: Float[Tensor, "S A"], visited_S: Bool[Tensor, "S"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw a policy and its values, in the time of a few steps of a training.

    Values are colours from dark, the lowest, to yellow, the highest, with numbers where there is room. Beside or below
    them stands the policy: where actions are directions of a grid as lines whose length is the probability, else as a
    bar for each action in its order. Start states are outlined where they are few, states that the policy does not
    visit are pale.
    """
    from PIL import Image, ImageDraw, ImageFont

    drawing = Drawing(mdp, side=384, cell=48)
    cell, columns = drawing.cell, drawing.columns
    is_wide = columns > 2 * drawing.rows
    value_S, probability_SA = v_S.numpy(), pi_SA.numpy()
    low, high = float(value_S.min()), float(value_S.max())
    share_S = (value_S - low) / (high - low) if high > low else np.full(mdp.num_states, 0.5)
    colour_S3 = np.stack([np.interp(share_S, np.linspace(0, 1, len(VIRIDIS)), channel) for channel in VIRIDIS.T], -1)
    pale_S1 = np.where(visited_S.numpy(), 0.0, 0.6)[:, None]
    values = drawing.spread(colour_S3 * (1 - pale_S1) + PAPER * pale_S1, LINE)
    has_arrows = mdp.shape[0] > 1 and all(name in DIRECTIONS for name in mdp.action_names)
    bars = drawing.spread(np.where(visited_S.numpy()[:, None], PAPER, SHADE), LINE)
    if not has_arrows:
        bars[_bars(drawing, probability_SA)] = BAR
    drawing.draw_borders(values, outlines=int(drawing.start_S.sum()) <= MOST_OUTLINED)
    drawing.draw_borders(bars, outlines=False)
    panels = [Image.fromarray(image.round().astype(np.uint8)) for image in (values, bars)]
    font, centre = ImageFont.load_default(max(cell // 5, 8)), cell // 2
    pens, ink = [ImageDraw.Draw(panel) for panel in panels], tuple(BAR.astype(int))
    for s, value in enumerate(value_S.tolist()):
        y, x = (place * cell + centre for place in divmod(s, columns))
        if cell >= SMALLEST_WRITTEN:
            fill = "black" if share_S[s] > 0.6 or not visited_S[s] else "white"
            pens[0].text((x, y), f"{value:.{3 if cell >= 48 else 2}g}", fill=fill, font=font, anchor="mm")
        for a, name in enumerate(mdp.action_names if has_arrows else ()):
            (dx, dy), length = DIRECTIONS[name], 0.45 * cell * probability_SA[s, a]
            if length >= 1:
                pens[1].line((x, y, x + dx * length, y + dy * length), fill=ink, width=max(cell // 12, 1))
    width, height = panels[0].size
    title = 18
    page = Image.new(
        "RGB", (width if is_wide else 2 * width + title, (2 if is_wide else 1) * (height + title)), "white"
    )
    pen, small = ImageDraw.Draw(page), ImageFont.load_default(11)
    titles = (f"v(s), {low:.3g} to {high:.3g}", "policy")
    for number, (panel, words) in enumerate(zip(panels, titles, strict=True)):
        x, y = (0, number * (height + title)) if is_wide else (number * (width + title), 0)
        pen.text((x + 2, y + 2), words, fill="black", font=small)
        page.paste(panel, (x, y + title))
    return np.asarray(page)


def _bars(drawing: "Drawing", probability_SA: Float[np.ndarray, "S A"]) -> Bool[np.ndarray, "height width"]:
    """The pixels of bars in the cells, from below, one as high as each probability."""
    cell, num_actions = drawing.cell, probability_SA.shape[1]
    offset = np.arange(cell)
    height_SX = np.ceil(probability_SA[:, offset * num_actions // cell] * (cell - 1))
    filled_SYX = (cell - 1 - offset)[None, :, None] < height_SX[:, None, :]
    full = np.zeros((drawing.rows * drawing.columns, cell, cell), dtype=bool)
    full[: len(filled_SYX)] = filled_SYX
    lined = full.reshape(drawing.rows, drawing.columns, cell, cell).swapaxes(1, 2)
    return lined.reshape(drawing.rows * cell, drawing.columns * cell)


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
