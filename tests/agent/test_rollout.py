"""Experience: whose visits are d^pi, where episodes end, and what happens again with the same seed."""

import gymnasium
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorWrapper

from pgts_torch.agent.imagine import simulated_returns
from pgts_torch.agent.rollout import Rollout
from pgts_torch.bellman import Outcomes
from pgts_torch.envs import TabularVectorEnv
from pgts_torch.errors import PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.models.environments import EnvSource, check_vector_env
from pgts_torch.options import FixedHorizon, GeometricHorizon
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, deep_sea, exact, grid, ladder
from tests.agent.helpers import (
    experience,
    following,
    made_in,
    same_bits,
    transitions,
    vector_env,
    visit_z_scores,
    weight_by_episode,
    z_scores,
)
from tests.support import always, outcomes_of, random_policy, uniform_policy, zoo

FAR = 5.0
"""Standard errors; a normal mean lies farther off with probability 6e-7, so each test here (at most 100 means) fails by
chance with probability below 1e-4."""

DISCOUNTED = {
    "ladder": lambda: ladder(5, gamma=0.8),
    "grid": lambda: grid(5, gamma=0.8, traps=(12,), absorbing=True, slip=0.2),
    "FrozenLake": lambda: TabularMDP.from_gymnasium(gymnasium.make("FrozenLake-v1"), 0.9),
    "deep_sea": lambda: deep_sea(6, gamma=0.8, stochastic=True),
}


def chain() -> TabularMDP:
    """0 -> 1 -> 2 -> 2 -> ..., rewards 1, 2, 3, discounts 0.5, 0.8, 0.9."""
    return TabularMDP(
        Outcomes(
            torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64),
            torch.ones(3, 1, 1, dtype=torch.float64),
            torch.tensor([[[0.5]], [[0.8]], [[0.9]]], dtype=torch.float64),
            torch.tensor([[[1]], [[2]], [[2]]]),
            3,
        ),
        torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64),
    )


def truncated_occupancy(mdp: TabularMDP, pi_SA: torch.Tensor, length: int) -> torch.Tensor:
    """sum_{t < length} of mu^T (gamma P^pi)^t, one outcome after another."""
    d_S, now_S = torch.zeros(mdp.num_states, dtype=torch.float64), mdp.start_S.clone()
    for _ in range(length):
        d_S += now_S
        later_S = torch.zeros_like(now_S)
        for s, a in torch.cartesian_prod(torch.arange(mdp.num_states), torch.arange(mdp.num_actions)).tolist():
            for (child, discount), p in outcomes_of(mdp, s, a).items():
                later_S[child] += now_S[s] * pi_SA[s, a] * p * discount
        now_S = later_S
    return d_S


def by_hand() -> Rollout:
    """Two episodes, states 3 1 3 and 1 2; the second is over after two steps. In state s 10 t + s is seen at time t."""
    alive_TB = torch.tensor([[1, 1], [1, 1], [1, 0]], dtype=torch.bool)
    ones_TB = torch.ones(3, 2, dtype=torch.float64)
    state_UB = torch.tensor([[3, 1], [1, 2], [3, 0], [1, 0]])
    return Rollout(
        observation_UB=state_UB + 10 * torch.arange(4)[:, None],
        action_TB=torch.zeros(3, 2, dtype=torch.int64),
        reward_TB=torch.tensor([[1.0, 10.0], [2.0, 20.0], [3.0, 77.0]], dtype=torch.float64),
        discount_TB=0.5 * ones_TB,
        alive_TB=alive_TB,
        weight_TB=torch.tensor([[1.0, 1.0], [0.5, 0.5], [0.25, 0.0]], dtype=torch.float64),
        survival_TB=0.5 * ones_TB,
        state_UB=state_UB,
    )


def test_values_are_queried_once_for_each_visit_and_each_end():
    made, asked = by_hand(), []
    v_TB, next_v_TB = made.values(lambda seen_N: asked.append(seen_N) or 2.0 * seen_N)
    alive_TB = made.alive_TB
    assert v_TB[alive_TB].tolist() == [6.0, 2.0, 22.0, 24.0, 46.0]
    assert next_v_TB[alive_TB].tolist() == [22.0, 24.0, 46.0, 40.0, 62.0]
    assert v_TB.dtype == next_v_TB.dtype == made.reward_TB.dtype
    assert [len(seen_N) for seen_N in asked] == [made.num_steps + made.num_episodes] == [7]


