"""Which world an environment gets: the first model that was written for it, and that a short trial does not contradict.

    table       `models.published.table_of`       transitions that the environment publishes
    dynamics    `models.classic`                known in torch
    simulator   `models.simulator`              restored from snapshots

A model that is not used is refused with a reason; where none is left the reasons are the message.
"""

import itertools
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.wrappers import NormalizeObservation, NormalizeReward

from pgts_torch.agent.world import DynamicsWorld, ModelWorld, SimulatedWorld, TabularWorld, World
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.actions import base_actions
from pgts_torch.models.adapters import adapter_for
from pgts_torch.models.attributes import attributes, different, own_to_each, unlike
from pgts_torch.models.classic import CLASSIC
from pgts_torch.models.environments import EnvSource, kinds_of
from pgts_torch.models.fidelity import why_not
from pgts_torch.models.published import publishes_table, table_of
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.trial import dynamics_contradiction
from pgts_torch.models.walks import Setup
from pgts_torch.models.wrappers import Transforms, check_transforms, transforms_of, wrappers_of
from pgts_torch.seeding import SharedGenerators, numpy_stream
from pgts_torch.tabular.mdp import check_gamma

_NO_MODEL_NEEDED = "; or take depth 0 and the estimator 'sampled', which need no model"

DEFAULT_GAMMA = 0.99
"""Discount of an environment that carries none."""


def make_world(
    source: EnvSource,
    *,
    num_envs: int,
    gamma: float | None,
    observation_key: str | None,
    plain: bool,
    action_repeat: int = 1,
    device: torch.device | str,
) -> World:
    """The world of an environment: what can be asked about it decides.

    A transition table makes it tabular; else its dynamics are asked if they are known in torch; else snapshots make it
    simulated. It has no model where none is needed and there is no table.

    Args:
        source: what `num_envs` environments are made from, unless it was given some.
        gamma: discount; None: the environment's own (pgts/*), else 0.99.
        observation_key: which part of dictionary observations a policy sees.
        plain: whether a world without a model will do: then snapshots are not taken.
        action_repeat: how often an action is taken in one outcome of the model (`TensorModel`).

    Raises:
        PgtsError: the environment does not exist, or is none that an agent can act in; or actions are to be repeated
            in a table, or where there is no model.
        MissingModel: it has no model, and needs one; the message says why each is not used.
    """
    env = source.make(num_envs) if source.given is None else source.given
    discount = DEFAULT_GAMMA if gamma is None else gamma
    check_gamma(discount)
    sought = _Sought(source, env, discount, observation_key, action_repeat, torch.device(device))
    with SharedGenerators(0, "models"):
        world, reasons = _first_model(sought, (_table,) if plain else (_table, _dynamics, _simulator))
    if world is not None:
        return world
    if not plain:
        raise MissingModel("; ".join(reversed(reasons)) + _NO_MODEL_NEEDED)
    if name := _normalizing_wrapper(env):
        raise PgtsError(
            f"{env_name(env)} is wrapped in {name}, whose running statistics no evaluation shares and no file "
            "keeps: leave it out, and set normalize of the network or normalize_returns of the critic"
        )
    _check_single(action_repeat, "without a model")
    return World(env, gamma=discount, observation_key=observation_key, device=device)


@dataclass(frozen=True)
class _Sought:
    """What a model is sought for."""

    source: EnvSource
    env: VectorEnv
    gamma: float
    observation_key: str | None
    action_repeat: int
    device: torch.device

    @cached_property
    def name(self) -> str:
        return env_name(self.env)

    @cached_property
    def random(self) -> np.random.Generator:
        """Of everything that is tried out: the same each time, and nobody else's."""
        return numpy_stream(0, "make_world")

    @property
    def envs(self) -> SyncVectorEnv:
        """The environments, each of which can be looked into."""
        assert isinstance(self.env, SyncVectorEnv)
        return self.env

    def fresh(self, k: int = 0) -> gymnasium.Env:
        """A new instance, as environment k is; no state of those that are trained in is touched."""
        return self.source.like(k)

    @cached_property
    def actions(self) -> list[int]:
        return list(range(int(self.env.single_action_space.n)))  # type: ignore[attr-defined]  # checked before

    @cached_property
    def new(self) -> gymnasium.Env:
        """One that is only looked at."""
        return self.fresh()

    @cached_property
    def others(self) -> list[set[str]]:
        """The attributes in which each environment differs from a new instance, in whatever state it is."""
        held = attributes(self.new)
        return [different(held, attributes(env)) for env in self.envs.envs]

    @cached_property
    def own_to_each(self) -> frozenset[str]:
        """The attributes in which new instances differ; more of them are made only where the environments do."""
        return frozenset(own_to_each(self.fresh)) if any(self.others) else frozenset()


def _first_model(
    sought: _Sought, candidates: tuple[Callable[[_Sought], ModelWorld | None], ...]
) -> tuple[ModelWorld | None, list[str]]:
    """The world of the first model that is not refused, and why those before it were."""
    env, reasons = sought.env, list[str]()
    if type(env) is TabularVectorEnv:
        _check_single(sought.action_repeat, "in a table")
        return TabularWorld(env, env.mdp, device=sought.device), []
    if type(env) is not SyncVectorEnv:
        return None, [f"{sought.name} is a VectorEnv that nothing looks into; a simulator needs a SyncVectorEnv"]
    try:
        _check_wrappers(sought)
        _check_alike(sought)
    except MissingModel as missing:
        return None, [str(missing)]
    for candidate in candidates:
        try:
            if (world := candidate(sought)) is not None:
                return world, reasons
        except MissingModel as missing:
            reasons.append(str(missing))
    return None, reasons


