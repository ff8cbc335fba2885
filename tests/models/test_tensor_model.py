"""Vectors as states: numbered like a dictionary would, and searched like any other model."""

import contextlib
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.compiled import torch_only
from pgts_torch.errors import PgtsError
from pgts_torch.models import StateIndex, TensorModel, state_index
from pgts_torch.models.state_index import hash_rows
from pgts_torch.search import Topology, expectimax
from pgts_torch.seeding import sample_keys, stream
from tests.search.models import walk_the_tree

DTYPES = [torch.float32, torch.float64, torch.int64]


class Naive:
    """A dictionary from rows to numbers."""

    def __init__(self) -> None:
        self.numbers: dict[tuple[float, ...], int] = {}

    def number(self, row_ND: Tensor) -> Tensor:
        rows = [tuple(row) for row in row_ND.tolist()]
        return torch.tensor([self.numbers.setdefault(row, len(self.numbers)) for row in rows], dtype=torch.int64)


def whole_rows(count: int, *, seed: int, dtype: torch.dtype, below: int = 9) -> Tensor:
    return torch.randint(-below, below, (count, 2), generator=stream(seed, "rows")).to(dtype)


def real_rows(count: int, seed: int = 0) -> Tensor:
    return torch.rand(count, 2, generator=stream(seed, "rows"), dtype=torch.float64)


@pytest.fixture
def set_hash(monkeypatch):
    return lambda hash: monkeypatch.setattr(state_index, "hash_rows", hash)


@pytest.fixture(params=[False, True], ids=["torch", "compiled"])
def either_way(request):
    """Compiled where numba is installed, and by torch."""
    if request.param:
        pytest.importorskip("numba")
    with contextlib.nullcontext() if request.param else torch_only():
        yield


HASHES = {
    "good": hash_rows,
    "of three values": lambda bits_ND: bits_ND.sum(-1) % 3,
    "constant": lambda bits_ND: torch.full((len(bits_ND),), -1),
}


