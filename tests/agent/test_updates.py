"""How policies move: as the exact formulas say, and only where they are told to."""

import math

import pytest
import torch

from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.policies import SimplexPolicy, SoftmaxPolicy
from pgts_torch.agent.updates import MirrorUpdate, ProjectedUpdate, SoftmaxUpdate
from pgts_torch.errors import PgtsError
from pgts_torch.options import Mirror, Projected, Random, Simplex, Softmax, SoftmaxGradient
from pgts_torch.seeding import stream
from pgts_torch.tabular.ascent import mirror_step, projected_step, softmax_step


def projected(**options) -> ProjectedUpdate:
    return ProjectedUpdate(Projected(**options))


def softmax(**options) -> SoftmaxUpdate:
    return SoftmaxUpdate(SoftmaxGradient(**options))


def in_reward_units(**options) -> MirrorUpdate:
    """The mirror step of the exact formula."""
    return MirrorUpdate(Mirror(normalize="none", floor="never", **options))


CASES = [
    (projected, SimplexPolicy, projected_step),
    (softmax, SoftmaxPolicy, softmax_step),
    (in_reward_units, SimplexPolicy, mirror_step),
    (in_reward_units, SoftmaxPolicy, mirror_step),
]
STATES = torch.tensor([5, 0, 3])


def random_policy(kind):
    return kind(7, 4, (Simplex if kind is SimplexPolicy else Softmax)(init=Random()), seed=3)


def question(seed: int = 0):
    """Lookahead values and weights at three states."""
    generator = stream(seed, "updates")
    q_NA = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    return q_NA, torch.rand(3, generator=generator, dtype=torch.float64) * 3


@pytest.mark.parametrize(("update", "kind", "step"), CASES)
@pytest.mark.parametrize("step_size", [0.01, 0.1, 0.3])
def test_an_update_is_the_exact_formula_at_the_visited_states(update, kind, step, step_size):
    policy = random_policy(kind)
    before_SA, (q_NA, weight_N) = policy.table(), question()
    update(step_size=step_size).step(policy, STATES, q_NA, weight_N)
    expected_NA = step(before_SA[STATES], q_NA, weight_N, step_size)
    torch.testing.assert_close(policy.probs(STATES), expected_NA)
    assert not torch.allclose(expected_NA, step(before_SA[STATES], q_NA, weight_N, 2 * step_size))
    assert not torch.allclose(expected_NA, step(before_SA[STATES], q_NA, weight_N.roll(1), step_size))


@pytest.mark.parametrize(("update", "kind", "step"), CASES)
def test_an_update_is_one_step_and_uses_no_random_numbers(update, kind, step):
    called, stepped = random_policy(kind), random_policy(kind)
    generator = stream(0, "untouched")
    assert update()(called, Batch(STATES, *question()), generator=generator) == {}
    update().step(stepped, STATES, *question())
    assert torch.equal(called.table(), stepped.table())
    assert torch.equal(generator.get_state(), stream(0, "untouched").get_state())


@pytest.mark.parametrize(("update", "kind", "step"), CASES)
def test_states_that_were_not_visited_stay_bit_for_bit(update, kind, step):
    policy = random_policy(kind)
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    update(step_size=5.0).step(policy, STATES, *question())
    others = torch.tensor([1, 2, 4, 6])
    for name, value in policy.state_dict().items():
        assert torch.equal(value[others], before[name][others])
        assert not torch.isclose(value[STATES], before[name][STATES]).all(-1).any()


@pytest.mark.parametrize(("update", "kind", "step"), CASES)
def test_after_many_large_steps_a_policy_is_still_one(update, kind, step):
    policy = random_policy(kind)
    for seed in range(200):
        update(step_size=50.0).step(policy, STATES, *question(seed))
    pi_SA = policy.table()
    assert (pi_SA >= 0).all()
    torch.testing.assert_close(pi_SA.sum(-1), torch.ones(7, dtype=torch.float64))


@pytest.mark.parametrize(("update", "kind", "step"), CASES)
def test_an_update_moves_toward_the_better_action(update, kind, step):
    policy = kind(2, 3)
    q_NA = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
    update(step_size=0.1).step(policy, torch.tensor([1]), q_NA, torch.ones(1, dtype=torch.float64))
    assert policy.table()[1, 1] > 1 / 3 > policy.table()[1, 0]


def test_mirror_steps_on_logits_and_on_probabilities_are_the_same():
    on_probs = SimplexPolicy(7, 4, Simplex(init=Random()), seed=3)
    on_logits = SoftmaxPolicy(7, 4, Softmax(init=Random()), seed=3)
    for seed in range(20):
        for policy in (on_probs, on_logits):
            MirrorUpdate(Mirror(step_size=0.3)).step(policy, STATES, *question(seed))
    torch.testing.assert_close(on_probs.table(), on_logits.table())


