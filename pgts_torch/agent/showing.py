"""A state of an episode as text for a terminal, and as a picture."""

import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pgts_torch.agent.watching import Choice, Moment

_WIDTH = 79
_NAME = 28
_MOST_CHOICES = 12
"""The most actions that are shown; of more, those of the largest values."""

_MOST_NUMBERS = 40
"""Of an observation in words; of a larger one its shape is said."""

# Text


def text(moment: Moment, *, coloured: bool) -> str:
    """A block of lines of at most 79 characters, but for what the environment renders.

    Args:
        coloured: whether colours of the environment are kept; else what has a coloured background is put in brackets.
    """
    lines = [title(moment)]
    if isinstance(moment.picture, str):
        lines += (moment.picture if coloured else _plain(moment.picture)).strip("\n").split("\n")
    else:
        lines += _wrapped("observation  ", in_words(moment.observation))
    lines += _wrapped("policy  ", moment.note) if moment.note else []
    shown, left = chosen(moment.choices)
    if shown:
        width = min(max(len(choice.name) for choice in shown), _NAME)
        lines.append(
            f"  {'action':<{max(width, 6)}}   policy" + ("" if moment.depth is None else f"  {value_name(moment):>12}")
        )
    for choice in shown:
        name = textwrap.shorten(choice.name, _NAME, placeholder="...")
        cells = [f"{name:<{max(width, 6)}}", f"{'' if choice.prob is None else f'{choice.prob:.3f}':>7}"]
        cells += [] if moment.depth is None and choice.value is None else [f"{number(choice.value):>12}"]
        bar = "#" * round(20 * (choice.prob or 0.0))
        lines.append(f"{'>' if choice.is_taken else ' '} {'  '.join([*cells, bar])}".rstrip())
    lines += [f"  and {left} more"] if left else []
    return "\n".join([*lines, ""])


def title(moment: Moment) -> str:
    """Where it is."""
    over = "" if moment.ended is None else f": {moment.ended}"
    return f"episode {moment.episode}, step {moment.step}, return {moment.total:.6g}{over}"


def value_name(moment: Moment) -> str:
    """What the lookahead computes."""
    return "Q" if moment.depth == 0 else f"T^{moment.depth} Q"


def number(value: float | None) -> str:
    """A value in at most twelve characters."""
    if value is None:
        return ""
    return "not legal" if value == -math.inf else f"{value:.4g}"


def chosen(choices: Sequence[Choice]) -> tuple[list[Choice], int]:
    """The actions that are shown, in their order, and how many are not: those of the smallest values, or probabilities,
    but never the one that is taken."""
    if len(choices) <= _MOST_CHOICES:
        return [*choices], 0

    def rank(k: int) -> tuple[bool, float]:
        choice = choices[k]
        return choice.is_taken, (choice.prob or 0.0) if choice.value is None else choice.value

    kept = sorted(sorted(range(len(choices)), key=rank)[-_MOST_CHOICES:])
    return [choices[k] for k in kept], len(choices) - len(kept)


def in_words(observation: Any) -> str:
    """An observation in a few words."""
    if isinstance(observation, Mapping):
        return "; ".join(f"{key}: {in_words(part)}" for key, part in observation.items())
    if isinstance(observation, tuple):
        return "; ".join(map(in_words, observation))
    array = np.asarray(observation)
    if array.dtype.kind not in "biuf":
        return repr(observation)
    if array.size > _MOST_NUMBERS:
        return f"{array.dtype} {array.shape}"
    return " ".join(f"{x:.4g}" for x in array.reshape(-1).tolist())


def _wrapped(head: str, words: str) -> list[str]:
    return textwrap.wrap(words, _WIDTH, initial_indent=head, subsequent_indent=" " * len(head)) or [head.rstrip()]


_COLOUR = re.compile(r"((?:\x1b\[[\d;]*m)+)([^\x1b]*)(?:\x1b\[0m)+")
_BACKGROUND = re.compile(r"(?<!\d)4[0-7](?!\d)")
_CODE = re.compile(r"\x1b\[[\d;]*[A-Za-z]")


def _plain(rendered: str) -> str:
    """Text without colours; what has a coloured background, as where the agent is, is put in brackets."""

    def bracketed(match: re.Match[str]) -> str:
        return f"[{match[2]}]" if _BACKGROUND.search(match[1]) else match[2]

    return _CODE.sub("", _COLOUR.sub(bracketed, rendered))


# Pictures

