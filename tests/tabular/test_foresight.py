"""What a training from rollouts is foreseen to do, beside Algorithm 1, plain chains, and trainings."""

import numpy as np
import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import PgtsError
from pgts_torch.options.updates import Mirror, Projected, SoftmaxGradient
from pgts_torch.tabular import exact, ladder, random_mdp
from pgts_torch.tabular.ascent import ascend, mirror_step, projected_step, softmax_step
from pgts_torch.tabular.foresight import expected_visits, foresee
from tests.support import always, random_policy, uniform_policy, weights

pytestmark = pytest.mark.usefixtures("unchecked_shapes")
ALL_SEEN = {"num_envs": 10**12, "length": 300, "trace": 1.0, "critic_step_size": 1.0}
"""Rollouts that hide nothing."""


UPDATES = [
    (Projected(step_size=0.7), projected_step),
    (SoftmaxGradient(step_size=0.7), softmax_step),
    (Mirror(step_size=0.7, normalize="none", floor="never", state_weight="occupancy"), mirror_step),
]


@pytest.mark.parametrize(("update", "step"), UPDATES)
def test_where_rollouts_hide_nothing_it_is_algorithm_1(update, step):
    differs = 0
    for seed in range(5):
        mdp = random_mdp(6, branching=2, reward_share=0.3, gamma=0.8, seed=seed)
        pi_SA = random_policy(mdp, seed)
        J_K = ascend(mdp, pi_SA, depth=seed % 3, step_size=0.7, iterations=15, step=step).J_K
        settings = {"iterations": 15, "update": update} | ALL_SEEN
        assert foresee(mdp, pi_SA, depth=seed % 3, **settings).J_K == pytest.approx(J_K.numpy(), abs=1e-6)
        other_K = foresee(mdp, pi_SA, depth=5, **settings).J_K
        differs += float((other_K - J_K).abs().max()) > 1e-3
    assert differs >= 2, "another depth is another training"


def test_with_weight_1_every_state_that_is_surely_visited_takes_the_whole_step():
    mdp = random_mdp(6, gamma=0.8)
    pi_SA = uniform_policy(mdp)
    settings = {"depth": 1, "iterations": 1, "update": Projected(step_size=0.3, state_weight="uniform")}
    look_SA = exact.lookahead(mdp, exact.evaluate(mdp, pi_SA).q_SA, 1)
    moved_SA = projected_step(pi_SA, look_SA, torch.ones(6).double(), 0.3)
    assert torch.allclose(foresee(mdp, pi_SA, **settings, **ALL_SEEN).pi_SA, moved_SA, atol=1e-6)


def test_expected_visits_are_those_of_a_chain_that_ends_where_it_is_looked_for():
    for seed in range(10):
        mdp = random_mdp(7, branching=2, seed=seed)
        pi_SA, n, length = random_policy(mdp, seed), 3, 9
        P_SS = np.einsum("sa,sat->st", pi_SA.numpy(), weights(mdp)) / 0.9
        visits_S, occupancy_S, visited_S = expected_visits(mdp, pi_SA, num_envs=n, length=length)
        powers = [np.linalg.matrix_power(P_SS, t)[0] for t in range(length)]
        assert visits_S.numpy() == pytest.approx(sum(powers))
        assert occupancy_S.numpy() == pytest.approx(sum(0.9**t * row_S for t, row_S in enumerate(powers)))
        for s in range(7):
            stops_SS = P_SS.copy()
            stops_SS[s] = np.eye(7)[s]
            found = np.linalg.matrix_power(stops_SS, length - 1)[0, s]
            assert float(visited_S[s]) == pytest.approx(1 - (1 - found) ** n)
        assert float(visits_S.sum()) == pytest.approx(length)


def test_what_no_rollout_reaches_is_not_foreseen_to_be_learned():
    mdp, settings = ladder(5), {"update": Projected(step_size=1.0), "iterations": 40, "length": 30}
    nearly_SA = 0.999 * always(mdp, 0) + 0.001 * always(mdp, 1)
    never = foresee(mdp, nearly_SA, depth=3, **settings).J_K
    found = foresee(mdp, nearly_SA, depth=4, **settings).J_K
    assert never[-1] < 1e-3
    assert found[-1] > 6.5
    assert foresee(mdp, uniform_policy(mdp), depth=0, num_envs=200, **settings).J_K[-1] > 6.5


@pytest.mark.parametrize(
    "update",
    [SoftmaxGradient(step_size=3.0), Projected(step_size=0.2, state_weight="uniform"), Mirror(step_size=0.3)],
)
def test_trainings_come_to_what_is_foreseen(update):
    mdp, length, iterations = random_mdp(8, branching=2, reward_share=0.2, gamma=0.8, seed=4), 20, 12
    settings = {"update": update, "iterations": iterations, "length": length}
    foreseen = {depth: foresee(mdp, uniform_policy(mdp), depth=depth, **settings).J_K for depth in (0, 2)}
    runs = []
    for seed in range(3):
        model = PGTS(
            TabularVectorEnv(mdp, 16, autoreset_mode="Disabled"),
            depth=2,
            seed=seed,
            horizon={"type": "fixed", "length": length},
            policy="simplex" if isinstance(update, Projected) else "softmax",
            update=update,
        )
        J = [exact.evaluate(mdp, model.policy_table()).J]
        for _ in range(iterations):
            model.iterate()
            J.append(exact.evaluate(mdp, model.policy_table()).J)
        runs.append(J)
    way = exact.optimal(mdp).J - runs[0][0]
    off = {m: float(np.abs(np.mean(runs, axis=0) - J_K.numpy()).max()) for m, J_K in foreseen.items()}
    assert off[2] < 0.1 * way
    assert off[0] > 1.5 * off[2], "another depth does not fit as well"


def test_bad_settings_are_named():
    mdp = ladder(3)
    with pytest.raises(PgtsError, match="num_envs is 0"):
        foresee(mdp, uniform_policy(mdp), depth=0, iterations=1, num_envs=0)
    with pytest.raises(PgtsError, match="depth is -1"):
        foresee(mdp, uniform_policy(mdp), depth=-1, iterations=1)
    with pytest.raises(PgtsError, match="not a schedule"):
        foresee(mdp, uniform_policy(mdp), depth=0, iterations=1, update=Projected(step_size="linear(1, 0.1, 1000)"))
