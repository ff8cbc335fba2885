"""Which outcome of a model a step of the environment was: of a table, dynamics and a simulator."""

import gymnasium
import numpy as np
import torch

from pgts_torch.models import CartPole, SimulatorModel, TabularModel
from pgts_torch.models.exact_model import CONTRADICTED, NOT_QUERIED, RANDOM, Happened
from pgts_torch.tabular import TabularMDP
from tests.agent.test_model_check import Restored


def test_outcomes_that_look_alike_are_one():
    rows = [(0.25, 1, 2.0, False), (0.125, 1, 3.0, False), (0.25, 0, 2.0, True), (0.375, 1, 2.0, True)]
    mdp = TabularMDP.from_transitions([[rows], [[(1.0, 0, 0.0, False)]]], 0.9, start=0)
    model = TabularModel(mdp)
    assert model.frequencies()[0].tolist() == [0.25, 0.125, 0.625, 0.0]
    steps = [(2.0, 0.9, 1), (3.0, 0.9, 1), (2.0, 0.0, 7), (2.0, 0.9, 0), (-0.0, 0.9, 1)]
    reward_N, discount_N, next_N = map(np.array, zip(*steps, strict=True))
    zeros = np.zeros(len(steps), dtype=np.int64)
    assert model.outcome_of(Happened(zeros, zeros, reward_N, discount_N, next_N, zeros > 0)).tolist() == [
        0,
        1,
        2,
        -1,
        -1,
    ]


def test_a_step_may_differ_from_dynamics_in_the_last_bits_only():
    env = gymnasium.make("CartPole-v1").unwrapped
    env.reset(seed=0)
    model = CartPole(env, gamma=0.9)
    start = model.number(model.vectors([env]))
    *_, ahead = model.step(model.states(start), torch.tensor([1]))
    for off, held in ((0.0, 0), (1e-15, 0), (1e-10, CONTRADICTED)):
        there = model.number(ahead + off)
        step = Happened(*map(np.array, ([int(start)], [1], [1.0], [0.9], [int(there)], [True])))
        assert model.outcome_of(step).tolist() == [held]
    for reward, discount in ((1.0 + 1e-9, 0.9), (1.0, 0.0)):
        step = Happened(*map(np.array, ([int(start)], [1], [reward], [discount], [int(model.number(ahead))], [True])))
        assert model.outcome_of(step).tolist() == [CONTRADICTED]


def test_a_step_is_not_queried_or_an_outcome_or_random():
    env = Restored()
    env.reset(seed=0)
    model = SimulatorModel(Restored, gamma=0.9)
    start = model.root(env, env.shown())
    env.step(1)
    there = model.root(env, env.shown())
    step = Happened(*map(np.array, ([start], [1], [0.0], [0.9], [there], [True])))
    no, yes = np.array([False]), np.array([True])
    assert model.outcome_of(step, query_N=no).tolist() == [NOT_QUERIED]
    assert model.outcome_of(step, query_N=yes).tolist() == [0]
    assert model.outcome_of(step, query_N=no).tolist() == [0]
    random = SimulatorModel(lambda: Restored(slip=0.3), gamma=0.9)
    start = random.number(random.adapter.get_state(Restored()))
    step = Happened(*map(np.array, ([start], [1], [0.0], [0.9], [start], [True])))
    assert random.outcome_of(step).tolist() == [RANDOM]
