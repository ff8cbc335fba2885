"""Parts from options, words and plain mappings."""

from inspect import signature

import pytest

from pgts_torch import options
from pgts_torch.agent.build import chosen, make_critic, make_policy, make_update
from pgts_torch.agent.critics import ExactCritic, RolloutCritic, TabularCritic
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.policies import SimplexPolicy, SoftmaxPolicy
from pgts_torch.agent.updates import MirrorUpdate, ProjectedUpdate
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.errors import PgtsError
from pgts_torch.options import (
    MCTS,
    MLP,
    PPO,
    Auto,
    Biased,
    ExactValues,
    FixedHorizon,
    GeometricHorizon,
    LookaheadAdvantages,
    Mirror,
    MonteCarlo,
    NetworkValues,
    RolloutValues,
    Sampled,
    SampledAdvantages,
    SharedNetwork,
    Simplex,
    Softmax,
    SoftmaxGradient,
    TabularValues,
    TDLambda,
)
from pgts_torch.options.arguments import described, read
from pgts_torch.options.training import Training
from tests.agent.helpers import vector_env
from tests.support import zoo

WORLD = TabularWorld(vector_env(zoo("ladder"), 2), zoo("ladder"))


def given(**arguments) -> Training:
    """The options among the arguments of PGTS, of which these are given."""
    defaults = {"policy": None, "critic": None, "update": None, "search": "auto", "estimator": "lookahead"}
    return read(defaults | {"horizon": "fixed", "depth": 4, "num_envs": 32} | arguments)


def test_a_word_and_a_mapping_stand_for_options_with_their_defaults():
    assert given(horizon="geometric").rollout.horizon == GeometricHorizon()
    assert given(horizon={"type": "fixed"}) == given(horizon="fixed") == given(horizon=FixedHorizon())
    for word, part in {"softmax": SoftmaxGradient(), "mirror": Mirror(), "ppo": PPO()}.items():
        assert given(update=word).update == given(update={"type": word}).update == given(update=part).update == part
    for word, part in {"exact": ExactValues(), "rollout": RolloutValues(), "network": NetworkValues()}.items():
        assert given(critic=word).critic == given(critic=part).critic == part
    assert given(search="sampled") == given(search={"type": "sampled"}) == given(search=Sampled())
    assert given(estimator="sampled", depth=0).estimator == SampledAdvantages()


def test_arguments_reach_the_options():
    critic = {"type": "tabular", "target": "q", "method": {"type": "td_lambda", "lambda": 0.4}, "step_size": "mean"}
    same = TabularValues(target="q", method=TDLambda(lambda_=0.4), step_size="mean")
    assert given(critic=critic).critic == given(critic=same).critic == same
    assert critic["method"] == {"type": "td_lambda", "lambda": 0.4}
    assert given(critic={"type": "tabular", "method": "monte_carlo"}).critic == TabularValues(method=MonteCarlo())
    shared = given(critic={"type": "network", "network": "shared"})
    assert shared == given(critic=NetworkValues(network=SharedNetwork()))
    search = given(search={"type": "mcts", "simulations": 7}, depth="adaptive", max_depth=3).search
    assert (search.kind, search.simulations, list(search.depths)) == ("mcts", 7, [0, 1, 2, 3])
    assert given(search=MCTS(simulations=7), depth="adaptive", max_depth=3).search == search
    assert given(update={"type": "mirror", "floor": None}).update == Mirror(floor="never")
    assert given(update={"type": "ppo", "max_grad_norm": None}).update == PPO(max_grad_norm="never")
    assert given(policy={"type": "mlp", "hidden": (7,)}).policy == MLP(hidden=[7])


def test_a_mapping_without_type_is_of_the_first_type_that_has_its_keys():
    options = given(policy={"hidden": [7]}, critic={"polyak": 0.5}, update={"clip_range": 0.1})
    assert (options.policy, options.critic) == (MLP(hidden=[7]), NetworkValues(polyak=0.5))
    assert options.update == PPO(clip_range=0.1)
    assert given(update={"step_size": 0.5}).update == Mirror(step_size=0.5)


