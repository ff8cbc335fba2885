"""One file that proves itself: its format, a SHA-256 of all the rest, then tensors and plain values."""

import hashlib
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from pgts_torch import files
from pgts_torch.errors import PgtsError

_NAME = b"pgts_torch "
_HEADER = re.compile(re.escape(_NAME) + rb"(\d{1,9})\n")
_FORMAT, _FORMAT_0_1 = 6, 3
_DIGEST = hashlib.sha256().digest_size


class Damaged(PgtsError):
    """A file does not hold what was written."""


def target(path: str | Path) -> Path:
    """Where a model may be written; PgtsError where a file is that is no saved model."""
    is_model: Callable[[bytes], bool] = lambda raw: raw == _NAME  # noqa: E731
    return files.target(path, is_model, "a model that pgts_torch has saved", most=len(_NAME))


def write(path: str | Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values; whoever reads `path` meanwhile finds the old file or the new one, never half.

    Raises:
        PgtsError: `content` holds something else, for instance a numpy number.
    """
    buffer = io.BytesIO()
    torch.save(content, buffer)
    payload = buffer.getvalue()
    _parse(payload, path)  # what could not be read again must not replace what can
    files.replace(path, sealed(payload))


def read(path: str | Path) -> dict[str, Any]:
    """What `write` wrote. Nothing in the file is executed.

    Raises:
        Damaged: it is not one of ours, or its checksum does not fit.
        PgtsError: no such file, or one of another format.
    """
    raw = files.read(path)
    header = _HEADER.match(raw)
    if header is None:
        raise Damaged(f"{path} is not a file saved by pgts_torch")
    number, start = int(header[1]), header.end()
    payload = raw[start + _DIGEST :]
    if number == _FORMAT_0_1:  # whose checksum was another one
        raise PgtsError(
            f"{path} was saved by version 0.1, which this version does not read: use that one, or train again"
        )
    if _seal(number, payload) != raw[start : start + _DIGEST]:
        raise Damaged(f"{path} is damaged: its checksum does not fit its content")
    if number != _FORMAT:
        raise PgtsError(f"{path} has the format {number}; this version of pgts_torch reads {_FORMAT}")
    return _parse(payload, path)


def sealed(payload: bytes, number: int = _FORMAT) -> bytes:
    """The file that holds this, in the format with this number."""
    return _NAME + b"%d\n" % number + _seal(number, payload) + payload


def _seal(number: int, payload: bytes) -> bytes:
    """The SHA-256 of a file, of its format too."""
    seal = hashlib.sha256(_NAME + b"%d\n" % number)
    seal.update(payload)
    return seal.digest()


def _parse(payload: bytes, path: str | Path) -> dict[str, Any]:
    try:
        content = torch.load(io.BytesIO(payload), weights_only=True)
    except Exception as error:  # torch.load raises almost anything for what torch.save did not write
        raise PgtsError(f"{path} holds something other than tensors and plain values") from error
    if not isinstance(content, dict):
        raise PgtsError(f"{path} holds a {type(content).__name__}; it must be a dict")
    return content
