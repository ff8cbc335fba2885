"""Outcomes and the one Bellman kernel."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import TypeCheckError
from torch import Tensor

from pgts_torch import compiled
from pgts_torch.bellman import Outcomes, back_up_steps, backup, policy_mean, sweep
from pgts_torch.seeding import stream
from tests.support import ZOO, mdps, weights, zoo


def outcomes_with(*, prob: list[float], discount: list[float], child: list[int], reward: float = 0.0) -> Outcomes:
    """One state with one action."""
    return Outcomes(
        torch.tensor([[reward]], dtype=torch.float64),
        torch.tensor([[prob]], dtype=torch.float64),
        torch.tensor([[discount]], dtype=torch.float64),
        torch.tensor([[child]]),
        max(child) + 1,
    )


def backup_by_loop(outcomes: Outcomes, v_C: Tensor) -> Tensor:
    q_NA = outcomes.reward_NA.clone()
    for n, a, k in itertools.product(*map(range, outcomes.child_NAK.shape)):
        child = outcomes.child_NAK[n, a, k]
        q_NA[n, a] += outcomes.prob_NAK[n, a, k] * outcomes.discount_NAK[n, a, k] * v_C[child]
    return q_NA


@given(mdps(), st.integers(0, 1000))
def test_backup_is_reward_plus_the_discounted_mean_of_the_children(mdp, seed):
    v_S = torch.randn(mdp.num_states, dtype=torch.float64, generator=stream(seed, "v"))
    torch.testing.assert_close(backup(mdp.outcomes, v_S), backup_by_loop(mdp.outcomes, v_S), rtol=1e-13, atol=1e-13)


# Compiled and in torch: one contract


FORMS = ["compiled", "torch"]


@pytest.fixture(params=FORMS)
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Every backup compiled, however small; or none."""
    if request.param == "torch":
        with compiled.torch_only():
            yield request.param
    else:
        pytest.importorskip("numba")
        monkeypatch.setattr("pgts_torch.bellman.COMPILED_FROM", 1)
        yield request.param


def some_outcomes(N: int, A: int, K: int, dtype: torch.dtype = torch.float64, unit: float = 1.0) -> Outcomes:
    """Some actions are not allowed, and some outcomes end."""
    generator = stream(N * A * K, "some_outcomes")
    prob_NAK = torch.rand(N, A, K, dtype=torch.float64, generator=generator)
    reward_NA = unit * torch.randn(N, A, dtype=torch.float64, generator=generator)
    reward_NA[::3, 0] = -torch.inf
    discount_NAK = torch.where(torch.rand(N, A, K, generator=generator) < 0.2, 0.0, 0.9).double()
    child_NAK = torch.randint(N, (N, A, K), generator=generator)
    prob_NAK = prob_NAK / prob_NAK.sum(-1, keepdim=True)
    return Outcomes(reward_NA, prob_NAK, discount_NAK, child_NAK, N).to(dtype=dtype)


SHAPES = [(1, 2, 1), (9, 4, 1), (7, 2, 2), (50, 3, 3), (20, 4, 4), (30, 4, 5), (11, 2, 7), (10, 3, 8), (13, 2, 13)]


@pytest.mark.parametrize("shape", [*SHAPES, (90_000, 3, 2)])
@pytest.mark.parametrize("times", [0, 1, 2, 5])
def test_sweeps_are_repeated_backups_by_hand(shape, times, form):
    outcomes = some_outcomes(*shape)
    assert outcomes.is_compiled == (form == "compiled")
    given_S = v_S = torch.randn(shape[0], dtype=torch.float64, generator=stream(0, "v"))
    before_S = given_S.clone()
    for _ in range(times):
        weight_NAK = outcomes.prob_NAK * outcomes.discount_NAK
        q_NA = outcomes.reward_NA + (weight_NAK * v_S[outcomes.child_NAK]).sum(-1)
        torch.testing.assert_close(backup(outcomes, v_S), q_NA, rtol=1e-12, atol=1e-12)
        v_S = q_NA.amax(-1)
    swept_S = sweep(outcomes, given_S, times)
    torch.testing.assert_close(swept_S, v_S, rtol=1e-12, atol=1e-12)
    assert torch.equal(given_S, before_S)
    assert swept_S.data_ptr() != given_S.data_ptr()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_compiled_backups_are_those_of_torch(shape, unit, dtype, monkeypatch):
    pytest.importorskip("numba")
    outcomes = some_outcomes(*shape, dtype=dtype, unit=unit)
    v_S = unit * torch.randn(shape[0], dtype=dtype, generator=stream(0, "v"))
    with compiled.torch_only():
        expected = backup(outcomes, v_S), sweep(outcomes, v_S, 6)
    monkeypatch.setattr("pgts_torch.bellman.COMPILED_FROM", 1)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    for got, wanted in zip((backup(outcomes, v_S), sweep(outcomes, v_S, 6)), expected, strict=True):
        torch.testing.assert_close(got, wanted, rtol=tolerance, atol=tolerance * unit)
        assert dtype == torch.float32 or torch.equal(got, wanted)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_backup_of_some_rows_is_that_of_all_bit_for_bit(shape, form):
    outcomes = some_outcomes(*shape)
    v_S = torch.randn(shape[0], dtype=torch.float64, generator=stream(0, "v"))
    q_NA = backup(outcomes, v_S)
    for row_N in torch.randperm(shape[0], generator=stream(1, "rows")).split(3):
        assert torch.equal(backup(outcomes.rows(row_N), v_S), q_NA[row_N])


