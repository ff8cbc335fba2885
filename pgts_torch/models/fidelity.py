"""Whether an environment can serve as a model: checks of all that a search relies on, and the cost of a call."""

import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from pgts_torch.errors import MissingModel, PgtsError, failure
from pgts_torch.models import restoring
from pgts_torch.models.actions import all_actions, sampled_actions
from pgts_torch.models.adapters import not_restored
from pgts_torch.models.adapters_generic import Layered, PickledAttributes, inside, known_or_none
from pgts_torch.models.attributes import own_to_each
from pgts_torch.models.classic import dynamics_of
from pgts_torch.models.clocks import check_clock
from pgts_torch.models.environments import EnvSource, Given, closing_made
from pgts_torch.models.masks import masks_in
from pgts_torch.models.published import compare_table, published_table
from pgts_torch.models.restoring import Setup, Walk
from pgts_torch.models.snapshots import SnapshotAdapter, env_name
from pgts_torch.models.stepper import Stepper
from pgts_torch.models.tabular import TabularModel
from pgts_torch.models.trial import compare, environment_code
from pgts_torch.models.wrappers import transforms_of
from pgts_torch.seeding import numpy_stream

_CONTINUOUS_ACTIONS = 8
"""How many actions of a continuous space are tried."""

_TIMED_CALLS = 200

