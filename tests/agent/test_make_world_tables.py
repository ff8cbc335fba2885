"""Which tables that environments publish are their models, and which are not."""

import functools
import re
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.envs.toy_text.taxi import TaxiEnv

from pgts_torch import PGTS
from pgts_torch.agent.world import ModelWorld
from pgts_torch.agent.worlds import SimulatedWorld, TabularWorld
from pgts_torch.envs import TabularEnv
from pgts_torch.models.attributes import fingerprint
from pgts_torch.tabular import exact, ladder
from tests.agent.cells import FIRST, Cells, N, Walk, row_of_cells, told_of, world_of


class Shaped(FrozenLakeEnv):
    def step(self, action: int) -> Any:
        observation, reward, *rest = super().step(action)
        return observation, reward - 0.1, *rest


class Costly:
    def step(self, action: int) -> Any:
        observation, reward, *rest = super().step(action)  # type: ignore[misc]
        return observation, reward - 1, *rest


class Mixed(Costly, CliffWalkingEnv):
    pass


class Elsewhere(FrozenLakeEnv):
    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        self.s = 6
        return 6, {}


class Encoded(TaxiEnv):
    def action_mask(self, state: int) -> Any:
        self.s = 0
        return super().action_mask(state)


class Chosen(FrozenLakeEnv):
    np_random = property(lambda self: np.random.default_rng(0), lambda self, value: None)  # type: ignore[assignment]


def patched() -> gymnasium.Env:
    env = gymnasium.make("FrozenLake-v1")
    inner: Any = env.unwrapped
    inner.step = functools.partial(lambda step, action: step((action + 1) % 4), inner.step)
    return env


@pytest.mark.fault("a table of transitions that is not that of step and reset")
@pytest.mark.parametrize(
    ("make", "why"),
    [
        (Shaped, "step is overridden by Shaped"),
        (Mixed, "step is overridden by Costly"),
        (Elsewhere, "reset is overridden by Elsewhere"),
        (Encoded, "action_mask is overridden by Encoded"),
        (Chosen, "np_random is overridden by Chosen"),
        (patched, "step was set on the instance"),
        (
            lambda: Cells(row_of_cells(), starts=FIRST, slip=0.1),
            r"state \d under action \d gave .* the table says reward",
        ),
        (
            lambda: Cells(row_of_cells(), starts=FIRST, pays=2.0),
            r"gave reward 2, an end; the table says reward 1, an end",
        ),
        (lambda: Cells(row_of_cells(), starts=FIRST, begins=3), r"it starts in state [12], which has probability 0"),
        (lambda: Cells(row_of_cells(N - 1), starts=FIRST), "is no transition table: start_S has shape"),
        (lambda: Cells(row_of_cells(N - 1)), r"is no transition table: reset|it has 5 states|it shows 5"),
    ],
)
def test_a_table_that_was_not_written_for_what_runs_is_not_used_and_the_reason_is_told(make, why):
    assert re.search(why, told_of(make))
    assert not isinstance(world_of(make, plain=True), ModelWorld)  # where no model is needed there is no exact J either


def test_a_subclass_that_only_renders_keeps_the_table():
    class Seen(FrozenLakeEnv):
        def render(self) -> None:
            return None

    assert isinstance(world_of(Seen), TabularWorld)


@pytest.mark.parametrize(
    "env",
    [
        ("FrozenLake-v1", {"success_rate": 0.9}),
        ("FrozenLake-v1", {"reward_schedule": (10, -5, -0.1)}),
        ("CliffWalking-v1", {"is_slippery": True}),
        ("Taxi-v4", {"is_rainy": True}),
    ],
)
def test_options_that_the_table_has_keep_it(env):
    assert isinstance(world_of(env[0], **env[1]), TabularWorld)


def test_a_passenger_who_changes_his_mind_is_in_no_table_and_taxis_are_restored_from_snapshots():
    assert isinstance(world_of("Taxi-v4", fickle_passenger=True), SimulatedWorld)