def test_the_observation_of_a_distinct_state_is_that_of_its_first_visit():
    made = by_hand()
    assert made.observation_V.tolist() == [3, 1, 11, 12, 23]
    assert made.visits("visits")[0].tolist() == [1, 2, 3]
    assert made.first_observation_N.tolist() == [1, 12, 3]


@pytest.mark.parametrize("name", DISCOUNTED)
def test_visits_under_the_geometric_horizon_are_an_unbiased_sample_of_d_pi(name):
    mdp = DISCOUNTED[name]()
    pi_SA = random_policy(mdp, seed=1)
    truth = exact.evaluate(mdp, pi_SA)
    made = experience(mdp, pi_SA, GeometricHorizon(), episodes=8_000)
    visits_BS = weight_by_episode(made, made.weight_TB, mdp.num_states)
    assert visit_z_scores(visits_BS, truth.d_S).abs().max() < FAR
    assert abs(z_scores(made.returns()[:, None], torch.tensor([truth.J]))) < FAR

    states, weight_N = made.visits("occupancy")
    torch.testing.assert_close(weight_N, visits_BS.mean(0)[states])
    assert torch.equal(states, torch.nonzero(visits_BS.sum(0)).flatten())


@pytest.mark.parametrize("name", DISCOUNTED)
def test_the_comparison_would_see_missing_discounts(name):
    # Without terminal outcomes every discount is gamma; a wrong one shows, and so do visits that nothing discounts.
    mdp = DISCOUNTED[name]()
    pi_SA = random_policy(mdp, seed=1)
    made = experience(mdp, pi_SA, FixedHorizon(length=20), episodes=8_000)
    undiscounted_BS = weight_by_episode(made, made.alive_TB, mdp.num_states)
    assert visit_z_scores(undiscounted_BS, exact.occupancy(mdp, pi_SA)).abs().max() > 2 * FAR
    other = TabularMDP(
        Outcomes(
            mdp.outcomes.reward_NA,
            mdp.outcomes.prob_NAK,
            mdp.outcomes.discount_NAK * 0.9,
            mdp.outcomes.child_NAK,
            mdp.num_states,
        ),
        mdp.start_S,
    )
    made = experience(other, pi_SA, GeometricHorizon(), episodes=8_000)
    visits_BS = weight_by_episode(made, made.weight_TB, mdp.num_states)
    assert visit_z_scores(visits_BS, exact.occupancy(mdp, pi_SA)).abs().max() > 2 * FAR


def test_under_the_fixed_horizon_a_visit_weighs_the_discounts_before_it():
    made = experience(chain(), torch.ones(3, 1, dtype=torch.float64), FixedHorizon(length=4), episodes=2)
    assert made.state_TB[:, 0].tolist() == [0, 1, 2, 2]
    torch.testing.assert_close(made.weight_TB[:, 0], torch.tensor([1.0, 0.5, 0.4, 0.36], dtype=torch.float64))
    torch.testing.assert_close(made.returns(), torch.full((2,), 1 + 0.5 * 2 + 0.4 * 3 + 0.36 * 3, dtype=torch.float64))
    states, weight_N = made.visits("occupancy")
    assert states.tolist() == [0, 1, 2]
    torch.testing.assert_close(weight_N, torch.tensor([1.0, 0.5, 0.76], dtype=torch.float64))


@pytest.mark.parametrize("name", DISCOUNTED)
def test_under_the_fixed_horizon_the_weights_estimate_the_occupancy_of_its_first_steps(name):
    mdp = DISCOUNTED[name]()
    pi_SA = random_policy(mdp, seed=1)
    made = experience(mdp, pi_SA, FixedHorizon(length=4), episodes=8_000)
    weight_BS = weight_by_episode(made, made.weight_TB, mdp.num_states)
    assert visit_z_scores(weight_BS, truncated_occupancy(mdp, pi_SA, 4)).abs().max() < FAR
    assert visit_z_scores(weight_BS, exact.occupancy(mdp, pi_SA)).abs().max() > FAR
    assert made.num_steps <= 4 * 8_000


