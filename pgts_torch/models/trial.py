"""Short trials of an environment: random walks in which an error of its code is told from one of ours."""

import contextlib
import itertools
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, final

import gymnasium
import numpy as np
from jaxtyping import Bool

from pgts_torch.errors import Failed, ModelMismatch, PgtsError, text_of
from pgts_torch.models.exact_model import CONTRADICTED, ExactModel, Happened
from pgts_torch.models.masks import ActionMasks, masks_in
from pgts_torch.models.steps import check_info, discount_of, names_discounts, number_of

SECONDS = 0.3
"""After these a random walk ends in a slow environment."""

_LEAST_EPISODES = 3
"""Of a random walk, however slow the environment is; each has at least one step."""

_COMPARED_STEPS, _LONGEST_EPISODE = 400, 40


@contextlib.contextmanager
def environment_code() -> Iterator[None]:
    """Whatever the code of an environment raises in this context is `Failed`, so that it is told from an error of our
    own code; Ctrl-C is passed on."""
    try:
        yield
    except (PgtsError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise Failed(text_of(error)) from error


class Taken(NamedTuple):
    """What a step gave, or a reset: then there is no action and no reward."""

    action: Any
    observation: Any
    reward: Any = None
    terminated: bool = False
    truncated: bool = False
    info: Mapping[str, Any] = MappingProxyType({})

    @property
    def ends(self) -> bool:
        """Whether the episode is over."""
        return self.terminated or self.truncated


def reset(env: gymnasium.Env, *, seed: int | None = None) -> Taken:
    """Reset an environment; Failed if it raises, or returns something else than two values."""
    with environment_code():
        observation, info = env.reset(seed=seed)
        return Taken(None, observation, info=info if isinstance(info, Mapping) else MappingProxyType({}))


def step(env: gymnasium.Env, action: Any) -> Taken:
    """Take an action; Failed if the environment raises, or returns something else than five values."""
    with environment_code():
        observation, reward, terminated, truncated, info = env.step(action)
        check_info(info)
        return Taken(action, observation, reward, bool(terminated), bool(truncated), dict(info))


@final
class Trial:
    """Resets and steps of environments of one kind, in which an action is replaced by a legal one where it is known to
    be none.

    Args:
        masks: how action masks say which of them are legal; None: all are.
    """

    def __init__(self, actions: Sequence[Any], masks: ActionMasks | None) -> None:
        self._actions, self.masks = actions, masks
        # By the id of an environment, because it may have no hash.
        self._latest = dict[int, tuple[weakref.ref[gymnasium.Env], Taken]]()

    def reset(self, env: gymnasium.Env, *, seed: int | None = None) -> Taken:
        return self._noted(env, reset(env, seed=seed))

    def step(self, env: gymnasium.Env, action: Any) -> Taken:
        return self._noted(env, step(env, action if self.masks is None else self._legal(env, action)))

    def forget(self, env: gymnasium.Env) -> None:
        """Its state is another one now."""
        self._latest.pop(id(env), None)

    def _noted(self, env: gymnasium.Env, taken: Taken) -> Taken:
        self._latest[id(env)] = weakref.ref(env), taken
        return taken

    def legal(self, env: gymnasium.Env) -> Bool[np.ndarray, "A"] | None:
        """The legal actions in the present state; None where that is not known."""
        if self.masks is None:
            return None
        noted = self._latest.get(id(env))
        latest = noted[1] if noted is not None and noted[0]() is env else Taken(None, None)
        with environment_code(), contextlib.suppress(PgtsError):
            return self.masks.of(env, latest.observation, latest.info)
        return None

    def _legal(self, env: gymnasium.Env, action: Any) -> Any:
        legal_A = self.legal(env)
        if legal_A is None:
            return action
        place = next(k for k, one in enumerate(self._actions) if np.array_equal(one, action))
        (legal,) = legal_A.nonzero()
        return action if legal_A[place] else self._actions[int(legal[place % len(legal)])]


def random_walk(
    env: gymnasium.Env,
    actions: Sequence[Any],
    generator: np.random.Generator,
    *,
    steps: int,
    longest: int,
    seconds: float = SECONDS,
    any_action: bool = False,
) -> Iterator[Taken]:
    """Resets and steps of random episodes: three, and more until there are `steps` steps or the time is over.

    An episode is ended after `longest` steps, and after its next step once the time is over.

    Args:
        any_action: whether actions are taken that are not legal by the environment's action masks.
    """
    until, taken, trial = time.monotonic() + seconds, 0, Trial(actions, None)
    for episode in itertools.count():
        if episode >= _LEAST_EPISODES and (taken >= steps or time.monotonic() > until):
            return
        now = trial.reset(env, seed=int(generator.integers(2**31)))
        if episode == 0 and not any_action:
            with contextlib.suppress(PgtsError):
                trial.masks = masks_in(env, actions, now.info)
        yield now
        for _ in range(longest):
            now = trial.step(env, actions[int(generator.integers(len(actions)))])
            taken += 1
            yield now
            if now.ends or time.monotonic() > until:
                break


def compare(
    model: ExactModel,
    env: gymnasium.Env,
    generator: np.random.Generator,
    state_of: Callable[[Taken], int],
    *,
    gamma: float,
    actions: Sequence[Any] | None = None,
    seconds: float = SECONDS,
    any_action: bool = False,
) -> int:
    """Compare a random walk with a model that claims to be the environment (`ExactModel.outcome_of`).

    Args:
        model: for this alone: it may number the states of the walk.
        env: an instance for this alone, in the wrappers that the model is meant for, with actions from 0 on.
        state_of: the state of the model in which a step or a reset has left the environment; it may raise too.
        gamma: discount of a step that names none.
        any_action: as in `random_walk`.
        actions: those of the walk. Default: all numbered ones.

    Returns:
        How many steps were compared. An error of the environment ends the walk: it is no contradiction, and reported
        when it stops a training.

    Raises:
        ModelMismatch: the model rules a step out. The message has the first such step.
    """
    rows, state, named = list[tuple[Any, ...]](), 0, names_discounts(env)
    try:
        for taken in random_walk(
            env,
            [*np.arange(model.num_actions)] if actions is None else actions,
            generator,
            steps=_COMPARED_STEPS,
            longest=_LONGEST_EPISODE,
            seconds=seconds,
            any_action=any_action,
        ):
            before, state = state, state_of(taken)
            if taken.action is not None:
                discount = 0.0 if taken.terminated else discount_of(taken.info, gamma, named=named)
                rows.append((before, taken.action, number_of("reward", taken.reward), discount, state, False))
    except ModelMismatch:
        raise
    except PgtsError:
        pass
    if rows:
        happened = Happened(*map(np.array, zip(*rows, strict=True)))
        off = np.flatnonzero(model.outcome_of(happened) == CONTRADICTED)
        if off.size:
            raise ModelMismatch(model.contradiction(happened.part(off)))
    return len(rows)
