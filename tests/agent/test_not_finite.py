"""A number that is not finite stops training before it moves the policy, wherever it comes from."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from torch import Tensor

from pgts_torch import PGTS
from pgts_torch.agent import advantages
from pgts_torch.agent.gradients import Forward
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_updates import GradientUpdate
from pgts_torch.agent.optimisers import Optimiser
from pgts_torch.agent.policies import SimplexPolicy, SoftmaxPolicy
from pgts_torch.agent.policy_lookahead import PolicyLookahead
from pgts_torch.agent.updates import MirrorUpdate, ProjectedUpdate, SoftmaxUpdate
from pgts_torch.bellman import Outcomes
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.options import MLP, Biased, Gradient, Mirror, Projected, Softmax, SoftmaxGradient
from pgts_torch.seeding import stream

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

KINDS = {
    "tables": {"env": "pgts/Random-v0", "policy": "softmax", "update": "softmax"},
    "simplex": {"env": "pgts/Random-v0", "policy": "simplex", "update": "projected"},
    "networks": {"env": "CartPole-v1", "policy": "mlp", "update": "ppo"},
    "mirror": {"env": "CartPole-v1", "policy": "mlp", "update": "mirror"},
    "sampled": {"env": "CartPole-v1", "policy": "mlp", "update": "gradient", "estimator": "sampled", "depth": 0},
}


def make(kind: str) -> PGTS:
    return PGTS(**{"depth": 1, "num_envs": 2, "horizon": {"type": "fixed", "length": 5}, "seed": 3} | KINDS[kind])


def spoiled(function: Callable[..., Tensor], value: float) -> Callable[..., Tensor]:
    """The function, with one number of its answer replaced."""

    def wrapped(*args, **kwargs):
        answer = function(*args, **kwargs).clone()
        answer.view(-1)[-1] = value
        return answer

    return wrapped


def last_replaced(numbers: object, value: float) -> np.ndarray:
    array = np.array(numbers, dtype=np.float64)
    array.flat[-1] = value
    return array


def in_steps(patch: pytest.MonkeyPatch, model: PGTS, change: Callable[..., tuple]) -> None:
    """Change what is returned by the last environment, or by all where they are stepped together."""
    env = model.world.env
    stepped = env.envs[-1] if isinstance(env, SyncVectorEnv) else env
    step = stepped.step
    patch.setattr(stepped, "step", lambda action: change(*step(action)))


def in_rewards(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    in_steps(patch, model, lambda observation, reward, *rest: (observation, last_replaced(reward, value), *rest))


def in_discounts(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    def change(observation, reward, terminated, truncated, info):
        return observation, reward, terminated, truncated, info | {"discount": np.full(np.shape(reward), value)}

    env = model.world.env
    for one in env.envs if isinstance(env, SyncVectorEnv) else [env]:
        patch.setitem(one.metadata, "discounts", True)
    in_steps(patch, model, change)


def in_observations(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    in_steps(patch, model, lambda observation, *rest: (last_replaced(observation, value), *rest))


def in_rewards_of_the_model(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    asked = model.world.model.outcomes

    def wrapped(state_N):
        answer = asked(state_N)
        return Outcomes(
            torch.full_like(answer.reward_NA, value),
            answer.prob_NAK,
            answer.discount_NAK,
            answer.child_NAK,
            answer.num_children,
        )

    patch.setattr(model.world.model, "outcomes", wrapped)


def in_values(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    patch.setattr(model.critic, "v", spoiled(model.critic.v, value))


def in_targets(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    patch.setattr(advantages, "lambda_returns", lambda made, *rest: torch.full_like(made.reward_TB, value))


def in_lookaheads(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    search = model.search
    assert search is not None
    look = search.look_ahead

    def wrapped(*args):
        answer = look(*args)
        answer.q_BA[-1] = value
        return answer

    patch.setattr(search, "look_ahead", wrapped)


def in_logits(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    patch.setattr(model.policy, "probs", spoiled(model.policy.probs, value))


def in_parameters(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    """In the table itself: a saved one with such numbers may be refused."""
    name = "logits_SA" if isinstance(model.policy, SoftmaxPolicy) else "probs_SA"
    getattr(model.policy, name)[:] = value


def in_losses(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    step = Optimiser.step

    def wrapped(self, parameters, gradients, loss, name):
        return step(self, parameters, gradients, loss * value if name == "policy" else loss, name)

    patch.setattr(Optimiser, "step", wrapped)


def in_gradients(patch: pytest.MonkeyPatch, model: PGTS, value: float) -> None:
    """From the second minibatch of the update on, where it has several."""
    calls = iter(range(100))
    late = type(model.update).__name__ != "GradientUpdate"
    plain, network = Forward.gradients, model.policy.network

    def wrapped(made: Forward, down_ND: Tensor) -> list[Tensor]:
        first, *others = plain(made, down_ND)
        is_due = made.network is network and next(calls) >= late
        return [first * value if is_due else first, *others]

    patch.setattr(Forward, "gradients", wrapped)


ALL, NETWORKS = list(KINDS), ["networks", "mirror", "sampled"]
PLACES = {
    in_observations: ("observation", NETWORKS),
    in_rewards: ("reward", ALL),
    in_discounts: ("discount", ALL),
    in_rewards_of_the_model: ("reward", ["tables", "simplex", "networks", "mirror"]),
    in_values: ("value", ["tables", "simplex", "networks", "mirror"]),
    in_targets: ("value", ALL),
    in_lookaheads: ("lookahead", ["tables", "simplex", "networks", "mirror"]),
    in_logits: ("probability", ALL),
    in_parameters: ("probability", ["tables", "simplex"]),
    in_losses: ("loss", NETWORKS),
    in_gradients: ("gradient", NETWORKS),
}
CASES = [(place, kind) for place, (_, kinds) in PLACES.items() for kind in kinds]


def remembered(model: PGTS) -> list[Tensor]:
    """What the policy and its optimiser consist of."""
    states = (model.policy.state_dict(), model.update.state_dict())
    return [torch.as_tensor(value).clone() for state in states for value in state.values()]


@pytest.mark.fault(
    "observation that is not finite",
    "reward that is not finite",
    "discount that is not finite",
    "value that is not finite",
    "lookahead that is not finite",
    "probability that is not finite",
    "loss that is not finite",
    "gradient that is not finite",
)
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize(("place", "kind"), CASES, ids=lambda case: getattr(case, "__name__", case))
def test_a_number_that_is_not_finite_stops_training_before_the_policy_moves(place, kind, value, monkeypatch):
    model = make(kind)
    with monkeypatch.context() as patch:
        place(patch, model, value)
        before = remembered(model)
        with pytest.raises(NotFinite) as caught:
            model.iterate()
    assert caught.value.what == PLACES[place][0]
    after = remembered(model)
    assert len(before) == len(after)
    assert all(torch.equal(x, y) for x, y in zip(before, after, strict=True) if x.isfinite().all())


@pytest.mark.parametrize("kind", KINDS)
def test_without_such_a_number_the_policy_moves(kind):
    model = make(kind)
    before = remembered(model)
    model.iterate()
    assert not all(map(torch.equal, before, remembered(model)))


@pytest.mark.fault("step that overflows")
@pytest.mark.parametrize(
    ("policy", "update"),
    [
        (SoftmaxPolicy(3, 2), SoftmaxUpdate(SoftmaxGradient(step_size=1e308))),
        (SoftmaxPolicy(3, 2), MirrorUpdate(Mirror(step_size=1e308))),
        (SimplexPolicy(3, 2), ProjectedUpdate(Projected(step_size=1e308))),
    ],
)
def test_a_tabular_step_that_overflows_leaves_the_table_as_it_is(policy, update):
    before, states, weight_N = policy.table(), torch.tensor([0, 2]), torch.ones(2, dtype=torch.float64)
    advantage_NA = torch.tensor([[1.0, -1.0], [1e3, -1e3]], dtype=torch.float64)
    with pytest.raises(
        NotFinite, match=r"the step along the advantages of state 2 is \[inf, -inf\]; it must be finite"
    ):
        update(policy, Batch(states, advantage_NA, weight_N), generator=stream(0, "update"))
    assert torch.equal(policy.table(), before)
    update(policy, Batch(states[:1], advantage_NA[:1] / 1e308, weight_N[:1]), generator=stream(0, "update"))
    assert not torch.equal(policy.table(), before)


@pytest.mark.fault("step that overflows")
def test_a_direction_that_overflows_leaves_the_table_as_it_is():
    policy = SoftmaxPolicy(3, 2, Softmax(init=Biased(action=1, probability=0.9)))
    before, weight_N = policy.table(), torch.ones(1, dtype=torch.float64)
    advantage_NA = torch.tensor([[1.7e308, -1.7e308]], dtype=torch.float64)
    with pytest.raises(NotFinite, match=r"the next policy of state 1 is \[inf, .*\]; it must be finite"):
        SoftmaxUpdate(SoftmaxGradient(step_size=0.1))(
            policy, Batch(torch.tensor([1]), advantage_NA, weight_N), generator=stream(0, "update")
        )
    assert torch.equal(policy.table(), before)


@pytest.mark.parametrize("make", [SoftmaxPolicy, SimplexPolicy])
@pytest.mark.parametrize("options", [{}, {"normalize": "none"}, {"floor": None}, {"normalize": "none", "floor": None}])
def test_an_action_that_is_not_allowed_may_be_worth_minus_infinity(make, options):
    policy, states, weight_N = make(4, 3), torch.tensor([1, 2]), torch.ones(2, dtype=torch.float64)
    advantage_NA = torch.tensor([[0.0, -math.inf, -math.inf], [1.0, -1.0, -math.inf]], dtype=torch.float64)
    MirrorUpdate(Mirror(step_size=1.0, **options))(
        policy, Batch(states, advantage_NA, weight_N), generator=stream(0, "update")
    )
    assert policy.table()[1].tolist() == [1.0, 0.0, 0.0]
    # State 2: pi is (1/2, 1/2) on what is allowed. The mean over both states of sum_a pi A^2, pi = 1/3, is 1/3.
    size = 1.0 if "normalize" in options else math.sqrt(1 / 3)
    better = 1 / (1 + math.exp(-2 / size))
    assert policy.table()[2].tolist() == pytest.approx([better, 1 - better, 0.0], abs=1e-12)
    assert torch.equal(policy.table()[[0, 3]], make(4, 3).table()[[0, 3]])
    with pytest.raises(NotFinite, match=r"the step along the advantages of state 1 is \[-inf, -inf, -inf\]"):
        MirrorUpdate(Mirror(step_size=1.0))(
            policy, Batch(states, advantage_NA.fill_(-math.inf), weight_N), generator=stream(0, "update")
        )


def test_the_softmax_gradient_leaves_an_action_that_is_not_allowed_and_never_taken_where_it_is():
    policy, weight_N = SoftmaxPolicy(2, 3), torch.ones(1, dtype=torch.float64)
    policy.logits_SA[1] = torch.tensor([0.0, 0.0, -math.inf])
    advantage_NA = torch.tensor([[1.0, -1.0, -math.inf]], dtype=torch.float64)
    SoftmaxUpdate(SoftmaxGradient(step_size=0.5))(
        policy, Batch(torch.tensor([1]), advantage_NA, weight_N), generator=stream(0, "update")
    )
    # pi = (1/2, 1/2, 0), so the direction is pi A = (1/2, -1/2, 0).
    assert policy.logits_SA[1].tolist() == [0.25, -0.25, -math.inf]


@pytest.mark.parametrize(("make", "update"), [(SoftmaxPolicy, "softmax"), (SimplexPolicy, "projected")])
def test_a_policy_that_never_takes_what_is_not_allowed_is_trained(make, update, monkeypatch):
    policy = make(10, 3)
    if isinstance(policy, SoftmaxPolicy):
        policy.logits_SA[:, 2] = -math.inf
    else:
        policy.probs_SA[:] = torch.tensor([0.5, 0.5, 0.0])
    options = {"num_envs": 2, "horizon": {"type": "fixed", "length": 5}, "env_kwargs": {"num_actions": 3}}
    model = PGTS("pgts/Random-v0", depth=1, policy=policy, update=update, **options)
    call, allowed = PolicyLookahead.__call__, []

    def denied(*args, **given):
        look = call(*args, **given)
        look.q_BA[:, 2] = -math.inf
        allowed.append(look.q_BA[:, :2])
        return look

    monkeypatch.setattr(PolicyLookahead, "__call__", denied)
    seen = model.iterate()
    shallow_NA, deep_NA = allowed
    assert seen.gap_N.tolist() == pytest.approx((deep_NA.amax(-1) - shallow_NA.mean(-1)).clamp(min=0).tolist())
    after_NA = policy.table()[seen.state_N]
    assert torch.equal(after_NA[:, 0] > after_NA[:, 1], deep_NA[:, 0] > deep_NA[:, 1])
    assert not after_NA[:, 2].any()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_saved_probabilities_that_are_not_finite_are_refused(value):
    policy = SimplexPolicy(3, 2)
    spoiled_SA = policy.table()
    spoiled_SA[1, 0] = value
    with pytest.raises(PgtsError, match="probs_SA has rows that are no distributions"):
        policy.load_state_dict({"probs_SA": spoiled_SA})
    assert torch.equal(policy.table(), SimplexPolicy(3, 2).table())


@pytest.mark.fault("step that overflows")
@pytest.mark.parametrize(("learning_rate", "what"), [(1e20, "probability"), (1e39, "gradient")])
def test_steps_of_a_network_that_overflow_are_taken_back(learning_rate, what):
    policy = NetworkPolicy(spaces.Box(-math.inf, math.inf, (3,)), 2, MLP(activation="relu"))
    update = GradientUpdate(Gradient(learning_rate=learning_rate, optimizer="sgd", max_grad_norm="never"))
    before = policy.state_dict()
    question = torch.ones(2, 3), torch.tensor([[1.0, -1.0], [2.0, -2.0]]), torch.ones(2)
    with pytest.raises(NotFinite) as caught:
        update(policy, Batch(*question), generator=stream(0, "update"))
    assert caught.value.what == what
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())
