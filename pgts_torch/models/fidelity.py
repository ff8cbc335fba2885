"""Whether a simulator can serve as a model: checks of everything that a search relies on, and the cost of a call."""

import functools
import itertools
import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from pgts_torch.errors import PgtsError, text_of
from pgts_torch.models.actions import all_actions, sampled_actions
from pgts_torch.models.adapters import adapter_for, methods_for
from pgts_torch.models.attributes import changing, own_to_each
from pgts_torch.models.environments import EnvSource, Given
from pgts_torch.models.snapshots import env_name, generator_state
from pgts_torch.models.trial import claims
from pgts_torch.models.walks import Setup, Walk, again, live, replays, walks_of
from pgts_torch.models.wrappers import transforms_of
from pgts_torch.seeding import SharedGenerators, numpy_stream, sample_keys, stream

_CONTINUOUS_ACTIONS = 8
"""How many actions of a continuous space are tried."""

_ACTIONS_TRIED, _TIMED_CALLS = 8, 200
_SHORT_WALKS, _SHORT_LENGTH, _LONG_LENGTH, _STEPS_IN_ALL, _TIMED_STEPS = 4, 20, 300, 20, 3
"""Of the short form: a few short walks, and one to the end of an episode, of which all the steps together are so many
times as many. A few steps are timed first."""

_WALKS_APART = 12
"""In as many instances, where instances differ: two may be alike by chance."""

_LEVELS, _WIDTH = 3, 8
"""The search that is made beside a real environment: its levels, and the states of each."""

_GENERATORS = (np.random.Generator, np.random.RandomState, np.random.BitGenerator, random.Random, torch.Generator)


@dataclass(frozen=True)
class Check:
    """One thing that a search relies on.

    needed: without it the values of a search are wrong; else it only costs more.
    detail: what was found; where the check failed, what is missing.
    """

    name: str
    needed: bool
    passed: bool
    detail: str


@dataclass(frozen=True)
class Cost:
    """Median microseconds of each part of a call, and the bytes of a snapshot's key."""

    restore: float
    step: float
    snapshot: float
    bytes: int

    @property
    def call(self) -> float:
        return self.restore + self.step + self.snapshot


@dataclass(frozen=True)
class Report:
    """The result of `check_model`.

    random_share: how many of the (state, action) tried are decided by chance, in [0, 1].
    cost: of a call; None where one fails.
    """

    env: str
    family: str
    num_actions: int
    random_share: float
    checks: tuple[Check, ...]
    cost: Cost | None

    @property
    def usable(self) -> bool:
        return all(check.passed or not check.needed for check in self.checks)

    @property
    def verdict(self) -> str:
        """One line: by which searches it can be used, or what is missing."""
        missing = "; ".join(check.detail for check in self.checks if not check.passed)
        if not self.usable:
            return f"{self.env} cannot serve as a model: {missing}"
        random = "random, so search it by `sampled`" if self.random_share else "its outcomes can be enumerated"
        return f"{self.env} can serve as a model: {random}{'; but ' * bool(missing)}{missing}"


@dataclass
class _Tried:
    """What the check of answers finds out for the report."""

    random_share: float = 0.0


class _Missing(Exception):
    """A check failed; the message is its detail."""


