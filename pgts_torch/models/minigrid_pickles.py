"""States of MiniGrid and BabyAI that hold anything: pickled, with a text of their values that tells them apart."""

import copyreg
import enum
import io
import marshal
import pickle
from collections.abc import Set
from typing import Any

import numpy as np

PLAIN = frozenset({type(None), bool, int, float, str, bytes})


START = "init_pos"
"""The attribute of an object that says where a reset has put it."""

_NONE = frozenset[str]()


def text_of(state: dict[str, Any], env: Any, *, but: Set[str] = _NONE) -> bytes:
    """The values of a state of an environment in one order: equal for equal states, also where pickles differ.

    Args:
        but: attributes of objects that do not count.
    """
    parts: list[Any] = []
    _spell(state, parts, {id(env): 0}, but)
    return marshal.dumps(parts, 2)


def pickled(state: dict[str, Any], env: Any) -> bytes:
    """A state, without the environment itself wherever that is met in it."""
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer, protocol=5)
    pickler.dispatch_table = copyreg.dispatch_table | {type(env): lambda _: (_environment, ())}
    pickler.dump(state)
    return buffer.getvalue()


def unpickled(data: bytes, env: Any) -> dict[str, Any]:
    """A state, with this environment where the pickled one was met."""
    state: dict[str, Any] = _Unpickler(data, env).load()
    _share_walls(state["grid"].grid)
    return state


def is_plain_wall(value: Any) -> bool:
    """Whether it is a wall without a position of its own."""
    kind = type(value)
    if kind.__qualname__ != "Wall" or kind.__module__ != "minigrid.core.world_object":
        return False
    plain = {"type": "wall", "color": value.color, "contains": None, "init_pos": None, "cur_pos": None}
    return vars(value) == plain


def _share_walls(cells: list[Any]) -> None:
    """One object for neighbouring walls that are alike."""
    wall = None
    for i, cell in enumerate(cells):
        if cell is not None and cell is not wall and is_plain_wall(cell):
            if wall is not None and wall.color == cell.color:
                cells[i] = wall
            else:
                wall = cell


def _spell(value: Any, parts: list[Any], seen: dict[int, int], but: Set[str]) -> None:
    """Append what a value consists of, in plain values and one order; an object that was met before by when that was.

    Each part that has parts begins with its kind and their number, so that different values are spelled differently.
    """
    kind = type(value)
    if kind in PLAIN:
        parts.append(value)
    elif kind is tuple or kind is list:
        parts += ("(", len(value))
        # Most of a grid is one wall, the same object again and again: it is looked into once.
        wall = None
        for item in value:
            if type(item) in PLAIN:
                parts.append(item)
            elif item is wall:
                parts.append(("wall", wall.color))
            elif is_plain_wall(item):
                wall = item
                parts.append(("wall", wall.color))
            else:
                _spell(item, parts, seen, but)
    elif kind is np.ndarray:
        _spell(value.tolist(), parts, seen, but)
    elif isinstance(value, np.generic):
        parts.append(value.item())
    elif isinstance(value, enum.Enum) or callable(value):
        parts.append(repr(value))
    elif isinstance(value, set | frozenset):
        _spell(sorted(value, key=repr), parts, seen, but)
    elif kind is dict:
        parts += ("{", len(value))
        for name in sorted(value, key=repr):
            _spell(name, parts, seen, but)
            _spell(value[name], parts, seen, but)
    # Objects that were met before: what they consist of is spelled already, and may lead back to themselves.
    elif id(value) in seen:
        parts += ("=", seen[id(value)])
    else:
        seen[id(value)] = len(seen)
        content = vars(value)
        parts += (kind.__qualname__, len(content))
        for name, item in content.items():
            if name in but:
                continue
            parts.append(name)
            if type(item) in PLAIN:
                parts.append(item)
            else:
                _spell(item, parts, seen, but)


def _environment() -> Any:
    """Stands in a pickle for the environment itself, which is not copied."""
    raise AssertionError


class _Unpickler(pickle.Unpickler):
    """Puts the environment where `_environment` stands."""

    def __init__(self, data: bytes, env: Any) -> None:
        super().__init__(io.BytesIO(data))
        self._env = env

    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name)
        return (lambda: self._env) if found is _environment else found
