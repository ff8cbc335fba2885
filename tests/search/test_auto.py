"""How the automatic search goes from one width, or number of samples, to the next: searches of stated sizes."""

from collections.abc import Callable
from typing import Any

import gymnasium
import pytest
import torch
from torch import Tensor

from pgts_torch.errors import NodeBudgetExceeded, PgtsError
from pgts_torch.models.classic import CartPole
from pgts_torch.models.tabular import TabularModel
from pgts_torch.options import Auto, Sampled
from pgts_torch.search import Lookahead, auto
from pgts_torch.search.auto import AutoSearch
from pgts_torch.seeding import stream
from tests.search.test_engine import EnumeratingOnly, SamplingOnly
from tests.support import zoo

TOO_LARGE = 10**9


def found(nodes: int, root_B: Tensor) -> Lookahead:
    """What a search of so many nodes gives that has pruned some."""
    q_BA = torch.zeros(len(root_B), 2, dtype=torch.float64)
    return Lookahead(q_BA, q_BA, q_BA + 1, model_calls=0, critic_calls=1, nodes_per_level=(nodes,))


def search_once(search: AutoSearch, roots: int = 1, depth: int = 1) -> None:
    """One search whose leaves are valued by v: depth + 1 levels are expanded."""
    search(torch.zeros(roots, dtype=torch.int64), depth=depth, v_leaf=torch.zeros_like, generator=stream(0, "search"))


@pytest.fixture
def widths(monkeypatch) -> Callable[[Callable[[int], int]], list[int | None]]:
    """Puts a search whose nodes are a function of its width in the place of expectimax; the widths that are tried."""

    def replace(nodes_of: Callable[[int], int]) -> list[int | None]:
        tried: list[int | None] = []

        def search(_: Any, __: Any, root_B: Tensor, *, max_nodes: int, max_width: int | None = None) -> Lookahead:
            tried.append(max_width)
            nodes = TOO_LARGE if max_width is None else nodes_of(max_width)
            if nodes > max_nodes:
                raise NodeBudgetExceeded(f"it has {nodes} nodes")
            return found(nodes, root_B)

        monkeypatch.setattr(auto, "search_levels", search)
        return tried

    return replace


def tries(tried: list[int | None], search: AutoSearch, **larger: int) -> list[int | None]:
    """The widths that one search tries."""
    before = len(tried)
    search_once(search, **larger)
    return tried[before:]


def test_a_width_is_halved_until_the_search_fits(widths):
    search, tried = AutoSearch(EnumeratingOnly(zoo("ladder")), Auto(max_nodes=300)), widths(lambda width: 6 * width)
    assert tries(tried, search) == [None, 300, 150, 75, 37]
    assert "37 states a level" in str(search)


@pytest.mark.parametrize(("nodes", "following"), [(150, 74), (151, 37)])
def test_the_width_is_doubled_where_twice_as_many_nodes_would_fit(nodes, following, widths):
    tried = widths(lambda width: nodes if width <= 37 else TOO_LARGE)
    search = AutoSearch(EnumeratingOnly(zoo("ladder")), Auto(max_nodes=300))
    assert tries(tried, search)[-1] == 37
    assert tries(tried, search)[0] == following


@pytest.mark.parametrize(("fits", "max_nodes", "following"), [(150, 300, 300), (300, 300, 300), (149, 299, 298)])
def test_a_width_is_never_more_than_the_nodes_of_a_search(fits, max_nodes, following, widths):
    tried = widths(lambda width: 10 if width <= fits else TOO_LARGE)
    search = AutoSearch(EnumeratingOnly(zoo("ladder")), Auto(max_nodes=max_nodes))
    assert tries(tried, search)[-1] == fits
    assert tries(tried, search)[0] == following


@pytest.mark.parametrize(
    ("roots", "depth", "again"),
    [(3, 3, False), (4, 3, False), (3, 4, False), (2, 3, True), (3, 2, True), (2, 9, True), (9, 2, True)],
)
def test_full_width_is_tried_again_for_fewer_roots_or_levels_only(roots, depth, again, widths):
    tried = widths(lambda width: width)
    search = AutoSearch(EnumeratingOnly(zoo("ladder")), Auto(max_nodes=300))
    assert tries(tried, search, roots=3, depth=3)[0] is None
    assert (tries(tried, search, roots=roots, depth=depth)[0] is None) == again


@pytest.fixture
def samples(monkeypatch) -> Callable[[Callable[[int], int]], list[int]]:
    """Puts a search whose nodes are a function of its samples in the place of `SampledSearch`; those that are tried."""

    def replace(nodes_of: Callable[[int], int]) -> list[int]:
        tried: list[int] = []

        class Stated:
            def __init__(self, model: Any, options: Sampled) -> None:
                tried.append(options.samples)
                self.nodes, self.max_nodes = nodes_of(options.samples), options.max_nodes

            def look_ahead(self, _: Any, root_B: Tensor, __: Any) -> Lookahead:
                if self.nodes > self.max_nodes:
                    raise NodeBudgetExceeded(f"it has {self.nodes} nodes")
                return found(self.nodes, root_B)

        monkeypatch.setattr(auto, "SampledSearch", Stated)
        return tried

    return replace


