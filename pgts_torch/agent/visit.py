"""Collect the episodes of an iteration: each process runs its part of them."""

from typing import Any

from pgts_torch.agent.collect import rollout
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.ongoing import OngoingEpisodes
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.ranks import Ranks


def visit(
    world: World, policy: Policy, episodes: OngoingEpisodes | None, horizon: Any, draws: Draws, ranks: Ranks
) -> Rollout:
    """Run the policy in each environment of this process, and learn how much the others have done.

    Args:
        episodes: the episodes that go on; None: each environment runs one episode, from a reset.
        horizon: when they end; for episodes that go on, how many steps an iteration takes.
        world: its states are numbered from 0 again, unless they keep their numbers.

    Raises:
        PgtsError, RankLost: as `rollout` and `Ranks`.
    """
    if isinstance(world, ModelWorld):
        world.reset_numbers()
    if episodes is None:
        made = rollout(world, policy, horizon, seed=draws.seed, names=draws.names, generator=draws.own)
    else:
        length = horizon.length if draws.number or horizon.first is None else horizon.first
        made = episodes.collect(policy, length, names=draws.names, generator=draws.own)
    return made.shared(ranks)