def test_the_three_state_weights_are_those_computed_by_hand():
    for state_weight, expected in [
        ("occupancy", [(0.5 + 1.0) / 2, 0.5 / 2, (1.0 + 0.25) / 2]),
        ("visits", [2 / 5, 1 / 5, 2 / 5]),
        ("uniform", [1.0, 1.0, 1.0]),
    ]:
        states, weight_N = by_hand().visits(state_weight)
        assert states.tolist() == [1, 2, 3]
        torch.testing.assert_close(weight_N, torch.tensor(expected, dtype=torch.float64))


def test_nothing_after_the_end_of_an_episode_counts():
    made = by_hand()
    assert made.num_steps == 5
    assert made.num_episodes == 2
    assert made.returns().tolist() == [1 + 0.5 * 2 + 0.25 * 3, 10 + 0.5 * 20]
    assert made.follows_TB.tolist() == [[True, True], [True, False], [False, False]]


@pytest.mark.parametrize("horizon", [FixedHorizon(length=12), GeometricHorizon()])
@pytest.mark.parametrize("name", ["FrozenLake", "deep_sea", "garnet", "grid, absorbing"])
def test_episodes_go_on_exactly_until_a_terminal_outcome_or_the_horizon(name, horizon):
    mdp = zoo(name)
    made = experience(mdp, uniform_policy(mdp), horizon, episodes=200)
    alive_TB, over_TB = made.alive_TB, made.survival_TB == 0
    assert alive_TB[0].all()
    assert torch.equal(alive_TB[1:], alive_TB[:-1] & ~over_TB[:-1])
    assert (made.weight_TB[~alive_TB] == 0).all()
    assert torch.equal(made.state_TB[1:][alive_TB[1:]], made.next_state_TB[:-1][alive_TB[1:]])
    assert (made.discount_TB[:-1][alive_TB[1:]] > 0).all()
    if isinstance(horizon, FixedHorizon):
        assert torch.equal(over_TB, made.discount_TB == 0)
        assert len(alive_TB) == (6 if name == "deep_sea" else 12)
    else:
        assert over_TB[-1][alive_TB[-1]].all()
        assert set(made.weight_TB.unique().tolist()) == {0.0, 1.0}


@pytest.mark.parametrize("name", ["FrozenLake-v1", "CliffWalking-v1", "Taxi-v4"])
def test_rollouts_of_gymnasiums_environments_are_transitions_of_their_tables(name):
    env = EnvSource.of(name).make(8)
    assert isinstance(env, SyncVectorEnv)
    check_vector_env(env)
    mdp = TabularMDP.from_gymnasium(env.envs[0], 0.9)
    made = made_in(env, following(uniform_policy(mdp)), FixedHorizon(length=250), gamma=0.9)
    table = env.envs[0].unwrapped.P
    for s, a, reward, discount, child in transitions(made):
        listed = {(float(r), 0.0 if over else 0.9, next_state) for p, next_state, r, over in table[s][a] if p > 0}
        assert (reward, discount, child) in listed
    length_B = made.alive_TB.sum(0)
    last_B = made.discount_TB[length_B - 1, torch.arange(8)]
    assert ((length_B == 250) | (last_B == 0)).all()
    assert (mdp.start_S[made.state_TB[0]] > 0).all()


@pytest.mark.parametrize("name", ["pgts/Ladder-v0", "pgts/Grid-v0", "pgts/DeepSea-v0", "pgts/Random-v0"])
def test_our_environments_make_the_same_kind_of_rollout_together_and_one_by_one(name):
    mdp = gymnasium.make(name).unwrapped.mdp
    together = EnvSource.of(name).make(3)
    assert isinstance(together, TabularVectorEnv)
    single = gymnasium.make_vec(
        name, 3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": AutoresetMode.DISABLED}
    )
    for env in (together, single):
        made = made_in(env, following(uniform_policy(mdp)), FixedHorizon(length=30), gamma=float("nan"), seed=3)
        for s, a, reward, discount, child in transitions(made):
            assert (child, discount) in outcomes_of(mdp, s, a)
            assert reward == mdp.outcomes.reward_NA[s, a]


def test_the_environments_own_discount_overrides_gamma():
    assert TabularVectorEnv(ladder(gamma=0.7), 1).mdp.outcomes.discount_NAK.unique().tolist() == [0.7]
    made = experience(ladder(gamma=0.7), uniform_policy(ladder()), FixedHorizon(length=3), episodes=4, gamma=0.2)
    assert made.discount_TB.unique().tolist() == [0.7]
    assert EnvSource.of("pgts/Ladder-v0", gamma=0.6).make(2).mdp.outcomes.discount_NAK.unique().tolist() == [0.6]
    assert EnvSource.of("pgts/Ladder-v0").make(2).mdp.outcomes.discount_NAK.unique().tolist() == [0.9]


