"""Action masks of a game against a random opponent: within wrappers, of images, in other processes, and checked."""

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from pgts_torch import PGTS
from pgts_torch.agent.diagnostics import Truth
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.envs.tabular import TabularEnv
from pgts_torch.errors import PgtsError
from pgts_torch.models.fidelity import check_model
from tests.agent.masked import MAKERS, Turned
from tests.tabular.test_illegal_actions import masked

LINES = [(0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6)]
SHORT: dict[str, Any] = {"num_envs": 2, "horizon": {"type": "fixed", "length": 5}}
LOOK: dict[str, Any] = {
    "depth": 1,
    "search": {"type": "sampled", "samples": 2},
    "policy": {"type": "mlp", "hidden": [8]},
}
SAMPLED: dict[str, Any] = {"depth": 0, "estimator": "sampled"}


class TicTacToe(gymnasium.Env):
    """A field that is taken is an error. Nothing of it is written for a model: it has no get_state."""

    action_space = spaces.Discrete(9)
    steps = 0

    def __init__(self, *, pays: float = 1.0, image: bool = False) -> None:
        self.pays, self.image = pays, image
        self.observation_space = spaces.Box(0, 2, (9, 9, 1) if image else (3, 3), np.uint8)

    def seen(self):
        fields = (self.board + 1).astype(np.uint8).reshape(3, 3)
        return np.kron(fields[:, :, None], np.ones((3, 3, 1), np.uint8)) if self.image else fields

    def action_masks(self):
        return self.board == 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.board = np.zeros(9, np.int8)
        return self.seen(), {}

    def step(self, action):
        if self.board[action]:
            raise ValueError(f"field {action} is taken")
        type(self).steps += 1
        self.board[action] = 1
        free = np.flatnonzero(self.board == 0)
        if not self.won(1) and len(free):
            self.board[self.np_random.choice(free)] = -1
        score = float(self.won(1)) - float(self.won(-1))
        return self.seen(), self.pays * score, score != 0 or len(free) < 2, False, {}

    def won(self, player):
        return any(all(self.board[k] == player for k in line) for line in LINES)


class Mirrored(gymnasium.ActionWrapper):
    def action(self, action):
        return 8 - action


class Bonus(gymnasium.Wrapper):
    """Pays for each step more than for the last, so that it is part of a simulator."""

    def reset(self, **options):
        self.paid = 0.0
        return self.env.reset(**options)

    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        self.paid += 0.01
        return observation, reward + self.paid, *rest


STRANGERS: dict[str, Any] = {
    "plain": TicTacToe,
    "large rewards": lambda: TicTacToe(pays=1e6),
    "small rewards": lambda: TicTacToe(pays=1e-3),
    "wrappers": lambda: wrappers.TransformReward(
        Mirrored(wrappers.RecordEpisodeStatistics(wrappers.TimeLimit(TicTacToe(), 4))), lambda reward: 2 * reward
    ),
    "a wrapper that is part of the simulator": lambda: Bonus(Mirrored(TicTacToe())),
    "stacked observations": lambda: wrappers.FrameStackObservation(TicTacToe(), 2),
}


@pytest.mark.filterwarnings("ignore:.*attributes are pickled")
@pytest.mark.parametrize("name", STRANGERS)
def test_a_game_is_searched_and_evaluated_without_an_illegal_move(name):
    before = TicTacToe.steps
    training = PGTS(STRANGERS[name], **SHORT, **LOOK)
    training.iterate()
    assert math.isfinite(evaluate(training, episodes=2, deterministic=False).episodic_return.mean)
    assert TicTacToe.steps > before


def test_a_mask_in_info_of_which_it_is_not_known_whose_actions_it_numbers_is_refused():
    with pytest.raises(PgtsError, match=r"a wrapper that changes actions within Bonus, which may change the mask: say"):
        PGTS(lambda: Bonus(Turned(MAKERS["info"]())), **SHORT, **SAMPLED)
    PGTS(lambda: Turned(Bonus(MAKERS["info"]())), **SHORT, **SAMPLED).iterate()


def test_masks_beside_images_and_normalised_vectors_are_no_inputs():
    small = {"type": "cnn", "channels": [2], "hidden": [4], "kernel_size": 3, "stride": 2}
    PGTS(lambda: TicTacToe(image=True), **SHORT, **SAMPLED, policy=small).iterate()
    training = PGTS(TicTacToe, **SHORT, **SAMPLED, policy={"type": "mlp", "hidden": [4], "normalize": True})
    training.iterate()
    assert training.policy.network.trunk.encoder.num_inputs == 9


def test_masks_of_environments_in_other_processes_are_read():
    envs = AsyncVectorEnv([TicTacToe] * 2, autoreset_mode=AutoresetMode.DISABLED)
    try:
        assert len(PGTS(envs, **(SHORT | {"num_envs": None}), **SAMPLED).iterate().experience.alive_TB) == 5
    finally:
        envs.close()


@pytest.mark.parametrize("says", MAKERS)
def test_an_environment_with_masks_is_checked_as_a_model(says):
    report = check_model(MAKERS[says], continuations=3, length=5)
    assert report.usable
    assert report.cost is not None


def test_the_truth_of_a_table_counts_actions_that_are_allowed_only():
    training = PGTS(lambda: TabularEnv(masked()), critic="exact", depth=2, num_envs=2)
    pi_SA = training.policy_table()
    tags = Truth(training.mdp, training.update).metrics(pi_SA, training.iterate())
    assert tags["exact/lookahead_error"] == pytest.approx(0, abs=1e-9)
    assert 0 < tags["exact/gradient_cosine"] <= 1 + 1e-9


def test_masks_are_wanted_in_vain_of_a_table_that_allows_all_actions():
    with pytest.raises(PgtsError, match=r"action_masks is 'on'; the table of .* allows all actions"):
        PGTS("pgts/Ladder-v0", action_masks="on")
