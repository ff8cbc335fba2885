"""The command `pgts check-model`."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from pgts_torch.cli.main import main

HELP = "(see pgts check-model --help)"

OWN = """\
import gymnasium, itertools
from tests.models.corridors import Bare, Corridor, Forgetful
steps = itertools.count()
class Hidden(Bare):
    def look(self):
        return super().look() + next(steps)
from gymnasium.envs.toy_text import CliffWalkingEnv
class Liar(CliffWalkingEnv):
    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, 0.5, *rest
    def __init__(self):
        super().__init__()
        for rows in self.P.values():
            for a, [(p, t, _, end)] in rows.items():
                rows[a] = [(p, t, 0.0, end)]
for kind in (Hidden, Corridor, Forgetful, Liar):
    gymnasium.register(f"{kind.__name__}-v0", kind)
"""


@pytest.fixture
def own_environments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user's module `corridors_of_mine`, which registers environments."""
    (tmp_path / "corridors_of_mine.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert main(["check-model", *arguments, "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


def test_a_usable_environment_is_told_in_a_table_with_exit_code_0(capsys):
    assert main(["check-model", "CliffWalking-v1"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    lines = out.splitlines()
    assert max(map(len, lines)) < 80
    assert lines[0] == "CliffWalking-v1: toy text, 4 actions"
    assert [line.split()[:2] for line in lines if line.split()[1:2] == ["yes"]] == [
        [name, "yes"] for name in ("answers", "restore", "merge", "chance", "untouched", "table")
    ]
    assert lines[-1] == "CliffWalking-v1 can serve as a model: its outcomes can be enumerated"


@pytest.mark.parametrize(("kwargs", "states"), [([], 100), (["--kwargs", '{"size": 4, "traps": []}'], 16)])
def test_a_table_is_told_to_need_no_snapshot_and_to_agree_with_the_steps(kwargs, states, capsys):
    assert main(["check-model", "pgts/Grid-v0", *kwargs]) == 0
    verdict = f"pgts/Grid-v0 can serve as a model: a table of {states} states, so no snapshot is needed"
    words = " ".join(capsys.readouterr().out.split())
    assert words.startswith(f"pgts/Grid-v0: table, {states} states, 4 actions table yes 400 steps agree")
    assert words.endswith(verdict)
    told = answer(capsys, "pgts/Grid-v0", *kwargs)
    checks = told.pop("checks")
    assert told == {
        "env": "pgts/Grid-v0",
        "family": "table",
        "num_states": states,
        "num_actions": 4,
        "random_share": 1.0,
        "cost": None,
        "usable": True,
        "verdict": verdict,
    }
    assert checks == [{"name": "table", "needed": True, "passed": True, "detail": "400 steps agree, bit for bit"}]


@pytest.mark.fault("environment that contradicts its model")
def test_a_table_and_dynamics_that_step_contradicts_are_a_failed_check_with_the_step(own_environments, capsys):
    assert main(["check-model", "corridors_of_mine:Liar-v0"]) == 1
    words = " ".join(capsys.readouterr().out.split())
    assert "gave reward 0.5, discount 0.5, then state" in words
    assert "; the table says reward 0, discount 0.5, then state" in words
    [dynamics] = [check for check in answer(capsys, "CartPole-v1")["checks"] if check["name"] == "dynamics"]
    assert dynamics["passed"]
    assert dynamics["detail"] == "412 steps agree, within 1e-12"  # the last episode is taken to its end


def test_the_json_holds_the_same_and_the_seed_decides_the_walks(capsys):
    told = answer(capsys, "FrozenLake-v1", "--seed", "4")
    assert (told["env"], told["family"], told["num_actions"]) == ("FrozenLake-v1", "toy text", 4)
    assert told["usable"] is True
    assert told["random_share"] == 1
    assert [check["passed"] for check in told["checks"]] == [True] * 6
    assert set(told["cost"]) == {"restore", "step", "snapshot", "bytes"}
    assert answer(capsys, "FrozenLake-v1", "--seed", "4")["checks"] == told["checks"]
    assert answer(capsys, "FrozenLake-v1", "--seed", "5")["checks"] != told["checks"]


def test_the_arguments_of_the_environment_are_handed_on(capsys):
    assert answer(capsys, "FrozenLake-v1", "--kwargs", '{"is_slippery": false}')["random_share"] == 0


def test_a_failed_check_is_told_and_has_exit_code_1(own_environments, capsys):
    assert answer(capsys, "corridors_of_mine:Corridor-v0")["usable"] is True
    assert main(["check-model", "corridors_of_mine:Forgetful-v0"]) == 1
    out, err = capsys.readouterr()
    assert err == ""
    assert max(map(len, out.splitlines())) < 80
    words = " ".join(out.split())
    assert "restore NO a restored state goes on differently at step 1: get_state misses something" in words
    assert "Forgetful-v0 cannot serve as a model: a restored state goes on differently" in words
    assert main(["check-model", "corridors_of_mine:Forgetful-v0", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["usable"] is False


MISTAKES = {
    "": f"the following arguments are required: ENV_ID {HELP}",
    "Nope-v0": "Nope-v0 cannot be made: Environment `Nope` doesn't exist",
    "nope:Nope-v0": "nope:Nope-v0 cannot be made: No module named 'nope'",
    "corridors_of_mine:Hidden-v0": "Hidden-v0 cannot be restored: give Hidden the methods get_state(self), which",
    "FrozenLake-v1 --kwargs [1]": f"argument --kwargs: '[1]' is not a JSON object {HELP}",
    "FrozenLake-v1 --kwargs {": f"argument --kwargs: '{{' is not a JSON object {HELP}",
    'FrozenLake-v1 --kwargs {"slip":1}': "FrozenLake-v1 cannot be made: FrozenLakeEnv.__init__() got an unexpected",
    "FrozenLake-v1 --seed -1": f"argument --seed: '-1' is not a whole number >= 0 and below 2**63 {HELP}",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_is_one_line_with_exit_code_2(arguments, own_environments, capsys):
    assert main(["check-model", *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith(f"error: {MISTAKES[arguments]}")


@pytest.mark.fault("missing extra")
def test_a_missing_extra_is_named(monkeypatch, capsys):
    for module, id, extra in [("minigrid", "MiniGrid-Empty-5x5-v0", "envs"), ("ale_py", "ALE/Pong-v5", "atari")]:
        monkeypatch.setitem(sys.modules, module, None)
        assert main(["check-model", id]) == 2
        assert capsys.readouterr().err == f"error: {id} needs {module}: pip install 'pgts_torch[{extra}]'\n"


def test_the_help_tells_the_protocol_within_80_columns(capsys):
    assert main(["check-model", "--help"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) < 80
    for word in ["def get_state(self):", "def set_state(self, state):", "self.np_random", "exit code"]:
        assert word in out