_GAMMA = 0.5
"""Of a table P or dynamics that steps are compared with: only an end, of discount 0, has to differ from it."""


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

    family: of the snapshots; "table" where the environment needs none, because it publishes its transitions.
    num_states: of that table; None elsewhere.
    random_share: how many (state, action) of those tried, or of the table, are decided by chance, in [0, 1].
    cost: of a call; None where one fails, and of a table.
    """

    env: str
    family: str
    num_states: int | None
    num_actions: int
    random_share: float
    checks: tuple[Check, ...]
    cost: Cost | None

    @property
    def usable(self) -> bool:
        return all(check.passed or not check.needed for check in self.checks)

    @property
    def missing(self) -> str:
        """What the checks that failed have found."""
        return "; ".join(check.detail for check in self.checks if not check.passed)

    @property
    def verdict(self) -> str:
        """One line: by which searches it can be used, or what is missing."""
        missing = self.missing
        if not self.usable:
            return f"{self.env} cannot serve as a model: {missing}"
        if self.num_states is not None:
            return f"{self.env} can serve as a model: a table of {self.num_states} states, so no snapshot is needed"
        random = "random, so search it by `sampled`" if self.random_share else "its outcomes can be enumerated"
        return f"{self.env} can serve as a model: {random}{'; but ' * bool(missing)}{missing}"


def check_model(env: Given, *, seed: int = 0, continuations: int = 20, length: int = 20) -> Report:
    """Check whether an environment can serve as a `SimulatorModel`, or else as a table.

        answers     rewards and observations are finite and fit the spaces that the environment declares
        restore     from a snapshot, the same actions and keys give the same observations (in the dtypes declared),
                    rewards and ends, bit for bit, in another instance that has been in other states since
        merge       equal states have equal snapshots, so that a search can merge them
        chance      what follows is a function of state, action and key, and no generator is in a snapshot: a search
                    cannot foresee what the environment is about to draw
        clock       where an environment counts its own steps (MiniGrid): what follows depends on that only by rewards
                    and truncation as its own code makes them, so that a search can remember it without
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
        MissingModel: the environment publishes no table, no adapter knows it, and its attributes are not its whole
            state: the message says what to implement.
        PgtsError: it cannot be made, or raises in random walks.
    """
    if min(continuations, length) < 1:
        raise PgtsError(f"continuations is {continuations} and length is {length}; both must be at least 1")
    with closing_made(EnvSource.of(env).make_one) as make:
        return _report(make, seed=seed, continuations=continuations, length=length)


def _report(make: Callable[[], gymnasium.Env], *, seed: int, continuations: int, length: int) -> Report:
    first, claims = make(), tuple(_claims(make(), seed=seed))
    name, known, mdp = env_name(first), None, published_table(first, gamma=_GAMMA)
    try:
        known = known_or_none(first, make)
    except MissingModel:
        if mdp is None:
            raise
    if known is None and mdp is not None:
        share = float(((TabularModel(mdp).frequencies() > 0).sum(-1) > 1).double().mean())
        return Report(name, "table", mdp.num_states, mdp.num_actions, share, claims, cost=None)
    setup, shares = _setup(make, first, known or PickledAttributes(), seed=seed), [0.0]
    try:
        seen = setup.reset(new := setup.make(), seed=seed)
        setup = replace(setup, masks=masks_in(new, setup.actions, seen.info))
        walks = restoring.walks_of(setup, continuations, length)
    except PgtsError as error:
        raise failure(f"{name} fails in random walks with seed {seed}", error) from error
    checks = (*_simulator_checks(setup, walks, length, shares), *claims)
    report = Report(name, setup.adapter.name, None, len(setup.actions), shares[-1], checks, cost=None)
    if known is None and not report.usable:
        raise MissingModel(f"{not_restored(first)}; its attributes, pickled, are not enough: {report.missing}")
    try:
        return replace(report, cost=_cost(setup, walks))
    except PgtsError as error:
        if report.usable:
            raise failure(f"{name} fails where its calls are timed", error) from error
        return report


def _setup(make: Callable[[], gymnasium.Env], env: gymnasium.Env, adapter: SnapshotAdapter, *, seed: int) -> Setup:
    """How walks are made and restored. A wrapper that may have a memory is a part of what is restored."""
    space = env.action_space
    is_box = isinstance(space, spaces.Box)
    outer = sampled_actions(space, _CONTINUOUS_ACTIONS, seed=seed) if is_box else all_actions(space)
    try:
        actions = [*map(transforms_of(env).action, outer)]
    except MissingModel:
        adapter, actions = Layered(adapter), [*outer]
    random, alike = numpy_stream(seed, "check_model"), not own_to_each(make)
    return Setup(lambda: inside(make(), adapter), adapter, actions, random, alike=alike)


def _simulator_checks(setup: Setup, walks: Sequence[Walk], length: int, shares: list[float]) -> Iterator[Check]:
    """The checks of what is restored, in the order of `check_model`; `shares` gets that of random outcomes."""
    others = functools.cache(lambda: restoring.repeated(setup, walks))

    def restore() -> str:
        restoring.beside_snapshots(setup)
        if isinstance(setup.adapter, Layered):
            restoring.check_resets(setup)
        return restoring.restored(walks, others())

    yield _check("answers", lambda: _answers(setup, walks, shares))
    yield _check("restore", restore)
    yield _check("merge", lambda: _merged(walks, others()), needed=False)
    yield _check("chance", lambda: restoring.chance(setup, walks))
    yield _check("untouched", lambda: restoring.untouched(setup, length))
    yield from _clock(setup)


def _check(name: str, check: Callable[[], str], *, needed: bool = True) -> Check:
    """The result of one check; an error of the environment fails it."""
    try:
        return Check(name, needed, True, check())
    except PgtsError as error:
        return Check(name, needed, False, str(error))


def _clock(setup: Setup) -> Iterator[Check]:
    """Whether transitions can be remembered without the clock of an environment that has one."""
    stepper = Stepper(setup.make, gamma=_GAMMA, actions=setup.actions, adapter=setup.adapter, observe=None)
    if (clock := stepper.clock) is not None:
        yield _check("clock", lambda: check_clock(stepper, clock), needed=False)


def _claims(env: gymnasium.Env, *, seed: int) -> Iterator[Check]:
    """Whether steps of an environment, an instance for this alone, contradict its table or dynamics."""
    random, base = numpy_stream(seed, "claims"), env.unwrapped
    table, kind = published_table(base, gamma=_GAMMA), dynamics_of(env)
    if table is not None:
        steps = functools.partial(compare_table, table, base, _GAMMA, random, seconds=math.inf)
        yield _check("table", lambda: f"{steps()} steps agree, bit for bit")
    if kind is not None:
        model = kind(env, gamma=_GAMMA)
        steps = functools.partial(
            compare, model, env, random, lambda _: int(model.roots([env])), gamma=_GAMMA, seconds=math.inf
        )
        yield _check("dynamics", lambda: f"{steps()} steps agree, within 1e-12")


def _answers(setup: Setup, walks: Sequence[Walk], shares: list[float]) -> str:
    """Query a model for some actions in each state; the share of those that chance decides is added to `shares`."""
    model = setup.model()
    numbers = [model.number(walk.start, legal_A=walk.legal_A) for walk in walks]
    state_N = torch.tensor(numbers).repeat_interleave(restoring.ACTIONS_TRIED)
    action_N = torch.from_numpy(setup.random.integers(len(setup.actions), size=len(state_N)))
    legal_NA = torch.tensor(model.legal(state_N))
    action_N = torch.where(legal_NA.gather(1, action_N[:, None]).squeeze(1), action_N, legal_NA.int().argmax(1))
    shares.append(float(model.is_random(state_N, action_N).double().mean()))
    return f"{len(state_N)} (state, action) queried, {shares[-1]:.0%} of them decided by chance"


def _merged(walks: Sequence[Walk], others: Sequence[Walk]) -> str:
    """Whether walks that went on the same have the same snapshots."""
    pairs = [(walk, other) for walk, other in zip(walks, others, strict=True) if walk.seen == other.seen]
    off = sum((walk.start.name, *walk.states) != (other.start.name, *other.states) for walk, other in pairs)
    if off:
        raise MissingModel(
            f"equal states gave different bytes in {off} of {len(pairs)} continuations, so a search merges fewer of "
            "them: let get_state return bytes that are made in one way"
        )
    return "equal states gave equal bytes"


def _cost(setup: Setup, walks: Sequence[Walk]) -> Cost:
    """The times of the parts of a call, on one thread."""
    env, times = setup.fresh(), []
    for n in range(_TIMED_CALLS):
        walk = walks[n % len(walks)]
        action = walk.actions[0] if setup.masks else setup.action()
        with environment_code():
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
