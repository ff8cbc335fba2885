"""The command `pgts stationary`."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pgts_torch.cli.commands.stationary import MDPS
from pgts_torch.cli.main import main
from pgts_torch.tabular import deep_sea, exact, grid, ladder, random_mdp, stationary_sets, tightrope

LADDER = """\
5 states, 2 actions, 32 deterministic policies
J* = 6.561
sufficient depth M = 4: all policies in Pi^4 are optimal

depth     |Pi^m|        b^m   J* - b^m   by values    by reach  closed form
    0         27          0      6.561       6.561           9            9
    1         23          0      6.561       6.561         8.1          8.1
    2         17          0      6.561       6.561        7.29         7.29
    3          9          0      6.561       6.561       6.561        6.561
    4          1      6.561          0      5.9049      5.9049       5.9049

b^m is the least return of a policy in Pi^m. What bounds J* - b^m:
  by values    Prop. 3, with the worst values of any policy
  by reach     gamma and the rewards that m + 1 steps do not pass by
  closed form  gamma and all rewards

escapes at   policies
         0          5  #########################
         1          4  ####################
         2          6  ##############################
         3          8  ########################################
         4          8  ########################################
     never          1  #####
"""


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert main(["stationary", *arguments, "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


@pytest.fixture
def npz(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The ladder of four states in a file of the working directory."""
    monkeypatch.chdir(tmp_path)
    ladder(4, gamma=0.8, start=0).save_npz("four.npz")
    return Path("four.npz")


def test_the_ladder_is_answered_in_tables(capsys):
    assert main(["stationary", "ladder"]) == 0
    assert capsys.readouterr() == (LADDER, "")


def test_the_json_holds_the_same_numbers(capsys):
    told = answer(capsys, "ladder")
    assert (told["num_states"], told["num_actions"], told["num_policies"]) == (5, 2, 32)
    assert (told["J_optimal"], told["sufficient_depth"]) == (pytest.approx(6.561), 4)
    assert told["escape_depths"] == {"never": 1, "0": 5, "1": 4, "2": 6, "3": 8, "4": 8}
    assert [row["depth"] for row in told["depths"]] == [0, 1, 2, 3, 4]
    assert [row["count"] for row in told["depths"]] == [27, 23, 17, 9, 1]
    assert told["depths"][3] == pytest.approx(
        {
            "depth": 3,
            "count": 9,
            "worst_return": 0,
            "lack": 6.561,
            "value_bound": 6.561,
            "reachable_bound": 6.561,
            "closed_form_bound": 6.561,
        }
    )


@pytest.mark.parametrize(
    ("arguments", "mdp"),
    [
        (["ladder", "--n", "4", "--gamma", "0.5", "--start", "1"], lambda: ladder(4, gamma=0.5, start=1)),
        (["ladder", "--start", "uniform"], lambda: ladder(5, start=None)),
        (["tightrope"], tightrope),
        (["tightrope", "--gamma", "0.5"], lambda: tightrope(gamma=0.5)),
        (["random"], random_mdp),
        (
            ["random", "--states", "5", "--actions", "3", "--branching", "1", "--mdp-seed", "7"],
            lambda: random_mdp(5, 3, branching=1, seed=7),
        ),
        (["grid", "--n", "2"], lambda: grid(2, traps=())),
        (["grid", "--n", "2", "--traps", "1,2", "--gamma", "0.8"], lambda: grid(2, traps=(1, 2), gamma=0.8)),
        (["deep_sea"], lambda: deep_sea(3)),
        (["deep_sea", "--n", "2", "--gamma", "1"], lambda: deep_sea(2, gamma=1.0)),
        (["four.npz"], lambda: ladder(4, gamma=0.8)),
        (["four.npz", "--start", "2"], lambda: ladder(4, gamma=0.8, start=2)),
        (["four.npz", "--start", "uniform"], lambda: ladder(4, gamma=0.8, start=None)),
    ],
)
def test_each_mdp_is_the_one_that_was_asked_for(arguments, mdp, npz, capsys):
    told, sets = answer(capsys, *arguments), stationary_sets.enumerate_sets(mdp())
    assert told["J_optimal"] == pytest.approx(exact.optimal(mdp()).J)
    assert told["num_policies"] == len(sets.J_P)
    assert told["sufficient_depth"] == sets.sufficient_depth
    assert [row["count"] for row in told["depths"]] == [sets.count(m) for m in range(sets.sufficient_depth + 1)]
    assert told["depths"][0]["worst_return"] == pytest.approx(sets.worst_return(0))
    assert told["depths"][-1]["lack"] == 0


