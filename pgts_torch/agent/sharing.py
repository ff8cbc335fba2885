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
from pgts_torch.agent.world import World
from pgts_torch.search.lookahead import Lookahead

_COLUMNS = ("action_TB", "reward_TB", "discount_TB", "alive_TB", "weight_TB", "survival_TB")


def whole_rollout(ranks: Ranks, world: World, make: Callable[[], Rollout]) -> Rollout:
    """The episodes of all ranks, side by side; their states have the same numbers in all ranks.

    Args:
        world: whose states they visit; where it numbers states anew in each iteration, it does so now.
        make: makes the episodes of this rank.

    Raises:
        PgtsError, RankLost: as `Ranks.gather`.
    """
    if ranks.size == 1:
        return make()
    parts = ranks.gather("episodes", lambda: _sent(world, make()))
    world.forget()
    length = max(len(part["alive_TB"]) for part in parts)
    columns = {
        name: torch.cat([_padded(part[name], length) for part in parts], 1).to(world.device) for name in _COLUMNS
    }
    state_UB = torch.cat([_states(world, part, length) for part in parts], 1)
    return Rollout(state_TB=state_UB[:-1], next_state_TB=state_UB[1:], observe=world.observe, **columns)


def _sent(world: World, made: Rollout) -> dict[str, Any]:
    """Episodes as another process can take them."""
    state_UB = torch.cat([made.state_TB, made.next_state_TB[-1:]])
    columns = {name: getattr(made, name).cpu() for name in _COLUMNS}
    return {"states": world.export(state_UB.flatten()), **columns}


def _states(world: World, part: dict[str, Any], length: int) -> Int[Tensor, "U B"]:
    """The states of some episodes, and the one after; the last ones stand for those that there are not."""
    num_steps, num_episodes = part["alive_TB"].shape
    state_UB = world.adopt(part["states"]).view(num_steps + 1, num_episodes)
    return torch.cat([state_UB, state_UB[-1:].expand(length - num_steps, -1)])


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
