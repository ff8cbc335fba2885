"""Searches as objects: what they remember, and how the automatic one chooses."""

import gymnasium
import pytest
import torch
from torch import Tensor

from pgts_torch.errors import MissingModel, NodeBudgetExceeded, PgtsError
from pgts_torch.models import EnumeratingModel, SamplingModel, SimulatorModel, TabularModel, Transitions
from pgts_torch.options import MCTS, Auto, Sampled
from pgts_torch.search import Lookahead, mcts, sampled
from pgts_torch.search.auto import AutoSearch
from pgts_torch.search.engine import ExpectimaxSearch, MCTSSearch, SampledSearch, Search
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact, ladder, random_mdp
from tests.search.models import some_v, watched
from tests.support import zoo


class SamplingOnly(SamplingModel):
    """A tabular model that does not enumerate its outcomes."""

    def __init__(self, mdp: TabularMDP) -> None:
        self._model = TabularModel(mdp)
        self.num_states, self.num_actions = mdp.num_states, mdp.num_actions
        self.device, self.dtype = self._model.device, self._model.dtype

    def sample(self, state_N: Tensor, action_N: Tensor, *, key_N: Tensor) -> Transitions:
        return self._model.sample(state_N, action_N, key_N=key_N)


GARNET = random_mdp(200, 3, branching=4, seed=5)
ROOTS = torch.tensor([7, 3, 3, 150])


def look(search: Search, depth: int = 3, seed: int = 0) -> Lookahead:
    v_S = some_v(GARNET)
    return search(ROOTS, depth=depth, v_leaf=lambda s: v_S[s], generator=stream(seed, "search"))


def truth(depth: int = 3) -> Tensor:
    v_S = some_v(GARNET)
    weight_SAK = GARNET.outcomes.prob_NAK * GARNET.outcomes.discount_NAK
    q_SA = GARNET.outcomes.reward_NA + (weight_SAK * v_S[GARNET.outcomes.child_NAK]).sum(-1)
    return exact.lookahead(GARNET, q_SA, depth)[ROOTS]


@pytest.mark.parametrize(
    "make", [ExpectimaxSearch, AutoSearch, lambda model: MCTSSearch(model, MCTS(simulations=10**5))]
)
def test_a_search_that_expands_everything_is_exact_and_queries_nothing_twice(make):
    search = make(TabularModel(GARNET))
    first, second = look(search), look(search, seed=1)
    torch.testing.assert_close(first.q_BA, truth())
    assert torch.equal(first.q_BA, second.q_BA)
    assert search.model_calls == first.model_calls > 0
    assert second.model_calls == 0
    assert not torch.allclose(first.q_BA, truth(2))


def of_function(samples: int) -> Lookahead:
    """The same search by the function `sampled`."""
    v_S, generator = some_v(GARNET), stream(0, "search")
    options = {"samples": samples, "share": "search", "generator": generator, "replicates": 0}
    return sampled(TabularModel(GARNET), ROOTS, depth=3, v_leaf=lambda s: v_S[s], **options)


def test_a_sampled_search_is_the_function_of_that_name_and_counts_its_calls():
    search = SampledSearch(SamplingOnly(GARNET), Sampled(samples=3, share="search"))
    expected = of_function(samples=3)
    first, again, other = look(search), look(search), look(search, seed=1)
    assert torch.equal(first.q_BA, expected.q_BA)
    assert torch.equal(first.q_BA, again.q_BA)
    assert not torch.equal(first.q_BA, other.q_BA)
    assert search.model_calls == first.model_calls + again.model_calls + other.model_calls


def test_where_all_paths_fit_the_automatic_search_expands_all_of_them_and_says_so():
    search = AutoSearch(TabularModel(GARNET))
    assert str(search) == "nothing yet"
    nodes = look(search).nodes
    assert str(search) == f"expectimax: the model enumerates its outcomes, and {nodes} nodes hold all paths"


def test_where_they_do_not_fit_it_keeps_to_the_budget_and_queries_nothing_twice():
    model = watched(GARNET)
    search = AutoSearch(model, Auto(max_nodes=300))
    first = look(search)
    assert first.nodes <= 300
    assert float(first.pruned_BA.max()) > 0
    assert "states a level: all paths need more than 300 nodes" in str(search)
    calls = len(model.calls)
    assert torch.equal(look(search).q_BA, first.q_BA)
    assert len(model.calls) == calls
    assert len(model.queried) == len(set(model.queried))
    # A shallower search fits, and is exact.
    torch.testing.assert_close(look(search, depth=0).q_BA, truth(0))
    assert str(search).startswith("expectimax: ")