def test_a_bound_that_says_nothing_is_null_for_programs_and_none_for_people(capsys):
    rows = answer(capsys, "deep_sea", "--gamma", "1")["depths"]
    assert [row["reachable_bound"] for row in rows] == [None, None, 0]
    assert [row["closed_form_bound"] for row in rows] == [None] * 3
    assert main(["stationary", "deep_sea", "--gamma", "1"]) == 0
    assert " none" in capsys.readouterr().out


@pytest.mark.parametrize("what", ["ladder --n 12", "tightrope", "grid --n 2", "deep_sea", "random --branching 1"])
def test_the_tables_stay_within_80_columns(what, capsys):
    assert main(["stationary", *what.split()]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) < 80


def test_a_long_table_shows_the_depths_at_which_something_changes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    there, here = [0.0, 1.0], [1.0, 0.0]
    P, R = [[here, there], [there, here]], [[0.0, -8.99], [1.0, 0.0]]
    np.savez("toll.npz", P=P, R=R, gamma=0.9, start=0)
    assert len(answer(capsys, "toll.npz")["depths"]) == 66
    main(["stationary", "toll.npz"])
    out = capsys.readouterr().out
    assert [line.split()[0] for line in out.splitlines()[5:8]] == ["0", "65", "Depths"]


MISTAKES = {
    "": "WHAT",
    "laddr": "'laddr' is not an MDP; did you mean ladder?",
    "xyz": ", ".join(MDPS),
    "none.npz": "'none.npz' is not a file",
    "tightrope --n 3": "--n does not apply to tightrope, which takes --gamma, --start",
    "ladder --mdp-seed 3": "--mdp-seed does not apply to ladder",
    "four.npz --gamma 0.5": "--gamma does not apply to four.npz",
    "ladder --n 0": "--n: '0'",
    "ladder --gamma 1.5": "--gamma: '1.5'",
    "ladder --start first": "--start: 'first'",
    "grid --traps 1,x": "--traps: 'x'",
    "ladder --start 5": "start state 5",
    "ladder --gamma 1": "gamma is 1",
    "random --branching 11": "branching is 11",
    "grid --traps 8": "state 8",
    "grid --n 4": "--n 4 gives 4,294,967,296 = 4^16 deterministic policies; at most 1048576 are enumerated: take at "
    "most 10 states with 4 actions, as --n 3 does",
    "ladder --n 1000000000000": "as --n 20 does",
    "random --states 13 --actions 3": "take at most 12 states with 3 actions",
    "broken.npz": "broken.npz: array 'gamma' is missing",
    "large.npz": "take at most 20 states with 2 actions",
}


@pytest.mark.parametrize("arguments", MISTAKES)
def test_a_mistake_is_one_line_with_exit_code_2(arguments, npz, capsys):
    np.savez("broken.npz", P=np.eye(2)[:, None], R=np.zeros((2, 1)))
    np.savez("large.npz", P=np.full((21, 2, 21), 1 / 21), R=np.zeros((21, 2)), gamma=0.9)
    assert main(["stationary", *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    [mistake] = err.splitlines()
    assert MISTAKES[arguments] in mistake


def test_the_help_tells_the_names_and_the_arrays_of_a_file(capsys):
    assert main(["stationary", "--help"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) < 80
    for word in [*MDPS, 'numpy.savez("mdp.npz", P=P, R=R, gamma=0.9)', "[S, A, S]", "[S, A]", "start"]:
        assert word in out
