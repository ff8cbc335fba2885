"""Worlds: which one an environment gets, that states and observations belong together, and that all of them learn."""

import functools
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from torch import Tensor

from pgts_torch import PGTS
from pgts_torch.agent import candidates as worlds
from pgts_torch.agent.build import make_policy
from pgts_torch.agent.collect import rollout
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.agent.worlds import DynamicsWorld, SimulatedWorld, TabularWorld
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models import SimulatorModel, with_torques
from pgts_torch.options import MLP, FixedHorizon
from pgts_torch.options.environment import Observed
from pgts_torch.seeding import sample_keys, seed_sequence, stream
from tests.agent import cells
from tests.agent.helpers import same_bits
from tests.models.corridors import Dice
from tests.support import same_values

KEYWORDS = {"num_envs": 3, "gamma": None, "observed": Observed(), "plain": False, "device": "cpu"}

SEES_X = Observed(observation_keys=["x"])

DYNAMICS = ["CartPole-v1", "Acrobot-v1", "MountainCar-v0", "Pendulum-v1"]


class Cart(gymnasium.envs.classic_control.CartPoleEnv):
    """CartPole, but for all that can be known about a subclass it may do anything."""


class Parts(gymnasium.Env):
    """Its observations are dictionaries; it can be restored."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Dict({"place": spaces.Discrete(9), "map": spaces.Box(0, 1, (2, 2))})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self.observation(), {}

    def step(self, action):
        self.place = min(self.place + action, 8)
        return self.observation(), 1.0, self.place == 8, False, {}

    def observation(self) -> dict[str, object]:
        return {"place": self.place, "map": np.full((2, 2), self.place / 8, np.float32)}

    def get_state(self):
        return self.place

    def set_state(self, state):
        self.place = state


class Unknown(gymnasium.Env):
    """Nothing is known of it, and it has a generator of a class of its own."""

    observation_space, action_space = spaces.Box(-1, 1, (2,)), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.dice = Dice(0)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.full(2, action, np.float32), 0.0, False, False, {}


class Together(VectorEnv):
    """Environments of which single ones cannot be reached."""

    num_envs, metadata = 3, {"autoreset_mode": AutoresetMode.DISABLED}
    single_observation_space, single_action_space = Unknown.observation_space, Unknown.action_space


def vector_of(make: Callable[[], gymnasium.Env], num_envs: int = 3) -> SyncVectorEnv:
    return SyncVectorEnv([make] * num_envs, autoreset_mode=AutoresetMode.DISABLED)


def world_of(env: object, **options) -> ModelWorld:
    if env == "Pendulum-v1":
        env = lambda: with_torques(gymnasium.make("Pendulum-v1", max_episode_steps=-1))  # noqa: E731
    return cells.world_of(env, **KEYWORDS | options)


WORLDS = {
    "tabular": lambda: world_of("pgts/Ladder-v0"),
    "tabular, from P": lambda: world_of("FrozenLake-v1"),
    "simulated": lambda: world_of(vector_of(Cart)),
    "simulated, by parts": lambda: world_of(vector_of(Parts), observed=Observed(observation_keys=["map"])),
    **{name: lambda name=name: world_of(name) for name in DYNAMICS},
}


def numbered(world: World, observation: np.ndarray) -> Tensor:
    """The numbers of the states that the environments are in now."""
    return world.numbers(world.read(observation, world.encode(observation)))


def walked(world: World, steps: int) -> tuple[list[Tensor], list[Tensor]]:
    """The observations of the environments, encoded, and the numbers of their states, in each step of a random walk."""
    observation, _ = world.env.reset(seed=1)
    seen, numbers = [world.encode(observation)], [numbered(world, observation)]
    for action_B in torch.randint(world.num_actions, (steps, 3), generator=stream(0, "walk")):
        observation, _, over, *_ = world.env.step(action_B.numpy())
        seen.append(world.encode(observation))
        numbers.append(numbered(world, observation))
        if over.any():
            world.env.reset(options={"reset_mask": over})
    return seen, numbers


# Which world


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (lambda: world_of("pgts/Grid-v0"), TabularWorld),
        (lambda: world_of("Taxi-v4"), TabularWorld),
        (lambda: world_of("pgts/Grid-v0", plain=True), TabularWorld),
        *((lambda name=name: world_of(name), DynamicsWorld) for name in DYNAMICS),
        (lambda: world_of(vector_of(Cart)), SimulatedWorld),
        (lambda: world_of("CartPole-v1", plain=True), World),
        (lambda: world_of(vector_of(Unknown), plain=True), World),
    ],
)
def test_what_is_known_of_an_environment_decides_its_world(make, kind):
    world = make()
    assert type(world) is kind
    assert (world.model is None) == (kind is World)
    assert (world.mdp is None) == (kind is not TabularWorld)


@pytest.mark.parametrize("id", ["CartPole-v1", "CliffWalking-v1"])
def test_the_states_of_a_rollout_are_numbered_at_once_as_one_after_the_other(id, monkeypatch):
    world, other, counts = world_of(id), world_of(id), []
    policy = make_policy(MLP(), world, seed=0)
    monkeypatch.setattr(
        world, "numbers", lambda read_N: counts.append(len(read_N)) or type(world).numbers(world, read_N)
    )
    made = rollout(world, policy, FixedHorizon(length=6), seed=0, names=("test",), generator=stream(0, "test"))
    assert counts == [7 * 3]
    observation, _ = other.env.reset(seed=seed_sequence(0, "test", "env").generate_state(3).tolist())
    for state_B, action_B in zip(made.state_TB, made.action_TB, strict=True):
        assert torch.equal(numbered(other, observation), state_B)
        observation, _, over, *_ = other.env.step(action_B.numpy())
        assert not over.any()
    assert torch.equal(numbered(other, observation), made.next_state_TB[-1])
    assert torch.equal(made.next_state_TB[:-1], made.state_TB[1:])


def test_an_update_sees_what_was_acted_on_and_not_what_the_model_makes_of_the_states(monkeypatch):
    model, acted, moved = PGTS("Acrobot-v1", depth=0, num_envs=64, horizon={"type": "fixed", "length": 5}), [], []
    sample, update = model.policy.sample, model.update
    monkeypatch.setattr(
        model.policy, "sample", lambda seen_B, **kwargs: acted.append(seen_B) or sample(seen_B, **kwargs)
    )
    monkeypatch.setattr(model, "update", lambda _, batch, **kwargs: moved.append(batch.observation_N) or {})
    model.update.state_weight = update.state_weight
    experience = model.iterate().experience
    assert torch.equal(torch.stack(acted), experience.observation_UB[:-1])
    assert torch.equal(moved[0], experience.first_observation_N)
    remade = model.world.observe(experience.state_TB[0])  # just after a reset Acrobot takes its sines in float32
    torch.testing.assert_close(remade, acted[0], rtol=0, atol=1e-6)
    assert not torch.equal(remade, acted[0])


def test_changed_constants_are_used_and_must_be_the_same_in_all_environments():
    world = world_of("CartPole-v1", sutton_barto_reward=True)
    observation, _ = world.env.reset(seed=0)
    assert float(world.model.outcomes(numbered(world, observation)).reward_NA.max()) == 0.0
    envs = world_of("CartPole-v1").env
    envs.envs[1].unwrapped.gravity = 1.6
    observation, _ = envs.reset(seed=0)
    with pytest.raises(
        PgtsError, match=r"environment 1 of CartPole-v1 has gravity = 1\.6, where another instance has 9\.8"
    ):
        numbered(world_of(envs), observation)


def test_actions_are_those_of_the_environments_also_in_a_simulator():
    def mirrored() -> gymnasium.Env:
        return gymnasium.wrappers.TransformAction(Cart(), lambda a: 1 - a, spaces.Discrete(2))

    following = []
    for world in (world_of(vector_of(Cart)), world_of(vector_of(mirrored))):
        observation, _ = world.env.reset(seed=3)
        answer = world.model.outcomes(numbered(world, observation)[:1])
        following.append(world.observe(answer.child_NAK[0, :, 0]))
    assert torch.equal(following[0], following[1].flip(0))
    assert not torch.equal(following[0], following[1])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: world_of("FrozenLake-v1", action_repeat=2), "action_repeat is 2; in a table it must be 1"),
        (lambda: world_of("CartPole-v1", plain=True, action_repeat=2), "action_repeat is 2; without a model it must"),
        (lambda: world_of("CartPole-v1", observed=SEES_X), "no part 'x'; they are Box"),
        (lambda: world_of("CartPole-v1", plain=True, observed=SEES_X), "no part 'x'; they are Box"),
        (lambda: world_of(vector_of(Parts), observed=SEES_X), "no part 'x'; they have map, place"),
        (lambda: world_of("pgts/Ladder-v0", observed=SEES_X), "no part 'x'; they are Discrete"),
        (lambda: world_of(SyncVectorEnv([Cart])), "the environment resets by"),
        (lambda: world_of("CartPole-v1", num_envs=0), "num_envs is 0"),
    ],
)
def test_what_does_not_make_a_world_is_refused_by_name(make, message):
    with pytest.raises(PgtsError, match=message):
        make()


def test_an_environment_that_cannot_be_restored_needs_a_model():
    with pytest.raises(MissingModel, match="give Unknown the methods get_state"):
        world_of(vector_of(Unknown))
    with pytest.raises(MissingModel, match="a simulator needs a SyncVectorEnv"):
        world_of(Together())


# States and observations


@pytest.mark.parametrize("kind", WORLDS)
def test_a_numbered_state_is_observed_as_in_the_environment(kind):
    world = WORLDS[kind]()
    seen, numbers = walked(world, 6)
    for k, (seen_B, number_B) in enumerate(zip(seen, numbers, strict=True)):
        observed_B = world.observe(number_B)
        assert observed_B.dtype == seen_B.dtype
        # Just after a reset Acrobot takes its sines in float32.
        rounded = kind == "Acrobot-v1" and k == 0
        torch.testing.assert_close(observed_B, seen_B, rtol=0, atol=1e-7 if rounded else 0)
    assert not torch.equal(world.observe(numbers[0]), seen[6])


@pytest.mark.parametrize("kind", WORLDS)
def test_numbers_are_reset_except_where_a_state_is_its_number(kind):
    world = WORLDS[kind]()
    _, first = walked(world, 3)
    world.reset_numbers()
    assert world.keeps_numbers == isinstance(world, TabularWorld)
    seen, second = walked(world, 3)
    assert all(torch.equal(*pair) for pair in zip(first, second, strict=True))
    assert torch.equal(world.observe(second[1]), seen[1]) or kind == "Acrobot-v1"
    _, third = walked(world, 3)
    assert torch.equal(third[0], first[0])


@pytest.mark.parametrize("kind", [*WORLDS, "without a model"])
def test_observations_that_the_environment_cannot_make_are_refused(kind):
    world = WORLDS[kind]() if kind in WORLDS else world_of("CartPole-v1", plain=True)
    if isinstance(world.observation_space, spaces.Discrete):
        wrong = [(np.array([0.5]), "states are integers"), (np.array([999]), "state 999 does not exist")]
    else:
        shape = world.observation_space.shape
        wrong = [
            (np.full((2, *shape), np.nan, np.float32), "an observation is not finite"),
            (np.zeros((2, *shape, 5), np.float32), "an observation has shape"),
            ((np.zeros(shape, np.float32), {}), "an observation is .array"),  # all that reset gives
        ]
    for observation, message in wrong:
        given = {"map": observation} if "parts" in kind else observation
        with pytest.raises(PgtsError, match=message):
            world.encode(given)


# Dynamics in torch and the simulator are the same world


def by_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "CLASSIC", ())


@pytest.mark.parametrize("repeat", [1, 3])
@pytest.mark.parametrize("name", DYNAMICS)
def test_dynamics_and_simulator_answer_alike(name, repeat, monkeypatch):
    answers = []
    for simulate in (False, True):
        if simulate:
            by_simulator(monkeypatch)
        world = world_of(name, action_repeat=repeat)
        assert isinstance(world, SimulatedWorld) == simulate
        observation, _ = world.env.reset(seed=5)
        state_B = numbered(world, observation)
        for _ in range(2):
            answer = world.model.outcomes(state_B)
            state_B = answer.child_NAK.flatten().unique()
        answers.append((answer.reward_NA, answer.discount_NAK, world.observe(answer.child_NAK.flatten())))
    for first, second in zip(*answers, strict=True):
        torch.testing.assert_close(first, second, rtol=1e-12, atol=1e-12)
    assert float(answers[0][1].max()) == pytest.approx(0.99**repeat)


def test_a_simulator_repeats_random_actions_as_the_key_says():
    model = SimulatorModel("FrozenLake-v1", gamma=0.9, action_repeat=3)
    env = gymnasium.make("FrozenLake-v1")
    env.reset(seed=0)
    state_N, action_N = torch.full((300,), model.root(env)), torch.full((300,), 1)
    key_N = sample_keys(300, generator=stream(0, "keys"))
    first, second = (model.sample(state_N, action_N, key_N=key_N) for _ in range(2))
    assert torch.equal(first.next_state_N, second.next_state_N)
    flipped = model.sample(state_N.flip(0), action_N, key_N=key_N.flip(0))
    assert torch.equal(flipped.next_state_N.flip(0), first.next_state_N)
    places = {int.from_bytes(model.snapshot(s).key[:8], "little") for s in first.next_state_N.unique().tolist()}
    assert max(places) >= 9  # three rows down
    assert {5} <= places  # a hole, where the repetition ends
    assert sorted(set(first.discount_N.tolist())) == pytest.approx([0.0, 0.9**3])


@pytest.mark.parametrize("depth", [0, 2])
def test_an_iteration_is_the_same_bit_for_bit_with_dynamics_and_with_a_simulator(depth, monkeypatch):
    fast = cartpole(depth=depth)
    by_simulator(monkeypatch)
    slow = cartpole(depth=depth)
    assert isinstance(fast.world, DynamicsWorld)
    assert isinstance(slow.world, SimulatedWorld)
    for _ in range(2):
        first, second = fast.iterate(), slow.iterate()
        assert torch.equal(first.experience.reward_TB, second.experience.reward_TB)
        assert torch.equal(first.look.q_BA, second.look.q_BA)
        assert first.losses == second.losses
    assert same_weights(fast, slow)


# Training


def cartpole(**kwargs) -> PGTS:
    short = {"depth": 2, "num_envs": 3, "seed": 7, "horizon": {"type": "fixed", "length": 15}}
    return PGTS("CartPole-v1", **short | kwargs)


def same_weights(first: PGTS, second: PGTS) -> bool:
    return all(same_values(first.state_dict()[part], second.state_dict()[part]) for part in ("policy", "critic"))


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("kwargs", [{}, {"action_repeat": 3}, {"depth": "adaptive", "max_depth": 2}])
def test_training_with_a_lookahead_is_reproducible_and_a_loaded_model_goes_on_bit_for_bit(kwargs, tmp_path):
    whole, twin, other = cartpole(**kwargs), cartpole(**kwargs), cartpole(seed=8, **kwargs)
    for model in (whole, twin, other):
        model.iterate()
    assert same_weights(whole, twin)
    assert not same_weights(whole, other)
    whole.save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt")
    for _ in range(2):
        first, second = whole.iterate(), loaded.iterate()
        assert same_bits(first.experience, second.experience)
        assert torch.equal(first.look.q_BA, second.look.q_BA)
        assert first.losses == second.losses
        assert first.model_calls == second.model_calls
    assert same_weights(whole, loaded)
    assert not same_weights(whole, twin)


def test_each_iteration_numbers_its_states_from_0():
    model = cartpole()
    for k in range(3):
        seen = model.iterate()
        assert model.world.model.generation == k + 1
        assert seen.experience.state_TB[0].tolist() == [0, 1, 2]
        assert model.world.model.num_states <= 3 * 16 * (1 + 2 + 4 + 8)


def test_repeated_actions_prove_nothing_and_single_ones_do():
    for repeated, highest in ((1, 100), (2, torch.inf)):
        assert cartpole(action_repeat=repeated).world.model.highest_value == pytest.approx(highest)


@pytest.mark.usefixtures("unchecked_shapes")
def test_cartpole_is_learned_with_a_lookahead_of_two_steps_and_not_without_training():
    model = PGTS("CartPole-v1", depth=2, num_envs=8, seed=0, horizon={"type": "fixed", "length": 200})

    def mean_length() -> float:
        made = rollout(
            model.world.of(model.source.make(24)),
            model.policy,
            FixedHorizon(length=200),
            seed=1,
            names=("test",),
            generator=stream(1, "test"),
        )
        return made.num_steps / made.num_episodes

    untrained = mean_length()
    model.learn(3_000)
    assert untrained < 35
    assert mean_length() > 2 * untrained


def test_rewards_that_a_wrapper_transforms_are_those_of_the_model():
    doubled = functools.partial(gymnasium.wrappers.TransformReward, func=lambda reward: 2 * reward)
    cliff, usual = (world_of(make) for make in (lambda: doubled(gymnasium.make("CliffWalking-v1")), "CliffWalking-v1"))
    assert torch.equal(cliff.mdp.outcomes.reward_NA, 2 * usual.mdp.outcomes.reward_NA)
    cart = world_of(lambda: doubled(gymnasium.make("CartPole-v1")))
    observation, _ = cart.env.reset(seed=0)
    assert (cart.model.outcomes(numbered(cart, observation)).reward_NA == 2).all()
    plain = world_of(lambda: doubled(gymnasium.make("CartPole-v1")), plain=True)
    assert not isinstance(plain, ModelWorld)


def test_where_a_wrapper_repeats_actions_at_random_the_model_only_samples():
    sticky = functools.partial(gymnasium.wrappers.StickyAction, repeat_action_probability=0.5)
    with pytest.warns(UserWarning, match="CartPole-v1 is wrapped in StickyAction"):
        world = world_of(lambda: sticky(gymnasium.make("CartPole-v1")))
    state_B = world.numbers(world.read(observation := world.env.reset(seed=0)[0], world.encode(observation)))
    first_B = world.model.sample(state_B, torch.ones_like(state_B), key_N=torch.arange(len(state_B))).next_state_N
    for state_N, is_random in ((state_B, False), (first_B, True)):  # no action has been taken yet that could stick
        assert world.model.is_random(state_N, torch.zeros_like(state_N)).tolist() == [is_random] * len(state_N)


@pytest.mark.parametrize("wrapper", [gymnasium.wrappers.NormalizeObservation, gymnasium.wrappers.NormalizeReward])
def test_statistics_that_no_evaluation_would_share_are_refused(wrapper):
    mistake = f"CartPole-v1 is wrapped in {wrapper.__name__}, whose running statistics are neither saved"
    with pytest.raises(PgtsError, match=mistake):
        world_of(lambda: wrapper(gymnasium.make("CartPole-v1")), plain=True)


def test_images_of_a_minigrid_are_learned_from_with_a_lookahead():
    pytest.importorskip("minigrid")
    model = PGTS(
        "MiniGrid-Empty-5x5-v0",
        depth=1,
        policy={"type": "cnn", "scale": 10.0},
        observation_keys=["image"],
        num_envs=2,
        horizon={"type": "fixed", "length": 4},
    )
    seen = model.iterate()
    assert isinstance(model.world, SimulatedWorld)
    assert model.world.observe(seen.state_N).shape[1:] == (7, 7, 3)
    assert 0 < seen.model_calls <= 2 * len(seen.state_N) * model.world.num_actions * (1 + model.world.num_actions)
    observation, _ = gymnasium.make("MiniGrid-Empty-5x5-v0").reset(seed=0)
    assert 0 <= model.predict(observation) < model.world.num_actions