# StateIndex


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("name", HASHES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_rows_are_numbered_as_a_dictionary_would_whatever_the_hash(name, dtype, set_hash):
    set_hash(HASHES[name])
    ours, naive = StateIndex(2, dtype=dtype), Naive()
    for seed, count in enumerate([1, 0, 40, 3, 700, 90]):
        rows = whole_rows(count, seed=seed, dtype=dtype)
        assert torch.equal(ours.number(rows), naive.number(rows))
        assert len(ours) == len(naive.numbers)
    assert ours.rows(torch.arange(len(ours))).tolist() == [list(row) for row in naive.numbers]


@given(st.lists(st.lists(st.tuples(st.integers(-2, 2), st.integers(-2, 2)), max_size=30), max_size=5))
def test_any_batches_of_rows_are_numbered_as_a_dictionary_would(batches):
    ours, naive = StateIndex(2, dtype=torch.int64), Naive()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(state_index, "hash_rows", HASHES["of three values"])
        for batch in batches:
            rows = torch.tensor(batch, dtype=torch.int64).reshape(-1, 2)
            assert torch.equal(ours.number(rows), naive.number(rows))


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("dtype", DTYPES)
def test_rows_that_differ_in_their_last_bit_alone_are_different(dtype, set_hash):
    one = torch.ones(1, 3, dtype=dtype)
    other = one.clone()
    other[0, 2] += 1 if dtype == torch.int64 else torch.finfo(dtype).eps
    for hash in HASHES.values():
        set_hash(hash)
        ours = StateIndex(3, dtype=dtype)
        assert ours.number(torch.cat([one, other, one])).tolist() == [0, 1, 0]


@pytest.mark.usefixtures("either_way")
def test_large_integers_that_no_float_tells_apart_are_different():
    ours = StateIndex(1, dtype=torch.int64)
    assert ours.number(torch.tensor([[2**60], [2**60 + 1], [-(2**63)], [2**60]])).tolist() == [0, 1, 2, 0]


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_minus_0_equals_0_and_infinities_equal_themselves(dtype):
    rows = torch.tensor([[0.0], [-0.0], [math.inf], [-math.inf], [math.inf], [-0.0]], dtype=dtype)
    assert StateIndex(1, dtype=dtype).number(rows).tolist() == [0, 0, 1, 2, 1, 0]


@pytest.mark.usefixtures("unchecked_shapes")
def test_rows_that_cannot_be_numbered_are_refused_and_named_and_leave_no_trace():
    ours = StateIndex(2, dtype=torch.float64)
    for rows, message in [
        (torch.tensor([[0.0, 1.0], [2.0, math.nan]], dtype=torch.float64), r"row 1 is \[2\.0, nan\]"),
        (torch.zeros(3, 2), r"rows are torch\.float32 \(3, 2\); they must be torch\.float64 \[N, 2\]"),
        (torch.zeros(3, 1, dtype=torch.float64), r"rows are torch\.float64 \(3, 1\)"),
        (torch.zeros(2, dtype=torch.float64), r"rows are torch\.float64 \(2,\)"),
    ]:
        with pytest.raises(PgtsError, match=message):
            ours.number(rows)
        assert len(ours) == 0
    with pytest.raises(PgtsError, match="merge is 'sometimes'"):
        StateIndex(2, dtype=torch.float64, merge="sometimes")


def test_memory_at_most_doubles_and_is_given_back():
    ours = StateIndex(2, dtype=torch.float64, merge=True)
    capacities = []
    for seed in range(40):
        ours.number(real_rows(500, seed))
        capacities.append(ours.capacity)
    assert len(ours) == 20_000 <= capacities[-1] < 40_500
    assert len(set(capacities)) <= 8
    ours.clear()
    assert len(ours) == ours.capacity == 0
    assert ours.number(real_rows(3, 7)).tolist() == [0, 1, 2]


@pytest.mark.usefixtures("either_way")
def test_after_clear_the_memory_of_as_many_rows_is_taken_at_once(monkeypatch):
    ours = StateIndex(2, dtype=torch.float64, merge=True)
    taken = []
    monkeypatch.setattr(ours, "_enter", lambda *given, enter=ours._enter: taken.append(given[1]) or enter(*given))
    grown = []
    for _ in range(2):
        taken.clear()
        capacities = set()
        for seed in range(20):
            ours.number(real_rows(500, seed))
            capacities.add(ours.capacity)
        grown.append((len(taken), len(capacities)))
        ours.clear()
    assert grown[0] > (3, 3)
    assert grown[1] == (1, 1)


def test_a_call_hashes_its_own_rows_and_not_the_whole_table_except_when_that_doubles(set_hash):
    hashed = []

    def hash(bits_ND: Tensor) -> Tensor:
        hashed.append(len(bits_ND))
        return hash_rows(bits_ND)

    set_hash(hash)
    ours = StateIndex(2, dtype=torch.float64, merge=True)
    for seed in range(100):
        ours.number(real_rows(100, seed))
    assert sum(hashed) <= 4 * 10_000
    assert sum(count > 100 for count in hashed) <= 8


# Merging while it pays


@pytest.mark.usefixtures("either_way")
def test_rows_that_do_not_recur_are_no_longer_looked_up_and_rows_that_recur_are_again():
    ours = StateIndex(2, dtype=torch.float64)
    assert ours.merging
    first = real_rows(6_000, 0)
    ours.number(first)
    assert not ours.merging
    unseen = real_rows(2_000, 1)
    number_N = ours.number(unseen)
    again = ours.number(first[:3_000])
    assert 0 < int((again < 6_000).sum()) < 1_000  # the sample, one in 16
    ours.number(first)
    assert ours.merging
    assert torch.equal(ours.number(first), torch.arange(6_000))
    assert torch.equal(ours.number(unseen), number_N)


@pytest.mark.usefixtures("either_way")
def test_rows_that_recur_are_looked_up_for_ever():
    ours, naive = StateIndex(2, dtype=torch.int64), Naive()
    for seed in range(8):
        rows = whole_rows(4_000, seed=seed, dtype=torch.int64, below=40)
        assert torch.equal(ours.number(rows), naive.number(rows))
    assert ours.merging


@pytest.mark.usefixtures("either_way")
def test_whether_merged_or_not_a_number_leads_back_to_its_row():
    recurring = real_rows(3_000, 99)
    for merge in ("auto", True, False):
        ours = StateIndex(2, dtype=torch.float64, merge=merge)
        known = []
        for seed in range(6):
            rows = torch.cat([real_rows(5_000, seed), recurring[: 1_000 * (seed // 2)]])
            known.append((ours.number(rows), rows))
            for number_N, row_ND in known:
                assert torch.equal(ours.rows(number_N), row_ND)
        distinct = len(ours.number(torch.cat([rows for _, rows in known])).unique())
        assert merge is not True or distinct == 32_000
        assert merge is not False or distinct == 36_000


def test_without_merging_every_row_is_new():
    ours = StateIndex(2, dtype=torch.float64, merge=False)
    assert ours.number(torch.zeros(5, 2, dtype=torch.float64)).tolist() == [0, 1, 2, 3, 4]
    assert not ours.merging


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64, torch.int32, torch.int64])
def test_compiled_and_torch_give_the_same_hashes_and_numbers_and_may_take_turns(dtype):
    """Also where lookups are given up and resumed, which hashes decide."""
    pytest.importorskip("numba")
    row_ND = (real_rows(20_000, 1) * 2**12).to(dtype)
    batches = [row_ND[:6_000], row_ND[6_000:9_000], row_ND[:3_000], row_ND[:8_000], row_ND.flip(0), -row_ND[:9_000]]
    compiled, plain, mixed = (StateIndex(2, dtype=dtype) for _ in range(3))
    merging = []
    for i, batch in enumerate(batches):
        number_N = compiled.number(batch)
        with torch_only():
            assert torch.equal(plain.number(batch), number_N)
        with torch_only() if i % 2 else contextlib.nullcontext():
            assert torch.equal(mixed.number(batch), number_N)
        merging.append((compiled.merging, plain.merging, mixed.merging))
    assert all(len(set(each)) == 1 for each in merging)
    assert dtype.itemsize < 4 or {each[0] for each in merging} == {True, False}
    bits_ND = row_ND.view(state_index._BITS.get(dtype, dtype))
    with torch_only():
        plain_N = hash_rows(bits_ND)
    assert torch.equal(hash_rows(bits_ND), plain_N)
    assert len(plain_N.unique()) > 0.9 * len(row_ND.unique(dim=0))


# A model of vectors


class Lattice(TensorModel):
    """A walk in the plane without an edge. To go up where x is 2 ends it; to go left is not allowed where y is 1."""

    def __init__(self, **options: object) -> None:
        super().__init__(2, 3, **{"state_dtype": torch.float64, "dtype": torch.float64} | options)
        self.pairs = 0

    def step(self, state_ND: Tensor, action_N: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        self.pairs += len(state_ND)
        x, y = state_ND.double().unbind(-1)
        reward_N = (torch.sin(3 * x + y) - action_N.double() / 10).to(self.dtype)
        reward_N = reward_N.masked_fill((action_N == 2) & (y == 1), -math.inf)
        ends_N = (action_N == 1) & (x == 2)
        move = torch.tensor([[1, 0], [0, 1], [-1, 0]])[action_N]
        next_ND = state_ND + move.to(state_ND.dtype)
        if next_ND.dtype.is_floating_point:
            next_ND[ends_N | reward_N.isinf()] = math.nan
        return reward_N, torch.full_like(reward_N, 0.9).masked_fill(ends_N, 0.0), next_ND


def lattice(state: tuple[float, float], action: int) -> tuple[float, list[tuple[float, float, tuple[float, float]]]]:
    """The same walk, one step at a time."""
    x, y = state
    reward = -math.inf if action == 2 and y == 1 else math.sin(3 * x + y) - action / 10
    ahead = [(x + 1, y), (x, y + 1), (x - 1, y)][action]
    return reward, [(1.0, 0.0 if action == 1 and x == 2 else 0.9, ahead)]


def height(state_ND: Tensor) -> Tensor:
    x, y = state_ND.double().unbind(-1)
    return torch.cos(x) + 0.3 * y


def height_of(state: tuple[float, float]) -> float:
    return math.cos(state[0]) + 0.3 * state[1]


STARTS = [(0, 0), (1, 1), (2, -3), (0, 0), (50, 1)]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("merge", ["auto", True, False])
def test_a_search_over_vectors_sees_what_the_tree_sees_however_they_are_merged(dtype, merge):
    for depth in (0, 3):
        model = Lattice(state_dtype=dtype, merge=merge)
        roots = model.number(torch.tensor(STARTS).to(dtype))
        look = expectimax(model, roots, depth=depth, v_leaf=lambda s, model=model: height(model.states(s)))
        expected = [walk_the_tree(lattice, start, depth, height_of, 3) for start in STARTS]
        torch.testing.assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-12)
        assert (len(roots.unique()) == 5) == (merge is False)


def test_each_pair_is_queried_once_and_states_that_are_reached_on_several_paths_are_one():
    model = Lattice()
    topology, roots = Topology(model), model.number(torch.tensor([[9.0, 9.0]], dtype=torch.float64))
    for depth in (3, 5, 5):
        look = expectimax(model, roots, depth=depth, v_leaf=lambda s: height(model.states(s)), topology=topology)
    # Level k of three moves right, up and left holds the (k + 1) (k + 2) / 2 sums of k moves.
    assert look.nodes_per_level == tuple((k + 1) * (k + 2) // 2 for k in range(7))
    assert topology.table.model_calls == model.pairs
    separate = Lattice(merge=False)
    roots = separate.number(torch.tensor([[9.0, 9.0]], dtype=torch.float64))
    look = expectimax(separate, roots, depth=3, v_leaf=lambda s: height(separate.states(s)))
    assert look.nodes_per_level == (1, 3, 9, 27, 81)


def test_what_follows_where_nothing_counts_needs_no_number():
    model = Lattice()
    state_N = model.number(torch.tensor([[2.0, 1.0]], dtype=torch.float64))
    answer = model.outcomes(state_N)
    assert answer.child_NAK[0, :, 0].tolist() == [1, 0, 0]
    assert answer.discount_NAK[0, :, 0].tolist() == [0.9, 0.0, 0.9]
    assert answer.reward_NA[0, 2] == -math.inf
    assert model.num_states == answer.num_children == 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_sampled_outcome_is_the_enumerated_one_in_the_dtype_of_the_model_whatever_the_key(dtype):
    model = Lattice(dtype=dtype)
    state_N = model.number(torch.tensor(STARTS, dtype=torch.float64)).repeat_interleave(3)
    action_N = torch.arange(3).repeat(len(STARTS))
    answer = model.outcomes(state_N[::3])
    for seed in (0, 1):
        sampled = model.sample(state_N, action_N, key_N=sample_keys(len(state_N), generator=stream(seed, "keys")))
        assert torch.equal(sampled.reward_N, answer.reward_NA.reshape(-1))
        assert torch.equal(sampled.discount_N, answer.discount_NAK.reshape(-1))
        assert torch.equal(sampled.next_state_N, answer.child_NAK.reshape(-1))
        assert sampled.reward_N.dtype == sampled.discount_N.dtype == answer.prob_NAK.dtype == dtype


def test_after_clear_numbers_start_again_and_an_old_topology_refuses_to_go_on():
    model = Lattice()
    topology = Topology(model)
    starts = torch.tensor(STARTS[:3], dtype=torch.float64)

    def look(topology: Topology) -> Tensor:
        roots = model.number(starts)
        return expectimax(model, roots, depth=3, v_leaf=lambda s: height(model.states(s)), topology=topology).q_BA

    before = look(topology)
    model.clear()
    assert model.num_states == 0
    model.number(torch.arange(1_000, dtype=torch.float64).view(-1, 2))  # more than there were: counting would not tell
    for _ in range(2):
        with pytest.raises(PgtsError, match=r"has been reset .*make a new topology"):
            look(topology)
    assert torch.equal(look(Topology(model)), before)


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_step_with_a_wrong_answer_is_refused_and_named():
    class Narrow(Lattice):
        def step(self, state_ND: Tensor, action_N: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            return (*super().step(state_ND, action_N)[:2], state_ND[:, :1])

    class Lost(Lattice):
        def step(self, state_ND: Tensor, action_N: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            return (*super().step(state_ND, action_N)[:2], state_ND / 0)

    class Rough(Lattice):
        def step(self, state_ND: Tensor, action_N: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            reward_N, discount_N, next_ND = super().step(state_ND, action_N)
            return reward_N, discount_N.float(), next_ND

    for model, message in [
        (
            Rough(),
            r"rewards in torch\.float64 and discounts in torch\.float32; the dtype of the model is torch\.float64",
        ),
        (Narrow(), r"step returned shapes .*\(3, 1\)\); for 3 states and actions they must be .*\(3, 2\)"),
        (Lost(), r"step leads from state \[0\.0, 4\.0\] by action 0 to \[nan, inf\]"),
    ]:
        state_N = model.number(torch.tensor([[0.0, 4.0]], dtype=torch.float64))
        with pytest.raises(PgtsError, match=message):
            model.outcomes(state_N)


def test_a_search_in_inference_mode_leaves_a_model_that_serves_outside():
    model = Lattice()
    with torch.inference_mode():
        roots = model.number(torch.tensor(STARTS, dtype=torch.float64))
        expectimax(model, roots, depth=2, v_leaf=lambda s: height(model.states(s)))
    model.number(torch.tensor(STARTS, dtype=torch.float64))
    assert not model.states(torch.arange(2)).is_inference()


def test_the_sample_of_rows_is_chosen_by_the_hash_so_that_equal_rows_are_both_in_it_or_neither():
    bits = torch.arange(20_000).view(-1, 2)
    top = hash_rows(bits) >> 60
    share = float((top == 0).double().mean())
    assert abs(share - 1 / 16) < 5 * math.sqrt(1 / 16 * 15 / 16 / 10_000)  # 5 sigma: one seed in 1.7 million would fail
