"""Tables of transitions that environments publish, and whether these are what the environments do."""

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from jaxtyping import Float

from pgts_torch.bellman import Outcomes
from pgts_torch.errors import MissingModel, ModelMismatch
from pgts_torch.models.actions import base_actions
from pgts_torch.models.provenance import origin, overridden
from pgts_torch.models.snapshots import env_name
from pgts_torch.models.steps import number_of
from pgts_torch.models.tabular import TabularModel, tabular_truth
from pgts_torch.models.trial import SECONDS, Taken, compare, reset
from pgts_torch.models.wrappers import Transforms, transforms_of
from pgts_torch.tabular.mdp import TabularMDP

_STARTS = "initial_state_distrib"
"""The attribute with the start distribution of a table P."""

_RESETS = 1000


def published_table(env: gymnasium.Env, *, gamma: float) -> TabularMDP | None:
    """The table that an environment publishes, as it stands (`tabular_truth`); None where it has none."""
    with contextlib.suppress(Exception):  # whatever an attribute P of another meaning raises where it is read
        return tabular_truth(env, gamma=gamma)
    return None


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

    Raises:
        MissingModel: P is no table, or it was not written for this `step` and `reset`, has other states or actions than
            the spaces, or is contradicted by a step of a short walk.
    """
    base: Any = env.unwrapped
    transforms = transforms_of(env)
    attribute = "mdp" if isinstance(getattr(base, "mdp", None), TabularMDP) else "P"
    unused = f"the table {attribute} of {env_name(env)} is not used"
    starts_known = attribute == "mdp" or getattr(base, _STARTS, None) is not None
    why = overridden(base, origin(base, attribute), ("step",))
    if starts_known and not why:
        why = overridden(base, origin(base, attribute if attribute == "mdp" else _STARTS), ("reset",))
    if why:
        raise MissingModel(f"{unused}, for it was not written for what runs: {why}")
    if transforms.observations:
        raise MissingModel(f"{unused}, for its wrappers show something else than states")
    if attribute == "mdp":
        positions = [_position(base, action) for action in base_actions(env)]
        mdp = _transformed(tabular_truth(base, gamma=gamma), positions, transforms)
    elif getattr(base, "fickle_passenger", False):
        raise MissingModel(f"{unused}: it lacks what a fickle passenger draws")
    else:
        mdp = _from_rows(env, gamma, transforms, generator)
    sizes = mdp.num_states, mdp.num_actions
    if sizes != tuple(int(getattr(space, "n", 0)) for space in (env.observation_space, env.action_space)):
        raise MissingModel(
            f"{unused}: it has {sizes[0]} states and {sizes[1]} actions, and its spaces are {env.observation_space} "
            f"and {env.action_space}"
        )
    try:
        compare_table(mdp, env, gamma, generator)
    except ModelMismatch as off:
        raise MissingModel(f"{unused}, for its steps contradict it: {off}") from off
    return mdp, starts_known


def compare_table(
    mdp: TabularMDP, env: gymnasium.Env, gamma: float, generator: np.random.Generator, *, seconds: float = SECONDS
) -> int:
    """`compare` a random walk with a table: starts must have positive probability there, and each step must be an
    outcome that has (`TabularModel.outcome_of`).

    Args:
        env: an instance for this alone, in the wrappers that the table is meant for.
        gamma: discount of a step that names none.
    """

    def state_of(taken: Taken) -> int:
        seen = taken.observation
        if not _is_state(seen, mdp.num_states):
            raise ModelMismatch(f"it shows {seen!r}, which is none of the states 0 to {mdp.num_states - 1}")
        if taken.action is None and mdp.start_S[int(seen)] == 0:
            raise ModelMismatch(f"it starts in state {seen}, which has probability 0 there")
        return int(seen)

    # Where a table says what every action does, masks of the environment are advice.
    any_action = bool(mdp.outcomes.reward_NA.isfinite().all())
    return compare(TabularModel(mdp), env, generator, state_of, gamma=gamma, seconds=seconds, any_action=any_action)


def _from_rows(env: gymnasium.Env, gamma: float, transforms: Transforms, generator: np.random.Generator) -> TabularMDP:
    """The MDP of a table P with the transforms of wrappers; MissingModel if it is no such table."""
    base: Any = env.unwrapped
    start = getattr(base, _STARTS, None)
    try:
        if start is None:
            start = _counted_starts(env, len(base.P), generator)
        mdp = TabularMDP.from_gymnasium(env, gamma, start=start)
        if not (transforms.actions or transforms.rewards):
            return mdp
        positions = [_position(base, action) for action in base_actions(env)]
        listed = (base.P[s] for s in range(len(base.P)))
        rows = [row if isinstance(row, Mapping) else dict(enumerate(row)) for row in listed]
        P: Any = {
            s: {
                k: [(p, child, number_of("reward", transforms.reward(r)), end) for p, child, r, end in row[a]]
                for k, a in enumerate(positions)
                if a in row
            }
            for s, row in enumerate(rows)
        }
        return TabularMDP.from_transitions(P, gamma, start=start, shape=mdp.shape)
    except MissingModel:
        raise
    except Exception as error:
        raise MissingModel(f"the attribute P of {env_name(env)} is no transition table: {error}") from error


def _counted_starts(env: gymnasium.Env, num_states: int, generator: np.random.Generator) -> Float[np.ndarray, "S"]:
    """The share of up to 1,000 seeded resets in which each state was the start; ValueError if a start is no state."""
    counts, until = np.zeros(num_states), time.monotonic() + SECONDS
    for _ in range(_RESETS):
        state = reset(env, seed=int(generator.integers(2**31))).observation
        if not _is_state(state, num_states):
            raise ValueError(f"reset gave {state!r}, which is none of the states 0 to {num_states - 1}")
        counts[int(state)] += 1
        if time.monotonic() > until:
            break
    return counts / counts.sum()


def _is_state(seen: Any, num_states: int) -> bool:
    array = np.asarray(seen)
    return array.ndim == 0 and array.dtype.kind in "iu" and 0 <= int(array) < num_states


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
        legal_SA = reward_SA > -torch.inf
        paid_SA = torch.where(legal_SA, reward_SA, 0.0)
        paid_SA.apply_(lambda reward: number_of("reward", transforms.reward(reward)))
        reward_SA = torch.where(legal_SA, paid_SA, -torch.inf)
    prob_SAK, discount_SAK, child_SAK = (x[:, order] for x in (old.prob_NAK, old.discount_NAK, old.child_NAK))
    outcomes = Outcomes(reward_SA, prob_SAK, discount_SAK, child_SAK, old.num_children)
    return replace(mdp, outcomes=outcomes, action_names=tuple(mdp.action_names[a] for a in positions))
