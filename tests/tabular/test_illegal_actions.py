"""Actions that an MDP allows in some states only, with rewards of -inf in the others: exactly the MDP without them.

Here each of the states forbids one of three actions, so that the MDP without them has two.
"""

import math
from dataclasses import replace

import gymnasium
import pytest
import torch
from gymnasium.wrappers import TimeLimit, TransformReward
from torch import Tensor

from pgts_torch import PGTS
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.bellman import Outcomes
from pgts_torch.envs.tabular import TabularEnv
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.tabular import TabularMDP, exact, random_mdp, stationary
from pgts_torch.tabular.ascent import ascend, mirror_step, projected_step, softmax_step
from pgts_torch.tabular.stationary_sets import enumerate_sets, escape_depth
from tests.support import random_policy, same_values

S = 7
TWO = random_mdp(S, 2, branching=3, seed=4)
FORBIDDEN_S = torch.tensor([2, 0, 1, 1, 2, 0, 0])
LEGAL_SA = torch.arange(3) != FORBIDDEN_S[:, None]
PLACE_SA = (LEGAL_SA.cumsum(-1) - 1).clamp(min=0)
"""Which of the two actions each of the three is; of those that are forbidden it does not matter."""


def three(x_SA: Tensor, other: float) -> Tensor:
    """Rows over the two actions as rows over the three."""
    return torch.where(LEGAL_SA, x_SA.gather(1, PLACE_SA), other)


def masked(mdp: TabularMDP = TWO, *, nonsense: bool = True) -> TabularMDP:
    """The MDP over three actions. Where one is forbidden, what would follow is nonsense."""
    old, rows = mdp.outcomes, torch.arange(S)[:, None]
    prob_SAK, discount_SAK, child_SAK = (
        x[rows, PLACE_SA].clone() for x in (old.prob_NAK, old.discount_NAK, old.child_NAK)
    )
    if nonsense:
        prob_SAK[~LEGAL_SA], discount_SAK[~LEGAL_SA], child_SAK[~LEGAL_SA] = 7.0, 1.0, 0
    outcomes = Outcomes(three(old.reward_NA, -math.inf), prob_SAK, discount_SAK, child_SAK, S)
    return TabularMDP(outcomes, mdp.start_S)


def test_the_exact_solver_finds_the_values_of_the_mdp_without_these_actions():
    mdp, optimum = masked(), exact.optimal(TWO)
    for found in (exact.optimal(mdp), exact.optimal(mdp, tolerance=1e-9)):
        torch.testing.assert_close(found.v_S, optimum.v_S, rtol=0, atol=1e-8)
        torch.testing.assert_close(found.q_SA, three(optimum.q_SA, -math.inf), rtol=0, atol=1e-8)
        assert torch.equal(found.pi_SA, three(optimum.pi_SA, 0.0))
    pi_SA = random_policy(TWO)
    evaluation, expected = exact.evaluate(mdp, three(pi_SA, 0.0)), exact.evaluate(TWO, pi_SA)
    torch.testing.assert_close(evaluation.v_S, expected.v_S)
    torch.testing.assert_close(evaluation.d_S, expected.d_S)
    for depth in range(4):
        look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
        torch.testing.assert_close(look_SA, three(exact.lookahead(TWO, expected.q_SA, depth), -math.inf))


@pytest.mark.parametrize("gamma_is_1", [False, True])
def test_what_follows_an_action_that_is_not_allowed_does_not_matter(gamma_is_1):
    mdp = TWO
    if gamma_is_1:  # every step may end the episode
        discount_SAK = torch.where(TWO.outcomes.child_NAK == 0, 0.0, 1.0).double()
        mdp = replace(TWO, outcomes=replace(TWO.outcomes, discount_NAK=discount_SAK))
        assert exact.ends(mdp.outcomes).any()
    found = [exact.optimal(masked(mdp, nonsense=nonsense)) for nonsense in (False, True)]
    assert same_values(vars(found[0]), vars(found[1]))


