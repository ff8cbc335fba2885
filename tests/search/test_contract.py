"""What every search promises, whatever its way: the same arguments, the same truth, the same refusals."""

from collections.abc import Callable

import gymnasium
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.compiled import torch_only
from pgts_torch.errors import PgtsError
from pgts_torch.models import EnumeratingModel, SimulatorModel, TabularModel
from pgts_torch.search import Lookahead, expectimax, mcts, sampled
from pgts_torch.seeding import stream
from pgts_torch.tabular import TabularMDP, exact, ladder
from tests.search.models import some_q, some_v, zeros
from tests.support import mdps, zoo

Engine = Callable[..., Lookahead]


def complete_samples(model, root_B, **kwargs) -> Lookahead:
    return sampled(model, root_B, samples=[None], generator=stream(0, "contract"), replicates=0, **kwargs)


def tree_by_torch(model, root_B, **kwargs) -> Lookahead:
    with torch_only():
        return mcts(model, root_B, simulations=5_000, **kwargs)


ENGINES: dict[str, Engine] = {
    "expectimax": expectimax,
    "pruned": lambda *args, **kwargs: expectimax(*args, max_width=10_000, **kwargs),
    "sampled": complete_samples,
    "mcts, tree": lambda *args, **kwargs: mcts(*args, simulations=5_000, **kwargs),
    "mcts, tree, torch": tree_by_torch,
    "mcts, graph": lambda *args, **kwargs: mcts(*args, simulations=5_000, merge=True, **kwargs),
}
"""Each search with a budget that leaves nothing out."""

every_engine = pytest.mark.parametrize("engine", ENGINES.values(), ids=ENGINES)


@every_engine
@given(mdp=mdps(max_states=4, max_actions=2, max_outcomes=2), depth=st.integers(0, 3), seed=st.integers(0, 99))
def test_a_search_that_leaves_nothing_out_is_exact_for_both_kinds_of_leaves(engine, mdp, depth, seed):
    root_B = torch.arange(mdp.num_states).flip(0)
    q_SA, v_S = some_q(mdp, seed), some_v(mdp, seed)
    look = engine(TabularModel(mdp), root_B, depth=depth, q_leaf=lambda s: q_SA[s])
    torch.testing.assert_close(look.q_BA, exact.lookahead(mdp, q_SA, depth)[root_B])
    one_step_SA = exact.lookahead(mdp, v_S.unsqueeze(-1).expand(-1, mdp.num_actions), 1)
    look = engine(TabularModel(mdp), root_B, depth=depth, v_leaf=lambda s: v_S[s])
    torch.testing.assert_close(look.q_BA, exact.lookahead(mdp, one_step_SA, depth)[root_B])
    assert float(look.pruned_BA.abs().max()) == 0
    assert len(look.nodes_per_level) == depth + 2
    assert 0 < look.model_calls <= mdp.num_states * mdp.num_actions * (depth + 1)


@every_engine
@pytest.mark.parametrize("depth", [0, 1, 4])
def test_with_discount_0_nothing_after_the_first_reward_counts(engine, depth):
    mdp = zoo("garnet")
    blind = TabularMDP(
        Outcomes(
            mdp.outcomes.reward_NA,
            mdp.outcomes.prob_NAK,
            torch.zeros_like(mdp.outcomes.discount_NAK),
            mdp.outcomes.child_NAK,
            mdp.num_states,
        ),
        mdp.start_S,
    )
    v_S = some_v(mdp)
    look = engine(TabularModel(blind), torch.tensor([3, 9]), depth=depth, v_leaf=lambda s: v_S[s])
    assert torch.equal(look.q_BA, mdp.outcomes.reward_NA[[3, 9]])
    seeing = (
        engine(TabularModel(mdp), torch.tensor([3, 9]), depth=depth, v_leaf=lambda s: v_S[s]) if depth < 4 else look
    )
    assert depth == 4 or not torch.allclose(seeing.q_BA, look.q_BA)


