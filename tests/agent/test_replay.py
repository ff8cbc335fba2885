"""Training from imagined episodes that start in replayed states."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from pgts_torch import PGTS
from pgts_torch.agent.evaluate import Greedy
from pgts_torch.agent.imagine import imagine
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.ongoing import OngoingEpisodes
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.target_updates import NetworkMirrorUpdate
from pgts_torch.agent.world import World
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.options import (
    CMPO,
    MLP,
    Counts,
    Ensemble,
    Mirror,
    NetworkTDLambda,
    NetworkValues,
    StepsHorizon,
    UniformReplay,
)
from pgts_torch.seeding import stream
from pgts_torch.tabular import deep_sea, exact
from tests.agent.helpers import following, vector_env
from tests.support import zoo

SMALL = {
    "depth": 1,
    "model": Ensemble(members=2, hidden=[16], first_updates=20),
    "replay": UniformReplay(updates_per_step=0.1, starts=4, length=5),
    "horizon": StepsHorizon(length=30, first=50),
    "policy": MLP(hidden=[16]),
}


class Slide(gymnasium.Env):
    """A position that actions move; its noise is of its own generator, or of numpy's global one."""

    observation_space = spaces.Box(-10, 10, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, *, shared: bool = False) -> None:
        self.shared = shared

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.normal(size=2)
        return self.state.astype(np.float32), {}

    def step(self, action):
        noise = np.random.normal() if self.shared else self.np_random.normal()  # noqa: NPY002
        self.state = self.state + np.array([0.1 * (2 * action - 1), 0.1 * noise])
        return self.state.astype(np.float32), float(self.state[0]), bool(abs(self.state[0]) > 1), False, {}


def world_of_slides(count: int, *, shared: bool = False) -> World:
    env = SyncVectorEnv([lambda: Slide(shared=shared)] * count, autoreset_mode=AutoresetMode.DISABLED)
    return World(env, gamma=0.9)


def collected(episodes: OngoingEpisodes, *lengths: int) -> list:
    policy = PGTS(Slide, depth=0, estimator="sampled", num_envs=1).policy
    return [
        episodes.collect(policy, length, names=("test", k), generator=stream(k, "test"))
        for k, length in enumerate(lengths)
    ]


def test_episodes_go_on_from_one_rollout_to_the_next():
    episodes = OngoingEpisodes(world_of_slides(3), max_length=17, seed=0, names=())
    rollouts = collected(episodes, 20, 7, 40)
    steps = [rollout.steps() for rollout in rollouts]
    assert [rollout.num_steps for rollout in rollouts] == [60, 21, 120]
    for rollout, step in zip(rollouts, steps, strict=True):
        assert rollout.finished is not None
        follows_N, over_N = step.follows_N, step.discount_N == 0
        assert not bool((follows_N & over_N).any())
        after_N = step.next_observation_N[:-1][follows_N[:-1]]
        assert after_N.equal(step.observation_N[1:][follows_N[:-1]])
        second_B = rollout.weight_TB[1]
        assert second_B.tolist() == [0.9 if alive else 0.0 for alive in rollout.alive_TB[1].tolist()]
    finished = [each for rollout in rollouts for each in rollout.finished]
    assert all(length <= 17 for _, length in finished)
    assert len({length for _, length in finished}) > 1
    # all rewards belong to an episode: those that ended, and the three that did not
    total = sum(float(step.reward_N.sum()) for step in steps)
    open_returns = episodes.state_dict()["return"]
    assert total == pytest.approx(sum(value for value, _ in finished) + sum(open_returns))


def test_episodes_are_restored_from_their_seeds_and_actions():
    one, other = (OngoingEpisodes(world_of_slides(3), max_length=17, seed=0, names=()) for _ in range(2))
    collected(one, 20, 7)
    other.load_state_dict(one.state_dict())
    for mine, its in zip(collected(one, 9, 30), collected(other, 9, 30), strict=True):
        assert mine.observation_UB.equal(its.observation_UB)
        assert mine.reward_TB.equal(its.reward_TB)
        assert mine.finished == its.finished


