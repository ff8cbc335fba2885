"""Episodes of a policy in the environments of a world, each from a reset."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.episodes import Episodes
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import COLUMNS, Rollout
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.errors import PgtsError, warn
from pgts_torch.models.snapshots import env_name
from pgts_torch.options.rollouts import FixedHorizon, GeometricHorizon, Horizon
from pgts_torch.seeding import SharedGenerators, seed_sequence


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


def rollout(
    world: World,
    policy: Policy,
    horizon: Horizon,
    *,
    seed: int,
    names: tuple[str | int, ...],
    generator: torch.Generator,
    stepped: Callable[[int], None] = lambda steps: None,
) -> Rollout:
    """Run one episode in each environment of a world, from a reset.

    The episodes are a function of (seed, names), `generator` and the policy alone. Environments are seeded, and while
    they run so are the generators of the whole process (`SharedGenerators`), in case they use these.

    Args:
        world: the environments; where it has a model the rollout has states, which a lookahead may start from.
        seed, names: the stream that the environments are seeded from.
        generator: for actions and the geometric horizon.
        stepped: called with the number of steps made in each environment.

    Raises:
        PgtsError: an episode is longer than `max_length` of the geometric horizon; or the environment raised an error
            or returned something that is not a number; the message names environment, step and seed.

    Warns:
        UserWarning: an environment uses the generators of the whole process, once for each world.
    """
    seeds = seed_sequence(seed, *names, "env").generate_state(world.env.num_envs).tolist()
    with shared_generators(world, seed, names):
        return _episodes(world, policy, horizon, seeds, generator, stepped)


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
        warn(
            f"{env_name(world.env)} uses the generator of {shared.used[0]}, which the whole process shares: it is "
            "seeded for each iteration and restored afterwards; better use self.np_random"
        )


def _episodes(
    world: World,
    policy: Policy,
    horizon: Horizon,
    seeds: list[int],
    generator: torch.Generator,
    stepped: Callable[[int], None],
) -> Rollout:
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
        stepped(len(rows))
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
