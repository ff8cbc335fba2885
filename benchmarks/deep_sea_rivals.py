"""The algorithms of stable-baselines3 on DeepSea, as its users would run them."""

import math
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from records import Record
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv

from pgts_torch.envs import TabularVectorEnv
from pgts_torch.tabular import deep_sea

WIDTH = 64


class Cells(VecEnv):
    """Copies of a DeepSea that count their episodes and those that found the treasure.

    An observation is the number of the cell; `RowOf` makes a row of weights of it.
    """

    def __init__(self, size: int, num_envs: int, *, gamma: float, seed: int) -> None:
        mdp = deep_sea(size, gamma=gamma, mapping_seed=seed)
        self.env = TabularVectorEnv(mdp, num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
        self.first_seed, self.episodes, self.found = seed, 0, 0
        space = spaces.Box(0, mdp.num_states, shape=(1,), dtype=np.float32)
        super().__init__(num_envs, space, self.env.single_action_space)

    def reset(self) -> np.ndarray:
        return self._shown(self.env.reset(seed=self.first_seed)[0])

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        state_B, reward_B, terminated_B, _, info = self.env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if terminated_B.any():
            for b in np.flatnonzero(terminated_B):
                infos[b]["terminal_observation"] = self._shown(info["final_obs"])[b]
            self.episodes += int(terminated_B.sum())
            self.found += int((reward_B[terminated_B] > 0.5).sum())
        return self._shown(state_B), reward_B.astype(np.float32), terminated_B, infos

    @staticmethod
    def _shown(state_B: np.ndarray) -> np.ndarray:
        return np.asarray(state_B, dtype=np.float32)[:, None]

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [getattr(self.env, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class RowOf(BaseFeaturesExtractor):
    """The first layer of a network that sees the cell one-hot: its row of weights, looked up."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, WIDTH)
        self.rows = torch.nn.Embedding(int(observation_space.high[0]), WIDTH)
        torch.nn.init.orthogonal_(self.rows.weight, math.sqrt(2))
        self.bias = torch.nn.Parameter(torch.zeros(WIDTH))

    def forward(self, observation_B1: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.rows(observation_B1.squeeze(-1).long()) + self.bias)


class _Until(BaseCallback):
    """Ends the training once enough of the episodes have found the treasure."""

    def __init__(self, enough: float) -> None:
        super().__init__()
        self._enough = enough

    def _on_step(self) -> bool:
        env = self.training_env
        return env.found <= self._enough * env.episodes


def deep_sea_run(
    method: str, size: int, seed: int, *, gamma: float, num_envs: int, episodes: int, enough: float
) -> Record:
    """PPO or A2C with default settings, and two layers of 64 units for policy and critic each; for PPO a batch is one
    episode of each copy, seen in 4 epochs of 4 minibatches as in its settings for Atari."""
    env = Cells(size, num_envs, gamma=gamma, seed=seed)
    shared = {"features_extractor_class": RowOf, "share_features_extractor": False, "net_arch": [WIDTH]}
    if method == "ppo":
        options: dict[str, Any] = {"n_steps": size, "n_epochs": 4, "batch_size": size * num_envs // 4}
        model = PPO("MlpPolicy", env, gamma=gamma, seed=seed, device="cpu", policy_kwargs=shared, **options)
    else:
        model = A2C("MlpPolicy", env, gamma=gamma, seed=seed, device="cpu", policy_kwargs=shared)
    model.learn(episodes * size, callback=_Until(enough))
    return {
        "solved": env.found > enough * env.episodes,
        "episodes": env.episodes,
        "env_steps": model.num_timesteps,
        "model_calls": 0,
        "deepest": 0,
    }
