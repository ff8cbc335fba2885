"""Rollouts: episodes of a policy in an environment, or in a model of it."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Num, Shaped
from torch import Tensor

from pgts_torch.agent.episodes import Episodes
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import Experience, SamplingModel
from pgts_torch.models.snapshots import env_name
from pgts_torch.options.rollouts import FixedHorizon, GeometricHorizon, Horizon
from pgts_torch.options.updates import StateWeight
from pgts_torch.ranks import ALONE, Ranks, Share
from pgts_torch.seeding import SharedGenerators, sample_keys, seed_sequence


def survival(horizon: Horizon, discount_B: Float[Tensor, "B"], generator: torch.Generator) -> Float[Tensor, "B"]:
    """The factor of the weight of an episode after a step of this discount.

    Fixed horizon: the discount. Geometric horizon: 1 with the discount as its probability, else 0; so visits are an
    unbiased sample of d^pi, and undiscounted sums of rewards are unbiased estimates of v^pi.
    """
    if isinstance(horizon, FixedHorizon):
        return discount_B.double()
    uniform_B = torch.rand(discount_B.shape, generator=generator, dtype=torch.float64, device=generator.device)
    return (uniform_B.to(discount_B.device) < discount_B).double()


def check_end(horizon: Horizon, num_alive: int) -> None:
    """PgtsError if episodes are alive at the limit of a geometric horizon."""
    if num_alive and isinstance(horizon, GeometricHorizon):
        raise PgtsError(
            f"an episode is longer than max_length = {horizon.max_length} of the geometric horizon; is gamma 1?"
        )


COLUMNS = ("action_TB", "reward_TB", "discount_TB", "alive_TB", "weight_TB", "survival_TB")
"""The fields of `Rollout` with a row for each step."""


class Totals(NamedTuple):
    """How much all processes have made together.

    visits: how many visits there are, and which of them are those of this process.
    searched: the same for the visits that a lookahead starts from.
    """

    visits: Share
    searched: Share
    episodes: int


@dataclass(frozen=True, eq=False)
class Rollout:
    """B episodes of at most T steps. After the end of an episode its rows are padding and `alive_TB` is False.

    observation_UB: the observations before each of the T steps and after the last: U = T + 1.
    reward_TB: in reward units.   discount_TB: of the transition itself, 0 where it terminated.
    weight_TB: the weight of a visit in the occupancy: the product of the discounts before it (fixed horizon) or 1
        (geometric horizon); 0 where the episode is over.
    survival_TB: the factor from one weight to the next: weight_{t+1} = weight_t * survival_t.
    state_UB: the states of these observations, which a lookahead may start from; None where there is no model.
    begins_B: whether an episode begins in the first row, where episodes go on from one rollout to the next; None: each
        does.
    searched_TB: the visits that a lookahead starts from; None: all.
    finished: the undiscounted return and the length of each episode that ended, where episodes go on from one rollout
        to the next; None: all begin in this one.
    totals: what this rollout is a part of, where several processes have made episodes of the same policy; the weights
        of visits are those in the whole. None: it is the whole.
    """

    observation_UB: Shaped[Tensor, "U B ..."]
    action_TB: Num[Tensor, "T B ..."]
    reward_TB: Float[Tensor, "T B"]
    discount_TB: Float[Tensor, "T B"]
    alive_TB: Bool[Tensor, "T B"]
    weight_TB: Float[Tensor, "T B"]
    survival_TB: Float[Tensor, "T B"]
    state_UB: Int[Tensor, "U B"] | None = None
    begins_B: Bool[Tensor, "B"] | None = None
    searched_TB: Bool[Tensor, "T B"] | None = None
    finished: tuple[tuple[float, int], ...] | None = None
    totals: Totals | None = None

    @property
    def ranks(self) -> Ranks:
        """The processes that have the other episodes."""
        return self.share.ranks

    @property
    def share(self) -> Share:
        """The visits of this rollout among those of all processes."""
        return self.whole.visits

    @cached_property
    def whole(self) -> Totals:
        """How much all processes have made together."""
        if self.totals is not None:
            return self.totals
        return Totals(Share(ALONE, 0, self.num_steps), Share(ALONE, 0, self._num_searched), self.num_episodes)

    def shared(self, ranks: Ranks) -> "Rollout":
        """The same rollout as the part of one of several processes, which must all call this.

        Raises:
            PgtsError, RankLost: as `Ranks`.
        """
        if ranks.size == 1:
            return self
        own = self.num_steps, self._num_searched, self.num_episodes
        steps_R, searched_R, episodes_R = ranks.each("episodes", *own).astype(int).T
        visits, searched = (
            Share(ranks, int(count_R[: ranks.rank].sum()), int(count_R.sum())) for count_R in (steps_R, searched_R)
        )
        return replace(self, totals=Totals(visits, searched, int(episodes_R.sum())))

    @cached_property
    def observation_V(self) -> Shaped[Tensor, "V ..."]:
        """The observation of each of the V = `num_steps` visits, in the order of `alive_TB`."""
        return self.of_visits(self.observation_UB[:-1])

    def of_visits(self, column_TB: Shaped[Tensor, "T B ..."]) -> Shaped[Tensor, "V ..."]:
        """The rows of the visits, in the order of `alive_TB`."""
        return column_TB.flatten(0, 1).index_select(0, self._visit_V)

    # Positions are found once, because a GPU is waited for each time that a mask is an index.

    @cached_property
    def _visit_V(self) -> Int[Tensor, "V"]:
        return torch.nonzero(self.alive_TB.flatten()).squeeze(1)

    @cached_property
    def _needed_M(self) -> Int[Tensor, "M"]:
        """Where the observations of visits and of ends are: a visit at t has its own in row t and the one after it in
        row t + 1."""
        return torch.nonzero(torch.cat([self.alive_TB[:1], self.alive_TB]).flatten()).squeeze(1)

    @property
    def state_TB(self) -> Int[Tensor, "T B"]:
        """The states before each step. Only with a model."""
        assert self.state_UB is not None
        return self.state_UB[:-1]

    @property
    def start_state_N(self) -> Int[Tensor, "N"]:
        """The states in which episodes begin in this rollout. Only with a model."""
        return self.state_TB[0] if self.begins_B is None else self.state_TB[0][self.begins_B]

    @property
    def next_state_TB(self) -> Int[Tensor, "T B"]:
        """The states after each step. Only with a model."""
        assert self.state_UB is not None
        return self.state_UB[1:]

    @cached_property
    def num_steps(self) -> int:
        """The number of steps, without padding."""
        return int(self.alive_TB.sum())

    @property
    def num_episodes(self) -> int:
        return self.alive_TB.shape[1]

    @property
    def follows_TB(self) -> Bool[Tensor, "T B"]:
        """Whether the next row is another step of the same episode."""
        return torch.cat([self.alive_TB[1:], torch.zeros_like(self.alive_TB[:1])])

    def steps(self) -> Experience:
        """All steps, those of the first episode first."""
        alive_BT = self.alive_TB.T

        def rows(column_TB: Tensor) -> Tensor:
            return column_TB.transpose(0, 1)[alive_BT]

        before_N, after_N = rows(self.observation_UB[:-1]), rows(self.observation_UB[1:])
        action_N, reward_N, discount_N = rows(self.action_TB), rows(self.reward_TB), rows(self.discount_TB)
        return Experience(before_N, action_N, reward_N, discount_N, after_N, rows(self.follows_TB), self.ranks)

    def values(self, v: Callable[[Tensor], Tensor]) -> tuple[Float[Tensor, "T B"], Float[Tensor, "T B"]]:
        """Return v(s_t) and v(s_{t+1}); they have no meaning where the episode is over.

        Args:
            v: returns the values of observations; called once, with each visit and each end of an episode.
        """
        v_M = v(self.observation_UB.flatten(0, 1).index_select(0, self._needed_M)).to(self.reward_TB)
        v_UB = v_M.new_zeros(len(self.observation_UB) * self.num_episodes).index_copy_(0, self._needed_M, v_M)
        v_UB = v_UB.view(-1, self.num_episodes)
        return v_UB[:-1], v_UB[1:]

    def returns(self) -> Float[Tensor, "B"]:
        """The weighted sum of rewards of each episode: an estimate of J^pi, unbiased for the geometric horizon."""
        return (self.weight_TB * self.reward_TB).sum(0)

    def visits(self, state_weight: StateWeight) -> tuple[Int[Tensor, "N"], Float[Tensor, "N"]]:
        """Return the distinct visited states that a lookahead starts from, ascending, and the weight w(s) of each. A
        state that several processes have visited has a row in each, and its weight there is that of the visits there.

        occupancy:  mean over episodes of sum_t weight_t 1(s_t = s), an estimate of d^pi(s)    [PGTS Sec. 2]
        visits:     fraction of all visits that are to s
        uniform:    1
        """
        states, row_V = self._distinct
        if state_weight == "uniform":
            return states, torch.ones(len(states), dtype=self.weight_TB.dtype, device=states.device)
        weight_V = self.visit_weight(state_weight)[self._searched_V]
        weight_V = weight_V * (self.share.total / self.whole.searched.total)  # they stand for all visits
        # the sum of the weights of all visits to a state
        weight_N = torch.zeros(len(states), dtype=weight_V.dtype, device=states.device)
        return states, weight_N.index_add_(0, row_V, weight_V)

    @property
    def count_N(self) -> Int[Tensor, "N"]:
        """How many of the visits that a lookahead starts from are to each distinct state, in the order of `visits`."""
        states, row_V = self._distinct
        return torch.bincount(row_V, minlength=len(states))

    @property
    def first_observation_N(self) -> Shaped[Tensor, "N ..."]:
        """The observation at the first visit to each distinct state, in the order of `visits`."""
        states, row_V = self._distinct
        # the smallest index of a visit to each state
        visit_V = torch.arange(len(row_V), device=row_V.device)
        first_N = torch.full_like(states, len(row_V)).scatter_reduce_(0, row_V, visit_V, "amin")
        return self.observation_V[self._searched_V][first_N]

    @property
    def _searched_V(self) -> Any:
        """Which of the visits a lookahead starts from, as an index."""
        return slice(None) if self.searched_TB is None else self.of_visits(self.searched_TB)

    @property
    def _num_searched(self) -> int:
        return self.num_steps if self.searched_TB is None else int(self.searched_TB[self.alive_TB].sum())

    @cached_property
    def _distinct(self) -> tuple[Int[Tensor, "N"], Int[Tensor, "V"]]:
        """The distinct visited states, ascending, and the index among them of the state of each visit."""
        return self.of_visits(self.state_TB)[self._searched_V].unique(return_inverse=True)

    def visit_weight(self, state_weight: StateWeight) -> Float[Tensor, "V"]:
        """The weight that each visit adds to w(s), in the order of `alive_TB`; with "uniform" it is 1."""
        weight_V = self.of_visits(self.weight_TB)
        if state_weight == "occupancy":
            return weight_V / self.whole.episodes
        return torch.full_like(weight_V, 1 / self.share.total if state_weight == "visits" else 1.0)


def rollout(
    world: World,
    policy: Policy,
    horizon: Horizon,
    *,
    seed: int,
    names: tuple[str | int, ...],
    generator: torch.Generator,
) -> Rollout:
    """Run one episode in each environment of a world, from a reset.

    The episodes are a function of (seed, names), `generator` and the policy alone. Environments are seeded, and while
    they run so are the generators of the whole process (`SharedGenerators`), in case they use these.

    Args:
        world: the environments; where it has a model the rollout has states, which a lookahead may start from.
        seed, names: the stream that the environments are seeded from.
        generator: for actions and the geometric horizon.

    Raises:
        PgtsError: an episode is longer than `max_length` of the geometric horizon; or the environment raised an error
            or returned something that is not a number; the message names environment, step and seed.

    Warns:
        UserWarning: an environment uses the generators of the whole process, once for each world.
    """
    seeds = seed_sequence(seed, *names, "env").generate_state(world.env.num_envs).tolist()
    with shared_generators(world, seed, names):
        return _episodes(world, policy, horizon, seeds, generator)


@contextmanager
def shared_generators(world: World, seed: int, names: tuple[str | int, ...]) -> Iterator[None]:
    """A context in which the generators of the whole process are seeded, in case the environments use these."""
    if world.draws_its_own:
        yield
        return
    with SharedGenerators(seed, *names) as shared:
        yield
    if shared.used and not world.warned:
        world.warned = True
        warnings.warn(
            f"{env_name(world.env)} uses the generator of {shared.used[0]}, which the whole process shares: it is "
            "seeded for each iteration and restored afterwards; better use self.np_random",
            stacklevel=4,
        )


def _episodes(world: World, policy: Policy, horizon: Horizon, seeds: list[int], generator: torch.Generator) -> Rollout:
    num_envs, model_world = world.env.num_envs, world if isinstance(world, ModelWorld) else None
    episodes = Episodes(world.env, gamma=world.gamma, seeds=seeds, masks=world.masks)
    observations: list[Tensor] = []
    reads: list[Tensor] = []

    def observe() -> None:
        observations.append(world.encode(episodes.observation))
        if model_world:
            reads.append(model_world.read(episodes.observation, observations[-1]))

    with episodes.named("at the start"):
        episodes.reset()
        observe()
    # numpy until the end, because operations on a few numbers cost several times more in torch
    alive_B, weight_B = np.ones(num_envs, dtype=bool), np.ones(num_envs)
    rows: list[tuple[np.ndarray, ...]] = []
    while len(rows) < horizon.limit and alive_B.any():
        action_B = policy.sample(world.perceive(observations[-1]), generator=generator).cpu().numpy()
        with episodes.named(f"in step {len(rows)}"):
            reward_B, discount_B, truncated_B = episodes.step(action_B, alive_B)
            if world.reward_range is not None:
                world.reward_range.check(reward_B[alive_B])
            observe()
        survival_B = survival(horizon, torch.from_numpy(discount_B), generator).numpy()
        rows.append((action_B, reward_B, discount_B, alive_B, weight_B * alive_B, survival_B))
        weight_B = weight_B * survival_B
        alive_B = alive_B & (survival_B > 0) & ~truncated_B
    check_end(horizon, int(alive_B.sum()))
    arrays = (torch.from_numpy(np.array(column)).to(world.device) for column in zip(*rows, strict=True))
    columns: dict[str, Any] = dict(zip(COLUMNS, arrays, strict=True))
    state_UB = model_world.numbers(torch.cat(reads)).view(len(reads), -1) if model_world else None
    return Rollout(torch.stack(observations), **columns, state_UB=state_UB)


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
