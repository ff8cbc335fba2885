"""The types of the command line's arguments, as argparse takes them."""

import argparse
import difflib
import json
import math
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from pgts_torch import files
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.ownership import MARK_FILE, is_earlier
from pgts_torch.options.fields import INT64_MAX


def whole(least: int, *words: str) -> Callable[[str], Any]:
    """An argparse type: a whole number of at least `least`, below 2**63; or one of the words."""

    def convert(text: str) -> int | str:
        if text in words:
            return text
        if not (text.isascii() and text.isdecimal() and len(text) < 20 and least <= int(text) <= INT64_MAX):
            whole_number = f"a whole number >= {least}"
            is_not = (
                " nor ".join([f"neither {whole_number}", *words]) if words else f"not {whole_number} and below 2**63"
            )
            raise argparse.ArgumentTypeError(f"{text!r} is {is_not}")
        return int(text)

    return convert


def listed(convert: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    """An argparse type: values separated by commas; each counts once."""
    return lambda text: tuple(dict.fromkeys(map(convert, text.split(","))))


def choice_of(text: str, known: Collection[str]) -> str:
    """Return the end of a message about an unknown word: the likeliest one, or all."""
    close = difflib.get_close_matches(text, known, n=1)
    return f"did you mean {close[0]}?" if close else f"choose from {', '.join(known)}"


def json_object(text: str) -> dict[str, Any]:
    """An argparse type: a JSON object."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = None
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"{text!r} is not a JSON object")
    return value


def unit_interval(text: str) -> float:
    """An argparse type: a number in [0, 1]."""
    return _real(text, lambda value: 0 <= value <= 1, "a number in [0, 1]")


def positive(text: str) -> float:
    """An argparse type: a number above 0."""
    return _real(text, lambda value: 0 < value < math.inf, "a number above 0")


def _real(text: str, is_fine: Callable[[float], bool], what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not is_fine(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value


def env_scale(text: str) -> tuple[str, tuple[float, float]]:
    """An argparse type: ENV=LOW,HIGH."""
    env, _, ends = text.rpartition("=")
    try:
        low, high = map(float, ends.split(","))
    except ValueError:
        low = high = math.nan
    if not (env and math.isfinite(high - low) and low < high):
        raise argparse.ArgumentTypeError(f"{text!r} is not ENV=LOW,HIGH, with two ascending numbers")
    return env, (low, high)


def path_kind(text: str) -> str | None:
    """Return what is at a path (`files.kind`); ArgumentTypeError where it cannot be looked up."""
    try:
        with files.named(f"{text!a}"):
            text.encode()  # bytes that the locale lacks were escaped, and can be looked up, but not written down
        return files.kind(text, follow=True)
    except PgtsError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def output_folder(text: str) -> Path:
    """An argparse type: a folder, which need not exist yet."""
    if path_kind(text) not in (None, "folder"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a folder")
    return Path(text)


def html_file(text: str) -> Path:
    """An argparse type: a path that ends in .html, in an existing folder."""
    if Path(text).suffix != ".html" or path_kind(text) == "folder":
        raise argparse.ArgumentTypeError(f"{text!r} is not a file that ends in .html")
    return file_path(text)


def file_path(text: str) -> Path:
    """An argparse type: the path of a file, which need not exist yet, in an existing folder."""
    path = Path(text)
    if path_kind(text) == "folder":
        raise argparse.ArgumentTypeError(f"{text!r} is a folder; it must be a file")
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r}: {str(path.parent)!r} is not a folder")
    return path


def film_path(text: str) -> Path:
    """An argparse type: a path that ends in .gif, .mp4 or .txt, in an existing folder."""
    if Path(text).suffix.lower() not in (".gif", ".mp4", ".txt"):
        raise argparse.ArgumentTypeError(f"{text!r} does not end in .gif, .mp4 or .txt")
    return file_path(text)


def run_folder(text: str) -> Path:
    """An argparse type: a folder that has the mark of a run and its config.yaml."""
    path = Path(text)
    if path_kind(text) != "folder":
        raise argparse.ArgumentTypeError(f"{text!r} is not a folder")
    if not (path / "config.yaml").is_file():
        raise argparse.ArgumentTypeError(f"{text!r} is not the folder of a run: it has no config.yaml")
    if not (path / MARK_FILE).is_file() and not is_earlier(path):
        raise argparse.ArgumentTypeError(f"{text!r} is not the folder of a run: it has no {MARK_FILE}")
    if is_earlier(path):
        raise argparse.ArgumentTypeError(
            f"{text!r} is the folder of a run of version 0.1: read it with that, or train again"
        )
    return path
