"""One file that knows whether it is whole: a checksum, then tensors and plain values."""

import hashlib
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from pgts_torch import files
from pgts_torch.errors import PgtsError

_NAME = b"pgts_torch "
_MAGIC, _MAGIC_0_1 = _NAME + b"4\n", _NAME + b"3\n"
_DIGEST = hashlib.sha256().digest_size


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
    files.replace(path, _MAGIC + hashlib.sha256(payload).digest() + payload)


def read(path: str | Path) -> dict[str, Any]:
    """What `write` wrote. Nothing in the file is executed.

    Raises:
        PgtsError: no such file, not one of ours, or damaged.
    """
    return decode(files.read(path), path)


def decode(raw: bytes, path: str | Path) -> dict[str, Any]:
    """What the content of a file holds; `path` is its name in errors, which are those of `read`."""
    is_old = raw.startswith(_MAGIC_0_1)
    if not (is_old or raw.startswith(_MAGIC)):
        raise PgtsError(f"{path} is not a file saved by pgts_torch")
    digest, payload = raw[len(_MAGIC) : len(_MAGIC) + _DIGEST], raw[len(_MAGIC) + _DIGEST :]
    if hashlib.sha256(payload).digest() != digest:
        raise PgtsError(f"{path} is damaged: its checksum does not fit its content")
    content = _parse(payload, path)
    if is_old:
        warnings.warn(f"{path} was saved by version 0.1; trained on, it follows the defaults of this one", stacklevel=2)
        _upgrade(content)
    return content


def _upgrade(content: dict[str, Any]) -> None:
    """What version 0.1 did not save, as in a model that has not seen anything yet."""
    state = content.get("state")
    if isinstance(state, dict):
        state["model_check"] = {"contradictions": 0, "model_calls": 0, "said": [], "frequencies": {}}
        searches = state.get("searches")
        for search in searches.values() if isinstance(searches, dict) else ():
            if isinstance(search, dict) and "choices" in search:
                search["upper"] = {}


def _parse(payload: bytes, path: str | Path) -> dict[str, Any]:
    try:
        content = torch.load(io.BytesIO(payload), weights_only=True)
    except Exception as error:  # torch.load raises almost anything for what torch.save did not write
        raise PgtsError(f"{path} holds something other than tensors and plain values") from error
    if not isinstance(content, dict):
        raise PgtsError(f"{path} holds a {type(content).__name__}; it must be a dict")
    return content
