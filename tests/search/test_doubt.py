"""A doubt is at least the distance of a lookahead in a wrong model from that in the environment."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pgts_torch import PGTS
from pgts_torch.agent.diagnostics import metrics
from pgts_torch.errors import PgtsError
from pgts_torch.models import CountsModel, FallibleModel, TabularModel
from pgts_torch.models.base import Experience
from pgts_torch.options import Counts, Expectimax
from pgts_torch.search import expectimax
from pgts_torch.search.engine import ExpectimaxSearch
from pgts_torch.seeding import mix, numpy_stream, stream
from pgts_torch.tabular import TabularMDP, exact, random_mdp
from tests.search.models import WatchedModel, all_states, assert_close, some_q, some_v, walk_the_tree, watched
from tests.support import mdps, random_policy, rewarded, weights, zoo


class WrongModel(FallibleModel, WatchedModel):
    """A table that is not that of the environment, and what it says of its error."""

    def __init__(self, mdp: TabularMDP, error_SA: Tensor | None) -> None:
        super().__init__(TabularModel(mdp))
        self.error_SA = error_SA

    def step_error(self, state_N: Tensor) -> Tensor | None:
        return None if self.error_SA is None else self.error_SA[state_N]


def one_step_error(model: TabularMDP, truth: TabularMDP, low: float, high: float) -> Tensor:
    """The largest error of one step over all v in [low, high]^S: it is affine in v, so v is low or high everywhere."""
    paid_SA = (model.outcomes.reward_NA - truth.outcomes.reward_NA).numpy()
    moved_SAS = weights(model) - weights(truth)
    most_SA = paid_SA + np.where(moved_SAS > 0, moved_SAS * high, moved_SAS * low).sum(-1)
    least_SA = paid_SA + np.where(moved_SAS > 0, moved_SAS * low, moved_SAS * high).sum(-1)
    return torch.from_numpy(np.maximum(most_SA, -least_SA))


@given(mdps(), st.integers(0, 10**6), st.integers(0, 6), st.sampled_from("qv"))
def test_no_lookahead_in_a_wrong_model_is_farther_from_the_truth_than_its_doubt(truth, seed, depth, critic):
    random, (S, A, K) = numpy_stream(seed, "wrong"), truth.outcomes.child_NAK.shape
    wrong = replace(
        truth,
        outcomes=replace(
            truth.outcomes,
            reward_NA=truth.outcomes.reward_NA + 0.1 * torch.from_numpy(random.normal(size=(S, A))),
            prob_NAK=torch.from_numpy(random.dirichlet(np.ones(K), size=(S, A))),
            child_NAK=torch.from_numpy(random.integers(0, S, size=(S, A, K))),
        ),
        reward_SAK=None,
    )
    q_SA, v_S = some_q(truth, seed), some_v(truth, seed)
    # T^j Q for all j that a step of the proof meets: with values of v the first step is from v itself.
    start_SA = q_SA if critic == "q" else exact.lookahead(truth, v_S[:, None].expand(S, A), 1)
    met = [v_S] * (critic == "v") + [exact.lookahead(truth, start_SA, j).amax(-1) for j in range(depth)]
    low, high = (float(f(torch.cat([*met, torch.zeros(1).double()]))) for f in (torch.amin, torch.amax))
    model = WrongModel(wrong, one_step_error(wrong, truth, low, high))
    off = torch.from_numpy(random.uniform(size=(S, A) if critic == "q" else S))
    sign = torch.from_numpy(random.choice([-1.0, 1.0], size=off.shape))
    leaf = {f"{critic}_leaf": lambda s: ((q_SA if critic == "q" else v_S) + sign * off)[s]}
    look = expectimax(model, all_states(truth), depth=depth, leaf_error=lambda s: off[s], **leaf)
    true_SA = exact.lookahead(truth, start_SA, depth)
    assert bool(((look.q_BA - true_SA).abs() <= look.doubt_BA + 1e-9).all())
    least, most = look.interval()
    assert bool(((least <= true_SA + 1e-9) & (true_SA <= most + 1e-9)).all())


@given(mdps(max_actions=1), st.integers(0, 8))
def test_where_a_model_with_one_action_errs_in_one_direction_the_doubt_is_the_error(mdp, depth):
    model = WrongModel(rewarded(mdp, constant=0.25), torch.full((mdp.num_states, 1), 0.25, dtype=torch.float64))
    q_SA = some_q(mdp)
    look = expectimax(model, all_states(mdp), depth=depth, q_leaf=lambda s: q_SA[s] + 2.0, leaf_error=2.0)
    error_SA = look.q_BA - exact.lookahead(mdp, q_SA, depth)
    assert_close(look.doubt_BA, error_SA, 1e-9)
    # so a smaller error of the model, or of the critic, would be no bound
    model.error_SA = 0.9 * model.error_SA
    less = expectimax(model, all_states(mdp), depth=depth, q_leaf=lambda s: q_SA[s] + 2.0, leaf_error=2.0).doubt_BA
    assert depth == 0 or bool((less < error_SA - 0.02).all())


@pytest.mark.parametrize("depth", [1, 2, 3, 6])
def test_a_doubt_is_the_value_of_errors_along_all_paths(depth):
    mdp = zoo("garnet")
    error_SA, off_S = some_q(mdp).abs(), some_v(mdp).abs()
    roots = torch.tensor([3, 7, 3])
    model = WrongModel(mdp, error_SA)
    look = expectimax(model, roots, depth=depth, v_leaf=lambda s: s.double(), leaf_error=lambda s: off_S[s])
    if depth < 4:
        outcomes = mdp.outcomes

        def step(s: int, a: int) -> tuple[float, list[tuple[float, float, int]]]:
            of = (outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK)
            return float(error_SA[s, a]), list(zip(*(x[s, a].tolist() for x in of), strict=True))

        slow = [walk_the_tree(step, s, depth, lambda s: float(off_S[s]), 3) for s in roots.tolist()]
        assert_close(look.doubt_BA, torch.tensor(slow, dtype=torch.float64))
    errors = replace(mdp, outcomes=mdp.outcomes.paying(error_SA), reward_SAK=None)
    first_SA = exact.lookahead(errors, off_S[:, None].expand(-1, 3), 1)
    assert_close(look.doubt_BA, exact.lookahead(errors, first_SA, depth)[roots])


@pytest.mark.parametrize("depth", [0, 1, 5])
@pytest.mark.parametrize("name", ["garnet", "CliffWalking", "deep_sea"])
def test_a_doubt_costs_no_call_and_leaves_values_as_they_are(name, depth):
    mdp = zoo(name)
    models = [WrongModel(mdp, torch.ones_like(mdp.outcomes.reward_NA)) for _ in range(2)]
    roots = torch.arange(5)
    plain, doubted = (
        expectimax(model, roots, depth=depth, v_leaf=lambda s: some_v(mdp)[s], leaf_error=error)
        for model, error in zip(models, (None, 1.0), strict=True)
    )
    assert models[0].calls == models[1].calls
    assert plain.q_BA.equal(doubted.q_BA)
    assert (plain.model_calls, plain.critic_calls) == (doubted.model_calls, doubted.critic_calls)
    assert plain.doubt_BA is None
    assert bool((doubted.doubt_BA >= 1).all())


def test_an_exact_model_leaves_the_doubt_of_the_critic_alone():
    mdp = zoo("grid")
    q_SA = some_q(mdp)

    def doubt(depth: int, leaf_error: float) -> Tensor:
        model = TabularModel(mdp)
        return expectimax(model, torch.arange(9), depth=depth, q_leaf=lambda s: q_SA[s], leaf_error=leaf_error).doubt_BA

    assert float(doubt(3, 0.0).abs().max()) == 0
    gamma = float(mdp.outcomes.discount_NAK.max())
    assert_close(doubt(3, 2.0), torch.full((9, mdp.num_actions), 2 * gamma**3, dtype=torch.float64))
    unknown = expectimax(watched(mdp), torch.arange(9), depth=3, q_leaf=lambda s: q_SA[s], leaf_error=0.0)
    assert unknown.doubt_BA is None
    silent = expectimax(WrongModel(mdp, None), torch.arange(9), depth=3, q_leaf=lambda s: q_SA[s], leaf_error=0.0)
    assert silent.doubt_BA is None


def test_an_action_that_is_not_allowed_causes_no_doubt():
    mdp = zoo("ladder")
    table = TabularModel(mdp)
    reward_SA = mdp.outcomes.reward_NA.clone()
    reward_SA[:, 1] = -torch.inf
    table.table = replace(table.table, reward_NA=reward_SA)
    model = WrongModel(mdp, torch.tensor([[1.0, 1e6]] * 5, dtype=torch.float64))
    model.model = table
    look = expectimax(model, all_states(mdp), depth=2, v_leaf=lambda s: s.double(), leaf_error=0.0)
    gamma = float(mdp.outcomes.discount_NAK.max())
    assert_close(look.doubt_BA, torch.tensor([[1 + gamma + gamma**2, 0.0]] * 5, dtype=torch.float64))


# Counts


def counted(mdp: TabularMDP, options: Counts, visits: int, seed: int) -> CountsModel:
    """A table of the steps of random pairs, some never and some often."""
    random = numpy_stream(seed, "pairs")
    pairs = mdp.num_states * mdp.num_actions
    pair_N = torch.from_numpy(random.choice(pairs, size=visits * pairs, p=random.dirichlet(np.ones(pairs))))
    state_N, action_N = pair_N // mdp.num_actions, pair_N % mdp.num_actions
    seen = TabularModel(mdp).sample(state_N, action_N, key_N=mix(torch.arange(len(pair_N)), seed))
    model = CountsModel(mdp.num_states, mdp.num_actions, gamma=0.9, options=options)
    never_N = torch.zeros(len(pair_N), dtype=torch.bool)
    experience = Experience(state_N, action_N, seen.reward_N, seen.discount_N, seen.next_state_N, never_N)
    model.learn(experience, generator=stream(seed, "learn"))
    return model


def off_by(mdp: TabularMDP, model: CountsModel, depth: int, seed: int) -> tuple[Tensor, Tensor]:
    """The error of a lookahead in the table, and its doubt."""
    q_SA = exact.evaluate(mdp, random_policy(mdp, seed)).q_SA
    look = expectimax(model, all_states(mdp), depth=depth, q_leaf=lambda s: q_SA[s], leaf_error=0.0)
    assert look.doubt_BA is not None
    return (look.q_BA - exact.lookahead(mdp, q_SA, depth)).abs(), look.doubt_BA


@pytest.mark.parametrize("optimism", ["none", "posterior"])
@pytest.mark.parametrize("count", [100, pytest.param(1_000, marks=pytest.mark.long)])
def test_the_doubt_of_counts_is_exceeded_in_no_larger_share_of_mdps_than_they_say(count, optimism):
    exceeded, shrunk = [], []
    for seed in range(count):
        mdp = random_mdp(4, 2, branching=2, reward_share=0.5, seed=seed, gamma=0.5)
        options = Counts(optimism=optimism, value_range=[0.0, 2.0], confidence=0.5)
        off_SA, doubt_SA = off_by(mdp, counted(mdp, options, 8, seed), 4, seed)
        exceeded.append(bool((off_SA > doubt_SA + 1e-9).any()))
        shrunk.append(bool((off_SA > doubt_SA / 50).any()))
    # In more than 64 of 100 MDPs, or 546 of 1,000, with a probability below 0.003 if each exceeds it with 1/2.
    assert np.mean(exceeded) <= 0.5 + 1.45 / count**0.5
    assert np.mean(shrunk) > 0.8  # a bound of a 50th would be none


@pytest.mark.parametrize("optimism", ["none", "posterior", "rmax"])
def test_the_error_that_counts_state_holds_for_every_value_and_falls_with_visits(optimism):
    options = Counts(optimism=optimism, value_range=[-2.0, 10.0], confidence=0.5)
    worst, stated = [], []
    for seed in range(40):
        mdp = random_mdp(4, 2, seed=seed, gamma=0.9)
        model = counted(mdp, options, 30, seed)
        table = replace(mdp, outcomes=model.outcomes(all_states(mdp)), reward_SAK=None)
        error_SA = model.step_error(all_states(mdp))
        assert bool((error_SA <= 12.0).all())
        worst.append(float((one_step_error(table, mdp, -2.0, 10.0) / error_SA).max()))
        stated.append(float(error_SA[0, 0]) - float(model.step_error(torch.tensor([0]))[0, 0]))
    assert np.mean(np.array(worst) > 1) <= 0.5
    assert max(worst) > 0.3  # and it is not idle
    assert stated == [0.0] * 40
    seen, never = (counted(mdp, options, times, 0).step_error(all_states(mdp)).sum() for times in (1_000, 1))
    assert seen < 0.3 * never


def test_counts_that_state_no_confidence_say_nothing_of_their_error():
    mdp = random_mdp(4, 2)
    assert counted(mdp, Counts(value_range=[0.0, 10.0]), 3, 0).step_error(all_states(mdp)) is None
    stated = counted(mdp, Counts(value_range=[0.0, 10.0], confidence=0.9), 3, 0)
    assert stated.plain().step_error(all_states(mdp)).le(stated.step_error(all_states(mdp))).all()


FEW = {"type": "uniform", "updates_per_step": 0.001, "starts": 4, "length": 8}


def test_a_training_logs_its_doubt_where_it_is_asked_for():
    def doubts(**search: bool) -> list[float | None]:
        counts = Counts(value_range=[0.0, 2.0], confidence=0.9)
        search = {"type": "expectimax", **search}
        agent = PGTS("pgts/Ladder-v0", model=counts, replay=FEW, depth=2, search=search)
        return [metrics(agent.parts, agent.iterate(), agent.counters).get("search/doubt") for _ in range(2)]

    assert doubts() == [None, None]
    assert all(0 < found <= 2 * (1 + 0.99 + 0.99**2) for found in doubts(doubt=True))


# Bad input


@pytest.mark.parametrize(
    ("leaf_error", "match"),
    [
        (-1.0, "leaf_error in state 0 is .*; it must be finite and at least 0"),
        (float("nan"), "leaf_error in state 0"),
        (lambda s: torch.where(s == 2, torch.inf, 1.0), "the critic's error in state 2 is inf"),
        (lambda s: s[:1].double(), "the critic's error has shape"),
    ],
)
def test_an_error_that_bounds_nothing_is_refused(leaf_error, match):
    mdp = zoo("ladder")
    ask = {"depth": 1, "v_leaf": lambda s: s.double()}
    with pytest.raises(PgtsError, match=match):
        expectimax(TabularModel(mdp), all_states(mdp), leaf_error=leaf_error, **ask)
    with pytest.raises(PgtsError, match="the model's error in state 0"):
        expectimax(WrongModel(mdp, torch.full((5, 2), -1.0)), all_states(mdp), leaf_error=0.0, **ask)


def test_a_doubt_that_cannot_be_had_is_refused():
    mdp = zoo("ladder")
    with pytest.raises(PgtsError, match=r"search\.doubt needs a model that says its error"):
        ExpectimaxSearch(watched(mdp), Expectimax(doubt=True))
    with pytest.raises(PgtsError, match=r"search\.max_width is 3"):
        expectimax(TabularModel(mdp), all_states(mdp), depth=1, v_leaf=lambda s: s, max_width=3, leaf_error=0.0)
    with pytest.raises(PgtsError, match=r"needs model\.value_range"):
        Counts(confidence=0.9)
    with pytest.raises(PgtsError, match=r"needs model\.confidence"):
        PGTS("FrozenLake-v1", model="counts", search={"type": "expectimax", "doubt": True})
    with pytest.raises(PgtsError, match=r"model\.members 2 or more and action_repeat 1; they are 3 and 4"):
        PGTS("CartPole-v1", model="ensemble", action_repeat=4, search={"type": "expectimax", "doubt": True})
    with pytest.raises(PgtsError, match=r"from a value in value_range, which is \[0\.0, 0\.1\], such a step leads out"):
        counted(random_mdp(4, 2), Counts(value_range=[0.0, 0.1], confidence=0.9), 3, 0)
