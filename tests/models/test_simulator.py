"""A simulator as a model: the truth of tables where there are some, each pair queried once, chance in the keys."""

import copy
import gc
import math
import weakref
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
import scipy.stats
import torch
from gymnasium import spaces
from torch import Tensor

from pgts_torch.errors import PgtsError, RandomOutcomes
from pgts_torch.models import SimulatorModel, TabularModel, chance, snapshots, stepper
from pgts_torch.models.actions import all_actions, grid_actions, sampled_actions
from pgts_torch.models.environments import EnvSource
from pgts_torch.models.snapshots import generator_state
from pgts_torch.search import Topology, expectimax, sampled
from pgts_torch.seeding import sample_keys, stream
from pgts_torch.tabular import TabularMDP, exact
from tests.models.corridors import Broken, Corridor
from tests.support import outcomes_of

DRAWS = 400
FALSE_ALARM = 1e-6
"""Probability with which a right model fails a test of frequencies, had its seed not been fixed."""


def standing_in(id: str, state: int, **kwargs: Any) -> gymnasium.Env:
    env = gymnasium.make(id, **kwargs)
    env.reset(seed=0)
    env.unwrapped.s = state
    return env


def table_of(env: gymnasium.Env, gamma: float) -> TabularMDP:
    return TabularMDP.from_gymnasium(env, gamma)


def every_state(id: str, model: SimulatorModel, count: int) -> Tensor:
    """The model's numbers of the environment's states 0, 1, 2, ..."""
    return model.roots([standing_in(id, s) for s in range(count)], range(count))


def zeros(state_N: Tensor) -> Tensor:
    return torch.zeros(len(state_N), dtype=torch.float64)


def keys(count: int, seed: int = 0) -> Tensor:
    return sample_keys(count, generator=stream(seed, "keys"))


# The truth


@pytest.mark.parametrize(("id", "states"), [("CliffWalking-v1", [36, 24, 13, 0, 35]), ("Taxi-v4", [1, 123, 328, 499])])
@pytest.mark.parametrize("depth", [0, 3, 4])
def test_expectimax_sees_in_a_simulator_what_it_sees_in_the_table(id, states, depth):
    env = gymnasium.make(id)
    truth = TabularModel(table_of(env, 0.9))
    model = SimulatorModel(id, gamma=0.9)
    root_B = model.roots([standing_in(id, s) for s in states])
    seen = expectimax(model, root_B, depth=depth, v_leaf=zeros)
    expected = expectimax(truth, torch.tensor(states), depth=depth, v_leaf=zeros)
    torch.testing.assert_close(seen.q_BA, expected.q_BA, rtol=1e-12, atol=1e-12)
    assert seen.nodes_per_level == expected.nodes_per_level  # it merges what the table merges
    other = expectimax(truth, torch.tensor(states), depth=depth + 1, v_leaf=zeros)
    assert not torch.allclose(other.q_BA, expected.q_BA)


def test_a_search_without_end_meets_each_state_of_the_cliff_once():
    model = SimulatorModel("CliffWalking-v1", gamma=0.9)
    env = gymnasium.make("CliffWalking-v1")
    observation, _ = env.reset()
    expectimax(model, model.roots([env], [observation]), depth=60, v_leaf=zeros)
    assert model.num_states == 48 - 10  # nobody stands on the cliff
    states = model.observations(torch.arange(model.num_states)).tolist()
    assert sorted(states) == [*range(37), 47]