def test_episodes_that_cannot_be_repeated_are_refused():
    world = world_of_slides(1, shared=True)
    one, other = (OngoingEpisodes(world, max_length=500, seed=0, names=()) for _ in range(2))
    with pytest.warns(UserWarning, match="the whole process shares"):
        collected(one, 5, 4)
    with pytest.raises(
        PgtsError, match=r"does not repeat its episode from the seed \d+ and \d+ actions.*horizon 'fixed'"
    ):
        other.load_state_dict(one.state_dict())
    with pytest.raises(PgtsError, match="it is of 1 environments; this training has 2"):
        OngoingEpisodes(world_of_slides(2), max_length=5, seed=0, names=()).load_state_dict(one.state_dict())
    with pytest.raises(PgtsError, match="num_envs 1, because its environments share one random generator"):
        OngoingEpisodes(World(vector_env(zoo("ladder"), 2), gamma=0.9), max_length=5, seed=0, names=())


def test_imagined_returns_are_unbiased():
    mdp = zoo("garnet")
    world = TabularWorld(vector_env(mdp, 1), mdp)
    pi_SA = torch.softmax(torch.randn(mdp.num_states, mdp.num_actions, generator=stream(0, "pi")).double(), -1)
    start_B = torch.zeros(4000, dtype=torch.int64)
    rollout = imagine(world, following(pi_SA), start_B, 100, generator=stream(1, "test"))
    returns_B = rollout.returns()
    v_S, error = exact.evaluate(mdp, pi_SA).v_S, float(returns_B.std()) / 4000**0.5
    cut = float(rollout.weight_TB[-1].max() * v_S.abs().max())  # of what comes after the last step
    assert abs(float(returns_B.mean() - v_S[0])) < 5 * error + cut  # outside with a probability below 1e-6
    assert rollout.state_UB is not None
    assert rollout.state_UB.equal(rollout.observation_UB)


class Trusting(TabularModel):
    """A table that does not trust steps from some states."""

    def __init__(self, mdp, doubted: list[int]) -> None:
        super().__init__(mdp)
        self.doubted = torch.tensor(doubted)

    def sample(self, state_N, action_N, *, key_N):
        return replace(super().sample(state_N, action_N, key_N=key_N), trusted_N=~torch.isin(state_N, self.doubted))


def test_imagined_episodes_are_cut_off_before_steps_that_are_not_trusted():
    mdp, doubted = zoo("garnet"), [1, 2]
    pi_SA, start_B = torch.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions), torch.arange(mdp.num_states)

    def imagined(doubted: list[int]) -> Rollout:
        world = TabularWorld(vector_env(mdp, 1), mdp, model=Trusting(mdp, doubted))
        return imagine(world, following(pi_SA), start_B, 30, generator=stream(0, "test"))

    cut, whole = imagined(doubted), imagined([])
    assert bool(cut.alive_TB[0].all())  # the first step is taken everywhere
    assert not torch.isin(cut.state_TB[1:][cut.alive_TB[1:]], torch.tensor(doubted)).any()
    assert torch.isin(whole.state_TB[1:][whole.alive_TB[1:]], torch.tensor(doubted)).any()
    # until then both are the same, and the state that an episode is cut off in is what its critic is asked for
    assert cut.reward_TB[cut.alive_TB].equal(whole.reward_TB[: len(cut.alive_TB)][cut.alive_TB])
    last_B, episode_B = cut.alive_TB.sum(0), torch.arange(mdp.num_states)
    ends_B = cut.state_UB[last_B, episode_B]
    assert torch.isin(ends_B[last_B < 30], torch.tensor(doubted)).all()
    assert bool((cut.discount_TB[last_B - 1, episode_B] > 0).all())