def check_model(env: Given, *, seed: int = 0, continuations: int = 20, length: int = 20) -> Report:
    """Check whether an environment can serve as a `SimulatorModel`.

        answers     rewards and observations are finite and fit the spaces that the environment declares
        restore     from a snapshot, the same actions and keys give the same observations (in the dtypes declared),
                    rewards and ends, bit for bit, in another instance that has been in other states since
        merge       equal states have equal snapshots, so that a search can merge them
        chance      what follows is a function of state, action and key, and no generator is in a snapshot: a search
                    cannot foresee what the environment is about to draw
        untouched   a search from the state of a real environment changes neither it nor its generator: it goes on like
                    an equal one without a search
        table       where there is one: steps and starts of a short walk are among its outcomes, bit for bit
        dynamics    where they are known in torch: they give the steps of a short walk up to rounding

    Args:
        env: an id, a spec, an environment with a spec, or a function that makes one; only fresh instances are used.
        seed: of the walks.
        continuations: how many are compared.
        length: their most steps.

    Returns:
        What was found. A check that fails says what is missing; an error of the environment fails its check.

    Raises:
        MissingModel: no adapter knows the environment, the message says what to implement; or a wrapper may change more
            than single answers.
        PgtsError: it cannot be made, or raises in random walks.
    """
    if min(continuations, length) < 1:
        raise PgtsError(f"continuations is {continuations} and length is {length}; both must be at least 1")
    make = EnvSource.of(env).make_one
    first = make()
    space, continuous = first.action_space, isinstance(first.action_space, spaces.Box)
    outer = sampled_actions(space, _CONTINUOUS_ACTIONS, seed=seed) if continuous else all_actions(space)
    actions = [*map(transforms_of(first).action, outer)]
    random = numpy_stream(seed, "check_model")
    alike = not own_to_each(make)
    setup = Setup(env_name(first), lambda: make().unwrapped, adapter_for(first), actions, random, alike=alike)
    try:
        walks = walks_of(setup, continuations, length)
    except BaseException as error:
        raise PgtsError(f"{setup.name} fails in random walks with seed {seed}: {_in_words(error)}") from error
    tried = _Tried()
    repeated = functools.cache(lambda: replays(setup, walks))
    checks = (
        _check("answers", lambda: _answers(setup, walks, tried)),
        _check("restore", lambda: _nothing_beside(setup) or _restore(walks, repeated())),
        _check("merge", lambda: _merge(walks, repeated()), needed=False),
        _check("chance", lambda: _chance(setup, walks)),
        _check("untouched", lambda: _untouched(setup, length)),
        *held(make(), seed=seed),
    )
    report = Report(setup.name, setup.adapter.name, len(actions), tried.random_share, checks, cost=None)
    try:
        return replace(report, cost=_cost(setup, walks))
    except BaseException as error:
        if report.usable:
            raise PgtsError(f"{setup.name} fails where its calls are timed: {_in_words(error)}") from error
        return report


def held(env: gymnasium.Env, *, seed: int) -> Iterator[Check]:
    """Whether steps of an environment contradict its table or dynamics.

    Args:
        env: an instance for this alone.
        seed: of the walk.
    """
    for kind, why, steps in claims(env, numpy_stream(seed, "claims")):
        agreement = f"{steps} steps agree, " + ("bit for bit" if kind == "table" else "within 1e-12")
        yield Check(kind, True, not why, why or agreement)


