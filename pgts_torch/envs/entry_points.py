"""What `gymnasium.make` and `gymnasium.make_vec` call: one environment, or many, for each MDP of the zoo."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
from gymnasium.vector import AutoresetMode

from pgts_torch.envs.tabular import TabularEnv
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import PgtsError
from pgts_torch.tabular import zoo
from pgts_torch.tabular.mdp import TabularMDP


@dataclass(frozen=True)
class _Single:
    """Makes a `TabularEnv`; keyword arguments other than its own go to the function of the zoo."""

    # Read by gymnasium.make: with it "rgb_array_list" and "human" work through Gymnasium's wrappers.
    metadata: ClassVar[dict[str, Any]] = TabularEnv.metadata

    id: str
    make_mdp: Callable[..., TabularMDP]

    def __call__(self, *, render_mode: str | None = None, **kwargs: Any) -> TabularEnv:
        return TabularEnv(_build(self.id, self.make_mdp, kwargs), render_mode=render_mode)


@dataclass(frozen=True)
class _Vector:
    """Makes a `TabularVectorEnv`; `max_episode_steps` means what it means to `gymnasium.make`: -1 is no limit, None the
    registered one."""

    id: str
    make_mdp: Callable[..., TabularMDP]

    def __call__(
        self,
        *,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> TabularVectorEnv:
        limit = gymnasium.spec(self.id).max_episode_steps if max_episode_steps is None else max_episode_steps
        return TabularVectorEnv(
            _build(self.id, self.make_mdp, kwargs),
            num_envs,
            max_episode_steps=None if limit == -1 else limit,
            autoreset_mode=autoreset_mode,
            render_mode=render_mode,
        )


def _build(id: str, make_mdp: Callable[..., TabularMDP], kwargs: dict[str, Any]) -> TabularMDP:
    known = inspect.signature(make_mdp).parameters
    for name in kwargs:
        if name not in known:
            raise PgtsError(f"{id} has no argument {name!r}; it has {', '.join(known) or 'none'}")
    return make_mdp(**kwargs)


def _forms(id: str, make_mdp: Callable[..., TabularMDP]) -> tuple[_Single, _Vector]:
    return _Single(id, make_mdp), _Vector(id, make_mdp)


ladder, ladder_vector = _forms("pgts/Ladder-v0", zoo.ladder)
tightrope, tightrope_vector = _forms("pgts/Tightrope-v0", zoo.tightrope)
random_mdp, random_mdp_vector = _forms("pgts/Random-v0", zoo.random_mdp)
grid, grid_vector = _forms("pgts/Grid-v0", zoo.grid)
deep_sea, deep_sea_vector = _forms("pgts/DeepSea-v0", zoo.deep_sea)
combination_lock, combination_lock_vector = _forms("pgts/CombinationLock-v0", zoo.combination_lock)
river_swim, river_swim_vector = _forms("pgts/RiverSwim-v0", zoo.river_swim)
corridor, corridor_vector = _forms("pgts/Corridor-v0", zoo.corridor)
