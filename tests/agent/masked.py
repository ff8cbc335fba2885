"""A small environment that raises an error where an action is not legal, and the same as an exact MDP."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from pgts_torch.bellman import Outcomes
from pgts_torch.tabular import TabularMDP

GAMMA = 0.9

# Six states and three actions; the last state is an end. Where an action is not legal it would be the best one.
LEGAL_SA = np.array([[1, 1, 0], [0, 1, 1], [1, 0, 0], [1, 1, 1], [0, 1, 0]], dtype=np.int8)
NEXT_SA = np.array([[1, 2, 5], [5, 3, 0], [3, 5, 5], [4, 2, 1], [5, 0, 5]])
REWARD_SA = np.array([[0.0, 0.3, 9.0], [9.0, 0.1, -0.2], [0.5, 9.0, 9.0], [0.0, 0.4, -1.0], [9.0, 1.0, 9.0]])


class Strict(gymnasium.Env):
    """Six states, seen as a number or as a vector. An illegal action is an error.

    Args:
        says: how it says which actions are legal, "info", "observation" or not at all.
        bare: whether it is restored from its attributes, for it has no `get_state`.
    """

    action_space = spaces.Discrete(3)
    taken = 0

    def __init__(self, says: str = "method", *, vector: bool = False, bare: bool = False) -> None:
        self.says, self.vector = says, vector
        if bare:
            self.get_state = None
        seen: Any = spaces.Box(0, 1, (6,), np.float32) if vector else spaces.Discrete(6)
        mask: Any = spaces.Box(0, 1, (3,), np.int8) if vector else spaces.MultiBinary(3)
        self.observation_space = seen
        if says == "observation":
            self.observation_space = spaces.Dict({"observation": seen, "action_mask": mask})

    def _mask(self) -> np.ndarray:
        return LEGAL_SA[self.s] if self.s < 5 else np.zeros(3, np.int8)

    def _seen(self) -> Any:
        seen = np.eye(6, dtype=np.float32)[self.s] if self.vector else self.s
        return {"observation": seen, "action_mask": self._mask()} if self.says == "observation" else seen

    def _info(self) -> dict[str, Any]:
        return {"action_mask": self._mask()} if self.says == "info" else {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = int(self.np_random.integers(3))
        return self._seen(), self._info()

    def step(self, action):
        if not LEGAL_SA[self.s, action]:
            raise ValueError(f"action {action} is not legal in state {self.s}")
        type(self).taken += 1
        reward, self.s = float(REWARD_SA[self.s, action]), int(NEXT_SA[self.s, action])
        return self._seen(), reward, self.s == 5, False, self._info()

    def get_state(self):
        return (self.s,)

    def set_state(self, state):
        (self.s,) = state


class ByMethod(Strict):
    """With the method of the class."""

    def __init__(self, **options) -> None:
        super().__init__("class", **options)

    def action_masks(self):
        return self._mask().astype(bool)


class Masker(gymnasium.Wrapper):
    """Gives the masks of an environment that has none of its own, as the wrapper of sb3-contrib does."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.mask_of = lambda inner: inner.unwrapped._mask()

    def action_masks(self):
        return self.mask_of(self.env)


class Turned(gymnasium.ActionWrapper):
    """Numbers the actions the other way round."""

    def action(self, action):
        return 2 - action


def legal_mdp() -> TabularMDP:
    """The same MDP without illegal actions: each of them is the first legal one of its state once more."""
    legal_SA = np.concatenate([LEGAL_SA, np.ones((1, 3), np.int8)])
    action_SA = np.where(legal_SA, np.arange(3), legal_SA.argmax(-1)[:, None])
    next_SA = np.take_along_axis(np.concatenate([NEXT_SA, np.full((1, 3), 5)]), action_SA, 1)
    reward_SA = np.take_along_axis(np.concatenate([REWARD_SA, np.zeros((1, 3))]), action_SA, 1)
    child_SA1 = torch.from_numpy(next_SA)[:, :, None]
    discount = torch.where(child_SA1 == 5, 0.0, GAMMA).double()
    outcomes = Outcomes(torch.from_numpy(reward_SA), torch.ones_like(discount), discount, child_SA1, 6)
    return TabularMDP(outcomes, torch.tensor([1, 1, 1, 0, 0, 0], dtype=torch.float64) / 3)


ENVIRONMENTS: dict[str, Any] = {
    "action_masks()": ByMethod,
    "action_masks(), observed as vectors": lambda: ByMethod(vector=True),
    "info": lambda: Strict("info"),
    "info, observed as vectors": lambda: Strict("info", vector=True),
    "info, without get_state": lambda: Strict("info", bare=True),
    "observation": lambda: Strict("observation"),
    "observation, observed as vectors": lambda: Strict("observation", vector=True),
    "observation, without get_state": lambda: Strict("observation", bare=True),
    "observation, within an action wrapper": lambda: Turned(Strict("observation")),
    "action_masks(), of a wrapper": lambda: Masker(Strict("nothing")),
    "action_masks(), of a wrapper within an action wrapper": lambda: Turned(Masker(Strict("nothing"))),
    "info, within an action wrapper": lambda: Turned(Strict("info")),
    "action_masks(), within an action wrapper": lambda: Turned(ByMethod()),
}
MAKERS: dict[str, Any] = {
    "method": ByMethod,
    "info": lambda: Strict("info"),
    "observation": lambda: Strict("observation"),
}
SEARCHES: dict[str, dict[str, Any]] = {
    "none": {"depth": 0, "estimator": "sampled"},
    "m = 0": {"depth": 0},
    "expectimax": {"depth": 2, "search": "expectimax"},
    "pruned": {"depth": 3, "search": {"type": "expectimax", "max_width": 2}},
    "sampled": {"depth": 2, "search": {"type": "sampled", "samples": 2}},
    "mcts": {"depth": 3, "search": {"type": "mcts", "simulations": 8}},
    "merged mcts": {"depth": 3, "search": {"type": "mcts", "simulations": 8, "merge": True}},
    "auto": {"depth": 2},
}
