"""PPO, A2C and DQN of stable-baselines3 with the tuned settings of RL Baselines3 Zoo, as its users would run them.

For FrozenLake, CliffWalking and Taxi the zoo has none: there they run with their defaults in 8 environments, PPO with
batches of 2,048 steps as by default, in minibatches of 256 as on CartPole. For DoorKey it has those of PPO; the
others run with their defaults on the same normalised observations.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

UNLIMITED = {"train": 100, "eval": 1000}
"""Time limits where the environment sets none: the horizon of our configuration, and of our evaluation."""

ALGORITHMS: dict[str, Any] = {"ppo": PPO, "a2c": A2C, "dqn": DQN}


def falling(first: float) -> Callable[[float], float]:
    """The zoo's `lin_`: from the first value to 0 over the training."""
    return lambda left: left * first


WIDE = {"net_arch": [256, 256]}
NUM_ENVS = {"CartPole-v1": 8, "Acrobot-v1": 16, "MountainCar-v0": 16, "LunarLander-v3": 16}
NORMALIZED = ("Acrobot-v1", "MountainCar-v0", "MiniGrid-DoorKey-5x5-v0")
TUNED: dict[tuple[str, str], dict[str, Any]] = {
    ("ppo", "CartPole-v1"): {
        "n_steps": 32,
        "batch_size": 256,
        "gae_lambda": 0.8,
        "gamma": 0.98,
        "n_epochs": 20,
        "learning_rate": falling(1e-3),
        "clip_range": falling(0.2),
    },
    ("ppo", "Acrobot-v1"): {"n_steps": 256, "gae_lambda": 0.94, "gamma": 0.99, "n_epochs": 4},
    ("ppo", "MountainCar-v0"): {"n_steps": 16, "gae_lambda": 0.98, "gamma": 0.99, "n_epochs": 4},
    ("ppo", "MiniGrid-DoorKey-5x5-v0"): {"n_steps": 128, "batch_size": 64, "learning_rate": 2.5e-4},
    ("ppo", "LunarLander-v3"): {
        "n_steps": 1024,
        "gae_lambda": 0.98,
        "gamma": 0.999,
        "n_epochs": 4,
        "ent_coef": 0.01,
    },
    ("a2c", "LunarLander-v3"): {"gamma": 0.995, "learning_rate": falling(8.3e-4), "ent_coef": 1e-5},
    ("dqn", "CartPole-v1"): {
        "learning_rate": 2.3e-3,
        "batch_size": 64,
        "buffer_size": 100_000,
        "learning_starts": 1000,
        "target_update_interval": 10,
        "train_freq": 256,
        "gradient_steps": 128,
        "exploration_final_eps": 0.04,
        "policy_kwargs": WIDE,
    },
    ("dqn", "Acrobot-v1"): {
        "learning_rate": 6.3e-4,
        "batch_size": 128,
        "buffer_size": 50_000,
        "learning_starts": 0,
        "target_update_interval": 250,
        "train_freq": 4,
        "gradient_steps": -1,
        "exploration_final_eps": 0.1,
        "policy_kwargs": WIDE,
    },
    ("dqn", "MountainCar-v0"): {
        "learning_rate": 4e-3,
        "batch_size": 128,
        "buffer_size": 10_000,
        "learning_starts": 1000,
        "gamma": 0.98,
        "target_update_interval": 600,
        "train_freq": 16,
        "gradient_steps": 8,
        "exploration_final_eps": 0.07,
        "policy_kwargs": WIDE,
    },
    ("dqn", "LunarLander-v3"): {
        "learning_rate": 6.3e-4,
        "batch_size": 128,
        "buffer_size": 50_000,
        "learning_starts": 0,
        "gamma": 0.99,
        "target_update_interval": 250,
        "train_freq": 4,
        "gradient_steps": -1,
        "exploration_final_eps": 0.1,
        "policy_kwargs": WIDE,
    },
}
EXPLORATION_STEPS = {"CartPole-v1": 8_000, "Acrobot-v1": 12_000, "MountainCar-v0": 24_000, "LunarLander-v3": 12_000}
"""The zoo's exploration_fraction of its n_timesteps."""


def train(
    method: str,
    env_id: str,
    episodes: int,
    *,
    seed: int,
    gamma: float,
    budget: int,
    watch: Callable[..., bool],
    judge: Callable[[Any], float] | None = None,
    env_kwargs: dict[str, Any] | None = None,
) -> None:
    """One training, watched by evaluations of so many episodes.

    Args:
        judge: the score of a model of stable-baselines3, instead of the mean return of episodes.
    """
    num_envs = 1 if method == "dqn" else NUM_ENVS.get(env_id, 8)
    env = _envs(env_id, num_envs, "train", seed, env_kwargs)
    fresh = _envs(env_id, min(50, episodes), "eval", seed + 1000, env_kwargs)
    untuned = {"n_steps": 256, "batch_size": 256} if method == "ppo" else {}
    options = {"gamma": gamma} | TUNED.get((method, env_id), untuned)
    if method == "dqn" and env_id in EXPLORATION_STEPS:
        options["exploration_fraction"] = EXPLORATION_STEPS[env_id] / budget
    if env_id in NORMALIZED and method != "dqn":
        env = VecNormalize(env, gamma=options["gamma"])
        fresh = VecNormalize(fresh, training=False, norm_reward=False)
    model = ALGORITHMS[method]("MlpPolicy", env, seed=seed, device="cpu", **options)

    def score() -> float:
        if judge is not None:
            return judge(model)
        sync_envs_normalization(env, fresh)
        return float(evaluate_policy(model, fresh, episodes, deterministic=True, warn=False)[0])

    class Watched(BaseCallback):
        def _on_step(self) -> bool:
            return watch(self.num_timesteps, 0, score)

    model.learn(budget, callback=Watched())


def _envs(env_id: str, count: int, use: str, seed: int, kwargs: dict[str, Any] | None) -> VecEnv:
    def make() -> gymnasium.Env:
        limit = gymnasium.spec(env_id).max_episode_steps or UNLIMITED[use]
        env = gymnasium.make(env_id, max_episode_steps=limit, **(kwargs or {}))
        if env_id.startswith("MiniGrid-"):
            from minigrid.wrappers import ImgObsWrapper

            env = gymnasium.wrappers.FlattenObservation(ImgObsWrapper(env))
        return env

    if env_id.startswith("MiniGrid-"):
        import minigrid  # noqa: F401 - registers its environments
    return make_vec_env(make, n_envs=count, seed=seed)