def test_a_model_that_only_samples_is_sampled_more_often_where_paths_met():
    search = AutoSearch(SamplingOnly(ladder(5)), Auto(max_nodes=400))
    samples = []
    for seed in range(6):
        search(torch.tensor([0]), depth=3, v_leaf=torch.zeros_like, generator=stream(seed, "search"))
        samples.append(int(str(search).split()[1]))
        assert "the model only samples" in str(search)
    # 2 actions and 2 samples on 4 levels: 341 nodes if no two paths met; the Ladder has 5 states.
    assert samples[0] == 2
    assert samples == sorted(samples)
    assert samples[-1] > 2


def test_the_samples_of_a_model_in_which_paths_rarely_meet_stay_within_the_budget():
    search = AutoSearch(SamplingOnly(random_mdp(5000, 4, branching=50, seed=2)), Auto(max_nodes=2_000))
    for seed in range(5):
        root_B = torch.arange(3)
        found = search(
            root_B,
            depth=2,
            v_leaf=lambda s: torch.zeros(len(s), dtype=torch.float64),
            generator=stream(seed, "search"),
        )
        assert found.nodes <= 2_000


def test_an_automatic_search_counts_also_the_calls_of_what_turned_out_too_large():
    model = watched(GARNET)
    search = AutoSearch(model, Auto(max_nodes=300))
    assert look(search).model_calls == search.model_calls == len(model.queried) * GARNET.num_actions > 0


def test_one_search_that_was_too_large_does_not_make_the_automatic_one_narrow_for_good():
    search = AutoSearch(TabularModel(GARNET), Auto(max_nodes=250))
    v_S = some_v(GARNET)

    def pruned(root_B: Tensor, depth: int) -> float:
        found = search(root_B, depth=depth, v_leaf=lambda s: v_S[s], generator=stream(0, "search"))
        assert ("nodes hold all paths" in str(search)) == (float(found.pruned_BA.max()) == 0)
        return float(found.pruned_BA.max())

    assert pruned(torch.arange(20), 2) > 0
    assert pruned(torch.arange(1), 1) == 0
    assert pruned(torch.arange(20), 2) > 0


def test_a_larger_search_of_a_model_that_only_samples_takes_fewer_samples():
    search = AutoSearch(SamplingOnly(random_mdp(5000, 4, branching=50, seed=2)), Auto(max_nodes=2_000))
    samples = []
    for roots, depth in ((1, 0), (3, 2)):
        found = search(
            torch.arange(roots),
            depth=depth,
            v_leaf=lambda s: torch.zeros(len(s), dtype=torch.float64),
            generator=stream(0, "search"),
        )
        assert found.nodes <= 2_000
        samples.append(int(str(search).split()[1]))
    assert samples[0] > samples[1]


@pytest.mark.parametrize("model", [TabularModel(GARNET), SamplingOnly(GARNET)])
def test_a_budget_that_is_too_small_for_anything_is_an_error(model):
    with pytest.raises(NodeBudgetExceeded):
        look(AutoSearch(model, Auto(max_nodes=2)))


def test_a_tree_search_of_a_model_that_only_samples_searches_fixed_samples():
    """With enough simulations it is the sampled lookahead with one set of samples for each state."""
    search = MCTSSearch(SamplingOnly(GARNET), MCTS(simulations=100_000, samples=2))
    expected = of_function(samples=2)
    found = look(search)
    torch.testing.assert_close(found.q_BA, expected.q_BA)
    assert found.model_calls <= expected.model_calls
    assert not torch.equal(look(search, seed=1).q_BA, found.q_BA)
    assert str(search) == "mcts, 100000 simulations, merged, 2 sampled outcomes of each action"
    assert torch.equal(look(MCTSSearch(TabularModel(GARNET), MCTS(simulations=100_000, samples=2))).q_BA, found.q_BA)
    with pytest.raises(PgtsError, match="samples is 0"):
        MCTS(samples=0)


MCTS_OPTIONS = [
    {"root": "rule"},
    {"rule": "puct"},
    {"rule": "uct", "exploration": 0.3},
    {"wave": 4},
    {"prior": "policy"},
    {"backup": "mean"},
    {"merge": False},
    {"root": "rule", "rule": "puct", "exploration": 2.0, "prior": "policy", "wave": 1, "backup": "mean"},
]


