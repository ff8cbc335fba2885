"""Episodes of a policy in a model of the environment."""

from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import COLUMNS, Rollout
from pgts_torch.agent.world import ModelWorld, SimulatedWorld
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.base import SamplingModel
from pgts_torch.seeding import sample_keys


@torch.no_grad()
def imagine(
    world: ModelWorld,
    policy: Policy,
    start_B: Int[Tensor, "B"],
    length: int,
    *,
    search_every: int = 1,
    generator: torch.Generator,
) -> Rollout:
    """Run one episode of at most `length` steps in the model from each state; the environment is not stepped.

    Outcomes are sampled from the model, so visits are an unbiased sample of what pi does in it. An episode is cut off
    before a step that the model does not trust, unless it is the first one.

    Args:
        world: its model is stepped, and gives the observations of its states.
        start_B: states of the model.
        search_every: a lookahead starts from the visits at t = -b, search_every - b, ... of episode b.
        generator: for actions and outcomes.

    Returns:
        A rollout as of a fixed horizon, with states.

    Raises:
        MissingModel: the model cannot sample outcomes.
        PgtsError: the policy takes an action that the model does not allow.
    """
    model = world.model
    if not isinstance(model, SamplingModel):
        raise MissingModel(f"{type(model).__name__} cannot sample outcomes, which imagined episodes need")
    state_B, alive_B, weight_B = start_B, torch.ones_like(start_B, dtype=torch.bool), torch.ones_like(start_B).double()
    states, observations = [state_B], [world.observe(state_B)]
    rows: list[tuple[Tensor, ...]] = []
    while len(rows) < length and bool(alive_B.any()):
        action_B = policy.sample(observations[-1], generator=generator)
        sampled = model.sample(state_B, action_B, key_N=sample_keys(len(state_B), generator=generator))
        if rows and sampled.trusted_N is not None:
            alive_B = alive_B & sampled.trusted_N
        reward_B, discount_B = torch.where(alive_B, sampled.reward_N.double(), 0.0), sampled.discount_N.double()
        if bool((off_B := reward_B == -torch.inf).any()):
            b = int(off_B.nonzero()[0, 0])
            raise PgtsError(
                f"{type(model).__name__} does not allow action {int(action_B[b])} in state {int(state_B[b])}, which "
                "the policy has taken in an imagined episode; with replay all actions must be allowed"
            )
        rows.append((action_B, reward_B, discount_B, alive_B, weight_B * alive_B, discount_B))
        weight_B, alive_B = weight_B * discount_B, alive_B & (discount_B > 0)
        state_B = torch.where(alive_B, sampled.next_state_N, state_B)  # what is over stays where it is
        if isinstance(world, SimulatedWorld):
            alive_B = alive_B & ~world.model.is_cut(state_B)
        states.append(state_B)
        observations.append(world.observe(state_B))
    columns: dict[str, Any] = dict(zip(COLUMNS, map(torch.stack, zip(*rows, strict=True)), strict=True))
    step_TB = torch.arange(len(rows), device=start_B.device)[:, None] + torch.arange(
        len(start_B), device=start_B.device
    )
    searched_TB = None if search_every == 1 else step_TB % search_every == 0
    return Rollout(torch.stack(observations), **columns, state_UB=torch.stack(states), searched_TB=searched_TB)
