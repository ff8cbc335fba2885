"""An environment of your own: two methods make it a simulator that a lookahead can restore."""

import gymnasium
import numpy as np

from pgts_torch import PGTS, evaluate
from pgts_torch.models import check_model


class Corridor(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 8, (1,), dtype=np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = 0
        return np.array([0], np.float32), {}

    def step(self, action):
        self.position = max(0, self.position + (1 if action == 1 else -1))
        return np.array([self.position], np.float32), float(self.position == 8), self.position == 8, False, {}

    def get_state(self):
        return self.position

    def set_state(self, state):
        self.position = state


print(check_model(Corridor).verdict)
model = PGTS(Corridor, depth=8, horizon={"type": "fixed", "length": 40}).learn(4_000)
print(f"return {evaluate(model, episodes=5).episodic_return.mean:.0f}")
