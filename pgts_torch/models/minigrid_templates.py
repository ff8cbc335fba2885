"""States of MiniGrid that hold plain values and a grid of objects: templates of the objects, which are made again and
again."""

import marshal
from collections.abc import Sequence, Set
from operator import is_, itemgetter
from typing import Any, NamedTuple, final

import numpy as np

from pgts_torch.models.minigrid_pickles import PLAIN, START, is_plain_wall

MOVING = ("agent_pos", "agent_dir")
"""What changes in most steps, beside what is carried, the grid and the count of steps."""

COUNT = "step_count"
"""The clock."""

GRID = {"width", "height", "grid"}
"""The attributes of a grid."""


class NotPlain(Exception):
    """There is more in a state than plain values."""


def plain(value: Any) -> Any:
    """A value as `marshal` takes it, the same for a number of Python or numpy, for a tuple or an array."""
    kind = type(value)
    if kind in PLAIN:
        return value
    if kind is tuple:
        return tuple(map(plain, value))
    if kind is np.ndarray and value.dtype.kind in "biuf" and value.ndim == 1:
        return tuple(value.tolist())
    if isinstance(value, np.generic) and value.dtype.kind in "biuf":
        return value.item()
    raise NotPlain


def kept(values: tuple[Any, ...]) -> tuple[Any, ...]:
    """The values, arrays copied."""
    return tuple(value.copy() if type(value) is np.ndarray else value for value in values)


@final
class Layout:
    """Reads the attributes of environments that have the same ones.

    names: of the attributes that belong to a state.   values: those that were read last, of the rest.
    """

    def __init__(self, names: Set[str]) -> None:
        self.names = names | {COUNT}
        self.rest = tuple(sorted(names - {*MOVING, "grid", "carrying"}))
        self._read = itemgetter(*self.rest)
        self.values: tuple[Any, ...] = ()
        self._head = b""

    def head(self, held: dict[str, Any]) -> bytes:
        """The part of a key that is of `rest`: from memory where all are the very objects that were read last."""
        values = self._read(held)
        if len(values) != len(self.values) or not all(map(is_, values, self.values)):
            if any(type(value) is np.ndarray for value in values):
                raise NotPlain  # an array may be written into, and is the same object then
            spelled = [self.rest, [repr(value) if isinstance(value, type) else plain(value) for value in values]]
            self._head, self.values = b"c" + marshal.dumps(spelled, 2), values
        return self._head


@final
class Template:
    """What an object of a grid is made from, again and again. Its attributes are plain, or another such object.

    is_wall: whether it is one without a position of its own.   text: its values, as part of a key, but for where it
    and what it contains lay at the start: `starts`.
    """

    __slots__ = ("_copied", "_kind", "_names", "_state", "is_wall", "starts", "text")

    def __init__(self, thing: Any) -> None:
        self._kind, self._state, self.is_wall = type(thing), dict(vars(thing)), is_plain_wall(thing)
        base = self._kind.__mro__[-2]  # what all things that can lie in a grid have in common
        spelled, copied, starts = dict(self._state), list[str](), list[Any]()
        for name, value in self._state.items():
            if type(value) in PLAIN:
                continue
            if isinstance(value, base):
                inner: Template = Template(value)
                self._state[name], spelled[name] = inner, inner.text
                copied.append(name)
                starts += inner.starts
            else:
                spelled[name] = plain(value)
                if type(value) is np.ndarray:
                    self._state[name] = value.copy()
                    copied.append(name)
        self._copied, self._names = tuple(copied), tuple(spelled)
        self.starts: tuple[Any, ...] = (spelled.pop(START, None), *starts)
        self.text: bytes = marshal.dumps((self._kind.__qualname__, *spelled, *spelled.values()), 2)

    def is_of(self, thing: Any) -> bool:
        """Whether an object that was made from this template is still as it was made."""
        held = vars(thing)
        return not self._copied and tuple(held) == self._names and all(map(is_, held.values(), self._state.values()))

    def made(self) -> Any:
        """A new object."""
        thing = object.__new__(self._kind)
        state = thing.__dict__
        state.update(self._state)
        for name in self._copied:
            value = state[name]
            state[name] = value.made() if type(value) is Template else value.copy()
        return thing


