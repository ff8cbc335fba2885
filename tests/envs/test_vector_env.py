"""Many environments of one MDP are as many single ones; and the three autoreset modes."""

import gymnasium
import numpy as np
import pytest
import scipy.stats
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from pgts_torch.envs import TabularEnv, TabularVectorEnv
from pgts_torch.errors import PgtsError
from pgts_torch.tabular import deep_sea, grid, ladder, random_mdp

MODES = list(AutoresetMode)


def make_both(id, mode, **kwargs):
    """The fast form, and Gymnasium's own loop over single environments."""
    fast = gymnasium.make_vec(id, num_envs=4, autoreset_mode=mode, **kwargs)
    slow = gymnasium.make_vec(
        id, num_envs=4, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **kwargs
    )
    return fast, slow


def assert_same_step(fast_step, slow_step):
    for fast, slow in zip(fast_step[:4], slow_step[:4], strict=True):
        assert fast.dtype == slow.dtype
        np.testing.assert_array_equal(fast, slow)
    fast, slow = fast_step[4], slow_step[4]
    assert ("final_obs" in fast) == ("final_obs" in slow)
    if "final_obs" in slow:
        for key in ("final_obs", "_final_obs", "_final_info"):
            np.testing.assert_array_equal(fast[key], slow[key])
            assert fast[key].dtype == slow[key].dtype
        for key in ("discount", "_discount"):
            np.testing.assert_array_equal(fast["final_info"][key], slow["final_info"][key])
    told = slow.get("_discount", np.zeros(4, dtype=bool))
    np.testing.assert_array_equal(fast["discount"][told], slow.get("discount", np.zeros(4))[told])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("id", "kwargs"),
    [
        ("pgts/Ladder-v0", {"max_episode_steps": 7}),
        ("pgts/Tightrope-v0", {"max_episode_steps": 4}),
        ("pgts/DeepSea-v0", {"n": 4}),
        ("pgts/DeepSea-v0", {"n": 4, "max_episode_steps": 4}),  # terminated and truncated in one step
        ("pgts/DeepSea-v0", {"n": 4, "max_episode_steps": 3}),
    ],
)
def test_deterministic_environments_equal_gymnasiums_loop_over_single_ones_step_by_step(id, kwargs, mode):
    fast, slow = make_both(id, mode, **kwargs)
    assert fast.observation_space == slow.observation_space
    assert fast.action_space == slow.action_space
    assert fast.metadata["autoreset_mode"] == slow.metadata["autoreset_mode"] == mode
    np.testing.assert_array_equal(fast.reset(seed=0)[0], slow.reset(seed=0)[0])
    random = np.random.default_rng(0)
    ends = 0
    for step in range(60):
        action = random.integers(2, size=4)
        fast_step, slow_step = fast.step(action), slow.step(action)
        assert_same_step(fast_step, slow_step)
        over = fast_step[2] | fast_step[3]
        ends += over.sum()
        if step == 1:  # from here on the environments end at different times
            over = over | np.array([True, False, True, False])
        if over.any() and (mode == AutoresetMode.DISABLED or step == 1):
            np.testing.assert_array_equal(*(envs.reset(options={"reset_mask": over})[0] for envs in (fast, slow)))
    assert ends >= 4 * 60 // (kwargs.get("max_episode_steps", 5) + 2)


@pytest.mark.parametrize("mdp", [random_mdp(start=None), grid(slip=0.5, start=None), deep_sea(stochastic=True)])
def test_a_vector_of_one_is_the_single_environment_bit_by_bit_under_random_dynamics(mdp):
    single, vector = TabularEnv(mdp), TabularVectorEnv(mdp, 1, autoreset_mode=AutoresetMode.SAME_STEP)
    assert single.reset(seed=5)[0] == vector.reset(seed=5)[0][0]
    for action in np.random.default_rng(0).integers(mdp.num_actions, size=200):
        state, reward, terminated, _, info = single.step(action)
        if terminated:
            state = single.reset()[0]
        states, rewards, ends, _, infos = vector.step([action])
        assert (state, reward, terminated) == (states[0], rewards[0], ends[0])
        assert info["discount"] == infos["discount"][0]


