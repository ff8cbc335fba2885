"""One file that knows whether it is whole: a checksum, then tensors and plain values."""

import contextlib
import hashlib
import io
import os
from pathlib import Path
from typing import Any

import torch

from pgts_torch.errors import PgtsError

PARTIAL = ".partial"
"""The end of the name of a file, or a folder, that is being written."""

_MAGIC = b"pgts_torch 3\n"
_DIGEST = hashlib.sha256().digest_size


def write(path: str | Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values; whoever reads `path` meanwhile finds the old file or the new one, never half.

    Raises:
        PgtsError: `content` holds something else, for instance a numpy number.
    """
    buffer = io.BytesIO()
    torch.save(content, buffer)
    payload = buffer.getvalue()
    _parse(payload, path)  # what could not be read again must not replace what can
    replace(path, _MAGIC + hashlib.sha256(payload).digest() + payload)


def replace(path: str | Path, raw: bytes) -> None:
    """Write a file, to the disk; whoever reads `path` meanwhile finds the old file or the new one.

    Raises:
        PgtsError: it cannot be written; then nothing has changed.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    try:
        with partial.open("wb") as file:
            file.write(raw)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise PgtsError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def read(path: str | Path) -> dict[str, Any]:
    """What `write` wrote. Nothing in the file is executed.

    Raises:
        PgtsError: no such file, not one of ours, or damaged.
    """
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise PgtsError(f"{path} cannot be read: {error.strerror}") from error
    return decode(raw, path)


def decode(raw: bytes, path: str | Path) -> dict[str, Any]:
    """What the content of a file holds; `path` is its name in errors, which are those of `read`."""
    if not raw.startswith(_MAGIC):
        raise PgtsError(f"{path} is not a file saved by pgts_torch")
    digest, payload = raw[len(_MAGIC) : len(_MAGIC) + _DIGEST], raw[len(_MAGIC) + _DIGEST :]
    if hashlib.sha256(payload).digest() != digest:
        raise PgtsError(f"{path} is damaged: its checksum does not fit its content")
    return _parse(payload, path)


def _parse(payload: bytes, path: str | Path) -> dict[str, Any]:
    try:
        content = torch.load(io.BytesIO(payload), weights_only=True)
    except Exception as error:  # torch.load raises almost anything for what torch.save did not write
        raise PgtsError(f"{path} holds something other than tensors and plain values") from error
    if not isinstance(content, dict):
        raise PgtsError(f"{path} holds a {type(content).__name__}; it must be a dict")
    return content
