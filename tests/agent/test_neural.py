"""Policies and critics of networks: what they answer, what they learn, and that they can be taken up again."""

import copy
import dataclasses
import math

import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from pgts_torch.agent import saving
from pgts_torch.agent.advantages import gae, score_function
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.agent.neural_updates import GradientUpdate
from pgts_torch.agent.policies import SimplexPolicy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.errors import PgtsError
from pgts_torch.options import CNN, MLP, FixedHorizon, NetworkValues, OwnModule, TDLambda
from pgts_torch.seeding import stream
from pgts_torch.tabular import exact, random_mdp
from tests.agent.helpers import by_hand, experience, following
from tests.agent.modules import Plain, deep, linear
from tests.support import random_policy

VECTORS = spaces.Box(-math.inf, math.inf, (3,))
STATES = spaces.Discrete(6)
MDP = random_mdp(6, 2, gamma=0.5, start=None)
POINTS_SD = torch.randn(7, 3, generator=stream(0, "points"))


def tabular_critic(value_S: list[float] | Tensor, **options) -> NetworkCritic:
    """A critic whose v or Q is a table, with these entries."""
    value_SD = torch.as_tensor(value_S, dtype=torch.float32)
    critic = NetworkCritic(spaces.Discrete(len(value_SD)), 2, NetworkValues(network=MLP(hidden=()), **options))
    weight_DS = value_SD.reshape(len(value_SD), -1).T
    critic.network.load_plain_state({"head.weight": weight_DS, "head.bias": torch.zeros(len(weight_DS))})
    return critic


def fitted(critic: NetworkCritic) -> NetworkCritic:
    """The critic as one that has been fitted before: its values count."""
    critic.load_state_dict(critic.state_dict() | {"num_fits": 1, "scale": 1.0})
    return critic


def lagging(critic: NetworkCritic) -> NetworkCritic:
    """A critic whose network is the target network of another one."""
    other, state = copy.deepcopy(critic), critic.state_dict()
    other.load_state_dict(state | {"network": state["target_network"]})
    return other


@pytest.mark.parametrize("target", ["v", "q"])
def test_before_the_first_fit_all_values_are_0_and_then_those_that_were_fitted(target):
    critic = NetworkCritic(VECTORS, 2, NetworkValues(target=target))
    made, policy = by_hand(shows=POINTS_SD), NetworkPolicy(VECTORS, 2)
    ask = critic.v if target == "v" else critic.q
    assert not ask(POINTS_SD).any()
    assert critic.network.outputs(POINTS_SD).all()
    if target == "v":
        assert not any(value_TB.any() for value_TB in critic.values(made))
    critic.fit(policy, made, generator=stream(0, "critic"))
    assert ask(POINTS_SD).all()


def test_a_policy_is_the_softmax_of_its_network_and_nearly_uniform_at_first():
    policy = NetworkPolicy(VECTORS, 5, seed=1)
    probs_NA = policy.probs(POINTS_SD)
    assert probs_NA.dtype == torch.float32
    assert not probs_NA.requires_grad
    torch.testing.assert_close(probs_NA, policy.network(POINTS_SD).softmax(-1).detach())
    torch.testing.assert_close(probs_NA, torch.full((7, 5), 0.2), atol=0.02, rtol=0)
    assert (probs_NA != 0.2).any()


def test_a_policy_starts_from_its_seed_and_torchs_own_generator_is_not_used():
    before = torch.get_rng_state()
    first, same, other = (NetworkPolicy(VECTORS, 5, seed=seed) for seed in (1, 1, 2))
    critic = NetworkCritic(VECTORS, 5, seed=1)
    critic.fit(first, by_hand(shows=POINTS_SD), generator=stream(0, "critic"))
    first.sample(POINTS_SD, generator=stream(0, "sample"))
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(first.probs(POINTS_SD), same.probs(POINTS_SD))
    assert not torch.equal(first.probs(POINTS_SD), other.probs(POINTS_SD))


