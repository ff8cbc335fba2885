"""The forms in which environments say rewards and discounts, wherever a step is made."""

from decimal import Decimal
from fractions import Fraction
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space

from pgts_torch import PGTS, evaluate
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models import check_model

pytestmark = pytest.mark.usefixtures("unchecked_shapes")


class Clock(gymnasium.Env):
    """Counts its steps, each of which pays 1, in some form, and ends after five."""

    observation_space = spaces.Box(0, 100, (1,), np.float32)
    action_space = spaces.Discrete(2)
    form: Any = float
    info: ClassVar[dict[str, Any]] = {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.full(1, self.time, np.float32), {}

    def step(self, action):
        self.time += 1
        return np.full(1, self.time, np.float32), type(self).form(1), self.time == 5, False, self.info

    def get_state(self):
        return self.time

    def set_state(self, state):
        self.time = state


class Declared(Clock):
    metadata: ClassVar = {"discounts": True}


class Together(VectorEnv):
    """Two clocks in step."""

    metadata: ClassVar = {"autoreset_mode": AutoresetMode.DISABLED}
    info: ClassVar[dict[str, Any]] = {}
    num_envs = 2
    single_observation_space, single_action_space = Clock.observation_space, Clock.action_space
    observation_space, action_space = batch_space(Clock.observation_space, 2), batch_space(Clock.action_space, 2)

    def __init__(self, form: Any = np.ones) -> None:
        self.form, self.time_B = form, np.zeros(2)

    def reset(self, *, seed=None, options=None):
        mask_B = (options or {}).get("reset_mask", np.ones(2, dtype=bool))
        self.time_B[mask_B] = 0
        return self.time_B[:, None].astype(np.float32), {}

    def step(self, actions):
        self.time_B += 1
        return self.time_B[:, None].astype(np.float32), self.form(2), self.time_B == 5, np.zeros(2, bool), self.info


class DeclaredTogether(Together):
    metadata: ClassVar = Together.metadata | {"discounts": True}


def make(env: Any, **options: Any) -> PGTS:
    short = {"depth": 0, "estimator": "sampled", "num_envs": 2, "policy": "mlp", "gamma": 0.9, "seed": 5}
    return PGTS(env, **short | {"horizon": {"type": "fixed", "length": 9}} | options)


LOOKAHEAD = {"depth": 2, "estimator": "lookahead"}
FORMS = {
    "int": int,
    "bool": bool,
    "float32": np.float32,
    "int64": np.int64,
    "numpy bool": np.bool_,
    "array of one": lambda r: np.array([r], np.float32),
    "array [1, 1]": lambda r: np.array([[r]]),
    "array without axes": np.array,
    "tensor": lambda r: torch.tensor(float(r), requires_grad=True),
    "tensor of one": lambda r: torch.tensor([r]),
    "bfloat16": lambda r: torch.tensor(r, dtype=torch.bfloat16),
    "list of one": lambda r: [r],
    "fraction": lambda r: Fraction(r, 1),
    "decimal": Decimal,
}


@pytest.mark.parametrize("form", FORMS)
def test_a_reward_in_any_form_of_one_number_is_that_number(form):
    env = type("Formed", (Clock,), {"form": FORMS[form]})
    plain, looking, expected = make(env), make(env, **LOOKAHEAD), make(Clock, **LOOKAHEAD)
    assert plain.iterate().experience.reward_TB.tolist() == [[1.0, 1.0]] * 5
    seen, wanted = looking.iterate(), expected.iterate()
    assert seen.experience.reward_TB.tolist() == [[1.0, 1.0]] * 5
    assert torch.equal(seen.look.q_BA, wanted.look.q_BA)
    assert evaluate(plain, episodes=2).episodic_return.mean == 5
    assert check_model(env, continuations=2, length=3).usable


BAD_FORMS = {
    r"the reward has shape \(2,\); it must be one number, which a gymnasium.RewardWrapper can make of": lambda r: (
        np.ones(2)
    ),
    r"the reward has shape \(0,\); it must be one number": lambda r: [],
    r"the reward has shape \(2, 1\); it must be one number": lambda r: torch.ones(2, 1),
    "the reward is '1'; it must be one number": str,
    "the reward is None; it must be one number": lambda r: None,
    r"the reward is array\(\['1'\], dtype='<U1'\); it must be one number": lambda r: np.array([str(r)]),
    r"the reward is \(1\+0j\); it must be one number": complex,
    "the reward is a whole number that no float can hold": lambda r: 10**400,
}


@pytest.mark.fault("reward that is not one number")
@pytest.mark.parametrize("message", BAD_FORMS)
def test_a_reward_of_another_form_is_one_clear_error(message):
    env = type("Formed", (Clock,), {"form": staticmethod(BAD_FORMS[message])})
    with pytest.raises(PgtsError, match=rf"Formed failed in step 0 of the episode with the seed \d+: {message}"):
        make(env).iterate()
    with pytest.raises(PgtsError, match=message):
        make(env, **LOOKAHEAD).iterate()
    with pytest.raises(PgtsError, match=f"Formed fails in random walks with seed 0: {message}"):
        check_model(env, continuations=2, length=3)


def test_rewards_of_copies_that_step_together_are_one_number_each():
    for form in (np.ones, lambda n: np.ones((n, 1), np.float32), lambda n: [1] * n, torch.ones):
        assert make(Together(form)).iterate().experience.reward_TB.tolist() == [[1.0, 1.0]] * 5
    for form, message in [
        (lambda n: np.ones((n, 2)), r"the rewards have shape \(2, 2\); they must be 2 numbers"),
        (lambda n: np.ones((1, n)), r"the rewards have shape \(1, 2\)"),
        (lambda n: np.ones(3), r"the rewards have shape \(3,\)"),
        (lambda n: ["one", "one"], r"the rewards are \['one', 'one'\]; they must be 2 numbers"),
        (lambda n: 1.0, r"the rewards have shape \(1,\)"),
    ]:
        with pytest.raises(PgtsError, match=message):
            make(Together(form)).iterate()


# Discounts

PLACES = {
    "one by one": lambda env: env,
    "with a step of its own": lambda env: type(
        "Own", (SyncVectorEnv,), {"step": lambda s, a: SyncVectorEnv.step(s, a)}
    )([env] * 2, autoreset_mode=AutoresetMode.DISABLED),
}


@pytest.mark.fault("discount of another meaning in info")
@pytest.mark.parametrize("place", PLACES)
def test_a_discount_counts_only_where_the_environment_declares_it(place):
    shop = type("Shop", (Clock,), {"info": {"discount": 0.0}})
    assert make(PLACES[place](shop)).iterate().experience.discount_TB.tolist() == [[0.9, 0.9]] * 4 + [[0.0, 0.0]]
    half = type("Half", (Declared,), {"info": {"discount": np.array([0.5])}})
    if place == "one by one":
        assert make(half).iterate().experience.discount_TB.tolist() == [[0.5, 0.5]] * 4 + [[0.0, 0.0]]
    exact = type("Exact", (Declared,), {"info": {"discount": 0.5}})
    assert make(PLACES[place](exact)).iterate().experience.discount_TB.tolist() == [[0.5, 0.5]] * 4 + [[0.0, 0.0]]


def test_a_lookahead_has_the_discounts_of_the_steps():
    values = []
    for base in (Clock, Declared):
        env = type("Half", (base,), {"info": {"discount": 0.5}})
        values.append(make(env, **LOOKAHEAD, critic={"type": "network", "target": "v"}).iterate().look.q_BA)
    # Without the critic's share 1 + 0.9 + 0.81 against 1 + 0.5 + 0.25.
    assert not torch.allclose(*values)
    model = make(type("Half", (Declared,), {"info": {"discount": 0.5}}), **LOOKAHEAD)
    model.iterate()
    assert set(model.world.model.outcomes(torch.arange(3)).discount_NAK.flatten().tolist()) <= {0.5, 0.0}


def test_copies_together_declare_their_discounts_too():
    for env, expected in [(Together, 0.9), (DeclaredTogether, 0.5)]:
        named = type("Named", (env,), {"info": {"discount": np.full(2, 0.5)}})
        assert make(named()).iterate().experience.discount_TB[:4].unique().tolist() == [expected]


@pytest.mark.fault("discount outside [0, 1]")
@pytest.mark.parametrize("value", [-0.1, 1.5, np.inf, np.nan, "half", np.ones(2)], ids=str)
def test_a_discount_outside_0_to_1_is_refused_at_every_depth(value):
    env = type("Odd", (Declared,), {"info": {"discount": value}})
    for options in ({}, LOOKAHEAD | {"depth": 0}, LOOKAHEAD):
        with pytest.raises(
            PgtsError, match=r"Odd failed in step 0 of the episode with the seed \d+: the discount"
        ) as e:
            make(env, **options).iterate()
        assert isinstance(e.value, NotFinite) == (isinstance(value, float) and not np.isfinite(value))
    if isinstance(value, float):
        together = type("Odd", (DeclaredTogether,), {"info": {"discount": np.array([0.5, value])}})
        with pytest.raises(PgtsError, match=r"Odd.* failed in step 0 of the episodes with the seeds .*: the discount"):
            make(together()).iterate()


class Late(Declared):
    """Its discount is wrong from the third step on."""

    def step(self, action):
        *answer, _ = super().step(action)
        return *answer, {"discount": 1.25 if self.time > 2 else 0.9}


def test_a_discount_outside_0_to_1_is_found_by_the_lookahead_first_with_state_and_action():
    with pytest.raises(PgtsError, match=r"Late failed in state \d+ under action 0 .* the discount is 1.25; it must be"):
        make(Late, **LOOKAHEAD, horizon={"type": "fixed", "length": 1}).iterate()


def test_a_gamma_outside_0_to_1_is_refused_without_a_model_too():
    with pytest.raises(PgtsError, match=r"gamma is 1.5; it must be in \[0, 1\]"):
        make(Clock, gamma=1.5)
    with pytest.raises(PgtsError, match=r"gamma is nan; it must be in \[0, 1\]"):
        make(Clock, gamma=float("nan"), **LOOKAHEAD)


def test_the_discounts_of_our_own_environments_are_declared():
    for env in (gymnasium.make("pgts/Random-v0"), gymnasium.make_vec("pgts/Random-v0", num_envs=2)):
        assert env.metadata["discounts"] is True
