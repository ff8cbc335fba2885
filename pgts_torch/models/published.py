"""Tables of transitions that environments publish, and whether these are what the environments do."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import MissingModel
from pgts_torch.models.actions import base_actions
from pgts_torch.models.provenance import origin, overridden
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.steps import number_of
from pgts_torch.models.tabular import tabular_truth
from pgts_torch.models.trial import counted_starts, table_contradiction
from pgts_torch.models.wrappers import Transforms, transforms_of
from pgts_torch.tabular.mdp import TabularMDP

_STARTS = "initial_state_distrib"
"""The attribute with the start distribution of a table P."""


def publishes_table(env: gymnasium.Env) -> bool:
    """Whether an environment has an `mdp` or an attribute P."""
    base: Any = env.unwrapped
    try:
        return isinstance(getattr(base, "mdp", None), TabularMDP) or getattr(base, "P", None) is not None
    except Exception:  # a property of another meaning
        return False


def table_of(env: gymnasium.Env, *, gamma: float, generator: np.random.Generator) -> tuple[TabularMDP, bool]:
    """The MDP that an environment in its wrappers publishes (`publishes_table`), if its steps do not contradict it; and
    whether its start distribution is known, or counted in 1,000 resets because the environment declares none.

    Transforms of actions and rewards by wrappers are part of the table: an outcome has the reward f(r), and r(s, a) is
    the mean of that.

    Args:
        env: an instance for this alone; it is stepped.
        gamma: discount of a P table; ours carry their own.
        generator: of the walk.

    Raises:
        MissingModel: P is no table, or it was not written for this `step` and `reset`, has other states or actions than
            the spaces, or is contradicted by a step of a short walk.
    """
    base: Any = env.unwrapped
    name, transforms = env_name(env), transforms_of(env)
    attribute = "mdp" if isinstance(getattr(base, "mdp", None), TabularMDP) else "P"
    starts_known = attribute == "mdp" or getattr(base, _STARTS, None) is not None
    why = overridden(base, origin(base, attribute), ("step",))
    if starts_known and not why:
        why = overridden(base, origin(base, attribute if attribute == "mdp" else _STARTS), ("reset",))
    if why:
        raise MissingModel(f"the table {attribute} of {name} is not used, for it was not written for what runs: {why}")
    if transforms.observations:
        raise MissingModel(
            f"the table {attribute} of {name} is not used, for its wrappers show something else than states"
        )
    mdp = tabular_truth(base, gamma=gamma) if attribute == "mdp" else _published(env, gamma, transforms, generator)
    if attribute == "mdp":
        mdp = _transformed(mdp, [_position(base, action) for action in base_actions(env)], transforms)
    sizes = mdp.num_states, mdp.num_actions
    spaces_have = tuple(int(getattr(space, "n", 0)) for space in (env.observation_space, env.action_space))
    if sizes != spaces_have:
        raise MissingModel(
            f"the table {attribute} of {name} is not used: it has {sizes[0]} states and {sizes[1]} actions, and its "
            f"spaces are {env.observation_space} and {env.action_space}"
        )
    if why := table_contradiction(mdp, env, gamma, generator)[0]:
        raise MissingModel(f"the table {attribute} of {name} is not used, for its steps contradict it: {why}")
    return mdp, starts_known


def _published(env: gymnasium.Env, gamma: float, transforms: Transforms, generator: np.random.Generator) -> TabularMDP:
    """The MDP of a table P with the transforms of wrappers; MissingModel if it is no such table."""
    base: Any = env.unwrapped
    if getattr(base, "fickle_passenger", False):
        raise MissingModel(f"the table P of {env_name(env)} is not used: it lacks what a fickle passenger draws")
    start = getattr(base, _STARTS, None)
    try:
        if start is None:
            start = counted_starts(env, len(base.P), generator)
        mdp = TabularMDP.from_gymnasium(env, gamma, start=start)
        if mdp.num_actions != base.action_space.n:
            raise MissingModel(
                f"the table P of {env_name(env)} is not used: it has {mdp.num_actions} actions, and its space is "
                f"{base.action_space}"
            )
        if not (transforms.actions or transforms.rewards):
            return mdp
        positions = [_position(base, action) for action in base_actions(env)]
        P: Any = {
            s: [
                [(p, child, number_of("reward", transforms.reward(r)), end) for p, child, r, end in base.P[s][a]]
                for a in positions
            ]
            for s in range(len(base.P))
        }
        return TabularMDP.from_transitions(P, gamma, start=start, shape=mdp.shape)
    except MissingModel:
        raise
    except Exception as error:
        raise MissingModel(f"the attribute P of {env_name(env)} is no transition table: {error}") from error


def _position(base: Any, action: Any) -> int:
    """The position in the table of an action of the environment inside its wrappers."""
    if not isinstance(base.action_space, gymnasium.spaces.Discrete):
        raise MissingModel(f"a table numbers actions from 0 on; those of {env_name(base)} are {base.action_space}")
    return int(action) - int(base.action_space.start)


def _transformed(mdp: TabularMDP, positions: Sequence[int], transforms: Transforms) -> TabularMDP:
    """The MDP with its actions in this order and transformed rewards, which are those of all outcomes of an action."""
    if not (transforms.actions or transforms.rewards):
        return mdp
    order, old = torch.tensor(positions), mdp.outcomes
    reward_SA = old.reward_NA[:, order]
    if transforms.rewards:
        reward_SA = reward_SA.clone().apply_(lambda reward: number_of("reward", transforms.reward(reward)))
    prob_SAK, discount_SAK, child_SAK = (x[:, order] for x in (old.prob_NAK, old.discount_NAK, old.child_NAK))
    outcomes = Outcomes(reward_SA, prob_SAK, discount_SAK, child_SAK, old.num_children)
    return replace(mdp, outcomes=outcomes, action_names=tuple(mdp.action_names[a] for a in positions))