@every_engine
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_state_with_one_action_earns_a_geometric_series(engine, dtype):
    one = TabularModel(TabularMDP.from_transitions([[[(1.0, 0, 1.0, False)]]], 0.5), dtype=dtype)
    for depth in range(6):
        look = engine(one, torch.tensor([0]), depth=depth, v_leaf=zeros)
        assert look.q_BA.dtype == look.pruned_BA.dtype == dtype
        assert look.q_BA.item() == pytest.approx(2 - 0.5**depth, rel=1e-15)


@every_engine
def test_enormous_values_do_not_become_nan(engine):
    mdp = TabularMDP.from_transitions(
        [[[(0.5, 0, 1e300, False), (0.5, 1, -1e300, True)], [(1.0, 1, 0.0, False)]], [[(1.0, 0, 0.0, False)]] * 2], 0.5
    )
    q_SA = torch.tensor([[1e300, -1e300], [1e300, 1e300]], dtype=torch.float64)
    for depth in range(5):
        look = engine(TabularModel(mdp), torch.tensor([0, 1]), depth=depth, q_leaf=lambda s: q_SA[s])
        torch.testing.assert_close(look.q_BA / 1e300, exact.lookahead(mdp, q_SA, depth) / 1e300)


@every_engine
def test_values_carry_no_gradient_and_can_be_part_of_a_loss(engine):
    v_S, logits = some_v(ladder(5)).requires_grad_(), torch.zeros(5, 2, dtype=torch.float64, requires_grad=True)
    look = engine(TabularModel(ladder(5)), torch.arange(5), depth=2, v_leaf=lambda s: v_S[s])
    assert not look.q_BA.requires_grad
    (logits.softmax(-1) * look.q_BA).sum().backward()
    assert bool(logits.grad.abs().sum() > 0)


class Gated(EnumeratingModel):
    """Two states; action 1 is allowed in state 0 alone, and pays enormously there."""

    num_states, num_actions = 2, 2
    device, dtype = torch.device("cpu"), torch.float64

    def __init__(self, pay: float) -> None:
        self.pay = pay

    def outcomes(self, state_N: Tensor) -> Outcomes:
        shape = len(state_N), 2, 1
        reward_NA = torch.tensor([[1.0, self.pay], [2.0, -torch.inf]], dtype=torch.float64)[state_N]
        child_NAK = torch.tensor([0, 1]).view(1, 2, 1).expand(shape)
        ones = torch.ones(shape, dtype=torch.float64)
        return Outcomes(reward_NA, ones, 0.5 * ones, child_NAK, 2)


@every_engine
@pytest.mark.parametrize("pay", [3.0, 1e300, -1e300])
def test_an_action_that_is_not_allowed_is_minus_infinity_and_never_the_best(engine, pay):
    look = engine(Gated(pay), torch.tensor([1, 0]), depth=1, v_leaf=zeros)
    best_of_0 = max(1.0, pay)
    expected = [[2 + best_of_0 / 2, -torch.inf], [1 + best_of_0 / 2, pay + 0.5 * 2]]
    torch.testing.assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64))
    leaf_SA = torch.tensor([[0.0, 4.0], [6.0, -torch.inf]], dtype=torch.float64)
    look = engine(Gated(pay), torch.tensor([1, 0]), depth=1, q_leaf=lambda s: leaf_SA[s])
    expected = [[2 + 4.0 / 2, -torch.inf], [1 + 4.0 / 2, pay + 6.0 / 2]]
    torch.testing.assert_close(look.q_BA, torch.tensor(expected, dtype=torch.float64))


@every_engine
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"prob_NAK": -0.5}, "probability of outcome 0 of state 1 and action 0 is -0.5"),
        ({"discount_NAK": -1.0}, r"discount of outcome 0 of state 1 and action 0 is -1.0; it must be in \[0, 1\]"),
        ({"discount_NAK": float("nan")}, "discount of outcome 0 of state 1 and action 0 is nan"),
        ({"reward_NA": float("nan")}, "rewards in state 1 are"),
    ],
)
def test_a_model_whose_answers_make_no_sense_is_refused_by_the_state(engine, changed, message):
    class Broken(Gated):
        def outcomes(self, state_N: Tensor) -> Outcomes:
            answer = super().outcomes(state_N)
            for name, value in changed.items():
                given = getattr(answer, name)
                given[state_N == 1, 0] = value
                if name == "prob_NAK":
                    twice = torch.cat([given, torch.where(given < 0, 1 - given, 0.0)], -1)
                    both = [torch.cat([x, x], -1) for x in (answer.discount_NAK, answer.child_NAK)]
                    answer = Outcomes(answer.reward_NA, twice, *both, 2)
            return answer

    with pytest.raises(PgtsError, match=message):
        engine(Broken(1.0), torch.tensor([1]), depth=1, v_leaf=zeros)


