"""Environments that are seen as images."""

from typing import Any, final

import gymnasium
import numpy as np
from gymnasium import spaces

from pgts_torch.errors import PgtsError, check_count


@final
class Catch(gymnasium.Env[np.ndarray, np.int64]):
    """A ball falls and is to be caught, as in the `catch` of bsuite (Osband et al. 2020).

    It falls from a random column of the top row, one row a step, while the paddle in the bottom row moves left, stays
    or moves right. The episode ends when the ball is in the bottom row: with reward 1 if the paddle is there, else -1.

    An observation is an image (rows, columns, 1) of bytes, 255 where ball and paddle are and else 0.

    Args:
        rows, columns: at least 2 and 1.
        render_mode: "rgb_array", the same image in three colours; None: it is not drawn.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (Gymnasium's type)

    def __init__(self, rows: int = 10, columns: int = 5, render_mode: str | None = None) -> None:
        check_count("rows", rows, least=2)
        check_count("columns", columns)
        self.action_space = spaces.Discrete(3)
        self.observation_space = spaces.Box(0, 255, (rows, columns, 1), np.uint8)
        self._shape, self._ball, self._paddle, self.render_mode = (rows, columns), (0, 0), 0, render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The ball in a random column, the paddle in the middle."""
        super().reset(seed=seed)
        columns = self._shape[1]
        self._ball, self._paddle = (0, int(self.np_random.integers(columns))), columns // 2
        return self._image(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Actions: 0 left, 1 stay, 2 right."""
        rows, columns = self._shape
        self._paddle = min(max(self._paddle + int(action) - 1, 0), columns - 1)
        self._ball = self._ball[0] + 1, self._ball[1]
        over, caught = self._ball[0] == rows - 1, self._ball[1] == self._paddle
        return self._image(), (1.0 if caught else -1.0) if over else 0.0, over, False, {}

    def render(self) -> np.ndarray | None:
        """What an observation shows; None without a render mode."""
        return None if self.render_mode is None else self._image().repeat(3, -1)

    def _image(self) -> np.ndarray:
        image = np.zeros((*self._shape, 1), np.uint8)
        image[self._ball] = image[-1, self._paddle] = 255
        return image


def minigrid(room: str) -> gymnasium.Env:
    """An environment of MiniGrid (extra `envs`) of which the whole grid is seen: three codes of each cell, for what is
    there, its colour and its state, with the agent and where it looks among them.

    Args:
        room: its id, for instance MiniGrid-Empty-8x8-v0.

    Raises:
        PgtsError: MiniGrid is not installed.
    """
    try:
        import minigrid  # noqa: F401 - registers its environments
        from minigrid.wrappers import FullyObsWrapper, ImgObsWrapper
    except ImportError as error:
        raise PgtsError(f"{room} needs MiniGrid: pip install pgts_torch[envs]") from error
    whole: gymnasium.Env = ImgObsWrapper(FullyObsWrapper(gymnasium.make(room)))
    return whole


def atari(game: str, size: int = 84, stack: int = 4, sticky: float = 0.25) -> gymnasium.Env:
    """A game of Atari (extra `atari`) as it is usually learned: four frames a step, of which the brighter of the last
    two is seen in grey and scaled down; a stack of the latest observations, channels first; and actions that stick.

    They stick by Gymnasium's wrapper, so that it is drawn by the search whether they do. ALE's own stickiness would be
    foreseen.

    Args:
        game: its id, for instance ALE/Breakout-v5.
        size: pixels on a side.
        stack: how many observations are seen at once.
        sticky: the probability with which an action is the one before; 0: it never is.

    Raises:
        PgtsError: ALE or OpenCV, with which images are scaled, is not installed.
    """
    try:
        import ale_py  # noqa: F401 - registers its environments
        import cv2  # noqa: F401 - AtariPreprocessing needs it
    except ImportError as error:
        raise PgtsError(f"{game} needs ALE and OpenCV: pip install 'pgts_torch[atari]'") from error
    env: gymnasium.Env = gymnasium.make(game, frameskip=1, repeat_action_probability=0.0)
    env = gymnasium.wrappers.AtariPreprocessing(env, screen_size=size)
    env = gymnasium.wrappers.FrameStackObservation(env, stack)
    return gymnasium.wrappers.StickyAction(env, sticky) if sticky else env
