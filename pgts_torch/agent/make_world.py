"""Choose the model of an environment: the first of these that applies to it and that a short trial does not contradict.

    table       `models.published.table_of`     transitions that the environment publishes
    dynamics    `models.classic`                written in torch
    simulator   `models.simulator`              restored from snapshots

A model that does not apply is refused with a reason; where none is left the reasons are the message.
"""

import itertools
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv, VectorEnv
from gymnasium.wrappers import NormalizeObservation, NormalizeReward

from pgts_torch.agent.observations import Observations
from pgts_torch.agent.world import DynamicsWorld, ModelWorld, SimulatedWorld, TabularWorld, World
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import Failed, MissingModel, ModelMismatch, PgtsError
from pgts_torch.models.actions import all_actions
from pgts_torch.models.adapters import known_adapter, not_restored
from pgts_torch.models.adapters_generic import Layered, PickledAttributes, inside
from pgts_torch.models.attributes import attributes, own_to_each, unlike
from pgts_torch.models.classic import CLASSIC
from pgts_torch.models.environments import SLOW, EnvSource, kinds_of
from pgts_torch.models.masks import ActionMasks, has_method, masks_of
from pgts_torch.models.published import publishes_table, table_of
from pgts_torch.models.restoring import Setup, check_resets, check_snapshots
from pgts_torch.models.simulator import SimulatorModel
from pgts_torch.models.snapshots import SnapshotAdapter, each_of, env_name
from pgts_torch.models.squash import squash_of
from pgts_torch.models.trial import compare, environment_code
from pgts_torch.models.vector_simulator import VectorSimulator
from pgts_torch.models.wrapper_trial import check_transforms
from pgts_torch.models.wrappers import Transforms, transforms_of, wrappers_of
from pgts_torch.options.environment import Observed
from pgts_torch.seeding import SharedGenerators, numpy_stream
from pgts_torch.tabular.mdp import TabularMDP, check_gamma

_WAYS_OUT = (
    "; a model can be learned from its steps: model 'ensemble' where observations are vectors, 'latent' where they are "
    "images, 'counts' where they are numbers; or take depth 0 and the estimator 'sampled', which need no model"
)

_TRIED_VECTORS = 64

DEFAULT_GAMMA = 0.99
"""Discount where neither the caller nor the environment names one."""


def make_world(
    source: EnvSource,
    *,
    num_envs: int,
    gamma: float | None,
    observed: Observed,
    plain: bool,
    action_repeat: int = 1,
    device: torch.device | str,
    other: Callable[[VectorEnv, float, ActionMasks | Literal["off"] | None], ModelWorld] | None = None,
) -> World:
    """Make the world of an environment, with the first model of table, dynamics and simulator that applies to it.

    Args:
        source: makes `num_envs` environments, unless it was given a VectorEnv.
        gamma: discount; None: the environment's own (pgts/*), else 0.99.
        observed: what is seen of observations.
        plain: whether no model is needed: then only a table is looked for, and without one the world has no model.
        action_repeat: how often an action is taken in one outcome of the model (`TensorModel`).
        other: makes the world of environments, their discount and how their action masks are read (`World.masks`), with
            a model that is learned or the caller's own.

    Raises:
        PgtsError: the environment does not exist, or no agent can act in it; or actions are to be repeated in a table,
            or without a model.
        MissingModel: a model is needed and none applies; the message says why, for each.
    """
    one_by_one = not plain and other is None
    env = source.make(num_envs, one_by_one=one_by_one) if source.given is None else source.given
    discount = DEFAULT_GAMMA if gamma is None else gamma
    check_gamma(discount)
    request = _Request(source, env, discount, observed, action_repeat, torch.device(device))
    if other is not None:
        _check_memories(env)
        own = getattr(each_of(env)[0].unwrapped, "mdp", None)
        return other(
            env, float(own.outcomes.discount_NAK.max()) if isinstance(own, TabularMDP) else discount, request.masks
        )
    with SharedGenerators(0, "models"):
        world, reasons = _first_model(request, plain=plain)
    if world is not None:
        return world
    if not plain:
        raise MissingModel("; ".join(reversed(reasons)) + _WAYS_OUT)
    _check_memories(env)
    _check_single(action_repeat, "without a model")
    return World(env, gamma=discount, observed=observed, masks=request.masks, device=device)