@every_engine
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_value_of_the_critic_that_is_not_finite_is_refused_by_the_state(engine, bad):
    v_S = torch.zeros(5, dtype=torch.float64)
    v_S[2] = bad
    with pytest.raises(PgtsError, match=f"state 2 is {bad}"):
        engine(TabularModel(ladder(5)), torch.tensor([0]), depth=3, v_leaf=lambda s: v_S[s])


@every_engine
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"depth": -1}, "depth is -1"),
        ({"root_B": torch.tensor([5])}, "root_B"),
        ({"root_B": torch.tensor([], dtype=torch.int64)}, "root_B"),
        ({"q_leaf": lambda s: torch.zeros(len(s), 2)}, "exactly one of q_leaf and v_leaf"),
        ({"v_leaf": None}, "exactly one of q_leaf and v_leaf"),
        ({"v_leaf": lambda s: torch.zeros(len(s), 3)}, "values have shape"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(engine, changed, message):
    arguments = {"root_B": torch.tensor([0]), "depth": 2, "v_leaf": zeros}
    arguments |= changed
    with pytest.raises(PgtsError, match=message):
        engine(TabularModel(ladder(5)), arguments.pop("root_B"), **arguments)


BUDGETS: dict[str, Engine] = {
    "expectimax": expectimax,
    "pruned": lambda *args, **kwargs: expectimax(*args, max_width=3, **kwargs),
    "mcts, tree": lambda *args, **kwargs: mcts(*args, simulations=20, **kwargs),
    "mcts, graph": lambda *args, **kwargs: mcts(*args, simulations=20, merge=True, **kwargs),
}
"""Searches that expand a part, of models that enumerate outcomes."""


@pytest.mark.parametrize("engine", BUDGETS.values(), ids=BUDGETS)
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_no_planner_beats_the_optimum_on_the_lake(engine, share):
    """With leaves at or below v* no value exceeds q*; a planner that foresaw the slips would."""
    mdp = zoo("FrozenLake")
    optimum = exact.optimal(mdp)
    root_B = torch.arange(mdp.num_states)
    look = engine(TabularModel(mdp), root_B, depth=6, v_leaf=lambda s: (1 - share) * optimum.v_S[s])
    assert bool((look.q_BA <= optimum.q_SA + 1e-12).all())
    too_high = engine(TabularModel(mdp), root_B, depth=6, v_leaf=lambda s: optimum.v_S[s] + 0.1)
    assert bool((too_high.q_BA > optimum.q_SA + 1e-3).any())


@pytest.mark.parametrize("kind", ["expectimax", "sampled", "mcts"])
def test_searching_leaves_the_environment_and_its_generator_as_they_are(kind):
    def searched(look: bool) -> list[tuple[int, float, bool]]:
        env = gymnasium.make("FrozenLake-v1")
        observation, _ = env.reset(seed=3)
        model = TabularModel(TabularMDP.from_gymnasium(env, 0.9))
        simulator = SimulatorModel(env, gamma=0.9)
        made = []
        for _ in range(30):
            if look:
                ask = {"depth": 2, "v_leaf": zeros}
                if kind == "sampled":
                    root_B = simulator.roots([env], [observation])
                    sampled(simulator, root_B, samples=2, generator=stream(0, "look"), **ask)
                else:
                    root_B = torch.tensor([observation])
                    expectimax(model, root_B, **ask) if kind == "expectimax" else mcts(
                        model, root_B, simulations=8, **ask
                    )
            observation, reward, terminated, truncated, _ = env.step(len(made) % 4)
            made.append((int(observation), float(reward), terminated))
            if terminated or truncated:
                observation, _ = env.reset()
        made.append((int(env.unwrapped.np_random.integers(10**9)), 0.0, False))
        return made

    assert searched(True) == searched(False)
