"""Tables learned by counting: right where they have seen enough, optimistic where they have not."""

import math

import numpy as np
import pytest
import torch

from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models import CountsModel, TabularModel
from pgts_torch.models.base import Experience
from pgts_torch.options import Counts
from pgts_torch.search import Topology, expectimax
from pgts_torch.seeding import mix, numpy_stream, stream
from pgts_torch.tabular import TabularMDP, exact
from pgts_torch.tabular.zoo import river_swim
from tests.support import random_policy, zoo

CERTAIN = ["ladder", "tightrope", "combination_lock", "CliffWalking", "Taxi"]
NONE = Counts(optimism="none")


def steps(mdp: TabularMDP, pair_N: torch.Tensor, seed: int = 0) -> Experience:
    """One step of each pair, state * A + action, in the MDP."""
    state_N, action_N = pair_N // mdp.num_actions, pair_N % mdp.num_actions
    key_N = mix(torch.arange(len(pair_N)), seed)
    sampled = TabularModel(mdp).sample(state_N, action_N, key_N=key_N)
    follows_N = torch.zeros(len(pair_N), dtype=torch.bool)
    return Experience(state_N, action_N, sampled.reward_N, sampled.discount_N, sampled.next_state_N, follows_N)


def step(state: int, action: int, reward: float, then: int, discount: float = 0.9) -> Experience:
    columns = (state, action, reward, discount, then, False)
    return Experience(*(torch.tensor([x], dtype=torch.float64 if type(x) is float else None) for x in columns))


def every_pair(mdp: TabularMDP, times: int = 1) -> torch.Tensor:
    return torch.arange(mdp.num_states * mdp.num_actions).repeat(times)


def learned(mdp: TabularMDP, experience: Experience | None, options: Counts = NONE, gamma: float = 0.9) -> CountsModel:
    model = CountsModel(mdp.num_states, mdp.num_actions, gamma=gamma, options=options)
    if experience is not None:
        model.learn(experience, generator=stream(0, "learn"))
    return model


def looked(model: CountsModel, q_SA: torch.Tensor, depth: int) -> torch.Tensor:
    """T^m Q in all states."""
    return expectimax(model, torch.arange(model.num_states), depth=depth, q_leaf=lambda state_N: q_SA[state_N]).q_BA


def unknown(model: CountsModel, state: int, action: int) -> float:
    """The probability of an unknown outcome."""
    return float(model.outcomes(torch.tensor([state])).prob_NAK[0, action, -1])


# What was seen


@pytest.mark.parametrize("depth", [1, 2, 40])
@pytest.mark.parametrize("name", CERTAIN)
def test_a_certain_table_that_was_fully_seen_gives_the_exact_lookahead_bit_for_bit(name, depth):
    mdp = zoo(name)
    q_SA = exact.evaluate(mdp, random_policy(mdp)).q_SA
    truth = exact.lookahead(mdp, q_SA, depth)
    assert looked(learned(mdp, steps(mdp, every_pair(mdp, 3))), q_SA, depth).equal(truth)
    # a pair that was never seen, or another depth, would be noticed
    on = int(torch.nonzero(mdp.outcomes.discount_NAK.flatten() * mdp.outcomes.prob_NAK.flatten())[0])
    rest = every_pair(mdp)[every_pair(mdp) != on]
    assert not looked(learned(mdp, steps(mdp, rest)), q_SA, depth).equal(truth)
    assert depth == 40 or not looked(learned(mdp, steps(mdp, every_pair(mdp))), q_SA, depth - 1).equal(truth)


def test_the_error_falls_with_the_root_of_the_samples_of_each_pair():
    mdp, depth, counts = zoo("garnet"), 4, [16, 64, 256, 1024]
    q_SA = exact.evaluate(mdp, random_policy(mdp)).q_SA
    truth = exact.lookahead(mdp, q_SA, depth)

    def slope(biased: float) -> float:
        errors = []
        for n in counts:
            tables = [learned(mdp, steps(mdp, every_pair(mdp, n), seed)) for seed in range(8)]
            errors.append(np.mean([float((looked(t, q_SA, depth) - truth + biased).square().mean()) for t in tables]))
        return float(np.polyfit(np.log(counts), 0.5 * np.log(errors), 1)[0])

    # Over seeds the slope has a standard deviation of 0.02: outside of 5 of them with a probability below 1e-6.
    assert abs(slope(0.0) + 0.5) < 0.1
    assert slope(0.1) > -0.3


