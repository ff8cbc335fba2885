"""The arrays of an MDP in a file of numpy.savez."""

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from pgts_torch import files
from pgts_torch.errors import PgtsError

MOST_BYTES = 2**31
"""The most memory that the arrays of a file may take, as float64."""

_ARRAYS = ("P", "R", "gamma", "start")

# How numpy, the zip and its compression report a file that is damaged or holds what no array is.
_UNREADABLE = (
    ValueError,
    KeyError,
    EOFError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
    SyntaxError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)


def write(path: str | Path, arrays: dict[str, Any]) -> None:
    """PgtsError if the file cannot be written."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    files.replace(path, buffer.getvalue())


def read(path: str | Path) -> tuple[np.ndarray, np.ndarray, float, int | np.ndarray | None]:
    """P, R, gamma and start. Anything but plain numbers under the known names is refused, and so is what would take
    more than `MOST_BYTES`, before any of it is unpacked."""
    if (found := files.kind(path, follow=True)) not in (None, "file", "folder"):
        raise PgtsError(f"{path}: is a {found}; it must be a file")
    try:
        with open(path, "rb") as file:
            if not zipfile.is_zipfile(file):
                raise PgtsError(f"{path}: is not an npz file (numpy.savez writes one)")
            with np.lib.npyio.NpzFile(file, allow_pickle=False) as archive:
                _check_names(path, archive.files)
                assert archive.zip is not None
                _check_size(path, archive.zip)
                arrays = {name: _read_array(path, archive, name) for name in archive.files}
    except PgtsError:
        raise
    except OSError as error:
        raise PgtsError(f"{path}: cannot be read: {error.strerror or error}") from error
    except _UNREADABLE as error:
        raise PgtsError(f"{path}: is damaged: {_first_line(error)}") from error
    gamma, start = arrays["gamma"], arrays.get("start")
    if gamma.ndim != 0:
        raise PgtsError(f"{path}: gamma has shape {gamma.shape}; it must be a single number")
    if start is None or start.ndim:
        return arrays["P"], arrays["R"], float(gamma), start
    if start.dtype.kind not in "iu":
        raise PgtsError(f"{path}: start is {start}; a single state must be a whole number")
    return arrays["P"], arrays["R"], float(gamma), int(start)


def _check_names(path: str | Path, names: Sequence[str]) -> None:
    for name in names:
        if name not in _ARRAYS:
            raise PgtsError(f"{path}: array {name!r} is unknown; the arrays are P, R, gamma and start")
    for name in _ARRAYS[:3]:
        if name not in names:
            raise PgtsError(f"{path}: array {name!r} is missing; it holds {', '.join(names) or 'none'}")


def _check_size(path: str | Path, archive: zipfile.ZipFile) -> None:
    """PgtsError if the arrays are larger than is allowed, or than what the file holds of them.

    No more is unpacked than the first bytes of each member; a zip never unpacks more of one than its directory says.
    """
    total = 0
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        total += member.file_size
        if total <= MOST_BYTES:
            with archive.open(member) as stream:
                total += _check_header(path, name, member.file_size, stream)
        if total > MOST_BYTES:
            raise PgtsError(
                f"{path}: array {name!r} would take the file's arrays to {total / 2**30:.3g} GiB in memory; they may "
                f"take {MOST_BYTES / 2**30:.3g} GiB: TabularMDP.from_dense takes sparse matrices"
            )


def _check_header(path: str | Path, name: str, size: int, stream: IO[bytes]) -> int:
    """How many bytes an array takes as float64 beyond those that it takes in the file."""
    if stream.read(len(np.lib.format.MAGIC_PREFIX)) != np.lib.format.MAGIC_PREFIX:
        return 0  # no array, which is found out when it is read
    stream.seek(0)
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
    except _UNREADABLE as error:
        raise PgtsError(f"{path}: array {name!r} cannot be read: {_first_line(error)}") from error
    count, stored = math.prod(shape), size - stream.tell()
    if not dtype.hasobject and count * dtype.itemsize != stored:
        raise PgtsError(
            f"{path}: array {name!r} cannot be read: {stored} bytes follow a header of {count * dtype.itemsize}"
        )
    return max(0, 8 * count - stored)


def _read_array(path: str | Path, archive: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    try:
        array = np.asarray(archive[name])
    except _UNREADABLE as error:
        raise PgtsError(f"{path}: array {name!r} cannot be read: {_first_line(error)}") from error
    if array.dtype.kind not in "biuf":
        raise PgtsError(f"{path}: {name} is of type {array.dtype}; it must hold real numbers")
    return array


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def in_words_of_the_file(message: str) -> str:
    """A message about an MDP with the names that the arrays have in a file."""
    for name, in_file in [("P_SAS", "P"), ("R_SA", "R"), ("start_S", "start")]:
        message = message.replace(name, in_file)
    return message
