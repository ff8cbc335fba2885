"""Trainings without replay whose episodes go on from one iteration to the next, as those of A2C and PPO do."""

from typing import Any

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.agent.callbacks import EvalCallback
from pgts_torch.agent.ongoing import OngoingEpisodes
from pgts_torch.errors import PgtsError
from pgts_torch.options import PPO, Gradient, StepsHorizon
from pgts_torch.seeding import stream
from tests.models.corridors import Corridor

FIVE: dict[str, Any] = {
    "depth": 0,
    "estimator": "sampled",
    "policy": {"type": "mlp", "hidden": [8]},
    "horizon": StepsHorizon(length=5),
    "seed": 3,
}
ENVS: dict[str, dict[str, Any]] = {
    "CartPole-v1": {"num_envs": 4, "update": "gradient"},
    "many CartPoles": {"env": "CartPole-v1", "num_envs": 40},
    "FrozenLake-v1": {"num_envs": 2, "update": PPO(num_epochs=2, minibatch_size=4)},
    "pgts/Ladder-v0": {"num_envs": 1, "update": Gradient(state_weight="uniform")},
    "Corridor": {"env": Corridor, "num_envs": 3, "horizon": StepsHorizon(length=5, max_length=7)},
}


def made(name: str) -> PGTS:
    return PGTS(**{"env": name} | FIVE | ENVS[name])


@pytest.mark.parametrize("name", ENVS)
def test_a_training_goes_on_in_the_middle_of_its_episodes_bit_for_bit(name, tmp_path):
    whole, half = made(name), made(name)
    for _ in range(9):
        whole.iterate()
    for _ in range(4):
        half.iterate()
    half.save(tmp_path / "half.pt")
    rest = PGTS.load(tmp_path / "half.pt", env=ENVS[name].get("env") if name == "Corridor" else None)
    for _ in range(5):
        last = rest.iterate()
    assert rest.num_env_steps == whole.num_env_steps == 9 * 5 * ENVS[name]["num_envs"]
    assert not bool(last.experience.begins_B.all())
    for part in ("policy", "critic"):
        one, other = (getattr(each, part).state_dict() for each in (rest, whole))
        assert torch.equal(*(torch.cat([x.flatten() for x in _tensors(each)]) for each in (one, other)))


def _tensors(state: Any) -> list[torch.Tensor]:
    if isinstance(state, dict):
        return [each for name in sorted(state) for each in _tensors(state[name])]
    return [state.double()] if isinstance(state, torch.Tensor) else []


def test_short_rollouts_have_the_steps_of_a_long_one():
    model = made("CartPole-v1")
    found = []
    for lengths in ((40,), (5, 20, 1, 14)):
        episodes, generator = OngoingEpisodes(model.world, max_length=30, seed=0, names=()), stream(0, "test")
        parts = [episodes.collect(model.policy, length, names=("test",), generator=generator) for length in lengths]
        found.append(torch.cat([each.observation_V for each in parts]).sort(0).values)
        ended = [each for part in parts for each in part.finished]
        found.append(torch.tensor(sorted(ended)))
    assert torch.equal(found[0], found[2])
    assert torch.equal(found[1], found[3])
    assert len(found[1]) > 4


def test_evaluations_leave_the_episodes_alone():
    plain, evaluated = made("CartPole-v1"), made("CartPole-v1")
    plain.learn(200)
    evaluated.learn(200, callback=EvalCallback(every=1, episodes=2))
    assert torch.equal(*(each.policy.network.head.weight for each in (plain, evaluated)))


def test_weights_that_need_episodes_from_their_start_are_refused():
    occupancy = {"type": "gradient", "state_weight": "occupancy"}
    with pytest.raises(PgtsError, match=r"update\.state_weight is occupancy, and horizon\.type is steps"):
        PGTS(**FIVE | {"env": "CartPole-v1", "update": occupancy})
    assert PGTS(**FIVE | {"env": "CartPole-v1", "update": occupancy, "horizon": "fixed"}).horizon.type == "fixed"


def test_the_first_iteration_is_as_long_as_the_others_unless_there_is_a_replay():
    assert made("CartPole-v1").horizon.first is None
    assert PGTS("CartPole-v1", replay="uniform", depth=0).horizon.first == 500
    first = made("CartPole-v1").options.rollout.horizon.model_copy(update={"first": 8})
    model = PGTS(**FIVE | {"env": "CartPole-v1", "num_envs": 2, "horizon": first})
    assert [model.iterate().num_steps for _ in range(3)] == [16, 10, 10]