def test_sampled_outcomes_have_the_frequencies_of_the_table():
    id = "FrozenLake-v1"
    mdp, model = table_of(gymnasium.make(id), 0.9), SimulatorModel(id, gamma=0.9)
    number_S = every_state(id, model, 16)
    statistic, freedom = 0.0, 0
    for s, a in [(0, 0), (6, 2), (14, 2), (14, 1), (10, 3)]:
        sample = model.sample(number_S[s].expand(DRAWS), torch.full((DRAWS,), a), key_N=keys(DRAWS, 16 * a + s))
        seen = list(zip(model.observations(sample.next_state_N).tolist(), sample.discount_N.tolist(), strict=True))
        expected = outcomes_of(mdp, s, a)
        assert set(seen) <= set(expected)
        statistic += sum((seen.count(what) - DRAWS * p) ** 2 / (DRAWS * p) for what, p in expected.items())
        freedom += len(expected) - 1
    assert scipy.stats.chi2.sf(statistic, freedom) > FALSE_ALARM


def test_a_plan_over_sampled_outcomes_is_not_clairvoyant_while_one_outcome_each_would_be():
    # The best policy is out of the lake in 9 steps with probability 0.029. Ten outcomes each leave an optimistic bias.
    env = reset(gymnasium.make("FrozenLake-v1"), 0)
    mdp = table_of(env, 1.0)
    best = exact.lookahead(mdp, mdp.outcomes.reward_NA, 8)[0].max().item()
    seen = {}
    for samples in (1, 10):
        model = SimulatorModel("FrozenLake-v1", gamma=1.0)
        look = sampled(
            model,
            model.roots([env]),
            depth=8,
            v_leaf=zeros,
            samples=samples,
            generator=stream(0, "plan"),
            share="level",
        )
        seen[samples] = look.q_BA.max().item()
    assert best == pytest.approx(0.0293, abs=1e-4)
    assert best / 2 < seen[10] < 0.15
    assert seen[1] == 1


def test_truncation_keeps_the_discount_and_termination_ends_it():
    pytest.importorskip("minigrid")
    model = SimulatorModel("MiniGrid-Empty-5x5-v0", gamma=0.9)
    env = EnvSource.of("MiniGrid-Empty-5x5-v0").make_one()
    env.reset(seed=0)
    env.unwrapped.step_count = env.unwrapped.max_steps - 1
    late = model.outcomes(model.roots([env]))
    assert late.discount_NAK.flatten().tolist() == [0.9] * 7
    end = SimulatorModel(lambda: Corridor(slip=0.0), gamma=0.9)
    corridor = Corridor()
    corridor.reset(seed=0)
    corridor.position = 3
    assert end.outcomes(end.roots([corridor])).discount_NAK.flatten().tolist() == [0.9, 0.0]


# Calls


def test_a_search_queries_the_simulator_once_for_each_state_and_action():
    model = SimulatorModel("CliffWalking-v1", gamma=0.9)
    root_B = model.roots([standing_in("CliffWalking-v1", 36), standing_in("CliffWalking-v1", 36)])
    topology = Topology(model)
    first = expectimax(model, root_B, depth=4, v_leaf=zeros, topology=topology)
    assert model.simulator_steps == first.model_calls < first.nodes * 4
    again = expectimax(model, root_B, depth=4, v_leaf=zeros, topology=topology)
    fresh = expectimax(model, root_B, depth=4, v_leaf=zeros)
    assert (again.model_calls, fresh.model_calls) == (0, first.model_calls)
    assert model.simulator_steps == first.model_calls  # what is sure is remembered by the model itself
    state_N, action_N = torch.zeros(9, dtype=torch.int64), torch.zeros(9, dtype=torch.int64)
    model.sample(state_N, action_N, key_N=keys(9))
    assert model.simulator_steps == first.model_calls


