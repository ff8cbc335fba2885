"""Counts what a computation dispatches: tensor operations, and reads by the host, for which it waits on a GPU."""

from collections import Counter
from typing import Any, Self

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

_VIEWS = {"detach", "alias", "lift_fresh", "split", "split_with_sizes", "unbind", "chunk", "_reshape_alias"}
"""Views that do not say so in their schema, or return lists."""

_DATA_DEPENDENT = {
    "_local_scalar_dense",
    "nonzero",
    "masked_select",
    "equal",
    "_unique2",
    "unique_dim",
    "unique_consecutive",
    "bincount",
}
"""Operations whose result, or its shape, is known to the host only after it has waited for the numbers."""

_COPIED = {"tolist", "numpy", "cpu", "__array__"}
"""Methods that copy a tensor to the host. On the CPU they dispatch nothing."""


class Counting:
    """A context.

    operations: how often each operation was dispatched, views not counted.
    reads: how often the host has read numbers, by what did so.
    """

    def __init__(self) -> None:
        self.operations: Counter[str] = Counter()
        self.reads: Counter[str] = Counter()
        self._modes = [_Operations(self), _Methods(self)]

    @property
    def num_operations(self) -> int:
        return self.operations.total()

    @property
    def num_reads(self) -> int:
        return self.reads.total()

    def __enter__(self) -> Self:
        for mode in self._modes:
            mode.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        for mode in reversed(self._modes):
            mode.__exit__(*error)


class _Operations(TorchDispatchMode):
    def __init__(self, counts: Counting) -> None:
        super().__init__()
        self._counts = counts

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function._schema.name.partition("::")[2]
        if name in _DATA_DEPENDENT or _is_counted_out(name, args, kwargs or {}):
            self._counts.reads[name] += 1
        if not function.is_view and name not in _VIEWS:
            self._counts.operations[name] += 1
        return function(*args, **(kwargs or {}))


class _Methods(TorchFunctionMode):
    def __init__(self, counts: Counting) -> None:
        super().__init__()
        self._counts = counts

    def __torch_function__(self, function, types, args=(), kwargs=None):
        name = getattr(function, "__name__", "")
        if name in _COPIED and getattr(torch.Tensor, name, None) is function:
            self._counts.reads[name] += 1
        return function(*args, **(kwargs or {}))


def _is_counted_out(name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
    """Whether the shape of the result is a count of numbers: of a mask that is an index, or of repeats."""
    if name == "repeat_interleave":
        return not kwargs.get("output_size")
    if name not in ("index", "index_put", "index_put_"):
        return False
    return any(isinstance(each, Tensor) and each.dtype == torch.bool for each in args[1])
