"""Evaluation during training: when it is made, what it says, that it changes nothing, and when it ends the training."""

import math

import gymnasium
import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.agent.callbacks import EvalCallback
from pgts_torch.agent.evaluate import Evaluator, Score, evaluate
from pgts_torch.errors import PgtsError
from pgts_torch.models.environments import EnvSource
from tests.agent.helpers import same_bits, vector_env
from tests.agent.test_world import same_weights
from tests.support import right_with

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

STEPS = 4 * 12
"""Environment steps of an iteration."""


def make(env: str = "pgts/Ladder-v0", **kwargs) -> PGTS:
    return PGTS(env, **{"depth": 2, "num_envs": 4, "horizon": {"type": "fixed", "length": 12}, "seed": 7} | kwargs)


def short_lake(**kwargs) -> PGTS:
    """FrozenLake without ice, whose shortest way to the goal has 6 steps; a lookahead of 6 steps sees it."""
    fast = {"type": "softmax", "step_size": 50.0}
    return make("FrozenLake-v1", depth=6, update=fast, env_kwargs={"is_slippery": False}, **kwargs)


@pytest.mark.parametrize(
    ("every", "marks"), [(1, [1, 2, 3, 4, 5]), (STEPS, [1, 2, 3, 4, 5]), (100, [3, 5]), (150, [4]), (999, [])]
)
def test_an_evaluation_follows_the_iteration_that_completes_the_steps(every, marks):
    callback = EvalCallback(every=every, episodes=2)
    make().learn(5 * STEPS, callback=callback)
    assert [made.env_steps for made in callback.history] == [mark * STEPS for mark in marks]


def test_a_continued_training_is_evaluated_at_the_same_steps(tmp_path):
    whole, first, second = (EvalCallback(every=100, episodes=2) for _ in range(3))
    make().learn(5 * STEPS, callback=whole)
    model = make().learn(2 * STEPS, callback=first)
    model.save(tmp_path / "model.pt")
    PGTS.load(tmp_path / "model.pt").learn(5 * STEPS, callback=second)
    assert first.history == []
    assert second.history == whole.history


@pytest.mark.fault("evaluation and logging")
@pytest.mark.parametrize("env", ["pgts/Ladder-v0", "FrozenLake-v1", "CartPole-v1"])
def test_evaluations_leave_every_bit_of_the_training_as_it_is(env):
    seen: dict[str, list] = {"quiet": [], "watched": []}
    short = {"depth": 1, "num_envs": 3, "horizon": {"type": "fixed", "length": 8}}
    quiet, watched, other = make(env, **short), make(env, **short), make(env, **short, seed=8)
    quiet.learn(60, callback=lambda model, made: seen["quiet"].append(made.experience))
    evaluations = [EvalCallback(every=1, episodes=2, deterministic=kind) for kind in (True, False)]
    watched.learn(60, callback=[*evaluations, lambda model, made: seen["watched"].append(made.experience)])
    other.learn(60)
    assert len(evaluations[0].history) == len(evaluations[1].history) == len(seen["quiet"]) >= 3
    assert all(same_bits(*pair) for pair in zip(seen["quiet"], seen["watched"], strict=True))
    assert same_weights(quiet, watched)
    assert not same_weights(quiet, other)


@pytest.mark.fault("rendering")
@pytest.mark.parametrize("env", ["pgts/Ladder-v0", "FrozenLake-v1", "CartPole-v1"])
def test_rendering_leaves_every_bit_of_the_training_as_it_is(env):
    if not env.startswith("pgts/"):
        pytest.importorskip("pygame")
    pictures = []
    short = {"depth": 1, "num_envs": 3, "horizon": {"type": "fixed", "length": 8}}
    unseen, drawn = make(env, **short), make(env, **short, env_kwargs={"render_mode": "rgb_array"})
    unseen.learn(60)
    drawn.learn(60, callback=lambda model, made: pictures.extend(model.world.env.render()))
    assert len(pictures) == 3 * drawn.num_iterations
    assert pictures[0].ndim == 3
    assert same_weights(unseen, drawn)


def test_training_ends_when_the_evaluated_return_is_high_enough():
    reached, never = (EvalCallback(every=1, episodes=2, stop_at_return=value) for value in (1.0, 1.01))
    assert short_lake().learn(9 * STEPS, callback=reached).num_env_steps < 5 * STEPS
    assert reached.history[-1].mean == 1.0
    assert all(made.mean < 1 for made in reached.history[:-1])
    assert short_lake().learn(9 * STEPS, callback=never).num_env_steps >= 9 * STEPS


def test_all_callbacks_are_called_though_one_of_them_ends_the_training():
    counts = [0, 0]

    def first(model, iteration):
        counts[0] += 1
        return False

    def second(model, iteration):
        counts[1] += 1

    assert make().learn(5 * STEPS, callback=[first, second]).num_iterations == 1
    assert counts == [1, 1]
    assert make().learn(5 * STEPS, callback=(second, second)).num_iterations == 5
    assert counts == [1, 11]