@pytest.mark.parametrize(("most_bytes", "is_queried_again"), [(10**9, False), (0, True)])
def test_answers_outlive_the_numbers_of_states_unless_they_take_much_memory(most_bytes, is_queried_again, monkeypatch):
    monkeypatch.setattr("pgts_torch.models.answers._MOST_BYTES", most_bytes)
    model, answers, steps = SimulatorModel("CliffWalking-v1", gamma=0.9), [], []
    for state in (0, 36, 36):  # the second search leads to states that the first one has numbered otherwise
        model.clear()
        root_B = model.roots([standing_in("CliffWalking-v1", state)])
        answers.append(expectimax(model, root_B, depth=20, v_leaf=zeros).q_BA)
        steps.append(model.simulator_steps)
    fresh = SimulatorModel("CliffWalking-v1", gamma=0.9)
    alone = expectimax(fresh, fresh.roots([standing_in("CliffWalking-v1", 36)]), depth=20, v_leaf=zeros).q_BA
    assert torch.equal(answers[1], alone)
    assert torch.equal(answers[2], alone)
    assert not torch.equal(answers[0], alone)
    assert (steps[2] > steps[1]) == is_queried_again


class Panorama(Corridor):
    """Its state takes two bytes, and its observation a million."""

    def __init__(self):
        super().__init__(slip=0.0)
        self.observation_space = spaces.Box(0, 255, (1000, 1000), np.uint8)

    def look(self):
        return np.full((1000, 1000), self.position, np.uint8)


def test_remembered_observations_count_as_memory(monkeypatch):
    monkeypatch.setattr("pgts_torch.models.answers._MOST_BYTES", 2**20)
    for make, is_queried_again in ((lambda: Corridor(slip=0.0), False), (Panorama, True)):
        model = SimulatorModel(make, gamma=0.9)
        for _ in range(2):
            model.clear()
            model.outcomes(model.roots([reset(make(), 0)]))
        assert model.simulator_steps == (4 if is_queried_again else 2)


def test_numbers_do_not_depend_on_what_is_remembered():
    fresh, knowing = (SimulatorModel("CliffWalking-v1", gamma=0.9) for _ in range(2))
    knowing.outcomes(every_state("CliffWalking-v1", knowing, 48)[[30]])
    knowing.clear()
    answers = []
    for model in (fresh, knowing):
        env = standing_in("CliffWalking-v1", 30), standing_in("CliffWalking-v1", 14)
        answers.append(model.outcomes(model.roots(env, [30, 14])).child_NAK)
    assert torch.equal(*answers)
    assert knowing.simulator_steps == fresh.simulator_steps == 8


@pytest.mark.parametrize(
    "id", ["MiniGrid-DoorKey-5x5-v0", "MiniGrid-Dynamic-Obstacles-5x5-v0", "MiniGrid-MemoryS7-v0", "BabyAI-GoToObj-v0"]
)
def test_observations_that_are_made_late_are_those_that_steps_give(id):
    pytest.importorskip("minigrid", exc_type=ImportError)
    model, env = (
        SimulatorModel(id, gamma=0.9, observe=lambda seen: np.append(seen["image"], seen["direction"])),
        EnvSource.of(id).make_one(),
    )
    observation, _ = env.reset(seed=3)
    base: Any = env.unwrapped
    state = model.root(env, observation)
    for action in (0, 2, 1, 2, 3, 2, 2, 5, 2, 0, 2):
        sample = model.sample(torch.tensor([state]), torch.tensor([action]), key_N=torch.tensor([5]))
        model.adapter.seed(base, 5)
        observation, reward, terminated, *_ = base.step(action)
        state = int(sample.next_state_N)
        assert model.snapshot(state).name == model.adapter.get_state(base).name
        assert (float(sample.reward_N), float(sample.discount_N)) == (reward, 0.0 if terminated else 0.9)
        (observed,) = model.observations(torch.tensor([state]))
        assert np.array_equal(observed, np.append(observation["image"], observation["direction"]))
        if terminated:
            break


