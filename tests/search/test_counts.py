"""How many tensor operations a search over known states takes where nothing is compiled, as on a GPU, and that the host
reads nothing in it."""

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from pgts_torch import bellman
from pgts_torch.bellman import back_up_steps, sweep
from pgts_torch.compiled import torch_only
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models import TabularModel
from pgts_torch.readings import Readings
from pgts_torch.search import Lookahead, Topology, expectimax
from pgts_torch.search.engine import ExpectimaxSearch
from pgts_torch.seeding import stream
from pgts_torch.tabular import deep_sea, exact, random_mdp
from tests.counting import Counting
from tests.search.models import assert_close

MDPS = {
    "all states are roots": (random_mdp(20, 3, gamma=0.9), torch.arange(20)),
    "one root below which all states close": (random_mdp(200, 3, gamma=0.9), torch.tensor([5])),
    "no closed set": (deep_sea(12), torch.tensor([0])),
    "repeated roots": (random_mdp(20, 3, gamma=0.9), torch.tensor([3, 3, 1])),
}
DEPTHS = (1, 2, 4, 8)


@pytest.fixture(autouse=True)
def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(bellman, "sums_in_order", lambda device, size: False)
    with torch_only():
        yield


def at_most(depth: int) -> int:
    """Operations of a search: a product and a maximum a level, the critic, the checks and the rows of the roots."""
    return 6 + 2 * (depth + 1)


def warm(name: str, leaf: str, depth: int) -> tuple[Callable[..., Lookahead], Tensor]:
    """A search with new leaf values over states that an earlier one has met; and what it must find."""
    mdp, roots = MDPS[name]
    model = TabularModel(mdp)
    topology = Topology(model)
    shape = (mdp.num_states,) if leaf == "v" else (mdp.num_states, mdp.num_actions)
    old, new = (torch.randn(shape, dtype=torch.float64, generator=stream(seed, "leaf")) for seed in range(2))
    expectimax(model, roots, depth=depth, topology=topology, **{f"{leaf}_leaf": old.__getitem__})
    q_SA = new if leaf == "q" else back_up_steps(((mdp.outcomes, 1),), new)

    def search(**more) -> Lookahead:
        return expectimax(model, roots, depth=depth, topology=topology, **{f"{leaf}_leaf": new.__getitem__}, **more)

    return search, exact.lookahead(mdp, q_SA, depth)[roots]


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("leaf", ["v", "q"])
@pytest.mark.parametrize("name", MDPS)
def test_a_search_over_known_states_takes_two_operations_a_level_and_reads_nothing(name, leaf, depth):
    search, truth_BA = warm(name, leaf, depth)
    readings = Readings()
    with Counting() as counts:
        look = search(readings=readings)
    assert counts.reads == {}
    assert counts.num_operations <= at_most(depth)
    assert look.model_calls == 0
    assert_close(look.q_BA, truth_BA)
    with Counting() as counts:
        readings.read()
    assert counts.reads == {"tolist": 1}


def test_a_search_that_makes_its_checks_at_once_reads_and_one_with_a_third_operation_a_level_is_too_dear(monkeypatch):
    search, _ = warm("no closed set", "v", 8)
    with Counting() as counts:
        search()
    assert counts.num_reads > 0

    def in_two_steps(reward: Tensor, weight: Tensor, v_C: Tensor) -> Tensor:
        return torch.mv(weight, v_C).add_(reward)

    monkeypatch.setattr(torch, "addmv", in_two_steps)
    with Counting() as counts:
        search(readings=Readings())
    assert counts.num_operations > at_most(8)


@pytest.mark.parametrize("depth", DEPTHS)
def test_a_search_object_reads_nothing_either(depth):
    mdp, roots = MDPS["no closed set"]
    search, v_S = ExpectimaxSearch(TabularModel(mdp)), torch.zeros(mdp.num_states, dtype=torch.float64)
    for warmed in (False, True):
        readings = Readings()
        with Counting() as counts:
            search(roots, depth=depth, v_leaf=v_S.__getitem__, generator=stream(0, "search"), readings=readings)
        assert (counts.num_reads == 0) == warmed
        readings.read()
    assert counts.num_operations <= at_most(depth)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_leaf_values_that_are_not_finite_are_refused_when_the_numbers_are_read(bad):
    mdp, roots = MDPS["one root below which all states close"]
    v_S, readings = torch.zeros(mdp.num_states, dtype=torch.float64), Readings()
    v_S[7] = bad
    expectimax(TabularModel(mdp), roots, depth=9, v_leaf=v_S.__getitem__, readings=readings)
    with pytest.raises(NotFinite, match=f"the critic's value of state 7 is {bad}"):
        readings.read()


def test_roots_that_were_written_to_in_their_tensor_are_noticed():
    mdp, _ = MDPS["repeated roots"]
    model, roots, readings = TabularModel(mdp), torch.tensor([3, 3, 1]), Readings()
    topology, v_S = Topology(model), torch.randn(20, dtype=torch.float64, generator=stream(0, "leaf"))
    arguments = {"depth": 2, "v_leaf": v_S.__getitem__, "topology": topology}
    expectimax(model, roots, readings=readings, **arguments)
    roots.numpy()[0] = 5  # of which torch knows nothing
    expectimax(model, roots, readings=readings, **arguments)
    with pytest.raises(PgtsError, match="the tensor of the roots has been written to since an earlier search"):
        readings.read()
    fresh = expectimax(model, roots.clone(), depth=2, v_leaf=v_S.__getitem__)
    assert torch.equal(expectimax(model, roots, **arguments).q_BA, fresh.q_BA)
    readings.read()


@pytest.mark.parametrize("times", [0, 1, 2, 8])
def test_a_sweep_takes_two_operations_and_a_backup_one(times):
    mdp, _ = MDPS["all states are roots"]
    v_S = torch.zeros(mdp.num_states, dtype=torch.float64)
    mdp.outcomes.weight  # noqa: B018 - made once
    with Counting() as swept:
        sweep(mdp.outcomes, v_S, times)
    with Counting() as backed_up:
        back_up_steps(((mdp.outcomes, times + 1),), v_S)
    assert swept.num_operations == max(1, 2 * times)
    assert backed_up.num_operations == 2 * times + 1
    assert swept.num_reads == backed_up.num_reads == 0
