"""Training with continuous actions: models that take vectors, what is refused, saving and resuming."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from benchmarks.linear import LinearQuadratic
from pgts_torch import PGTS
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.model_check import ModelCheck
from pgts_torch.errors import ModelMismatch, PgtsError, RandomOutcomes
from pgts_torch.models import classic
from pgts_torch.models.squash import Squash, Squashed
from pgts_torch.models.vector_simulator import VectorSimulator
from pgts_torch.seeding import stream
from tests.agent.continuous import GAMMA, Cart

SHORT = {"type": "fixed", "length": 12}
SMALL = {"policy": "gaussian", "depth": 1, "num_envs": 2, "horizon": SHORT, "actions": 3}


def test_vectors_are_squashed_into_the_bounds_and_into_none_where_there_are_none():
    space = spaces.Box(np.array([-2.0, 1.0, -np.inf]), np.array([2.0, 5.0, np.inf]), dtype=np.float64)
    squash = Squash(space, "it")
    vector_NX = np.array([[0.0, 0.0, 7.0], [100.0, -100.0, -1.0], [0.5, -0.5, 0.0]])
    action_NX = squash.actions(vector_NX)
    assert action_NX[:2].tolist() == [[0.0, 3.0, 7.0], [2.0, 1.0, -1.0]]
    assert action_NX[2].tolist() == pytest.approx([2 * np.tanh(0.5), 3 - 2 * np.tanh(0.5), 0.0])
    image = Squash(spaces.Box(-1, 1, (2, 3), np.float32), "it").actions(np.zeros((4, 6)))
    assert image.shape == (4, 2, 3)
    assert image.dtype == np.float32


def test_no_action_is_beyond_a_bound_by_rounding_and_one_may_have_no_axes():
    space = spaces.Box(-0.1, 0.3, (), np.float64)  # -0.1 + (0.3 - -0.1) is above 0.3
    squash = Squash(space, "it")
    actions = [squash.actions(np.array([end])) for end in (-50.0, 50.0)]
    assert actions == [-0.1, 0.3]
    assert all(action in space for action in actions)
    assert squash.of_tensors(torch.tensor([[-50.0], [50.0]])).tolist() == [-0.1, 0.3]


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Discrete(3), "needs continuous ones"),
        (spaces.Box(-1, 1, (0,), np.float32), "which has no entries"),
        (spaces.Box(-1e308, 1e308, (2,), np.float64), "entry 0 .* bounded by -1e.308 and 1e.308"),
        (spaces.Box(0, 255, (2,), np.uint8), "needs continuous ones"),
        (spaces.Box(np.array([0.0, -np.inf]), np.array([1.0, 1.0]), dtype=np.float64), "entry 1 .* on one side"),
    ],
)
def test_what_cannot_be_squashed_is_refused(space, message):
    with pytest.raises(PgtsError, match=message):
        Squash(space, "it")


def stepped(env: gymnasium.Env, model, roots, squash_NX):
    """What the environment gives for each of these vectors from its present state, and what the model says."""
    state = roots(env)
    said = model.follow(torch.tensor([state] * len(squash_NX)), torch.from_numpy(squash_NX))
    given = []
    for vector_X in squash_NX:
        reward, terminated = env.step(vector_X)[1:3]
        given.append((float(reward), 0.0 if terminated else model.gamma, roots(env)))
        restore(env, model, state)
    return given, list(zip(said.reward_N.tolist(), said.discount_N.tolist(), said.next_state_N.tolist(), strict=True))


def restore(env, model, state):
    if isinstance(model, VectorSimulator):
        model.adapter.set_state(env.unwrapped, model.snapshot(state).data)
    else:
        env.unwrapped.state = model.states(torch.tensor([state]))[0].numpy()


@pytest.mark.parametrize("kind", ["dynamics", "simulator"])
def test_a_model_of_vectors_gives_what_the_environment_does(kind):
    env = Squashed(gymnasium.make("Pendulum-v1") if kind == "dynamics" else Cart())
    env.reset(seed=4)
    vector_NX = np.random.default_rng(0).normal(size=(50, 1)).astype(np.float32) * 2
    if kind == "dynamics":
        model = classic.Pendulum(env, gamma=0.9)
        given, said = stepped(env, model, lambda env: int(model.roots([env])), vector_NX)
    else:
        model = VectorSimulator(lambda: Squashed(Cart()), gamma=0.9, size=1)
        given, said = stepped(env, model, lambda env: model.root(env, np.zeros(2)), vector_NX)
    assert len(set(said)) == 50
    assert given == said  # bit for bit


class Noisy(Cart):
    """Its steps are random."""

    def step(self, action):
        self._state = self._state + self.np_random.normal(size=2)
        return super().step(action)


def test_a_random_simulator_is_refused_by_a_lookahead_and_trains_with_sampled_advantages():
    with pytest.raises(RandomOutcomes, match="estimator 'sampled'"):
        PGTS(Noisy, **SMALL).iterate()
    PGTS(Noisy, **SMALL | {"depth": 0, "actions": None, "estimator": "sampled"}).iterate()


def test_a_model_that_is_not_the_environment_is_found_out(monkeypatch):
    model, move = PGTS("Pendulum-v1", **SMALL), classic.Pendulum._move
    # The check at the start has seen the right one.
    monkeypatch.setattr(classic.Pendulum, "_move", lambda self, xp, state, effect: move(self, xp, state, effect[::-1]))
    with pytest.raises(ModelMismatch, match=r"under action \["):
        model.iterate()


CASES = {
    "dynamics": ("Pendulum-v1", SMALL),
    "simulator": (Cart, SMALL | {"gamma": GAMMA}),
    "own model": (
        Cart,
        SMALL | {"gamma": GAMMA, "model": LinearQuadratic.double_integrator(gamma=GAMMA), "model_check": "off"},
    ),
    "mcts": ("Pendulum-v1", SMALL | {"depth": 2, "search": {"type": "mcts", "simulations": 8, "prior": "policy"}}),
    "gradient": ("Pendulum-v1", SMALL | {"depth": 0, "update": "gradient", "critic": {"network": "shared"}}),
    "ppo": ("Pendulum-v1", SMALL | {"update": "ppo"}),
    "sampled": ("Pendulum-v1", SMALL | {"depth": 0, "actions": None, "estimator": "sampled"}),
    "ensemble": (
        "Pendulum-v1",
        {"policy": "gaussian", "depth": 1, "actions": 3, "horizon": {"type": "steps", "first": 40, "length": 7}}
        | {"model": {"type": "ensemble", "members": 2, "hidden": [8], "first_updates": 5}}
        | {"replay": {"type": "uniform", "starts": 4, "length": 5, "updates_per_step": 0.05}},
    ),
    "replay": (
        "Pendulum-v1",
        {"policy": "gaussian", "depth": 0, "actions": 3, "horizon": {"type": "steps", "first": 30, "length": 7}}
        | {"replay": {"type": "uniform", "starts": 4, "length": 5, "updates_per_step": 0.1}},
    ),
}
CASES["replayed simulator"] = ("InvertedPendulum-v5", CASES["replay"][1])


@pytest.mark.parametrize("case", CASES)
def test_a_loaded_training_goes_on_bit_for_bit(case, tmp_path):
    env, arguments = CASES[case]
    if env == "InvertedPendulum-v5":
        pytest.importorskip("mujoco", exc_type=ImportError)
    model = PGTS(env, **arguments)
    model.iterate()
    if case == "own model":
        other = PGTS(env, **arguments)
        other.load_state_dict(model.state_dict())
    else:
        model.save(tmp_path / "model.pt")
        other = PGTS.load(tmp_path / "model.pt", **({} if isinstance(env, str) else {"env": env}))
    first, second = model.iterate(), other.iterate()
    assert torch.equal(first.experience.action_TB, second.experience.action_TB)
    assert first.losses == second.losses
    assert all(map(torch.equal, model.policy.network.weights, other.policy.network.weights))


def test_saved_snapshots_of_another_length_are_refused():
    pytest.importorskip("mujoco", exc_type=ImportError)
    model = PGTS("InvertedPendulum-v5", **CASES["replay"][1])
    model.iterate()
    state = model.state_dict()
    kept = state["dyna"]["replay"]["columns"]
    kept["data"] = kept["data"][:, 8:]
    with pytest.raises(PgtsError, match=r"snapshots are uint8 of shape \(\d+,\); they must be \d+ bytes"):
        PGTS("InvertedPendulum-v5", **CASES["replay"][1]).load_state_dict(state)


class Leaving(Cart):
    """A cart whose episode ends far from the middle."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, bool(abs(observation[0]) > 1), truncated, info


