"""Classic control in torch: step by step what Gymnasium does, whatever its constants, and far ahead by repetition."""

import math

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces, wrappers
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv, MountainCarEnv, PendulumEnv
from torch import Tensor

from pgts_torch.compiled import torch_only
from pgts_torch.errors import PgtsError
from pgts_torch.models import TensorModel
from pgts_torch.models.actions import with_torques
from pgts_torch.models.classic import CLASSIC, Acrobot, CartPole, MountainCar, Pendulum, dynamics_of
from pgts_torch.search import Topology, expectimax
from pgts_torch.seeding import numpy_stream, stream
from tests.counting import Counting

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
KINDS = {"CartPole-v1": CartPole, "Acrobot-v1": Acrobot, "MountainCar-v0": MountainCar, "Pendulum-v1": Pendulum}
GAMMA = 0.97


def make(name: str, **kwargs) -> gymnasium.Env:
    env = gymnasium.make(name, max_episode_steps=-1, **kwargs)
    return with_torques(env) if name == "Pendulum-v1" else env


def changed(name: str, **constants) -> gymnasium.Env:
    env = make(name)
    for constant, value in constants.items():
        assert hasattr(env.unwrapped, constant)
        setattr(env.unwrapped, constant, value)
    return env


# The same physics under other constants, each of which must matter.
VARIANTS = {
    **{name: lambda name=name: make(name) for name in KINDS},
    "CartPole, Sutton and Barto's reward": lambda: make("CartPole-v1", sutton_barto_reward=True),
    "CartPole, semi-implicit": lambda: changed("CartPole-v1", kinematics_integrator="semi-implicit"),
    "CartPole, heavy": lambda: changed("CartPole-v1", total_mass=2.0, masspole=0.4, gravity=7.0, tau=0.03, length=0.7),
    "CartPole, narrow": lambda: changed("CartPole-v1", x_threshold=0.2, theta_threshold_radians=0.1, force_mag=5.0),
    "Acrobot, NIPS": lambda: changed("Acrobot-v1", book_or_nips="nips"),
    "Acrobot, strong": lambda: changed("Acrobot-v1", AVAIL_TORQUE=[-4.0, 0.5, 3.0], dt=0.3, LINK_MASS_2=0.5),
    "Acrobot, slow": lambda: changed("Acrobot-v1", MAX_VEL_1=1.0, MAX_VEL_2=2.0, LINK_LENGTH_1=1.2),
    "MountainCar, goal velocity": lambda: changed("MountainCar-v0", goal_velocity=0.03, force=0.004),
    "MountainCar, short": lambda: changed("MountainCar-v0", min_position=-0.9, max_speed=0.04, gravity=0.002),
    "Pendulum, g": lambda: with_torques(gymnasium.make("Pendulum-v1", g=9.81, max_episode_steps=-1), 3),
    "Pendulum, long": lambda: changed("Pendulum-v1", l=1.3, m=0.7, dt=0.04, max_speed=5, max_torque=1.5),
}


WIDE = {
    CartPoleEnv: (2.4, 2.0, 0.2, 2.0),
    AcrobotEnv: (math.pi, math.pi, 10.0, 25.0),
    MountainCarEnv: (0.55, 0.07),
    PendulumEnv: (9.0, 8.0),
}
"""How far from 0 walks begin."""


