"""Algorithm 1 from rollouts: what one iteration does, and what a training leaves untouched."""

import gymnasium
import numpy as np
import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.agent.critics import TabularCritic
from pgts_torch.agent.policies import SimplexPolicy, SoftmaxPolicy
from pgts_torch.agent.updates import SoftmaxUpdate
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.options import Mirror, SoftmaxGradient, TabularValues
from pgts_torch.seeding import stream
from pgts_torch.tabular import exact, grid, ladder
from pgts_torch.tabular.ascent import projected_step
from tests.agent.helpers import same_bits, vector_env
from tests.models.corridors import Dice
from tests.support import right_with


def make(env: str = "pgts/Ladder-v0", **kwargs) -> PGTS:
    return PGTS(env, **{"depth": 2, "num_envs": 4, "horizon": {"type": "fixed", "length": 12}, "seed": 7} | kwargs)


def bits(model: PGTS) -> list[torch.Tensor]:
    """Everything that training goes on from."""
    state = model.state_dict()
    return [*state["policy"].values(), *state["critic"].values(), torch.tensor(state["num_env_steps"])]


def same(first: list[torch.Tensor], second: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(first, second, strict=True))


def test_the_short_form_works():
    model = PGTS("pgts/Ladder-v0", depth=4, seed=0).learn(2_000)
    assert model.num_env_steps >= 2_000
    assert model.predict(0) in (0, 1)
    assert model.gamma == 0.9


def test_one_iteration_is_algorithm_1():
    mdp = ladder(4, gamma=0.8)
    policy = SimplexPolicy(4, 2)
    pi_SA = right_with(0.3, 0.6, 0.2, 0.9)
    policy.load_state_dict({"probs_SA": pi_SA})
    model = PGTS(
        vector_env(mdp, 3),
        depth=2,
        policy=policy,
        critic="exact",
        update={"type": "projected", "step_size": 0.05},
        horizon={"type": "fixed", "length": 4},
    )
    seen = model.iterate()

    d_S = torch.zeros(4, dtype=torch.float64)
    for episode in seen.experience.state_TB.T.tolist():
        for t, s in enumerate(episode):
            d_S[s] += 0.8**t / 3
    visited = torch.nonzero(d_S).flatten()
    truth = exact.evaluate(mdp, pi_SA)
    look_SA = exact.lookahead(mdp, truth.q_SA, 2)
    expected_SA = pi_SA.clone()
    expected_SA[visited] = projected_step(pi_SA[visited], look_SA[visited], d_S[visited], 0.05)

    assert torch.equal(seen.state_N, visited)
    torch.testing.assert_close(seen.weight_N, d_S[visited])
    torch.testing.assert_close(seen.pi_NA, pi_SA[visited])
    torch.testing.assert_close(seen.look.q_BA, look_SA[visited])
    torch.testing.assert_close(seen.gap_N, look_SA[visited].amax(-1) - truth.v_S[visited])
    torch.testing.assert_close(policy.table(), expected_SA)
    assert not torch.allclose(expected_SA, pi_SA)
    wrong_SA = exact.lookahead(mdp, truth.q_SA, 1)
    assert not torch.allclose(seen.look.q_BA, wrong_SA[visited])


@pytest.mark.parametrize(
    "critic", ["tabular", {"type": "tabular", "target": "q"}, "exact", {"type": "exact", "target": "q"}]
)
def test_the_critic_stands_at_the_leaves_whether_it_learns_v_or_q(critic):
    model = make(critic=critic, depth=3)
    model.iterate()
    states = torch.arange(5)
    if model.critic.target == "q":
        q_SA = model.critic.q(states)
    else:
        q_SA = model.mdp.outcomes.reward_NA + (
            model.mdp.outcomes.prob_NAK
            * model.mdp.outcomes.discount_NAK
            * model.critic.v(model.mdp.outcomes.child_NAK.reshape(-1)).view(5, 2, 1)
        ).sum(-1)
    torch.testing.assert_close(model.lookahead(states, depth=3).q_BA, exact.lookahead(model.mdp, q_SA, 3))


def test_learn_counts_the_steps_of_all_calls():
    model = make()
    model.learn(4 * 12 * 3)
    assert (model.num_env_steps, model.num_iterations) == (144, 3)
    model.learn(145)
    assert (model.num_env_steps, model.num_iterations) == (192, 4)
    model.learn(100)
    assert model.num_iterations == 4


