"""What the ranks of a training make in parts, and have as a whole."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.agent.ranks import Ranks
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.search.lookahead import Lookahead

_COLUMNS = ("action_TB", "reward_TB", "discount_TB", "alive_TB", "weight_TB", "survival_TB")


def whole_rollout(ranks: Ranks, world: World, make: Callable[[], Rollout]) -> Rollout:
    """The episodes of all ranks, side by side; their states have the same numbers in all ranks.

    Args:
        world: where they are made; where it numbers states anew in each iteration, it does so now.
        make: makes the episodes of this rank.

    Raises:
        PgtsError, RankLost: as `Ranks.gather`.
    """
    if ranks.size == 1:
        return make()
    parts = ranks.gather("episodes", lambda: _sent(world, make()))
    if isinstance(world, ModelWorld):
        world.forget()
    length = max(len(part["alive_TB"]) for part in parts)
    columns = {
        name: torch.cat([_padded(part[name], length) for part in parts], 1).to(world.device) for name in _COLUMNS
    }
    observation_UB = torch.cat([_extended(part["observations"], length) for part in parts], 1).to(world.device)
    state_UB = None
    if isinstance(world, ModelWorld):
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


def whole_lookahead(ranks: Ranks, state_N: Int[Tensor, "N"], look: Callable[[Tensor], Lookahead]) -> Lookahead:
    """A lookahead from states that all ranks have, each of which looks from its part of them.

    Args:
        look: from some of the states.

    Raises:
        PgtsError, RankLost: as `Ranks.gather`.
    """
    if ranks.size == 1:
        return look(state_N)
    mine = ranks.part(state_N)
    parts = ranks.gather("lookahead", lambda: _moved(look(mine), "cpu") if len(mine) else None)
    return _moved(_joined([part for part in parts if part is not None]), state_N.device)


_VALUES = ("q_BA", "stderr_BA", "pruned_BA", "bias_BA")


def _moved(look: Lookahead, device: torch.device | str) -> Lookahead:
    moved: dict[str, Any] = {name: getattr(look, name) for name in _VALUES}
    for name, value_BA in moved.items():
        moved[name] = None if value_BA is None else value_BA.to(device)
    return replace(look, **moved)


def _joined(parts: Sequence[Lookahead]) -> Lookahead:
    """One lookahead from the roots of all."""

    def rows(name: str) -> Any:
        columns = [getattr(part, name) for part in parts]
        return None if any(column is None for column in columns) else torch.cat(columns)

    return Lookahead(
        **{name: rows(name) for name in _VALUES},
        model_calls=sum(part.model_calls for part in parts),
        critic_calls=sum(part.critic_calls for part in parts),
        samples=parts[0].samples,
        value_range=parts[0].value_range,
        nodes_per_level=tuple(map(sum, zip_longest(*(part.nodes_per_level for part in parts), fillvalue=0))),
    )
