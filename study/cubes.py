"""Sets of tuples, written as few products of sets: {(0, 1), (0, 2), (1, 1)} is 0 x {1, 2} and 1 x {1}."""

from collections.abc import Hashable, Iterable, Sequence
from typing import TypeVar

Value = TypeVar("Value", bound=Hashable)
Cube = tuple[frozenset[Value], ...]


def cover(points: Iterable[Sequence[Value]]) -> list[Cube[Value]]:
    """Disjoint products of sets whose union is exactly the given points.

    Greedy: two cubes that differ in one place become one, the places tried from the last to the first. Few, not fewest.
    """
    cubes: list[Cube[Value]] = [
        tuple(frozenset([value]) for value in point) for point in dict.fromkeys(map(tuple, points))
    ]
    places = len(cubes[0]) if cubes else 0
    merged = True
    while merged:
        before = len(cubes)
        for place in reversed(range(places)):
            cubes = _merge(cubes, place)
        merged = len(cubes) < before
    return cubes


def _merge(cubes: list[Cube[Value]], place: int) -> list[Cube[Value]]:
    """Unite the cubes that differ in this place only."""
    groups: dict[tuple[frozenset[Value], ...], frozenset[Value]] = {}
    for cube in cubes:
        rest = cube[:place] + cube[place + 1 :]
        groups[rest] = groups.get(rest, frozenset()) | cube[place]
    return [(*rest[:place], values, *rest[place:]) for rest, values in groups.items()]