@pytest.mark.parametrize("apart", [1000, 140_000])
def test_values_are_fetched_ahead_where_children_are_scattered_and_no_value_depends_on_it(apart):
    kernels = pytest.importorskip("pgts_torch.bellman_kernels", exc_type=ImportError)
    few = some_outcomes(200_000, 2, 5)
    near_N = torch.arange(200_000)[:, None, None] + few.child_NAK % apart - apart // 2
    outcomes = Outcomes(few.reward_NA, few.prob_NAK, few.discount_NAK, near_N.clamp(0, 199_999), 200_000)
    v_S = torch.randn(200_000, dtype=torch.float64, generator=stream(0, "v"))
    assert kernels.is_scattered(outcomes.arrays[2], 10, v_S.numpy()) == (apart > 1000)
    assert not kernels.is_scattered(outcomes.arrays[2], 10, v_S.numpy()[:1000])  # a cache holds them all
    with compiled.torch_only():
        expected = sweep(outcomes, v_S, 2)
    torch.testing.assert_close(sweep(outcomes, v_S, 2), expected, rtol=1e-12, atol=1e-12)


def test_what_is_not_a_number_comes_out_as_that(form):
    outcomes = some_outcomes(20, 3, 2)
    v_S = torch.zeros(20, dtype=torch.float64)
    v_S[4] = torch.nan
    meets_S = (outcomes.child_NAK == 4).any(-1).any(-1)
    assert torch.equal(sweep(outcomes, v_S, 1).isnan(), meets_S)
    assert 0 < int(meets_S.sum()) < 20


def test_small_tables_stay_with_torch_unless_the_loops_are_loaded(monkeypatch):
    outcomes = zoo("ladder").outcomes
    monkeypatch.setattr("pgts_torch.bellman._KERNELS", "as if not loaded")
    assert not outcomes.is_compiled
    monkeypatch.setattr("pgts_torch.bellman._KERNELS", "torch")
    assert outcomes.is_compiled == compiled.can_compile(torch.device("cpu"))


@pytest.mark.parametrize("K", [2, 5])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, None])
def test_steps_are_backups_one_above_the_other_and_say_before_that_values_are_not_finite(K, bad, form):
    closed, step, top = (some_outcomes(N, 3, K) for N in (12, 12, 7))
    top = replace(top, child_NAK=top.child_NAK + 5, num_children=12)
    v_S = torch.randn(12, dtype=torch.float64, generator=stream(0, "v"))
    if bad is not None:
        v_S[3] = bad
    calls = []
    q_NA = back_up_steps(((closed, 2), (step, 1), (top, 1)), v_S, lambda: calls.append(v_S))
    expected = backup(top, sweep(step, sweep(closed, v_S, 2), 1))
    torch.testing.assert_close(q_NA, expected, rtol=0, atol=0, equal_nan=True)
    assert len(calls) == (bad is not None or form == "torch")


@pytest.mark.parametrize("v_S", [torch.ones(6, dtype=torch.float64), torch.ones(5), torch.ones(0).double()])
def test_backup_refuses_values_of_another_length_or_dtype(v_S, form):
    for values in (backup, lambda outcomes, v_S: sweep(outcomes, v_S, 2)):
        with pytest.raises(RuntimeError, match=r"v has size \d and dtype"):
            values(zoo("ladder").outcomes, v_S)