def test_the_method_of_a_network_has_the_default_of_networks():
    assert NetworkValues(method=TDLambda()) == NetworkValues()
    assert NetworkValues().method.lambda_ == 0.95 != TabularValues().method.lambda_
    assert NetworkValues(method=TDLambda(lambda_=0.4)).method.lambda_ == 0.4


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"policy": MLP(hidden=[3]), "critic": NetworkValues(network=SharedNetwork()), "update": PPO(clip_range=0.1)},
        {"policy": Simplex(init=Biased(action=1, probability=1)), "critic": "exact", "search": MCTS(samples=2)},
        {"update": {"type": "mirror", "floor": None}, "depth": "adaptive", "tolerance": 0.1, "stop_at": 0.5},
        {"search": Sampled(samples=(3, None)), "horizon": GeometricHorizon(), "action_repeat": 2},
    ],
)
def test_options_survive_being_described(arguments):
    options = given(**arguments)
    assert given(**described(options)) == options


def test_a_part_is_made_from_its_options():
    def policy(options):
        return make_policy(options, WORLD, seed=0)

    def critic(options):
        return make_critic(options, WORLD, policy(Softmax()), seed=0)

    assert isinstance(policy(Softmax()), SoftmaxPolicy)
    assert isinstance(policy(MLP()), NetworkPolicy)
    biased = policy(Simplex(init=Biased(action=1, probability=1)))
    assert isinstance(biased, SimplexPolicy)
    assert biased.table().tolist() == [[0.0, 1.0]] * 5
    kinds = {ExactValues: ExactCritic, TabularValues: TabularCritic, RolloutValues: RolloutCritic}
    for values, kind in (kinds | {NetworkValues: NetworkCritic}).items():
        assert isinstance(critic(values(target="q")), kind)
        assert critic(values(target="q")).target == "q"
    with pytest.raises(PgtsError, match=r"critic.network is 'shared'; a SoftmaxPolicy has no network to share"):
        critic(NetworkValues(network=SharedNetwork()))


def test_the_environment_chooses_what_is_left_out():
    assert isinstance(make_update(chosen(given(), WORLD).update, make_policy(Softmax(), WORLD, seed=0)), MirrorUpdate)
    simplex = chosen(given(policy="simplex"), WORLD)
    assert isinstance(make_update(simplex.update, make_policy(simplex.policy, WORLD, seed=0)), ProjectedUpdate)
    assert chosen(given(policy="mlp", estimator="sampled", depth=0), WORLD).update == PPO()
    assert chosen(given(), WORLD).critic == TabularValues()
    with pytest.raises(
        PgtsError, match=r"update.type is ppo, which needs policy.type mlp, cnn, module or gaussian; policy.type is"
    ):
        chosen(given(update="ppo"), WORLD)