def test_a_lookahead_from_some_visits_weighs_states_like_one_from_all():
    mdp = zoo("garnet")
    world = TabularWorld(vector_env(mdp, 1), mdp)
    pi_SA, start_B = torch.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions), torch.zeros(4000).long()
    rollouts = [
        imagine(world, following(pi_SA), start_B, 12, search_every=every, generator=stream(0, "test"))
        for every in (1, 4)
    ]
    for weight in ("visits", "occupancy"):
        whole_S, part_S = torch.zeros(2, mdp.num_states, dtype=torch.float64)
        for into_S, rollout in zip((whole_S, part_S), rollouts, strict=True):
            states, weight_N = rollout.visits(weight)
            into_S[states] = weight_N
            assert rollout.first_observation_N.equal(states)
        assert float(part_S.sum()) == pytest.approx(float(whole_S.sum()), rel=0.02)
        assert float((part_S - whole_S).abs().max()) < 0.05 * float(whole_S.max())
        assert not part_S.equal(whole_S)
    searched_TB = rollouts[1].searched_TB
    assert int(searched_TB.sum()) == searched_TB.numel() // 4
    assert rollouts[1].num_steps == rollouts[0].num_steps


@pytest.mark.parametrize(
    ("env", "arguments"),
    [
        ("CartPole-v1", SMALL),
        ("CartPole-v1", SMALL | {"model": "auto"}),
        ("FrozenLake-v1", {"model": "counts", "depth": 8}),
        ("FrozenLake-v1", {"replay": UniformReplay(starts=4, length=5), "depth": 8}),
    ],
    ids=["ensemble", "dynamics", "counts", "table"],
)
def test_a_training_with_replay_goes_on_bit_for_bit(env, arguments, tmp_path):
    whole = PGTS(env, seed=3, **arguments).learn(120)
    half = PGTS(env, seed=3, **arguments).learn(60)
    half.save(tmp_path / "half.pt")
    rest = PGTS.load(tmp_path / "half.pt").learn(120)
    assert rest.num_env_steps == whole.num_env_steps
    assert rest.num_model_calls == whole.num_model_calls
    for part in ("policy", "critic", "dyna"):
        assert equal(getattr(rest, part).state_dict(), getattr(whole, part).state_dict())


def equal(one, other) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    return one.equal(other) if isinstance(one, torch.Tensor) else one == other


@pytest.mark.parametrize("model", ["auto", Counts()], ids=["given", "learned"])
def test_a_table_learns_from_replay(model):
    training, mdp = PGTS("pgts/Ladder-v0", depth=8, model=model, replay="uniform", seed=0), zoo("ladder")
    before = exact.evaluate(mdp, training.policy_table()).J
    J = exact.evaluate(mdp, training.learn(200).policy_table()).J
    assert J > 0.9 * exact.optimal(mdp).J > 5 * before


def test_a_policy_explores_beside_the_one_that_is_trained():
    """On the deep sea random actions find the treasure once in 2^7 episodes; and half of what is left leads nowhere."""
    arguments = {"env_kwargs": {"n": 8, "start": 0}, "model": "counts", "depth": 16, "seed": 0}
    training, mdp = PGTS("pgts/DeepSea-v0", **arguments).learn(50), deep_sea(8, start=0)
    state_S, explorer = torch.arange(mdp.num_states), training.dyna.explorer
    assert explorer is not None
    assert training.policy_table().equal(training.policy.probs(state_S))
    assert not torch.equal(explorer.policy.probs(state_S), training.policy.probs(state_S))
    training.learn(250)
    assert exact.evaluate(mdp, Greedy(training.policy).probs(state_S)).J == pytest.approx(exact.optimal(mdp).J)
    without = PGTS("pgts/DeepSea-v0", **arguments | {"model": Counts(optimism="none")}).learn(250)
    assert without.dyna.explorer is None
    assert exact.evaluate(mdp, Greedy(without.policy).probs(state_S)).J <= 0


