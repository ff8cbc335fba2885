"""Adapters of the emulators that come as extras: ALE (`atari`) and MuJoCo (`mujoco`)."""

from typing import Any, final

import numpy as np

from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter, of_key


@final
class Ale(SnapshotAdapter):
    """Atari: the serialised emulator. Its frame numbers are in it.

    What is serialised lacks the action that was taken last. Where actions stick, that decides what follows, so an
    emulator whose actions stick cannot be restored, not even with its generator.
    """

    name = "ALE"
    restored = frozenset({"ale"})

    def get_state(self, env: Any) -> Snapshot:
        return of_key(env.ale.cloneState(include_rng=False).serialize())

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
            f"actions stick with probability {share:g}, and ALE's state lacks the action that sticks; make it with "
            "repeat_action_probability=0, and if they are to stick wrap it in gymnasium.wrappers.StickyAction"
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

    name, is_plain = "MuJoCo", True
    restored = frozenset({"data", "mujoco_renderer", "goal", "goal_pos", "cylinder_pos", "init_qpos"})

    def __init__(self) -> None:
        # The data whose arrays were last looked up, which takes longer than a step of a small system; and these.
        self._of: Any = None
        self._arrays: list[np.ndarray] = []

    def get_state(self, env: Any) -> Snapshot:
        import mujoco

        state, *left_behind = self._flat(env)
        mujoco.mj_getState(env.model, env.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        return of_key(np.concatenate([state, *left_behind]).tobytes())

    def set_state(self, env: Any, data: Any) -> None:
        import mujoco

        (state, *left_behind), saved = self._flat(env), np.frombuffer(data)
        position = len(state)
        mujoco.mj_setState(env.model, env.data, saved[:position], mujoco.mjtState.mjSTATE_INTEGRATION)
        for array in left_behind:
            array[:] = saved[position : (position := position + len(array))]

    def _flat(self, env: Any) -> list[np.ndarray]:
        """Room for the integration state, and what the last step left behind, in the memory of the emulator."""
        import mujoco

        if self._of is not env.data:
            size = mujoco.mj_stateSize(env.model, mujoco.mjtState.mjSTATE_INTEGRATION)
            left_behind = [getattr(env.data, name).reshape(-1) for name in _LEFT_BEHIND.split()]
            self._of, self._arrays = env.data, [np.empty(size), *[x for x in left_behind if len(x)]]
        return self._arrays

    def same_world(self, env: Any, own: Any) -> bool:
        return type(env) is type(own) and env.fullpath == own.fullpath and env.frame_skip == own.frame_skip
