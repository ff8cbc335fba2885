"""Environments that fail in ways of their own: leaving the process, errors without a text, rewards beyond numbers."""

import json
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from pgts_torch import PGTS, evaluate
from pgts_torch.agent.imagine import simulated_returns
from pgts_torch.agent.policies import SoftmaxPolicy
from pgts_torch.cli.main import main
from pgts_torch.errors import Failed, MissingModel, NotFinite, PgtsError
from pgts_torch.models import check_model
from pgts_torch.models.tensor import TensorModel
from pgts_torch.options import FixedHorizon
from pgts_torch.search import expectimax, mcts, sampled
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact, stationary, stationary_sets
from tests.agent.test_step_forms import LOOKAHEAD, Clock, make

pytestmark = pytest.mark.usefixtures("unchecked_shapes")


class Leaving(BaseException):
    """As asyncio's and pytest's own."""


class Speechless(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


def raising(error: Any, where: str) -> type[Clock]:
    """A clock that raises this in one of its methods, in `step` the third time only."""

    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        if where == "step" and self.time < 2:
            return Clock.step(self, *args)
        raise error

    return type("Broken", (Clock,), {where: method})


ERRORS: dict[Any, str] = {
    SystemExit(3): "SystemExit: 3",
    Leaving("over"): "Leaving: over",
    GeneratorExit(): r"GeneratorExit: raise error \(test_stubborn_envs\.py, line \d+\)",
    Speechless(): r"Speechless, whose text cannot be printed \(RuntimeError\)",
}


@pytest.mark.fault("environment leaves the process, or raises what cannot be printed")
@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_whatever_an_environment_raises_is_one_error_that_says_where(error):
    text = ERRORS[error]
    with pytest.raises(Failed, match=rf"Broken failed in step 2 of the episode with the seed \d+: {text}"):
        make(raising(error, "step")).iterate()
    with pytest.raises(Failed, match=rf"Broken failed at the start of .*: {text}"):
        make(raising(error, "reset")).iterate()
    with pytest.raises(PgtsError, match=text):
        make(raising(error, "set_state"), **LOOKAHEAD).iterate()
    with pytest.raises(Failed, match=rf"cannot be made: {text}"):
        make(raising(error, "__init__"))
    with pytest.raises(PgtsError, match=text):
        check_model(raising(error, "step"), continuations=2, length=4)


def test_ctrl_c_is_the_users_wherever_it_comes():
    for where in ("step", "reset", "__init__"):
        with pytest.raises(KeyboardInterrupt):
            make(raising(KeyboardInterrupt(), where)).iterate()
    with pytest.raises(KeyboardInterrupt):
        make(raising(KeyboardInterrupt(), "set_state"), **LOOKAHEAD)


@pytest.mark.fault("environment leaves the process, or raises what cannot be printed")
def test_a_run_whose_environment_leaves_the_process_writes_down_where(tmp_path, capsys):
    gymnasium.register("Leaving-v0", raising(SystemExit(0), "step"), disable_env_checker=True)
    options = ["--policy.type=mlp", "--critic.type=network", "--estimator.type=sampled", "--search.depth=0"]
    options += ["--update.type=ppo", "--env.id=Leaving-v0", "--run.tensorboard=false"]
    try:
        assert main(["train", *options, f"--run.dir={tmp_path / 'run'}"]) == 2
    finally:
        gymnasium.registry.pop("Leaving-v0")
    assert "Leaving-v0 failed in step 2" in capsys.readouterr().err
    record = json.loads((tmp_path / "run" / "failure.json").read_text())
    assert "SystemExit: 0" in record["message"]
    assert record["iteration"] == 0


@pytest.mark.fault("environment raises an error in close")
def test_an_error_in_close_is_a_warning():
    closed = []

    class Unclosable(Clock):
        def close(self):
            closed.append(self)
            raise RuntimeError("it is stuck")

    with pytest.warns(UserWarning, match="Unclosable failed in close: RuntimeError: it is stuck"):
        model = make(Unclosable)
    tried = len(closed)
    with pytest.warns(UserWarning, match="Unclosable failed in close: RuntimeError: it is stuck"):
        assert evaluate(model, episodes=3).episodic_return.mean == 5
    assert tried > 0
    assert len(closed) == tried + 4  # and one whose time limit was read


@pytest.mark.filterwarnings("ignore:.*attributes are pickled")
@pytest.mark.parametrize("options", [{}, LOOKAHEAD], ids=["plain", "lookahead"])
@pytest.mark.parametrize("methods", [True, False])
def test_every_environment_that_was_made_is_closed(methods, options):
    made, closed = [], []

    class Counted(Clock):
        def __init__(self):
            made.append(self)
            if not methods:
                self.get_state = None

        def close(self):
            closed.append(self)

    with make(Counted, **options) as model:
        model.iterate()
        evaluate(model, episodes=3)
    check_model(Counted, continuations=2, length=5)
    with pytest.raises(PgtsError, match="have no part 'x'"):
        make(Counted, **options, observation_keys=["x"])
    assert len(made) > 10
    assert sorted(map(id, made)) == sorted(map(id, closed))


# Observations that change inside the lookahead


class Restored(Clock):
    """Shows something else once its state was restored; not yet while it is tried out, if `patient`."""

    patient: ClassVar[bool] = False

    def set_state(self, state):
        super().set_state(state)
        self.restored = True

    def step(self, action):
        observation, *rest = super().step(action)
        changed = getattr(self, "restored", False) and not self.patient
        return type(self).show(observation) if changed else observation, *rest


CHANGES = {
    r"the observation has shape \(2,\); \(1,\) is declared": lambda o: np.repeat(o, 2),
    r"the observation has shape \(\); \(1,\) is declared": lambda o: o[0],
    "the observation is of object; float32 is declared": lambda o: np.array([None]),
    "the observation is of <U3; float32 is declared": lambda o: o.astype("<U3"),
    "the observation is of complex64; float32 is declared": lambda o: o * 1j,
    r"the observation is \[\[1\], \[1, 2\]\], which has no shape": lambda o: [[1], [1, 2]],
}


@pytest.mark.fault("observation that changes inside the lookahead")
@pytest.mark.parametrize("message", CHANGES)
@pytest.mark.parametrize(
    "search", ["expectimax", {"type": "sampled", "samples": 2}, {"type": "mcts", "simulations": 4}]
)
def test_an_observation_of_another_shape_or_dtype_inside_the_lookahead_is_refused(message, search):
    env = type("Changed", (Restored,), {"show": staticmethod(CHANGES[message]), "patient": True})
    model = make(env, **LOOKAHEAD, search=search)
    env.patient = False
    with pytest.raises(Failed, match=rf"Changed failed in state \d+ under action \d .*: {message}"):
        model.iterate()


@pytest.mark.parametrize("message", CHANGES)
def test_an_observation_that_changes_at_once_is_refused_where_the_simulator_is_tried_out(message):
    env = type("Changed", (Restored,), {"show": staticmethod(CHANGES[message])})
    with pytest.raises(MissingModel, match="Changed cannot serve as a model: a restored state goes on differently"):
        make(env, **LOOKAHEAD)


def test_numbers_that_a_space_can_hold_are_no_other_dtype():
    for dtype in (np.float64, np.float16, np.int64, np.uint8):
        same = type("Same", (Restored,), {"show": staticmethod(lambda o, dtype=dtype: o.astype(dtype))})
        ours, clean = make(same, **LOOKAHEAD), make(Clock, **LOOKAHEAD)
        assert torch.equal(ours.iterate().look.q_BA, clean.iterate().look.q_BA)


class Scaled(Clock):
    """Its bits depend on whether an action is a number of Python or of numpy, as by the rules of NEP 50."""

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, float(np.float32(reward) + action.astype(np.int64) * 0.1), *rest


@pytest.mark.parametrize("search", ["expectimax", {"type": "mcts", "simulations": 4}])
def test_a_lookahead_takes_the_actions_that_its_environment_is_given(search):
    assert make(Scaled, **LOOKAHEAD, search=search).iterate().model_calls > 0
    assert check_model(Scaled).usable


class Unequal(spaces.Space):
    """As spaces of one's own are, equal to itself alone."""

    def __init__(self):
        super().__init__((), str)


@pytest.mark.parametrize("name", ["observation_space", "action_space"])
def test_a_space_that_is_equal_to_no_other_one_is_refused(name):
    env = type("Own", (Clock,), {name: property(lambda self: Unequal())})
    with pytest.raises(PgtsError, match=rf"Own has the {name} Unequal, which is equal to no other one: make it one of"):
        make(env)


class Parts(Restored):
    """Shows its time twice, with parts of its own dtype or value once its state was restored."""

    observation_space = spaces.Dict(at=Clock.observation_space, two=spaces.Tuple([Clock.observation_space]))

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return {"at": observation, "two": (observation,)}, info

    def step(self, action):
        observation, *rest = super().step(action)
        return {"at": observation, "two": (observation,)}, *rest


@pytest.mark.parametrize(("added", "usable"), [(0.0, True), (1e-12, True), (0.5, False)])
def test_parts_of_an_observation_are_compared_as_a_policy_sees_them(added, usable):
    env = type("Parts", (Parts,), {"show": staticmethod(lambda o: o.astype(np.float64) + added)})
    assert check_model(env, continuations=3, length=4).usable is usable


# Grad that was switched off


class Choice(Clock):
    """One of the two actions pays."""

    scale: ClassVar[float] = 1.0

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.scale * float(action), *rest


def trained(**options: Any) -> list[torch.Tensor]:
    model = make(Choice, **options)
    for _ in range(2):
        model.iterate()
    return [value.clone() for value in model.policy.state_dict().values()]


@pytest.mark.fault("grad switched off")
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
@pytest.mark.parametrize("options", [{}, LOOKAHEAD, LOOKAHEAD | {"update": "mirror"}], ids=["sampled", "ppo", "mirror"])
def test_training_has_the_same_bits_where_grad_is_switched_off(mode, options):
    expected = trained(**options)
    with mode():
        found = trained(**options)
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
    assert not torch.equal(found[0], make(Choice, **options).policy.state_dict()["trunk.layers.0.weight"])


def test_what_was_made_and_saved_in_inference_mode_goes_on_outside_it(tmp_path):
    with torch.inference_mode():
        model = make(Clock)
        model.iterate()
        model.save(tmp_path / "model.pt")
        again = PGTS.load(tmp_path / "model.pt", env=Clock)
    model.iterate()
    again.iterate()
    both = zip(model.policy.state_dict().values(), again.policy.state_dict().values(), strict=True)
    assert all(torch.equal(*pair) for pair in both)


# Rewards beyond numbers


@pytest.mark.fault("reward so large that what is learned from it is no number")
@pytest.mark.parametrize("reward", [1e300, -1e300, 1e160, 1.7e308])
def test_a_reward_too_large_to_learn_from_is_refused_where_it_is_met(reward):
    env = type("Rich", (Clock,), {"form": staticmethod(lambda r: r * reward)})
    for options in ({}, LOOKAHEAD, LOOKAHEAD | {"update": "mirror"}):
        with pytest.raises(
            NotFinite, match=r"Rich failed in step 0 of .* size; it must be at most 5.6e\+102"
        ) as caught:
            make(env, **options).iterate()
        assert caught.value.what == "reward"


@pytest.mark.parametrize("reward", [1e6, 1e15])
def test_large_rewards_are_learned_from(reward):
    env = type("Rich", (Choice,), {"scale": reward})
    for options in ({}, LOOKAHEAD):
        model = make(env, **options)
        before = model.policy.state_dict()["head.weight"].clone()
        seen = model.iterate()
        assert all(np.isfinite(list(seen.losses.values())))
        assert torch.isfinite(model.policy.state_dict()["head.weight"]).all()
        assert not torch.equal(before, model.policy.state_dict()["head.weight"])


@pytest.mark.fault("rewards of an MDP whose values are no numbers")
@pytest.mark.parametrize(("gamma", "most"), [(0.0, 2e307), (0.9, 2e306), (0.999, 2e304), (1.0, 2e207)])
def test_rewards_of_a_table_are_refused_where_values_would_be_no_numbers(gamma, most):
    def of(reward: float) -> TabularMDP:
        ends = [(0.5, 1, reward, False), (0.5, 1, -reward, True)]
        return TabularMDP.from_transitions([[ends, [(1.0, 1, reward, False)]], [[(1.0, 1, -reward, True)]] * 2], gamma)

    with pytest.raises(PgtsError, match=r"R_SA\[0, 1\] is .* rewards may be .* in size|has reward 2.*e\+307; rewards"):
        of(1.01 * 1.124 * most)
    with pytest.raises(PgtsError, match=r"P\[0\]\[0\] has reward 1e\+308; rewards must be finite, at most 2.2e\+307"):
        of(1e308)
    sets, unit = stationary_sets.enumerate_sets(of(most)), stationary_sets.enumerate_sets(of(1.0))
    assert sets.J_optimal == pytest.approx(most * unit.J_optimal)
    assert sets.histogram == unit.histogram
    for depth in range(3):
        mdp, pi_SA = of(most), torch.full((2, 2), 0.5, dtype=torch.float64)
        numbers = [
            *exact.evaluate(mdp, pi_SA).q_SA.flatten().tolist(),
            float(stationary.gap(mdp, pi_SA, depth).max()),
            stationary.worst_case_bound(mdp, stationary.worst_policy(mdp), depth),
        ]
        if gamma < 1:
            numbers += [stationary.closed_form_bound(mdp, depth), stationary.reachable_bound(mdp, depth)]
        assert all(np.isfinite(numbers))


# Discounts of models


class Growing(TensorModel):
    """Its discount is wrong."""

    wrong: ClassVar[float] = 1.25

    def __init__(self) -> None:
        super().__init__(1, 2)

    def step(self, state_ND, action_N):
        zero_N = torch.zeros(len(state_ND))
        return zero_N, zero_N + self.wrong, state_ND + 1


@pytest.mark.fault("discount outside [0, 1]")
@pytest.mark.parametrize("wrong", [1.25, -0.5, 1.00005, float("nan")])
def test_a_discount_of_a_model_outside_0_to_1_is_refused(wrong):
    model = type("Wrong", (Growing,), {"wrong": wrong})()
    root_B = model.number(torch.zeros(1, 1))
    zeros = lambda state_N: torch.zeros(len(state_N))  # noqa: E731
    message = rf"the discount {wrong:.4}\d* .*; it must be in \[0, 1\]"
    with pytest.raises(PgtsError, match=message):
        expectimax(model, root_B, depth=1, v_leaf=zeros)
    with pytest.raises(PgtsError, match=message):
        sampled(model, root_B, depth=1, v_leaf=zeros, samples=2, generator=stream(0, "search"))
    with pytest.raises(PgtsError, match=message):
        mcts(model, root_B, depth=1, v_leaf=zeros, simulations=2)
    with pytest.raises(PgtsError, match=message):
        simulated_returns(model, SoftmaxPolicy(3, 2), root_B, FixedHorizon(length=2), generator=stream(0, "returns"))
