"""Parts from plain descriptions."""

import pytest

from pgts_torch.agent.advantages import LookaheadAdvantages, SampledAdvantages
from pgts_torch.agent.build import make_critic, make_horizon, make_policy, make_update
from pgts_torch.agent.critics import ExactCritic, MonteCarlo, RolloutCritic, TabularCritic, TDLambda
from pgts_torch.agent.neural import NetworkCritic
from pgts_torch.agent.policies import SimplexPolicy, SoftmaxPolicy
from pgts_torch.agent.rollout import FixedHorizon, GeometricHorizon
from pgts_torch.agent.updates import MirrorUpdate, ProjectedUpdate, SoftmaxUpdate
from pgts_torch.agent.world import TabularWorld
from pgts_torch.errors import PgtsError
from tests.agent.helpers import copies
from tests.support import zoo

WORLD = TabularWorld(copies(zoo("ladder"), 2), zoo("ladder"))


def policy(description):
    return make_policy(description, WORLD, seed=0)


def update(description):
    return make_update(description, policy("softmax"))


def critic(description):
    return make_critic(description, WORLD, policy("softmax"), seed=0)


def test_a_word_stands_for_a_part_with_its_defaults():
    assert make_horizon("fixed") == make_horizon({"type": "fixed"}) == FixedHorizon()
    assert make_horizon("geometric") == GeometricHorizon()
    assert update("projected") == ProjectedUpdate()
    assert isinstance(policy("softmax"), SoftmaxPolicy)
    assert isinstance(policy("simplex"), SimplexPolicy)
    assert isinstance(critic("exact"), ExactCritic)
    assert isinstance(critic("rollout"), RolloutCritic)


def test_options_reach_their_part():
    assert make_horizon({"type": "fixed", "length": 7}) == FixedHorizon(7)
    assert update({"type": "softmax", "step_size": 0.3, "state_weight": "visits"}) == SoftmaxUpdate(0.3, "visits")
    assert update({"type": "mirror", "step_size": 2}) == MirrorUpdate(2)
    biased = policy({"type": "simplex", "init": {"type": "biased", "action": 1, "probability": 1}})
    assert biased.table().tolist() == [[0.0, 1.0]] * 5
    made = critic(
        {"type": "tabular", "target": "q", "method": {"type": "td_lambda", "lambda": 0.4}, "step_size": "mean"}
    )
    assert isinstance(made, TabularCritic)
    assert (made.target, made.method, made.step_size) == ("q", TDLambda(0.4), "mean")
    assert critic({"type": "tabular", "method": "monte_carlo"}).method == MonteCarlo()
    made = critic({"type": "rollout", "samples": 3, "horizon": {"type": "fixed", "length": 2}})
    assert isinstance(made, RolloutCritic)
    assert (made.samples, made.horizon) == (3, FixedHorizon(2))


def test_a_network_critic_has_fresh_targets_with_a_lookahead_unless_its_target_network_lags():
    def fresh(estimator=LookaheadAdvantages(), **options) -> bool:  # noqa: B008 - frozen
        made = make_critic({"type": "network", **options}, WORLD, policy("softmax"), estimator, seed=0)
        assert isinstance(made, NetworkCritic)
        return made.fresh_targets

    assert fresh()
    assert fresh(polyak=1.0, target_period=1)
    assert fresh(SampledAdvantages(), fresh_targets=True)
    assert not fresh(SampledAdvantages())
    assert not fresh(polyak=0.5)
    assert not fresh(target_period=2)
    assert not fresh(fresh_targets=False)


def test_a_description_is_not_changed_by_being_built():
    description = {"type": "tabular", "method": {"type": "td_lambda", "lambda": 0.4}}
    assert critic(description).method == critic(description).method == TDLambda(0.4)
    assert description == {"type": "tabular", "method": {"type": "td_lambda", "lambda": 0.4}}


@pytest.mark.parametrize(
    ("make", "description", "message"),
    [
        (make_horizon, "infinite", "horizon is 'infinite'; it must be one of fixed, geometric"),
        (make_horizon, {"length": 5}, "horizon is None"),
        (make_horizon, {"type": "fixed", "max_length": 5}, "'max_length'"),
        (make_horizon, {"type": "fixed", "length": 0}, "length is 0"),
        (make_horizon, {"type": "geometric", "max_length": 0}, "max_length is 0"),
        (make_horizon, 7, "horizon is 7"),
        (update, "adam", "update is 'adam'"),
        (update, 3, "update is 3"),
        (policy, {"type": "softmax", "device": "cpu"}, "'device'"),
        (policy, {"type": "softmax", "init": "zero"}, "policy.init is 'zero'"),
        (policy, {"type": "softmax", "init": {"type": "biased"}}, "policy.init 'biased' does not take"),
        (critic, {"type": "exact", "step_size": 0.5}, "step_size"),
        (critic, {"type": "tabular", "method": {"type": "td_lambda", "lambda": 1.5}}, "lambda is 1.5"),
        (critic, {"type": "tabular", "method": 3}, "critic.method is 3"),
        (critic, {"type": "tabular", "step_size": 0}, "step_size is 0"),
        (critic, {"type": "tabular", "step_size": "often"}, "step_size is 'often'"),
        (critic, {"type": "tabular", "target": "u"}, "target is 'u'"),
        (critic, {"type": "rollout", "samples": 0}, "samples is 0"),
        (critic, "neural", "critic is 'neural'"),
    ],
)
def test_what_describes_no_part_is_refused_by_name(make, description, message):
    with pytest.raises(PgtsError, match=message):
        make(description)
