"""The episodes of an iteration: each process makes its part of them, and all have the whole."""

from functools import partial
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.agent.policies import Policy
from pgts_torch.agent.ranks import Draws, Ranks
from pgts_torch.agent.rollout import Horizon, Rollout, rollout
from pgts_torch.agent.world import ModelWorld, World

_COLUMNS = ("action_TB", "reward_TB", "discount_TB", "alive_TB", "weight_TB", "survival_TB")


def visit(world: World, policy: Policy, horizon: Horizon, draws: Draws, ranks: Ranks) -> Rollout:
    """The episodes of a policy in the environments of all ranks, side by side; all ranks number their states alike.

    Args:
        world: of this rank. Where numbers of states last one iteration only, they begin anew.
        draws: of the iteration.

    Raises:
        PgtsError, RankLost: as `rollout` and `Ranks.gather`.
    """
    if isinstance(world, ModelWorld):
        world.reset_numbers()
    make = partial(rollout, world, policy, horizon, seed=draws.seed, names=draws.names, generator=draws.own)
    if ranks.size == 1:
        return make()
    parts = ranks.gather("episodes", lambda: _sent(world, make()))
    length = max(len(part["alive_TB"]) for part in parts)
    columns = {
        name: torch.cat([_padded(part[name], length) for part in parts], 1).to(world.device) for name in _COLUMNS
    }
    observation_UB = torch.cat([_extended(part["observations"], length) for part in parts], 1).to(world.device)
    state_UB = None
    if isinstance(world, ModelWorld):
        world.reset_numbers()  # those of this rank alone make room for those that all ranks have in common
        state_UB = torch.cat([_extended(_adopted(world, part), length) for part in parts], 1)
    return Rollout(observation_UB, **columns, state_UB=state_UB)


def _sent(world: World, made: Rollout) -> dict[str, Any]:
    """Episodes as another process can take them."""
    columns = {name: getattr(made, name).cpu() for name in _COLUMNS}
    if isinstance(world, ModelWorld) and made.state_UB is not None:
        columns["states"] = world.export(made.state_UB.flatten())
    return {"observations": made.observation_UB.cpu(), **columns}


def _adopted(world: ModelWorld, part: dict[str, Any]) -> Int[Tensor, "U B"]:
    """The states of some episodes, by the numbers of this process."""
    return world.adopt(part["states"]).view(len(part["alive_TB"]) + 1, -1)


def _extended(x_UB: Tensor, length: int) -> Tensor:
    """With its last row repeated, to the end of episodes of so many steps."""
    return torch.cat([x_UB, x_UB[-1:].expand(length + 1 - len(x_UB), *x_UB.shape[1:])])


def _padded(column_TB: Tensor, length: int) -> Tensor:
    """With rows of zeros: nobody is alive there."""
    return torch.cat([column_TB, column_TB.new_zeros(length - len(column_TB), column_TB.shape[1])])
