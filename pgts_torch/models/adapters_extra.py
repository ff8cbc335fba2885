"""Adapters of the simulators that come as extras: MiniGrid (extra `envs`), ALE (`atari`) and MuJoCo (`mujoco`)."""

import copyreg
import enum
import io
import marshal
import pickle
from collections.abc import Callable
from typing import Any, final

import numpy as np

from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter

_SPACES_AND_RENDERING = (
    "observation_space action_space actions reward_range metadata spec window clock screen_size render_size "
    "render_mode highlight tile_size agent_pov _np_random _np_random_seed gen_obs"
)
_NO_STATE_OF_MINIGRID = frozenset(_SPACES_AND_RENDERING.split())


@final
class MiniGrid(SnapshotAdapter):
    """MiniGrid and BabyAI: every attribute but spaces, rendering and generator, pickled.

    Equal states may pickle to different bytes (a position is a tuple here and an array there, a colour is one string
    or two equal ones), so the key is another text: the values alone, in one order. The count of steps is in it.

    Walls without a position of their own are all alike, and most of what a grid consists of: an environment that was
    given a state has one for each colour.
    """

    name = "MiniGrid"

    def get_state(self, env: Any) -> Snapshot:
        state = {name: value for name, value in vars(env).items() if name not in _NO_STATE_OF_MINIGRID}
        parts: list[Any] = []
        _spell(state, parts, {id(env): 0})
        return Snapshot(marshal.dumps(parts, 2), _pickled(state, env))

    def set_state(self, env: Any, data: Any) -> None:
        state = _Unpickler(data, env).load()
        for name in vars(env).keys() - state.keys() - _NO_STATE_OF_MINIGRID:
            delattr(env, name)
        vars(env).update(state)
        # One object for neighbouring walls that are alike; see the class.
        cells, wall = env.grid.grid, None
        for i, cell in enumerate(cells):
            if cell is not None and cell is not wall and _is_plain_wall(cell):
                if wall is not None and wall.color == cell.color:
                    cells[i] = wall
                else:
                    wall = cell

    def skip_observations(self, env: Any) -> Callable[[], Any] | None:
        if not all(
            cls.__module__.split(".")[0] in ("minigrid", "gymnasium", "typing") for cls in type(env).__mro__[:-1]
        ):
            return None
        show = env.gen_obs
        env.gen_obs = lambda: None
        return show


def _is_plain_wall(value: Any) -> bool:
    kind = type(value)
    if kind.__qualname__ != "Wall" or kind.__module__ != "minigrid.core.world_object":
        return False
    plain = {"type": "wall", "color": value.color, "contains": None, "init_pos": None, "cur_pos": None}
    return vars(value) == plain


_PLAIN = frozenset({type(None), bool, int, float, str, bytes})


def _spell(value: Any, parts: list[Any], seen: dict[int, int]) -> None:
    """Append what a value consists of, in plain values and one order; an object that was met before by when that was.

    Each part that has parts begins with its kind and their number, so that different values are spelled differently.
    """
    kind = type(value)
    if kind in _PLAIN:
        parts.append(value)
    elif kind is tuple or kind is list:
        parts += ("(", len(value))
        # Most of a grid is one wall, the same object again and again: it is looked into once.
        wall = None
        for item in value:
            if type(item) in _PLAIN:
                parts.append(item)
            elif item is wall:
                parts.append(("wall", wall.color))
            elif _is_plain_wall(item):
                wall = item
                parts.append(("wall", wall.color))
            else:
                _spell(item, parts, seen)
    elif kind is np.ndarray:
        _spell(value.tolist(), parts, seen)
    elif isinstance(value, np.generic):
        parts.append(value.item())
    elif isinstance(value, enum.Enum) or callable(value):
        parts.append(repr(value))
    elif isinstance(value, set | frozenset):
        _spell(sorted(value, key=repr), parts, seen)
    elif kind is dict:
        parts += ("{", len(value))
        for name in sorted(value, key=repr):
            _spell(name, parts, seen)
            _spell(value[name], parts, seen)
    # Objects that were met before: what they consist of is spelled already, and may lead back to themselves.
    elif id(value) in seen:
        parts += ("=", seen[id(value)])
    else:
        seen[id(value)] = len(seen)
        content = vars(value)
        parts += (kind.__qualname__, len(content))
        for name, item in content.items():
            parts.append(name)
            if type(item) in _PLAIN:
                parts.append(item)
            else:
                _spell(item, parts, seen)