def test_gaps_bounds_and_certificates_are_over_the_actions_that_are_allowed():
    mdp, pi_SA = masked(), random_policy(TWO)
    pi3_SA = three(pi_SA, 0.0)
    for depth in range(3):
        torch.testing.assert_close(stationary.gap(mdp, pi3_SA, depth), stationary.gap(TWO, pi_SA, depth))
        for bound in (stationary.closed_form_bound, stationary.reachable_bound):
            assert bound(mdp, depth) == pytest.approx(bound(TWO, depth))
        for of_policy in (stationary.worst_case_bound, stationary.certificate):
            assert of_policy(mdp, pi3_SA, depth) == pytest.approx(of_policy(TWO, pi_SA, depth))
    assert torch.equal(stationary.worst_policy(mdp), three(stationary.worst_policy(TWO), 0.0))
    assert escape_depth(mdp, stationary.worst_policy(mdp)) == escape_depth(TWO, stationary.worst_policy(TWO))
    assert stationary.lowest_value(mdp.outcomes) == stationary.lowest_value(TWO.outcomes)
    with pytest.raises(PgtsError, match="action 2 is not allowed in state 0; policies are enumerated"):
        enumerate_sets(mdp)


@pytest.mark.parametrize("step", [projected_step, mirror_step, softmax_step])
@pytest.mark.parametrize("step_size", [0.0, 0.3])
def test_algorithm_1_takes_the_same_steps(step, step_size):
    options = {"depth": 2, "step_size": step_size, "iterations": 6, "step": step}
    pi_SA = random_policy(TWO)
    found, expected = ascend(masked(), three(pi_SA, 0.0), **options), ascend(TWO, pi_SA, **options)
    torch.testing.assert_close(found.J_K, expected.J_K)
    torch.testing.assert_close(found.pi_SA, three(expected.pi_SA, 0.0))


def test_a_policy_that_takes_such_an_action_and_a_state_without_another_are_errors():
    with pytest.raises(PgtsError, match=r"pi_SA\[0, 2\] is 0.333.*; action 2 is not allowed in state 0"):
        exact.evaluate(masked(), torch.full((S, 3), 1 / 3, dtype=torch.float64))
    outcomes = masked().outcomes
    for wrong, message in (
        (-math.inf, r"R_SA\[3\] is .* one action of each state"),
        (math.nan, r"R_SA\[3, 0\] is nan"),
    ):
        reward_SA = outcomes.reward_NA.clone()
        reward_SA[3] = wrong
        with pytest.raises(PgtsError, match=message):
            TabularMDP(replace(outcomes, reward_NA=reward_SA), TWO.start_S)


def test_an_npz_file_and_arrays_keep_what_is_allowed(tmp_path):
    mdp = masked()
    mdp.save_npz(tmp_path / "mdp.npz")
    loaded = TabularMDP.load_npz(tmp_path / "mdp.npz")
    assert same_values(vars(exact.optimal(loaded)), vars(exact.optimal(mdp)))


def as_lists(mdp: TabularMDP) -> dict[int, dict[int, list[tuple[float, int, float, bool]]]]:
    """Its table P, without the actions that are not allowed."""
    out, rows = mdp.outcomes, {}
    for s in range(mdp.num_states):
        rows[s] = {
            a: [
                (p, child, float(out.reward_NA[s, a]), False)
                for p, child in zip(out.prob_NAK[s, a].tolist(), out.child_NAK[s, a].tolist(), strict=True)
            ]
            for a in range(mdp.num_actions)
            if out.reward_NA[s, a] > -math.inf
        }
    return rows


def test_lists_of_transitions_may_lack_actions():
    mdp, gamma = masked(), float(TWO.outcomes.discount_NAK.max())
    found = TabularMDP.from_transitions(as_lists(mdp), gamma, start=TWO.start_S.numpy())
    assert torch.equal(found.outcomes.legal_NA, LEGAL_SA)
    torch.testing.assert_close(exact.optimal(found).q_SA, exact.optimal(mdp).q_SA)
    with pytest.raises(PgtsError, match=r"P\[1\] has 1 actions; P\[0\] has 2"):
        TabularMDP.from_transitions([[[(1.0, 0, 0.0, False)]] * 2, [[(1.0, 0, 0.0, False)]]], 0.9)