def test_a_policy_survives_the_round_trip_through_a_file(tmp_path):
    policy, other = (NetworkPolicy(VECTORS, 5, MLP(hidden=(8,), normalize=True), seed=seed) for seed in (1, 2))
    policy.network.trunk.encoder.absorb(100 * POINTS_SD)
    saving.write(tmp_path / "policy", policy.state_dict())
    other.load_state_dict(saving.read(tmp_path / "policy"))
    assert torch.equal(policy.probs(POINTS_SD), other.probs(POINTS_SD))
    with pytest.raises(PgtsError, match=r"head.weight is torch.float32 of shape \(5, 8\); .* \(4, 8\)"):
        NetworkPolicy(VECTORS, 4, MLP(hidden=(8,), normalize=True)).load_state_dict(policy.state_dict())


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("target", "network"), [("v", MLP(hidden=())), ("q", MLP(hidden=())), ("v", OwnModule(make=linear))]
)
def test_fresh_targets_bring_the_values_of_a_policy_in_two_fits_and_stale_ones_do_not(target, network):
    # Of what is missing each stale fit leaves gamma (1 - lambda) / (1 - gamma lambda) = 0.905: 0.82 after two.
    mdp = random_mdp(6, 2, gamma=0.95, start=None)
    pi_SA = random_policy(mdp, seed=1)
    made = [experience(mdp, pi_SA, FixedHorizon(length=20), episodes=500, seed=seed) for seed in range(2)]
    missing = {}
    for fresh in (False, True):
        options = {"target": target, "method": TDLambda(lambda_=0.5), "learning_rate": 0.03, "fresh_targets": fresh}
        critic = NetworkCritic(STATES, 2, NetworkValues(network=network, num_epochs=40, minibatch_size=1000, **options))
        for each in made:
            critic.fit(following(pi_SA), each, generator=stream(0, "critic"))
        v_S = exact.evaluate(mdp, pi_SA).v_S
        missing[fresh] = float(((v_S - critic.v(torch.arange(6))) / v_S).mean())
    assert 0.8 < missing[False] < 0.84
    assert abs(missing[True]) < 0.05


@pytest.mark.parametrize("lambda_", [0.0, 0.7, 1.0])
def test_generalised_advantages_follow_their_own_recursion(lambda_):
    made = by_hand()
    v_S = torch.tensor([3.0, -1.0, 5.0, 10.0], dtype=torch.float64)
    v_TB, next_v_TB = v_S[made.observation_UB[:-1]], v_S[made.observation_UB[1:]]
    advantage_TB = gae(made, v_TB, next_v_TB, lambda_)
    for b, (length, ended) in enumerate([(3, False), (3, True), (2, False)]):
        following_advantage = 0.0
        for t in reversed(range(length)):
            discount = 0.0 if ended and t == length - 1 else 0.5
            delta = float(made.reward_TB[t, b]) + discount * float(v_S[t + 1]) - float(v_S[t])
            following_advantage = delta + discount * lambda_ * following_advantage
            assert float(advantage_TB[t, b]) == pytest.approx(following_advantage), (t, b)


def test_the_estimate_from_one_action_has_the_mean_of_the_advantages_of_all():
    pi_NA, advantage_NA = torch.tensor([[0.2, 0.5, 0.3]]), torch.tensor([[1.0, -2.0, 4.0]], dtype=torch.float64)
    mean_NA = sum(float(pi_NA[0, a]) * score_function(torch.tensor([a]), advantage_NA[:, a], pi_NA) for a in range(3))
    torch.testing.assert_close(mean_NA, advantage_NA)


def test_only_actions_that_were_taken_are_learned():
    critic = tabular_critic(torch.zeros(4, 2), target="q", learning_rate=0.1, normalize_returns=False)
    before_SA = critic.q(torch.arange(4))
    critic.fit(following(torch.full((4, 2), 0.5, dtype=torch.float64)), by_hand(), generator=stream(0, "critic"))
    # States 0, 1, 2 with the actions 0, 1, 0; a bias of its own goes with each action.
    step_SA = critic.q(torch.arange(4)) - before_SA - critic.network.head.bias.detach()
    assert (step_SA != 0).tolist() == [[True, False], [False, True], [True, False], [False, False]]


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_values_are_in_reward_units_whatever_the_unit_is(unit):
    # v of a tabular network after the same fits, but for float32.
    values = []
    for scale in (1.0, unit):
        critic = tabular_critic([0.0] * 4, learning_rate=0.02, num_epochs=30, method=TDLambda(lambda_=0.0))
        for k in range(10):
            critic.fit(following(torch.ones(4, 2) / 2), by_hand(scale), generator=stream(k, "critic"))
        values.append(critic.v(torch.arange(3)) / scale)
    torch.testing.assert_close(values[1], values[0], rtol=0.01, atol=0.01)
    assert values[0][1] > 1