def test_one_call_learns_what_many_calls_do():
    mdp, random = zoo("garnet"), numpy_stream(0, "rewards")
    pair_N = torch.from_numpy(random.integers(0, mdp.num_states * mdp.num_actions, 500))
    experience = steps(mdp, pair_N)._replace(reward_N=torch.from_numpy(random.normal(size=500)))
    one, many = learned(mdp, experience), learned(mdp, None)
    for part in torch.arange(500).split(7):
        many.learn(Experience(*(column[part] for column in experience[:-1])), generator=stream(0, "learn"))
    for name, column in one.state_dict().items():
        assert column.equal(many.state_dict()[name])
    other = learned(mdp, Experience(*(column[1:] for column in experience[:-1])))
    assert not one.outcomes(torch.arange(30)).reward_NA.equal(other.outcomes(torch.arange(30)).reward_NA)
    # Each outcome counts once more than it was seen, with the mean of its rewards.
    seen = list(zip(pair_N.tolist(), experience.next_observation_N.tolist(), strict=True))
    of = {key: [r for k, r in zip(seen, experience.reward_N.tolist(), strict=True) if k == key] for key in set(seen)}
    for pair in range(90):
        mean = [(len(rewards) + 1, sum(rewards) / len(rewards)) for key, rewards in of.items() if key[0] == pair]
        expected = sum(n * r for n, r in mean) / sum(n for n, _ in mean)
        assert float(one.outcomes(torch.tensor([pair // 3])).reward_NA[0, pair % 3]) == pytest.approx(expected)


def test_a_next_state_with_an_end_and_without_one_are_two_outcomes():
    model = CountsModel(3, 2, gamma=0.9, options=NONE)
    for discount, reward in [(0.9, 1.0), (0.0, 4.0), (0.9, 3.0), (0.9, 5.0)]:
        model.learn(step(0, 1, reward, 2, discount), generator=stream(0, "learn"))
    outcomes = model.outcomes(torch.tensor([0]))
    assert outcomes.prob_NAK[0].tolist() == [[0.0, 0.0, 1.0], [2 / 6, 4 / 6, 0.0]]
    assert outcomes.discount_NAK[0, 1].tolist() == [0.0, 0.9, 0.0]
    assert outcomes.child_NAK[0].tolist() == [[0, 0, 0], [2, 2, 0]]
    assert outcomes.reward_NA[0].tolist() == [0.0, pytest.approx(4.0 * 2 / 6 + 3.0 * 4 / 6)]


def test_sampled_outcomes_have_the_probabilities_of_those_that_are_enumerated():
    mdp, options = zoo("FrozenLake"), Counts(optimism="prior", strength=3.0)
    model = learned(mdp, steps(mdp, every_pair(mdp, 5)), options, gamma=0.99)
    state_N, action_N = torch.full((20_000,), 6), torch.ones(20_000, dtype=torch.int64)
    sampled = model.sample(state_N, action_N, key_N=mix(torch.arange(20_000), 1))
    outcomes = model.outcomes(torch.tensor([6]))
    assert set(sampled.reward_N.tolist()) == {float(outcomes.reward_NA[0, 1])}
    # each outcome that was seen leads to another state; the unknown one, which is the last, stays in this one
    p_K, child_K = outcomes.prob_NAK[0, 1], outcomes.child_NAK[0, 1]
    share_S = torch.bincount(sampled.next_state_N, minlength=16) / 20_000
    expected_S = torch.zeros(16, dtype=torch.float64).index_add(0, child_K, p_K)
    assert int((expected_S > 0).sum()) == 3
    # a share has a standard deviation of at most 0.0036: outside of 5 of them with a probability below 1e-5
    assert bool(((share_S - expected_S).abs() < 0.018).all())
    assert set(sampled.discount_N[sampled.next_state_N == 6].tolist()) == {0.0}
    again = model.sample(state_N[:9], action_N[:9], key_N=mix(torch.arange(9), 1))
    assert again.next_state_N.equal(sampled.next_state_N[:9])


# What was not seen


@pytest.mark.parametrize("optimism", ["rmax", "bonus", "prior", "posterior"])
@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("name", CERTAIN)
def test_no_value_is_below_the_optimum_where_a_table_is_optimistic(name, share, optimism):
    mdp = zoo(name)
    best, some = exact.optimal(mdp), torch.from_numpy(numpy_stream(0, "pairs").random(every_pair(mdp).shape)) < share
    value_range = [float(best.v_S.min()), float(best.v_S.max())]

    def values(options: Counts) -> torch.Tensor:
        model = learned(mdp, steps(mdp, every_pair(mdp)[some]), options)
        return looked(model, torch.full_like(best.q_SA, value_range[1]), 300)

    least = best.q_SA - 1e-9
    assert bool((values(Counts(optimism=optimism, value_range=value_range)) >= least).all())
    assert share > 0 or not bool((values(Counts(optimism="none", value_range=value_range)) >= least).all())


def test_the_unknown_becomes_less_probable_with_each_visit_where_outcomes_differ():
    visited = {name: CountsModel(3, 1, gamma=0.9, options=Counts(optimism=name, strength=c)) for name, c in LESS}
    for model in visited.values():
        assert unknown(model, 0, 0) == 1
        model.learn(step(0, 0, 0.0, 1), generator=stream(0, "learn"))
        model.learn(step(0, 0, 0.0, 2), generator=stream(0, "learn"))
    for n in range(2, 12):
        expected = {"rmax": float(n <= 3.5), "bonus": min(1, 2 / math.sqrt(n)), "prior": 2 / (n + 2), "none": 0.0}
        assert {name: unknown(visited[name], 0, 0) for name in expected} == pytest.approx(expected)
        assert unknown(visited["rmax"], 1, 0) == 1
        for model in visited.values():
            model.learn(step(0, 0, 0.0, 2), generator=stream(0, "learn"))


LESS = [("rmax", 3.5), ("bonus", 2.0), ("prior", 2.0), ("none", None)]


def test_the_more_pairs_were_certain_the_less_is_unknown_of_one_that_was_visited_once():
    models = {name: CountsModel(9, 1, gamma=0.9, options=Counts(optimism=name)) for name in ("rmax", "prior", "bonus")}
    for model in models.values():
        model.learn(step(8, 0, 0.0, 1), generator=stream(0, "learn"))
    for repeated in range(8):  # states 0 to 7, visited twice, always with the same outcome
        shares = {name: unknown(model, 8, 0) for name, model in models.items()}
        c = 1 / (1 + repeated)
        assert shares == pytest.approx({"rmax": float(repeated < 4), "prior": c / (1 + c), "bonus": 0.3 * c})
        assert unknown(models["rmax"].plain(), 8, 0) == 0
        for model in models.values():
            for _ in range(2):
                model.learn(step(repeated, 0, 0.0, 1), generator=stream(0, "learn"))


def test_sampled_probabilities_have_the_mean_of_the_prior_and_change_with_each_call():
    model = CountsModel(3, 1, gamma=0.9, options=Counts(optimism="posterior", strength=2.0))
    generator, samples = stream(0, "learn"), []
    for _ in range(3):
        model.learn(step(0, 0, 0.0, 1), generator=generator)
    for n in range(4, 1004):
        model.learn(step(1, 0, 0.0, 1 + n % 2), generator=generator)
        samples.append(unknown(model, 0, 0))
    # Dirichlet(3 + 1, 2): mean 1/3, standard deviation 0.178
    assert np.mean(samples[1:]) == pytest.approx(1 / 3, abs=5 * 0.178 / math.sqrt(1000))
    assert np.std(samples[1:]) == pytest.approx(0.178, rel=0.15)
    assert len(set(samples[1:])) == 999


@pytest.mark.parametrize(
    ("paid", "expected"),
    [
        ([], (0, 1)),
        ([(0, True)], (0, 1)),
        ([(-1, True)], (-10, 0)),
        ([(-1, True), (-20, False)], (-20, 0)),
        ([(-1, True), (0, True)], (-10, 10)),
        ([(-1, True), (20, False)], (-10, 20)),
        ([(1, True), (5, False)], (0, 10)),
        ([(0, True), (1, False)], (0, 1)),
    ],
)
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e6])
def test_the_unknown_is_worth_what_the_rewards_seen_allow(paid, expected, scale):
    model = CountsModel(4, 1, gamma=0.9)
    for state, (reward, goes_on) in enumerate(paid):
        model.learn(step(state, 0, scale * reward, 1, 0.9 * goes_on), generator=stream(0, "learn"))
    scale = scale if any(reward for reward, _ in paid) else 1.0
    assert model.value_range == pytest.approx((scale * expected[0], scale * expected[1]))
    lasting = max((2 * scale * reward / (1 - 0.9) for reward, goes_on in paid if goes_on), default=0)
    assert model.unknown_worth == pytest.approx(max(model.value_range[1], lasting))
    assert model.plain().unknown_worth == model.value_range[0]


def test_a_small_reward_that_can_be_had_for_ever_is_left_for_what_is_unknown():
    mdp = river_swim(6)

    def farthest(options: Counts) -> int:
        """The last state that is visited in 600 steps which are optimal in the table so far."""
        model, state, last = learned(mdp, None, options, gamma=0.99), 0, 0
        q_SA = torch.zeros(mdp.num_states, mdp.num_actions, dtype=torch.float64)
        best_S = looked(model, q_SA, 200).argmax(-1)
        for number in range(600):
            pair_1 = torch.tensor([state * mdp.num_actions + int(best_S[state])])
            made = steps(mdp, pair_1, seed=number)
            model.learn(made, generator=stream(number, "learn"))
            if model.is_news(made.observation_N, made.action_N) or number % 20 == 0:
                best_S = looked(model, q_SA, 200).argmax(-1)
            state = int(made.next_observation_N)
            last = max(last, state)
        return last

    assert farthest(Counts(optimism="prior")) == mdp.num_states - 1
    assert farthest(Counts(optimism="prior", value_range=[0.0, 0.5])) <= 1  # what staying is worth


@pytest.mark.parametrize("optimism", ["rmax", "bonus", "prior", "posterior", "none"])
def test_rewards_in_another_unit_give_values_in_that_unit(optimism):
    mdp = zoo("FrozenLake")
    experience = steps(mdp, every_pair(mdp, 4)[:230])
    q_SA = torch.zeros(mdp.num_states, mdp.num_actions, dtype=torch.float64)

    def values(unit: float) -> torch.Tensor:
        scaled = experience._replace(reward_N=unit * experience.reward_N)
        return looked(learned(mdp, scaled, Counts(optimism=optimism), 0.99), q_SA, 20)

    assert bool((values(1.0) > 0).any())
    assert values(2.0**20).equal(2.0**20 * values(1.0))
    for unit in (1e-3, 1e6):
        torch.testing.assert_close(values(unit), unit * values(1.0), rtol=1e-12, atol=0)


# Learning beside a search


def news(model: CountsModel, visits: int) -> list[int]:
    """At which visit to state 0 learning was worth it, if all visits are learned then."""
    found, pending = [], []
    for n in range(1, visits + 1):
        pending.append(step(0, 0, 0.0, 1))
        if model.is_news(torch.tensor([2, 0]), torch.tensor([0, 0])):
            found.append(n)
            for each in pending:
                model.learn(each, generator=stream(0, "learn"))
            pending = []
    return found


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (Counts(optimism="bonus"), [1, 2, 4, 8, 16, 32]),
        (Counts(optimism="rmax", strength=4.0), [5, 10, 20, 40]),
        (NONE, [1]),
    ],
)
def test_steps_are_news_when_a_pair_becomes_known_or_has_been_seen_twice_as_often(options, expected):
    model = CountsModel(3, 1, gamma=0.9, options=options)
    often = Experience(*(column.repeat(1000) for column in step(2, 0, 0.0, 2)[:-1]))
    model.learn(often, generator=stream(0, "learn"))
    if options != NONE:  # one outcome more; without it everything is certain
        model.learn(step(2, 0, 0.0, 1), generator=stream(0, "learn"))
    assert news(model, 50) == expected


