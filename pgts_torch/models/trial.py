"""A short trial of models that claim to be an environment: do its steps contradict them?"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
from jaxtyping import Float

from pgts_torch.errors import PgtsError
from pgts_torch.models.base import CONTRADICTED, ExactModel, Happened, step_text
from pgts_torch.models.classic import dynamics_of
from pgts_torch.models.dynamics import DynamicsModel
from pgts_torch.models.steps import discount_of, names_discounts, number_of
from pgts_torch.models.tabular import TabularModel, tabular_truth
from pgts_torch.tabular.mdp import TabularMDP

_GAMMA = 0.5
"""Only an end, of discount 0, has to differ from it."""

_STEPS, _LONGEST_EPISODE, _RESETS = 400, 40, 1000
_SECONDS = 0.3
"""After these a trial ends in a slow environment, though never before its first step."""


def table_contradiction(
    mdp: TabularMDP, env: gymnasium.Env, gamma: float, generator: np.random.Generator, *, seconds: float = _SECONDS
) -> tuple[str, int]:
    """The first thing in a short random walk that a table rules out, empty where there is none; and how many steps were
    compared.

    Starts must have positive probability, and each step must be an outcome that has (`TabularModel.outcome_of`).

    Args:
        env: an instance for this alone, in the wrappers that the table is meant for.
        gamma: discount of a step that names none.
    """

    def state_of(seen: Any) -> int:
        if not _is_state(seen, mdp.num_states):
            raise _NoState(f"it shows {seen!r}, which is none of the states 0 to {mdp.num_states - 1}")
        return int(seen)

    def began(state: int) -> None:
        if mdp.start_S[state] == 0:
            raise _NoState(f"it starts in state {state}, which has probability 0 there")

    try:
        return _contradiction(TabularModel(mdp), _walk(env, gamma, generator, state_of, began, seconds))
    except _NoState as off:
        return str(off), 0


def dynamics_contradiction(
    model: DynamicsModel, env: gymnasium.Env, generator: np.random.Generator, *, seconds: float = _SECONDS
) -> tuple[str, int]:
    """The first step of a short random walk that dynamics in torch contradict (`TensorModel.outcome_of`), empty where
    there is none; and how many steps were compared.

    Args:
        model: for this alone: it numbers the states of the walk.
        env: an instance for this alone, in the wrappers that the dynamics are meant for.
    """
    numbers = _walk(env, model.gamma, generator, lambda _: int(model.roots([env])), lambda _: None, seconds)
    return _contradiction(model, numbers)


def claims(env: gymnasium.Env, generator: np.random.Generator) -> Iterator[tuple[str, str, int]]:
    """The models that claim to be an environment, "table" or "dynamics", each with its contradiction as above.

    Args:
        env: an instance for this alone. Its table is compared with the environment inside its wrappers.
    """
    base: Any = env.unwrapped
    with contextlib.suppress(PgtsError):  # the attribute P is no table
        mdp = tabular_truth(base, gamma=_GAMMA)
        yield "table", *table_contradiction(mdp, base, _GAMMA, generator, seconds=math.inf)
    if (kind := dynamics_of(env)) is not None:
        model = kind(env, gamma=_GAMMA)
        yield "dynamics", *dynamics_contradiction(model, env, generator, seconds=math.inf)


def counted_starts(env: gymnasium.Env, num_states: int, generator: np.random.Generator) -> Float[np.ndarray, "S"]:
    """The share of up to 1,000 seeded resets in which each state was the start.

    Raises:
        ValueError: a start is no state.
    """
    counts, until = np.zeros(num_states), time.monotonic() + _SECONDS
    for _ in range(_RESETS):
        state, _ = env.reset(seed=_seed(generator))
        if not _is_state(state, num_states):
            raise ValueError(f"reset gave {state!r}, which is none of the states 0 to {num_states - 1}")
        counts[int(state)] += 1
        if time.monotonic() > until:
            break
    return counts / counts.sum()


class _NoState(Exception):
    """An observation is no state, or a start that has no probability."""


_Step = tuple[int, int, float, float, int]
"""State, number of the action, reward, discount and next state."""


def _contradiction(model: ExactModel, steps: Iterator[_Step]) -> tuple[str, int]:
    """The first step that contradicts a model, in words, and how many steps there were."""
    columns = list(zip(*steps, strict=True))
    if not columns:
        return "", 0
    state_N, action_N, reward_N, discount_N, next_N = map(np.array, columns)
    happened = Happened(state_N, action_N, reward_N, discount_N, next_N, np.zeros(len(state_N), dtype=bool))
    off = np.flatnonzero(model.outcome_of(happened) == CONTRADICTED)
    if not off.size:
        return "", len(state_N)
    state, action, reward, discount, following = (column[off[0]] for column in columns)
    return (
        f"after action {action} in {model.state_text(state)} came "
        f"{step_text(reward, discount, model.state_text(following))}; it has {model.outcomes_text(state, action)}"
    ), len(state_N)


def _walk(
    env: gymnasium.Env,
    gamma: float,
    generator: np.random.Generator,
    state_of: Callable[[Any], int],
    began: Callable[[int], None],
    seconds: float,
) -> Iterator[_Step]:
    """Random episodes, up to an error of the environment: that is no contradiction, and is reported when it stops a
    training."""
    until, taken, named = time.monotonic() + seconds, 0, names_discounts(env)
    try:
        while taken < _STEPS and (time.monotonic() < until or taken == 0):
            seen, _ = env.reset(seed=_seed(generator))
            state = state_of(seen)
            began(state)
            for _ in range(_LONGEST_EPISODE):
                action = int(generator.integers(env.action_space.n))  # type: ignore[attr-defined]
                seen, reward, terminated, truncated, info = env.step(action)
                discount = 0.0 if terminated else discount_of(info, gamma, named=named)
                before, state = state, state_of(seen)
                yield before, action, number_of("reward", reward), discount, state
                taken += 1
                if terminated or truncated or time.monotonic() > until:
                    break
    except (_NoState, KeyboardInterrupt):
        raise
    except BaseException:
        return


def _is_state(seen: Any, num_states: int) -> bool:
    array = np.asarray(seen)
    return array.ndim == 0 and array.dtype.kind in "iu" and 0 <= int(array) < num_states


def _seed(generator: np.random.Generator) -> int:
    return int(generator.integers(2**31))
