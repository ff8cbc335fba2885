"""Models that claim to be an environment, held to its steps for a moment before they are believed."""

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
from pgts_torch.models.classic import ClassicModel, dynamics_of
from pgts_torch.models.steps import discount_of, names_discounts, number_of
from pgts_torch.models.tabular import TabularModel, tabular_truth
from pgts_torch.tabular.mdp import TabularMDP

_GAMMA = 0.5
"""Any discount serves where an end is to be told from going on."""

_STEPS, _LONGEST_EPISODE, _RESETS = 400, 40, 1000
_SECONDS = 0.3
"""After which a trial ends in a slow environment, though never before its first step."""


def table_contradiction(
    mdp: TabularMDP, env: gymnasium.Env, gamma: float, generator: np.random.Generator, *, seconds: float = _SECONDS
) -> tuple[str, int]:
    """The first thing in a short random walk that cannot be by a table, empty where there is none; and how many steps
    were held to it.

    Starts must have positive probability, and each step must be an outcome that has (`TabularModel.outcome_of`).

    Args:
        env: an instance that nobody else needs, in the wrappers that the table is meant to hold for.
        gamma: discount of a step that names none.
    """

    def state_of(shown: Any) -> int:
        if not _is_state(shown, mdp.num_states):
            raise _NoState(f"it shows {shown!r}, which is none of the states 0 to {mdp.num_states - 1}")
        return int(shown)

    def began(state: int) -> None:
        if mdp.start_S[state] == 0:
            raise _NoState(f"it starts in state {state}, which has probability 0 there")

    try:
        return _denied(TabularModel(mdp), _walk(env, gamma, generator, state_of, began, seconds))
    except _NoState as off:
        return str(off), 0


def dynamics_contradiction(
    model: ClassicModel, env: gymnasium.Env, generator: np.random.Generator, *, seconds: float = _SECONDS
) -> tuple[str, int]:
    """The first step of a short random walk that dynamics in torch contradict (`TensorModel.outcome_of`), empty where
    there is none; and how many steps were compared.

    Args:
        model: of its own, for it numbers the states that are met.
        env: an instance that nobody else needs, in the wrappers that the dynamics are meant to hold for.
    """
    numbers = _walk(env, model.gamma, generator, lambda _: int(model.roots([env])), lambda _: None, seconds)
    return _denied(model, numbers)


def claims(env: gymnasium.Env, generator: np.random.Generator) -> Iterator[tuple[str, str, int]]:
    """What claims to be an environment, "table" or "dynamics", with what is found of it as above.

    Args:
        env: an instance that nobody else needs. What is inside its wrappers is held to its table.
    """
    base: Any = env.unwrapped
    with contextlib.suppress(PgtsError):  # what is called P is no table
        mdp = tabular_truth(base, gamma=_GAMMA)
        yield "table", *table_contradiction(mdp, base, _GAMMA, generator, seconds=math.inf)
    if (kind := dynamics_of(env)) is not None:
        model = kind(env, gamma=_GAMMA)
        yield "dynamics", *dynamics_contradiction(model, env, generator, seconds=math.inf)


def counted_starts(env: gymnasium.Env, num_states: int, generator: np.random.Generator) -> Float[np.ndarray, "S"]:
    """How often each state came first in up to 1,000 seeded resets, as shares.

    Raises:
        ValueError: it began with what is no state.
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
    """Something was shown that is no state, or no start."""


_Step = tuple[int, int, float, float, int]
"""State, number of the action, reward, discount and next state."""


def _denied(model: ExactModel, steps: Iterator[_Step]) -> tuple[str, int]:
    """The first step that a model denies, in words, and how many steps there were."""
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
    """Random episodes, up to where the environment raises: that is no contradiction, and is told where it stops a
    training."""
    until, taken, named = time.monotonic() + seconds, 0, names_discounts(env)
    try:
        while taken < _STEPS and (time.monotonic() < until or taken == 0):
            shown, _ = env.reset(seed=_seed(generator))
            state = state_of(shown)
            began(state)
            for _ in range(_LONGEST_EPISODE):
                action = int(generator.integers(env.action_space.n))  # type: ignore[attr-defined]
                shown, reward, terminated, truncated, info = env.step(action)
                discount = 0.0 if terminated else discount_of(info, gamma, named=named)
                before, state = state, state_of(shown)
                yield before, action, number_of("reward", reward), discount, state
                taken += 1
                if terminated or truncated or time.monotonic() > until:
                    break
    except (_NoState, KeyboardInterrupt):
        raise
    except BaseException:
        return


def _is_state(shown: Any, num_states: int) -> bool:
    array = np.asarray(shown)
    return array.ndim == 0 and array.dtype.kind in "iu" and 0 <= int(array) < num_states


def _seed(generator: np.random.Generator) -> int:
    return int(generator.integers(2**31))