@dataclass(frozen=True)
class _Request:
    """The environments that a model is looked for, and its options."""

    source: EnvSource
    env: VectorEnv
    gamma: float
    observed: Observed
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

    def fresh(self, k: int = 0) -> gymnasium.Env:
        """A new environment like number k. Trials use these, so that the training environments are not changed."""
        return self.source.like(k)

    @cached_property
    def new(self) -> gymnasium.Env:
        """A new environment whose attributes are read; it is never stepped."""
        return self.fresh()

    @cached_property
    def masks(self) -> ActionMasks | Literal["off"] | None:
        """How the action masks of the environments are read, where they are not those of a table."""
        mode = self.observed.action_masks
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
                    f"action_masks is 'on'; {self.name} has neither a method action_masks() nor info['action_mask']"
                )
            return masks
        return None

    @cached_property
    def own_to_each(self) -> frozenset[str]:
        """The attributes in which new environments differ from each other; empty if the given ones equal a new one."""
        expected = attributes(self.new)
        all_equal = all(attributes(env) == expected for env in self.envs.envs)
        return frozenset() if all_equal else frozenset(own_to_each(self.fresh))


def _first_model(request: _Request, *, plain: bool) -> tuple[ModelWorld | None, list[str]]:
    """Return the world of the first model that applies (None: no model does), and why those before it do not."""
    env, reasons = request.env, list[str]()
    if type(env) is TabularVectorEnv:
        _check_single(request.action_repeat, "in a table")
        if request.observed.action_masks == "on" and _own_masks(env.mdp) is None:
            raise PgtsError(f"action_masks is 'on'; the table of {request.name} allows all actions")
        return TabularWorld(
            env, env.mdp, observed=request.observed, masks=_own_masks(env.mdp), device=request.device
        ), []
    if type(env) is not SyncVectorEnv:
        return None, [f"{request.name} is a VectorEnv of unknown kind; a simulator needs a SyncVectorEnv ({SLOW})"]
    try:
        _check_alike(request)
    except MissingModel as missing:
        return None, [str(missing)]
    try:
        _check_wrappers(request)
    except MissingModel as missing:
        # Neither tables nor dynamics know of what a wrapper does; a simulator may contain it.
        reasons.append(str(missing))
    vectors = squash_of(env.envs[0]) is not None
    candidates: list[Callable[[_Request], ModelWorld | None]] = [] if reasons or vectors else [_table]
    if not plain:
        candidates += [*([] if reasons else [_dynamics]), partial(_simulator, reasons=reasons, layered=bool(reasons))]
    for candidate in candidates:
        try:
            if (world := candidate(request)) is not None:
                return world, reasons
        except MissingModel as missing:
            reasons.append(str(missing))
    return None, reasons


def _check_memories(env: VectorEnv) -> None:
    """PgtsError if a wrapper remembers something from one episode to the next."""
    for wrapper in wrappers_of(each_of(env)[0]):
        if isinstance(wrapper, NormalizeObservation | NormalizeReward):
            raise PgtsError(
                f"{env_name(env)} is wrapped in {type(wrapper).__name__}, whose running statistics are neither saved "
                "nor used in evaluations: leave it out, and set normalize of the network or normalize_returns of the "
                "critic"
            )


def _check_wrappers(request: _Request) -> None:
    """MissingModel unless the wrappers change nothing but single observations and rewards, without a memory."""
    if transforms_of(request.envs.envs[0]) != Transforms():
        with suppress(Failed):  # what an environment raises in a trial is reported, with step and seed, in training
            check_transforms(request.fresh(), _tried_actions(request), request.random)


def _check_alike(request: _Request) -> None:
    """MissingModel if an environment differs from a new one, of which a model would be made; its state may differ."""
    envs, new, found = request.envs.envs, request.new, None
    if any(kinds_of(env) != kinds_of(new) for env in envs):
        raise MissingModel(f"the environments of {request.name} are of different classes; a model needs all of one")
    with suppress(Failed):
        found = unlike(envs, itertools.repeat(new), request.fresh, request.random, apart=request.own_to_each)
    if found is not None:
        raise MissingModel(
            f"environment {found.number} of {request.name} has {found.what}; one model must fit all: make them alike"
        )


def _table(request: _Request) -> TabularWorld | None:
    """The world of a published table; None where there is none, or observations are not its states."""
    discrete = isinstance(request.env.single_observation_space, spaces.Discrete)
    if request.observed.observation_keys is not None or not discrete or not publishes_table(request.envs.envs[0]):
        return None
    if request.observed.action_masks == "on" or (request.observed.action_masks == "auto" and has_method(request.env)):
        raise MissingModel(f"the table of {request.name} is not used: it says nothing of its action masks")
    if own := request.own_to_each & {"P", "mdp", "initial_state_distrib"}:
        raise MissingModel(
            f"each instance of {request.name} has its own {min(own)}, and one table must fit all: make them alike"
        )
    mdp, starts_known = table_of(request.fresh(), gamma=request.gamma, generator=request.random)
    _check_single(request.action_repeat, "in a table")
    if not starts_known:
        warnings.warn(
            f"{request.name} has a table P and no initial_state_distrib: its start distribution is estimated from up "
            "to 1,000 resets",
            stacklevel=4,
        )
    masks = "off" if mdp.outcomes.legal_NA.all() else request.masks
    return TabularWorld(request.env, mdp, starts_known=starts_known, masks=masks, device=request.device)


