"""Whether a simulator can be restored from snapshots: random walks, recorded bit for bit and made again."""

import itertools
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
import torch
from jaxtyping import Bool

from pgts_torch.errors import MissingModel
from pgts_torch.models.adapters import methods_for
from pgts_torch.models.attributes import changing, own_generator
from pgts_torch.models.masks import ActionMasks
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter, generator_state
from pgts_torch.models.stand_ins import name_of
from pgts_torch.models.steps import as_declared, bits, check_observation, check_rewards, number_of
from pgts_torch.models.trial import Taken, Trial, environment_code, random_walk
from pgts_torch.seeding import SharedGenerators, sample_keys, stream

ACTIONS_TRIED = 8
"""In each state, at the most."""

_SHORT_WALKS, _SHORT_LENGTH, _LONG_LENGTH, _STEPS_IN_ALL, _TIMED_STEPS = 4, 20, 300, 20, 3
"""Of `check_snapshots`: a few short walks, and one to the end of an episode, of which all the steps together are so
many times as many. A few steps are timed first."""

_WALKS_APART = 12
"""In as many instances, where instances differ: two may be alike by chance."""

_LEVELS, _WIDTH = 3, 8
"""The search that is made beside a real environment: its levels, and the states of each."""


@dataclass(frozen=True)
class Setup:
    """What all checks share. An error of the environment is `Failed`.

    make: makes an instance without wrappers.   actions: of the environment inside them.
    longest: the most steps before a walk is recorded, or before a state of another instance is restored.
    alike: whether new instances are alike; else each state is restored in an instance of its own.
    masks: how action masks say which actions are legal, of which alone are taken; None: all are.
    """

    make: Callable[[], Any]
    adapter: SnapshotAdapter
    actions: Sequence[Any]
    random: np.random.Generator
    longest: int = 50
    alike: bool = True
    masks: ActionMasks | None = None

    @cached_property
    def trial(self) -> Trial:
        return Trial(self.actions, self.masks)

    def reset(self, env: Any, *, seed: int | None = None) -> Taken:
        return self.trial.reset(env, seed=seed)

    def step(self, env: Any, action: Any) -> Taken:
        return self.trial.step(env, action)

    def model(self) -> SimulatorModel:
        return SimulatorModel(self.make, gamma=1.0, actions=self.actions, adapter=self.adapter, masks=self.masks)

    def number(self) -> int:
        return int(self.random.integers(2**31))

    def action(self) -> Any:
        return self.actions[int(self.random.integers(len(self.actions)))]

    def fresh(self) -> Any:
        """A new instance, without wrappers, at the start of some episode."""
        env = self.make()
        self.reset(env, seed=self.number())
        return env

    def snapshot(self, env: Any) -> Snapshot:
        with environment_code():
            return self.adapter.get_state(env)

    def stable_name(self, env: Any) -> Hashable:
        """The name of a snapshot; None if a second one of the same state has another name."""
        name = self.snapshot(env).name
        return name if self.snapshot(env).name == name else None

    def restore(self, env: Any, snapshot: Snapshot) -> None:
        self.trial.forget(env)
        with environment_code():
            self.adapter.set_state(env, snapshot.data)

    def seed(self, env: Any, key: int) -> None:
        with environment_code():
            self.adapter.seed(env, key)


@dataclass(frozen=True)
class Walk:
    """A recorded walk: its start, the key of its chance, its actions, what was seen, and the names of its states.

    legal_A: the legal actions at its start; None where these are not known.
    """

    start: Snapshot
    key: int
    actions: tuple[Any, ...]
    seen: tuple[bytes, ...]
    states: tuple[Hashable, ...]
    legal_A: Bool[np.ndarray, "A"] | None


