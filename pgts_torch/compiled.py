"""Whether loops over nodes are compiled, and how.

A file of such loops, each marked with `jit`, stands beside torch code that does the same and which is its test.
It needs numba, so it is imported inside functions, behind `can_compile`.

What numba has compiled is kept on disk: in `__pycache__` beside the source, or where that is read-only in the user's
folder for such files; NUMBA_CACHE_DIR names another place.
"""

import functools
import hashlib
import importlib.util
import inspect
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import torch

_Function = TypeVar("_Function", bound=Callable[..., object])

SWITCH = "PGTS_COMPILED"
"""The environment variable that is 0 where nothing is to be compiled; a process reads it once."""

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}

_LITTLE = 256
"""Work on fewer numbers takes less time than loading numba."""

_torch_only = False


def can_compile(device: torch.device) -> bool:
    """Whether compiled loops are used for tensors of this device: those of the CPU, where numba is installed.

    That numba is missing is said once.
    """
    return not _torch_only and device.type == "cpu" and _usable()


def pays(device: torch.device, size: int) -> bool:
    """Whether compiled loops are used for work on so many numbers: as `can_compile`, but for little work only where
    numba is loaded already, which takes longer than a short training. Only for loops that change no bit."""
    return (size >= _LITTLE or "numba" in sys.modules) and can_compile(device)


@contextmanager
def torch_only() -> Iterator[None]:
    """Within it nothing compiled is used."""
    global _torch_only
    before, _torch_only = _torch_only, True
    try:
        yield
    finally:
        _torch_only = before


def clock() -> float:
    """Seconds, of which those in which numba compiles do not count: it does so once on a machine."""
    if "numba" not in sys.modules:
        return time.perf_counter()
    compiling = _compiling()
    return time.perf_counter() - (compiling.duration if compiling.done else 0.0)


@functools.cache
def _compiling() -> Any:
    """Adds up the seconds in which numba compiles, from the first call on."""
    from numba.core import event

    listener = event.TimingListener()
    event.register("numba:compile", listener)
    return listener


def jit(function: _Function) -> _Function:
    """The function, compiled by numba when it is first called: for numpy arrays and numbers, and with sums in the order
    in which they are written. Divisions by zero are not noticed. It makes no arrays and returns none: numba then counts
    no references to those that it is given, which in loops over nodes takes up to half of the time.

    What it calls must be marked too, and stand in a file of the same folder whose name ends in `_kernels` or
    `_records`: a function is read from the disk as long as none of these files has changed.
    """
    return _kept(function, _nrt=False)


def allocating(function: _Function) -> _Function:
    """As `jit`, for a function that makes arrays, if only by `max` or `np.dot`, or returns them."""
    return _kept(function)


def inlined(function: _Function) -> _Function:
    """The function, which becomes a part of those that call it: they are marked with `jit`, see there."""
    import numba

    inside = numba.njit(forceinline=True, no_cpython_wrapper=True, _nrt=False, **_OPTIONS)
    machine_code: _Function = inside(inspect.unwrap(function))
    return machine_code


def _kept(function: _Function, **options: Any) -> _Function:
    import numba

    _compiling()
    function = inspect.unwrap(function)  # without the shape checks of tests, which numba cannot read
    # Numba compares the age of one file, but also finds what it has kept by this name.
    function.__qualname__ += "_" + _digest(Path(function.__code__.co_filename).parent)
    try:
        machine_code: _Function = numba.njit(cache=True, **_OPTIONS, **options)(function)
    except RuntimeError as error:  # no folder for it
        _say_not_kept(str(error))
        machine_code = numba.njit(**_OPTIONS, **options)(function)
    return machine_code


@functools.cache
def _digest(folder: Path) -> str:
    """Of the compiled loops in a folder, what they read, and how they are compiled."""
    files = sorted(path for end in ("kernels", "records") for path in folder.glob(f"*_{end}.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in (*files, Path(__file__)))).hexdigest()[:12]


@functools.cache
def _usable() -> bool:
    if os.environ.get(SWITCH) == "0":
        return False
    if importlib.util.find_spec("numba") is not None:
        return True
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    warnings.warn(
        f"numba is not installed (Python {version}): torch alone is used, and searches on the CPU take longer",
        RuntimeWarning,
        stacklevel=2,
    )
    return False


@functools.cache
def _say_not_kept(error: str) -> None:
    warnings.warn(
        f"compiled code cannot be kept on disk, each process compiles it again, which takes seconds ({error}); "
        "set NUMBA_CACHE_DIR to a folder that may be written to",
        RuntimeWarning,
        stacklevel=3,
    )