def test_the_softmax_update_is_the_gradient_of_the_weighted_mean_value():
    policy = SoftmaxPolicy(7, 4, Softmax(init=Random()), seed=3)
    q_NA, weight_N = question()
    logits_SA = policy.logits_SA.clone().requires_grad_()
    (weight_N * (logits_SA[STATES].softmax(-1) * q_NA).sum(-1)).sum().backward()
    before_SA = policy.logits_SA.clone()
    SoftmaxUpdate(SoftmaxGradient(step_size=0.7)).step(policy, STATES, q_NA, weight_N)
    torch.testing.assert_close(policy.logits_SA - before_SA, 0.7 * logits_SA.grad)


@pytest.mark.parametrize(
    ("update", "kind", "fits"),
    [
        (ProjectedUpdate, SoftmaxPolicy, "SimplexPolicy"),
        (SoftmaxUpdate, SimplexPolicy, "SoftmaxPolicy"),
    ],
)
def test_a_policy_that_an_update_cannot_change_is_refused(update, kind, fits):
    with pytest.raises(PgtsError, match=f"{update.__name__} updates a {fits}, not a {kind.__name__}"):
        update().check(kind(3, 2))


@pytest.mark.parametrize(("update", "kind", "step"), CASES)
def test_a_policy_that_an_update_can_change_is_accepted(update, kind, step):
    policy = kind(3, 2)
    update().check(policy)
    assert isinstance(policy, update().policies)


def moved(update: MirrorUpdate, advantage: list[list[float]], logits: list[list[float]], noise: float = 0.0):
    """By how much the step changes the differences of the logits to the first action."""
    policy = SoftmaxPolicy(len(logits), len(logits[0]))
    policy.load_state_dict({"logits_SA": torch.tensor(logits, dtype=torch.float64)})
    before_SA = policy.logits_SA.clone()
    advantage_NA = torch.tensor(advantage, dtype=torch.float64)
    update(policy, Batch(torch.arange(len(logits)), advantage_NA, torch.ones(len(logits)), noise), generator=None)
    change_SA = policy.logits_SA - before_SA
    return (change_SA - change_SA[:, :1])[:, 1:].tolist()


def test_a_normalised_step_is_in_units_of_the_root_mean_square_under_the_policy():
    # State 0: pi = 1/2, A = -+ 3, mean square 9. State 1: pi = 1/4, 3/4, A = 3, -1, mean square 3. Root mean: sqrt 6.
    logits = [[0.0, 0.0], [0.0, math.log(3)]]
    (first,), (second,) = moved(MirrorUpdate(Mirror(step_size=2.0)), [[3.0, -3.0], [3.0, -1.0]], logits)
    assert first == pytest.approx(-6 * 2 / math.sqrt(6))
    assert second == pytest.approx(-4 * 2 / math.sqrt(6))
    assert first != pytest.approx(-6 * 2 / 3)  # what each state for itself would make of it


@pytest.mark.parametrize(("noise", "size"), [(0.0, 3.0), (2.0, 3.0), (30.0, 30.0)])
def test_noise_that_is_larger_than_the_advantages_makes_the_step_shorter(noise, size):
    ((step,),) = moved(MirrorUpdate(), [[3.0, -3.0]], [[0.0, 0.0]], noise)
    assert step == pytest.approx(-6 / size)


def test_no_probability_of_a_row_that_moves_falls_below_the_floor_and_what_is_below_comes_back():
    update = MirrorUpdate(Mirror(floor=3.0))
    policy = SimplexPolicy(2, 3)
    sure = torch.tensor([[1.0, 0.0, 0.0]] * 2, dtype=torch.float64)
    policy.load_state_dict({"probs_SA": sure})
    advantage_NA = torch.tensor([[0.0, 0.0, 1e-3], [0.0, 0.0, 0.0]], dtype=torch.float64)
    update.step(policy, torch.arange(2), advantage_NA, torch.ones(2))
    assert policy.probs_SA[0].log().tolist() == pytest.approx([-math.log1p(2 * math.exp(-3)) - x for x in (0, 3, 3)])
    assert torch.equal(policy.probs_SA[1], sure[1])
    MirrorUpdate(Mirror(floor="never")).step(policy, torch.arange(2), advantage_NA.flip(0), torch.ones(2))
    assert torch.equal(policy.probs_SA[1], sure[1])  # without a floor a mirror step leaves zeros at zero


def test_an_action_that_is_not_allowed_stays_so():
    policy = SimplexPolicy(1, 3)
    policy.load_state_dict({"probs_SA": torch.tensor([[0.5, 0.5, 0.0]], dtype=torch.float64)})
    advantage_NA = torch.tensor([[1.0, -1.0, -math.inf]], dtype=torch.float64)
    MirrorUpdate()(policy, Batch(torch.arange(1), advantage_NA, torch.ones(1)), generator=None)
    assert policy.probs_SA[0, 2] == 0
    assert policy.probs_SA[0, 0] > policy.probs_SA[0, 1] > 0