def p_value_of_states(env_mdp, true_mdp, steps=4, num_envs=20_000):
    """Pearson's test of the states after some steps of a fixed random policy, against mu (P^pi)^t."""
    A, S = true_mdp.num_actions, true_mdp.num_states
    pi_A = 8.0 ** np.arange(A) / (8.0 ** np.arange(A)).sum()  # far from uniform, which would hide how a grid slips
    envs = TabularVectorEnv(env_mdp, num_envs)
    state, _ = envs.reset(seed=1)
    actions = np.random.default_rng(2)
    for _ in range(steps):
        state = envs.step(actions.choice(A, size=num_envs, p=pi_A))[0]
    P_SS, outcomes = np.zeros((S, S)), true_mdp.outcomes
    source_SAK = np.broadcast_to(np.arange(S)[:, None, None], outcomes.child_NAK.shape)
    np.add.at(P_SS, (source_SAK, outcomes.child_NAK.numpy()), pi_A[:, None] * outcomes.prob_NAK.numpy())
    expected_S = num_envs * true_mdp.start_S.numpy() @ np.linalg.matrix_power(P_SS, steps)
    observed_S = np.bincount(state, minlength=S)
    if observed_S[expected_S == 0].any():
        return 0.0
    often = expected_S >= 5  # the approximation by chi-square wants at least five in each cell
    rest = [(~often & (expected_S > 0)).any()]
    expected = np.append(expected_S[often], expected_S[~often].sum()[None][rest])
    observed = np.append(observed_S[often], observed_S[~often].sum()[None][rest])
    return scipy.stats.chisquare(observed, expected).pvalue


@pytest.mark.parametrize(
    ("mdp", "wrong"),
    [
        (random_mdp(seed=0), random_mdp(seed=1)),
        (random_mdp(20, 3, branching=3, seed=2), random_mdp(20, 3, branching=3, seed=3)),
        (grid(size=5, traps=(12,)), grid(size=5, traps=(12,), slip=0.1)),
        (grid(size=5, slip=0.3, traps=(12,), start=None), grid(size=5, slip=0.5, traps=(12,), start=None)),
        (grid(size=5, slip=0.3, traps=(12,), start=None), grid(size=5, slip=0.3, traps=(12,), start=12)),
    ],
)
def test_states_are_distributed_as_in_the_exact_chain_and_a_wrong_chain_is_noticed(mdp, wrong):
    # A right sampler fails by chance with probability 1e-4 in each case, over the choice of the seed; it is fixed.
    assert p_value_of_states(mdp, mdp) > 1e-4
    assert p_value_of_states(wrong, mdp) < 1e-12


def two_environments(mode, **kwargs):
    """DeepSea-2 (states 0 1 / 2 3): environment 0 starts at the top left, 1 a step before its end."""
    envs = TabularVectorEnv(deep_sea(n=2, gamma=0.9, move_cost=0.0), 2, autoreset_mode=mode, **kwargs)
    states, info = envs.reset(seed=0, options={"state": [0, 2]})
    assert states.tolist() == [0, 2]
    assert info == {}
    return envs


def plain(value):
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    return value.tolist()


def test_same_step_by_hand():
    envs = two_environments(AutoresetMode.SAME_STEP)
    state, reward, terminated, truncated, info = envs.step([1, 0])
    assert (plain(state), plain(reward)) == ([3, 0], [0.0, 0.0])
    assert (plain(terminated), plain(truncated)) == ([False, True], [False, False])
    assert plain(info) == {
        "discount": [0.9, 0.0],
        "_discount": [True, True],
        "final_obs": [None, 2],
        "_final_obs": [False, True],
        "final_info": {"discount": [0.0, 0.0], "_discount": [False, True]},
        "_final_info": [False, True],
    }
    state, reward, terminated, _, info = envs.step([1, 1])
    assert (plain(state), plain(reward), plain(terminated)) == ([0, 3], [1.0, 0.0], [True, False])
    assert info["final_obs"].tolist() == [3, None]


