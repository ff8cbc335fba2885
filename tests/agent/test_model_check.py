"""Steps of an environment are compared with its model: tables, dynamics and simulators, one by one and by frequency."""

import pickle
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.classic_control import AcrobotEnv

from pgts_torch.agent.diagnostics import metrics
from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import ModelMismatch, PgtsError
from pgts_torch.models import SimulatorModel
from pgts_torch.models.base import Model
from tests.forks import on_ranks
from tests.support import same_values

A, S, LENGTH = 2, 6, 10
SMALL = {"num_envs": 4, "horizon": {"type": "fixed", "length": LENGTH}, "seed": 0}


class Walk(gymnasium.Env):
    """A row of cells whose last one ends the episode; a step slips to the other side with some probability.

    `Table` publishes P, `Restored` is a simulator. What `lie` changes is no part of either.
    """

    action_space = spaces.Discrete(A)

    def __init__(self, *, slip: float = 0.0, claimed: float | None = None, unit: float = 1.0) -> None:
        self.slip, self.unit, self.position, self.steps = slip, unit, 0, 0
        self.lie: Callable[[Walk], float | None] = lambda env: None
        self.begin = 0
        self.claimed = slip if claimed is None else claimed

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.position = self.begin
        return self.shown(), {}

    def step(self, action: int) -> Any:
        self.steps += 1
        right = bool(action) != (self.slip > 0 and self.np_random.random() < self.slip)
        self.position = min(S - 1, max(0, self.position + (1 if right else -1)))
        paid = self.lie(self)
        ends = self.position == S - 1
        return self.shown(), self.unit * ends if paid is None else paid, ends, False, {}


class Table(Walk):
    """With a table."""

    observation_space = spaces.Discrete(S)

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.initial_state_distrib = np.eye(S)[0]
        self.P = {}
        for s in range(S):
            after = [(max(0, s - 1), 0.0), (min(S - 1, s + 1), self.unit * (s + 1 >= S - 1))]
            rows = {0: (after[0], after[1]), 1: (after[1], after[0])}
            self.P[s] = {
                a: [
                    (p, t, float(r), t == S - 1)
                    for p, (t, r) in zip((1 - self.claimed, self.claimed), pair, strict=True)
                    if p > 0
                ]
                for a, pair in rows.items()
            }

    def shown(self) -> int:
        return self.position


class Restored(Walk):
    """With a state."""

    observation_space = spaces.Box(0, S, (1,), np.float64)

    def shown(self) -> np.ndarray:
        return np.array([self.position], dtype=np.float64)

    def get_state(self) -> bytes:
        return bytes([self.position])

    def set_state(self, state: bytes) -> None:
        self.position = state[0]


def real(model: PGTS) -> list[Any]:
    """The environments that the agent acts in, which the model does not know of."""
    return [env.unwrapped for env in model.world.env.envs]  # type: ignore[attr-defined]


def bits(model: PGTS) -> list[float]:
    return [x for tensor in model.policy.state_dict().values() for x in tensor.flatten().tolist()]


def pays_after(steps: int, amount: float) -> Callable[[Walk], float | None]:
    return lambda env: amount if env.steps > steps else None


def teleports_after(steps: int) -> Callable[[Walk], None]:
    def lie(env: Walk) -> None:
        if env.steps > steps and env.position == 1:
            env.position = 3

    return lie


KINDS = {"table": (Table, "softmax"), "simulator": (Restored, {"type": "mlp", "hidden": [8]})}
LIES = {
    "another reward": (pays_after(35, 0.5), r"gave reward 0\.5, (discount 0\.99|an end)"),
    "a reward off by 1e-9": (pays_after(35, 1e-9), r"gave reward 1e-09, (discount 0\.99|an end)"),
    "another state": (teleports_after(35), r"gave reward 0, discount 0\.99, then state"),
}


