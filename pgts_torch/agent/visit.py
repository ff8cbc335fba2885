"""Collect the episodes of an iteration: each process runs its part of them, and all get the whole batch."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from pgts_torch.agent.ongoing import OngoingEpisodes
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.ranks import Draws, Ranks
from pgts_torch.agent.rollout import COLUMNS, Rollout, rollout
from pgts_torch.agent.world import ModelWorld, World


def visit(
    world: World, policy: Policy, episodes: OngoingEpisodes | None, horizon: Any, draws: Draws, ranks: Ranks
) -> Rollout:
    """Run the policy in each environment of all ranks. All ranks number the states of the batch alike.

    Args:
        episodes: the episodes that go on; None: each environment runs one episode, from a reset.
        horizon: when they end; for episodes that go on, how many steps an iteration takes.
        world: of this rank. Its states are numbered from 0 again, unless they keep their numbers.
        draws: the random generators of the iteration.

    Raises:
        PgtsError, RankLost: as `rollout` and `Ranks.gather`.
    """
    if isinstance(world, ModelWorld):
        world.reset_numbers()
    if episodes is None:
        make = partial(rollout, world, policy, horizon, seed=draws.seed, names=draws.names, generator=draws.own)
    else:
        length = horizon.length if draws.number else horizon.first
        make = partial(episodes.collect, policy, length, names=draws.names, generator=draws.own)
    if ranks.size == 1:
        return make()
    parts = ranks.gather("episodes", lambda: _sent(world, make()))
    length = max(len(part["alive_TB"]) for part in parts)
    columns: dict[str, Any] = {
        name: torch.cat([_padded(part[name], length) for part in parts], 1).to(world.device) for name in COLUMNS
    }
    observation_UB = torch.cat([_extended(part["observations"], length) for part in parts], 1).to(world.device)
    state_UB = None
    if isinstance(world, ModelWorld):
        world.reset_numbers()  # this rank's own numbers are replaced by those that all ranks have in common
        numbered = (world.adopt(part["states"]).view(len(part["alive_TB"]) + 1, -1) for part in parts)
        state_UB = torch.cat([_extended(part_UB, length) for part_UB in numbered], 1)
    if episodes is None:
        return Rollout(observation_UB, **columns, state_UB=state_UB)
    begins_B = torch.cat([part["begins"] for part in parts]).to(world.device)
    finished = tuple(each for part in parts for each in part["finished"])
    return Rollout(observation_UB, **columns, state_UB=state_UB, begins_B=begins_B, finished=finished)


def _sent(world: World, made: Rollout) -> dict[str, Any]:
    """The episodes of this rank as a dict that pickles, with states in a form that another rank can number."""
    columns = {name: getattr(made, name).cpu() for name in COLUMNS}
    if isinstance(world, ModelWorld) and made.state_UB is not None:
        columns["states"] = world.export(made.state_UB.flatten())
    if made.begins_B is not None:
        columns |= {"begins": made.begins_B.cpu(), "finished": made.finished}
    return {"observations": made.observation_UB.cpu(), **columns}


def _extended(x_UB: Tensor, length: int) -> Tensor:
    """Repeat the last row until there are `length` + 1 rows."""
    return torch.cat([x_UB, x_UB[-1:].expand(length + 1 - len(x_UB), *x_UB.shape[1:])])


def _padded(column_TB: Tensor, length: int) -> Tensor:
    """Append rows of zeros until there are `length` rows; `alive_TB` is False there."""
    return torch.cat([column_TB, column_TB.new_zeros(length - len(column_TB), column_TB.shape[1])])