@pytest.mark.parametrize("total_steps", ["100", -1, 1.5, True, None])
def test_steps_that_are_no_number_of_steps_are_refused_before_any_is_made(total_steps):
    model = make()
    with pytest.raises(PgtsError, match=f"^total_steps is {total_steps!r}; it must be a whole number of at least 0$"):
        model.learn(total_steps)
    assert model.num_env_steps == 0


def test_a_whole_number_of_steps_may_be_a_float():
    assert make().learn(1e1).num_env_steps == make().learn(10).num_env_steps


def test_a_callback_sees_every_iteration_and_ends_the_training_by_returning_false():
    seen = []

    def callback(model, iteration):
        seen.append((model.num_iterations, iteration.experience.num_steps))
        return len(seen) < 3

    model = make().learn(10_000, callback=callback)
    assert seen == [(1, 48), (2, 48), (3, 48)]
    assert model.num_iterations == 3
    model.learn(48 * 5, callback=lambda model, iteration: None)
    assert model.num_iterations == 5


def test_predict_returns_actions_in_the_shape_of_the_observations():
    policy = SimplexPolicy(5, 2)
    policy.load_state_dict({"probs_SA": right_with(0.9, 0.1, 0.5, 0.0, 1.0)})
    model = PGTS(vector_env(ladder(), 2), policy=policy)
    assert model.predict(0) == 1
    assert isinstance(model.predict(np.int64(0)), np.integer)
    assert model.predict([3, 4, 1]).tolist() == [0, 1, 0]
    assert model.predict(np.array([[0, 1], [3, 4]], dtype=np.int32)).tolist() == [[1, 0], [0, 1]]
    assert model.predict(np.zeros((0,), dtype=np.int64)).shape == (0,)
    env = gymnasium.make("FrozenLake-v1")
    observation, _ = env.reset(seed=0)
    env.step(PGTS("FrozenLake-v1").predict(observation))


def test_predict_samples_from_the_policy_unless_deterministic():
    # 5 standard errors of 4,000 draws: fails by chance with probability 6e-7, here and call by call.
    policy = SimplexPolicy(5, 2)
    policy.load_state_dict({"probs_SA": right_with(0.7, 0.0, 0.0, 0.0, 1.0)})
    model, twin = (PGTS(vector_env(ladder(), 2), policy=policy) for _ in range(2))
    drawn = model.predict(np.zeros(4000, dtype=np.int64), deterministic=False)
    assert abs(drawn.mean() - 0.7) < 5 * (0.21 / 4000) ** 0.5
    assert np.array_equal(drawn, twin.predict(np.zeros(4000, dtype=np.int64), deterministic=False))
    one_by_one = np.array([model.predict(0, deterministic=False) for _ in range(4000)])
    assert abs(one_by_one.mean() - 0.7) < 5 * (0.21 / 4000) ** 0.5
    given = model.predict(np.zeros(4000, dtype=np.int64), deterministic=False, generator=stream(1, "mine"))
    assert not np.array_equal(drawn, given)
    assert model.predict([1, 4], deterministic=False).tolist() == [0, 1]


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (5, "state 5 does not exist; states are 0 to 4"),
        ([0, -1], "state -1"),
        (0.5, "float64"),
        ([0.0], "float64"),
        (True, "bool"),
        ("0", "states are integers"),
    ],
)
def test_an_observation_that_is_no_state_is_refused(observation, message):
    with pytest.raises(PgtsError, match=message):
        make().predict(observation)


@pytest.mark.parametrize("env", ["pgts/Random-v0", "FrozenLake-v1"])
def test_the_same_seed_gives_the_same_bits_and_another_seed_others(env):
    first, second, other = make(env), make(env), make(env, seed=8)
    for model in (first, second, other):
        model.learn(150)
    assert same(bits(first), bits(second))
    assert not same(bits(first), bits(other))


@pytest.mark.parametrize(
    "critic", ["tabular", {"type": "tabular", "target": "q"}, {"type": "rollout", "samples": 2}, "exact"]
)
def test_lookaheads_and_predictions_do_not_change_the_training(critic):
    quiet, asked = make(critic=critic), make(critic=critic)
    for _ in range(4):
        first, second = quiet.iterate(), asked.iterate()
        assert same_bits(first.experience, second.experience)
        asked.lookahead(torch.arange(5), depth=5)
        asked.predict(np.arange(5), deterministic=False)
        asked.critic.v(torch.arange(5))
        asked.policy.table()
    assert same(bits(quiet), bits(asked))