def test_sweeps_of_given_actions_are_backups_of_these_actions(form):
    outcomes, v_S = zoo("garnet").outcomes, torch.arange(30, dtype=torch.float64)
    action_S = torch.arange(30) % 3
    taken_S, best_S = (sweep(outcomes, v_S, 2, actions) for actions in (action_S, None))
    for _ in range(2):
        v_S = backup(outcomes, v_S)[torch.arange(30), action_S]
    assert torch.equal(taken_S, v_S)
    assert not torch.equal(best_S, v_S)


def test_backup_of_a_hand_made_row_is_the_sum_on_paper():
    outcomes = outcomes_with(reward=2.0, prob=[0.5, 0.25, 0.25], discount=[0.9, 0.5, 0.0], child=[1, 0, 2])
    q = backup(outcomes, torch.tensor([8.0, 10.0, 1e9], dtype=torch.float64))
    assert q.item() == pytest.approx(2 + 0.5 * 0.9 * 10 + 0.25 * 0.5 * 8, rel=1e-15)


def test_backup_leaves_the_rewards_as_they_are():
    outcomes = zoo("garnet").outcomes
    before, v_S = outcomes.reward_NA.clone(), torch.ones(30, dtype=torch.float64)
    first = backup(outcomes, v_S)
    assert torch.equal(backup(outcomes, v_S), first)
    assert torch.equal(outcomes.reward_NA, before)


def test_backup_carries_no_gradient():
    v_S = torch.ones(5, dtype=torch.float64, requires_grad=True)
    assert not backup(zoo("ladder").outcomes, v_S).requires_grad


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_backup_answers_in_the_dtype_of_the_outcomes(dtype):
    outcomes = zoo("garnet").outcomes.to(dtype=dtype)
    q_SA = backup(outcomes, torch.ones(30, dtype=dtype))
    assert outcomes.dtype == q_SA.dtype == dtype
    tolerance = 1e-6 if dtype == torch.float32 else 1e-15
    torch.testing.assert_close(q_SA.double(), zoo("garnet").outcomes.reward_NA + 0.9, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("name", [name for name in ZOO if name != "Taxi"])
def test_the_weight_matrix_holds_p_times_gamma(name):
    mdp = zoo(name)
    dense = torch.from_numpy(weights(mdp)).flatten(0, 1)
    torch.testing.assert_close(mdp.outcomes.weight.to_dense(), dense, rtol=1e-15, atol=1e-15)


def test_the_weight_matrix_has_narrow_indices():
    weight = zoo("garnet").outcomes.weight
    assert weight.crow_indices().dtype == weight.col_indices().dtype == torch.int32


def test_rows_are_the_given_states_in_the_given_order():
    outcomes, v_S = zoo("garnet").outcomes, torch.arange(30, dtype=torch.float64)
    row_N = torch.tensor([7, 3, 7, 0])
    picked = outcomes.rows(row_N)
    assert (picked.num_states, picked.num_actions, picked.num_outcomes, picked.num_children) == (4, 3, 4, 30)
    assert torch.equal(backup(picked, v_S), backup(outcomes, v_S)[row_N])
    assert not torch.equal(backup(outcomes.rows(row_N.sort().values), v_S), backup(picked, v_S))


def test_one_discount_for_all_outcomes_takes_no_memory():
    assert zoo("garnet").outcomes.discount_NAK.untyped_storage().nbytes() == 8


def test_the_tests_check_the_shapes_that_signatures_promise():
    row = outcomes_with(prob=[1.0], discount=[1.0], child=[0])
    with pytest.raises(TypeCheckError):
        Outcomes(row.reward_NA, row.prob_NAK.repeat(2, 1, 1), row.discount_NAK, row.child_NAK, 1)
    with pytest.raises(TypeCheckError):
        backup(row, torch.ones(1, 1, dtype=torch.float64))


def test_actions_that_a_policy_never_takes_do_not_count_whatever_they_are_worth():
    pi_NA = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.0, 1.0], [0.5, 0.0, 0.5]], dtype=torch.float64)
    q_NA = torch.tensor([[4.0, 8.0, -torch.inf], [-torch.inf, 1.0, -3.0], [2.0, 7.0, -torch.inf]], dtype=torch.float64)
    assert policy_mean(pi_NA, q_NA).tolist() == [7.0, -3.0, -torch.inf]