def _check_wrappers(sought: _Sought) -> None:
    """MissingModel unless the wrappers change nothing, or single answers, each by itself."""
    if transforms_of(sought.envs.envs[0]) == Transforms():
        return
    with _told_where_it_stops_a_training():
        check_transforms(sought.fresh(), sought.actions, sought.random)


def _check_alike(sought: _Sought) -> None:
    """MissingModel if an environment, in whatever state it is, is not what making another one gives: a model is made of
    that."""
    if any(kinds_of(env) != kinds_of(sought.new) for env in sought.envs.envs):
        raise MissingModel(f"the environments of {sought.name} are of different classes, and a model is of one of them")
    if not any(sought.others):
        return
    envs, found = sought.envs.envs, None
    with _told_where_it_stops_a_training():
        new = itertools.repeat(sought.new)
        found = unlike(envs, new, sought.fresh(), sought.random, apart=sought.own_to_each)
    if found is not None:
        raise MissingModel(
            f"environment {found.number} of {sought.name} has {found.what}, and a model is of all: make them alike"
        )


@contextmanager
def _told_where_it_stops_a_training() -> Iterator[None]:
    """What an environment raises while it is tried is no verdict on a model: a training is where it is told, with step
    and seed."""
    try:
        yield
    except (MissingModel, KeyboardInterrupt):
        raise
    except BaseException:
        return


def _table(sought: _Sought) -> TabularWorld | None:
    """The table that an environment publishes; None where it shows no numbers, or publishes nothing."""
    discrete = isinstance(sought.env.single_observation_space, spaces.Discrete)
    if sought.observation_key is not None or not discrete or not publishes_table(sought.envs.envs[0]):
        return None
    if own := sought.own_to_each & {"P", "mdp", "initial_state_distrib"}:
        raise MissingModel(
            f"each instance of {sought.name} has its own {min(own)}, so that no table holds for all: make them alike"
        )
    mdp, starts_known = table_of(sought.fresh(), gamma=sought.gamma, generator=sought.random)
    _check_single(sought.action_repeat, "in a table")
    if not starts_known:
        warnings.warn(
            f"{sought.name} has a table P and no initial_state_distrib: its start distribution is counted in up to "
            "1,000 resets",
            stacklevel=4,
        )
    return TabularWorld(sought.env, mdp, starts_known=starts_known, device=sought.device)


def _dynamics(sought: _Sought) -> DynamicsWorld | None:
    """The dynamics of classic control in torch; None elsewhere."""
    env = sought.envs.envs[0]
    kind = next((kind for kind in CLASSIC if type(env.unwrapped) is kind.env_class), None)
    if kind is None:
        return None
    if why := kind.obstacle(env) or _own(sought, kind.constants):
        raise MissingModel(f"the dynamics in torch of {kind.env_class.__name__} are not used: {why}")
    env = sought.fresh()
    if why := dynamics_contradiction(kind(env, gamma=sought.gamma), env, sought.random)[0]:
        raise MissingModel(f"the dynamics in torch of {kind.env_class.__name__} are not used: {why}")
    model = kind(env, gamma=sought.gamma, action_repeat=sought.action_repeat, device=sought.device)
    return DynamicsWorld(sought.envs, model, observation_key=sought.observation_key)


def _simulator(sought: _Sought) -> SimulatedWorld:
    """A simulator that is restored from snapshots."""
    key, env = sought.observation_key, sought.envs.envs[0]
    adapter = adapter_for(env)
    if adapter.restored is not None and (why := _own(sought, sought.own_to_each)):
        raise MissingModel(f"{sought.name} cannot be restored: {why}, which is in no snapshot")
    others = itertools.count()
    setup = Setup(
        sought.name,
        lambda: sought.fresh(next(others)).unwrapped,
        adapter,
        base_actions(env),
        sought.random,
        alike=not sought.own_to_each,
    )
    if why := why_not(setup):
        raise MissingModel(f"{sought.name} cannot serve as a model: {why}")
    model = SimulatorModel(
        sought.fresh,
        gamma=sought.gamma,
        action_repeat=sought.action_repeat,
        adapter=adapter,
        observe=None if key is None else lambda observation: observation[key],
        device=sought.device,
    )
    return SimulatedWorld(sought.envs, model, observation_key=key, device=sought.device)


def _normalizing_wrapper(env: VectorEnv) -> str:
    """The name of a wrapper that normalises by running statistics of its own; empty where there is none."""
    around = wrappers_of(env.envs[0]) if isinstance(env, SyncVectorEnv) else []
    kinds = NormalizeObservation, NormalizeReward
    return next((type(wrapper).__name__ for wrapper in around if isinstance(wrapper, kinds)), "")


def _own(sought: _Sought, names: Iterable[str]) -> str:
    """Which of these attributes each instance has its own of."""
    own = sought.own_to_each.intersection(names)
    return f"each instance has its own {min(own)}" if own else ""


def _check_single(action_repeat: int, where: str) -> None:
    if action_repeat != 1:
        raise PgtsError(f"action_repeat is {action_repeat}; {where} it must be 1")
