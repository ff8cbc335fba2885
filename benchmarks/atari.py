"""Games of Atari with a lookahead, against PPO at as many steps of the emulator and in as many seconds.

    python benchmarks/learning.py atari [--games freeway,breakout] [--steps N] [--seeds N] [--jobs N] [--quick]

    PGTS        configs/atari/*.yaml
    PPO         of stable-baselines3, with the settings that its zoo has for Atari and the same environment

A step of the emulator is one of the environment (four frames), whether the environment takes it or its model does: a
model call takes as many as the lookahead repeats its action. PGTS ends when it has taken `--steps`, and PPO is looked
at twice: when it has taken as many, and when it has taken as many CPU seconds. A look is the mean return of sampled
episodes in a fresh environment, of at most 2,000 steps each; it takes no part of the seconds.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from records import Key, Record, measure

from pgts_torch.config import Config, load
from pgts_torch.experiment.run import build
from pgts_torch.models.environments import EnvSource

CONFIGS = Path(__file__).resolve().parent.parent / "configs" / "atari"
RUNS = Path("runs/learning/atari.jsonl")
GAMES = "freeway", "breakout", "pong", "montezuma_revenge"
LONGEST, EPISODES = 2_000, 3
NUM_ENVS, NUM_STEPS = 8, 128

Act = Callable[[Any], Any]
"""From an observation to an action."""


class Watch:
    """CPU seconds of a training, without the looks at it."""

    def __init__(self) -> None:
        self._started = time.process_time()

    @property
    def seconds(self) -> float:
        return time.process_time() - self._started

    def look(self, config: Config, act: Act, steps: int) -> dict[str, float]:
        """The mean return of episodes with these actions, and what has been spent."""
        seconds, begun = self.seconds, time.process_time()
        score = mean_return(config, act)
        self._started += time.process_time() - begun
        return {"return": score, "steps": steps, "seconds": seconds}


def environment(config: Config) -> gymnasium.Env:
    return EnvSource.of(config.env.id, kwargs=config.env.kwargs).make_one()


def mean_return(config: Config, act: Act) -> float:
    env = gymnasium.wrappers.TimeLimit(environment(config), LONGEST)
    returns = []
    for number in range(EPISODES):
        observation, total, over = env.reset(seed=1000 + number)[0], 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    env.close()
    return statistics.mean(returns)


def run(key: Key) -> Record:
    """Both methods on a game with a seed, one after the other."""
    config = load(str(CONFIGS / f"{key['game']}.yaml"), ["--seed", str(key["seed"])])
    own = train(config, key["steps"])
    return {"pgts": own} | rival(config, key["seed"], key["steps"], own["seconds"])


def train(config: Config, steps: int) -> dict[str, float]:
    """PGTS, until it has taken so many steps of the emulator."""
    watch, model = Watch(), build(config)

    def taken() -> int:
        return model.num_env_steps + model.num_model_calls * config.search.action_repeat

    model.learn(steps, callback=lambda *_: taken() < steps)
    look = watch.look(config, lambda seen: model.predict(seen, deterministic=False), taken())
    model.close()
    return look | {"env_steps": model.num_env_steps}


def rival(config: Config, seed: int, steps: int, seconds: float) -> dict[str, dict[str, float]]:
    """PPO after as many steps, and after as many seconds."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    watch, env = Watch(), make_vec_env(lambda: environment(config), n_envs=NUM_ENVS, seed=seed)
    is_image = len(env.observation_space.shape or ()) == 3
    known = VecNormalize(env, norm_obs=not is_image, norm_reward=False)
    model = PPO(
        "CnnPolicy" if is_image else "MlpPolicy",
        known,
        n_steps=NUM_STEPS,
        n_epochs=4,
        batch_size=256,
        learning_rate=lambda left: 2.5e-4 * left,
        clip_range=lambda left: 0.1 * left,
        ent_coef=0.01,
        gamma=config.env.gamma or 0.99,
        seed=seed,
        device="cpu",
    )
    looks: dict[str, dict[str, float]] = {}

    def act(seen: np.ndarray) -> Any:
        return model.predict(known.normalize_obs(seen[None]), deterministic=False)[0][0]

    class Looked(BaseCallback):
        def _on_step(self) -> bool:
            if "ppo_steps" not in looks and self.num_timesteps >= steps:
                looks["ppo_steps"] = watch.look(config, act, self.num_timesteps)
            if "ppo_seconds" not in looks and watch.seconds >= seconds:
                looks["ppo_seconds"] = watch.look(config, act, self.num_timesteps)
            return len(looks) < 2

    # Twice: seconds may need more steps than `steps`, and the rates are those of a training of this length.
    model.learn(steps, callback=Looked())
    while len(looks) < 2:
        model.learn(steps, callback=Looked(), reset_num_timesteps=False)
    env.close()
    return looks


def row(game: str, records: list[Record]) -> str:
    """The medians over seeds, and all returns of each."""

    def cell(name: str) -> str:
        returns = ", ".join(f"{record[name]['return']:.3g}" for record in records)
        steps = statistics.median(record[name]["steps"] for record in records)
        return f"{returns} | {steps:,.0f} | {statistics.median(record[name]['seconds'] for record in records):.0f}"

    env_steps = statistics.median(record["pgts"]["env_steps"] for record in records)
    return f"| {game} | {cell('pgts')} | {env_steps:,.0f} | {cell('ppo_steps')} | {cell('ppo_seconds')} |"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--games", default=",".join(GAMES))
    parser.add_argument("--steps", type=int, default=200_000, help="of the emulator")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time, each in one thread; 0: none")
    parser.add_argument("--runs", type=Path, default=RUNS, help="finished runs, kept and not made again")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--quick", action="store_true", help="one seed, 2,000 steps")
    given = parser.parse_args(arguments)
    steps, seeds = (2_000, 1) if given.quick else (given.steps, given.seeds)
    torch.set_num_threads(1)
    games = given.games.split(",")
    keys = [{"game": game, "steps": steps, "seed": seed} for seed in range(seeds) for game in games]
    records = measure(keys, run, path=given.runs, jobs=given.jobs)
    if given.json:
        given.json.write_text(json.dumps(records, indent=1) + "\n")
    print("| game | PGTS: returns | steps | s | of the environment | PPO at as many steps | steps | s |", end="")
    print(" PPO in as many s | steps | s |\n" + "|---" * 11 + "|")
    for game in games:
        if found := [record for record in records if record["game"] == game]:
            print(row(game, found))


if __name__ == "__main__":
    main()