def test_an_imagined_episode_that_is_over_takes_no_step_of_the_simulator():
    model = PGTS(Leaving, **CASES["replay"][1])
    model.iterate()
    simulator = model.world.model
    before = simulator.simulator_steps
    imagined, _ = next(model.dyna.rollouts(Draws.of(model.ranks, 0, 1, model.device)))
    assert not imagined.alive_TB.all()
    assert simulator.simulator_steps - before == imagined.num_steps


def test_actions_are_in_bounds_and_deterministic_ones_the_squashed_mean():
    model = PGTS("Pendulum-v1", **SMALL)
    model.iterate()
    observation_NO = np.random.default_rng(1).normal(size=(40, 3)).astype(np.float32)
    assert model.predict(observation_NO[0]).shape == (1,)
    mean_NX = model.policy.normals(torch.from_numpy(observation_NO)).mean_NX.numpy()
    action_NX = model.predict(observation_NO)
    assert np.allclose(action_NX, 2 * np.tanh(mean_NX), atol=1e-6)
    drawn_NX = model.predict(observation_NO, deterministic=False, generator=stream(0, "drawn"))
    assert drawn_NX.dtype == np.float32
    assert (np.abs(drawn_NX) <= 2).all()
    assert not np.allclose(drawn_NX, action_NX, atol=0.1)
    assert evaluate(model, episodes=2).episodic_length.mean == 200


