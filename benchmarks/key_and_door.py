"""A puzzle that is seen as an image: fetch the key, pass the door, reach the goal; nothing is rewarded before."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

Cell = tuple[int, int]

MOVES: tuple[Cell, ...] = ((-1, 0), (0, 1), (1, 0), (0, -1))
"""Up, right, down, left."""


class KeyAndDoor(gymnasium.Env[np.ndarray, np.int64]):
    """A 6x6 room with a wall across it; the door in the wall opens for who has the key.

    Agent and key start in cells of the left half that are sampled in each episode. Reaching the goal in the far corner
    pays 1 and ends the episode.

    An observation has four channels of 0 and 255: agent, key (until it is taken), goal, wall and closed door (128).
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's type)
    size, wall, door, goal = 6, 3, (1, 3), (5, 5)

    def __init__(self) -> None:
        self.action_space = spaces.Discrete(len(MOVES))
        self.observation_space = spaces.Box(0, 255, (self.size, self.size, 4), np.uint8)
        self.agent: Cell = (0, 0)
        self.key: Cell | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        first, second = self.np_random.choice(self.size * self.wall, 2, replace=False)
        self.agent, self.key = divmod(int(first), self.wall), divmod(int(second), self.wall)
        return self._image(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        row, column = (here + by for here, by in zip(self.agent, MOVES[int(action)], strict=True))
        inside = 0 <= row < self.size and 0 <= column < self.size
        if inside and (column != self.wall or ((row, column) == self.door and self.key is None)):
            self.agent = row, column
        if self.agent == self.key:
            self.key = None
        over = self.agent == self.goal
        return self._image(), float(over), over, False, {}

    def _image(self) -> np.ndarray:
        image = np.zeros((self.size, self.size, 4), np.uint8)
        image[(*self.agent, 0)] = 255
        if self.key is not None:
            image[(*self.key, 1)] = 255
        image[(*self.goal, 2)] = 255
        image[:, self.wall, 3] = 255
        image[(*self.door, 3)] = 0 if self.key is None else 128
        return image

    def get_state(self) -> tuple[Cell, Cell | None]:
        return self.agent, self.key

    def set_state(self, state: tuple[Cell, Cell | None]) -> None:
        self.agent, self.key = state


ID = "KeyAndDoor-v0"
gymnasium.register(ID, KeyAndDoor, max_episode_steps=100)  # type: ignore[arg-type]