@pytest.mark.parametrize("options", [{}, {"network": OwnModule(make=deep)}])
def test_a_new_scale_of_the_targets_leaves_learned_values_where_they_were(options):
    learned = NetworkCritic(VECTORS, 2, NetworkValues(target_period=3, **options), seed=1)
    learned.fit(following(torch.ones(4, 2) / 2), by_hand(shows=POINTS_SD), generator=stream(0, "c"))
    critic = NetworkCritic(VECTORS, 2, NetworkValues(target_period=3, learning_rate=1e-12, **options))
    critic.load_state_dict(learned.state_dict())
    critic.fit(following(torch.ones(4, 2) / 2), by_hand(1000.0, shows=POINTS_SD), generator=stream(0, "c"))
    assert critic.state_dict()["scale"] > 100 * learned.state_dict()["scale"]
    torch.testing.assert_close(critic.v(POINTS_SD), learned.v(POINTS_SD), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(lagging(critic).v(POINTS_SD), lagging(learned).v(POINTS_SD), rtol=1e-3, atol=1e-3)


def w_to_2w(reward: float = 1.0, ends: bool = False) -> Rollout:
    """64 episodes of one step, each from the state 1 to the state 2, where no episode begins (Tsitsiklis and Van Roy
    1996): a linear value of 2 is twice that of 1."""
    ones_TB = torch.ones(1, 64, dtype=torch.float64)
    observation_UB = torch.tensor([1.0, 2.0])[:, None].expand(2, 64)[..., None]
    discount_TB = torch.zeros_like(ones_TB) if ends else 0.9 * ones_TB
    return Rollout(
        observation_UB,
        ones_TB.long(),
        reward * ones_TB,
        discount_TB,
        ones_TB.bool(),
        ones_TB,
        torch.zeros_like(ones_TB),
    )


LINE = spaces.Box(-math.inf, math.inf, (1,))
FAR_N1 = torch.tensor([[1e9], [-1e9]])


@pytest.mark.parametrize("target", ["v", "q"])
@pytest.mark.parametrize(("reward", "values"), [(1.0, (0.0, 10.0)), (-3.0, (-30.0, 0.0))])
def test_values_in_states_without_visits_do_not_feed_on_themselves(target, reward, values):
    options = {"network": MLP(hidden=()), "normalize_returns": False, "learning_rate": 0.3, "target": target}
    critic, policy = NetworkCritic(LINE, 2, NetworkValues(**options)), NetworkPolicy(LINE, 2)
    policy.load_state_dict(
        {name: torch.zeros_like(x) for name, x in policy.state_dict().items()}
        | {"head.bias": torch.tensor([-99.0, 99.0])}
    )
    for k in range(60):
        critic.fit(policy, w_to_2w(reward), generator=stream(k, "critic"))
    assert float(critic.v(torch.ones(1, 1))) == pytest.approx(10 * reward, rel=0.02)
    assert sorted(critic.v(FAR_N1).tolist()) == pytest.approx(values)
    assert critic.network.outputs(FAR_N1).abs().min() > 1e6  # what the network itself says far away
    other = NetworkCritic(LINE, 2, NetworkValues(**options), seed=1)
    other.load_state_dict(critic.state_dict())
    if target == "v":
        assert torch.equal(other.v(FAR_N1), critic.v(FAR_N1))


def test_the_range_of_values_is_that_of_all_rewards_and_discounts_so_far():
    critic, policy = NetworkCritic(LINE, 2, NetworkValues(network=MLP(hidden=()))), NetworkPolicy(LINE, 2)
    critic.fit(policy, w_to_2w(5.0, ends=True), generator=stream(0, "critic"))
    assert sorted(critic.v(FAR_N1).tolist()) == pytest.approx([0.0, 5.0])
    critic.fit(policy, w_to_2w(-1.0), generator=stream(0, "critic"))
    assert sorted(critic.v(FAR_N1).tolist()) == pytest.approx([-10.0, 50.0])


def test_a_state_saved_before_the_first_fit_has_no_range_and_a_wrong_range_is_refused():
    options = NetworkValues(network=MLP(hidden=()), normalize_returns=False)
    critic, policy = NetworkCritic(LINE, 2, options), NetworkPolicy(LINE, 2)
    unlearned, far_N = critic.state_dict(), critic.v(FAR_N1)
    critic.fit(policy, w_to_2w(), generator=stream(0, "critic"))
    learned = critic.state_dict()
    for wrong in ("all", [-1.0], [-1.0, 2.0, -0.9]):
        with pytest.raises(PgtsError, match="seen is"):
            critic.load_state_dict(learned | {"seen": wrong})
    critic.load_state_dict(unlearned)
    assert torch.equal(critic.v(FAR_N1), far_N)


@pytest.mark.parametrize(("polyak", "target_period"), [(0.25, 1), (1.0, 2), (0.25, 3)])
def test_a_target_network_lags_behind(polyak, target_period):
    options = {"polyak": polyak, "target_period": target_period, "normalize_returns": False}
    critic = tabular_critic([0.0] * 4, learning_rate=0.1, **options)
    critic.load_state_dict(critic.state_dict() | {"target_network": critic.network.plain_state()})
    lagging_S, states = critic.v(torch.arange(4)), torch.arange(4)
    for k in range(1, 7):
        critic.fit(following(torch.ones(4, 2) / 2), by_hand(), generator=stream(k, "critic"))
        if k % target_period == 0:
            lagging_S = lagging_S + polyak * (critic.v(states) - lagging_S)
        torch.testing.assert_close(lagging(critic).v(states), lagging_S)
    assert not torch.allclose(lagging_S, torch.zeros(4))


@pytest.mark.parametrize(("polyak", "asks"), [(1.0, 1), (0.5, 2)])
def test_values_queried_before_a_fit_are_reused(polyak, asks, monkeypatch):
    values, options = [0.5, -1.0, 2.0, 0.0], {"learning_rate": 0.1, "polyak": polyak}
    asking, silent = (fitted(tabular_critic(values, **options)) for _ in range(2))
    counted, outputs = [], asking.network.outputs
    monkeypatch.setattr(asking.network, "outputs", lambda seen_N: counted.append(seen_N) or outputs(seen_N))
    made = by_hand()
    for k in range(3):
        counted.clear()
        asking.values(made)
        policy = following(torch.ones(4, 2) / 2)
        losses = [critic.fit(policy, made, generator=stream(k, "critic")) for critic in (asking, silent)]
        assert losses[0] == losses[1]
        assert len(counted) == asks
    assert torch.equal(asking.v(torch.arange(4)), silent.v(torch.arange(4)))


@pytest.mark.parametrize("asked", ["of another rollout", "of another policy", "before a fit already"])
def test_values_of_another_rollout_or_policy_are_not_reused(asked):
    asking, silent = (tabular_critic(torch.eye(4)[:, :2], target="q", learning_rate=0.1) for _ in range(2))
    made = by_hand()
    first, second = following(torch.tensor([[0.9, 0.1]] * 4)), following(torch.tensor([[0.1, 0.9]] * 4))
    for critic in (asking, silent):
        critic.fit(first, made, generator=stream(0, "critic"))
    backward = dataclasses.replace(made, observation_UB=made.observation_UB.flip(0))
    asking.values(backward if asked == "of another rollout" else made)
    policy = second if asked == "of another policy" else first
    for k in range(3 if asked == "before a fit already" else 1):
        losses = [critic.fit(policy, made, generator=stream(k, "critic")) for critic in (asking, silent)]
        assert losses[0] == losses[1]
    assert torch.equal(asking.q(torch.arange(4)), silent.q(torch.arange(4)))


def test_a_policy_and_a_critic_can_share_a_trunk():
    space = spaces.Box(0, 255, (7, 7, 3))
    policy = NetworkPolicy(space, 2, CNN(normalize=True, hidden=(16,)))
    critic = NetworkCritic(space, 2, NetworkValues(), trunk=policy.network.trunk)
    alone = NetworkCritic(space, 2, NetworkValues(network=CNN(normalize=True, hidden=(16,))))
    images_S = torch.randint(0, 256, (4, 7, 7, 3), generator=stream(0, "images")).float()
    made, states = by_hand(shows=images_S), torch.arange(3)
    generator, encoder = stream(0, "test"), policy.network.trunk.encoder
    update = GradientUpdate()
    for k in range(2):
        before_NA = policy.probs(images_S)
        for each in (critic, alone):
            each.fit(policy, made, generator=generator)
        assert not torch.equal(policy.probs(images_S), before_NA)
        # 49 places a picture: the first 8 visits are seen at once by whoever comes first, later ones by the policy.
        assert float(encoder.norm.count) == 49 * (8 + 3 * k)
        assert float(alone.network.trunk.encoder.norm.count) == 49 * 8 * (k + 1)
        update(policy, Batch(images_S[states], torch.zeros(3, 2), torch.ones(3)), generator=generator)
    before_S = alone.v(images_S)
    update(policy, Batch(images_S[states], torch.eye(3)[:, :2], torch.ones(3)), generator=generator)
    assert torch.equal(alone.v(images_S), before_S)


@pytest.mark.parametrize(
    ("target", "polyak", "network"),
    [
        ("v", 1.0, MLP(hidden=(8,), normalize=True)),
        ("q", 0.5, MLP(hidden=(8,), normalize=True)),
        ("q", 0.5, OwnModule(make=Plain, normalize=True)),
    ],
)
def test_a_saved_critic_goes_on_bit_for_bit(target, polyak, network, tmp_path):
    options = {"network": network, "target": target, "polyak": polyak}
    critics = [NetworkCritic(VECTORS, 2, NetworkValues(**options), seed=seed) for seed in (1, 2)]
    made, policy = by_hand(shows=POINTS_SD), NetworkPolicy(VECTORS, 2)
    critics[0].fit(policy, made, generator=stream(0, "critic"))
    saving.write(tmp_path / "critic", critics[0].state_dict())
    critics[1].load_state_dict(saving.read(tmp_path / "critic"))
    for k in range(3):
        losses = [critic.fit(policy, made, generator=stream(k, "critic")) for critic in critics]
        assert losses[0] == losses[1]
    assert torch.equal(critics[0].v(POINTS_SD), critics[1].v(POINTS_SD))
    assert not torch.equal(
        critics[0].v(POINTS_SD), NetworkCritic(VECTORS, 2, NetworkValues(target="v"), seed=1).v(POINTS_SD)
    )
    with pytest.raises(PgtsError, match="the state of a network critic lacks"):
        critics[0].load_state_dict({"network": critics[0].state_dict()["network"]})


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_targets_that_are_not_finite_teach_nothing(value):
    critic, made = tabular_critic([1.0, 2.0, 3.0, 4.0]), by_hand()
    made.reward_TB.data = made.reward_TB.clone()
    made.reward_TB[1, 1] = value
    before = critic.state_dict()["network"]
    with pytest.raises(PgtsError, match="a target of the critic is not finite"):
        critic.fit(following(torch.ones(4, 2) / 2), made, generator=stream(0, "critic"))
    assert torch.equal(critic.state_dict()["network"]["head.weight"], before["head.weight"])


@pytest.mark.parametrize("lags", [{"polyak": 0.5}, {"target_period": 2}])
def test_fresh_targets_of_a_target_network_that_lags_are_refused(lags):
    with pytest.raises(PgtsError, match=r"fresh_targets is true, but .* lags behind"):
        NetworkValues(fresh_targets=True, **lags)


def test_a_critic_without_q_or_without_values_says_so():
    with pytest.raises(PgtsError, match="learns v"):
        NetworkCritic(VECTORS, 2).q(POINTS_SD)
    with pytest.raises(PgtsError, match="has no values yet"):
        NetworkCritic(VECTORS, 2, NetworkValues(target="q")).v(POINTS_SD)
    assert isinstance(following(torch.ones(2, 2) / 2), SimplexPolicy)
