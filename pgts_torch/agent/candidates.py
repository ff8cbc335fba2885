"""The models that an environment may have: its table, its dynamics in torch, or itself as a simulator."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.wrappers import NormalizeObservation, NormalizeReward

from pgts_torch.agent.observations import Observations
from pgts_torch.agent.worlds import DynamicsWorld, SimulatedWorld, TabularWorld
from pgts_torch.errors import Failed, MissingModel, ModelMismatch, PgtsError, failure, warn
from pgts_torch.models.actions import all_actions
from pgts_torch.models.adapters import known_adapter, not_restored
from pgts_torch.models.adapters_generic import Layered, PickledAttributes, inside, known_or_none
from pgts_torch.models.attributes import attributes, own_to_each
from pgts_torch.models.classic import CLASSIC
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.ids import Maker
from pgts_torch.models.masks import KEY, ActionMasks, has_method, masks_of
from pgts_torch.models.published import publishes_table, table_of
from pgts_torch.models.restoring import Setup, check_alone, check_resets, check_snapshots
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.snapshots import SnapshotAdapter, each_of, env_name
from pgts_torch.models.squash import squash_of
from pgts_torch.models.trial import compare, environment_code
from pgts_torch.models.vector_simulator import VectorSimulator
from pgts_torch.models.wrappers import transforms_of, wrappers_of
from pgts_torch.options.environment import Observed
from pgts_torch.seeding import SharedGenerators, numpy_stream
from pgts_torch.tabular.mdp import TabularMDP

_TRIED_VECTORS = 64


@dataclass(frozen=True)
class Request:
    """The environments that a model is looked for, and its options.

    fresh: makes a new environment like number k (0). Trials use these, so that the training environments are not
        changed; they do not outlive the search for a model.
    """

    source: EnvSource
    fresh: Maker
    env: VectorEnv
    gamma: float
    options: Observed
    action_repeat: int
    device: torch.device

    @cached_property
    def name(self) -> str:
        return env_name(self.env)

    @cached_property
    def random(self) -> np.random.Generator:
        """The generator of all trials, with a seed of its own."""
        return numpy_stream(0, "make_world")

    @property
    def envs(self) -> SyncVectorEnv:
        """The environments, as a vector of single ones."""
        assert isinstance(self.env, SyncVectorEnv)
        return self.env

    @cached_property
    def new(self) -> gymnasium.Env:
        """A new environment whose attributes are read; it is never stepped."""
        return self.fresh()

    @cached_property
    def masks(self) -> ActionMasks | Literal["off"] | None:
        """How the action masks of the environments are read, where they are not those of a table."""
        mode = self.options.action_masks
        if mode == "off":
            return "off"
        # what an environment raises in reset is reported, with its seed, in training
        with (
            SharedGenerators(0, "masks"),
            suppress(Failed),
            environment_code(),
        ):
            masks = masks_of(self.env, self.fresh if self.source.makers else None)
            if masks is None and mode == "on":
                raise PgtsError(
                    f"action_masks is 'on'; {self.name} has no method action_masks(), no info['action_mask'] and no "
                    "observation['action_mask'] from 0 to 1 for each action"
                )
            return masks
        return None

    @cached_property
    def observed(self) -> Observed:
        """What is seen of observations: nothing of masks in them, unless that is all."""
        space, masks, keys = self.env.single_observation_space, self.masks, self.options.observation_keys
        if not isinstance(masks, ActionMasks) or masks.source != "observation" or not isinstance(space, spaces.Dict):
            return self.options
        others = [key for key in (space if keys is None else keys) if key != KEY]
        return self.options.model_copy(update={"observation_keys": others}) if others else self.options

    @cached_property
    def own_to_each(self) -> frozenset[str]:
        """The attributes in which new environments differ from each other; empty if the given ones equal a new one."""
        expected = attributes(self.new)
        all_equal = all(attributes(env) == expected for env in self.envs.envs)
        return frozenset() if all_equal else frozenset(own_to_each(self.fresh))


def table_world(request: Request) -> TabularWorld | None:
    """The world of a published table; None where there is none, or observations are not its states."""
    discrete = isinstance(request.env.single_observation_space, spaces.Discrete)
    if request.options.observation_keys is not None or not discrete or not publishes_table(request.envs.envs[0]):
        return None
    if request.options.action_masks == "on" or (request.options.action_masks == "auto" and has_method(request.env)):
        raise MissingModel(f"the table of {request.name} is not used: it says nothing of its action masks")
    if own := request.own_to_each & {"P", "mdp", "initial_state_distrib"}:
        raise MissingModel(
            f"each instance of {request.name} has its own {min(own)}, and one table must fit all: make them alike"
        )
    mdp, starts_known = table_of(request.fresh(), gamma=request.gamma, generator=request.random)
    check_single(request.action_repeat, "in a table")
    if not starts_known:
        warn(
            f"{request.name} has a table P and no initial_state_distrib: its start distribution is estimated from up "
            "to 1,000 resets"
        )
    masks = "off" if mdp.outcomes.legal_NA.all() else request.masks
    return TabularWorld(request.env, mdp, starts_known=starts_known, masks=masks, device=request.device)


def own_masks(mdp: TabularMDP) -> ActionMasks | None:
    """How our environments of a table say which actions it allows; None: all are."""
    return None if mdp.outcomes.legal_NA.all() else ActionMasks.plain(mdp.num_actions, source="info")


def dynamics_world(request: Request) -> DynamicsWorld | None:
    """The world of classic control's dynamics in torch; None for other environments."""
    env = request.envs.envs[0]
    kind = next((kind for kind in CLASSIC if type(env.unwrapped) is kind.env_class), None)
    if kind is None:
        return None
    is_masked = isinstance(request.masks, ActionMasks)
    unused = f"the dynamics in torch of {kind.env_class.__name__} are not used"
    if why := kind.obstacle(env) or _own(request, kind.constants) or ("they have no action masks" * is_masked):
        raise MissingModel(f"{unused}: {why}")
    env = request.fresh()
    tried = kind(env, gamma=request.gamma)
    try:
        actions = tried_actions(request)
        compare(tried, env, request.random, lambda _: int(tried.roots([env])), gamma=request.gamma, actions=actions)
    except ModelMismatch as off:
        raise MissingModel(f"{unused}: {off}") from off
    model = kind(env, gamma=request.gamma, action_repeat=request.action_repeat, device=request.device)
    return DynamicsWorld(request.envs, model, observed=request.observed)