def _environment() -> Any:
    """Stands in a pickle for the environment itself, which is not copied."""
    raise AssertionError


def _pickled(state: dict[str, Any], env: Any) -> bytes:
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer, protocol=5)
    pickler.dispatch_table = copyreg.dispatch_table | {type(env): lambda _: (_environment, ())}
    pickler.dump(state)
    return buffer.getvalue()


class _Unpickler(pickle.Unpickler):
    """Puts the environment where `_environment` stands."""

    def __init__(self, data: bytes, env: Any) -> None:
        super().__init__(io.BytesIO(data))
        self._env = env

    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name)
        return (lambda: self._env) if found is _environment else found


@final
class Ale(SnapshotAdapter):
    """Atari: the serialised emulator. Its frame numbers are in it.

    What is serialised lacks the action that was taken last. Where actions stick, that decides what follows, so an
    emulator whose actions stick cannot be restored, not even with its generator.
    """

    name = "ALE"
    restored = frozenset({"ale"})

    def get_state(self, env: Any) -> Snapshot:
        key = env.ale.cloneState(include_rng=False).serialize()
        return Snapshot(key, key)

    def set_state(self, env: Any, data: Any) -> None:
        from ale_py import ALEState

        env.ale.restoreState(ALEState(data))

    def is_random(self, env: Any, action: Any) -> bool | None:
        return not isinstance(env._frameskip, int)

    def obstacle(self, env: Any) -> str:
        share = env.ale.getFloat("repeat_action_probability")
        if share == 0:
            return ""
        return (
            f"actions stick with probability {share:g}, and ALE's state lacks the action that sticks; make the model "
            "with repeat_action_probability=0"
        )


_LEFT_BEHIND = (
    "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat cam_xpos cam_xmat light_xpos "
    "light_xdir subtree_com cdof cinert ten_length actuator_length crb cvel cdof_dot ten_velocity actuator_velocity "
    "subtree_linvel subtree_angmom qfrc_bias qfrc_passive qfrc_actuator actuator_force qfrc_smooth qacc_smooth "
    "qfrc_constraint qfrc_inverse cacc cfrc_int cfrc_ext qacc sensordata energy"
)
"""What a step of the physics computes on the way, and leaves behind in arrays whose size never changes."""


@final
class Mujoco(SnapshotAdapter):
    """MuJoCo: its integration state, which decides what the physics does next, and what the last step left behind,
    from which environments read where the bodies were.

    Reacher and Pusher keep beside it what their reset drew, which the positions hold too."""

    name = "MuJoCo"
    restored = frozenset({"data", "mujoco_renderer", "goal", "goal_pos", "cylinder_pos", "init_qpos"})

    def get_state(self, env: Any) -> Snapshot:
        import mujoco

        integration = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(env.model, integration))
        mujoco.mj_getState(env.model, env.data, state, integration)
        key = np.concatenate([state, *[getattr(env.data, name).reshape(-1) for name in _LEFT_BEHIND.split()]]).tobytes()
        return Snapshot(key, key)

    def set_state(self, env: Any, data: Any) -> None:
        import mujoco

        integration = mujoco.mjtState.mjSTATE_INTEGRATION
        state, position = np.frombuffer(data), mujoco.mj_stateSize(env.model, integration)
        mujoco.mj_setState(env.model, env.data, state[:position], integration)
        for name in _LEFT_BEHIND.split():
            array = getattr(env.data, name)
            array[...] = state[position : position + array.size].reshape(array.shape)
            position += array.size

    def same_world(self, env: Any, own: Any) -> bool:
        return type(env) is type(own) and env.fullpath == own.fullpath and env.frame_skip == own.frame_skip