@pytest.mark.parametrize(("max_nodes", "first"), [(20, 1), (21, 2), (72, 2), (73, 4), (10**9, 32)])
def test_the_first_number_of_samples_fits_even_if_no_two_paths_meet(max_nodes, first, samples):
    # 2 actions, 2 levels below the root: 1 + 2 C + 4 C^2 nodes, 21 for C = 2 and 73 for C = 4.
    tried = samples(lambda C: 10)
    search_once(AutoSearch(SamplingOnly(zoo("ladder")), Auto(max_nodes=max_nodes)))
    assert tried == [first]


@pytest.mark.parametrize(("nodes", "following"), [(15, 4), (16, 2)])
def test_samples_are_doubled_where_paths_met_so_often_that_twice_as_many_would_fit(nodes, following, samples):
    # Twice as many samples have at most 4 times as many nodes on 2 levels: 60 and 64 of 60.
    tried = samples(lambda C: nodes)
    search = AutoSearch(SamplingOnly(zoo("ladder")), Auto(max_nodes=60))
    search_once(search)
    search_once(search)
    assert tried == [2, following]


def test_samples_are_never_more_than_32(samples):
    tried = samples(lambda C: 1)
    search = AutoSearch(SamplingOnly(zoo("ladder")), Auto(max_nodes=60))
    for _ in range(7):
        search_once(search)
    assert tried == [2, 4, 8, 16, 32, 32, 32]


@pytest.mark.parametrize(("roots", "depth", "again"), [(2, 2, False), (1, 1, False), (3, 2, True), (2, 3, True)])
def test_a_search_of_more_roots_or_of_more_levels_chooses_its_samples_again(roots, depth, again, samples):
    tried = samples(lambda C: 1)
    search = AutoSearch(SamplingOnly(zoo("ladder")), Auto(max_nodes=200))
    for _ in range(3):
        search_once(search, roots=2, depth=2)
    assert tried == [2, 4, 8]
    search_once(search, roots=roots, depth=depth)
    assert (tried[-1] < 8) == again


def test_a_sampled_search_that_turns_out_too_large_is_done_again_with_half(samples):
    tried = samples(lambda C: 10 * C)
    search = AutoSearch(SamplingOnly(zoo("ladder")), Auto(max_nodes=300))
    search_once(search)  # 8 samples have 273 nodes if no two paths meet
    assert tried == [8]
    tried.clear()
    state = search.state_dict(with_states=False)
    search.load_state_dict(state | {"choices": state["choices"] | {"_samples": 32}})
    search_once(search)
    assert tried == [32, 16]


def cart_pole() -> tuple[CartPole, Tensor]:
    model = CartPole(gymnasium.make("CartPole-v1"), gamma=0.99)
    generator = stream(0, "cart_pole")
    return model, model.number(0.05 * torch.randn(10, 4, dtype=model.state_dtype, generator=generator))


@pytest.mark.parametrize("max_calls", [32, 33, 90, 200, 1000])
def test_a_search_makes_no_more_model_calls_than_allowed_and_leaves_few_unused(max_calls):
    model, root_B = cart_pole()
    search = AutoSearch(model, Auto(max_calls=max_calls))
    look = search(root_B, depth=6, v_leaf=lambda state_N: model.states(state_N)[:, 2], generator=stream(0, "search"))
    assert min(max_calls - 2 * 6, 786) <= look.model_calls <= max_calls  # upper levels of 1000 are narrower
    assert float(look.pruned_BA.max()) > 0
    assert f"expectimax, {(max_calls // 2 - 10) // 6} states a level" in str(search)


def test_with_enough_calls_nothing_is_pruned_and_a_table_that_fits_is_searched_at_full_width():
    model, root_B = cart_pole()
    looks = []
    for max_calls in (None, 10**6):
        search = AutoSearch(model, Auto(max_calls=max_calls))
        looks.append(search(root_B, depth=3, v_leaf=torch.zeros_like, generator=stream(0, "search")))
    assert torch.equal(looks[0].q_BA, looks[1].q_BA)
    assert looks[0].model_calls == looks[1].model_calls == 10 * 2 * (1 + 2 + 4 + 8)
    search = AutoSearch(TabularModel(zoo("ladder")), Auto(max_calls=10))
    look = search(torch.tensor([0]), depth=50, v_leaf=torch.zeros_like, generator=stream(0, "search"))
    assert "hold all paths" in str(search)
    assert look.model_calls <= 10


def test_too_few_calls_are_refused_with_what_a_search_needs_at_least():
    model, root_B = cart_pole()
    search = AutoSearch(model, Auto(max_calls=31))
    with pytest.raises(
        PgtsError, match=r"max_calls is 31; 10 states under 2 actions, .* each of 6 levels, need 32: visit"
    ):
        search(root_B, depth=6, v_leaf=torch.zeros_like, generator=stream(0, "search"))
    assert search.model_calls == 0


@pytest.mark.parametrize(("max_calls", "first"), [(6, 1), (19, 1), (20, 2), (72, 4)])
def test_samples_are_as_many_as_the_calls_allow(max_calls, first, samples):
    # 2 actions, 2 levels: 2 C + 4 C^2 calls if no two paths meet, 6, 20 and 72 for C = 1, 2 and 4.
    tried = samples(lambda C: 10)
    search_once(AutoSearch(SamplingOnly(zoo("ladder")), Auto(max_calls=max_calls)))
    assert tried == [first]


def test_fewer_calls_than_one_sample_of_each_action_are_refused():
    with pytest.raises(PgtsError, match="max_calls is 5; one sample of each of 2 actions, 2 levels below 1 states"):
        search_once(AutoSearch(SamplingOnly(zoo("ladder")), Auto(max_calls=5)))
