"""A cart that kills its process, once, where the file `fatal` lies in the working folder."""

import os
import signal
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv


class Fatal(CartPoleEnv):
    steps = 0

    def step(self, action: Any) -> Any:
        Fatal.steps += 1
        if Fatal.steps == 20 and os.environ["RANK"] == "1" and Path("fatal").exists():
            Path("fatal").unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)


gymnasium.register("Fatal-v0", Fatal)
