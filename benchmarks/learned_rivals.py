"""What tables learn from `env.step` alone without a policy gradient: R-max, posterior sampling, Q-learning.

Each function steps a Gymnasium environment with numbered states and actions, and after each step calls

    watch(steps, greedy) -> bool

with the number of steps so far and a function that returns the greedy action of each state; False ends it.
"""

from collections.abc import Callable

import gymnasium
import numpy as np
import torch

from pgts_torch.bellman import backup, sweep
from pgts_torch.models import CountsModel
from pgts_torch.models.base import Experience
from pgts_torch.options import Counts
from pgts_torch.seeding import numpy_stream, stream

Watch = Callable[[int, Callable[[], np.ndarray]], bool]

_SWEEPS = 25
"""Of value iteration between two looks at whether it has settled."""


def planned(
    env: gymnasium.Env, watch: Watch, *, gamma: float, options: Counts, budget: int, horizon: int, seed: int
) -> None:
    """Act greedily in a table of counts with full value iteration, which is made again after each episode and where
    steps are news: R-max (Brafman and Tennenholtz 2002), or with optimism posterior PSRL (Osband et al. 2013)."""
    acting = _Planner(env, gamma, options, seed)
    judged = _Planner(env, gamma, Counts(optimism="none"), seed)  # of its own, so that a look at it changes nothing
    state, length, action_S = int(env.reset(seed=seed)[0]), 0, None
    for steps in range(1, budget + 1):
        action_S = acting.actions() if action_S is None else action_S
        action = int(action_S[state])
        following, reward, terminated, truncated, _ = env.step(action)
        for planner in (acting, judged):
            planner.steps.append((state, action, float(reward), 0.0 if terminated else gamma, int(following), False))
        if acting.model.is_news(torch.tensor([state]), torch.tensor([action])):
            action_S = None
        state, length = int(following), length + 1
        if terminated or truncated or length >= horizon:
            state, length, action_S = int(env.reset()[0]), 0, None
        if not watch(steps, judged.actions):
            return


class _Planner:
    """Value iteration in a table of counts.

    steps: those that the table has not learned yet.
    """

    def __init__(self, env: gymnasium.Env, gamma: float, options: Counts, seed: int) -> None:
        S, A = _sizes(env)
        self.model, self._generator = CountsModel(S, A, gamma=gamma, options=options), stream(seed, "learn")
        self.steps: list[tuple[int, int, float, float, int, bool]] = []
        self._v_S = torch.zeros(S, dtype=torch.float64)

    def actions(self) -> np.ndarray:
        """The optimal action of each state in what has been seen so far."""
        if self.steps:
            columns = [torch.from_numpy(np.array(column)) for column in zip(*self.steps, strict=True)]
            self.model.learn(Experience(*columns), generator=self._generator)  # type: ignore[arg-type]
            self.steps.clear()
        outcomes = self.model.outcomes(torch.arange(self.model.num_states))
        while True:
            v_S, self._v_S = self._v_S, sweep(outcomes, self._v_S, _SWEEPS)
            if float((self._v_S - v_S).abs().max()) <= 1e-6 * float(self._v_S.abs().max()):
                return backup(outcomes, self._v_S).argmax(-1).numpy()


def q_learning(
    env: gymnasium.Env,
    watch: Watch,
    *,
    gamma: float,
    step_size: float,
    epsilon: float,
    initial: float,
    budget: int,
    horizon: int,
    seed: int,
) -> None:
    """Q-learning (Watkins 1989) with epsilon-greedy actions, ties broken at random.

    Args:
        initial: of all values; as large as the largest value it is optimistic.
    """
    S, A = _sizes(env)
    random = numpy_stream(seed, "q_learning")
    q_SA = initial + 1e-9 * random.random((S, A))
    state, length = int(env.reset(seed=seed)[0]), 0
    for steps in range(1, budget + 1):
        action = int(random.integers(A)) if random.random() < epsilon else int(q_SA[state].argmax())
        following, reward, terminated, truncated, _ = env.step(action)
        target = float(reward) + (0.0 if terminated else gamma * q_SA[following].max())
        q_SA[state, action] += step_size * (target - q_SA[state, action])
        state, length = int(following), length + 1
        if terminated or truncated or length >= horizon:
            state, length = int(env.reset()[0]), 0
        if not watch(steps, lambda: q_SA.argmax(-1)):
            return


def _sizes(env: gymnasium.Env) -> tuple[int, int]:
    """S and A."""
    assert isinstance(env.observation_space, gymnasium.spaces.Discrete)
    assert isinstance(env.action_space, gymnasium.spaces.Discrete)
    return int(env.observation_space.n), int(env.action_space.n)
