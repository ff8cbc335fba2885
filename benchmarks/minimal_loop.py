"""A2C and PPO on CartPole as a loop that does nothing else: no checks, options, seeds of episodes, diagnostics or state
to save. What it takes is what torch and the environments take: eager torch, one fused Adam for policy and values.

`throughput.py` trains with it beside ours and SB3's, with the same settings.
"""

import itertools
import time

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor, nn


def _mlp(outputs: int, hidden: tuple[int, ...]) -> nn.Sequential:
    sizes, layers = (4, *hidden), list[nn.Module]()
    for inputs, size in itertools.pairwise(sizes):
        layers += [nn.Linear(inputs, size), nn.Tanh()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


def train(
    kind: str,
    num_envs: int,
    length: int,
    steps: int,
    seed: int,
    *,
    hidden: tuple[int, ...],
    rate: float,
    gamma: float,
    lambda_: float,
    epochs: int,
    minibatch: int,
    clip: float,
) -> dict[str, float]:
    """Transitions, updates, and the CPU seconds of learning and of collecting."""
    torch.manual_seed(seed)
    pi, vf = _mlp(2, hidden), _mlp(1, hidden)
    weights = [*pi.parameters(), *vf.parameters()]
    adam = torch.optim.Adam(weights, rate, fused=True)
    make = [lambda: gymnasium.make("CartPole-v1", disable_env_checker=True)] * num_envs
    env = SyncVectorEnv(make, autoreset_mode=AutoresetMode.SAME_STEP)
    T, B = length, num_envs
    seen, action, log_prob = torch.zeros(T, B, 4), torch.zeros(T, B, dtype=torch.long), torch.zeros(T, B)
    reward, over, value = torch.zeros(T, B), torch.zeros(T, B), torch.zeros(T + 1, B)

    def learn(x: Tensor, a: Tensor, before: Tensor, advantage: Tensor, returns: Tensor) -> None:
        log = torch.log_softmax(pi(x), 1).gather(1, a[:, None]).squeeze(1)
        if kind == "PPO":
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            ratio = (log - before).exp()
            loss = torch.maximum(-advantage * ratio, -advantage * ratio.clamp(0.8, 1.2)).mean()
        else:
            loss = -(log * advantage).mean()
        loss = loss + 0.5 * (vf(x).squeeze(1) - returns).square().mean()
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(weights, clip)
        adam.step()

    observation, done, updates = env.reset(seed=seed)[0], 0, 0
    collecting, begun = 0.0, time.process_time()
    while done < steps:
        at = time.process_time()
        with torch.inference_mode():
            for t in range(T):
                seen[t] = x = torch.from_numpy(np.asarray(observation, dtype=np.float32))
                log = torch.log_softmax(pi(x), 1)
                chosen = torch.multinomial(log.exp(), 1)
                action[t], log_prob[t], value[t] = chosen.squeeze(1), log.gather(1, chosen).squeeze(1), vf(x).squeeze(1)
                observation, r, ended, cut, _ = env.step(chosen.squeeze(1).numpy())
                reward[t], over[t] = torch.from_numpy(r), torch.from_numpy(ended | cut)
            value[T] = vf(torch.from_numpy(np.asarray(observation, dtype=np.float32))).squeeze(1)
            advantage, after = torch.zeros(T, B), torch.zeros(B)
            for t in reversed(range(T)):
                on = gamma * (1 - over[t])
                advantage[t] = after = reward[t] + on * value[t + 1] - value[t] + on * lambda_ * after
        collecting += time.process_time() - at
        columns = (seen, action, log_prob, advantage, advantage + value[:-1])
        rows = [column.reshape(T * B, *column.shape[2:]).clone() for column in columns]
        if kind == "PPO":
            for _ in range(epochs):
                for part in torch.randperm(T * B).split(minibatch):
                    learn(*(row[part] for row in rows))
        else:
            learn(*rows)
        done, updates = done + T * B, updates + 1
    return {"steps": done, "updates": updates, "seconds": time.process_time() - begun, "collecting": collecting}