def walk(env: gymnasium.Env, steps: int, *, hold: int = 1) -> tuple[Tensor, ...]:
    """States, actions, rewards, ends, next states and observations of them, of random walks in Gymnasium of at most 50
    steps, from anywhere, that hold each action for some steps."""
    random, rows, base = numpy_stream(0, "walk"), [], env.unwrapped
    wide, terminated = np.array(WIDE[type(base)]), False
    for step in range(steps):
        if step % 50 == 0 or terminated:
            env.reset()
            base.state = random.uniform(-wide, wide)
        action = int(random.integers(env.action_space.n)) if step % hold == 0 else action
        before = np.array(base.state)
        observation, reward, terminated, _, _ = env.step(action)
        rows.append((before, action, float(reward), terminated, np.array(base.state), observation))
    return tuple(torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_step_is_gymnasiums(variant, device):
    env = VARIANTS[variant]()
    model = dynamics_of(env)(env, gamma=GAMMA, device=device)
    state, action, reward, terminated, following, observation = (x.to(device) for x in walk(env, 2_000, hold=7))
    reward_N, discount_N, next_ND = model.step(state, action)
    # MountainCar takes its cosine from `math`, not from numpy.
    exact = device == "cpu" and not isinstance(model, MountainCar)
    tolerance = {"rtol": 0.0, "atol": 0.0} if exact else {"rtol": 1e-12, "atol": 1e-12}
    torch.testing.assert_close(next_ND, following, **tolerance)
    torch.testing.assert_close(reward_N, reward, **tolerance)
    assert torch.equal(discount_N, torch.full_like(reward, GAMMA).masked_fill(terminated, 0.0))
    observed = model.observe(next_ND)
    assert observed.dtype == torch.float32
    torch.testing.assert_close(observed, observation, rtol=0 if exact else 2e-7, atol=0 if exact else 1e-12)
    if not isinstance(model, Pendulum):
        assert 0 < int(terminated.sum()) < 2_000
    # Other physics would be noticed.
    usual = make(env.spec.id) if variant not in KINDS else changed(env.spec.id, **OTHER[env.spec.id])
    other = dynamics_of(usual)(usual, gamma=GAMMA, device=device)
    if other.num_actions == model.num_actions:
        assert any(
            not torch.equal(*pair) for pair in zip(model.step(state, action), other.step(state, action), strict=True)
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("variant", VARIANTS)
def test_numpy_and_torch_take_the_same_steps_in_the_dtype_of_the_model(variant, dtype):
    env = VARIANTS[variant]()
    for name, value in vars(env.unwrapped).items():
        if type(value) is float:  # constants of numpy's own type leave arrays as they are, too
            setattr(env.unwrapped, name, np.float64(value))
    model = dynamics_of(env)(env, gamma=GAMMA, dtype=dtype)
    state, action, *_ = walk(env, 300, hold=7)
    state, effect = state.to(dtype).T, model._effect_AE[action].T
    ours = model._move(np, state.numpy(), effect.numpy())
    plain = model._move(torch, state, effect)
    within = 1e-12 if dtype == torch.float64 else 1e-4
    for x, y in [(ours[0], plain[0]), *zip(ours[2], plain[2], strict=True)]:
        torch.testing.assert_close(torch.from_numpy(x), y, rtol=within, atol=within)
        assert y.dtype == dtype
    assert torch.equal(torch.from_numpy(ours[1]), plain[1])


@pytest.mark.parametrize("variant", [name for name in VARIANTS if name.startswith("CartPole")])
def test_steps_of_cartpole_in_a_compiled_loop_have_the_bits_of_those_by_numpy(variant):
    pytest.importorskip("numba")
    env = VARIANTS[variant]()
    model = CartPole(env, gamma=GAMMA)
    state, action, *_ = walk(env, 600, hold=7)
    state[::50, 1] = -0.0
    looped = model._step_compiled(state.numpy(), action.numpy())
    plain = model._step(state, action)
    assert all(torch.equal(x.view(torch.int64), y.view(torch.int64)) for x, y in zip(looped, plain, strict=True))
    assert not torch.equal(looped[2], model._step(state, 1 - action)[2])


def test_a_query_of_cartpole_takes_few_operations_of_torch_however_many_states_it_is_for():
    pytest.importorskip("numba")
    model, counted = CartPole(make("CartPole-v1"), gamma=GAMMA), []
    for count in (300, 3_000):
        state_N = model.number(
            (torch.rand(count, 4, generator=stream(count, "states"), dtype=torch.float64) - 0.5) / 10
        )
        for counts in (Counting(), Counting()):
            topology = Topology(model)
            with counts:
                topology.query(state_N)
        counted.append(counts.num_operations)
        with torch_only(), counts:
            Topology(model).query(state_N)
        assert counts.num_operations > 2 * counted[-1]
    assert max(counted) <= 20, counted


OTHER = {
    "CartPole-v1": {"gravity": 9.81},
    "Acrobot-v1": {"LINK_MOI": 1.001},
    "MountainCar-v0": {"goal_position": 0.45},
    "Pendulum-v1": {"g": 10.1},
}


@pytest.mark.parametrize("name", KINDS)
def test_every_constant_that_a_step_reads_is_read_from_the_instance(name):
    """Gymnasium itself says which attributes a step reads."""
    base, read = make(name).unwrapped, set()

    class Spied(type(base)):
        def __getattribute__(self, attribute):
            read.add(attribute)
            return super().__getattribute__(attribute)

    base.reset(seed=0)
    if name == "MountainCar-v0":
        base.state = (0.499, 0.07)  # only beyond the goal is its velocity read
    base.__class__ = Spied
    for action in (0, 1) if name != "Pendulum-v1" else (np.ones(1, np.float32),):
        base.step(action)
    methods = {attribute for attribute in read if callable(getattr(type(base), attribute, None))}
    others = {"state", "render_mode", "np_random", "action_space", "steps_beyond_terminated", "last_u", "__class__"}
    assert read - methods - others == set(KINDS[name].constants)


def test_the_last_step_of_cartpole_is_rewarded_and_ends():
    for sutton_barto, before, last in ((False, 1.0, 1.0), (True, 0.0, -1.0)):
        env = make("CartPole-v1", sutton_barto_reward=sutton_barto)
        model = CartPole(env, gamma=GAMMA)
        falling = torch.tensor([[0.0, 0.0, 0.2, 0.0], [0.0, 0.0, 0.2, 3.0]], dtype=torch.float64)
        reward_N, discount_N, _ = model.step(falling, torch.tensor([1, 1]))
        assert reward_N.tolist() == [before, last]
        assert discount_N.tolist() == [GAMMA, 0.0]


@pytest.mark.parametrize("name", KINDS)
def test_a_search_from_the_states_of_instances_sees_what_brute_force_in_gymnasium_sees(name):
    envs = [make(name) for _ in range(3)]
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
        env.step(0)
    model = KINDS[name](envs[0], gamma=GAMMA)
    before = [np.array(env.unwrapped.state) for env in envs]
    roots = model.roots(envs)
    look = expectimax(model, roots, depth=2, v_leaf=lambda s: model.states(s).sum(-1))
    assert all((env.unwrapped.state == state).all() for env, state in zip(envs, before, strict=True))

    def brute(env: gymnasium.Env, state: np.ndarray, depth: int) -> list[float]:
        values = []
        for action in range(env.action_space.n):
            env.unwrapped.state = state
            _, reward, terminated, _, _ = env.step(action)
            after = np.array(env.unwrapped.state)
            rest = 0.0 if terminated else max(brute(env, after, depth - 1)) if depth else after.sum()
            values.append(float(reward) + GAMMA * rest)
        return values

    expected = [brute(env, state, 2) for env, state in zip(envs, before, strict=True)]
    torch.testing.assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-12)
    shallow = expectimax(model, roots, depth=1, v_leaf=lambda s: model.states(s).sum(-1))
    assert not torch.allclose(look.q_BA, shallow.q_BA)


@pytest.mark.parametrize("name", KINDS)
def test_no_value_of_a_plan_is_above_the_highest_value(name):
    env = make(name)
    model = KINDS[name](env, gamma=GAMMA)
    state, *_ = walk(env, 300)
    look = expectimax(model, model.number(state), depth=3, v_leaf=lambda s: torch.zeros(len(s)))
    assert float(look.q_BA.max()) <= model.highest_value == (1 / (1 - GAMMA) if name == "CartPole-v1" else 0.0)
    assert CartPole(make("CartPole-v1"), gamma=1.0).highest_value == math.inf
    assert KINDS[name](env, gamma=GAMMA, action_repeat=2).highest_value == math.inf


# The same action several times


@pytest.mark.parametrize("k", [2, 5])
@pytest.mark.parametrize("name", KINDS)
def test_a_repeated_action_is_that_many_steps_of_gymnasium_and_stops_at_the_end(name, k):
    env = make(name)
    model = KINDS[name](env, gamma=GAMMA, action_repeat=k)
    state, _, _, terminated, *_ = walk(env, 2_000, hold=15)
    last = torch.nonzero(terminated).flatten()[:10]
    state = torch.cat([state[:100:2], state[last], state[last - 1]])
    answer = model.outcomes(number_N := model.number(state))
    ended_early = 0
    for n in range(len(state)):
        for action in range(model.num_actions):
            env.reset()
            env.unwrapped.state = state[n].numpy()
            total, weight = 0.0, 1.0
            for i in range(k):
                _, reward, terminated, _, _ = env.step(action)
                total += weight * float(reward)
                weight *= 0.0 if terminated else GAMMA
                if terminated:
                    ended_early += i + 1 < k
                    break
            assert float(answer.reward_NA[n, action]) == pytest.approx(total, rel=1e-12, abs=1e-12)
            assert float(answer.discount_NAK[n, action, 0]) == pytest.approx(weight, rel=1e-12)
            child = int(answer.child_NAK[n, action, 0])
            if weight > 0:
                after = np.array(env.unwrapped.state, dtype=np.float64)
                np.testing.assert_allclose(model.states(torch.tensor([child]))[0], after, rtol=1e-12, atol=1e-12)
            else:
                assert child == int(number_N[n])
    assert ended_early > 0 or name == "Pendulum-v1"


def test_a_repeated_action_brings_a_sparse_goal_into_sight_at_the_price_of_its_steps():
    env = make("MountainCar-v0")
    env.reset(seed=0)
    sight = {}
    for k in (1, 12):
        model = MountainCar(env, gamma=1.0, action_repeat=k)
        look = expectimax(model, model.roots([env]), depth=9, v_leaf=lambda s: torch.full((len(s),), -200.0))
        sight[k] = float(look.q_BA.max())
        assert look.model_calls * 1 <= model.simulator_steps <= look.model_calls * k
        assert (model.simulator_steps == look.model_calls) == (k == 1)
    assert sight[1] == -210.0
    assert sight[12] > -120


class Stairs(TensorModel):
    """Action 0 climbs a step, for a reward of 1, and is not allowed on step 2; action 1 stays."""

    def step(self, state_ND: Tensor, action_N: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        climbs_N = action_N == 0
        reward_N = climbs_N.double().masked_fill(climbs_N & (state_ND[:, 0] == 2), -math.inf)
        return reward_N, torch.full_like(reward_N, 0.5), state_ND + climbs_N.double().unsqueeze(-1)


def test_a_repetition_ends_before_a_step_in_which_the_action_is_not_allowed():
    model = Stairs(1, 2, state_dtype=torch.float64, dtype=torch.float64, action_repeat=4)
    answer = model.outcomes(model.number(torch.tensor([[0.0], [1.0], [2.0], [3.0]], dtype=torch.float64)))
    assert answer.reward_NA[:, 0].tolist() == [1.5, 1.0, -math.inf, 1.875]
    assert answer.discount_NAK[[0, 1, 3], 0, 0].tolist() == [0.25, 0.5, 0.0625]
    assert model.states(answer.child_NAK[:, 0, 0])[:, 0].tolist() == [2.0, 2.0, 2.0, 7.0]
    assert answer.discount_NAK[:, 1, 0].tolist() == [0.0625] * 4


# What is refused


def test_another_environment_other_constants_and_wrappers_that_change_things_are_refused_by_name():
    env = make("CartPole-v1")
    env.reset(seed=0)
    model = CartPole(env, gamma=GAMMA)
    assert model.vectors([env])[0].tolist() == env.unwrapped.state.tolist()
    other = changed("CartPole-v1", gravity=1.6)
    other.reset(seed=0)
    for wrong, message in [
        (other, r"CartPole-v1 has gravity = 1\.6; the model's is 9\.8"),
        (make("Acrobot-v1"), "Acrobot-v1 is not CartPole-v1: it is a AcrobotEnv, not a CartPoleEnv"),
        (make("CartPole-v1"), "CartPole-v1 was not reset"),
    ]:
        with pytest.raises(PgtsError, match=message):
            model.vectors([wrong])
    for make_it, message in [
        (lambda: MountainCar(env, gamma=GAMMA), "CartPole-v1 has no dynamics in torch: it is a CartPoleEnv"),
        (lambda: Pendulum(gymnasium.make("Pendulum-v1"), gamma=GAMMA), "make them discrete, as with_torques does"),
        (lambda: Acrobot(changed("Acrobot-v1", torque_noise_max=0.1), gamma=GAMMA), "torque_noise_max is 0.1"),
        (lambda: CartPole(wrappers.RepeatAction(env, 2), gamma=GAMMA), "is wrapped in RepeatAction, which may change"),
        (lambda: CartPole(env, gamma=1.01), "gamma is 1.01"),
        (lambda: CartPole(env, gamma=GAMMA, action_repeat=0), "action_repeat is 0"),
    ]:
        with pytest.raises(PgtsError, match=message):
            make_it()


def test_only_environments_whose_dynamics_are_known_have_them():
    class Windy(CartPoleEnv):
        """A subclass may do anything."""

    assert [dynamics_of(make(name)) for name in KINDS] == list(CLASSIC)
    assert dynamics_of(Windy()) is None
    assert dynamics_of(gymnasium.make("FrozenLake-v1")) is None
    assert dynamics_of(gymnasium.make("Pendulum-v1")) is None
    assert dynamics_of(changed("Acrobot-v1", torque_noise_max=0.1)) is None
    assert dynamics_of(wrappers.RecordEpisodeStatistics(make("CartPole-v1"))) is CartPole


def test_actions_are_what_action_wrappers_make_of_them():
    mirrored = wrappers.TransformAction(make("CartPole-v1"), lambda a: 1 - a, spaces.Discrete(2))
    straight, turned = (CartPole(env, gamma=GAMMA) for env in (mirrored.env, mirrored))
    state = torch.zeros(2, 4, dtype=torch.float64)
    forward = straight.step(state, torch.tensor([0, 1]))[2]
    assert torch.equal(turned.step(state, torch.tensor([1, 0]))[2], forward)
    assert not torch.equal(forward[0], forward[1])


def test_float32_states_stay_close_for_a_step():
    env = make("Acrobot-v1")
    double, single = (Acrobot(env, gamma=GAMMA, dtype=dtype) for dtype in (torch.float64, torch.float32))
    state, action, *_ = walk(env, 200)
    expected = double.step(state, action)[2]
    found = single.step(state.float(), action)[2]
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-4)