def test_a_plain_table_learns_with_the_optimistic_one_and_a_search_notices():
    model = CountsModel(3, 1, gamma=0.9, options=Counts(value_range=[-5.0, 7.0]))
    plain = model.plain()
    topology = Topology(plain)

    def q(of: CountsModel) -> list[float]:
        return of.outcomes(torch.arange(3)).reward_NA.flatten().tolist()

    assert (q(model), q(plain)) == ([7.0, 7.0, 7.0], [-5.0, -5.0, -5.0])
    expectimax(plain, torch.tensor([0]), depth=0, v_leaf=lambda state_N: state_N.double(), topology=topology)
    model.learn(step(0, 0, 2.0, 1), generator=stream(0, "learn"))
    assert (q(model), q(plain)) == ([(2.0 + 7.0) / 2, 7.0, 7.0], [2.0, -5.0, -5.0])
    with pytest.raises(PgtsError, match="new topology"):
        expectimax(plain, torch.tensor([0]), depth=0, v_leaf=lambda state_N: state_N.double(), topology=topology)
    before = model.generation
    model.learn(Experience(*(column[:0] for column in step(0, 0, 2.0, 1)[:-1])), generator=stream(0, "learn"))
    assert model.generation == before
    assert (model.exact, model.is_certain, model.highest_value) == (False, False, math.inf)


