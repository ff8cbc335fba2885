"""The lookahead of a policy: a search with the critic's values at the leaves, which several processes can share."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from typing import Any, final

import torch
from jaxtyping import Int
from torch import Tensor

from pgts_torch.agent.critics import Critic
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.ranks import Ranks
from pgts_torch.agent.world import ModelWorld
from pgts_torch.readings import Readings
from pgts_torch.search.engine import Search
from pgts_torch.search.lookahead import Lookahead

_VALUES = ("q_BA", "stderr_BA", "pruned_BA", "bias_BA", "doubt_BA")


@final
class PolicyLookahead:
    """(T^m Q)(s, .) at states of a model, with the critic's estimate of Q^pi or v^pi at the leaves.

    alone: the search with this critic and policy, `alone(state_N, depth=m, generator=generator)`, in this process only.

    Args:
        world: gives the observations of states, for policy and critic.
        policy: gives the prior of a tree search.
        critic: gives the values of this policy.
        search: computes the lookahead.
        ranks: the processes that can share it.
    """

    def __init__(self, world: ModelWorld, policy: Policy, critic: Critic, search: Search, ranks: Ranks) -> None:
        self.world, self.policy, self.critic, self.search, self._ranks = world, policy, critic, search, ranks
        self._generation = world.model.generation
        leaves: dict[str, Any] = {f"{critic.target}_leaf": self._leaf, "prior": self._prior}
        self.alone: Callable[..., Lookahead] = partial(search, **leaves)

    def in_parts(
        self, state_N: Int[Tensor, "N"], depth: int, generator: torch.Generator, readings: Readings | None = None
    ) -> Lookahead:
        """Return the lookahead from states that all ranks have; each rank computes its part of them.

        Args:
            readings: where the checks of values wait in a single process; of several ranks all must fail together.

        Raises:
            PgtsError, RankLost: as `Ranks.gather`.
        """
        if self._ranks.size == 1:
            return self.alone(state_N, depth=depth, generator=generator, readings=readings)
        mine = self._ranks.part(state_N)
        looks = self._ranks.gather(
            "lookahead",
            lambda: _moved(self.alone(mine, depth=depth, generator=generator), "cpu") if len(mine) else None,
        )
        return _moved(_joined([look for look in looks if look is not None]), state_N.device)

    def restart(self) -> None:
        """Reset the search before a lookahead for which states have got new numbers, or the model has learned."""
        generation = self.world.model.generation
        if not self.world.keeps_numbers or generation != self._generation:
            self.search.reset()
            self._generation = generation

    def _leaf(self, state_N: Int[Tensor, "N"]) -> Tensor:
        observation_N = self.world.observe(state_N)
        return self.critic.v(observation_N) if self.critic.target == "v" else self.critic.q(observation_N)

    def _prior(self, state_N: Int[Tensor, "N"]) -> Tensor:
        return self.policy.probs(self.world.observe(state_N))


def _moved(look: Lookahead, device: torch.device | str) -> Lookahead:
    values: dict[str, Any] = {name: getattr(look, name) for name in _VALUES}
    values = {name: None if value is None else value.to(device) for name, value in values.items()}
    return replace(look, **values)


def _joined(parts: Sequence[Lookahead]) -> Lookahead:
    """One lookahead from the roots of all parts, in their order."""

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