def simulator_world(request: Request, *, reasons: Sequence[str], layered: bool) -> SimulatedWorld:
    """The world of a simulator that is restored from snapshots; MissingModel where it cannot be.

    Args:
        reasons: why there is no other model.
        layered: whether its wrappers are part of it, because some do more than transform single answers.
    """
    env = request.envs.envs[0]
    known = known_or_none(env, request.fresh)
    adapter: SnapshotAdapter = known or PickledAttributes()
    # What wrappers hold is in the snapshot where they are part of the simulator.
    kept = {type(wrapper).__name__ for wrapper in wrappers_of(env)} if layered else set()
    outside = {name for name in request.own_to_each if name.partition(".")[0] not in kept}
    if adapter.restored is not None and (why := _own(request, outside)):
        raise MissingModel(f"{request.name} cannot be restored: {why}, which is in no snapshot")
    if layered:
        check_memories(request.env)
        adapter = Layered(adapter)
    numbers, alike = itertools.count(), not request.own_to_each
    make: Callable[[], gymnasium.Env] = lambda: inside(request.fresh(next(numbers)), adapter)  # noqa: E731
    squash, tried = squash_of(env), tried_actions(request)
    own = None if layered else transforms_of(env).action
    actions = [*tried] if own is None else [own(action) for action in tried]
    masks = inner = request.masks if isinstance(request.masks, ActionMasks) else None
    if inner is not None:
        inner = ActionMasks.of_env(make(), actions, source=inner.source)
    setup = Setup(make, adapter, actions, request.random, alike=alike, masks=inner)
    try:
        seconds = check_snapshots(setup)
        if layered:
            check_resets(setup)
        if known is None or layered:
            reason = "no get_state" if known_adapter(env) is None else "a generator of its own"
            what = "has wrappers that are part of the model: their" if layered else f"has {reason}: its"
            size, other = len(setup.snapshot(setup.fresh()).key), f" ({'; '.join(reasons)})" if reasons else ""
            warn(
                f"{request.name} {what} attributes are pickled, {size} bytes and {1e6 * seconds:.0f} us a call; "
                f"get_state and set_state of its own could take less{other}"
            )
    except PgtsError as error:
        if known is None:
            if not isinstance(error, MissingModel):
                _check_alone(request.name, setup)
            raise MissingModel(f"{not_restored(env)}; its attributes, pickled, are not enough: {error}") from error
        if isinstance(error, MissingModel):
            raise MissingModel(f"{request.name} cannot serve as a model: {error}") from error
        # an error of the environment is reported when it stops a training
    seen = Observations(request.env, request.observed, request.device)
    options: dict[str, Any] = {
        "gamma": request.gamma,
        "action_repeat": request.action_repeat,
        "adapter": adapter,
        "observe": None if seen.as_given else seen.rows,
        "device": request.device,
    }
    model: SimulatorModel | VectorSimulator
    if squash is None:
        model = SimulatorModel(request.source.like, masks=masks, **options)
    else:
        model = VectorSimulator(request.source.like, size=squash.size, **options)
    return SimulatedWorld(request.envs, model, observed=request.observed, masks=request.masks, device=request.device)


def _check_alone(name: str, setup: Setup) -> None:
    """Failed if it is not restored states that fail, but the environment."""
    try:
        check_alone(setup)
    except PgtsError as error:
        raise failure(f"{name} fails in random walks", error) from error


def tried_actions(request: Request) -> Sequence[Any]:
    """The actions of trials, as the outermost wrapper takes them: all, or of vectors some random ones."""
    env = request.envs.envs[0]
    if (squash := squash_of(env)) is None:
        return [*all_actions(env.action_space)]
    return [*numpy_stream(0, "actions").normal(size=(_TRIED_VECTORS, squash.size)).astype(np.float32)]


def _own(request: Request, names: Iterable[str]) -> str:
    """A reason that names one of these attributes in which new environments differ; empty where there is none."""
    own = request.own_to_each.intersection(names)
    return f"each instance has its own {min(own)}" if own else ""


def check_memories(env: VectorEnv) -> None:
    """PgtsError if a wrapper remembers something from one episode to the next."""
    for wrapper in wrappers_of(each_of(env)[0]):
        if isinstance(wrapper, NormalizeObservation | NormalizeReward):
            raise PgtsError(
                f"{env_name(env)} is wrapped in {type(wrapper).__name__}, whose running statistics are neither saved "
                "nor used in evaluations: leave it out, and set normalize of the network or normalize_returns of the "
                "critic"
            )


def check_single(action_repeat: int, where: str) -> None:
    if action_repeat != 1:
        raise PgtsError(f"action_repeat is {action_repeat}; {where} it must be 1")