@pytest.mark.parametrize("optimism", ["rmax", "posterior"])
def test_a_loaded_table_goes_on_with_the_bits_of_the_saved_one(optimism):
    mdp, options = zoo("garnet"), Counts(optimism=optimism)
    model, other = learned(mdp, steps(mdp, every_pair(mdp, 3)), options), learned(mdp, None, options)
    generation = other.generation
    other.load_state_dict(model.state_dict())
    assert other.generation > generation
    for _ in range(2):
        for name, column in vars(model.outcomes(torch.arange(30))).items():
            assert torch.as_tensor(column).equal(torch.as_tensor(getattr(other.outcomes(torch.arange(30)), name)))
        for each in (model, other):
            each.learn(steps(mdp, every_pair(mdp), 7), generator=stream(1, "learn"))


# Bad input


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("pair_C", [0, 3, 6]),
        ("pair_C", [0, 4, 3]),
        ("next_C", [0, 1, 3]),
        ("discount_C", [0.9, 0.9, math.nan]),
        ("count_C", [1, 0, 1]),
        ("base_C", [0.0, math.inf, 0.0]),
        ("excess_C", [0.0, 0.0]),
        ("count_C", [1.0, 1.0, 1.0]),
        ("share_C", None),
        ("unknown_C", [0.0, 0.0, -1.0]),
    ],
)
def test_a_state_that_is_no_table_is_refused_and_nothing_is_loaded(name, column):
    model = CountsModel(3, 2, gamma=0.9, options=Counts(optimism="posterior"))
    for pair in (0, 3, 4):
        model.learn(step(pair // 2, pair % 2, 1.0, pair // 2), generator=stream(0, "learn"))
    state = model.state_dict()
    changed = state | {name: None if column is None else torch.tensor(column)}
    with pytest.raises(PgtsError, match=name if name != "pair_C" else "pair_C|the order"):
        model.load_state_dict(changed)
    assert model.state_dict()["pair_C"].equal(state["pair_C"])
    model.load_state_dict(state)


@pytest.mark.parametrize(
    ("column", "value", "match"),
    [
        ("observation_N", torch.tensor([3]), r"observation_N\[0\] is 3; it must be 0 to 2"),
        ("next_observation_N", torch.tensor([-1]), "next_observation_N"),
        ("action_N", torch.tensor([2]), "action_N.* 0 to 1"),
        ("observation_N", torch.tensor([[0.5, 1.0]]), "observation_N is float32.*ensemble"),
        ("discount_N", torch.tensor([1.5]), r"discount_N\[0\] is 1.5"),
        ("discount_N", torch.tensor([math.nan]), "discount_N"),
        ("reward_N", torch.tensor([math.nan]), "reward"),
    ],
)
def test_steps_that_cannot_be_counted_are_refused_and_nothing_is_learned(column, value, match):
    model = CountsModel(3, 2, gamma=0.9)
    with pytest.raises(NotFinite if column == "reward_N" else PgtsError, match=match):
        model.learn(step(0, 0, 1.0, 1)._replace(**{column: value}), generator=stream(0, "learn"))
    assert model.generation == 0


def test_options_that_cannot_be_used_are_refused():
    with pytest.raises(PgtsError, match="give value_range"):
        CountsModel(3, 2, gamma=1.0)
    with pytest.raises(PgtsError, match="num_states is 0"):
        CountsModel(0, 2, gamma=0.9)
    with pytest.raises(PgtsError, match="strength is 2"):
        Counts(optimism="none", strength=2.0)
    with pytest.raises(PgtsError, match="the lower number comes first"):
        Counts(value_range=[1.0, 0.0])