def test_news_are_learned_at_once():
    training = PGTS("CliffWalking-v1", model="counts", depth=4, seed=0)
    lengths = [training.iterate().experience.num_steps for _ in range(5)]
    assert lengths == [1] * 5  # each step from a state that was never left in this way
    assert training.world.model.num_outcomes >= 2


def test_a_model_of_the_callers_own_is_searched():
    mdp = zoo("ladder")
    own = TabularModel(mdp)
    training = PGTS("pgts/Ladder-v0", model=own, num_envs=2)
    assert training.world.model is own
    training.iterate()
    assert training.num_model_calls > 0
    with pytest.raises(PgtsError, match="model was given as"):
        training.content()
    with pytest.raises(PgtsError, match=r"TabularModel has 2 actions; Taxi"):
        PGTS("Taxi-v4", model=own)
    with pytest.raises(PgtsError, match="numbered observations need"):
        PGTS("CartPole-v1", model=own)


def test_what_does_not_go_with_a_learned_model_is_refused():
    with pytest.raises(MissingModel, match=r"'ensemble'.* vectors of numbers.*'counts'"):
        PGTS("pgts/Ladder-v0", model="ensemble")
    with pytest.raises(MissingModel, match=r"'counts', which learns from numbers.*take 'ensemble'"):
        PGTS("CartPole-v1", model="counts")
    with pytest.raises(PgtsError, match=r"stop_at is 0\.1, which needs an upper bound"):
        PGTS("CartPole-v1", model="ensemble", stop_at=0.1)
    with pytest.raises(PgtsError, match=r"replay\.type uniform, or estimator\.type sampled"):
        PGTS("CartPole-v1", horizon="steps")
    with pytest.raises(PgtsError, match=r"estimator\.type sampled there is no lookahead"):
        PGTS("CartPole-v1", model="ensemble", estimator="sampled", depth=0)


def test_starts_that_are_not_sampled_bound_nothing():
    with pytest.raises(PgtsError, match="start states are known from episodes only"):
        PGTS("CartPole-v1", replay="uniform", depth="adaptive", reward_range=(0, 1))
    training = PGTS("CartPole-v1", **SMALL | {"model": "auto", "reward_range": (0, 1)})
    assert training.iterate().certificate == float("inf")


def test_options_that_suit_replay_are_chosen():
    training = PGTS("CartPole-v1", model="ensemble")
    options = training.options
    assert isinstance(options.replay, UniformReplay)
    assert isinstance(options.rollout.horizon, StepsHorizon)
    assert (options.rollout.num_envs, options.policy) == (1, MLP(normalize=True))
    assert isinstance(options.critic, NetworkValues)
    assert options.critic.network == options.policy
    assert isinstance(options.update, CMPO)
    assert (options.replay.length, options.critic.method) == (128, NetworkTDLambda(lambda_=1.0))
    assert training.dyna.policy is not training.policy


def test_an_update_starts_from_the_policy_that_the_batch_is_of():
    """With replay that is the slow copy. Advantages that hardly count lead to it, not to the trained one."""
    space, observation_N = spaces.Box(-1, 1, (2,), np.float32), torch.randn(64, 2, generator=stream(0, "test"))
    trained, slow = (NetworkPolicy(space, 3, MLP(hidden=[32]), seed=seed) for seed in (0, 1))
    slow.network.head.weight.data.mul_(200)  # else both are nearly uniform

    def apart() -> float:
        return float((trained.probs(observation_N) - slow.probs(observation_N)).abs().mean())

    before = apart()
    update = NetworkMirrorUpdate(Mirror(temperature=1e6, num_epochs=400, learning_rate=1e-2))
    advantage_NA = torch.randn(64, 3, generator=stream(1, "test"))
    update(trained, Batch(observation_N, advantage_NA, torch.ones(64), 0.0, slow), generator=stream(2, "test"))
    assert apart() < 0.2 * before