@pytest.mark.parametrize(
    "P",
    [
        {s: {a: [(*rows[0], {})] for a, rows in each.items()} for s, each in row_of_cells().items()},
        {s: {a: [rows[0][:3]] for a, rows in each.items()} for s, each in row_of_cells().items()},
        {(0, s): each for s, each in row_of_cells().items()},
        np.full((2, N, N), 1 / N),
        0.8,
        lambda state, action: None,
        "P",
        [],
    ],
    ids=["rows of 5", "rows of 3", "tuples", "array", "number", "method", "text", "empty"],
)
def test_an_attribute_P_of_another_meaning_is_no_table(P):
    assert not isinstance(world_of(lambda: Cells(P), plain=True), ModelWorld)
    assert "attribute P of Cells is no transition table" in told_of(lambda: Cells(P))


def test_an_attribute_of_another_meaning_beside_a_table_lays_no_picture_out():
    class Framed(Cells):
        shape = "wide"

    assert world_of(lambda: Framed(row_of_cells(), starts=FIRST)).mdp.shape == (1, N)


def test_more_actions_than_a_table_has_are_a_reason():
    class Three(Cells):
        def __init__(self) -> None:
            super().__init__(row_of_cells(), starts=FIRST)
            self.action_space = spaces.Discrete(3)

    assert "it has 6 states and 2 actions, and its spaces are Discrete(6) and Discrete(3)" in told_of(Three)


def test_a_table_without_starts_takes_them_from_resets_and_says_so():
    with pytest.warns(UserWarning, match="Cells has a table P and no initial_state_distrib"):
        world = world_of(lambda: Cells(row_of_cells()))
    assert exact.optimal(world.mdp).J == pytest.approx(0.9 ** (N - 2), rel=1e-12)
    assert world.start_S is None
    with pytest.warns(UserWarning, match="start distribution is estimated"):
        spread = world_of(lambda: Cells(row_of_cells(), begins=3))
    # 1,000 resets: 5 standard errors of a share of 1/3 are 0.075.
    assert spread.mdp.start_S[:3].tolist() == pytest.approx([1 / 3] * 3, abs=0.075)
    assert spread.mdp.start_S[3:].tolist() == [0] * (N - 3)


def test_an_attribute_that_raises_is_no_table():
    class Shy(Walk):
        observation_space = spaces.Discrete(N)

        @property
        def P(self) -> Any:
            raise RuntimeError("not yet")

        def shown(self) -> Any:
            return self.position

    assert isinstance(world_of(Shy), SimulatedWorld)


def test_a_table_that_changes_from_episode_to_episode_is_contradicted():
    class Changing(Cells):
        def reset(self, **options: Any) -> Any:
            answer = super().reset(**options)
            self.pays = float(self.np_random.random() < 0.5)
            self.initial_state_distrib = FIRST
            return answer

    assert "gave reward 0, an end; the table says reward 1, an end" in told_of(
        lambda: Changing(row_of_cells(), starts=FIRST)
    )


def test_environments_may_share_an_mdp_that_has_been_solved():
    # Whose sparse matrices are kept, and are compared as other tensors are.
    mdp = ladder(5)
    best = exact.optimal(mdp)
    model = PGTS(lambda: TabularEnv(mdp), critic="exact", depth=4).learn(10_000)
    assert exact.evaluate(mdp, model.policy_table()).J == pytest.approx(best.J, rel=1e-3)
    for layout in (torch.sparse_coo, torch.sparse_csr, torch.sparse_csc):
        eye, others = (torch.eye(3).to_sparse(layout=layout) * weight for weight in (1.0, 2.0))
        assert fingerprint(eye) == fingerprint(eye.clone()) != fingerprint(others)
        assert fingerprint(eye) != fingerprint(torch.eye(4).to_sparse(layout=layout))
