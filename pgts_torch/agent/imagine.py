"""Episodes of a policy in a model of the environment."""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.agent.collect import check_end, survival
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import COLUMNS, Rollout
from pgts_torch.agent.world import ModelWorld
from pgts_torch.agent.worlds import SimulatedWorld
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.base import SamplingModel, Transitions
from pgts_torch.options.rollouts import Horizon
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

    Outcomes are sampled from the model, so visits are an unbiased sample of what pi does in it where it trusts all
    steps. An episode is cut off before a step that it does not trust, unless it is the first one: later visits are
    then those of trusted actions.

    Args:
        world: its model is stepped, and gives the observations of its states.
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
        key_B = sample_keys(len(state_B), generator=generator)
        if isinstance(world, SimulatedWorld):
            sampled = _sample_those_that_go_on(model, state_B, action_B, key_B, alive_B)
        else:
            sampled = model.sample(state_B, action_B, key_N=key_B)
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


def _sample_those_that_go_on(
    model: SamplingModel, state_B: Tensor, action_B: Tensor, key_B: Int[Tensor, "B"], alive_B: Bool[Tensor, "B"]
) -> Transitions:
    """Outcomes where an episode is not over, because each takes a step of a simulator; the others stay where they
    are, with reward and discount 0."""
    sampled = model.sample(state_B[alive_B], action_B[alive_B], key_N=key_B[alive_B])
    reward_B, discount_B = (x_N.new_zeros(len(state_B)) for x_N in (sampled.reward_N, sampled.discount_N))
    reward_B[alive_B], discount_B[alive_B] = sampled.reward_N, sampled.discount_N
    return Transitions(reward_B, discount_B, state_B.masked_scatter(alive_B, sampled.next_state_N))


def simulated_returns(
    model: SamplingModel,
    policy: Policy,
    state_B: Int[Tensor, "B"],
    horizon: Horizon,
    *,
    first_action_B: Int[Tensor, "B"] | None = None,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "B"], int]:
    """Run one episode in the model from each state. Return their weighted sums of rewards, and their steps in total.

    Args:
        first_action_B: the first actions; None: they are sampled from the policy as well.

    Raises:
        PgtsError: an episode is longer than `max_length` of the geometric horizon, or a discount is outside [0, 1].
    """
    returns_B = torch.zeros(len(state_B), dtype=torch.float64, device=state_B.device)
    row_N, state_N, weight_N = torch.arange(len(state_B), device=state_B.device), state_B, torch.ones_like(returns_B)
    action_N = policy.sample(state_B, generator=generator) if first_action_B is None else first_action_B
    num_steps = 0
    for _ in range(horizon.limit):
        sampled = model.sample(state_N, action_N, key_N=sample_keys(len(state_N), generator=generator))
        if bool((off_N := ~((sampled.discount_N >= 0) & (sampled.discount_N <= 1))).any()):
            n = int(torch.nonzero(off_N)[0, 0])
            raise PgtsError(
                f"the model's discount of state {int(state_N[n])} and action {int(action_N[n])} is "
                f"{float(sampled.discount_N[n])}; it must be in [0, 1]"
            )
        returns_B[row_N] += weight_N * sampled.reward_N
        num_steps += len(row_N)
        weight_N = weight_N * survival(horizon, sampled.discount_N, generator)
        alive_N = weight_N > 0
        row_N, state_N, weight_N = row_N[alive_N], sampled.next_state_N[alive_N], weight_N[alive_N]
        if len(row_N) == 0:
            break
        action_N = policy.sample(state_N, generator=generator)
    check_end(horizon, len(row_N))
    return returns_B, num_steps
