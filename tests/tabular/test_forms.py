"""The forms in which transitions and rewards are stored elsewhere all give the same MDP."""

import numpy as np
import pytest
import scipy.sparse as sp

from pgts_torch.errors import PgtsError
from pgts_torch.tabular import TabularMDP, exact
from tests.support import weights

S, A = 5, 3


def problem(num_states: int = S, num_actions: int = A) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P[s, a, s'], a reward of each entry, and the expected ones; some entries of P are 0."""
    random = np.random.default_rng(7)
    P = random.dirichlet(np.ones(num_states) * 0.3, size=(num_states, num_actions))
    P[P < 0.02] = 0
    P /= P.sum(-1, keepdims=True)
    R = random.normal(size=P.shape).round(1)
    return P, R, (P * R).sum(-1)


P_SAS, R_SAS, R_SA = problem()
P_ASS, R_ASS = P_SAS.swapaxes(0, 1), R_SAS.swapaxes(0, 1)
MATRICES = [sp.csr_matrix(P) for P in P_ASS]
REWARD_MATRICES = [sp.coo_array(R * (P > 0)) for R, P in zip(R_ASS, P_ASS, strict=True)]

FORMS = {
    "state first": (P_SAS, R_SA, None),
    "action first": (P_ASS, R_SA, None),
    "action first, said": (P_ASS, R_SA, "ASS"),
    "nested lists": (P_SAS.tolist(), R_SA.tolist(), "SAS"),
    "a tuple of dense matrices": (tuple(P_ASS), R_SA, None),
    "a list of csr": (MATRICES, R_SA, None),
    "a tuple of csc and dense": ((sp.csc_array(P_ASS[0]), P_ASS[1], MATRICES[2]), R_SA, None),
    "an array of csr": (np.array([*MATRICES, None], dtype=object)[:A], R_SA, None),
    "one matrix, state first": (sp.csr_matrix(P_SAS.reshape(S * A, S)), R_SA, "SAS"),
    "one matrix, action first": (sp.vstack(MATRICES), R_SA, "ASS"),
    "rewards of outcomes, state first": (P_SAS, R_SAS, None),
    "rewards of outcomes, action first": (P_ASS, R_ASS, None),
    "sparse, dense rewards of outcomes": (MATRICES, R_ASS, None),
    "sparse, sparse rewards of outcomes": (MATRICES, REWARD_MATRICES, None),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_same_mdp(form):
    P, R, order = FORMS[form]
    mdp = TabularMDP.from_dense(P, R, 0.9, order=order)
    np.testing.assert_allclose(weights(mdp), 0.9 * P_SAS, rtol=1e-15)
    np.testing.assert_allclose(mdp.outcomes.reward_NA, R_SA, rtol=1e-12, atol=1e-15)


def test_the_reward_of_each_outcome_is_kept_where_it_differs():
    for P, R in [(P_SAS, R_SAS), (P_ASS, R_ASS), (MATRICES, REWARD_MATRICES)]:
        mdp = TabularMDP.from_dense(P, R, 0.9)
        happens = (mdp.outcomes.prob_NAK > 0).numpy()
        kept = np.take_along_axis(R_SAS, mdp.outcomes.child_NAK.numpy(), axis=-1)
        assert np.array_equal(mdp.outcome_reward_SAK.numpy()[happens], kept[happens])


def test_rewards_of_states_are_those_of_all_actions():
    mdp = TabularMDP.from_dense(MATRICES, np.arange(5.0), 0.9)
    assert mdp.outcomes.reward_NA.tolist() == [[s] * A for s in range(S)]


def test_equal_rewards_of_outcomes_have_exactly_their_mean():
    equal = np.full((S, A, S), 0.1)
    mdp = TabularMDP.from_dense(P_SAS, equal, 0.9)
    assert (mdp.outcomes.reward_NA == 0.1).all()
    assert mdp.reward_SAK is None


def test_duplicate_entries_of_a_sparse_matrix_are_added():
    row, column, p = [0, 0, 1], [1, 1, 0], [0.25, 0.75, 1.0]
    mdp = TabularMDP.from_dense([sp.coo_matrix((p, (row, column)), shape=(2, 2))], np.zeros((2, 1)), 0.9)
    assert weights(mdp)[:, 0].tolist() == [[0, 0.9], [0.9, 0]]


def test_the_matrices_given_are_not_changed():
    matrix = sp.csr_matrix((np.array([1.0, 0.0, 1.0]), np.array([1, 0, 0]), np.array([0, 2, 3])), shape=(2, 2))
    TabularMDP.from_dense([matrix], np.zeros(2), 0.9)
    assert matrix.nnz == 3
    assert matrix.indices.tolist() == [1, 0, 0]


def test_a_large_sparse_mdp_is_never_made_dense():
    num_states, num_outcomes = 20_000, 3  # dense: 2 * 20,000^2 numbers, 6 GB
    random = np.random.default_rng(0)
    indices = np.sort(random.integers(num_states, size=(2, num_states, num_outcomes)), -1)
    indptr = np.arange(0, num_states * num_outcomes + 1, num_outcomes)
    data = random.dirichlet(np.ones(num_outcomes), size=(2, num_states))
    shape = num_states, num_states
    P = [sp.csr_array((d.reshape(-1), i.reshape(-1), indptr), shape=shape) for d, i in zip(data, indices, strict=True)]
    mdp = TabularMDP.from_dense(P, np.ones(num_states), 0.5)
    assert mdp.outcomes.child_NAK.shape == (num_states, 2, num_outcomes)
    assert exact.optimal(mdp).v_S.sub(2).abs().max() < 1e-6


# Orders


@pytest.mark.fault("an order of states and actions that nothing tells")
def test_an_order_that_nothing_tells_is_refused_unless_it_is_said():
    P, R, expected = problem(3, 3)
    with pytest.raises(PgtsError, match=r"P_SAS has shape \(3, 3, 3\), which does not tell .* give order='SAS'"):
        TabularMDP.from_dense(P, expected, 0.9)
    for given, rewards, order in [(P, R, "SAS"), (P.swapaxes(0, 1), R.swapaxes(0, 1), "ASS")]:
        mdp = TabularMDP.from_dense(given, rewards, 0.9, order=order)
        np.testing.assert_allclose(weights(mdp), 0.9 * P, rtol=1e-15)
        np.testing.assert_allclose(mdp.outcomes.reward_NA, expected, rtol=1e-12)
    other = TabularMDP.from_dense(P, expected, 0.9, order="ASS")
    assert not np.allclose(weights(other), 0.9 * P), "the order matters here"


def test_where_both_orders_are_the_same_none_is_asked_for():
    here, there = [1.0, 0.0], [0.0, 1.0]
    TabularMDP.from_dense([[here, there], [there, here]], [[0.0, 2.0], [1.0, 0.0]], 0.9)
    with pytest.raises(PgtsError, match=r"R_SA has shape \(2, 2, 2\), which does not tell"):
        TabularMDP.from_dense([[here, there], [there, here]], np.arange(8).reshape(2, 2, 2), 0.9)


def with_entry(value: float) -> np.ndarray:
    P = P_SAS.copy()
    P[1, 0, 1] = P[2, 1, 2] = value
    return P


MISTAKES = {
    "P_SAS has shape (5, 5); it must be [S, A, S] with at least one state and one action": (P_SAS[:, 0], R_SA, None),
    "P_SAS has shape (0, 2, 0); it must be [S, A, S]": (np.ones((0, 2, 0)), np.ones((0, 2)), None),
    "P_SAS has shape (5, 0, 5); it must be [S, A, S]": (P_SAS[:, :0], R_SA[:, :0], None),
    "P_SAS[1, 0, 1] is -0.5; probabilities are": (with_entry(-0.5), R_SA, None),
    "P_SAS[1, 0, 1] is nan; probabilities are": (with_entry(np.nan), R_SA, None),
    "P_SAS[1, 0] is not a distribution: it sums to": (with_entry(0.9), R_SA, None),
    "P_SAS has shape (3, 5, 5); it must be [S, A, S]": (P_ASS, R_SA, "SAS"),
    "P_SAS has shape (5, 3, 5); it must be [A, S, S]": (P_SAS, R_SA, "ASS"),
    "order is 'AS'; it must be 'SAS' or 'ASS'": (P_SAS, R_SA, "AS"),
    "P is a list of matrices, one for each action": (MATRICES, R_SA, "SAS"),
    "P is one matrix of shape (15, 5): give order='SAS' if row s * 3 + a": (sp.vstack(MATRICES), R_SA, None),
    "P has shape (7, 5); a single sparse matrix must be [S A, S]": (sp.csr_matrix((7, 5)), R_SA, "SAS"),
    "P[1] has shape (4, 4); P must hold one matrix [S, S]": ([sp.eye(5), sp.eye(4)], R_SA, None),
    "P_SAS[2, 1] is not a distribution: it sums to 0.5": (
        [sp.eye(5), sp.diags([1.0, 1, 0.5, 1, 1])],
        R_SA[:, :2],
        None,
    ),
    "P_SAS[3, 0] is not a distribution: it sums to 0": ([sp.diags([1.0, 1, 1, 0, 1])], R_SA[:, :1], None),
    "P_SAS[4, 0, 4] is -1.0; probabilities are": ([sp.diags([1.0, 1, 1, 1, -1])], R_SA[:, :1], None),
    "P_SAS[0, 1, 0] is nan; probabilities are": ([sp.eye(5), sp.diags([np.nan, 1, 1, 1, 1])], R_SA[:, :2], None),
    "R_SA has shape (3, 5); P_SAS needs (5, 3), or (5,) where": (P_SAS, R_SA.T, None),
    "R_SA has shape (3,); P_SAS needs": (P_SAS, np.zeros(3), None),
    "R_SA has shape (3, 5, 5); P_SAS needs": (P_SAS, R_ASS, None),
    "R[1] has shape (4, 4)": (MATRICES, [sp.eye(5), sp.eye(4), sp.eye(5)], None),
    "R is a list of 2 matrices": (MATRICES, [sp.eye(5)] * 2, None),
    "R_SA[0, 1] is inf; rewards must be finite": (P_SAS, np.where(np.eye(5, 3, 1), np.inf, 0), None),
}


@pytest.mark.parametrize("message", MISTAKES)
def test_a_mistake_is_named_with_its_place_and_value(message):
    P, R, order = MISTAKES[message]
    with pytest.raises(PgtsError) as refused:
        TabularMDP.from_dense(P, R, 0.9, order=order)
    assert str(refused.value).startswith(message)


# Rows that were rounded when they were stored


@pytest.mark.fault("rows rounded when they were stored")
def test_rows_stored_in_float32_are_divided_by_their_sums():
    P = np.random.default_rng(0).dirichlet(np.ones(50), (50, 3)).astype(np.float32)
    stored = P.astype(np.float64)
    assert 1e-9 < abs(stored.sum(-1) - 1).max() < 1e-6
    mdp = TabularMDP.from_dense(P, np.zeros((50, 3)), 1.0, start=P[0, 0])
    off = abs(stored.sum(-1, keepdims=True) - 1) > 1e-9
    expected = np.where(off, stored / stored.sum(-1, keepdims=True), stored)
    assert np.array_equal(weights(mdp), expected)
    assert float(mdp.start_S.sum()) == pytest.approx(1, abs=1e-15)
    sparse = TabularMDP.from_dense([sp.csr_matrix(P[:, a]) for a in range(3)], np.zeros((50, 3)), 1.0)
    assert np.array_equal(weights(sparse), expected)


def test_rows_within_1e_9_keep_their_bits():
    row = [0.5, 0.5 - 9e-10]
    mdp = TabularMDP.from_dense([[row], [row]], np.zeros(2), 1.0, start=row)
    assert mdp.outcomes.prob_NAK.tolist() == [[row], [row]]
    assert mdp.start_S.tolist() == row


@pytest.mark.parametrize("missing", [2e-5, -2e-5])
def test_rows_that_miss_more_than_1e_5_are_refused(missing):
    row = [0.5, 0.5 - missing]
    with pytest.raises(PgtsError, match=r"P_SAS\[0, 0\] is not a distribution"):
        TabularMDP.from_dense([[row], [row]], np.zeros(2), 1.0)
    with pytest.raises(PgtsError, match="start_S is not a distribution"):
        TabularMDP.from_dense(np.eye(2)[:, None], np.zeros(2), 1.0, start=row)


def test_transitions_of_six_digits_are_divided_by_their_sums():
    row = [(0.333333, 0, 3.0, False), (0.333333, 1, 6.0, False), (0.333333, 0, 3.0, True)]
    mdp = TabularMDP.from_transitions([[row], [row]], 1.0, start=0)
    assert mdp.outcomes.prob_NAK.flatten().tolist() == pytest.approx([1 / 3] * 6, rel=1e-15)
    assert mdp.outcomes.reward_NA.flatten().tolist() == pytest.approx([4.0] * 2, rel=1e-15)


def test_an_npz_of_float32_rows_is_read(tmp_path):
    P = np.random.default_rng(0).dirichlet(np.ones(9), (9, 2)).astype(np.float32)
    np.savez(tmp_path / "mdp.npz", P=P, R=np.zeros((9, 2)), gamma=0.9)
    assert float(TabularMDP.load_npz(tmp_path / "mdp.npz").outcomes.prob_NAK.sum(-1).sub(1).abs().max()) < 1e-9
