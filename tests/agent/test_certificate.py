"""A certificate is true or it is not called proved."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from pgts_torch.agent.pgts import PGTS
from pgts_torch.bellman import Outcomes
from pgts_torch.errors import PgtsError
from pgts_torch.search.upper import UpperBound
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular import TabularMDP, exact, random_mdp
from tests import reliability
from tests.agent.helpers import vector_env

ROUNDING = 1e-11
"""In units of the largest value: of the optimum that the certificates are held to."""


def random_case(seed: int) -> tuple[TabularMDP, dict]:
    """A random MDP, its episodes begin in several states, and random options."""
    random = numpy_stream(seed, "certificates")
    S, A, K = (int(random.integers(low, high)) for low, high in ((2, 12), (2, 4), (1, 4)))
    gamma = float(random.choice([0.7, 0.9, 0.97]))
    ends = random.random((S, A, K)) < random.choice([0.0, 0.1, 0.3])
    outcomes = Outcomes(
        torch.from_numpy(random.normal(random.choice([-1, 0, 1]), 1, (S, A)) * float(random.choice([1e-3, 1, 1e6]))),
        torch.from_numpy(random.dirichlet(np.ones(K), size=(S, A))),
        torch.from_numpy(np.where(ends, 0.0, gamma)),
        torch.from_numpy(random.integers(0, S, size=(S, A, K))),
        S,
    )
    start_S = random.dirichlet(np.full(S, random.choice([0.1, 1.0])))
    mdp = TabularMDP(outcomes, torch.from_numpy(start_S / start_S.sum()))
    missing = exact.optimal(mdp).J - exact.evaluate(mdp, torch.full((S, A), 1 / A, dtype=torch.float64)).J
    arguments = {
        "depth": random.choice(["adaptive", 0, 1, 4, 30]).item(),
        "stop_at": missing * float(random.choice([0.02, 0.3, 0.8])),
        "horizon": {"type": "fixed", "length": 5},
        "critic": {"type": "exact", "target": str(random.choice(["v", "q"]))},
        "update": {"type": "mirror", "step_size": 0.5 / max(missing, 1e-9), "state_weight": "uniform"},
    }
    arguments["depth"] = arguments["depth"] if arguments["depth"] == "adaptive" else int(arguments["depth"])
    return mdp, arguments


def false_proofs(seeds: range, iterations: int) -> tuple[int, int, int]:
    """How many certificates of so many runs, and how many means over the starts that episodes happened to have, are
    below what is missing; and how many runs were ended by their certificate."""
    wrong, wrong_of_drawn, ended = 0, 0, 0
    for seed in seeds:
        mdp, arguments = random_case(seed)
        optimum = exact.optimal(mdp)
        slack = ROUNDING * float(optimum.q_SA.abs().max())
        model = PGTS(vector_env(mdp, 1 + seed % 3), seed=seed, **arguments)
        assert model.certificates.trust == "proved"
        for _ in range(iterations):
            evaluation = exact.evaluate(mdp, model.policy.table())
            missing = optimum.J - evaluation.J
            iteration = model.iterate()
            wrong += iteration.certificate < missing - slack
            drawn = iteration.experience.state_TB[0]
            again = UpperBound(model.search.topology, model.world.model.highest_value, gamma=model.gamma)
            again.tighten(32)
            wrong_of_drawn += float((again.at(drawn) - evaluation.v_S[drawn]).mean()) < missing - slack
            if iteration.certificate <= arguments["stop_at"]:
                ended += 1
                break
    return wrong, wrong_of_drawn, ended


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.fault("an episode that begins in one of several states")
def test_no_certificate_of_an_exact_critic_is_below_the_gap_but_a_mean_over_sampled_starts_is():
    wrong, wrong_of_drawn, ended = false_proofs(range(12), iterations=5)
    assert wrong == 0
    assert wrong_of_drawn > 10
    assert ended >= 1


@pytest.mark.long
@pytest.mark.usefixtures("unchecked_shapes")
def test_none_of_a_thousand_runs_proves_something_false():
    wrong, wrong_of_drawn, ended = false_proofs(range(1000), iterations=40)
    assert wrong == 0
    assert wrong_of_drawn > 1000
    assert ended > 300
    reliability.record("certificates in runs on random MDPs", runs=1000, false=wrong, ended_by_one=ended)


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_policy_that_is_bad_from_a_start_that_was_not_sampled_is_not_proved():
    model = PGTS(
        "pgts/Tightrope-v0", env_kwargs={"start": None}, critic="exact", depth=200, stop_at=20.0, num_envs=1, seed=0
    )
    model.learn(20_000)
    assert model.num_env_steps < 20_000
    assert exact.optimal(model.mdp).J - exact.evaluate(model.mdp, model.policy_table()).J <= 20


@pytest.mark.long
@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("critic", ["exact", "tabular"])
def test_taxi_ends_by_its_certificate_and_is_within_it(critic):
    model = PGTS("Taxi-v4", gamma=0.99, depth="adaptive", stop_at=0.05, critic=critic, seed=0).learn(200_000)
    assert model.num_env_steps < 200_000
    assert exact.optimal(model.mdp).J - exact.evaluate(model.mdp, model.policy_table()).J <= 0.05


def test_a_start_that_no_search_has_expanded_counts_as_the_highest_value():
    apart = TabularMDP.from_dense(
        np.eye(2)[:, None].repeat(2, 1), np.array([[1.0, 0.0], [0.0, 1.0]]), 0.5, start=None, order="SAS"
    )
    model = PGTS(vector_env(apart, 1), critic="exact", depth=8, seed=1)
    visited = model.iterate()
    assert visited.state_N.tolist() in ([0], [1])
    # It loses 1 of the 2 that are to be had in each state, and the other one is known to be worth at most 2.
    assert visited.certificate == pytest.approx(1.0, abs=1e-9)
    while len(model.search.topology.table.queried) == 1:
        model.iterate()
    missing = 2 - exact.evaluate(apart, model.policy.table()).J
    assert model.iterate().certificate == pytest.approx(missing, abs=1e-9)


@pytest.mark.parametrize(
    ("arguments", "trust"),
    [
        ({"critic": "exact"}, "proved"),
        ({"critic": "tabular"}, "critic"),
        ({"critic": "rollout"}, "critic"),
        ({"critic": "exact", "search": {"type": "mcts", "simulations": 4}}, "proved"),
    ],
)
def test_only_an_exact_critic_in_a_table_proves(arguments, trust):
    model = PGTS("pgts/Ladder-v0", num_envs=2, **arguments)
    assert math.isfinite(model.iterate().certificate)
    assert model.certificates.trust == trust


def test_starts_that_are_known_from_resets_only_prove_nothing(monkeypatch):
    model = PGTS("pgts/Ladder-v0", num_envs=2, critic="exact")
    monkeypatch.setattr(model.world, "start_S", None)
    assert model.certificates.trust == "sampled starts"
    assert model.iterate().certificate == math.inf  # two starts say too little


def test_an_estimate_over_sampled_starts_is_above_the_gap_and_narrows_with_their_number():
    """Hoeffding: by exactly span sqrt(ln(1 / alpha) / 2n) above the mean, alpha = 0.05 * 6 / pi^2 in iteration 1."""
    mdp = TabularMDP.from_dense(
        np.eye(2)[:, None].repeat(2, 1), np.array([[1.0, 0.0], [0.0, 1.0]]), 0.5, start=None, order="SAS"
    )
    for num_envs in (200, 3_200):
        model = PGTS(vector_env(mdp, num_envs), critic="exact", depth=20)
        model.world.start_S = None
        width = 2 * math.sqrt(math.log(math.pi**2 / 0.3) / (2 * num_envs))
        assert model.iterate().certificate == pytest.approx(1 + width, abs=1e-5)


def test_a_pruned_lookahead_has_no_certificate_where_starts_are_sampled():
    mdp = random_mdp(30, 3, branching=2, seed=0, gamma=0.5, start=None)
    for width, is_known in ((None, True), (3, False)):
        model = PGTS(vector_env(mdp, 3_200), critic="exact", depth=3, search={"type": "expectimax", "max_width": width})
        model.world.start_S = None
        assert math.isfinite(model.iterate().certificate) is is_known


@pytest.mark.parametrize(
    ("env", "arguments"),
    [
        ("pgts/Random-v0", {"depth": 2, "critic": "exact", "env_kwargs": {"start": None}}),
        ("pgts/Grid-v0", {"depth": "adaptive", "max_depth": 6}),
        ("FrozenLake-v1", {"depth": 2, "gamma": 1.0}),
    ],
)
def test_a_loaded_model_has_the_certificates_of_the_one_that_went_on(env, arguments, tmp_path):
    whole = PGTS(env, num_envs=2, seed=1, **arguments)
    for _ in range(2):
        whole.iterate()
    whole.save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt")
    for _ in range(3):
        assert whole.iterate().certificate == loaded.iterate().certificate


@pytest.mark.parametrize("damaged", [lambda x: x[:-1], lambda x: x * math.nan, lambda x: None])
def test_invalid_saved_bounds_are_refused(damaged):
    model = PGTS("pgts/Ladder-v0", num_envs=2, depth=0)
    model.iterate()
    state = model.state_dict()
    upper = state["searches"][0]["upper"]
    upper["bound"] = damaged(upper["bound"])
    with pytest.raises(PgtsError, match=r"bound is|not finite"):
        model.load_state_dict(state)


def test_the_error_of_an_exact_critic_covers_its_rounding():
    """Held to the same equation in fractions of arbitrary precision."""
    for seed in range(5):
        mdp = random_mdp(6, 2, branching=2, seed=seed, gamma=0.99)
        model = PGTS(vector_env(mdp, 1), critic="exact")
        pi_SA = model.policy.table()
        model.iterate()
        truth = float(sum(p * v for p, v in zip(map(Fraction, mdp.start_S.tolist()), solved(mdp, pi_SA), strict=True)))
        off = abs(exact.evaluate(mdp, pi_SA).J - truth)
        assert off <= model.critic.error < 1e-10 * max(1.0, abs(truth))


def solved(mdp: TabularMDP, pi_SA: torch.Tensor) -> list[Fraction]:
    """v^pi by Gauss-Jordan elimination in fractions."""
    S, A, K = mdp.outcomes.child_NAK.shape
    rows = [[Fraction(int(s == t)) for t in range(S)] + [Fraction(0)] for s in range(S)]
    for s, a in np.ndindex(S, A):
        p_a = Fraction(float(pi_SA[s, a]))
        rows[s][S] += p_a * Fraction(float(mdp.outcomes.reward_NA[s, a]))
        for k in range(K):
            weight = Fraction(float(mdp.outcomes.prob_NAK[s, a, k])) * Fraction(
                float(mdp.outcomes.discount_NAK[s, a, k])
            )
            rows[s][int(mdp.outcomes.child_NAK[s, a, k])] -= p_a * weight
    for s in range(S):
        rows[s] = [x / rows[s][s] for x in rows[s]]
        for t in range(S):
            if t != s:
                rows[t] = [x - rows[t][s] * y for x, y in zip(rows[t], rows[s], strict=True)]
    return [row[S] for row in rows]