_SIDE, _LONGEST_SIDE = 360, 640
"""Smaller renderings are enlarged to about this height, and larger ones than this are made smaller."""

_PANEL, _LINE, _MARGIN = 440, 24, 16
_INK, _PALE, _PAPER = (31, 35, 40), (110, 118, 129), (255, 255, 255)
_POLICY, _VALUE, _TAKEN = (84, 130, 196), (221, 132, 82), (214, 224, 238)
_FONT = ImageFont.load_default(size=14)
_PROB, _PROB_BAR, _Q, _Q_BAR, _BAR = 132, 182, 262, 340, 66
"""Where the columns of the panel begin, and the length of the longest bar."""


def picture(moment: Moment, name: str, num_choices: int) -> Image.Image:
    """What the environment renders, and the actions beside it. Bars of values reach from the worst action to the best.

    Args:
        name: of the environment.
        num_choices: of the moments that are to have the same size.
    """
    rendered = _scaled(Image.fromarray(moment.picture))
    height = max(rendered.height, _LINE * (min(num_choices, _MOST_CHOICES + 1) + 4) + 2 * _MARGIN)
    size = rendered.width + _PANEL, height
    canvas = Image.new("RGB", (size[0] + size[0] % 2, size[1] + size[1] % 2), _PAPER)  # videos have even sides
    canvas.paste(rendered, (0, (height - rendered.height) // 2))
    draw = ImageDraw.Draw(canvas)
    draw.line((rendered.width, 0, rendered.width, height), _TAKEN)
    _draw_panel(draw, moment, name, left=rendered.width + _MARGIN)
    return canvas


def _scaled(rendered: Image.Image) -> Image.Image:
    """A small picture enlarged by a whole number, a large one made smaller."""
    if (longest := max(rendered.size)) > _LONGEST_SIDE:
        width, height = (max(1, round(side * _LONGEST_SIDE / longest)) for side in rendered.size)
        return rendered.resize((width, height))
    factor = max(1, min(round(_SIDE / rendered.height), _LONGEST_SIDE // rendered.width))
    return rendered.resize((rendered.width * factor, rendered.height * factor), Image.Resampling.NEAREST)


def _draw_panel(draw: ImageDraw.ImageDraw, moment: Moment, name: str, *, left: int) -> None:
    y = _MARGIN

    def write(x: int, words: str, colour: tuple[int, int, int] = _INK, *, most: int = _PANEL - 2 * _MARGIN) -> None:
        draw.text((left + x, y), _fitting(draw, words, most), colour, _FONT)

    write(0, name, _PALE)
    y += _LINE
    write(0, f"episode {moment.episode}, step {moment.step}, return {moment.total:.6g}")
    y += _LINE
    if moment.ended is not None:
        write(0, moment.ended)
        return
    write(0, moment.note, _PALE)
    y += _LINE
    shown, hidden = chosen(moment.choices)
    write(0, "action", _PALE)
    write(_PROB, "policy", _PALE)
    write(_Q, "" if moment.depth is None else value_name(moment), _PALE)
    y += _LINE
    finite = [choice.value for choice in shown if choice.value is not None and choice.value > -math.inf]
    for choice in shown:
        if choice.is_taken:
            draw.rectangle((left - 6, y - 3, left + _PANEL - 2 * _MARGIN + 6, y + _LINE - 6), _TAKEN)
        write(0, choice.name, most=_PROB - 8)
        if choice.prob is not None:
            write(_PROB, f"{choice.prob:.3f}")
            _bar(draw, left + _PROB_BAR, y, choice.prob, _POLICY)
        if choice.value == -math.inf:
            write(_Q, number(choice.value), _PALE)
        elif choice.value is not None:
            write(_Q, number(choice.value))
            if (spread := max(finite) - min(finite)) > 0:
                _bar(draw, left + _Q_BAR, y, 0.05 + 0.95 * (choice.value - min(finite)) / spread, _VALUE)
        y += _LINE
    if hidden:
        write(0, f"and {hidden} more", _PALE)


def _bar(draw: ImageDraw.ImageDraw, x: int, y: int, share: float, colour: tuple[int, int, int]) -> None:
    if (length := round(_BAR * share)) > 0:
        draw.rectangle((x, y + 3, x + length, y + 13), colour)


def _fitting(draw: ImageDraw.ImageDraw, words: str, most: int) -> str:
    """Words that are cut off where they would be wider."""
    if draw.textlength(words, _FONT) <= most:
        return words
    while words and draw.textlength(words + "...", _FONT) > most:
        words = words[:-1]
    return words + "..."