@pytest.mark.fault("environment that contradicts its model")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lie", LIES)
def test_the_first_step_that_the_model_rules_out_stops_the_training_before_the_policy_moves(kind, lie):
    make, policy = KINDS[kind]
    model = PGTS(make, depth=2, policy=policy, **SMALL)
    for env in real(model):
        env.steps, env.lie = 0, LIES[lie][0]
    before, iterations = bits(model), model.num_iterations

    def remember(model: PGTS, _: Any) -> None:
        nonlocal before, iterations
        before, iterations = bits(model), model.num_iterations

    with pytest.raises(ModelMismatch, match=LIES[lie][1]) as stopped:
        model.learn(4_000, callback=remember)
    assert bits(model) == before
    assert model.num_iterations == iterations >= 2
    text = str(stopped.value)
    assert f"contradicts its {kind}: state" in text
    assert "under action" in text
    assert f"the {kind} says reward" in text
    assert model.model_check.contradictions > 0


def test_a_step_that_dynamics_rule_out_stops_the_training():
    model = PGTS("CartPole-v1", depth=1, policy="mlp", **SMALL)
    model.iterate()
    real(model)[2].force_mag = 10 * (1 + 1e-9)  # constants are read when an instance is first met
    with pytest.raises(
        ModelMismatch, match=r"CartPole-v1 contradicts its dynamics: state \[.*\] under action [01] gave"
    ):
        model.iterate()


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e6, -1e6, 1 / 3])
@pytest.mark.parametrize("kind", KINDS)
def test_an_environment_that_does_what_its_model_says_is_never_stopped(kind, unit):
    make, policy = KINDS[kind]
    model = PGTS(lambda: make(unit=unit), depth=2, policy=policy, **SMALL)
    model.learn(300)
    assert model.model_check.contradictions == 0
    assert model.model_check.model_calls == 0


@pytest.mark.parametrize(
    ("env", "actions"),
    [
        *((env, None) for env in ("FrozenLake-v1", "Taxi-v4", "CliffWalking-v1", "pgts/Random-v0", "pgts/DeepSea-v0")),
        *((env, None) for env in ("CartPole-v1", "Acrobot-v1", "MountainCar-v0")),
        *((env, 3) for env in ("Pendulum-v1", "MountainCarContinuous-v0")),
    ],
)
def test_the_tables_and_dynamics_that_come_along_agree_with_their_environments(env, actions):
    model = PGTS(env, depth=1, actions_per_dimension=actions, **{**SMALL, "num_envs": 16})
    model.learn(500)
    assert model.model_check.is_active
    assert model.model_check.contradictions == 0


def test_observations_of_dynamics_are_compared_with_those_of_the_environment(monkeypatch):
    model = PGTS("Acrobot-v1", depth=1, **SMALL)
    before, shown = model.policy.state_dict(), AcrobotEnv._get_ob
    monkeypatch.setattr(AcrobotEnv, "_get_ob", lambda env: shown(env) + np.float32(5e-7))
    model.iterate()
    moved = model.policy.state_dict()
    assert not same_values(before, moved)
    monkeypatch.setattr(AcrobotEnv, "_get_ob", lambda env: shown(env)[[0, 1, 3, 2, 4, 5]])
    with pytest.raises(
        ModelMismatch, match=r"Acrobot-v1 contradicts its dynamics: state .* shows \[.*\]; the dynamics"
    ):
        model.iterate()
    assert same_values(model.policy.state_dict(), moved)
    assert model.model_check.contradictions > 20  # of 40 visits


def test_a_reward_that_is_paid_in_float32_agrees_with_the_one_that_it_was_rounded_from():
    model = PGTS(lambda: Table(unit=1 / 3), depth=1, **SMALL)
    for env in real(model):
        env.lie = lambda env: float(np.float32(1 / 3)) if env.position == S - 1 else None
    model.learn(300)
    assert model.model_check.contradictions == 0


def test_an_end_that_the_table_does_not_know_and_a_start_that_it_rules_out_are_contradictions():
    model = PGTS(Table, depth=1, **SMALL)
    for env in real(model):
        env.begin = 2
    with pytest.raises(ModelMismatch, match=r"an episode began in state 2; the start distribution of its table has 1"):
        model.iterate()
    model = PGTS(Table, depth=1, **SMALL)
    for env in real(model):
        step = env.step
        env.step = lambda action, step=step: (*step(action)[:2], True, False, {})
    with pytest.raises(ModelMismatch, match=r"gave reward 0, an end; the table says reward 0, discount 0\.99"):
        model.iterate()


