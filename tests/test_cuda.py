"""What runs on a GPU, where there is one: the answers of the CPU, without reads by the host where none are promised."""

import copy
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import product

import pytest
import torch
from torch import Tensor

from benchmarks import checksums
from pgts_torch import PGTS, evaluate
from pgts_torch.bellman import Outcomes, backup, sweep
from pgts_torch.config import load
from pgts_torch.experiment.run import build
from pgts_torch.models import TabularModel
from pgts_torch.options import MCTS
from pgts_torch.readings import Readings
from pgts_torch.search import Lookahead, Topology, expectimax, mcts
from pgts_torch.search.fixed_trees import FixedTrees
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, deep_sea, random_mdp
from tests.search.models import some_v
from tests.support import ZOO, random_policy, zoo

GPU = torch.device("cuda")

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


@contextmanager
def nothing_read() -> Iterator[None]:
    """A read by the host, which waits for the GPU, is an error."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Synchronization debug mode is a prototype")
        torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_a_read_within_is_an_error():
    number = torch.ones((), device=GPU)
    with nothing_read(), pytest.raises(RuntimeError, match="synchroniz"):
        float(number)


SEARCHES: dict[str, Callable[..., Lookahead]] = {
    "expectimax": expectimax,
    "pruned": lambda *args, **more: expectimax(*args, max_width=3, **more),
    "mcts, one by one": lambda *args, **more: mcts(*args, simulations=24, wave=1, **more),
    "mcts, in waves": lambda *args, **more: mcts(*args, simulations=24, wave=8, **more),
    "mcts, merged": lambda *args, **more: mcts(*args, simulations=24, wave=8, merge=True, **more),
}


def look(mdp: TabularMDP, search: Callable[..., Lookahead], device: torch.device, seed: int = 0) -> Lookahead:
    v_S, roots = some_v(mdp, seed).to(device), torch.arange(min(mdp.num_states, 40), device=device)
    return search(TabularModel(mdp, device=device), roots, depth=3, v_leaf=v_S.__getitem__)


# FrozenLake's ways to the goal are equally good up to rounding, and the last bits decide which gets simulations.
@pytest.mark.parametrize(("name", "kind"), [each for each in product(ZOO, SEARCHES) if each[0] != "FrozenLake"])
def test_searches_find_what_they_find_on_the_cpu(name, kind):
    cpu, gpu = (look(zoo(name), SEARCHES[kind], device) for device in (torch.device("cpu"), GPU))
    assert gpu.q_BA.device.type == "cuda"
    torch.testing.assert_close(gpu.q_BA.cpu(), cpu.q_BA, atol=1e-12, rtol=1e-12)
    assert gpu.model_calls == cpu.model_calls
    other = look(zoo(name), SEARCHES[kind], GPU, seed=1)
    assert not torch.allclose(gpu.q_BA, other.q_BA)


@pytest.mark.parametrize("leaf", ["v", "q"])
@pytest.mark.parametrize("depth", [1, 8])
def test_a_search_over_known_states_waits_for_nothing(depth, leaf):
    mdp, roots = deep_sea(12), torch.tensor([0], device=GPU)
    model = TabularModel(mdp, device=GPU)
    topology, readings = Topology(model), Readings()
    shape = (mdp.num_states,) if leaf == "v" else (mdp.num_states, mdp.num_actions)
    value = torch.randn(shape, dtype=torch.float64, generator=stream(0, "leaf")).to(GPU)

    def search(**more) -> Lookahead:
        return expectimax(model, roots, depth=depth, topology=topology, **{f"{leaf}_leaf": value.__getitem__}, **more)

    first = search()
    with nothing_read():
        again = search(readings=readings)
    readings.read()
    assert torch.equal(again.q_BA, first.q_BA)
    with nothing_read(), pytest.raises(RuntimeError, match="synchroniz"):
        search()


def test_a_cuda_graph_holds_a_whole_tree_search():
    mdp, options, roots = random_mdp(200, 4, branching=5, seed=3), MCTS(simulations=64), 128
    model = TabularModel(mdp, device=GPU)
    outcomes = model.outcomes(torch.arange(mdp.num_states, device=GPU))
    prior_SA = random_policy(mdp, 1).to(GPU)
    state_B = torch.arange(roots, device=GPU)
    trees = FixedTrees(outcomes, some_v(mdp).to(GPU), prior_SA, 8, options, num_roots=roots, num_nodes=64)

    def search() -> tuple[Tensor, Tensor]:
        return trees.search(state_B, prior_SA[state_B].log())

    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        search()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        q_BA, _ = search()
    found = []
    for first in (0, 50):
        state_B.copy_(torch.arange(first, first + roots) % mdp.num_states)
        graph.replay()
        found.append(q_BA.clone())
        assert torch.equal(found[-1], search()[0])
        cpu = mcts(
            TabularModel(mdp),
            state_B.cpu(),
            depth=7,
            v_leaf=some_v(mdp).__getitem__,
            prior=random_policy(mdp, 1).__getitem__,
            simulations=64,
        )
        torch.testing.assert_close(found[-1].cpu(), cpu.q_BA, atol=1e-12, rtol=1e-12)
    assert not torch.equal(*found)


@pytest.mark.parametrize("times", [1, 5])
def test_sweeps_are_those_of_the_cpu_and_wait_for_nothing(times):
    mdp = random_mdp(3000, 4, branching=5, seed=3)
    v_S, outcomes = some_v(mdp), TabularModel(mdp, device=GPU).outcomes(torch.arange(mdp.num_states, device=GPU))
    on_gpu_S = v_S.to(GPU)
    sweep(outcomes, on_gpu_S, 1)
    with nothing_read():
        swept = sweep(outcomes, on_gpu_S, times)
    torch.testing.assert_close(swept.cpu(), sweep(mdp.outcomes, v_S, times), atol=1e-12, rtol=1e-12)


def test_rows_may_have_more_outcomes_than_there_are_children():
    child_NAK = torch.tensor([[[0, 1, 1, 1], [1, 0, 0, 0]]])
    outcomes = Outcomes(torch.zeros(1, 2), torch.full((1, 2, 4), 0.25), torch.ones(1, 2, 4), child_NAK, 2)
    v_C = torch.tensor([4.0, 8.0])
    assert backup(outcomes.to(GPU), v_C.to(GPU)).tolist() == backup(outcomes, v_C).tolist() == [[7.0, 5.0]]


TRAININGS = {name: (path, arguments) for name, path, arguments in checksums.settings()}


def make(name: str, *more: str) -> PGTS:
    path, arguments = TRAININGS[name]
    return build(load(path, [*arguments, "--device", "cuda", *more]))


@pytest.mark.parametrize("name", TRAININGS)
def test_every_shipped_training_runs_and_goes_on_from_what_was_saved(name):
    model, resumed = make(name), make(name)
    first = model.iterate()
    state = copy.deepcopy(model.state_dict())
    second = model.iterate()
    resumed.load_state_dict(state)
    again = resumed.iterate()
    for seen in (first, second, again):
        assert seen.advantage_NA.device.type == "cuda"
        assert bool(torch.isfinite(seen.advantage_NA).any(1).all())
    torch.testing.assert_close(again.advantage_NA, second.advantage_NA, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("policy", ["softmax", "mlp"])
def test_a_policy_learns_on_it_and_is_read_on_the_cpu(tmp_path, policy):
    model = PGTS("pgts/Ladder-v0", depth=4, policy=policy, device="cuda", seed=0)
    before = evaluate(model, episodes=50).episodic_return.mean
    model.learn(6_000)
    model.save(tmp_path / "model")
    on_cpu = PGTS.load(tmp_path / "model", device="cpu")
    assert on_cpu.device.type == "cpu"
    after = evaluate(model, episodes=50).episodic_return.mean
    assert evaluate(on_cpu, episodes=50).episodic_return.mean == pytest.approx(after, abs=1e-6)
    assert after > before