@pytest.mark.parametrize("name", ["pgts/Ladder-v0", "FrozenLake-v1"])
def test_a_time_limit_cuts_an_episode_without_terminating_it(name):
    env = EnvSource.of(name, gamma=0.9, kwargs={"max_episode_steps": 4}).make(50)
    num_states, num_actions = env.single_observation_space.n, env.single_action_space.n
    made = made_in(
        env,
        following(torch.full((num_states, num_actions), 1 / num_actions, dtype=torch.float64)),
        FixedHorizon(length=10),
        gamma=0.9,
    )
    cut_B = made.alive_TB[3] & (made.discount_TB[3] > 0)
    assert cut_B.any()
    assert made.alive_TB[4:].sum() == 0
    assert (made.discount_TB[3, cut_B] == 0.9).all()
    assert (made.survival_TB[3, cut_B] == 0.9).all()
    assert EnvSource.of(name, gamma=0.9).make(2).reset(seed=[0, 1])[0].shape == (2,)


def test_an_environment_that_is_truncated_early_counts_no_longer():
    class FirstCopyIsCut(VectorWrapper):
        def step(self, actions):
            *answer, truncated, info = super().step(actions)
            truncated[0] = True
            return *answer, truncated, info

    made = made_in(
        FirstCopyIsCut(vector_env(ladder(), 3)), following(uniform_policy(ladder())), FixedHorizon(length=5), gamma=0.9
    )
    assert made.alive_TB.sum(0).tolist() == [1, 5, 5]
    assert (made.weight_TB > 0).sum(0).tolist() == [1, 5, 5]
    assert made.discount_TB[0].tolist() == [0.9] * 3


def test_the_environments_own_time_limit_is_off_in_training():
    for name in ("pgts/Ladder-v0", "FrozenLake-v1"):
        env = EnvSource.of(name, gamma=0.9, kwargs={"is_slippery": False} if name == "FrozenLake-v1" else {}).make(1)
        num_states, num_actions = int(env.single_observation_space.n), int(env.single_action_space.n)
        left_SA = torch.eye(num_actions, dtype=torch.float64)[0].repeat(num_states, 1)
        made = made_in(env, following(left_SA), FixedHorizon(length=300), gamma=0.9)
        assert made.num_steps == 300


@pytest.mark.parametrize("name", ["pgts/Random-v0", "FrozenLake-v1"])
@pytest.mark.parametrize("horizon", [FixedHorizon(length=20), GeometricHorizon()])
def test_the_same_seed_and_names_give_the_same_rollout_whatever_was_before(name, horizon):
    env = EnvSource.of(name, gamma=0.9).make(4)
    pi_SA = torch.full((env.single_observation_space.n, env.single_action_space.n), 1.0, dtype=torch.float64)
    policy = following(pi_SA / pi_SA.sum(-1, keepdim=True))

    def made(seed: int, iteration: int) -> Rollout:
        names = ("iteration", iteration)
        return made_in(env, policy, horizon, gamma=0.9, seed=seed, names=names, generator=stream(seed, *names))

    first = made(0, 0)
    others = [made(0, 1), made(1, 0), made(1, 1)]
    assert same_bits(first, made(0, 0))
    for other in others:
        steps = min(len(first.action_TB), len(other.action_TB))
        assert not torch.equal(first.action_TB[:steps], other.action_TB[:steps])


def test_neighbouring_seeds_and_iterations_hand_disjoint_seeds_to_the_environment():
    class Recorded(VectorWrapper):
        def reset(self, *, seed=None, options=None):
            words.extend(seed or [])
            return super().reset(seed=seed, options=options)

    # 800 words of 32 bits: two of them are equal by chance with probability 1e-4.
    words: list[int] = []
    mdp = ladder()
    env = Recorded(vector_env(mdp, 16))
    for seed in range(10):
        for iteration in range(5):
            names = ("iteration", iteration)
            made_in(
                env,
                following(uniform_policy(mdp)),
                FixedHorizon(length=1),
                gamma=0.9,
                seed=seed,
                names=names,
                generator=stream(seed, *names),
            )
    assert len(words) == len(set(words)) == 10 * 5 * 16


