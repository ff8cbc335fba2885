"""Random walks in simulators, recorded bit for bit, and repeated from a restored state."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter
from pgts_torch.models.steps import as_declared, number_of


@dataclass(frozen=True)
class Setup:
    """What all checks share.

    make: makes an instance without wrappers.   actions: of the environment inside them.
    longest: the most steps before a walk is recorded, or before a state of another instance is restored.
    alike: whether new instances are alike; else each state is restored in an instance of its own.
    """

    name: str
    make: Callable[[], Any]
    adapter: SnapshotAdapter
    actions: Sequence[Any]
    random: np.random.Generator
    longest: int = 50
    alike: bool = True

    def model(self) -> SimulatorModel:
        return SimulatorModel(self.make, gamma=1.0, actions=self.actions, adapter=self.adapter)

    def fresh(self) -> Any:
        """A new instance, without wrappers, at the start of some episode."""
        env = self.make()
        env.reset(seed=self.number())
        return env

    def number(self) -> int:
        return int(self.random.integers(2**31))

    def action(self) -> Any:
        return self.actions[int(self.random.integers(len(self.actions)))]


@dataclass(frozen=True)
class Walk:
    """A recorded walk: its start, the key of its chance, its actions, what was seen and the keys of its states."""

    start: Snapshot
    key: int
    actions: tuple[Any, ...]
    seen: tuple[bytes, ...]
    states: tuple[bytes, ...]


def walks_of(setup: Setup, count: int, length: int) -> list[Walk]:
    """Walks without a restored state in between, from states at random steps of random episodes."""
    env = setup.fresh()
    walks = []
    for _ in range(count):
        _go_somewhere(setup, env)
        walks.append(walk_on(setup, env, setup.number(), tuple(setup.action() for _ in range(length))))
    return walks


def _go_somewhere(setup: Setup, env: Any) -> None:
    """Go to a random step of an episode without restoring a state: find its end, and repeat it up to that step."""
    seed, actions, over = setup.number(), list[Any](), False
    env.reset(seed=seed)
    while not over and len(actions) < setup.longest:
        actions.append(setup.action())
        _, _, terminated, truncated, _ = env.step(actions[-1])
        over = terminated or truncated
    env.reset(seed=seed)
    for action in actions[: int(setup.random.integers(len(actions)))]:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:  # the same seed and actions have led elsewhere
            env.reset(seed=seed)


def walk_on(setup: Setup, env: Any, key: int, actions: tuple[Any, ...]) -> Walk:
    """Record these actions from the present state, up to an end."""
    start = setup.adapter.get_state(env)
    setup.adapter.seed(env, key)
    seen, states = [], []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append(_seen(env, observation, reward, terminated, truncated))
        states.append(setup.adapter.get_state(env).key)
        if terminated or truncated:
            break
    return Walk(start, key, actions, tuple(seen), tuple(states))


def again(setup: Setup, env: Any, walk: Walk) -> Walk:
    setup.adapter.set_state(env, walk.start.data)
    return walk_on(setup, env, walk.key, walk.actions)


def _seen(env: gymnasium.Env, observation: Any, reward: Any, terminated: Any, truncated: Any) -> bytes:
    """The bits of a step as an agent sees it."""
    declared = as_declared(env.observation_space, observation)
    return bits((declared, number_of("reward", reward), bool(terminated), bool(truncated)))


def bits(value: Any) -> bytes:
    """Every bit of an observation, or of a step."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}".encode() + value.tobytes()
    if isinstance(value, dict):
        return b"".join(str(name).encode() + bits(value[name]) for name in sorted(value, key=str))
    if isinstance(value, tuple | list):
        return b"".join(b"(" + bits(part) for part in value)
    return repr(value.item() if isinstance(value, np.generic) else value).encode()


def replays(setup: Setup, walks: Sequence[Walk]) -> list[Walk]:
    """Repeat each walk in an instance that was at the end of an episode, and then in another walk: anything that a
    snapshot lacks is then likely to differ."""
    env, repeated = _at_the_end(setup), list[Walk]()
    for walk in walks:
        repeated.append(again(setup, env if setup.alike else _at_the_end(setup), walk))
    return repeated


def _at_the_end(setup: Setup) -> Any:
    """A new instance at the end of an episode, or late in one."""
    env = setup.fresh()
    for _ in range(setup.longest):
        _, _, terminated, truncated, _ = env.step(setup.action())
        if terminated or truncated:
            break
    return env


def live(env: gymnasium.Env, actions: Sequence[Any]) -> list[bytes]:
    """The bits that an agent sees as it takes these actions; where an episode ends a new one starts."""
    seen = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append(_seen(env, observation, reward, terminated, truncated))
        if terminated or truncated:
            seen.append(bits(as_declared(env.observation_space, env.reset()[0])))
    return seen