def test_the_gap_and_the_value_are_those_of_the_drawn_actions():
    model = PGTS("Pendulum-v1", **SMALL)
    found = model.iterate()
    assert found.pi_NA is found.drawn.prob_NK
    q_NK, pi_NK = found.look.q_BA, found.pi_NA.double()
    assert torch.allclose(found.advantage_NA, q_NK - (pi_NK * q_NK).sum(-1, keepdim=True), atol=1e-3)
    assert found.certificate == float("inf")


def test_a_lookahead_trains_the_double_integrator_to_nearly_its_best_return():
    model = PGTS(
        Cart, policy="gaussian", depth=1, actions=8, gamma=GAMMA, num_envs=8, horizon={"type": "fixed", "length": 30}
    )
    integrator = LinearQuadratic.double_integrator(gamma=GAMMA)
    before = evaluate(model, episodes=8, seed=1)
    for _ in range(12):
        model.iterate()
    after = evaluate(model, episodes=8, seed=1)
    starts = np.array([Cart().reset(seed=int(seed))[0] for seed in range(4000)])
    best = float(integrator.v(integrator.optimal(), torch.from_numpy(starts)).mean())
    assert before.discounted_return.mean < 1.5 * best  # all of these are negative
    assert after.discounted_return.mean > 0.8 * before.discounted_return.mean


REPLAYED = {"policy": "gaussian", "actions": 4, "depth": 0, "replay": {"type": "uniform", "starts": 4, "length": 10}}


SAMPLED = {"policy": "gaussian", "depth": 0, "estimator": "sampled", "num_envs": 4, "horizon": SMALL["horizon"]}


@pytest.mark.parametrize("options", [SMALL, REPLAYED, SAMPLED], ids=["rollouts", "replay", "sampled"])
def test_rewards_of_any_size_train_the_same_policy(options):
    horizon = {"type": "steps", "length": 20, "first": 60} if options is REPLAYED else options["horizon"]
    given = options | {"gamma": GAMMA, "horizon": horizon}
    one, other = (PGTS(lambda: Cart(reward_scale=2.0**k), **given) for k in (-10, 20))  # noqa: B023
    for model in (one, other):
        model.iterate()
        model.iterate()
    assert all(map(torch.equal, one.policy.network.weights, other.policy.network.weights))


