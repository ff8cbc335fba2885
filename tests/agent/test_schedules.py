"""Options that change by environment steps: their values on paper, in each place that has them, and after a resume."""

import copy
import math

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.config import load
from pgts_torch.errors import PgtsError
from pgts_torch.options import CMPO, MPO, PPO, Gradient, Mirror, NetworkValues, Projected, SoftmaxGradient
from pgts_torch.options.schedules import at, value_at

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

SHORT = {"depth": 0, "num_envs": 2, "horizon": {"type": "fixed", "length": 20}, "estimator": "sampled"}
RATE = "linear(1e-2, 1e-4, 100)"


def same_bits(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


def test_values_on_paper():
    assert value_at(0.5, 10) == 0.5
    assert [value_at("linear(1, 0, 100)", n) for n in (0, 25, 100, 1000)] == [1, 0.75, 0, 0]
    assert [value_at("cosine(3, 1, 1e2)", n) for n in (0, 100, 1000)] == [3, 1, 1]
    assert value_at("cosine(3,1,100)", 50) == pytest.approx(2)
    assert value_at("cosine(3, 1, 100)", 25) == pytest.approx(2 + math.cos(math.pi / 4))
    options = PPO(clip_range="linear(0.2, 0.1, 10)", entropy_coef="cosine(0, 1, 10)")
    now = at(options, 5)
    assert (now.clip_range, now.entropy_coef) == (pytest.approx(0.15), pytest.approx(0.5))
    assert now.learning_rate == 3e-4
    assert at(PPO(), 5) == PPO()


@pytest.mark.parametrize(
    "text",
    [
        "linear(1, 2)",
        "linear(0, 0, 10)",
        "linear(-1, 1, 10)",
        "linear(nan, 1, 5)",
        "step(1, 2, 3)",
        "linear(1, x, 10)",
        "linear(1, 0, 0)",
        "linear(1, -1, 5)",
        "linear(1, nan, 5)",
        "linear(1, 0, inf)",
        "linear(1, 0, 5) ",
    ],
)
def test_what_is_no_schedule_is_refused_with_the_form_of_one(text):
    with pytest.raises(
        PgtsError, match=r"learning_rate is '.*'; it must be a number > 0, or linear\(FROM, TO, STEPS\)"
    ):
        PGTS("CartPole-v1", **SHORT, update={"type": "ppo", "learning_rate": text})


@pytest.mark.parametrize("update", [PPO, Gradient, CMPO, Mirror])
def test_each_update_of_networks_and_the_critic_follow_their_schedule(update):
    depth = {} if update in (PPO, Gradient) else {"depth": 1, "estimator": "lookahead"}
    scheduled, critic = update(learning_rate=RATE), NetworkValues(learning_rate="linear(1e-3, 0, 30)")
    model = PGTS("CartPole-v1", **SHORT | depth, policy="mlp", update=scheduled, critic=critic)
    seen, rates = [], []
    for _ in range(4):
        seen.append(model.num_env_steps)
        before = model.critic.network.weights[0].clone()  # the head is rescaled with the targets
        model.iterate()
        rates.append(model.update._optimiser.learning_rate)
        assert torch.equal(before, model.critic.network.weights[0]) == (seen[-1] >= 30)
    assert rates == [value_at(RATE, n) for n in seen]
    assert len(set(rates)) > 2


PENDULUM = {"policy": "gaussian", "actions": 3, "depth": 0, "num_envs": 2, "horizon": SHORT["horizon"]}


@pytest.mark.parametrize("kind", [PPO, MPO, Gradient])
def test_a_rate_may_begin_at_0_also_that_of_a_gaussian_policy(kind):
    env, options = ("CartPole-v1", SHORT) if kind is PPO else ("Pendulum-v1", PENDULUM)
    model = PGTS(env, **options, update=kind(learning_rate="linear(0, 1e-3, 20)"))
    states = [model.policy.state_dict()]
    for _ in range(2):
        model.iterate()
        states.append(model.policy.state_dict())
    assert same_bits(states[0], states[1])
    assert not same_bits(states[1], states[2])


def test_a_clip_range_that_changes_is_the_one_that_is_used():
    ranges = [0.2, "linear(0.2, 0.001, 1)", 0.001]
    models = [PGTS("CartPole-v1", **SHORT, update=PPO(clip_range=each, learning_rate=1e-2)) for each in ranges]
    policies = [[each.iterate(), copy.deepcopy(each.policy.state_dict())][1] for each in models]
    assert same_bits(policies[0], policies[1])
    for model, policy in zip(models[1:], policies[1:], strict=True):
        model.policy.load_state_dict(policy)
    clipped = [each.iterate().losses["clip_fraction"] for each in models]
    assert clipped[1] > clipped[0]


@pytest.mark.parametrize(
    ("policy", "kind"), [("softmax", Mirror), ("simplex", Mirror), ("softmax", SoftmaxGradient), ("simplex", Projected)]
)
def test_the_step_size_of_tables_is_that_of_the_schedule(policy, kind):
    make = lambda eta: PGTS("pgts/Ladder-v0", depth=1, policy=policy, update=kind(step_size=eta), num_envs=2)  # noqa: E731
    scheduled, constant, small = (make(eta) for eta in ("linear(1, 0.1, 1)", 1.0, 0.1))
    for one in (scheduled, constant):
        one.iterate()
    first = scheduled.policy.state_dict()
    assert same_bits(first, constant.policy.state_dict())
    small.iterate()
    assert not same_bits(first, small.policy.state_dict())
    small.load_state_dict(constant.state_dict())
    for one in (scheduled, small):
        one.iterate()
    assert scheduled.update.step_size == 0.1
    assert same_bits(scheduled.policy.state_dict(), small.policy.state_dict())
    assert not same_bits(scheduled.policy.state_dict(), first)


def test_the_policy_that_explores_a_learned_table_follows_the_schedule_too():
    steps = {"horizon": {"type": "steps", "first": 10, "length": 10}, "num_envs": 1, "replay": {"length": 1}}
    model = PGTS("pgts/Ladder-v0", model="counts", depth=1, **steps, update=Mirror(step_size="linear(1, 0, 20)"))
    for _ in range(2):
        expected = 1 - model.num_env_steps / 20
        model.iterate()
        critic, update = model.parts.dyna.explorer.learners
        assert update is not model.update
        assert update.step_size == model.update.step_size == pytest.approx(expected)
        assert critic.num_env_steps == model.critic.num_env_steps
    assert expected < 1


def test_the_clip_of_cmpo_is_that_of_the_schedule():
    given = {"depth": 1, "num_envs": 2, "horizon": {"type": "fixed", "length": 20}}
    model = PGTS("CartPole-v1", **given, update=CMPO(clip="linear(0.5, 0, 1)"))
    before = model.policy.state_dict()
    model.iterate()
    moved = model.policy.state_dict()
    assert not same_bits(before, moved)
    model.iterate()  # at 0 the target is the policy itself
    assert same_bits(moved, model.policy.state_dict())


def test_a_training_goes_on_with_its_schedule_and_with_more_steps_in_all(tmp_path):
    make = lambda: PGTS("CartPole-v1", **SHORT, update=PPO(learning_rate=RATE, entropy_coef="cosine(0.1, 0, 200)"))  # noqa: E731
    whole, half = make().learn(200), make().learn(60)
    half.save(tmp_path / "half.pt")
    loaded = PGTS.load(tmp_path / "half.pt").learn(200)
    assert loaded.options.update.learning_rate == RATE
    assert same_bits(whole.policy.state_dict(), loaded.policy.state_dict())
    constant = PGTS("CartPole-v1", **SHORT, update=PPO(learning_rate=1e-2)).learn(200)
    assert not same_bits(whole.policy.state_dict(), constant.policy.state_dict())


def test_a_configuration_and_the_command_line_take_it():
    config = load(None, ["--env.id", "CartPole-v1", "--update.type", "ppo", "--update.learning_rate", RATE])
    assert config.update.learning_rate == RATE
    assert torch.is_tensor(PGTS(**config.arguments()).iterate().observation_N)