def test_global_generators_are_neither_used_nor_changed():
    first, second = make("FrozenLake-v1"), make("FrozenLake-v1")
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    first.learn(100)
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002
    torch.rand(3)
    np.random.random(3)  # noqa: NPY002
    second.learn(100)
    assert same(bits(first), bits(second))


@pytest.mark.parametrize("env", ["FrozenLake-v1", "CliffWalking-v1", "Taxi-v4"])
def test_gymnasiums_tabular_environments_can_be_learned_from(env):
    steps = []
    model = make(env, depth=3).learn(
        200, callback=lambda model, seen: steps.append(int(seen.experience.alive_TB.sum()))
    )
    assert model.num_env_steps == sum(steps) >= 200
    assert (model.mdp.num_states, model.mdp.num_actions) == (
        model.world.env.single_observation_space.n,
        model.world.env.single_action_space.n,
    )
    assert model.gamma == 0.99
    assert make(env, gamma=0.5).gamma == 0.5


@pytest.mark.parametrize("env", ["pgts/Ladder-v0", "pgts/Grid-v0", "FrozenLake-v1"])
def test_a_training_queries_the_model_at_most_once_for_each_state_and_action(env):
    total = 0

    def count(model, iteration):
        nonlocal total
        total += iteration.model_calls

    model = make(env, depth=6).learn(1_000, callback=count)
    assert 0 < model.num_model_calls == total <= model.mdp.num_states * model.mdp.num_actions


@pytest.mark.parametrize(("depth", "looks"), [(0, [0]), (3, [0, 3])])
def test_an_iteration_searches_once_at_depth_0_and_once_at_its_own_depth(depth, looks, monkeypatch):
    model, made = make(depth=depth), []
    look_ahead = model.search.look_ahead
    monkeypatch.setattr(
        model.search,
        "look_ahead",
        lambda leaves, *rest: made.append(leaves.expansions - 1) or look_ahead(leaves, *rest),
    )
    model.iterate()
    assert model.critic.target == "v"  # so it expands one level more
    assert made == looks


def test_with_sampled_advantages_a_critic_values_each_visit_and_each_end_once_and_then_learns(monkeypatch):
    estimator = {"type": "sampled", "lambda": 0.9}
    model = make("CartPole-v1", depth=0, estimator=estimator, policy="mlp", critic={"type": "network", "num_epochs": 1})
    network, rows = model.critic.network, []
    outputs = network.outputs
    monkeypatch.setattr(network, "outputs", lambda seen_N: rows.append(len(seen_N)) or outputs(seen_N))
    experience = model.iterate().experience
    assert rows == [experience.num_steps + experience.num_episodes]


def test_model_calls_of_the_rollout_critic_are_counted():
    model = make(critic={"type": "rollout", "samples": 2, "horizon": {"type": "fixed", "length": 3}})
    seen = model.iterate()
    assert seen.model_calls == model.search.model_calls + model.critic.model_calls == model.num_model_calls
    assert model.critic.model_calls > 0


def test_an_environment_without_a_model_is_refused_with_what_is_missing():
    class Unpublished(gymnasium.Env):
        observation_space = gymnasium.spaces.Discrete(3)
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.dice = Dice(0)  # a generator of a class of its own
            return 0, {}

        def step(self, action):
            return int(action), 0.0, False, False, {}

    env = gymnasium.vector.SyncVectorEnv([Unpublished], autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED)
    with pytest.raises(MissingModel, match="get_state") as caught:
        PGTS(env)
    assert "Unpublished" in str(caught.value)
    with pytest.raises(MissingModel, match="get_state"):
        PGTS(Unpublished)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"depth": -1}, "depth is -1"),
        ({"depth": 1.5}, "depth is 1.5"),
        ({"policy": "simplex", "update": "softmax"}, "update.type is softmax, which needs policy.type softmax"),
        ({"policy": SoftmaxPolicy(4, 2)}, r"\(4, 2\); the environment has \(5, 2\)"),
        ({"gamma": 1.5}, "gamma is 1.5"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": "any"}, "seed is any; it must be a whole number"),
        ({"device": "auto"}, "device is 'auto', where torch cannot compute: Expected one of cpu"),
        ({"num_envs": 0}, "num_envs is 0; it must be a whole number >= 1"),
        ({"env_kwargs": {"length": 3}}, "no argument 'length'"),
        ({"env": "pgts/Nowhere-v0"}, "pgts/Nowhere-v0 cannot be made"),
        ({"horizon": 3}, "horizon is 3"),
        ({"critic": 3}, "critic is 3"),
        ({"env": vector_env(ladder(), 4), "gamma": 0.5}, "gamma is 0.5; the environment has its own, 0.9"),
        ({"env": vector_env(ladder(), 2), "env_kwargs": {"n": 3}}, "takes none"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"update": "mirror"}, "^update.type is mirror"),
        (
            {"policy": "softmax", "update": "mirror"},
            "^estimator.type is sampled, which needs policy.type mlp",
        ),
        ({"depth": 1}, "^depth is 1"),
        ({"critic": "exact"}, "^critic.type is exact"),
        ({"critic": "rollout"}, "^critic.type is rollout"),
        ({"critic": {"type": "tabular", "target": "q"}}, "^critic.type is tabular and critic.target q"),
        ({"critic": {"type": "network", "target": "q"}}, "^critic.type is network and critic.target q"),
    ],
)
def test_sampled_advantages_are_refused_with_parts_that_they_do_not_fit(options, message):
    sampled = {"depth": 0, "estimator": "sampled", "policy": "mlp", "update": "ppo"}
    make(**sampled).iterate()
    with pytest.raises(PgtsError, match=message):
        make(**sampled | options)