def test_the_model_with_the_best_return_is_kept(tmp_path):
    path = tmp_path / "best.pt"
    model = make(update={"type": "softmax", "step_size": 1e-6})
    callback = EvalCallback(every=1, episodes=5, best_path=path)
    policies = [right_with(*[right] * 5) for right in (0.1, 0.9, 0.2, 0.9)]
    for pi_SA in policies:
        model.policy.load_state_dict({"logits_SA": pi_SA.log()})
        assert callback(model, model.iterate())
    returns = [made.mean for made in callback.history]
    assert returns == [0.0, 96.0, 0.0, 96.0]
    assert callback.best == callback.history[1]
    assert PGTS.load(path).num_iterations == 2
    assert PGTS.load(path).predict(0) == 1


def test_an_evaluation_is_the_mean_of_its_episodes_with_the_interval_of_student():
    # Greedy and never slipping: every episode is the same, so the interval has no width; drawn ones differ.
    model = short_lake().learn(10 * STEPS)
    greedy = evaluate(model, episodes=4)
    assert (greedy.episodic_return.mean, greedy.episodic_return.half_width) == (1.0, 0.0)
    assert (greedy.episodes, greedy.episodic_length.mean) == (4, 6.0)
    assert greedy.discounted_return.mean == pytest.approx(0.99**5)
    uniform = short_lake(policy="softmax")
    drawn = evaluate(uniform, episodes=3, deterministic=False, seed=1)
    assert drawn.episodic_length.half_width > 0
    score = Score.of(torch.tensor([1.0, 2.0, 6.0]))  # deviation sqrt(7); t is 4.302653 with 2 degrees of freedom
    assert (score.mean, score.half_width) == (3.0, pytest.approx(4.302653 * math.sqrt(7 / 3), abs=1e-5))


def test_evaluations_in_the_same_environments_are_those_in_new_ones_and_make_them_once(monkeypatch):
    made, real = [], EnvSource.make
    monkeypatch.setattr(EnvSource, "make", lambda source, count, **_: made.append(count) or real(source, count))
    model = PGTS("CartPole-v1", depth=0, policy="mlp", num_envs=2, seed=0)
    made.clear()
    with Evaluator(3) as evaluator:
        greedy, drawn, again = (evaluator(model, deterministic=kind, seed=1) for kind in (True, False, True))
        callbacks = [EvalCallback(every=1, evaluator=evaluator, deterministic=kind) for kind in (True, False)]
        model.learn(1, callback=callbacks)
    assert made == [3]
    assert [len(callback.history) for callback in callbacks] == [1, 1]
    assert greedy == again != drawn
    fresh = PGTS("CartPole-v1", depth=0, policy="mlp", num_envs=2, seed=0)
    assert greedy == evaluate(fresh, episodes=3, seed=1)
    assert drawn == evaluate(fresh, episodes=3, deterministic=False, seed=1)
    assert made == [3, 2, 3, 3]


@pytest.mark.fault("no time limit and no horizon")
def test_an_evaluation_without_a_time_limit_ends_at_our_own(monkeypatch):
    monkeypatch.setattr("pgts_torch.agent.evaluate.UNLIMITED_LENGTH", 30)
    model = PGTS("CliffWalking-v1", depth=0, num_envs=2, seed=0)
    assert model.source.time_limit is None
    assert evaluate(model, episodes=2, deterministic=True).episodic_length.mean == 30


def test_an_environment_given_as_an_object_is_evaluated_in_new_ones_of_its_kind():
    given = [
        gymnasium.make("FrozenLake-v1", is_slippery=False),
        lambda: gymnasium.make("FrozenLake-v1", is_slippery=False),
        gymnasium.vector.SyncVectorEnv(
            [lambda: gymnasium.make("FrozenLake-v1", is_slippery=False)] * 2,
            autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED,
        ),
    ]
    lengths = [evaluate(PGTS(env, depth=0, num_envs=2), episodes=3).episodic_length.mean for env in given]
    assert lengths == [100.0] * 3  # always left, until the time limit
    refused = r"of which no others can be made; give a SyncVectorEnv or an id \(.* pgts train --processes N\)"
    with pytest.raises(PgtsError, match=refused):
        evaluate(PGTS(vector_env(short_lake().mdp, 2)), episodes=2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, "every is 0; it must be a whole number of at least 1"),
        ({"every": 1, "episodes": 0}, "episodes is 0; it must be a whole number of at least 1"),
        ({"every": 1, "stop_at_return": math.nan}, "stop_at_return is nan; it must be finite"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(PgtsError, match=message):
        EvalCallback(**options)