def test_only_distinct_states_are_observed_and_an_observation_that_a_subclass_makes_is_kept(monkeypatch):
    doorkey = pytest.importorskip("minigrid.envs", exc_type=ImportError).DoorKeyEnv
    observed = []
    real = doorkey.gen_obs
    monkeypatch.setattr(doorkey, "gen_obs", lambda env: observed.append(env) or real(env))

    class Dimmed(doorkey):
        def step(self, action):
            observation, *rest = super().step(action)
            return {**observation, "image": observation["image"] // 2}, *rest

    images = []
    for make in (doorkey, Dimmed):
        env = make(size=5)
        observation, _ = env.reset(seed=0)
        model = SimulatorModel(lambda make=make: make(size=5), gamma=0.9, observe=lambda seen: seen["image"])
        observed.clear()
        look = expectimax(model, torch.tensor([model.root(env, observation)]), depth=2, v_leaf=zeros)
        # Late, where nothing but the environment itself makes them: only those that somebody asks for.
        assert len(observed) == (0 if make is doorkey else model.simulator_steps)
        for _ in range(2):
            model.observations(torch.arange(model.num_states))
        apart_from_the_clock = {model.snapshot(s).key for s in range(1, model.num_states)}
        assert len(observed) == (len(apart_from_the_clock) if make is doorkey else model.simulator_steps)
        images.append(model.observations(torch.tensor([1]))[0])
    assert look.model_calls > 2 * model.num_states
    assert np.array_equal(images[0] // 2, images[1])
    assert images[1].any()


class Hasty(Corridor):
    """Its steps name a discount while there is much fuel."""

    metadata: ClassVar = {"discounts": True}

    def step(self, action):
        *told, info = super().step(action)
        return (*told, {"discount": 0.5} if self.fuel > 18 else info)


def test_an_outcome_has_the_discount_that_the_step_names():
    model, env = SimulatorModel(lambda: Hasty(slip=0.0), gamma=0.9), reset(Hasty(slip=0.0), 0)
    first = model.outcomes(torch.tensor([model.root(env)]))
    assert first.discount_NAK.flatten().tolist() == [0.5, 0.5]
    second = model.outcomes(first.child_NAK[0, :1, 0])
    assert second.discount_NAK.flatten().tolist() == [0.9, 0.9]
    twice = SimulatorModel(lambda: Hasty(slip=0.0), gamma=0.9, action_repeat=2)
    assert twice.outcomes(torch.tensor([twice.root(env)])).discount_NAK.flatten().tolist() == [
        0.45,
        0.0,
    ]  # the end is two to the right


def test_what_chance_decides_is_queried_for_every_key():
    model = SimulatorModel(Corridor, gamma=0.9)
    root = model.root(reset(Corridor(), 0))
    model.sample(torch.full((50,), root), torch.ones(50, dtype=torch.int64), key_N=keys(50))
    assert model.simulator_steps == 50
    assert model.num_states == 3  # where it began, and one step to either side


def reset(env: gymnasium.Env, seed: int) -> gymnasium.Env:
    env.reset(seed=seed)
    return env


@pytest.mark.parametrize("id", ["FrozenLake-v1", "CartPole-v1", "Blackjack-v1"])
def test_an_outcome_is_a_function_of_state_action_and_key_alone(id):
    model, other = SimulatorModel(id, gamma=0.9), SimulatorModel(id, gamma=0.9)
    global_before = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    envs = [reset(gymnasium.make(id), seed) for seed in range(6)]
    state_N, action_N, key_N = model.roots(envs).repeat(4), torch.arange(24) % model.num_actions, keys(24)
    sample = model.sample(state_N, action_N, key_N=key_N)
    order_N = torch.randperm(24, generator=stream(0, "order"))
    reordered = other.sample(other.roots(envs).repeat(4)[order_N], action_N[order_N], key_N=key_N[order_N])
    assert torch.equal(reordered.reward_N, sample.reward_N[order_N])
    assert np.array_equal(
        other.observations(reordered.next_state_N), model.observations(sample.next_state_N)[order_N.numpy()]
    )
    if id != "CartPole-v1":
        assert not torch.equal(model.sample(state_N, action_N, key_N=keys(24, 1)).next_state_N, sample.next_state_N)
    assert np.array_equal(np.random.get_state()[1], global_before[0])  # noqa: NPY002
    assert torch.equal(torch.get_rng_state(), global_before[1])


@pytest.mark.parametrize("id", ["FrozenLake-v1", "Taxi-v4", "Acrobot-v1"])
def test_a_search_leaves_the_environment_it_starts_from_bit_identical(id, monkeypatch):
    env, twin = reset(gymnasium.make(id), 3), reset(gymnasium.make(id), 3)
    before = generator_state(env.unwrapped), repr(vars(env.unwrapped))
    model = SimulatorModel(id, gamma=0.9)
    monkeypatch.setattr(copy, "deepcopy", lambda *_: pytest.fail("deepcopy"))
    sampled(model, model.roots([env]), depth=2, v_leaf=zeros, samples=2, generator=stream(0, "search"))
    assert model.simulator_steps > 10
    assert (generator_state(env.unwrapped), repr(vars(env.unwrapped))) == before
    for action in [0, 1, 2, 1, 0, 2]:
        (seen, *rest), (expected, *other) = env.step(action), twin.step(action)
        assert np.array_equal(seen, expected)
        assert rest[:3] == other[:3]


# Work for a call


def counting(monkeypatch: pytest.MonkeyPatch, place: Any, name: str) -> list[None]:
    """One entry for each call of a function from here on."""
    calls, real = [], getattr(place, name)
    monkeypatch.setattr(place, name, lambda *args, **kwargs: calls.append(None) or real(*args, **kwargs))
    return calls


@pytest.mark.parametrize("count", [1, 40])
def test_a_batch_of_calls_reads_no_generator_looks_into_no_single_observation_and_makes_as_many_tensors_as_one(
    count, monkeypatch
):
    model = SimulatorModel("CartPole-v1", gamma=0.9)
    root_B = model.roots([reset(gymnasium.make("CartPole-v1"), seed) for seed in range(count + 1)])
    model.outcomes(root_B[:1])
    states, seeds = counting(monkeypatch, chance, "generator_state"), counting(monkeypatch, snapshots, "reseed")
    checks, tensors = counting(monkeypatch, stepper, "check_observation"), counting(monkeypatch, torch, "tensor")
    model.outcomes(root_B[1:])
    assert (len(states), len(seeds), len(checks), len(tensors)) == (0, 0, 0, 3)


def test_a_model_that_nobody_needs_is_gone_at_once():
    # A cycle of references would keep all of its states until the garbage collector has looked through all objects.
    model = SimulatorModel("CartPole-v1", gamma=0.9)
    model.outcomes(torch.tensor([model.root(reset(gymnasium.make("CartPole-v1"), 0))]))
    is_alive = weakref.ref(model)
    del model
    assert is_alive() is None


@pytest.mark.parametrize("enabled", [True, False])
def test_the_collector_of_cycles_waits_while_a_batch_is_answered_and_is_as_before_after_it(enabled):
    (gc.enable if enabled else gc.disable)()
    try:
        model = SimulatorModel("CliffWalking-v1", gamma=0.9)
        root_B = every_state("CliffWalking-v1", model, 48)
        seen, real = list[bool](), model.env.step
        model.env.step = lambda action: seen.append(gc.isenabled()) or real(action)
        model.outcomes(root_B)
        assert seen == [False] * 4 * 48
        assert gc.isenabled() == enabled
        broken = SimulatorModel(lambda: Broken("raises"), gamma=0.9)
        with pytest.raises(PgtsError, match="division by zero"):
            expectimax(broken, torch.tensor([broken.root(reset(Broken("raises"), 0))]), depth=3, v_leaf=zeros)
        assert gc.isenabled() == enabled
    finally:
        gc.enable()


class Gusty(Corridor):
    """A corridor in which steps to the right draw by a method that was taken from the generator before the first
    step, so that nothing of the environment is read as they draw."""

    def reset(self, **kwargs):
        answer = super().reset(**kwargs)
        self.gust = self.np_random.random
        return answer

    def step(self, action):
        if action == 6:
            self.gust()
        return super().step(action)


def test_a_draw_is_noticed_however_it_is_made_and_only_where_it_is_made():
    model = SimulatorModel(lambda: Gusty(slip=0.0), gamma=0.9)
    root_B = torch.tensor([model.root(reset(Gusty(slip=0.0), 0))])
    assert model.is_random(root_B.repeat(2), torch.tensor([0, 1])).tolist() == [False, True]
    for _ in range(2):
        with pytest.raises(RandomOutcomes, match="is random in state 0 under action 1"):
            model.outcomes(root_B)
    # What was certain in such a batch is remembered, and nothing else.
    steps = model.simulator_steps
    model.sample(root_B.repeat(2), torch.tensor([0, 1]), key_N=keys(2))
    assert model.simulator_steps == steps + 1


# Observations, clearing, devices


def test_observations_are_those_of_the_environment_and_wait_for_those_of_roots():
    model = SimulatorModel("CartPole-v1", gamma=0.9)
    env = gymnasium.make("CartPole-v1")
    observation, _ = env.reset(seed=2)
    root_B = model.roots([env])
    with pytest.raises(PgtsError, match="CartPole-v1: the observation of state 0 was not given"):
        model.observations(root_B)
    assert torch.equal(model.roots([env], [observation]), root_B)
    child = int(model.outcomes(root_B).child_NAK[0, 1, 0])
    after, *_ = env.step(1)
    seen = model.observations(torch.tensor([0, child]))
    assert seen.dtype == np.float32
    assert np.array_equal(seen, np.stack([observation, after]))
    assert model.root(env) == child


class Canvas(Corridor):
    """Its observation is one array again and again, which it writes into."""

    def __init__(self):
        super().__init__(slip=0.0)
        self.canvas = np.zeros(2)

    def look(self):
        self.canvas[:] = self.position, self.fuel
        return self.canvas


class Diptych(Canvas):
    """With that array as a part of others."""

    def __init__(self):
        super().__init__()
        alone = self.observation_space
        self.observation_space = spaces.Dict({"a": alone, "b": spaces.Tuple([alone])})

    def look(self):
        canvas = super().look()
        return {"a": canvas, "b": (canvas,)}


@pytest.mark.parametrize("make", [Canvas, Diptych])
def test_a_remembered_observation_stays_when_the_environment_writes_into_it(make):
    model, env = SimulatorModel(make, gamma=0.9), make()
    root_B = torch.tensor([model.root(env, env.reset(seed=0)[0])])
    model.outcomes(model.outcomes(root_B).child_NAK.flatten())
    where = [model.adapter.set_state(env, model.snapshot(s).data) or env.get_state() for s in range(model.num_states)]
    assert len(set(where)) == model.num_states > 3
    seen = model.observations(torch.arange(model.num_states))
    assert np.array_equal(seen, np.tile(where, (1, 1 if make is Canvas else 2)))


def test_observe_decides_what_is_remembered():
    pytest.importorskip("minigrid")
    model = SimulatorModel("MiniGrid-Empty-5x5-v0", gamma=0.9, observe=lambda seen: seen["image"])
    env = EnvSource.of("MiniGrid-Empty-5x5-v0").make_one()
    observation, _ = env.reset(seed=0)
    model.outcomes(model.roots([env], [observation]))
    assert model.observations(torch.arange(3)).shape == (3, 7, 7, 3)
    whole = SimulatorModel("MiniGrid-Empty-5x5-v0", gamma=0.9)
    with pytest.raises(PgtsError, match="cannot be flattened: give `observe`"):
        whole.observations(whole.roots([env], [observation]))
    cards = SimulatorModel("Blackjack-v1", gamma=1.0)
    assert cards.observations(cards.roots([reset(gymnasium.make("Blackjack-v1"), 0)], [(12, 3, 0)])).shape == (1, 45)


def test_after_clear_numbers_start_again_and_an_old_topology_refuses_to_go_on():
    model = SimulatorModel("CliffWalking-v1", gamma=0.9)
    root_B = model.roots([standing_in("CliffWalking-v1", 36)])
    topology = Topology(model)
    expectimax(model, root_B, depth=2, v_leaf=zeros, topology=topology)
    assert model.num_states > 4
    model.clear()
    assert (model.num_states, model.generation) == (0, 1)
    assert model.roots([standing_in("CliffWalking-v1", 3)]).tolist() == [0]
    with pytest.raises(PgtsError):
        expectimax(model, root_B, depth=2, v_leaf=zeros, topology=topology)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_answers_are_in_the_dtype_of_the_model_and_a_given_bound_is_kept(dtype):
    model = SimulatorModel("CliffWalking-v1", gamma=0.9, dtype=dtype, highest_value=0.0)
    root_B = model.roots([standing_in("CliffWalking-v1", 36)])
    answer, sample = model.outcomes(root_B), model.sample(root_B, root_B, key_N=keys(1))
    for tensor in (answer.reward_NA, answer.prob_NAK, answer.discount_NAK, sample.reward_N, sample.discount_N):
        assert tensor.dtype == model.dtype == dtype
    assert (model.highest_value, SimulatorModel(Corridor, gamma=1.0).highest_value) == (0.0, math.inf)


# Actions


def test_actions_are_all_of_a_discrete_space_in_its_own_numbers():
    assert SimulatorModel(Corridor, gamma=1.0).actions == [5, 6]
    several = list(all_actions(spaces.MultiDiscrete([2, 3], start=[1, 0])))
    assert [action.tolist() for action in several] == [[1, 0], [1, 1], [1, 2], [2, 0], [2, 1], [2, 2]]


def test_continuous_actions_are_a_grid_or_a_sample():
    space = spaces.Box(np.float32([-1, 0]), np.float32([1, 4]))
    grid = grid_actions(space, 3)
    assert [action.tolist() for action in grid[:4]] == [[-1, 0], [-1, 2], [-1, 4], [0, 0]]
    assert len(grid) == 9
    assert all(action in space for action in grid)
    sample = sampled_actions(space, 7, seed=1)
    assert len(sample) == 7
    assert all(action in space for action in sample)
    assert np.array_equal(sampled_actions(space, 7, seed=1), sample)
    assert not np.array_equal(sampled_actions(space, 7, seed=2), sample)
    model = SimulatorModel("Pendulum-v1", gamma=0.9, actions=grid_actions(spaces.Box(-2, 2, (1,)), 5))
    env = reset(gymnasium.make("Pendulum-v1"), 0)
    reward_A = model.outcomes(model.roots([env])).reward_NA[0]
    assert reward_A[4].item() == env.step(np.float32([2.0]))[1]


# Refusals


def slippery() -> SimulatorModel:
    model = SimulatorModel("FrozenLake-v1", gamma=0.9)
    model.roots([standing_in("FrozenLake-v1", 0)])
    return model


ZERO = torch.zeros(1, dtype=torch.int64)
REFUSALS = {
    "FrozenLake-v1 is random in state 0 under action 0: its outcomes cannot be enumerated; search it by `sampled`": (
        lambda: slippery().outcomes(ZERO)
    ),
    "FrozenLake-v1: state 1 does not exist; there are 1, from 0 on": lambda: slippery().outcomes(ZERO + 1),
    "FrozenLake-v1: state -1 does not exist": lambda: slippery().sample(ZERO - 1, ZERO, key_N=ZERO),
    "FrozenLake-v1: action 4 does not exist": lambda: slippery().sample(ZERO, ZERO + 4, key_N=ZERO),
    "gamma is 1.5; it must be in": lambda: SimulatorModel("FrozenLake-v1", gamma=1.5),
    "gamma is nan; it must be in": lambda: SimulatorModel("FrozenLake-v1", gamma=math.nan),
    "actions is empty": lambda: SimulatorModel("FrozenLake-v1", gamma=0.9, actions=[]),
    "Corridor has no spec to make another instance from: give a function": lambda: SimulatorModel(
        Corridor(), gamma=1.0
    ),
    "the actions of Box.* cannot be enumerated: give some, as grid_actions": lambda: SimulatorModel(
        "Pendulum-v1", gamma=1.0
    ),
    "Discrete.2. is no bounded Box": lambda: grid_actions(spaces.Discrete(2), 2),
    "Box.* is no bounded Box": lambda: sampled_actions(spaces.Box(-np.inf, 1, (2,)), 2, seed=0),
    "per_dimension is 1": lambda: grid_actions(spaces.Box(0, 1, (2,)), 1),
    "per_dimension is 3; .* at most 10,000 actions in 9 dimensions": lambda: grid_actions(spaces.Box(0, 1, (9,)), 3),
    "count is 0": lambda: sampled_actions(spaces.Box(0, 1, (2,)), 0, seed=0),
    "Nope-v0 cannot be made: Environment `Nope` doesn't exist": lambda: EnvSource.of("Nope-v0").make_one(),
    "CartPole-v1 is not the environment that the model was made from .FrozenLake-v1.": (
        lambda: slippery().root(reset(gymnasium.make("CartPole-v1"), 0))
    ),
    "FrozenLake-v1 is not the environment .* map or constants differ": (
        lambda: slippery().root(standing_in("FrozenLake-v1", 0, map_name="8x8"))
    ),
}


@pytest.mark.parametrize("message", REFUSALS)
def test_a_mistake_is_named(message):
    with pytest.raises(PgtsError, match=message):
        REFUSALS[message]()


def test_other_constants_are_another_environment():
    model, env = SimulatorModel("CartPole-v1", gamma=0.9), reset(gymnasium.make("CartPole-v1"), 0)
    assert model.root(env) == 0
    heavy = reset(gymnasium.make("CartPole-v1"), 0)
    heavy.unwrapped.gravity = 20.0
    with pytest.raises(PgtsError, match="constants differ"):
        model.root(heavy)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raises", "ZeroDivisionError: division by zero"),
        ("reward", "the reward is nan"),
        ("observation", r"the observation is \[nan, 1.0\]; it must be finite"),
        ("shape", r"the observation has shape \(1,\); \(2,\) is declared"),
        ("arity", r"ValueError: not enough values to unpack"),
    ],
)
def test_an_environment_that_fails_is_named_with_state_action_and_key(fault, message):
    model = SimulatorModel(lambda: Broken(fault), gamma=0.9)
    broken = reset(Broken(fault), 0)
    broken.position = 1
    state_N, key_N = model.roots([broken]), torch.tensor([77])
    assert model.sample(state_N, torch.tensor([0]), key_N=key_N).reward_N.item() == pytest.approx(1.9)
    with pytest.raises(
        PgtsError, match=rf"^Broken failed in state 0 under action 1 \(6\) with key 77: {message}"
    ) as raised:
        model.sample(state_N, torch.tensor([1]), key_N=key_N)
    assert raised.value.__cause__ is not None
    assert model.sample(state_N, torch.tensor([0]), key_N=key_N).discount_N.item() == 0.9
    # In a batch it is the same step, without a key, and what comes after it does not matter.
    whole = SimulatorModel(lambda: Broken(fault), gamma=0.9)
    state_N = whole.roots([reset(Broken(fault), 0), broken, reset(Broken(fault), 0)])
    with pytest.raises(PgtsError, match=rf"^Broken failed in state 1 under action 1 \(6\): {message}"):
        whole.outcomes(state_N)
