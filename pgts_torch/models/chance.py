"""The generator of a simulator, seeded by keys, and watched without reading its state at each step."""

from typing import Any, final

import numpy as np

from pgts_torch.models.snapshots import SnapshotAdapter, generator_state


@final
class Chance:
    """Seeds the generator of an environment, and tells whether anything was drawn from it since.

    A twin in the same state says what the next raw number is. If the generator has another one, something was drawn in
    between; if it has the same, then something was with a probability of 2^-64. To look takes a number from both.
    """

    def __init__(self, env: Any, adapter: SnapshotAdapter) -> None:
        self._env, self._adapter = env, adapter
        self._generator: np.random.Generator | None = None
        self._twin: np.random.BitGenerator = np.random.PCG64(0)

    def seed(self, key: int) -> None:
        """What is drawn from here on is a function of the key."""
        self._adapter.seed(self._env, key)
        self._generator = generator = self._env.np_random
        bits = generator.bit_generator
        if type(self._twin) is not type(bits):
            self._twin = type(bits)(0)
        self._twin.state = generator_state(self._env)

    def watch(self) -> None:
        """Whatever is drawn from here on is noticed. The generator is seeded only if something was drawn before."""
        if self.was_drawn():
            self.seed(0)

    def was_drawn(self) -> bool:
        """Whether something was drawn, or another generator took its place, since it was seeded or looked at."""
        generator = self._generator
        if generator is None or self._env.np_random is not generator:
            return True
        if generator.bit_generator.random_raw() == self._twin.random_raw():
            return False
        self._generator = None
        return True