def test_a_step_beyond_a_truncation_that_the_simulator_makes_is_a_contradiction():
    class Short(Restored):
        limit = 3

        def step(self, action: int) -> Any:
            observation, reward, terminated, _, info = super().step(action)
            return observation, reward, terminated, self.position >= self.limit, info

    model = PGTS(Short, depth=1, policy="mlp", **SMALL)
    model.iterate()
    for env in real(model):
        env.limit, env.begin = 99, 2
    with pytest.raises(
        ModelMismatch, match=r"and the episode went on; the simulator says .* where the episode is trunc"
    ):
        model.learn(2000)


# Frequencies


@pytest.mark.fault("probabilities that are not the environment's")
@pytest.mark.parametrize(("slip", "claimed"), [(0.2, 2 / 3), (0.5, 0.4), (0.05, 0.2)])
def test_probabilities_that_are_wrong_stop_the_training(slip, claimed):
    model = PGTS(lambda: Table(slip=claimed), depth=1, **{**SMALL, "num_envs": 16})
    for env in real(model):
        env.slip = slip
    with pytest.raises(
        ModelMismatch, match=r"contradicts its table: state \d under action \d gave .* in \d+ of \d+ cases"
    ):
        model.learn(30_000)


def test_a_rounded_table_is_never_stopped_and_a_true_one_not_even_doubted():
    for claimed in (0.33, 1 / 3):
        model = PGTS(lambda claimed=claimed: Table(slip=claimed), depth=1, **{**SMALL, "num_envs": 16})
        for env in real(model):
            env.slip = 1 / 3
        model.learn(3_000)
        assert model.model_check.contradictions == 0


def test_a_start_that_is_too_frequent_stops_the_training():
    class Scattered(Table):
        def __init__(self) -> None:
            super().__init__()
            self.initial_state_distrib, self.shares = np.full(S, 1 / (S - 1)) * (np.arange(S) < S - 1), [0.2] * 5

        def reset(self, **options: Any) -> Any:
            super().reset(**options)
            self.position = int(self.np_random.choice(S - 1, p=self.shares))
            return self.position, {}

    model = PGTS(Scattered, depth=1, **SMALL)
    model.learn(400)
    for env in real(model):
        env.shares = [0.6, 0.1, 0.1, 0.1, 0.1]
    with pytest.raises(ModelMismatch, match=r"contradicts its table: an episode began in state 0 in \d+ of \d+"):
        model.learn(40_000)


# Modes, counters, work


def test_warn_counts_contradictions_and_warns_once_a_kind_and_off_checks_nothing():
    for mode, said in (("warn", 1), ("off", 0)):
        model = PGTS(Table, depth=1, model_check=mode, **SMALL)
        for env in real(model):
            env.lie = pays_after(0, 0.25)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            iterations = [model.iterate() for _ in range(3)]
        assert len([w for w in caught if "contradicts its table" in str(w.message)]) == said
        tags = metrics(model.parts, iterations[-1], model.counters)
        if mode == "warn":
            assert tags["model/contradictions"] == sum(each.experience.num_steps for each in iterations)
        else:
            assert "model/contradictions" not in tags
    with pytest.raises(PgtsError, match="model_check is 'loud'; it must be error, warn or off"):
        PGTS(Table, model_check="loud")


def test_with_sampled_advantages_nothing_is_checked():
    model = PGTS(Restored, depth=0, estimator="sampled", policy="mlp", **SMALL)
    for env in real(model):
        env.lie = pays_after(0, 0.25)
    model.learn(100)
    assert not model.model_check.is_active


@pytest.mark.parametrize("env", ["FrozenLake-v1", "CartPole-v1", Restored])
def test_the_check_moves_no_learning_curve(env):
    policies = []
    for mode in ("error", "off"):
        model = PGTS(env, depth=1, model_check=mode, policy=None if env == "FrozenLake-v1" else "mlp", **SMALL)
        model.learn(200)
        policies.append((bits(model), model.num_model_calls))
    assert policies[0] == policies[1]


