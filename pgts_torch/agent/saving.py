"""One file that knows whether it is whole: a checksum, then tensors and plain values."""

import hashlib
import io
import os
from pathlib import Path
from typing import Any

import torch

from pgts_torch.errors import PgtsError

_MAGIC = b"pgts_torch 1\n"
_DIGEST = hashlib.sha256().digest_size


def write(path: str | Path, content: dict[str, Any]) -> None:
    """Write tensors and plain values; whoever reads `path` meanwhile finds the old file or the new one, never half.

    Raises:
        PgtsError: `content` holds something else, for instance a numpy number.
    """
    path = Path(path)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    payload = buffer.getvalue()
    _parse(payload, path)  # what could not be read again must not replace what can
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            file.write(_MAGIC + hashlib.sha256(payload).digest() + payload)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
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