@pytest.mark.fault("autoreset in the next step")
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_environments_that_reset_by_themselves_are_refused(mode):
    with pytest.raises(PgtsError, match=rf"resets by {mode}.*DISABLED"):
        check_vector_env(TabularVectorEnv(ladder(), 2, autoreset_mode=mode))
    sync = gymnasium.make_vec("FrozenLake-v1", 2, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode})
    with pytest.raises(PgtsError, match="DISABLED"):
        check_vector_env(sync)


def test_actions_that_are_not_counted_from_0_are_refused():
    class Shifted(VectorWrapper):
        single_action_space = gymnasium.spaces.Discrete(2, start=1)

    with pytest.raises(PgtsError, match=r"the actions of Pendulum-v1 are continuous, Box"):
        EnvSource.of("Pendulum-v1").make(2)
    with pytest.raises(PgtsError, match=r"are Discrete\(2, start=1\)"):
        check_vector_env(Shifted(vector_env(ladder(), 2)))


@pytest.mark.fault("unknown environment", "deprecated environment")
@pytest.mark.parametrize(
    ("name", "num_envs", "kwargs"),
    [
        ("pgts/Nowhere-v0", 2, {}),
        ("Nowhere-v0", 2, {}),
        ("nowhere:Nowhere-v0", 2, {}),
        ("no id at all", 2, {}),
        ("Taxi-v3", 2, {}),
        ("pgts/Ladder-v0", 2, {"size": 3}),
        ("FrozenLake-v1", 2, {"size": 3}),
        ("FrozenLake-v1", 2, {"map_name": "none"}),
        ("FrozenLake-v1", 0, {}),
        ("pgts/Ladder-v0", -1, {}),
        ("FrozenLake-v1", 1.5, {}),
        ("pgts/Ladder-v0", True, {}),
    ],
)
def test_an_environment_that_cannot_be_made_is_one_clear_error(name, num_envs, kwargs):
    with pytest.raises(PgtsError, match=rf"{name}|num_envs is {num_envs}"):
        EnvSource.of(name, kwargs=kwargs).make(num_envs)


@pytest.mark.fault("no time limit and no horizon")
def test_a_process_that_never_ends_is_stopped_by_the_guard_of_the_geometric_horizon():
    with pytest.raises(PgtsError, match=r"max_length = 30 .* is gamma 1"):
        experience(ladder(gamma=1.0), uniform_policy(ladder()), GeometricHorizon(max_length=30), episodes=2)
    ending = deep_sea(5, gamma=1.0)
    made = experience(ending, uniform_policy(ending), GeometricHorizon(max_length=5), episodes=2)
    assert made.num_steps == 10


def test_simulated_returns_are_those_computed_by_hand():
    model, policy = TabularModel(chain()), following(torch.ones(3, 1, dtype=torch.float64))
    returns_B, num_steps = simulated_returns(
        model, policy, torch.tensor([0, 1, 2]), FixedHorizon(length=3), generator=stream(0, "test")
    )
    expected_B = torch.tensor([1 + 0.5 * (2 + 0.8 * 3), 2 + 0.8 * (3 + 0.9 * 3), 3 + 0.9 * (3 + 0.9 * 3)])
    torch.testing.assert_close(returns_B, expected_B.double())
    assert num_steps == 9


def test_simulated_episodes_end_with_a_terminal_outcome_and_cost_nothing_after_it():
    mdp = deep_sea(4, gamma=1.0, move_cost=0.0)
    right, state_B = following(always(mdp, 1)), torch.tensor([0, 5, 15])
    for horizon in (FixedHorizon(length=30), GeometricHorizon(max_length=4)):
        kwargs = {"generator": stream(0, "test")}
        returns_B, num_steps = simulated_returns(TabularModel(mdp), right, state_B, horizon, **kwargs)
        assert returns_B.tolist() == [1.0, 1.0, 1.0]
        assert num_steps == 4 + 3 + 1
        returns_B, _ = simulated_returns(
            TabularModel(mdp), right, state_B, horizon, first_action_B=torch.tensor([0, 0, 1]), **kwargs
        )
        assert returns_B.tolist() == [0.0, 0.0, 1.0]
    with pytest.raises(PgtsError, match="max_length = 3"):
        simulated_returns(TabularModel(mdp), right, state_B, GeometricHorizon(max_length=3), **kwargs)
