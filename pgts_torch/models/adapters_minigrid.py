"""The adapter of MiniGrid and BabyAI (extra `envs`)."""

import marshal
from collections.abc import Callable
from operator import itemgetter
from typing import Any, final

from pgts_torch.models.minigrid_pickles import pickled, text_of, unpickled
from pgts_torch.models.minigrid_templates import GRID, MOVING, Compact, Layout, NotPlain, Things, kept, plain
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter

_SPACES_AND_RENDERING = (
    "observation_space action_space actions reward_range metadata spec window clock screen_size render_size "
    "render_mode highlight tile_size agent_pov _np_random _np_random_seed gen_obs"
)
NO_STATE = frozenset(_SPACES_AND_RENDERING.split())
"""Attributes that belong to no state."""


@final
class MiniGrid(SnapshotAdapter):
    """MiniGrid and BabyAI: every attribute but spaces, rendering and generator. The count of steps is among them.

    Where these are plain values, a grid and what lies in it, a snapshot has templates of the objects, and the values
    that no step has changed are read once. Otherwise (lists, instructions) all is pickled.

    Equal states may pickle to different bytes (a position is a tuple here and an array there, a colour is one string
    or two equal ones), so the key is another text: the values alone, in one order.

    Walls without a position of their own are all alike, and most of what a grid consists of: an environment that was
    given a state has one for each colour.
    """

    name = "MiniGrid"

    def __init__(self) -> None:
        # By the names of all attributes: what reads those of the state.
        self._layouts: dict[tuple[str, ...], Layout] = {}
        self._things = Things()

    def get_state(self, env: Any) -> Snapshot:
        try:
            return self._compact(env)
        except NotPlain:
            state = {name: value for name, value in vars(env).items() if name not in NO_STATE}
            return Snapshot(b"p" + text_of(state, env), pickled(state, env))

    def set_state(self, env: Any, data: Any) -> None:
        if isinstance(data, Compact):
            state, names = data.restored(self._things), data.layout.names
        else:
            state = unpickled(data, env)
            names = state.keys()
        held = vars(env)
        if self._layout(held).names != names:
            for name in held.keys() - names - NO_STATE:
                delattr(env, name)
        held.update(state)

    def _layout(self, held: dict[str, Any]) -> Layout:
        """How to read the attributes of an environment."""
        present = tuple(held)
        if (layout := self._layouts.get(present)) is None:
            layout = self._layouts[present] = Layout(held.keys() - NO_STATE)
        return layout

    def _compact(self, env: Any) -> Snapshot:
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
        texts = [template.text for template, _ in cells] + ([] if carries is None else [carries.text])
        data = Compact(layout, layout.values, kept(moving), type(grid), grid.width, grid.height, cells, carries)
        return Snapshot(b"".join((head, marshal.dumps(values, 2), *texts)), data)

    def skip_observations(self, env: Any) -> Callable[[], Any] | None:
        if not all(
            cls.__module__.split(".")[0] in ("minigrid", "gymnasium", "typing") for cls in type(env).__mro__[:-1]
        ):
            return None
        show = env.gen_obs
        env.gen_obs = lambda: None
        return show