class Listed(gymnasium.Env):
    """Publishes the table; an action that is not in it is an error."""

    observation_space, action_space = gymnasium.spaces.Discrete(S), gymnasium.spaces.Discrete(3)

    def __init__(self):
        self.P, self.initial_state_distrib = as_lists(masked()), TWO.start_S.numpy()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = int(self.np_random.choice(S, p=self.initial_state_distrib))
        return self.s, {}

    def step(self, action):
        p, child, reward, _ = zip(*self.P[self.s][int(action)], strict=True)
        self.s = int(self.np_random.choice(child, p=p))
        return self.s, reward[0], False, False, {}


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: TransformReward(env, lambda reward: 2 * reward)])
def test_an_environment_whose_table_lacks_actions_is_trained_in_without_them(wrap):
    model = PGTS(lambda: wrap(TimeLimit(Listed(), 9)), depth=2, num_envs=2, horizon={"type": "fixed", "length": 9})
    model.learn(60)
    evaluate(model, episodes=2, deterministic=False)
    assert isinstance(model.world.model, TabularModel)
    assert (model.policy_table()[~LEGAL_SA] == 0).all()


# Training in it


def test_our_environments_say_what_is_allowed_and_raise_where_it_is_not():
    env, envs = TabularEnv(masked()), TabularVectorEnv(masked(), 3)
    state, info = env.reset(seed=0)
    assert info["action_mask"].tolist() == LEGAL_SA[state].int().tolist()
    with pytest.raises(PgtsError, match=rf"action {FORBIDDEN_S[state]} is not allowed in state {state}"):
        env.step(int(FORBIDDEN_S[state]))
    state_B, info = envs.reset(seed=0)
    assert info["action_mask"].tolist() == LEGAL_SA[state_B].int().tolist()
    with pytest.raises(PgtsError, match="is not allowed in state"):
        envs.step(FORBIDDEN_S.numpy()[state_B])
    assert "action_mask" not in TabularEnv(TWO).reset(seed=0)[1]
    drawn = TabularEnv(masked(), render_mode="ansi")
    drawn.reset(seed=0)
    assert "[" in drawn.render()


@pytest.mark.parametrize(
    ("critic", "search"),
    [
        ("exact", "m = 0"),
        ({"type": "tabular", "target": "q"}, "m = 0"),
        ({"type": "tabular", "target": "q"}, "mcts"),
        ({"type": "tabular"}, "expectimax"),
        ("rollout", "mcts"),
    ],
)
@pytest.mark.parametrize("policy", ["softmax", "simplex"])
def test_tables_never_take_an_action_that_is_not_allowed(policy, critic, search, tmp_path):
    kind = {"m = 0": {"depth": 0}, "expectimax": {"depth": 3}, "mcts": {"depth": 2, "search": "mcts"}}[search]
    options = {"policy": policy, "critic": critic, "horizon": {"type": "fixed", "length": 8}, "num_envs": 4, **kind}

    def make():
        return TabularEnv(masked())

    for update in [None, *({"softmax": ["softmax", "mirror"], "simplex": ["mirror"]}[policy])]:
        model = PGTS(make, **options, update=update)
        model.iterate()
        model.save(tmp_path / "model.pt")
        loaded = PGTS.load(tmp_path / "model.pt", env=make)
        model.iterate()
        loaded.iterate()
        assert same_values(model.state_dict(), loaded.state_dict())
        probs_SA = model.policy_table()
        assert (probs_SA[~LEGAL_SA] == 0).all()
        assert (probs_SA != three(torch.full((S, 2), 0.5, dtype=torch.float64), 0.0)).any()
        if search == "m = 0" and critic == "exact":
            evaluate(model, episodes=2, deterministic=False)
        assert LEGAL_SA[torch.arange(S), torch.as_tensor(model.predict(torch.arange(S).numpy()))].all()
        vector = PGTS(TabularVectorEnv(masked(), 4, autoreset_mode="Disabled"), **(options | {"num_envs": None}))
        vector.iterate()


def test_a_training_reaches_the_optimum_of_the_actions_that_are_allowed():
    model = PGTS(lambda: TabularEnv(masked()), critic="exact", depth=4, update={"type": "mirror", "step_size": 5.0})
    model.learn(20_000)
    J = exact.evaluate(model.mdp, model.policy_table()).J
    assert exact.optimal(TWO).J - J < 0.01 * abs(exact.optimal(TWO).J)
    assert model.mdp.num_actions == 3


def test_a_network_does_not_see_what_a_table_allows_and_is_refused():
    with pytest.raises(PgtsError, match="NetworkPolicy does not see: take the policy softmax or simplex"):
        PGTS(lambda: TabularEnv(masked()), policy="mlp")
