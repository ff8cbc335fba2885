"""What an agent can be given to act in: ids, instances, functions; continuous actions, divided."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from pgts_torch import PGTS
from pgts_torch.agent.callbacks import EvalCallback
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.world import ModelWorld
from pgts_torch.agent.worlds import DynamicsWorld, SimulatedWorld, TabularWorld
from pgts_torch.errors import PgtsError
from pgts_torch.models import check_model
from pgts_torch.models.environments import EnvSource
from tests.agent.helpers import same_bits
from tests.models.corridors import Corridor

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

SHORT = {"depth": 1, "num_envs": 2, "horizon": {"type": "fixed", "length": 5}, "seed": 3}


class Field(gymnasium.Env):
    """A point in the plane, moved by two continuous actions; the reward is its nearness to (1, 1)."""

    observation_space = spaces.Box(-100, 100, (2,), np.float64)
    action_space = spaces.Box(np.array([-1, -2], np.float32), np.array([1, 2], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = np.zeros(2)
        return self.place, {}

    def step(self, action):
        assert action in self.action_space
        self.place = self.place + action
        return self.place, -float(np.abs(self.place - 1).sum()), False, False, {}

    def get_state(self):
        return self.place.tobytes()

    def set_state(self, state):
        self.place = np.frombuffer(state)


def pendulum(**kwargs) -> PGTS:
    return PGTS("Pendulum-v1", **SHORT | {"actions_per_dimension": 5} | kwargs)


def test_pendulum_is_trained_evaluated_saved_and_used_with_one_option(tmp_path):
    model = pendulum()
    assert isinstance(model.world, DynamicsWorld)
    assert model.iterate().look.q_BA.shape[-1] == 5
    callback = EvalCallback(every=1, episodes=2, best_path=tmp_path / "best.pt")
    model.learn(30, callback=callback)
    assert callback.history[-1].evaluation.episodic_length.mean == 200
    loaded = PGTS.load(tmp_path / "best.pt")
    env = gymnasium.make("Pendulum-v1")
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        action = loaded.predict(observation)
        assert action in env.action_space
        observation, *_ = env.step(action)


def test_predicted_actions_are_those_of_the_grid_over_the_space():
    model = PGTS(Field, **SHORT, actions_per_dimension=3)
    assert isinstance(model.world, SimulatedWorld)
    grid = [[x, y] for x in (-1, 0, 1) for y in (-2, 0, 2)]
    assert model.world.model.num_actions == 9
    seen = set()
    for action in model.predict(np.zeros((400, 2)), deterministic=False):
        assert action in Field.action_space
        seen.add(tuple(action.tolist()))
    assert seen == {tuple(map(float, point)) for point in grid}
    assert model.predict(np.zeros((4, 3, 2))).shape == (4, 3, 2)
    assert model.predict(np.zeros(2)).shape == (2,)


def test_what_the_model_answers_is_what_the_divided_environment_does():
    model = PGTS(Field, **SHORT, actions_per_dimension=3)
    seen = model.iterate().experience
    place_TBD = model.world.observe(seen.next_state_TB.reshape(-1)).view(*seen.state_TB.shape, 2)
    assert torch.equal(place_TBD, seen.observation_UB[1:])
    grid_AD = torch.tensor([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-2.0, 0.0, 2.0)], dtype=torch.float64)
    torch.testing.assert_close(place_TBD, grid_AD[seen.action_TB].cumsum(0))


@pytest.mark.parametrize(
    ("env", "kind"),
    [("FrozenLake-v1", TabularWorld), ("CartPole-v1", DynamicsWorld), ("pgts/Ladder-v0", TabularWorld)],
)
def test_an_id_an_instance_a_spec_and_a_function_are_the_same_environment(env, kind):
    instance = gymnasium.make(env)
    forms = [env, instance, instance.spec, lambda: gymnasium.make(env, max_episode_steps=-1)]
    models = [PGTS(form, **SHORT) for form in forms]
    assert all(isinstance(model.world, kind) for model in models)
    first, *others = [model.iterate().experience for model in models]
    if env != "pgts/Ladder-v0":  # those that step together draw their starts together
        assert all(same_bits(first, other) for other in others)
    assert all(same_bits(others[0], other) for other in others)
    assert evaluate(models[1], episodes=2) == evaluate(models[2], episodes=2)


def test_the_instance_itself_is_not_acted_in():
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=0)
    before = env.unwrapped.state.copy(), env.unwrapped.np_random.bit_generator.state
    PGTS(env, **SHORT).learn(20)
    assert np.array_equal(env.unwrapped.state, before[0])
    assert env.unwrapped.np_random.bit_generator.state == before[1]


def test_an_id_that_names_its_module_is_imported_from_there(tmp_path, monkeypatch):
    source = (
        "import gymnasium\nfrom tests.agent import test_environments as own\ngymnasium.register('Field-v0', own.Field)"
    )
    (tmp_path / "fields_of_mine.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    model = PGTS("fields_of_mine:Field-v0", **SHORT, actions_per_dimension=2)
    assert model.iterate().experience.num_steps == 10
    model.save(tmp_path / "model.pt")
    assert PGTS.load(tmp_path / "model.pt", trust_imports=True).num_env_steps == 10
    with pytest.raises(PgtsError, match="nothing_of_mine:Field-v0 cannot be made: No module named"):
        PGTS("nothing_of_mine:Field-v0")
    (tmp_path / "broken_of_mine.py").write_text("import gymnasium\nclass Field(Env): pass")
    with pytest.raises(
        PgtsError, match="Field cannot be made, for importing broken_of_mine fails: NameError: name 'Env'"
    ):
        PGTS("broken_of_mine:Field")
    with pytest.raises(PgtsError, match=r"doesn't exist\. MODULE:Meadow-v0 imports the module that registers it$"):
        PGTS("Meadow-v0")
    with pytest.raises(
        PgtsError, match=r"doesn't exist\. Importing fields_of_mine does not register it: name a module"
    ):
        PGTS("fields_of_mine:Meadow-v0")
    with pytest.raises(
        PgtsError, match=r"proper package for Meadows\? MODULE:Meadows/Green-v0 imports the module that"
    ):
        PGTS("Meadows/Green-v0")


def test_continuous_actions_need_no_model_where_advantages_are_sampled():
    model = pendulum(depth=0, estimator="sampled")
    assert not isinstance(model.world, ModelWorld)
    assert model.iterate().model_calls == 0


@pytest.mark.parametrize(
    ("env", "options", "message"),
    [
        (
            "Pendulum-v1",
            {},
            r"the actions of Pendulum-v1 are continuous, Box.*: take the policy 'gaussian', or set actions",
        ),
        (
            Field,
            {},
            r"the actions of Field are continuous, Box.*: take the policy 'gaussian', or set actions",
        ),
        ("CartPole-v1", {"actions_per_dimension": 3}, r"actions_per_dimension is 3; .*CartPole-v1.* discrete actions"),
        ("pgts/Ladder-v0", {"actions_per_dimension": 3}, "actions_per_dimension is 3; pgts/Ladder-v0 has discrete"),
        ("Pendulum-v1", {"actions_per_dimension": 1}, "it must be at least 2"),
        (Field, {"actions_per_dimension": 101}, "at most 10,000 actions in 2 dimensions"),
        (Field, {"env_kwargs": {"n": 3}, "actions_per_dimension": 2}, "given as an object takes none"),
        (lambda: 3, {}, "gave 3; it must be a Gymnasium environment"),
        (3, {}, "the environment is 3; it must be a Gymnasium id, an environment, a function that makes one"),
    ],
)
def test_environments_that_no_agent_can_act_in_are_refused_by_name(env, options, message):
    with pytest.raises(PgtsError, match=message):
        PGTS(env, **SHORT, **options)


class Switches(Field):
    """Two switches, of two and of three positions, counted from 0 and from 5."""

    action_space = spaces.MultiDiscrete([2, 3], start=[0, 5])


class Bits(Field):
    """Two switches that are on or off."""

    action_space = spaces.MultiBinary(2)


@pytest.mark.parametrize("options", [{}, {"depth": 0, "estimator": "sampled"}])
@pytest.mark.parametrize(("env", "second"), [(Switches, (5, 6, 7)), (Bits, (0, 1))])
def test_combinations_of_actions_are_numbered(env, second, options):
    model = PGTS(env, **SHORT | options)
    model.iterate()
    assert model.policy.num_actions == 2 * len(second)
    seen = {tuple(action.tolist()) for action in model.predict(np.zeros((200, 2)), deterministic=False)}
    assert seen == {(x, y) for x in (0, 1) for y in second}
    assert evaluate(model, episodes=2).episodic_return.mean < 0


def test_actions_that_are_counted_from_elsewhere_are_numbered(tmp_path):
    model = PGTS(Corridor, **SHORT)
    model.iterate()
    model.save(tmp_path / "m.pt")
    loaded = PGTS.load(tmp_path / "m.pt", env=Corridor)
    assert set(loaded.predict(np.zeros((50, 2)), deterministic=False).tolist()) == {5, 6}


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.MultiDiscrete([10] * 5), r"are MultiDiscrete.*: more than 10,000 combinations"),
        (spaces.MultiBinary(14), r"are MultiBinary\(14\): more than 10,000 combinations"),
        (spaces.Tuple([spaces.Discrete(2)]), "must be Discrete, MultiDiscrete, MultiBinary or Box"),
    ],
)
def test_actions_that_cannot_be_numbered_are_refused(space, message):
    panel = type("Panel", (Field,), {"action_space": space})
    with pytest.raises(PgtsError, match=f"the actions of Panel .*{message}"):
        PGTS(panel, **SHORT)


def test_environments_that_were_made_take_their_own_actions():
    envs = EnvSource.of("Pendulum-v1", actions_per_dimension=3).make(2)
    assert PGTS(envs, **SHORT).iterate().look.q_BA.shape[-1] == 3
    with pytest.raises(PgtsError, match="actions_per_dimension is 3; a VectorEnv takes its own actions"):
        PGTS(envs, **SHORT, actions_per_dimension=3)


def test_a_vector_environment_keeps_its_number_and_refuses_another(tmp_path):
    short = {name: value for name, value in SHORT.items() if name != "num_envs"}
    model = PGTS(EnvSource.of("CartPole-v1").make(3), **short)
    assert model.iterate().experience.num_episodes == 3
    with pytest.raises(PgtsError, match="num_envs is 16, and a VectorEnv of 3 was given: leave num_envs out"):
        PGTS(EnvSource.of("CartPole-v1").make(3), **short, num_envs=16)
    model.save(tmp_path / "m.pt")
    assert PGTS.load(tmp_path / "m.pt", env=EnvSource.of("CartPole-v1").make(2)).world.env.num_envs == 2


class Unbuilt(Field):
    """It cannot be made."""

    def __init__(self):
        raise RuntimeError("no licence")


def test_an_environment_that_raises_while_it_is_made_is_named():
    with pytest.raises(PgtsError, match="Unbuilt cannot be made: RuntimeError: no licence"):
        PGTS(Unbuilt, **SHORT)
    gymnasium.register("Unbuilt-v0", Unbuilt)
    try:
        for make in (lambda: PGTS("Unbuilt-v0", **SHORT), lambda: check_model("Unbuilt-v0")):
            with pytest.raises(PgtsError, match=r"^Unbuilt-v0 cannot be made: RuntimeError: no licence"):
                make()
    finally:
        gymnasium.registry.pop("Unbuilt-v0")


def test_a_time_limit_around_an_environment_of_ones_own_is_that_of_its_evaluation():
    model = PGTS(lambda: TimeLimit(Field(), 1200), **SHORT, actions_per_dimension=2)
    assert model.source.time_limit == 1200
    assert evaluate(model, episodes=1).episodic_length.mean == 1200
    assert PGTS(Field, **SHORT, actions_per_dimension=2).source.time_limit is None


class Spaceless(gymnasium.Env):
    """It says what it observes, and not which actions it takes."""

    observation_space = spaces.Discrete(2)


@pytest.mark.parametrize(
    ("given", "name"), [(gymnasium.Env, "Env has no observation_space"), (Spaceless, "action_space")]
)
def test_an_environment_without_spaces_is_refused_by_their_name(given, name):
    with pytest.raises(PgtsError, match=name):
        PGTS(given, **SHORT)


def test_an_id_without_a_version_is_its_latest_version(tmp_path):
    model = PGTS("CartPole", **SHORT)
    assert (model.source.name, model.source.time_limit) == ("CartPole-v1", 500)
    assert PGTS("gymnasium:CartPole", **SHORT).source.name == "gymnasium:CartPole-v1"
    with pytest.raises(
        PgtsError, match=r"Cartpole cannot be made: Environment `Cartpole` doesn't exist\. Did you mean"
    ):
        PGTS("Cartpole", **SHORT)
    with pytest.raises(PgtsError, match="cannot be made: Malformed environment ID"):
        PGTS("no id at all!", **SHORT)
    model.save(tmp_path / "m.pt")
    assert PGTS.load(tmp_path / "m.pt").source.name == "CartPole-v1"


def test_atari_is_found_under_all_its_ids():
    pytest.importorskip("ale_py")
    for name in ("BreakoutNoFrameskip-v4", "ALE/Breakout-v5", "Breakout"):
        assert EnvSource.of(name, kwargs={"obs_type": "ram"}).make(1).single_observation_space.shape == (128,)


class Counted(Field):
    """It counts how many are open."""

    num_open = 0
    action_space = spaces.Discrete(2)

    def __init__(self):
        Counted.num_open += 1

    def step(self, action):
        return self.place, 0.0, False, False, {}

    def close(self):
        Counted.num_open -= 1


def test_a_training_closes_its_environments_and_not_those_that_were_given():
    with PGTS(Counted, **SHORT) as model:
        model.iterate()
        assert Counted.num_open > 0
    assert model.predict(np.zeros(2)) in (0, 1)
    with pytest.raises(PgtsError, match="the environments of this training are closed"):
        model.iterate()
    model.close()  # twice is once
    envs = EnvSource.of(Counted).make(2)
    with PGTS(envs, **{name: value for name, value in SHORT.items() if name != "num_envs"}) as model:
        model.iterate()
    assert not envs.closed