Cells = tuple[tuple[Template, tuple[int, ...]], ...]
"""What lies in a grid, and in which cells."""


_NOWHERE = list[int]()


@final
class Things:
    """The objects of the grid that was restored last, each with its template, so that most need not be read again."""

    def __init__(self) -> None:
        self._made: dict[int, tuple[Any, Template]] = {}
        # The cells of that grid as they were, what lies in them, and what is carried.
        self._grid: list[Any] = []
        self._lying: list[tuple[Any, Template]] = []
        self._cells: Cells = ()
        self._carried: Any = None

    def lay(self, cells: Cells, count: int) -> list[Any]:
        """So many cells, in which new objects lie."""
        self._made.clear()
        self._cells, self._grid, self._lying, self._carried = cells, [None] * count, [], None
        for template, where in cells:
            thing = self.make(template)
            self._lying.append((thing, template))
            for i in where:
                self._grid[i] = thing
        return self._grid.copy()

    def carry(self, template: Template | None) -> Any:
        """A new object that is carried."""
        self._carried = None if template is None else self.make(template)
        return self._carried

    def _are_untouched(self, grid: Sequence[Any], carried: Any) -> bool:
        """Whether the cells hold what was laid there, as it was, and nothing else was picked up."""
        return (
            carried is self._carried
            and len(grid) == len(self._grid)
            and all(map(is_, grid, self._grid))
            and all(template.is_of(thing) for thing, template in self._lying)
        )

    def make(self, template: Template) -> Any:
        """A new object."""
        thing = template.made()
        self._made[id(thing)] = thing, template
        return thing

    def template(self, thing: Any) -> Template:
        """The template of an object, as it is now."""
        made = self._made.get(id(thing))
        return made[1] if made is not None and made[0] is thing and made[1].is_of(thing) else Template(thing)

    def cells(self, grid: Sequence[Any], carried: Any) -> Cells:
        """What lies in the cells of a grid. NotPlain if it is the same object in two of them, except for a wall."""
        if self._are_untouched(grid, carried):
            return self._cells
        found: dict[bytes | int, tuple[Template, list[int]]] = {}
        # By identity: the cells of a wall, which may be many; None for what can be in one place only.
        places: dict[int, list[int] | None] = {id(carried): None}
        for i, cell in enumerate(grid):
            if cell is None:
                continue
            if (where := places.get(id(cell), _NOWHERE)) is _NOWHERE:
                template = self.template(cell)
                # All walls alike are one; whatever else there is, each has a place of its own.
                _, where = found.setdefault(template.text if template.is_wall else i, (template, []))
                places[id(cell)] = where if template.is_wall else None
            elif where is None:
                raise NotPlain
            where.append(i)
        return tuple((template, tuple(where)) for template, where in found.values())


class Compact(NamedTuple):
    """The data of a snapshot of plain values.

    rest: the values of `layout.rest`.   moving: those of MOVING.
    """

    layout: Layout
    rest: tuple[Any, ...]
    moving: tuple[Any, ...]
    kind: type
    width: int
    height: int
    cells: Cells
    carries: Template | None

    def restored(self, things: Things) -> dict[str, Any]:
        """The attributes of an environment in this state; what a step may write into is new."""
        grid: Any = object.__new__(self.kind)
        cells = things.lay(self.cells, self.width * self.height)
        vars(grid).update(width=self.width, height=self.height, grid=cells)
        state = dict(zip(self.layout.rest, self.rest, strict=True))
        state.update(zip(MOVING, kept(self.moving), strict=True))
        state["grid"], state["carrying"] = grid, things.carry(self.carries)
        return state