def check_snapshots(setup: Setup, *, seconds: float = 0.4) -> float:
    """Check a few short walks and a long one (`chance`, `restored`, `untouched`), whose length is such that all takes
    about these seconds, and at least two steps. Return the seconds that a step takes with its snapshot.

    Raises:
        MissingModel: snapshots of the environment cannot be trusted; the message says why.
        PgtsError: the environment fails.
    """
    # Making an instance may take long: where all are alike three take turns, one for each part of a check.
    take_turns = itertools.cycle([setup.make() for _ in range(3)]).__next__ if setup.alike else setup.make
    turns = replace(setup, make=take_turns)
    beside_snapshots(turns)
    longest = int(np.clip(seconds / (_STEPS_IN_ALL * (each := _seconds_of_a_step(turns))), 2, _LONG_LENGTH))
    # With masks all actions are needed, for it may be that none of the first ones is legal.
    tried = len(setup.actions) if setup.masks else max(2, min(longest, ACTIONS_TRIED))
    turns = replace(turns, longest=longest, actions=setup.actions[:tried])
    many = _SHORT_WALKS if setup.alike else _WALKS_APART
    for count, length in ((many, min(longest, _SHORT_LENGTH)), (1, longest)):
        walks = walks_of(turns, count, length)
        chance(turns, walks)
        restored(walks, repeated(turns, walks))
    # Real environments have not been in other states.
    new = replace(turns, make=setup.make)
    untouched(new, min(longest, _SHORT_LENGTH), width=max(1, min(_WIDTH, longest // _WIDTH)))
    return each


def _seconds_of_a_step(setup: Setup) -> float:
    """Of a step with its snapshot: the smallest of a few times, which other processes have disturbed least."""
    env, times = setup.fresh(), []
    for _ in range(_TIMED_STEPS):
        begin = time.perf_counter()
        setup.snapshot(env)
        taken = setup.step(env, setup.action())
        times.append(time.perf_counter() - begin)
        if taken.ends:
            setup.reset(env)
    return min(times)


def walks_of(setup: Setup, count: int, length: int) -> list[Walk]:
    """Walks without a restored state in between, each from the state that some random steps have led to."""
    env, walks = setup.fresh(), list[Walk]()
    for _ in range(count):
        # Without seeds: some emulators load their program again for each seed.
        for _ in range(int(setup.random.integers(setup.longest))):
            if setup.step(env, setup.action()).ends:
                setup.reset(env)
        walks.append(_recorded(setup, env, setup.number(), tuple(setup.action() for _ in range(length))))
        setup.reset(env)
    return walks


def _recorded(setup: Setup, env: Any, key: int, actions: tuple[Any, ...]) -> Walk:
    """These actions from the present state, up to an end."""
    start, legal_A = setup.snapshot(env), setup.trial.legal(env)
    setup.seed(env, key)
    seen, states, made = list[bytes](), list[Hashable](), list[Any]()
    for action in actions:
        taken = setup.step(env, action)
        made.append(taken.action)
        seen.append(_bits_of(env, taken))
        states.append(setup.snapshot(env).name)
        if taken.ends:
            break
    return Walk(start, key, tuple(made), tuple(seen), tuple(states), legal_A)


def _again(setup: Setup, env: Any, walk: Walk) -> Walk:
    setup.restore(env, walk.start)
    return _recorded(setup, env, walk.key, walk.actions)


def repeated(setup: Setup, walks: Sequence[Walk]) -> list[Walk]:
    """Repeat each walk in an instance that was at the end of an episode, and then in another walk: anything that a
    snapshot lacks is then likely to differ."""
    env, found = _at_the_end(setup), list[Walk]()
    for walk in walks:
        found.append(_again(setup, env if setup.alike else _at_the_end(setup), walk))
    return found


def _at_the_end(setup: Setup) -> Any:
    """A new instance at the end of an episode, or late in one."""
    env = setup.fresh()
    for _ in range(setup.longest):
        if setup.step(env, setup.action()).ends:
            break
    return env


def _bits_of(env: gymnasium.Env, taken: Taken) -> bytes:
    """The bits of a step, or of a reset, as an agent sees it."""
    declared = as_declared(env.observation_space, taken.observation)
    reward = None if taken.action is None else number_of("reward", taken.reward)
    return bits((declared, reward, taken.terminated, taken.truncated))


def check_alone(setup: Setup) -> None:
    """PgtsError if the environment fails in random episodes without any snapshot."""
    env = setup.make()
    for taken in random_walk(env, setup.actions, setup.random, steps=_LONG_LENGTH, longest=_LONG_LENGTH):
        check_observation(env.observation_space, taken.observation)
        if taken.action is not None:
            check_rewards(number_of("reward", taken.reward))
        if setup.masks is not None and not taken.ends:
            setup.masks.of(env, taken.observation, taken.info)


def beside_snapshots(setup: Setup) -> None:
    """MissingModel if a subclass has attributes that change and are not in the snapshots of its family."""
    env, known = setup.make(), setup.adapter.restored
    if known is None or type(env).__module__.split(".")[0] in ("gymnasium", "ale_py"):
        return
    setup.reset(env, seed=setup.number())
    if names := changing(env, setup.actions, setup.random, but=known):
        raise MissingModel(
            f"{min(names)} changes in its steps or resets and is in no snapshot of {setup.adapter.name}: "
            f"{methods_for(env)}"
        )


def restored(walks: Sequence[Walk], others: Sequence[Walk]) -> str:
    """Whether walks that were repeated went on as at first."""
    for walk, other in zip(walks, others, strict=True):
        pairs = itertools.zip_longest(walk.seen, other.seen)
        if (off := next((k for k, (seen, now) in enumerate(pairs) if seen != now), None)) is not None:
            raise MissingModel(
                f"a restored state goes on differently at step {off + 1}: get_state misses something that step reads "
                "or changes, or step draws from elsewhere than self.np_random"
            )
    steps = sum(len(walk.seen) for walk in walks)
    return f"{len(walks)} continuations of {steps} steps in all are the same, bit for bit"


def chance(setup: Setup, walks: Sequence[Walk]) -> str:
    """Whether steps use generators other than the one that the key seeds; and how often another key matters."""
    env = setup.fresh()
    if name := own_generator(env, but=name_of if setup.adapter.shares_generators else None):
        raise MissingModel(f"attribute {name} is a generator of its own: draw from self.np_random only")
    differ = 0
    for walk in walks:
        setup.restore(env, walk.start)
        before = setup.stable_name(env)
        setup.seed(env, setup.number())
        if setup.stable_name(env) != before:
            raise MissingModel(
                "get_state returns the generator too, and a search would foresee what will be drawn: leave it out"
            )
        with SharedGenerators() as shared:
            differ += _again(setup, env, replace(walk, key=setup.number())).seen != walk.seen
        if shared.used:
            raise MissingModel(
                f"step draws from the global generator of {shared.used[0]}: draw from self.np_random only"
            )
    return f"of the key alone; {differ} of {len(walks)} continuations differ under another key"


def untouched(setup: Setup, length: int, *, width: int = _WIDTH) -> str:
    """Whether two equal real environments stay equal when a search starts from one of them."""
    real, twin = setup.make(), setup.make()
    seed, actions = setup.number(), [setup.action() for _ in range(2 * length)]
    begun = [[_bits_of(env, setup.reset(env, seed=seed))] for env in (real, twin)]
    for env, seen in zip((real, twin), begun, strict=True):
        seen += _live(setup, env, actions[:length])
    before = _state_of(setup, real)
    model, after = setup.model(), {before}
    frontier_N = torch.tensor([model.number(setup.snapshot(real), legal_A=setup.trial.legal(real))])
    for level in range(_LEVELS):
        legal_NA = torch.tensor(model.legal(frontier_N[:width]))
        if setup.masks:
            legal_NA &= legal_NA.cumsum(-1) <= ACTIONS_TRIED
        n_N, action_N = legal_NA.nonzero(as_tuple=True)
        state_N = frontier_N[n_N]
        key_N = sample_keys(len(state_N), generator=stream(seed, "untouched", level))
        sampled = model.sample(state_N, action_N, key_N=key_N)
        frontier_N = sampled.next_state_N[sampled.discount_N > 0].unique()
        after.add(_state_of(setup, real))
    if after != {before}:
        raise MissingModel(
            "a search changes the real environment: instances share something, or get_state changes its own"
        )
    if begun[0] != begun[1]:
        raise MissingModel(
            "after reset with the same seed two instances go on differently: reset must hand its seed to "
            "super().reset, and draw from self.np_random only"
        )
    if _live(setup, real, actions[length:]) != _live(setup, twin, actions[length:]):
        raise MissingModel(
            "a real environment goes on differently after a search: it shares something with the model's"
        )
    return f"a search of {model.simulator_steps} steps left a real environment as it was, bit for bit"


def check_resets(setup: Setup) -> None:
    """MissingModel unless what an instance remembers after a reset is a function of the seed alone: what it remembered
    of earlier episodes would neither be saved with a training nor be there in an evaluation."""
    seed, keys = setup.number(), []
    for env in (setup.make(), _at_the_end(setup)):
        setup.reset(env, seed=seed)
        keys.append(setup.snapshot(env))
    if not setup.adapter.same_state(*keys):
        raise MissingModel("it remembers something from one episode to the next: leave out the wrapper that does")


def _live(setup: Setup, env: gymnasium.Env, actions: Sequence[Any]) -> list[bytes]:
    """The bits that an agent sees as it takes these actions; where an episode ends a new one starts."""
    seen = []
    for action in actions:
        taken = setup.step(env, action)
        seen.append(_bits_of(env, taken))
        if taken.ends:
            seen.append(_bits_of(env, setup.reset(env)))
    return seen


def _state_of(setup: Setup, env: Any) -> tuple[Hashable, str]:
    """The name of its snapshot, and its generator."""
    with environment_code():
        generator = repr(generator_state(env))
    return setup.stable_name(env), generator
