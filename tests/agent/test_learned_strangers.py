"""Replay and learned models in environments of every form."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from pgts_torch import PGTS
from pgts_torch.agent.draws import Draws
from pgts_torch.config import load
from pgts_torch.errors import Failed, MemoryBudgetExceeded, PgtsError
from pgts_torch.experiment.run import train
from pgts_torch.models.base import LearningModel
from pgts_torch.models.ensemble import EnsembleModel
from pgts_torch.models.replay import ReplayBuffer
from pgts_torch.models.tabular import TabularModel
from pgts_torch.models.tensor import TensorModel
from pgts_torch.options import MLP, Ensemble, StepsHorizon, UniformReplay
from pgts_torch.tabular import exact
from tests.agent.helpers import vector_env
from tests.support import zoo

REPLAY = UniformReplay(updates_per_step=0.1, starts=4, length=5)
ONGOING = {"depth": 1, "replay": REPLAY, "horizon": StepsHorizon(length=33, first=50)}
ENSEMBLE = ONGOING | {"model": Ensemble(members=2, hidden=[16], first_updates=20), "policy": MLP(hidden=[16])}


class Drift(gymnasium.Env):
    """A number that actions move; it can be restored from its state."""

    observation_space: spaces.Space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Discrete(2)
    fails = False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = float(self.np_random.normal())
        self.count = 0
        return np.array([self.position]), {}

    def step(self, action):
        if self.fails and self.count == 3:
            raise RuntimeError("broken")
        self.position, self.count = self.position + 0.3 * action - 0.1, self.count + 1
        return np.array([self.position]), self.position, abs(self.position) > 2, False, {}

    def get_state(self):
        return self.position, self.count

    def set_state(self, state):
        self.position, self.count = state


class Truncated(Drift):
    """Truncates its episodes itself after six steps."""

    def step(self, action):
        seen, reward, *_ = super().step(action)
        return seen, reward, False, self.count == 6, {}


class NoisyReward(Drift):
    def step(self, action):
        seen, reward, *rest = super().step(action)
        return seen, reward + np.random.normal(), *rest  # noqa: NPY002


class Corridor(gymnasium.Env):
    """Five cells counted from 3 on, in a dictionary if `key` is given."""

    action_space = spaces.Discrete(2)

    def __init__(self, key=None):
        self.key, cells = key, spaces.Discrete(5, start=3)
        self.observation_space = cells if key is None else spaces.Dict({key: cells})

    def seen(self):
        return self.cell if self.key is None else {self.key: self.cell}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 3
        return self.seen(), {}

    def step(self, action):
        self.cell = min(max(self.cell + 2 * action - 1, 3), 7)
        return self.seen(), float(self.cell == 7), self.cell == 7, False, {}


def test_a_row_in_which_an_episode_goes_on_is_no_start():
    for critic in ("tabular", "exact"):
        PGTS("pgts/Ladder-v0", critic=critic, **ONGOING).learn(100)  # would contradict the starts of the table
    training = PGTS(Drift, **ENSEMBLE)
    rollouts = [training.iterate().experience for _ in range(4)]
    begun = sum(int(rollout.begins_B.sum()) for rollout in rollouts)
    under_way = [actions for actions in training.episodes.state_dict()["actions"] if len(actions)]
    assert begun == sum(len(rollout.finished) for rollout in rollouts) + len(under_way)
    assert begun < sum(rollout.num_episodes for rollout in rollouts)


def test_a_certificate_with_replay_is_true():
    mdp = zoo("ladder")
    training = PGTS("pgts/Ladder-v0", critic="exact", stop_at=0.2, **ONGOING)
    best = exact.optimal(mdp).J
    assert best - exact.evaluate(mdp, training.policy_table()).J > 0.2
    iterations = []
    training.learn(5000, callback=lambda _, iteration: iterations.append(iteration))
    assert training.certificates.trust == "proved"
    assert iterations[-1].is_enough
    assert best - exact.evaluate(mdp, training.policy_table()).J <= iterations[-1].certificate <= 0.2


def test_snapshots_are_replayed_and_not_saved(tmp_path):
    training = PGTS(Drift, **ONGOING, policy=MLP(hidden=[16]))
    visited = training.iterate().experience.observation_V
    draws = Draws.of(training.ranks, 0, 1, training.device)
    imagined, _ = next(training.dyna.rollouts(draws))
    assert torch.isin(imagined.observation_UB[0], visited).all()
    steps = imagined.steps()
    moved = 0.3 * steps.action_N[:, None] - 0.1
    torch.testing.assert_close(
        steps.next_observation_N[steps.discount_N > 0], (steps.observation_N + moved)[steps.discount_N > 0]
    )
    with pytest.raises(PgtsError, match=r"replay keeps snapshots of Drift.* cannot be saved"):
        training.save(tmp_path / "model.pt")


def test_imagined_episodes_end_where_the_environment_truncates_them():
    training = PGTS(Truncated, **ONGOING, policy=MLP(hidden=[16])).learn(120)
    draws = Draws.of(training.ranks, 0, 9, training.device)
    imagined, _ = next(training.dyna.rollouts(draws))
    assert not training.world.model.is_cut(imagined.state_TB[imagined.alive_TB]).any()
    last_B = imagined.alive_TB.sum(0)
    ends = imagined.state_UB[last_B, torch.arange(imagined.num_episodes)]
    is_cut_B = training.world.model.is_cut(ends)
    assert is_cut_B.any()
    assert (is_cut_B | (last_B == REPLAY.length)).all()
    assert (imagined.discount_TB[imagined.alive_TB] == training.gamma).all()  # truncation is no end


class Forbids(TensorModel):
    def __init__(self):
        super().__init__(1, 2)

    def step(self, state_ND, action_N):
        forbidden_N = torch.where(action_N == 1, -torch.inf, 0.0)
        return forbidden_N, torch.full_like(forbidden_N, 0.9), state_ND


def test_imagined_episodes_need_all_actions():
    with pytest.raises(PgtsError, match="Forbids does not allow action 1 in state"):
        PGTS(Drift, **ONGOING, model=Forbids()).iterate()


def test_a_run_that_could_not_be_saved_does_not_begin(tmp_path):
    pytest.importorskip("minigrid")
    arguments = ["--env.id", "MiniGrid-Empty-5x5-v0", "--env.observation_keys", "[image]", "--replay.type", "uniform"]
    config = load(None, [*arguments, "--run.dir", str(tmp_path / "run")])
    with pytest.raises(PgtsError, match="cannot be saved"):
        train(config)
    assert not (tmp_path / "run").exists()


def test_a_capacity_that_no_memory_holds_is_refused():
    with pytest.raises(MemoryBudgetExceeded, match="10,000,000,000,000; so many rows take 80,000,000,000,000 bytes"):
        PGTS("pgts/Ladder-v0", replay=UniformReplay(capacity=10**13))
    with pytest.raises(MemoryBudgetExceeded, match="set a smaller one"):
        EnsembleModel(4, 2, gamma=0.9, capacity=10**13)
    buffer = ReplayBuffer(10**12)
    with pytest.raises(MemoryBudgetExceeded):
        buffer.add(state=[b"x" * 100])
    assert len(buffer) == 0


@pytest.mark.parametrize("capacity", [1, 32])
def test_a_capacity_of_which_all_may_be_held_out_is_refused(capacity):
    with pytest.raises(PgtsError, match=f"capacity is {capacity}; .* more than 32 steps"):
        PGTS("CartPole-v1", model="ensemble", replay=UniformReplay(capacity=capacity))


def test_a_capacity_of_one_block_and_a_step_is_enough():
    model = PGTS("CartPole-v1", **ENSEMBLE | {"replay": REPLAY.model_copy(update={"capacity": 33})}).learn(150)
    assert model.num_env_steps >= 150


@pytest.mark.parametrize("wrapper", [gymnasium.wrappers.NormalizeObservation, gymnasium.wrappers.NormalizeReward])
def test_wrappers_with_a_memory_are_refused_with_a_learned_model_too(wrapper):
    with pytest.raises(PgtsError, match=f"{wrapper.__name__}, whose running statistics"):
        PGTS(lambda: wrapper(Drift()), **ENSEMBLE)


def test_the_discount_is_that_of_the_environment():
    assert PGTS("pgts/Ladder-v0", model="counts").gamma == PGTS("pgts/Ladder-v0").gamma == 0.9
    with pytest.raises(PgtsError, match=r"gamma is 0\.5; the environment has its own"):
        PGTS(vector_env(zoo("ladder"), 1), model="counts", gamma=0.5)


def test_states_may_be_counted_from_any_number():
    training = PGTS(Corridor, depth=4, model="counts", replay=REPLAY, horizon=StepsHorizon(length=30)).learn(100)
    assert training.policy_table().shape == (5, 2)
    assert training.policy_table()[:4].argmax(-1).tolist() == [1] * 4
    assert training.predict(3) == 1
    with pytest.raises(PgtsError, match="state 8 does not exist; states are 3 to 7"):
        training.predict(8)
    inside = PGTS(lambda: Corridor("cell"), depth=4, model="counts", replay=REPLAY, horizon=StepsHorizon(length=30))
    assert torch.equal(inside.learn(100).policy_table(), training.policy_table())
    PGTS(lambda: Corridor("cell"), **ONGOING, model="counts", policy="mlp", observation_keys=["cell"]).learn(100)


def test_a_model_that_would_never_learn_is_refused():
    with pytest.raises(PgtsError, match=r"replay\.type is none; model\.type ensemble learns"):
        PGTS("CartPole-v1", model="ensemble", replay="none")

    class Own(TabularModel, LearningModel):
        def learn(self, experience, *, generator):
            return {}

        def state_dict(self):
            return {}

        def load_state_dict(self, state):
            pass

    with pytest.raises(PgtsError, match="Own learns from steps, which needs replay"):
        PGTS("pgts/Ladder-v0", model=Own(zoo("ladder")))


def test_an_episode_whose_rewards_are_not_repeated_is_noticed(tmp_path):
    with pytest.warns(UserWarning, match="the whole process shares"):
        training = PGTS(NoisyReward, **ENSEMBLE).learn(50)
    assert len(training.episodes.state_dict()["actions"][0])
    training.save(tmp_path / "model.pt")
    with (
        pytest.warns(UserWarning, match="the whole process shares"),
        pytest.raises(PgtsError, match="does not repeat its episode"),
    ):
        PGTS.load(tmp_path / "model.pt", env=NoisyReward)


def test_after_a_failure_episodes_begin_again(tmp_path):
    training = PGTS(Drift, **ENSEMBLE, num_envs=2)
    for env in training.world.env.envs:
        env.unwrapped.fails = True
    with pytest.raises(Failed, match="broken"):
        training.iterate()
    for env in training.world.env.envs:
        env.unwrapped.fails = False
    assert training.learn(100).num_env_steps == 100
    training.save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt", env=Drift)
    assert loaded.iterate().losses == training.iterate().losses