def why_not(setup: Setup, *, seconds: float = 0.4) -> str:
    """Why snapshots of an environment cannot be trusted, in the words of `check_model`; empty where nothing was found.

    The checks `chance`, `restore` and `untouched` with a few short walks and a long one; their length is such that all
    takes about these seconds, and at least two steps. An error of the environment is no reason: it is reported when it
    stops a training.
    """
    try:
        _nothing_beside(setup)
        longest = int(np.clip(seconds / (_STEPS_IN_ALL * _seconds_of_a_step(setup)), 2, _LONG_LENGTH))
        few = setup.actions[: max(2, min(longest, _ACTIONS_TRIED))]
        short = replace(setup, longest=longest, actions=few)
        # Making an instance may take long: where all are alike three take turns, one for each part of a check.
        three = itertools.cycle([setup.make() for _ in range(3)]) if setup.alike else None
        many, turns = (_WALKS_APART, short) if three is None else (_SHORT_WALKS, replace(short, make=three.__next__))
        for count, length in ((many, min(longest, _SHORT_LENGTH)), (1, longest)):
            walks = walks_of(turns, count, length)
            _chance(turns, walks)
            _restore(walks, replays(turns, walks))
        _untouched(short, min(longest, _SHORT_LENGTH), width=max(1, min(_WIDTH, longest // _WIDTH)))
    except _Missing as missing:
        return str(missing)
    except KeyboardInterrupt:
        raise
    except BaseException:
        return ""
    return ""


def _seconds_of_a_step(setup: Setup) -> float:
    """Of a step with its snapshot: the smallest of a few times, which other processes have disturbed least."""
    env, times = setup.fresh(), []
    for _ in range(_TIMED_STEPS):
        begin = time.perf_counter()
        state = setup.adapter.get_state(env)
        env.step(setup.action())
        times.append(time.perf_counter() - begin)
        setup.adapter.set_state(env, state.data)
    return min(times)


def _check(name: str, check: Callable[[], str], *, needed: bool = True) -> Check:
    """The result of one check; an error of the environment fails it."""
    try:
        return Check(name, needed, True, check())
    except BaseException as error:
        return Check(name, needed, False, str(error) if isinstance(error, _Missing) else _in_words(error))


def _in_words(error: BaseException) -> str:
    """The text of an error; Ctrl-C of the user is raised again."""
    if isinstance(error, KeyboardInterrupt):
        raise error
    return text_of(error)


def _answers(setup: Setup, walks: Sequence[Walk], tried: _Tried) -> str:
    """Query a model for some actions in each state."""
    model = setup.model()
    state_N = torch.tensor([model.number(walk.start) for walk in walks]).repeat_interleave(_ACTIONS_TRIED)
    action_N = torch.from_numpy(setup.random.integers(len(setup.actions), size=len(state_N)))
    random_N = model.is_random(state_N, action_N)
    tried.random_share = float(random_N.double().mean())
    return f"{len(random_N)} (state, action) queried, {tried.random_share:.0%} of them decided by chance"


def _nothing_beside(setup: Setup) -> str:
    """Whether a subclass has attributes that change and are not in the snapshots of its family."""
    env, known = setup.fresh(), setup.adapter.restored
    if known is None or type(env).__module__.split(".")[0] in ("gymnasium", "ale_py"):
        return ""
    if names := changing(env, setup.actions, setup.random, but=known):
        raise _Missing(
            f"{min(names)} changes in its steps or resets and is in no snapshot of {setup.adapter.name}: "
            f"{methods_for(env)}"
        )
    return ""


def _restore(walks: Sequence[Walk], repeated: Sequence[Walk]) -> str:
    for walk, other in zip(walks, repeated, strict=True):
        if walk.seen != other.seen:
            pairs = zip(walk.seen, other.seen, strict=False)
            step = next((k for k, (seen, now) in enumerate(pairs) if seen != now), min(len(walk.seen), len(other.seen)))
            raise _Missing(
                f"a restored state goes on differently at step {step + 1}: get_state misses something that step reads "
                "or changes, or step draws from elsewhere than self.np_random"
            )
    steps = sum(len(walk.seen) for walk in walks)
    return f"{len(walks)} continuations of {steps} steps in all are the same, bit for bit"


def _merge(walks: Sequence[Walk], repeated: Sequence[Walk]) -> str:
    """Whether walks that went on the same have the same snapshots."""
    pairs = [(walk, other) for walk, other in zip(walks, repeated, strict=True) if walk.seen == other.seen]
    off = sum((walk.start.key, *walk.states) != (other.start.key, *other.states) for walk, other in pairs)
    if off:
        raise _Missing(
            f"equal states gave different bytes in {off} of {len(pairs)} continuations, so a search merges fewer of "
            "them: let get_state return bytes that are made in one way"
        )
    return "equal states gave equal bytes"


def _chance(setup: Setup, walks: Sequence[Walk]) -> str:
    """Whether steps use generators other than the one that the key seeds; and how often another key matters."""
    env = setup.fresh()
    if name := _own_generator(env):
        raise _Missing(f"attribute {name} is a generator of its own: draw from self.np_random only")
    differ = 0
    for walk in walks:
        setup.adapter.set_state(env, walk.start.data)
        restored = _stable_key(setup, env)
        setup.adapter.seed(env, setup.number())
        if _stable_key(setup, env) != restored:
            raise _Missing(
                "get_state returns the generator too, and a search would foresee what will be drawn: leave it out"
            )
        with SharedGenerators() as shared:
            differ += again(setup, env, replace(walk, key=setup.number())).seen != walk.seen
        if shared.used:
            raise _Missing(f"step draws from the global generator of {shared.used[0]}: draw from self.np_random only")
    return f"of the key alone; {differ} of {len(walks)} continuations differ under another key"


def _own_generator(env: Any) -> str:
    """Where in an environment there is another generator than `np_random`; empty where there is none."""
    seen, known = [("", env)], {id(env), id(env.np_random)}
    for where, holder in seen:
        for name, value in _held(holder):
            if id(value) in known:
                continue
            if isinstance(value, _GENERATORS):
                return f"{where}{name}"
            known.add(id(value))
            seen.append((f"{where}{name}.", value))
    return ""


def _held(value: Any) -> list[tuple[Any, Any]]:
    """The names and values of which an object consists; not of spaces, whose generators no step uses."""
    if isinstance(value, dict):
        return list(value.items())
    if isinstance(value, list | tuple):
        return list(enumerate(value))
    return [] if isinstance(value, spaces.Space | type | ModuleType) else list(getattr(value, "__dict__", {}).items())


def _stable_key(setup: Setup, env: Any) -> bytes | None:
    """The key of a snapshot; None if a second one of the same state has another key."""
    key = setup.adapter.get_state(env).key
    return key if setup.adapter.get_state(env).key == key else None


def _untouched(setup: Setup, length: int, *, width: int = _WIDTH) -> str:
    """Whether two equal real environments stay equal when a search starts from one of them."""
    real, twin = setup.make(), setup.make()
    seed, actions = setup.number(), [setup.action() for _ in range(2 * length)]
    for env in (real, twin):
        env.reset(seed=seed)
    begun = live(real, actions[:length]), live(twin, actions[:length])
    before = _stable_key(setup, real), repr(generator_state(real))
    model = setup.model()
    frontier_N, after = model.roots([real]), {before}
    for level in range(_LEVELS):
        state_N = frontier_N[:width].repeat_interleave(len(setup.actions))
        action_N = torch.arange(len(setup.actions)).repeat(len(frontier_N[:width]))
        key_N = sample_keys(len(state_N), generator=stream(seed, "untouched", level))
        sampled = model.sample(state_N, action_N, key_N=key_N)
        frontier_N = sampled.next_state_N[sampled.discount_N > 0].unique()
        after.add((_stable_key(setup, real), repr(generator_state(real))))
    if after != {before}:
        raise _Missing("a search changes the real environment: instances share something, or get_state changes its own")
    if begun[0] != begun[1]:
        raise _Missing(
            "after reset with the same seed two instances go on differently: reset must hand its seed to "
            "super().reset, and draw from self.np_random only"
        )
    if live(real, actions[length:]) != live(twin, actions[length:]):
        raise _Missing("a real environment goes on differently after a search: it shares something with the model's")
    return f"a search of {model.simulator_steps} steps left a real environment as it was, bit for bit"


def _cost(setup: Setup, walks: Sequence[Walk]) -> Cost:
    """The times of the parts of a call, on one thread."""
    env = setup.fresh()
    times = []
    for n in range(_TIMED_CALLS):
        walk, action = walks[n % len(walks)], setup.action()
        begin = time.perf_counter()
        setup.adapter.set_state(env, walk.start.data)
        setup.adapter.seed(env, n)
        restored = time.perf_counter()
        env.step(action)
        stepped = time.perf_counter()
        setup.adapter.get_state(env)
        times.append((restored - begin, stepped - restored, time.perf_counter() - stepped))
    restore, step, snapshot = (1e6 * np.median(times, axis=0)).tolist()
    return Cost(restore, step, snapshot, int(np.median([len(walk.start.key) for walk in walks])))