@pytest.mark.parametrize("options", MCTS_OPTIONS, ids=str)
def test_each_option_of_a_tree_search_is_that_of_the_function_and_changes_the_answer(options):
    v_S, root_B = some_v(GARNET), torch.arange(40)
    pi_SA = torch.full((GARNET.num_states, 3), 0.1, dtype=torch.float64)
    pi_SA[:, 2] = 0.8
    given = {"depth": 4, "v_leaf": lambda s: v_S[s]}

    def searched(**options) -> Lookahead:
        search = MCTSSearch(TabularModel(GARNET), MCTS(simulations=12, **options))
        return search(root_B, **given, prior=lambda s: pi_SA[s], generator=stream(0, "search"))

    of_function = dict(options)
    of_function.setdefault("merge", options.get("backup") != "mean")
    if of_function.pop("prior", None):
        of_function["prior"] = lambda s: pi_SA[s]
    if options.get("root") != "rule":
        of_function["generator"] = stream(0, "search")
    direct = mcts(TabularModel(GARNET), root_B, **given, simulations=12, **of_function)
    assert torch.equal(searched(**options).q_BA, direct.q_BA)
    assert not torch.equal(searched(**options).q_BA, searched().q_BA)


def test_a_tree_search_says_which_options_it_has():
    model = TabularModel(GARNET)
    alpha_zero = {"root": "rule", "rule": "puct", "prior": "policy", "backup": "mean"}
    assert str(MCTSSearch(model, MCTS(**alpha_zero))) == (
        "mcts, 64 simulations, puct at the root too, the policy as prior, mean backups"
    )
    assert str(MCTSSearch(model, MCTS(rule="uct", wave=1))) == "mcts, 64 simulations, uct, merged"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"root": "puct"}, "root is 'puct'; it must be gumbel or rule"),
        ({"rule": "ucb"}, "rule is 'ucb'; it must be gumbel, puct or uct"),
        ({"backup": "min"}, "backup is 'min'; it must be max or mean"),
        ({"prior": "best"}, "prior is 'best'; it must be uniform or policy"),
        ({"wave": 0}, "wave is 0"),
        ({"exploration": 1.0}, "search.rule gumbel has none, it must be puct or uct"),
        ({"rule": "puct", "exploration": -1.0}, "exploration is -1.0; it must be a number >= 0"),
        ({"backup": "mean", "merge": True}, "search.merge is true, which needs search.backup max"),
        (
            {"root": "rule", "rule": "uct", "prior": "policy"},
            "search.prior is policy, which search.rule uct with search.root rule does not use",
        ),
    ],
)
def test_an_option_of_a_tree_search_that_is_out_of_range_or_has_no_effect_is_refused(options, message):
    with pytest.raises(PgtsError, match=message):
        MCTS(**options)


def test_a_search_from_the_prior_of_the_policy_needs_the_policy():
    with pytest.raises(PgtsError, match="the prior of the search is that of the policy: give prior"):
        look(MCTSSearch(TabularModel(GARNET), MCTS(prior="policy")))


class EnumeratingOnly(EnumeratingModel):
    """A tabular model that does not sample."""

    def __init__(self, mdp: TabularMDP) -> None:
        self._model = TabularModel(mdp)
        self.num_states, self.num_actions = mdp.num_states, mdp.num_actions
        self.device, self.dtype = self._model.device, self._model.dtype

    def outcomes(self, state_N: Tensor):
        return self._model.outcomes(state_N)


@pytest.mark.parametrize(
    ("make", "model", "message"),
    [
        (
            ExpectimaxSearch,
            SamplingOnly,
            "'expectimax' needs a model that enumerates its outcomes; SamplingOnly does not",
        ),
        (SampledSearch, EnumeratingOnly, "'sampled' needs a model that samples outcomes; EnumeratingOnly does not"),
    ],
)
def test_a_search_refuses_a_model_that_cannot_do_what_it_needs(make, model, message):
    with pytest.raises(MissingModel, match=message):
        make(model(zoo("ladder")))


def test_a_simulator_that_turns_out_to_be_random_is_sampled():
    env = gymnasium.make("FrozenLake-v1")
    observation, _ = env.reset(seed=0)
    for slippery, picked in ((True, "sampled, "), (False, "expectimax: ")):
        made = gymnasium.make("FrozenLake-v1", is_slippery=slippery)
        made.reset(seed=0)
        model = SimulatorModel(made, gamma=0.9)
        search = AutoSearch(model, Auto(max_nodes=10_000))
        search(model.roots([made], [observation]), depth=2, v_leaf=torch.zeros_like, generator=stream(0, "search"))
        assert str(search).startswith(picked)
        assert (search.topology is None) is slippery
