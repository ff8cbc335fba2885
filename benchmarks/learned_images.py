"""What is learned from images and `env.step` alone: how soon is an environment solved with a learned model of them?

    python benchmarks/learned_images.py [--seeds N] [--tasks catch,empty] [--methods learned,ppo] [--jobs N]
                                        [--runs FILE] [--json FILE] [--picture FILE]

    learned     PGTS with a model that is learned from steps: configs/learned/catch.yaml, minigrid_*.yaml
    ppo         of stable-baselines3, in 8 environments with the zoo's settings for MiniGrid, and the same networks: the
                convolutions of the model, then two layers of 64 for policy and values

Catch is a ball that falls through 10 x 5 pixels; of MiniGrid's rooms the whole grid is seen (`pgts_torch.envs.images`).
A return is reached as in `tasks.py`: by greedy episodes, at the first of three evaluations in a row that have it.
Seconds are CPU seconds without evaluations.
"""

from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import tasks
import torch
from gymnasium.wrappers import TransformObservation
from matplotlib.figure import Figure
from records import Key, Record, benchmark
from tasks import ROOT, Task, Watch, mean_return
from torch import nn

from pgts_torch.config import load
from pgts_torch.experiment import run as experiment
from pgts_torch.options import CNN, Latent

RUNS = Path("runs/learning/learned_images.jsonl")
METHODS = {"learned": "learned model", "ppo": "PPO"}
CONFIGS = {"catch": "catch", "empty": "minigrid_empty", "door_key": "minigrid_door_key"}
TASKS = {"catch": Task(0.9, 20_000, 50), "empty": Task(0.9, 20_000, 20), "door_key": Task(0.9, 20_000, 20)}
TUNED = {"n_steps": 128, "batch_size": 64, "learning_rate": 2.5e-4, "n_epochs": 10, "gae_lambda": 0.95}
NUM_ENVS = 8


def run(key: Key) -> Record:
    """One method on one task with one seed."""
    task, seed = TASKS[key["task"]], key["seed"]
    config = load(str(ROOT / "configs" / "learned" / f"{CONFIGS[key['task']]}.yaml"), ["--seed", str(seed)])
    if key["method"] == "learned":
        return tasks.train(experiment.build(config), task, lambda model: mean_return(model, task, seed))
    assert isinstance(config.model, Latent)
    assert isinstance(config.model.network, CNN)
    watch, network = Watch(task), config.model.network
    _train_ppo(lambda: gymnasium.make(config.env.id, **config.env.kwargs), network, config.env.gamma, task, seed, watch)
    return watch.record()


def _train_ppo(
    make: Callable[[], gymnasium.Env], network: CNN, gamma: float | None, task: Task, seed: int, watch: Watch
) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class Convolutions(BaseFeaturesExtractor):
        """Those of our model."""

        def __init__(self, space: gymnasium.spaces.Box) -> None:
            super().__init__(space, network.hidden[-1])
            layers: list[nn.Module] = []
            for outputs, kernel_size, stride in network.convolutions:
                layers += [nn.LazyConv2d(outputs, kernel_size, stride), nn.ReLU()]
            layers.append(nn.Flatten())
            for outputs in network.hidden:
                layers += [nn.LazyLinear(outputs), nn.ReLU()]
            self.layers = nn.Sequential(*layers)
            self.layers(torch.zeros(1, *space.shape))  # which makes the layers that wait for it

        def forward(self, observations: torch.Tensor) -> torch.Tensor:
            found: torch.Tensor = self.layers(observations)
            return found

    def scaled() -> gymnasium.Env:
        """Channels first, as numbers up to 1."""
        env = make()
        shape = env.observation_space.shape
        assert shape is not None
        space = gymnasium.spaces.Box(-np.inf, np.inf, (shape[2], *shape[:2]), np.float32)
        by = network.scale or 255.0
        return TransformObservation(env, lambda image: image.transpose(2, 0, 1).astype(np.float32) / by, space)

    env = make_vec_env(scaled, n_envs=NUM_ENVS, seed=seed)
    fresh = make_vec_env(scaled, n_envs=task.episodes, seed=seed + 1000)
    model = PPO(
        "MlpPolicy",
        env,
        seed=seed,
        device="cpu",
        gamma=gamma or 0.99,
        policy_kwargs={"features_extractor_class": Convolutions, "net_arch": [64, 64]},
        **TUNED,
    )

    def score() -> float:
        return float(np.mean(evaluate_policy(model, fresh, task.episodes, deterministic=True, warn=False)[0]))

    class Watched(BaseCallback):
        def _on_step(self) -> bool:
            return watch(self.num_timesteps, 0, score)

    model.learn(task.budget, callback=Watched())


def table(records: list[Record]) -> str:
    """In Markdown."""
    return tasks.table(records, TASKS, METHODS)


def picture(records: list[Record]) -> Figure:
    """Return against environment steps."""
    return tasks.picture(records, shape=(1, 3), tasks=TASKS, methods=METHODS)


def main(arguments: list[str] | None = None) -> None:
    benchmark(__doc__, arguments, "task", tuple(TASKS), tuple(METHODS), RUNS, run, table, picture)


if __name__ == "__main__":
    main()