def test_the_check_queries_a_simulator_about_few_steps_and_none_that_the_lookahead_has_queried():
    queries = {}
    for depth, critic in ((1, {"type": "network", "target": "v"}), (0, {"type": "network", "target": "q"})):
        model = PGTS(Restored, depth=depth, policy="mlp", critic=critic, **{**SMALL, "num_envs": 32})
        model.learn(320)
        queries[depth] = model.model_check.model_calls
    assert queries[1] == 0
    assert 0 < queries[0] <= S * A  # one in 64 of 320, and none of them twice


def test_repeated_actions_are_checked_by_single_steps():
    model = PGTS(Restored, depth=1, action_repeat=3, policy="mlp", **{**SMALL, "num_envs": 32})
    model.learn(2_000)
    assert model.model_check.contradictions == 0
    assert model.model_check.model_calls > 0
    for env in real(model):
        env.lie = pays_after(0, 0.25)
    with pytest.raises(ModelMismatch, match=r"gave reward 0\.25"):
        model.learn(20_000)


def test_steps_that_a_simulator_only_samples_are_not_checked_which_is_one_warning():
    model = PGTS(lambda: Restored(slip=0.3), depth=1, policy="mlp", **{**SMALL, "num_envs": 32})
    with pytest.warns(UserWarning, match="outcomes its simulator does not enumerate.*is not checked") as said:
        model.learn(400)
    assert len(said) == 1
    assert model.model_check.contradictions == 0


@pytest.mark.parametrize("pack", [lambda x: (x, [x]), lambda x: pickle.dumps({"x": x})])
def test_a_state_is_the_same_whether_its_numbers_are_of_python_or_of_numpy(pack):
    class Mixed(Restored):
        def get_state(self) -> Any:
            return pack(self.position)

        def set_state(self, state: Any) -> None:
            self.position = pickle.loads(state)["x"] if isinstance(state, bytes) else state[0]

    model = PGTS(Mixed, depth=1, policy="mlp", **SMALL)
    for env in real(model):
        env.lie = lambda env: setattr(env, "position", np.int64(env.position))
    model.learn(120)
    assert model.model_check.contradictions == 0
    for env in real(model):
        env.lie = lambda env: setattr(env, "position", np.int64(env.position) % 3)
    with pytest.raises(ModelMismatch, match="contradicts its simulator"):
        model.learn(800)


def test_a_saved_check_goes_on_with_the_same_bits(tmp_path):
    def make() -> PGTS:
        return PGTS("FrozenLake-v1", depth=1, **SMALL)

    model = make()
    model.learn(100)
    model.save(tmp_path / "model.pt")
    other = PGTS.load(tmp_path / "model.pt")
    for each in (model, other):
        each.learn(300)
    first, second = (each.model_check.state_dict() for each in (model, other))
    assert first["frequencies"]["steps"]["counts"].sum() > 50
    assert repr(first) == repr(second)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("make", [Table, Restored])
def test_ranks_stop_together_whichever_of_them_was_contradicted(make):
    def stopped() -> tuple[int, int, str]:
        policy = "softmax" if make is Table else {"type": "mlp", "hidden": [8]}
        model = PGTS(make, depth=1, policy=policy, **SMALL)
        if model.ranks.rank == 1:
            for env in real(model):
                env.lie = pays_after(25, 0.25)
        try:
            model.learn(4_000)
        except ModelMismatch as error:
            return model.num_iterations, model.model_check.contradictions, str(error)
        return 0, 0, ""

    first, second = on_ranks(2, stopped)
    assert first == second
    assert first[0] >= 2
    assert "reward 0.25" in first[2]


def test_models_that_claim_to_be_the_environment_are_exact_and_others_are_not_unless_they_say_so():
    assert PGTS("pgts/Ladder-v0").world.model.exact
    assert PGTS("CartPole-v1").world.model.exact
    assert SimulatorModel("FrozenLake-v1", gamma=0.9).exact
    assert not Model.exact
