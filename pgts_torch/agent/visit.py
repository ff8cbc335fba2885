"""Collect the episodes of an iteration: each process runs its part of them."""

from collections.abc import Callable
from typing import Any

from pgts_torch.agent.collect import rollout
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.ongoing import OngoingEpisodes
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.options.rollouts import FixedHorizon
from pgts_torch.ranks import Ranks


def visit(
    world: World,
    policy: Policy,
    episodes: OngoingEpisodes | None,
    horizon: Any,
    draws: Draws,
    ranks: Ranks,
    *,
    stepped: Callable[[int, int | None], None],
) -> Rollout:
    """Run the policy in each environment of this process, and learn how much the others have done.

    Args:
        episodes: the episodes that go on; None: each environment runs one episode, from a reset.
        horizon: when they end; for episodes that go on, how many steps an iteration takes.
        world: its states are numbered from 0 again, unless they keep their numbers.
        stepped: called with the number of steps made in each environment, and with how many there will be at most; None
            where that depends on chance.

    Raises:
        PgtsError, RankLost: as `rollout` and `Ranks`.
    """
    if isinstance(world, ModelWorld):
        world.reset_numbers()
    if episodes is None:
        most = horizon.limit if isinstance(horizon, FixedHorizon) else None
        made = rollout(
            world,
            policy,
            horizon,
            seed=draws.seed,
            names=draws.names,
            generator=draws.own,
            stepped=lambda steps: stepped(steps, most),
        )
    else:
        length = horizon.length if draws.number or horizon.first is None else horizon.first
        made = episodes.collect(
            policy, length, names=draws.names, generator=draws.own, stepped=lambda steps: stepped(steps, length)
        )
    return made.shared(ranks)