def test_a_network_critic_has_a_network_like_the_policy_unless_told_otherwise():
    for critic in (None, "network", NetworkValues(), {"type": "network", "network": "own"}):
        assert chosen(given(policy=MLP(hidden=[3]), critic=critic), WORLD).critic == NetworkValues(
            network=MLP(hidden=[3])
        )
    other = NetworkValues(network=MLP(hidden=[5]))
    assert chosen(given(policy=MLP(hidden=[3]), critic=other), WORLD).critic == other
    assert chosen(given(critic="network"), WORLD).critic == NetworkValues()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": "infinite"}, "^horizon.type is 'infinite'"),
        ({"horizon": 7}, "^horizon is 7; it must be auto, fixed, geometric or steps, or a mapping with such a type$"),
        ({"horizon": {"type": "fixed", "max_length": 5}}, "^horizon.max_length does not belong to horizon.type fixed"),
        ({"horizon": {"type": "fixed", "length": 1.5}}, "^horizon.length is 1.5"),
        ({"num_envs": 4.0}, "^num_envs is 4.0; it must be a whole number >= 1 or null$"),
        ({"depth": 2, "max_depth": 3}, "^max_depth is 3, which only depth adaptive uses; depth is 2$"),
        ({"update": 3}, "^update is 3"),
        ({"update": MLP()}, "^update.type is 'mlp'"),
        ({"update": {"type": "ppo", "clip_rang": 1}}, "^update.clip_rang is unknown; did you mean update.clip_range"),
        ({"policy": {"type": "softmax", "init": "zero"}}, "^policy.init.type is 'zero'"),
        ({"critic": {"type": "tabular", "method": {"lambda": 1.5}}}, "^critic.method.lambda is 1.5"),
        ({"search": "best"}, "^search.kind is 'best'"),
        ({"search": {"type": "mcts", "share": "none"}}, "^search.share does not belong to search.kind mcts"),
        (
            {"search": {"type": "sampled", "samples": [2, 0]}},
            "search.samples is a list; it must be a whole number >= 1, or a list of such",
        ),
        ({"estimator": "sampled"}, "^depth is 4; with estimator.type sampled there is no lookahead, it must be 0$"),
    ],
)
def test_an_invalid_description_of_a_part_is_refused_by_name(arguments, message):
    with pytest.raises(PgtsError, match=message):
        given(**arguments)


def test_all_mistakes_are_reported_at_once():
    with pytest.raises(PgtsError) as caught:
        given(
            num_envs=0, update={"type": "ppo", "clip_range": -1, "num_epochs": 0}, search={"type": "mcts", "merge": 3}
        )
    assert {line.split(" ")[0] for line in str(caught.value).splitlines()} == {
        "num_envs",
        "search.merge",
        "update.clip_range",
        "update.num_epochs",
    }
    with pytest.raises(PgtsError, match=r"^PPO: num_epochs is 0; it must be .*\nPPO: clip_range is -1"):
        PPO(num_epochs=0, clip_range=-1)


def test_a_choice_of_the_environment_that_does_not_fit_is_one_clear_line():
    for update in ({"type": "mirror", "step_size": 0.5}, Mirror(step_size=0.5)):
        with pytest.raises(PgtsError) as caught:
            PGTS("CartPole-v1", update=update, num_envs=1, depth=0)
        assert str(caught.value) == (
            "update.step_size is 0.5, which the mirror update of a network does not use; policy.type is mlp"
        )


def test_the_defaults_of_pgts_are_those_of_the_options():
    arguments = {name: each.default for name, each in signature(PGTS).parameters.items()}
    assert read(arguments) == Training()


def test_options_cannot_be_changed_and_are_equal_by_value():
    assert Auto(max_nodes=7) == Auto(max_nodes=7) != Auto()
    with pytest.raises(ValueError, match="frozen"):
        PPO().clip_range = 0.1


def test_options_are_documented():
    for name in options.__all__:
        kind = getattr(options, name)
        assert kind.__doc__, name
        assert all(field.description or each in ("type", "kind") for each, field in kind.model_fields.items()), name


def test_a_network_critic_has_fresh_targets_with_a_lookahead_unless_its_target_network_lags():
    def fresh(estimator=LookaheadAdvantages(), **options) -> bool:  # noqa: B008 - frozen
        made = make_critic(NetworkValues(**options), WORLD, make_policy(Softmax(), WORLD, seed=0), estimator, seed=0)
        return made.options.fresh_targets

    assert fresh()
    assert fresh(polyak=1.0, target_period=1)
    assert fresh(SampledAdvantages(), fresh_targets=True)
    assert not fresh(SampledAdvantages())
    assert not fresh(polyak=0.5)
    assert not fresh(target_period=2)
    assert not fresh(fresh_targets=False)