REFUSALS = {
    "discrete": ("CartPole-v1", {}, "needs continuous ones"),
    "divided": ("Pendulum-v1", {"actions_per_dimension": 3}, "leave one of the two out"),
    "adaptive": ("Pendulum-v1", {"depth": "adaptive"}, "depth is adaptive, which needs a bound over all actions"),
    "stop_at": ("Pendulum-v1", {"stop_at": 1.0}, "stop_at is 1.0, which needs a bound over all actions"),
    "sampled search": ("Pendulum-v1", {"search": "sampled"}, "each drawn action has one outcome"),
    "counts": ("Pendulum-v1", {"model": "counts"}, "learns what follows numbered actions"),
    "q": ("Pendulum-v1", {"critic": {"type": "network", "target": "q"}}, "a value for each numbered action"),
    "cmpo": ("Pendulum-v1", {"update": "cmpo"}, "update.type is cmpo, which needs policy.type mlp, cnn or module"),
    "mpo": ("Pendulum-v1", {"policy": "mlp", "update": "mpo"}, "needs policy.type gaussian"),
    "one action": ("Pendulum-v1", {"actions": 1}, "actions is 1; it must be a whole number >= 2"),
    "actions": ("CartPole-v1", {"policy": "mlp", "actions": 4}, "actions is 4, which only policy.type gaussian uses"),
    "std": ("Pendulum-v1", {"policy": {"type": "gaussian", "std": 0.1, "min_std": 0.2}}, "must be below policy.std"),
    "numbered model": (
        Cart,
        {"model": LinearQuadratic.double_integrator(gamma=GAMMA, action_AX=torch.zeros(2, 1)), "gamma": GAMMA},
        "has 2 actions",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_does_not_go_with_vectors_is_refused_in_one_sentence(case):
    env, options, message = REFUSALS[case]
    with pytest.raises(PgtsError, match=message) as refused:
        PGTS(env, **{"policy": "gaussian"} | options)
    assert "\n" not in str(refused.value)


def test_environments_that_step_together_are_refused_and_continuous_ones_name_both_ways_out():
    env = SyncVectorEnv([Cart], autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(PgtsError, match="policy 'gaussian'"):
        PGTS(env)
    with pytest.raises(PgtsError, match="policy 'gaussian', or set actions_per_dimension"):
        PGTS("Pendulum-v1")
    numbered = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")], autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(PgtsError, match="given as a VectorEnv"):
        PGTS(numbered, policy="gaussian")


def test_steps_are_checked_against_a_simulator_of_vectors():
    model = PGTS(Cart, **SMALL | {"gamma": GAMMA})
    assert isinstance(model.model_check, ModelCheck)
    experience = model.iterate().experience
    happened_N = np.concatenate([model.world.model.outcome_of(each) for each in [_happened(experience)]])
    assert (happened_N == 0).all()
    wrong = _happened(experience)
    wrong.action_N[0] += 1
    assert model.world.model.outcome_of(wrong)[0] == -1
    assert "under action [" in model.world.model.contradiction(wrong)


@pytest.mark.parametrize("env", ["MountainCarContinuous-v0", "InvertedPendulum-v5"])
def test_known_environments_are_simulated_bit_for_bit(env):
    if env == "InvertedPendulum-v5":
        pytest.importorskip("mujoco")
    model = PGTS(env, **SMALL | {"depth": 0, "horizon": {"type": "fixed", "length": 5}})
    happened = _happened(model.iterate().experience)
    assert (model.world.model.outcome_of(happened) == 0).all()
    assert len(happened.state_N) >= 4  # a pendulum may fall soon


def _happened(experience):
    from pgts_torch.agent.model_check import _steps

    return _steps(experience, follows="follows_TB")
