"""The random generators of an iteration."""

from dataclasses import dataclass
from typing import final

import torch

from pgts_torch.ranks import Ranks
from pgts_torch.seeding import stream


@final
@dataclass(frozen=True)
class Draws:
    """The random generators of an iteration, from streams named by (seed, "iteration", number).

    ranks: the processes that train together.
    names: the prefix of the names of this process's own streams.
    own: for its part of the episodes, of the lookahead and of what a model learns.
    common: for what all processes do alike; the same object as `own` in a single process.
    """

    ranks: Ranks
    seed: int
    number: int
    names: tuple[str | int, ...]
    own: torch.Generator
    common: torch.Generator
    _common_names: tuple[str | int, ...]

    @classmethod
    def of(cls, ranks: Ranks, seed: int, number: int, device: torch.device) -> "Draws":
        """The random generators of iteration `number`."""
        return cls._of(ranks, seed, number, ("iteration", number), device)

    @classmethod
    def _of(cls, ranks: Ranks, seed: int, number: int, names: tuple[str | int, ...], device: torch.device) -> "Draws":
        own = stream(seed, *names, *ranks.names, device=device)
        common = own if ranks.size == 1 else stream(seed, *names, "common", device=device)
        return cls(ranks, seed, number, (*names, *ranks.names), own, common, names)

    def search(self) -> torch.Generator:
        """A new generator for a search; all searches of an iteration get the same random numbers."""
        return stream(self.seed, *self._common_names, "search", device=self.own.device)

    def roots(self) -> torch.Generator:
        """A new generator, on the CPU and the same in all processes, for the visits that a lookahead starts from."""
        return stream(self.seed, *self._common_names, "roots")

    def update(self, number: int) -> "Draws":
        """The random generators of one of several updates of the iteration."""
        return Draws._of(self.ranks, self.seed, self.number, (*self._common_names, "update", number), self.own.device)
