"""The command `pgts compare`: which runs are one group, what is drawn and said of them, and what is refused."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pgts_torch.cli.main import main
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import run as training
from pgts_torch.experiment.compare.comparison import compare
from pgts_torch.experiment.compare.drawing import page
from pgts_torch.experiment.compare.text import describe, to_json
from pgts_torch.experiment.statistics import bootstrap_interval, interquartile_mean
from tests.experiment.cut_off import QUIET, configured, cut_off
from tests.experiment.finished import run
from tests.experiment.test_report import EVIL, Page


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def made(*depths: int, seeds: int = 3, folder: str = "runs", add: tuple[str, ...] = (), **more: Any) -> None:
    """Runs whose score is 10 times their depth plus their seed."""
    for depth in depths:
        for seed in range(seeds):
            place = Path(f"{folder}/d{depth}/s{seed}")
            run(place, f"--search.depth={depth}", *add, seed=seed, score=10 * depth + seed, **more)


def compared(*paths: str, **options: Any) -> dict[str, Any]:
    return to_json(compare([Path(path) for path in paths or ("runs",)], **options))


def groups(answer: dict[str, Any]) -> dict[str, int]:
    return {group["label"]: len(group["runs"]) for group in answer["groups"]}


def test_runs_of_one_configuration_up_to_the_seed_are_one_group_and_labels_say_what_differs(here):
    made(10, 0, 2, add=("--update.type=mirror",))
    made(2, seeds=2, folder="more", add=("--update.step_size=0.25",))
    answer = compared("runs", "more")
    assert groups(answer) == {
        "search.depth 0, update.step_size null": 3,
        "search.depth 2, update.step_size 0.25": 2,
        "search.depth 2, update.step_size null": 3,
        "search.depth 10, update.step_size null": 3,
    }
    assert [group["letter"] for group in answer["groups"]] == [*"ABCD"]
    assert answer["groups"][0]["settings"] == {"search.depth": 0, "update.step_size": None}


def test_a_label_has_all_keys_that_differ_where_they_are_few_and_else_those_that_tell_apart(here):
    own = ("--rollout.num_envs=2", "--search.max_nodes=5", "--search.max_bytes=7")
    run(Path("runs/a"), "--update.step_size=0.12345", "--update.type=mirror", *own, "--critic.type=exact")
    run(Path("runs/b"), "--update.step_size=0.12346", "--update.type=mirror", *own)
    assert [*groups(compared())] == [
        "critic.type auto, update.step_size 0.1235",
        "critic.type exact, critic.target v, update.step_size 0.1235",
    ]
    run(Path("runs/c"), "--update.step_size=0.12346", "--update.type=mirror")
    assert [*groups(compared())] == [
        "critic.type auto, rollout.num_envs 2",
        "critic.type auto, rollout.num_envs null",
        "critic.type exact, rollout.num_envs 2",
    ]


def test_what_bears_no_bit_of_a_training_makes_no_group_of_its_own(here):
    run(Path("runs/a"), "--name=a", "--threads=2", "--log.every=2", "--eval.episodes=3", seed=0)
    run(Path("runs/b"), "--name=b", seed=1)
    assert groups(compared()) == {"a": 2}


def test_scores_and_curves_are_the_statistics_of_the_runs(here):
    made(1, 3, seeds=8)
    [panel] = compared()["environments"]
    assert (panel["metric"], panel["at"]) == ("charts/episodic_return", 1000)
    for curve, depth in zip(panel["curves"], (1, 3), strict=True):
        score_R = 10.0 * depth + np.arange(8)
        assert curve["scores"] == score_R.tolist()
        assert curve["score"]["mean"] == interquartile_mean(score_R)
        assert [curve["score"]["low"], curve["score"]["high"]] == bootstrap_interval(score_R).tolist()
        half = np.interp(550, curve["x"], curve["mean"])
        assert half == pytest.approx(0.55 * interquartile_mean(score_R))
        assert (curve["x"][0], curve["x"][-1], curve["mean"][-1]) == (100, 1000, curve["score"]["mean"])
        assert curve["low"][-1] == pytest.approx(curve["score"]["low"])


def test_the_probability_of_improvement_names_the_better_group(here):
    for depth, scores in ((0, (1, 5, 9)), (1, (4, 5, 12))):
        for seed, score in enumerate(scores):
            run(Path(f"runs/d{depth}/s{seed}"), f"--search.depth={depth}", seed=seed, score=score)
    [pair] = compared()["pairs"]
    assert (pair["better"], pair["worse"]) == ("B", "A")
    assert pair["probability"]["mean"] == pytest.approx((1 + 1.5 + 3) / 9)
    assert pair["probability"]["low"] < 0.5 < pair["probability"]["high"]


def test_runs_are_compared_where_the_shortest_has_come_to_and_a_run_that_was_good_enough_stays(here):
    made(1, 2)
    run(Path("runs/cut"), "--search.depth=2", seed=7, score=50.0, steps=400, finished=False)
    answer = compared()
    [panel] = answer["environments"]
    assert panel["at"] == 400
    assert panel["curves"][1]["x"][-1] == 400
    assert panel["curves"][0]["x"][-1] == 1000
    assert answer["notes"] == ["not finished, and --finished leaves them out: runs/cut (unfinished, step 400 of 1,000)"]
    [panel] = compared(finished=True)["environments"]
    assert panel["at"] == 1000
    shutil.rmtree("runs/cut")
    run(Path("runs/soon"), "--search.depth=2", seed=7, score=100.0, steps=400, ended_by="return")
    [panel] = compared()["environments"]
    assert panel["at"] == 1000
    assert panel["curves"][1]["scores"][-1] == 40.0  # where it has stopped


def test_curves_are_drawn_over_calls_and_seconds_too(here):
    made(1, seeds=2)
    run(Path("runs/other"), "--search.depth=2", score=10.0, calls=0.5)
    [panel] = compared(x="calls")["environments"]
    assert panel["at"] == 500
    assert [curve["x"][-1] for curve in panel["curves"]] == [2000, 500]
    assert panel["curves"][0]["scores"] == [2.5, 2.75]
    [panel] = compared(x="seconds")["environments"]
    assert panel["at"] == pytest.approx(1000 / 50)
    run(Path("runs/none"), "--search.depth=0", calls=0)
    answer = compared(x="calls")
    assert [curve["letter"] for curve in answer["environments"][0]["curves"]] == ["B", "C"]
    assert answer["notes"] == ["left out, as they have no model calls: runs/none"]


def test_exact_returns_come_before_greedy_ones_and_these_before_those_of_training(here):
    made(1, 2, tag="exact/J")
    assert compared()["environments"][0]["metric"] == "exact/J"
    run(Path("discounted"), "--env.gamma=0.5", tag="exact/J")
    with pytest.raises(PgtsError, match="nothing can be compared\nleft out, as they have no charts/episodic_return"):
        compared("runs", "discounted")  # J of two discounts
    made(1, 2, tag="eval/deterministic_return", folder="evaluated")
    assert compared("evaluated")["environments"][0]["metric"] == "eval/deterministic_return"
    assert compared("evaluated", metric="eval/sampled_return")["environments"][0]["curves"][0]["scores"][0] == 5.0
    with pytest.raises(PgtsError, match=r"no x/y \(but charts/SPS, eval/.*\): evaluated/d1/s0, .*, 3 more"):
        compare([Path("evaluated")], metric="x/y")


def test_groups_are_also_made_by_name_folder_and_pattern(here):
    made(1, 2, seeds=2)
    assert groups(compared(by="folder")) == {"runs/d1": 2, "runs/d2": 2}
    answer = compared(by="name")
    assert groups(answer) == {"run": 4}
    assert answer["notes"] == ["runs of run differ in search.depth, and are one group all the same"]
    assert groups(compared(by="s([0-9])")) == {"0": 2, "1": 2}
    answer = compared(by="d1.s[0-9]")
    assert groups(answer) == {"d1/s0": 1, "d1/s1": 1}
    assert answer["notes"] == ["left out, as --by does not match their paths: runs/d2/s0, runs/d2/s1"]
    assert "interval" in describe(compare([Path("runs")], by="d1.s[0-9]"))
    for pattern, message in (
        ("(", "'\\(' is neither config, name nor folder"),
        ("x", "'x' matches the path of no run"),
    ):
        with pytest.raises(PgtsError, match=message):
            compared(by=pattern)


def test_a_training_counts_once_however_often_it_is_there(here):
    made(1, seeds=2)
    shutil.copytree("runs/d1/s0", "copy")
    Path("link").symlink_to("runs/d1/s1")
    answer = compared("runs", "runs/d1/s0", "link", "copy")
    assert groups(answer) == {"run": 2}
    assert answer["notes"] == [
        "left out, as the same training with the same seed is there already: copy (as runs/d1/s0)"
    ]


def test_environments_have_panels_of_their_own_and_scores_are_pooled_where_they_are_scaled(here):
    for env, unit in (("CartPole-v1", 1.0), ("Acrobot-v1", 1e6)):
        for depth in (1, 2):
            for seed in range(3):
                folder = Path(f"runs/{env}/d{depth}/s{seed}")
                run(folder, f"--env.id={env}", f"--search.depth={depth}", seed=seed, score=unit * (depth + seed))
    answer = compared()
    assert groups(answer) == {"search.depth 1": 6, "search.depth 2": 6}
    assert [panel["env"] for panel in answer["environments"]] == ["Acrobot-v1", "CartPole-v1"]
    assert answer["pairs"][0]["probability"]["mean"] == pytest.approx((1.5 + 2.5 + 3) / 9)
    assert answer["scaled"] == {}
    assert answer["notes"][0].startswith("no mean over environments: --scale Acrobot-v1=LOW,HIGH says which of its")
    answer = compared(scale={"Acrobot-v1": (0, 4e6), "CartPole-v1": (0, 4)})
    assert answer["scaled"]["A"]["mean"] == pytest.approx(0.5)
    with pytest.raises(PgtsError, match="--scale names Taxi; the environments are Acrobot-v1, CartPole-v1"):
        compared(scale={"Taxi": (0, 1)})


def test_no_scale_is_asked_for_where_no_group_is_in_all_environments(here):
    for depth, env in enumerate(("CartPole-v1", "Acrobot-v1")):
        run(Path(f"runs/{env}"), f"--env.id={env}", f"--search.depth={depth}")
    answer = compared()
    assert [len(panel["curves"]) for panel in answer["environments"]] == [1, 1]
    assert answer["notes"] == []
    assert compared(scale={"Acrobot-v1": (0, 1), "CartPole-v1": (0, 1)})["scaled"] == {}


def test_what_is_no_run_or_says_nothing_is_one_sentence(here):
    made(1, seeds=2)
    (here / "photos").mkdir()
    (here / "photos" / "config.yaml").write_text("camera: old")
    (here / "empty").mkdir()
    run(Path("runs/early"), finished=False, steps=0)
    run(Path("runs/broken"))
    Path("runs/broken/config.yaml").write_text("search: {depth: -1}")
    run(Path("runs/damaged"), seed=1)
    Path("runs/damaged/summary.json").write_text("{")
    with Path("runs/damaged/metrics.jsonl").open("a") as file:
        file.write('{"step": 11')
    answer = compared("runs", "photos")
    assert groups(answer) == {"search.depth 1": 2, "search.depth 4": 1}
    text = "\n".join(answer["notes"])
    for said in (
        "configuration cannot be read: runs/broken (runs/broken/config.yaml:1: search.depth is -1",
        "photos (photos/config.yaml:1: camera is unknown",
        "no iteration has been written down: runs/early",
        "the run counts as unfinished: runs/damaged/summary.json is damaged (",
        "runs/damaged: 1 of 11 lines of metrics.jsonl cannot be read",
    ):
        assert said in text
    for path, message in (("empty", "empty holds no run: neither it nor"), ("none", "none is not there")):
        with pytest.raises(PgtsError, match=message):
            compared(path)
    with pytest.raises(PgtsError, match=r"no run is left to compare\nleft out, as no iteration .*: runs/early"):
        compared("runs/early")


def test_the_command_writes_a_page_and_a_picture_and_a_text_within_80_columns(here, capsys):
    made(1, 2, seeds=2)
    run(Path("runs/alone"), "--search.depth=3", "--env.kwargs.n=7", "--name", "x", score=1e-3)
    assert main(["compare", "runs", "--out", "out"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-2:] == ["out/compare.html", "out/compare.png"]
    assert max(map(len, out.splitlines())) < 80
    assert Path("out/compare.png").read_bytes().startswith(b"\x89PNG")
    read = Page(Path("out/compare.html").read_text())
    assert read.named("script") == read.named("link") == []
    assert all(each["src"].startswith("data:image/svg+xml;base64,") for each in read.named("img"))
    assert len(read.named("img")) == 2
    assert "runs/alone" in read.text
    assert main(["compare", "runs", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["groups"][2]["label"] == "search.depth 3"
    for name in ("compare.html", "compare.png"):
        Path("out", name).write_text("mine")
        assert main(["compare", "runs", "--out", "out"]) == 2
        assert capsys.readouterr().err == (
            f"error: out/{name} exists and is not of pgts compare: move it away, or choose another name\n"
        )
        assert Path("out", name).read_text() == "mine"
        Path("out", name).unlink()


def test_the_page_escapes_what_it_is_given(here):
    run(Path("runs") / EVIL.replace("/", "-"), seed=1)
    read = Page(page(compare([Path("runs")], by="folder")).decode())
    assert read.named("script") == []
    assert "<script>" in read.text


def test_many_groups_are_told_from_the_best(here):
    for step in range(1, 23):
        run(Path(f"runs/{step}"), f"--update.step_size={step}", score=step)
    comparison = compare([Path("runs")])
    text = describe(comparison)
    assert "update.step_size 22" in text
    assert max(map(len, text.splitlines())) < 80
    assert [(pair.better, pair.worse) for pair in comparison.pairs] == [("V", chr(ord("A") + at)) for at in range(21)]
    read = Page(page(comparison).decode()).text
    assert read.count("update.step_size 22") >= 2
    assert "V > U" in read
    some = compare([Path(f"runs/{step}") for step in range(1, 13)])
    assert len(some.pairs) == 66
    assert "and 55 more, in --json" in describe(some)


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        ("", "the following arguments are required: RUN"),
        ("runs --x miles", "argument --x: invalid choice: 'miles'"),
        ("runs --scale CartPole-v1=1,0", "'CartPole-v1=1,0' is not ENV=LOW,HIGH, with two ascending numbers"),
        ("file", "'file' is not a folder"),
    ],
)
def test_a_mistake_is_one_line(arguments, mistake, here, capsys):
    Path("file").write_text("")
    assert main(["compare", *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert mistake in err


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_run_that_was_killed_is_compared_with_one_that_was_not(here, monkeypatch):
    cut_off(configured(Path("runs/cut"), *QUIET), monkeypatch, after=2)
    training.train(configured(Path("runs/whole"), *QUIET, "--seed=1"))
    answer = compared()
    [panel] = answer["environments"]
    assert (panel["metric"], groups(answer)) == ("exact/J", {"run": 2})
    assert 0 < panel["at"] < 300
    for x in ("calls", "seconds"):
        assert compared(x=x)["environments"][0]["at"] > 0
