"""Choose the model of an environment: the first of these that applies to it and that a short trial does not contradict.

    table       `models.published.table_of`     transitions that the environment publishes
    dynamics    `models.classic`                written in torch
    simulator   `models.simulator`              restored from snapshots

A model that does not apply is refused with a reason; where none is left the reasons are the message.
"""

import itertools
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import torch
from gymnasium.vector import SyncVectorEnv

from pgts_torch.agent.candidates import (
    Request,
    check_memories,
    check_single,
    dynamics_world,
    own_masks,
    simulator_world,
    table_world,
    tried_actions,
)
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import Failed, MissingModel, PgtsError
from pgts_torch.models.attributes import unlike
from pgts_torch.models.environments import SLOW, EnvSource, close_environments, closing_made, kinds_of
from pgts_torch.models.masks import ActionMasks, entries_in
from pgts_torch.models.snapshots import each_of
from pgts_torch.models.squash import squash_of
from pgts_torch.models.wrapper_trial import check_transforms
from pgts_torch.models.wrappers import Transforms, transforms_of
from pgts_torch.options.environment import Observed
from pgts_torch.seeding import SharedGenerators
from pgts_torch.tabular.mdp import TabularMDP, check_gamma

_WAYS_OUT = (
    "; a model can be learned from its steps: model 'ensemble' where observations are vectors, 'latent' where they are "
    "images, 'counts' where they are numbers; or take depth 0 and the estimator 'sampled', which need no model"
)

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
    other: Callable[..., ModelWorld] | None = None,
) -> World:
    """Make the world of an environment, with the first model of table, dynamics and simulator that applies to it.

    Args:
        source: makes `num_envs` environments, unless it was given a VectorEnv.
        gamma: discount; None: the environment's own (pgts/*), else 0.99.
        plain: whether no model is needed: then only a table is looked for, and without one the world has no model.
        action_repeat: how often an action is taken in one outcome of the model (`TensorModel`).
        other: makes the world of environments, with the `gamma`, `observed`, `masks` and `device` of `World`, and a
            model that is learned or the caller's own.

    Raises:
        PgtsError: the environment does not exist, or no agent can act in it; or actions are to be repeated in a table,
            or without a model.
        MissingModel: a model is needed and none applies; the message says why, for each.
    """
    one_by_one = not plain and other is None
    env = source.make(num_envs, one_by_one=one_by_one) if source.given is None else source.given
    discount = DEFAULT_GAMMA if gamma is None else gamma
    check_gamma(discount)
    try:
        with closing_made(source.like) as fresh:
            request = Request(source, fresh, env, discount, observed, action_repeat, torch.device(device))
            if other is None:
                return _chosen(request, plain=plain)
            check_memories(env)
            own = getattr(each_of(env)[0].unwrapped, "mdp", None)
            if isinstance(own, TabularMDP):
                discount = float(own.outcomes.discount_NAK.max())
            return other(env, gamma=discount, observed=request.observed, masks=request.masks, device=request.device)
    except BaseException:
        if source.given is None:
            close_environments(env)
        raise


def _chosen(request: Request, *, plain: bool) -> World:
    """The world with the first model that applies, or without one where none is needed."""
    with SharedGenerators(0, "models"):
        world, reasons = _first_model(request, plain=plain)
    if world is not None:
        return world
    if not plain:
        raise MissingModel("; ".join(reversed(reasons)) + _WAYS_OUT)
    check_memories(request.env)
    check_single(request.action_repeat, "without a model")
    return World(
        request.env, gamma=request.gamma, observed=request.observed, masks=request.masks, device=request.device
    )


def _first_model(request: Request, *, plain: bool) -> tuple[ModelWorld | None, list[str]]:
    """Return the world of the first model that applies (None: no model does), and why those before it do not."""
    env, reasons = request.env, list[str]()
    if type(env) is TabularVectorEnv:
        check_single(request.action_repeat, "in a table")
        if request.options.action_masks == "on" and own_masks(env.mdp) is None:
            raise PgtsError(f"action_masks is 'on'; the table of {request.name} allows all actions")
        return TabularWorld(
            env, env.mdp, observed=request.observed, masks=own_masks(env.mdp), device=request.device
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
    candidates: list[Callable[[Request], ModelWorld | None]] = [] if reasons or vectors else [table_world]
    if not plain:
        candidates += [
            *([] if reasons else [dynamics_world]),
            partial(simulator_world, reasons=reasons, layered=bool(reasons)),
        ]
    for candidate in candidates:
        try:
            if (world := candidate(request)) is not None:
                return world, reasons
        except MissingModel as missing:
            reasons.append(str(missing))
    return None, reasons


def _check_wrappers(request: Request) -> None:
    """MissingModel unless the wrappers change nothing but single observations and rewards, without a memory, and masks
    are those of the environment inside."""
    masks, base = request.masks, request.envs.envs[0].unwrapped
    if isinstance(masks, ActionMasks) and masks.source == "observation" and not entries_in(base.observation_space):
        raise MissingModel(f"{request.name} gets {masks.what} from a wrapper")
    if transforms_of(request.envs.envs[0]) != Transforms():
        with suppress(Failed):  # what an environment raises in a trial is reported, with step and seed, in training
            check_transforms(request.fresh(), tried_actions(request), request.random)


def _check_alike(request: Request) -> None:
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
