"""A user's environment that fails: one error names the environment, the step and the seeds of its episodes."""

import itertools
import re

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from pgts_torch import PGTS, EvalCallback
from pgts_torch.errors import Failed, MissingModel, PgtsError
from pgts_torch.seeding import seed_sequence

pytestmark = pytest.mark.usefixtures("unchecked_shapes")


class Clock(gymnasium.Env):
    """Counts its steps, of which the fourth may go wrong."""

    observation_space = spaces.Box(0, 100, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.shown(), {}

    def step(self, action):
        self.time += 1
        if self.time == 4:
            return self.fourth()
        return self.shown(), 1.0, False, False, {}

    def shown(self):
        return np.full(2, self.time, np.float32)

    def fourth(self):
        return self.shown(), 1.0, False, False, {}

    def get_state(self):
        return self.time

    def set_state(self, state):
        self.time = state


class Raises(Clock):
    def fourth(self):
        raise RuntimeError("the spring broke")


class Unseen(Clock):
    def fourth(self):
        return np.full(2, np.nan, np.float32), 1.0, False, False, {}


class Longer(Clock):
    def fourth(self):
        return np.zeros(3, np.float32), 1.0, False, False, {}


class Shorter(Clock):
    def fourth(self):
        return np.zeros(1, np.float32), 1.0, False, False, {}


class Worthless(Clock):
    def fourth(self):
        return self.shown(), np.nan, False, False, {}


class Terse(Clock):
    def fourth(self):
        return self.shown(), 1.0, False


class Silent(Clock):
    def fourth(self):
        return self.shown(), 1.0, False, False, None


class Changing(Clock):
    """It has as many actions as its seed says."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.action_space = spaces.Discrete(2 + seed % 3)
        return super().reset(seed=seed)


class Unborn(Clock):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.full(2, np.nan, np.float32), {}


class Stillborn(Clock):
    def reset(self, *, seed=None, options=None):
        raise RuntimeError("no start")


class Misborn(Clock):
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}


def make(env: type[gymnasium.Env], **kwargs) -> PGTS:
    short = {"depth": 0, "estimator": "sampled", "num_envs": 2, "horizon": {"type": "fixed", "length": 6}, "seed": 5}
    return PGTS(env, **short | kwargs)


def seeds(*names: str | int) -> list[int]:
    return seed_sequence(5, *names, "env").generate_state(2).tolist()


FAILURES = {
    Raises: "in step 3 .* RuntimeError: the spring broke",
    Unseen: r"in step 3 .* the observation is \[nan, nan\]; it must be finite",
    Longer: r"in step 3 .* the observation has shape \(3,\); \(2,\) is declared",
    Shorter: r"in step 3 .* the observation has shape \(1,\); \(2,\) is declared",
    Worthless: "in step 3 .* the reward is nan",
    Silent: "in step 3 .* info is None; reset and step must return a dictionary",
    Terse: "in step 3 .* not enough values to unpack",
    Unborn: r"at the start .* the observation is \[nan, nan\]; it must be finite",
    Misborn: "at the start .* Output array is the wrong shape",
}
NOT_FINITE = {Unseen: "observation", Worthless: "reward", Unborn: "observation"}


@pytest.mark.fault("environment raises an error")
@pytest.mark.parametrize("env", FAILURES)
@pytest.mark.parametrize("options", [{}, {"depth": 1, "estimator": "lookahead"}], ids=["plain", "lookahead"])
def test_what_fails_in_a_rollout_is_named_with_its_step_and_seeds(env, options):
    with pytest.raises(PgtsError, match=f"^{env.__name__} failed {FAILURES[env]}") as caught:
        make(env, **options).iterate()
    both = seeds("iteration", 0)
    named = f"the episodes with the seeds {both}: " if env is Misborn else f"the episode with the seed {both[0]}: "
    assert named in str(caught.value)
    assert getattr(caught.value, "what", None) == NOT_FINITE.get(env)
    assert make(Clock, **options).iterate().experience.num_steps == 12


@pytest.mark.filterwarnings("ignore:.*attributes are pickled")
@pytest.mark.parametrize("env", FAILURES)
def test_what_fails_in_the_trial_of_a_simulator_is_no_missing_model(env):
    bare = type(env.__name__, (env,), {"get_state": None})
    message = FAILURES[env].partition(".* ")[2]
    with pytest.raises(PgtsError, match=f"^{env.__name__} (fails in random walks|failed .*): .*{message}") as caught:
        make(bare, depth=1, estimator="lookahead").iterate()
    assert not isinstance(caught.value, MissingModel)
    assert getattr(caught.value, "what", None) == NOT_FINITE.get(env)


@pytest.mark.parametrize("env", [Raises, Unseen, Longer, Worthless])
def test_of_many_copies_the_one_that_failed_is_named(env):
    class Sometimes(env):
        def reset(self, *, seed=None, options=None):
            observation = super().reset(seed=seed)
            self.unlucky = self.np_random.random() < 0.1
            return observation

        def fourth(self):
            return super().fourth() if self.unlucky else Clock.fourth(self)

    with pytest.raises(PgtsError, match=r"with the seed \d+: ") as caught:
        make(Sometimes, num_envs=32).iterate()
    failed = Sometimes()
    failed.reset(seed=int(re.search(r"seed (\d+): ", str(caught.value))[1]))
    assert failed.unlucky


def test_what_cannot_start_is_named_by_whoever_starts_it_first():
    with pytest.raises(PgtsError, match=r"Stillborn failed at the start of .*: RuntimeError: no start"):
        make(Stillborn).iterate()
    with pytest.raises(PgtsError, match="Stillborn failed in reset with seed 0: RuntimeError: no start"):
        make(Stillborn, depth=1, estimator="lookahead")


def test_what_fails_in_an_evaluation_is_named_too():
    model = make(Raises, horizon={"type": "fixed", "length": 3})
    with pytest.raises(PgtsError, match=r"Raises failed in step 3 .* the spring broke") as caught:
        model.learn(100, callback=EvalCallback(every=1, episodes=2, seed=5))
    assert f"the seed {seeds('evaluate', 'deterministic')[0]}: " in str(caught.value)


@pytest.mark.parametrize("env", [Raises, Worthless, Unseen, Longer])
def test_what_fails_in_a_lookahead_is_named_with_its_environment(env):
    short = {"depth": 2, "estimator": "lookahead", "horizon": {"type": "fixed", "length": 2}}
    assert make(env, **short | {"depth": 1}).iterate().depth == 1
    with pytest.raises(PgtsError, match=f"{env.__name__}") as caught:
        make(env, **short).iterate()
    assert getattr(caught.value, "what", None) == NOT_FINITE.get(env)


@pytest.mark.fault("environment without a model")
def test_an_environment_without_a_model_is_refused_where_a_lookahead_needs_one_and_not_elsewhere():
    class Unknown(Clock):
        get_state = set_state = None

        def shown(self):
            return super().shown() + next(steps) % 2

    steps = itertools.count()
    with pytest.raises(MissingModel, match="Unknown cannot be restored: give Unknown the methods get_state"):
        make(Unknown, depth=1, estimator="lookahead")
    with pytest.raises(MissingModel, match=r"or take depth 0 and the estimator 'sampled', which need no model"):
        make(Unknown, depth=0, estimator="lookahead")
    assert make(Unknown).iterate().model_calls == 0


def test_actions_that_a_reset_changes_are_refused_and_so_is_a_reset_without_info():
    message = r"Changing failed .* the seed \d+: its actions are Discrete\(\d\) after a reset, and were Discrete\(2\)"
    with pytest.raises(Failed, match=message):
        make(Changing, num_envs=8).learn(200)

    class Bare(Clock):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)[0], None

    with pytest.raises(PgtsError, match="Bare returns an info that is None in reset; it must be a dictionary"):
        make(Bare)


@pytest.mark.parametrize("callback", [3, [3], "evaluate", {"every": 3}])
def test_a_callback_that_cannot_be_called_is_refused(callback):
    with pytest.raises(PgtsError, match=r"callback is .*; it must be a function of"):
        make(Clock).learn(10, callback=callback)