def test_next_step_by_hand():
    envs = two_environments(AutoresetMode.NEXT_STEP)
    state, _, terminated, _, info = envs.step([1, 0])
    assert (plain(state), plain(terminated)) == ([3, 2], [False, True])
    assert plain(info) == {"discount": [0.9, 0.0], "_discount": [True, True]}
    state, reward, terminated, truncated, info = envs.step([1, 1])
    assert (plain(state), plain(reward)) == ([3, 0], [1.0, 0.0])
    assert (plain(terminated), plain(truncated)) == ([True, False], [False, False])
    assert plain(info) == {"discount": [0.0, 0.0], "_discount": [True, False]}
    state, _, terminated, _, info = envs.step([1, 1])
    assert (plain(state), plain(terminated), plain(info["_discount"])) == ([0, 3], [False, False], [False, True])


def test_disabled_by_hand():
    envs = two_environments(AutoresetMode.DISABLED)
    state, _, terminated, _, info = envs.step([1, 0])
    assert (plain(state), plain(terminated)) == ([3, 2], [False, True])
    assert plain(info) == {"discount": [0.9, 0.0], "_discount": [True, True]}
    with pytest.raises(ResetNeeded, match=r"the episode of environment 1 is over; reset it with env\.reset"):
        envs.step([1, 1])
    state, _ = envs.reset(options={"reset_mask": terminated})
    assert plain(state) == [3, 0]
    state, reward, terminated, _, _ = envs.step([1, 1])
    assert (plain(state), plain(reward), plain(terminated)) == ([3, 3], [1.0, 0.0], [True, False])


def test_a_truncated_environment_keeps_its_discount_and_starts_a_fresh_clock():
    envs = TabularVectorEnv(ladder(n=3), 2, max_episode_steps=2, autoreset_mode="SameStep")
    envs.reset()
    envs.step([1, 1])
    envs.reset(options={"reset_mask": np.array([False, True]), "state": 2})
    state, reward, terminated, truncated, info = envs.step([1, 1])
    assert (plain(state), plain(reward)) == ([0, 2], [0.0, 1.0])
    assert (plain(terminated), plain(truncated)) == ([False, False], [True, False])
    assert (plain(info["discount"]), plain(info["final_obs"])) == ([0.9, 0.9], [2, None])
    assert plain(envs.step([1, 1])[3]) == [False, True]