def test_parts_may_be_given_as_objects():
    model = PGTS(
        vector_env(grid(4, traps=(5,)), 3),
        policy=SoftmaxPolicy(16, 4),
        critic=TabularCritic(16, 4, TabularValues(target="q")),
        update=SoftmaxUpdate(SoftmaxGradient(step_size=0.2)),
    )
    assert model.iterate().depth == 4
    assert model.options.update == SoftmaxGradient(step_size=0.2)
    with pytest.raises(PgtsError, match="was given as a VectorEnv of which no others can be made"):
        model.source.make(2)


def test_the_defaults_update_every_kind_of_policy():
    assert make().update.options == Mirror(step_size=1.0, state_weight="uniform", normalize="rms", floor=12.0)
    assert type(make(policy="simplex").update).__name__ == "ProjectedUpdate"


def test_the_device_and_max_nodes_are_passed_on():
    assert make(device="cpu").world.model.device == torch.device("cpu")
    with pytest.raises(PgtsError, match="max_nodes is 3"):
        make(search={"type": "expectimax", "max_nodes": 3}).iterate()


def test_without_a_seed_one_is_drawn_and_said(capsys, tmp_path):
    first, second = (PGTS("pgts/Ladder-v0", seed=None, num_envs=2) for _ in range(2))
    assert first.seed != second.seed
    assert capsys.readouterr().err.splitlines()[1] == f"note: seed is None; this training has the seed {second.seed}"
    again = PGTS("pgts/Ladder-v0", seed=first.seed, num_envs=2)
    first.iterate()
    again.iterate()
    assert torch.equal(first.policy_table(), again.policy_table())
    first.save(tmp_path / "model.pt")
    assert PGTS.load(tmp_path / "model.pt").seed == first.seed


@pytest.mark.parametrize(
    "arguments",
    [
        {"env": "CartPole-v1", "depth": 1, "policy": {"type": "mlp", "hidden": [32]}, "gamma": 0.9},
        {"env": "pgts/Ladder-v0", "depth": "adaptive", "max_depth": 6, "seed": 3},
        {"env": "pgts/DeepSea-v0", "env_kwargs": {"n": 5}, "model": "counts", "depth": 4},
        {"env": "CartPole-v1", "depth": 0, "estimator": "sampled", "update": {"type": "ppo", "clip_range": 0.1}},
        {"env": "CartPole-v1", "search": {"type": "mcts", "simulations": 8}, "max_roots": 5, "horizon": "geometric"},
    ],
)
def test_what_is_printed_of_a_training_makes_the_same_one_again(arguments):
    model = PGTS(**arguments)
    again = eval(repr(model))
    assert again.options == model.options
    assert (again.gamma, again.seed, again.source.name) == (model.gamma, model.seed, model.source.name)
    assert repr(again) == repr(model)
    assert repr(PGTS(**{**arguments, "seed": 9})) != repr(model)


def test_an_environment_that_is_an_object_is_printed_as_no_id():
    assert repr(PGTS(lambda: gymnasium.make("CartPole-v1"), depth=1)).startswith("PGTS(<lambda>, ")
