"""Episodes of a trained policy as a file: GIF, MP4, or text."""

import io
import itertools
import tempfile
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from tqdm import tqdm

from pgts_torch import files
from pgts_torch.agent.showing import picture, text
from pgts_torch.agent.watching import Moment, Watching
from pgts_torch.errors import PgtsError, check_count

_SIGNS = {".gif": (b"GIF8",), ".mp4": (b"ftyp",), ".txt": (b"episode 0, step 0",)}
"""The files that are written, each with what stands in the first bytes of such a file."""

_FASTEST = 50.0
"""Pictures a second that a GIF shows; what is faster, browsers show slower."""


class Seen(NamedTuple):
    """An episode that was watched: the seed of its reset, its length in steps, the sum of its rewards, and its end."""

    seed: int
    length: int
    episodic_return: float
    ended: str


def suffix_of(path: str | Path) -> str:
    """The end of the name of a file, which says what is written; PgtsError where it is another one, or what writes it
    is not installed."""
    suffix = files.as_path(path).suffix.lower()
    if suffix not in _SIGNS:
        raise PgtsError(f"{path} ends in {suffix!r}; a recording is a .gif, an .mp4 or, as text, a .txt")
    if suffix == ".mp4" and (find_spec("imageio") is None or find_spec("imageio_ffmpeg") is None):
        raise PgtsError(f"{path}: an mp4 needs imageio with ffmpeg: pip install 'pgts_torch[video]', or take a .gif")
    return suffix


def record(path: str | Path, watching: Watching, *, episodes: int, fps: float | None, name: str) -> list[Seen]:
    """Write episodes into a file.

    Args:
        fps: pictures a second; None: as the environment says, or 10.
        name: of the environment.

    Raises:
        PgtsError: as `suffix_of`; a number out of range; or there is another file at `path`.
        NoPicture: the environment cannot be drawn.
    """
    check_count("episodes", episodes)
    if fps is not None and not 0 < fps <= 1000:
        raise PgtsError(f"fps is {fps}; it must be above 0 and at most 1000")
    suffix = suffix_of(path)
    signs = _SIGNS[suffix]
    place = files.target(path, lambda raw: any(sign in raw for sign in signs), f"a {suffix} file", most=32)
    seen: list[Seen] = []
    with tqdm(watching(episodes), unit="step", disable=None, leave=False) as moments:
        states = noted(moments, seen)
        if suffix == ".txt":
            raw = "\n".join(text(moment, coloured=False) for moment in states).encode()
        else:
            rate = fps or watching.rate
            pictures = _pictures(states, name, rate)
            raw = _gif(pictures, rate) if suffix == ".gif" else _mp4(pictures, rate)
    files.replace(place, raw)
    return seen


def noted(moments: Iterable[Moment], seen: list[Seen]) -> Iterator[Moment]:
    """The moments; each episode that is over is added to the list."""
    for moment in moments:
        if moment.ended is not None:
            seen.append(Seen(moment.seed, moment.step, moment.total, moment.ended))
        yield moment


def _pictures(moments: Iterator[Moment], name: str, rate: float) -> Iterator[Image.Image]:
    """A picture of each moment; the last one of an episode stays for a second."""
    most = 0
    for moment in moments:
        most = most or len(moment.choices)
        yield from itertools.repeat(picture(moment, name, most), 1 if moment.ended is None else max(1, round(rate)))


def _gif(pictures: Iterator[Image.Image], rate: float) -> bytes:
    # A palette of its own for each picture. Pillow joins equal ones, and keeps of others what has changed.
    reduced = (each.quantize(128, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE) for each in pictures)
    buffer, first = io.BytesIO(), next(reduced)
    duration = round(1000 / min(rate, _FASTEST))
    first.save(buffer, "GIF", save_all=True, append_images=reduced, duration=duration, loop=0)
    return buffer.getvalue()


def _mp4(pictures: Iterator[Image.Image], rate: float) -> bytes:
    import imageio.v2 as imageio

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episodes.mp4"
        options: dict[str, Any] = {"fps": rate, "macro_block_size": 2, "codec": "libx264", "ffmpeg_log_level": "error"}
        video: Any
        with imageio.get_writer(path, **options) as video:
            for each in pictures:
                video.append_data(np.asarray(each))
        return path.read_bytes()
