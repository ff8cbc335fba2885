"""Environments of ALE, MuJoCo and Box2D: which are restored, and which have a state beside their family's snapshots."""

from typing import Any

import gymnasium
import pytest
from gymnasium.envs.registration import load_env_creator

from pgts_torch import PGTS
from pgts_torch.agent.world import World
from pgts_torch.agent.worlds import SimulatedWorld
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models.adapters_extra import Ale, Mujoco
from tests.agent.cells import agrees, world_of

NAMES = ["Pong", "InvertedPendulum", "Reacher", "Pusher"]


def family(name: str) -> Any:
    """The class of Pong, or one of MuJoCo's; without the extra the test is skipped."""
    pytest.importorskip("ale_py" if name == "Pong" else "mujoco", exc_type=ImportError)
    return load_env_creator("ale_py.env:AtariEnv" if name == "Pong" else gymnasium.spec(f"{name}-v5").entry_point)


def world(name: str, kind: Any) -> World:
    """Of one copy of a class of this family."""
    if name != "Pong":
        return world_of(kind, num_envs=1, actions_per_dimension=2)
    return world_of(lambda: kind("pong", obs_type="ram", repeat_action_probability=0.0), num_envs=1)


def tiring(name: str) -> Any:
    """One that pays less with every step."""

    class Tiring(family(name)):  # type: ignore[misc]
        taken = 0

        def step(self, action: Any) -> Any:
            self.taken += 1
            observation, reward, *rest = super().step(action)
            return observation, reward - self.taken, *rest

    return Tiring


@pytest.mark.parametrize("name", NAMES)
def test_a_subclass_without_a_state_of_its_own_is_restored(name):
    class Halved(family(name)):  # type: ignore[misc]
        def step(self, action: Any) -> Any:
            observation, reward, *rest = super().step(action)
            return observation, reward / 2, *rest

    made = world(name, Halved)
    assert isinstance(made, SimulatedWorld)
    assert agrees(made, [0, 1, 1, 0, 1])


@pytest.mark.fault("a subclass with a state of its own beside the snapshots of its family")
@pytest.mark.parametrize("name", NAMES)
def test_a_subclass_with_a_state_of_its_own_needs_two_methods(name):
    kind = tiring(name)
    with pytest.raises(PgtsError, match=r"taken changes in its steps or resets and is in no snapshot of ") as refusal:
        world(name, kind)
    told = "calls of the present set_state(qpos, qvel) must go on to super()"
    assert (told in str(refusal.value)) == (name != "Pong")

    class Honest(kind):
        """Its state is that of its family, and what it counts."""

        snapshots = Ale() if name == "Pong" else Mujoco()

        def get_state(self) -> Any:
            return self.snapshots.get_state(self).data, self.taken

        def set_state(self, state: Any, *velocities: Any) -> None:
            if velocities:  # a call of MuJoCo's reset
                return super().set_state(state, *velocities)
            self.snapshots.set_state(self, state[0])
            self.taken = state[1]

    assert agrees(world(name, Honest), [0, 1, 1, 0, 1])


def test_bodies_that_change_their_weight_are_in_no_snapshot():
    class Anybody(family("Reacher")):  # type: ignore[misc]
        def reset_model(self) -> Any:
            self.model.body_mass[1] = self.np_random.uniform(0.01, 0.1)
            return super().reset_model()

    with pytest.raises(PgtsError, match="model changes in its steps or resets and is in no snapshot of MuJoCo"):
        world("Reacher", Anybody)


def test_emulators_whose_actions_stick_are_refused():
    kind = family("Pong")
    with pytest.raises(PgtsError, match=r"make it with repeat_action_probability=0"):
        world_of(lambda: kind("pong", obs_type="ram", repeat_action_probability=0.25), num_envs=1)


def test_box2d_cannot_be_restored_and_is_learned_from_its_steps():
    pytest.importorskip("Box2D", exc_type=ImportError)
    with pytest.raises(MissingModel, match=r"LunarLander-v3 cannot be restored: .*model 'ensemble' where"):
        PGTS("LunarLander-v3", depth=1, num_envs=2)
    few = {"replay": {"updates_per_step": 0.05, "starts": 4, "length": 5}, "policy": {"hidden": [8]}}
    model = {"type": "ensemble", "members": 2, "hidden": [16], "first_updates": 20}
    training = PGTS("LunarLander-v3", depth=1, model=model, horizon={"type": "steps", "length": 20, "first": 40}, **few)
    assert all(training.iterate().model_calls > 0 for _ in range(3))
