"""Models of the caller's own that forbid actions by rewards of -inf, with and without action masks beside them."""

from dataclasses import replace

import pytest
import torch
from gymnasium.wrappers import TimeLimit

from pgts_torch import PGTS
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.errors import ModelMismatch, PgtsError
from pgts_torch.models import TabularModel, TensorModel
from pgts_torch.tabular import TabularMDP, exact
from tests.agent.masked import GAMMA, LEGAL_SA, NEXT_SA, REWARD_SA, ByMethod, Strict, legal_mdp

SHORT = {"num_envs": 2, "horizon": {"type": "fixed", "length": 6}, "gamma": GAMMA, "policy": {"type": "mlp"}}
LEGAL = torch.from_numpy(LEGAL_SA == 1)
ALLOWED_SA = torch.cat([LEGAL, torch.ones(1, 3, dtype=torch.bool)])


def forbidding_table() -> TabularMDP:
    """The table of `Strict`, with rewards of -inf."""
    mdp = legal_mdp()
    reward_SA = torch.where(ALLOWED_SA, mdp.outcomes.reward_NA, -torch.inf)
    return TabularMDP(replace(mdp.outcomes, reward_NA=reward_SA), mdp.start_S)


class Known(TensorModel):
    """The dynamics of `Strict`, whose states are one-hot vectors."""

    def __init__(self) -> None:
        super().__init__(6, 3)

    def step(self, state_ND, action_N):
        at_N = state_ND.argmax(-1)
        ends_N, s_N = at_N == 5, at_N.clamp(max=4)
        next_N = torch.from_numpy(NEXT_SA)[s_N, action_N]
        reward_N = torch.where(
            self.allows(s_N, action_N) & ~ends_N, torch.from_numpy(REWARD_SA)[s_N, action_N], -torch.inf
        )
        return reward_N.float(), GAMMA * (next_N != 5).float(), torch.nn.functional.one_hot(next_N, 6).float()

    def allows(self, s_N, action_N):
        return LEGAL[s_N, action_N]


class Forbidding(Known):
    forbids = True


def silent():
    return TimeLimit(Strict("nothing", vector=True), 20)


SEARCHES = [
    {"depth": 0},
    {"depth": 2, "search": "expectimax"},
    {"depth": 2, "search": {"type": "mcts", "simulations": 8}},
    {"depth": 1, "critic": {"type": "network", "target": "q", "target_period": 2}},
    {"depth": 1, "replay": {"type": "uniform", "starts": 4, "length": 4}, "horizon": {"type": "steps", "length": 20}},
]


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize(
    ("env", "model"), [(silent, Forbidding), (lambda: TimeLimit(ByMethod(vector=True), 20), Known)]
)
def test_no_action_is_taken_that_such_a_model_forbids(env, model, search):
    training, before = PGTS(env, **(SHORT | search), model=model()), Strict.taken + ByMethod.taken
    training.iterate()
    training.iterate()
    evaluate(training, episodes=1, deterministic=False)
    assert Strict.taken + ByMethod.taken > before


def test_its_lookahead_has_the_values_of_the_mdp_without_these_actions_and_predict_knows_them():
    training = PGTS(silent, **SHORT, model=Forbidding(), depth=40, search="expectimax")
    state_N = training.iterate().state_N
    states = training.world.observe(state_N)[:, :6].argmax(-1)
    expected_NA = torch.where(LEGAL[states], exact.optimal(legal_mdp()).q_SA[states], -torch.inf)
    torch.testing.assert_close(training.lookahead(state_N).q_BA.double(), expected_NA, rtol=1e-5, atol=20 * GAMMA**40)
    one_hot = torch.eye(6)[:5].numpy()
    assert LEGAL[range(5), training.predict(one_hot)].all()
    assert LEGAL[range(5), training.predict(one_hot, deterministic=False)].all()
    assert [int(training.predict(one)) for one in one_hot] == training.predict(one_hot).tolist()
    assert training.predict(one_hot[None]).tolist() == [training.predict(one_hot).tolist()]
    with pytest.raises(PgtsError, match="without action masks"):
        training.predict(one_hot[0], action_mask=[1, 1, 1])


def test_a_model_that_allows_something_else_than_the_masks_contradicts_them():
    class Other(Known):
        def allows(self, s_N, action_N):
            return torch.ones_like(LEGAL[s_N, action_N])

    with pytest.raises(ModelMismatch, match=r"Other allows action \d in state \d+, and .* it is not legal"):
        PGTS(lambda: ByMethod(vector=True), **SHORT, model=Other(), depth=1).iterate()
    with pytest.raises(PgtsError, match=r"is not legal in state|Known does not allow action \d in state"):
        PGTS(silent, **SHORT, model=Known(), depth=1).iterate()


@pytest.mark.parametrize("env", [lambda: Strict("nothing"), ByMethod])
def test_a_table_of_the_callers_own_says_what_is_allowed(env):
    table, legal_SA = forbidding_table(), ALLOWED_SA
    options = SHORT | {"policy": "softmax", "gamma": None}
    for critic in ("exact", "tabular"):
        training = PGTS(env, **options, model=TabularModel(table), critic=critic, depth=2)
        training.learn(100)
        evaluate(training, episodes=1, deterministic=False)
        assert (training.policy_table()[~legal_SA] == 0).all()
        assert legal_SA[range(6), training.predict(range(6))].all()


def test_predict_takes_no_action_that_a_mask_forbids_beside_a_table():
    table, pi_SA = forbidding_table(), torch.tensor([[0.5, 0.3, 0.2], [0.0, 0.6, 0.4]])
    training = PGTS(ByMethod, **(SHORT | {"policy": "softmax", "gamma": None}), model=TabularModel(table), depth=2)
    logits_SA = training.policy.state_dict()["logits_SA"]
    logits_SA[[3, 1]] = pi_SA.double().log().where(pi_SA > 0, 0.0)
    training.policy.load_state_dict({"logits_SA": logits_SA})
    assert training.predict([3, 1]).tolist() == [0, 1]
    assert training.predict([3, 1], action_mask=[[0, 1, 1], [1, 0, 1]]).tolist() == [1, 2]
    assert int(training.predict(3, action_mask=[0, 0, 1])) == 2
    generator = torch.Generator().manual_seed(0)
    many = training.predict([3] * 4000, action_mask=[[1, 0, 1]] * 4000, deterministic=False, generator=generator)
    # P(|mean of 4,000 draws - 2/7| > 0.036) < 1e-6 by the normal law with a standard error of 0.0071
    assert set(many.tolist()) == {0, 2}
    assert (many == 2).mean() == pytest.approx(2 / 7, abs=0.036)
    with pytest.raises(
        PgtsError, match=r"allows the actions \[0\] in state 1 of ByMethod, of which the policy takes none"
    ):
        training.predict([0, 1], action_mask=[[1, 1, 1], [1, 0, 0]])
    with pytest.raises(PgtsError, match=r"action masks have the shape \(2, 3\); there are 3 observations"):
        training.predict([0, 1, 2], action_mask=[[1, 1, 1]] * 2)
