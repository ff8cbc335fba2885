"""The adapter of MiniGrid and BabyAI (extra `envs`)."""

import functools
import marshal
import weakref
from collections.abc import Callable
from operator import itemgetter
from types import SimpleNamespace
from typing import Any, final

from pgts_torch.models.minigrid_pickles import START, pickled, text_of, unpickled
from pgts_torch.models.minigrid_templates import COUNT, GRID, MOVING, Compact, Layout, NotPlain, Things, kept, plain
from pgts_torch.models.provenance import overridden
from pgts_torch.models.snapshots import Clock, Reading, Snapshot, SnapshotAdapter

_SPACES_AND_RENDERING = (
    "observation_space action_space actions reward_range metadata spec window clock screen_size render_size "
    "render_mode highlight tile_size agent_pov _np_random _np_random_seed gen_obs _reward"
)
NO_STATE = frozenset({*_SPACES_AND_RENDERING.split(), COUNT})
"""Attributes that belong to no state, and the clock."""


def _is_minigrids_own(env: Any) -> bool:
    """Whether all code of an environment is MiniGrid's: its steps read no object's place at the start, and its
    observations are functions of the state."""
    return _are_minigrids(type(env).__mro__)


@functools.cache
def _are_minigrids(classes: tuple[type, ...]) -> bool:
    return all(cls.__module__.split(".")[0] in ("minigrid", "gymnasium", "typing", "builtins") for cls in classes)


@final
class _Clock(Clock):
    """`step_count`: an episode is truncated at `max_steps`, and `_reward`, watched on this instance, pays by both."""

    name = COUNT

    def __init__(self, env: Any) -> None:
        self._env, self._formula, self._paid = weakref.proxy(env), type(env)._reward, list[float]()
        env._reward = self._pay

    def _pay(self) -> float:
        self._paid.append(self._formula(self._env))
        return self._paid[-1]

    def reading(self, reward: Any, truncated: bool) -> Reading | None:
        paid, self._paid = self._paid, []
        limit = self._env.max_steps
        # A reward that was made from that of the clock is another one, and has another formula.
        known = not paid or (len(paid) == 1 and reward is paid[0])
        return Reading(limit, bool(paid)) if known and truncated == (self._env.step_count >= limit) else None

    def reward(self, reading: Reading, count: int) -> float:
        return self._formula(SimpleNamespace(step_count=count, max_steps=reading.limit))

    def at(self, snapshot: Snapshot, count: int) -> Snapshot:
        return Snapshot(snapshot.key, (snapshot.data[0], count), clock=count)


@final
class MiniGrid(SnapshotAdapter):
    """MiniGrid and BabyAI: every attribute but spaces, rendering and generator. The count of steps is kept apart.

    Where these are plain values, a grid and what lies in it, a snapshot has templates of the objects, and the values
    that no step has changed are read once. Otherwise (lists, instructions) all is pickled.

    Equal states may pickle to different bytes (a position is a tuple here and an array there, a colour is one string
    or two equal ones), so the key is another text: the values alone, in one order. Where objects lay at the start is
    no part of it in MiniGrid's own environments, which never read that again.

    Walls without a position of their own are all alike, and most of what a grid consists of: an environment that was
    given a state has one for each colour.
    """

    name = "MiniGrid"

    def __init__(self) -> None:
        # By the names of all attributes: what reads those of the state.
        self._layouts: dict[tuple[str, ...], Layout] = {}
        self._things = Things()

    def get_state(self, env: Any) -> Snapshot:
        count = int(env.step_count)
        try:
            key, data = self._compact(env)
            return Snapshot(key, (data, count), clock=count)
        except NotPlain:
            state = {name: value for name, value in vars(env).items() if name not in NO_STATE}
            starts = {START} if _is_minigrids_own(env) else set[str]()
            return Snapshot(b"p" + text_of(state, env, but=starts), (pickled(state, env), count), clock=count)

    def set_state(self, env: Any, data: Any) -> None:
        content, count = data
        if isinstance(content, Compact):
            state, names = content.restored(self._things), content.layout.names
        else:
            state = unpickled(content, env)
            names = state.keys() | {COUNT}
        held = vars(env)
        if self._layout(held).names != names:
            for name in held.keys() - names - NO_STATE:
                delattr(env, name)
        held.update(state)
        env.step_count = count

    def _layout(self, held: dict[str, Any]) -> Layout:
        """How to read the attributes of an environment."""
        present = tuple(held)
        if (layout := self._layouts.get(present)) is None:
            layout = self._layouts[present] = Layout(held.keys() - NO_STATE)
        return layout

    def _compact(self, env: Any) -> tuple[bytes, Compact]:
        """The key of a state of plain values, and what restores it."""
        held = vars(env)
        layout = self._layout(held)
        head = layout.head(held)
        grid, carried = held["grid"], held["carrying"]
        if vars(grid).keys() != GRID:
            raise NotPlain
        moving = itemgetter(*MOVING)(held)
        cells = self._things.cells(grid.grid, carried)
        carries = None if carried is None else self._things.template(carried)
        values = plain(moving), grid.width, grid.height, carried is not None, *[where for _, where in cells]
        things = [template for template, _ in cells] + ([] if carries is None else [carries])
        if not _is_minigrids_own(env):
            values += tuple(thing.starts for thing in things)
        data = Compact(layout, layout.values, kept(moving), type(grid), grid.width, grid.height, cells, carries)
        return b"".join((head, marshal.dumps(values, 2), *[thing.text for thing in things])), data

    def skip_observations(self, env: Any) -> Callable[[], Any] | None:
        if not _is_minigrids_own(env):
            return None
        show = env.gen_obs
        env.gen_obs = lambda: None
        return show

    def clock(self, env: Any) -> Clock | None:
        family = next(cls for cls in type(env).__mro__ if cls.__name__ == "MiniGridEnv")
        return None if overridden(env, family, ("_reward",)) else _Clock(env)