def _own_masks(mdp: TabularMDP) -> ActionMasks | None:
    """How our environments of a table say which actions it allows; None: all are."""
    return None if mdp.outcomes.legal_NA.all() else ActionMasks.plain(mdp.num_actions, by_method=False)


def _dynamics(request: _Request) -> DynamicsWorld | None:
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
        actions = _tried_actions(request)
        compare(tried, env, request.random, lambda _: int(tried.roots([env])), gamma=request.gamma, actions=actions)
    except ModelMismatch as off:
        raise MissingModel(f"{unused}: {off}") from off
    model = kind(env, gamma=request.gamma, action_repeat=request.action_repeat, device=request.device)
    return DynamicsWorld(request.envs, model, observed=request.observed)


def _simulator(request: _Request, *, reasons: Sequence[str], layered: bool) -> SimulatedWorld:
    """The world of a simulator that is restored from snapshots; MissingModel where it cannot be.

    Args:
        reasons: why there is no other model.
        layered: whether its wrappers are part of it, because some do more than transform single answers.
    """
    env = request.envs.envs[0]
    known = known_adapter(env)
    adapter: SnapshotAdapter = known or PickledAttributes()
    # What wrappers hold is in the snapshot where they are part of the simulator.
    kept = {type(wrapper).__name__ for wrapper in wrappers_of(env)} if layered else set()
    outside = {name for name in request.own_to_each if name.partition(".")[0] not in kept}
    if adapter.restored is not None and (why := _own(request, outside)):
        raise MissingModel(f"{request.name} cannot be restored: {why}, which is in no snapshot")
    if layered:
        _check_memories(request.env)
        adapter = Layered(adapter)
    numbers, alike = itertools.count(), not request.own_to_each
    make: Callable[[], gymnasium.Env] = lambda: inside(request.fresh(next(numbers)), adapter)  # noqa: E731
    squash, tried = squash_of(env), _tried_actions(request)
    own = None if layered else transforms_of(env).action
    actions = [*tried] if own is None else [own(action) for action in tried]
    masks = inner = request.masks if isinstance(request.masks, ActionMasks) else None
    if inner is not None:
        inner = ActionMasks.of_env(make(), actions, by_method=inner.by_method)
    setup = Setup(make, adapter, actions, request.random, alike=alike, masks=inner)
    try:
        seconds = check_snapshots(setup)
        if layered:
            check_resets(setup)
        if known is None or layered:
            what = "has wrappers that are part of the model: their" if layered else "has no get_state: its"
            size, other = len(setup.snapshot(setup.fresh()).key), f" ({'; '.join(reasons)})" if reasons else ""
            warnings.warn(
                f"{request.name} {what} attributes are pickled, {size} bytes and {1e6 * seconds:.0f} us a call; "
                f"get_state and set_state of its own could take less{other}",
                stacklevel=5,
            )
    except PgtsError as error:
        if known is None:
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
        model = SimulatorModel(request.fresh, masks=masks, **options)
    else:
        model = VectorSimulator(request.fresh, size=squash.size, **options)
    return SimulatedWorld(request.envs, model, observed=request.observed, masks=request.masks, device=request.device)


def _tried_actions(request: _Request) -> Sequence[Any]:
    """The actions of trials, as the outermost wrapper takes them: all, or of vectors some random ones."""
    env = request.envs.envs[0]
    if (squash := squash_of(env)) is None:
        return [*all_actions(env.action_space)]
    return [*numpy_stream(0, "actions").normal(size=(_TRIED_VECTORS, squash.size)).astype(np.float32)]


def _own(request: _Request, names: Iterable[str]) -> str:
    """A reason that names one of these attributes in which new environments differ; empty where there is none."""
    own = request.own_to_each.intersection(names)
    return f"each instance has its own {min(own)}" if own else ""


def _check_single(action_repeat: int, where: str) -> None:
    if action_repeat != 1:
        raise PgtsError(f"action_repeat is {action_repeat}; {where} it must be 1")