def test_disabled_with_prompt_resets_is_same_step():
    mdp = random_mdp(6, start=None)
    same, disabled = (
        TabularVectorEnv(mdp, 50, max_episode_steps=5, autoreset_mode=mode)
        for mode in (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
    )
    np.testing.assert_array_equal(same.reset(seed=3)[0], disabled.reset(seed=3)[0])
    for action in np.random.default_rng(0).integers(2, size=(20, 50)):
        expected = same.step(action)[0]
        state, _, terminated, truncated, _ = disabled.step(action)
        if (terminated | truncated).any():
            state, _ = disabled.reset(options={"reset_mask": terminated | truncated})
        np.testing.assert_array_equal(state, expected)


def states_seen(envs, seed):
    rows = [envs.reset(seed=seed)[0]]
    rows += [envs.step(np.zeros(envs.num_envs, dtype=int))[0] for _ in range(5)]
    return np.stack(rows).tolist()


def test_the_same_seed_gives_the_same_bits_and_other_seeds_others():
    mdp = random_mdp(50, start=None)
    envs, again = TabularVectorEnv(mdp, 8), TabularVectorEnv(mdp, 8)
    assert states_seen(envs, 0) == states_seen(envs, 0) == states_seen(again, 0)
    words = list(range(8))
    assert states_seen(envs, words) == states_seen(again, words)
    different = [states_seen(envs, seed) for seed in (0, 1, words, [*words[:-1], 8])]
    assert all(a != b for i, a in enumerate(different) for b in different[:i])


def test_environments_of_one_seed_differ_from_each_other():
    columns = np.array(states_seen(TabularVectorEnv(random_mdp(50, start=None), 8), 0)).T.tolist()
    assert len({tuple(column) for column in columns}) == 8


def test_what_a_step_returns_is_not_changed_by_later_steps():
    envs = TabularVectorEnv(deep_sea(n=3), 4, max_episode_steps=2, autoreset_mode="SameStep")
    kept = [envs.reset(seed=0)[0]]
    for _ in range(4):
        *arrays, info = envs.step([1, 1, 0, 0])
        kept += [*arrays, info["discount"], info["_discount"]]
    before = [array.copy() for array in kept]
    envs.step([0, 1, 0, 1])
    for array, expected in zip(kept, before, strict=True):
        np.testing.assert_array_equal(array, expected)


def test_writing_into_what_was_returned_changes_no_episode():
    envs = TabularVectorEnv(ladder(n=5), 2)
    envs.reset()[0][:] = 4
    for expected in (1, 2):
        arrays = envs.step([1, 1])
        assert arrays[0].tolist() == [expected] * 2
        for array in (*arrays[:4], *arrays[4].values()):
            array[:] = 0


def test_resetting_one_finished_environment_leaves_the_other_finished():
    envs = TabularVectorEnv(ladder(), 2, max_episode_steps=1, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset()
    envs.step([1, 1])
    envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ResetNeeded, match="the episode of environment 1 is over"):
        envs.step([1, 1])


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_gymnasiums_episode_statistics_count_whole_episodes(mode):
    envs = RecordEpisodeStatistics(gymnasium.make_vec("pgts/Ladder-v0", num_envs=3, n=3, autoreset_mode=mode))
    envs.reset(seed=0)
    for _ in range(210):
        envs.step(np.ones(3, dtype=int))
    assert list(envs.return_queue) == [98.0] * 6  # rewarded from the third of 100 steps on
    assert list(envs.length_queue) == [100] * 6


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_envs": 0}, "num_envs is 0"),
        ({"max_episode_steps": 0}, "max_episode_steps is 0"),
        ({"autoreset_mode": "sometimes"}, "autoreset_mode is 'sometimes'; it must be an AutoresetMode or one of"),
    ],
)
def test_a_wrong_argument_is_named(kwargs, message):
    with pytest.raises(PgtsError, match=message):
        TabularVectorEnv(ladder(), **kwargs)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ([0, 2, 0], "action 2 of environment 1 does not exist; actions are 0 to 1"),
        ([0, 1, -1], "action -1 of environment 2 does not exist; actions are 0 to 1"),
        ([0, 1], r"actions have shape \(2,\) and dtype int64; they must be 3 integers"),
        ([0.0, 1.0, 1.0], r"actions have shape \(3,\) and dtype float64; they must be 3 integers"),
    ],
)
def test_wrong_actions_are_named_and_move_nothing(actions, message):
    envs = TabularVectorEnv(ladder(), 3)
    envs.reset()
    with pytest.raises(PgtsError, match=message):
        envs.step(actions)
    assert envs.step([1, 1, 1])[0].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"low": 1}, "reset has no option 'low'; it has reset_mask, state"),
        ({"state": 5}, "state 5 of environment 0 does not exist; states are 0 to 4"),
        ({"state": [0, 1, -1]}, "state -1 of environment 2 does not exist"),
        ({"state": [0, 1]}, r"states have shape \(2,\) and dtype int64; they must be 3 integers"),
        ({"state": 1.0}, r"states have shape \(3,\) and dtype float64; they must be 3 integers"),
        ({"reset_mask": [True, False]}, r"reset_mask has shape \(2,\) and dtype bool and names 1 environments"),
        ({"reset_mask": [1, 0, 0]}, r"reset_mask has shape \(3,\) and dtype int64 and names 1 environments"),
        ({"reset_mask": [False] * 3}, "names 0 environments; it must be 3 booleans that name at least one"),
    ],
)
def test_wrong_reset_options_are_named(options, message):
    envs = TabularVectorEnv(ladder(n=5), 3)
    envs.reset(seed=0)
    with pytest.raises(PgtsError, match=message):
        envs.reset(options=options)


@pytest.mark.parametrize("seed", [[1, 2], [1, 2, -3], [1, 2, None]])
def test_a_wrong_list_of_seeds_is_named(seed):
    with pytest.raises(PgtsError, match="it must be an integer or 3 integers of at least 0"):
        TabularVectorEnv(ladder(), 3).reset(seed=seed)


def test_some_environments_cannot_be_reset_before_all_were():
    with pytest.raises(
        ResetNeeded, match=r"Cannot reset some environments before env.reset\(\) has started all of them"
    ):
        TabularVectorEnv(ladder(), 2).reset(options={"reset_mask": np.array([True, False])})
