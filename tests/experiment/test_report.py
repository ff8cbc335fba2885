"""The page about a run: it needs nothing but itself, shows what the run has left, and says what is missing."""

import base64
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

from pgts_torch.cli.main import main
from pgts_torch.envs import vector
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.report import facts
from pgts_torch.experiment.report.curves import draw, panels
from pgts_torch.experiment.report.page import image, tiles, typeset, write

ROOT = Path(__file__).parents[2]
VOID = {"meta", "img"}
EVIL = "<script>alert(1)</script>"
DRAWN = "data:image/svg+xml;base64,"


class Page(HTMLParser):
    """The elements of a page, their attributes and its text; AssertionError if an end does not fit its start."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text, self._open = "", list[str]()
        self.feed(source)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data

    def named(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "run"
    assert train(folder, "--eval.every=2") == 0
    return folder


def train(folder: Path, *arguments: str) -> int:
    few = ["--total_steps=300", "--rollout.num_envs=4", "--rollout.horizon.length=15", "--eval.episodes=2"]
    quiet = ["--run.tensorboard=false", "--log.checkpoint_every=2", f"--run.dir={folder}"]
    return main(["train", "--config", str(ROOT / "configs" / "ladder.yaml"), *few, *quiet, *arguments])


@pytest.fixture
def run(finished: Path, tmp_path: Path, undrawn: None) -> Path:
    """A finished run that a test may damage."""
    return shutil.copytree(finished, tmp_path / "run", ignore=lambda *_: ["report.html"])


@pytest.fixture(scope="module")
def shown(finished: Path) -> tuple[Page, dict]:
    """The page of a finished run, and what `pgts report --json` prints."""
    return report(finished)


def report(run: Path) -> tuple[Page, dict]:
    answer = write(run, None)
    assert json.loads(json.dumps(answer, allow_nan=False)) == json.loads(json.dumps(answer))
    return Page(Path(answer["page"]).read_text(encoding="utf-8")), answer


def test_the_page_is_well_formed_and_refers_to_nothing_outside_of_it(shown):
    page, answer = shown
    source = Path(answer["page"]).read_text(encoding="utf-8")
    assert not re.search(r"https?:|url\((?!#)|@import|<script|<link|<iframe", source)
    targets = [value for _, given in page.elements for name, value in given.items() if name in ("src", "href")]
    assert len(targets) > 5
    assert all(target.startswith(DRAWN) for target in targets)
    assert len(source) < 1_000_000
    assert all(image["alt"] for image in page.named("img"))
    for target in targets:
        drawing = base64.b64decode(target.removeprefix(DRAWN)).decode()
        assert ElementTree.fromstring(drawing).tag == "{http://www.w3.org/2000/svg}svg"
        assert not re.search(r'<script|<a |href="(?!#|data:image/png;base64,)|url\((?!#)|@import', drawing)


def test_a_page_whose_elements_are_not_closed_would_be_found():
    with pytest.raises(AssertionError):
        Page("<p><b>text</p>")
    with pytest.raises(AssertionError):
        Page("<p>text")


def test_a_finished_run_shows_the_numbers_of_its_summary(finished, shown):
    page, answer = shown
    summary = json.loads((finished / "summary.json").read_text())
    assert (answer["state"], answer["step"], answer["failure"], answer["notes"]) == ("finished", 300, None, [])
    for number in (summary["J"], summary["J_optimal"], summary["sampled"]["episodic_return"]["mean"]):
        assert typeset(f"{number:.4g}") in page.text
    assert typeset(f"J* - J <= {summary['certificate']:.3g}") in page.text
    assert "an estimate" in page.text
    assert answer["certificate"]["bound"] == summary["certificate"]
    assert answer["certificate"]["missing"] == pytest.approx(summary["J_optimal"] - summary["J"])
    assert "Value v(s) of the policy" in page.text


@pytest.mark.usefixtures("undrawn")
def test_an_exact_critic_proves_its_certificate(tmp_path):
    assert train(tmp_path / "run", "--critic={type: exact}") == 0
    page, answer = report(tmp_path / "run")
    assert answer["certificate"]["trust"] == "proved"
    assert "proved" in page.text
    assert answer["certificate"]["bound"] >= answer["certificate"]["missing"] - 1e-9


def test_every_tag_is_drawn_or_named(finished, shown):
    page, _ = shown
    tags = {tag for line in (finished / "metrics.jsonl").read_text().splitlines() for tag in json.loads(line)}
    named = {tag for tag in tags - {"step"} if tag in page.text}
    assert named == {tag for tag in tags - {"step"} if not tag.endswith("_half_width")}
    assert {"exact/J", "search/certificate", "eval/sampled_return", "charts/SPS", "losses/entropy"} <= named


def test_two_reports_of_a_run_are_the_same(finished, shown, tmp_path):
    again = write(finished, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == Path(shown[1]["page"]).read_bytes()
    assert again | {"page": ""} == shown[1] | {"page": ""}


def test_keys_that_differ_from_the_defaults_are_marked(shown):
    settings = {setting["key"]: setting for setting in shown[1]["config"]}
    changed = {key for key, setting in settings.items() if not setting["is_default"]}
    assert {"total_steps", "env.kwargs.n", "policy.type", "policy.init.type", "update.step_size", "run.dir"} <= changed
    assert not {"seed", "env.id", "critic.method.lambda", "policy.init.probability"} & changed
    assert (settings["update.step_size"]["value"], settings["update.step_size"]["default"]) == (2.0, 0.1)


def test_text_from_outside_is_shown_and_never_executed(run):
    (run / "failure.json").write_text(json.dumps({"iteration": 1, "env_step": EVIL, "message": EVIL}))
    (run / "versions.json").write_text(json.dumps({EVIL: "$style \" onload='x'"}))
    (run / "config.yaml").write_text((run / "config.yaml").read_text().replace("start: 0", f"start: '{EVIL}'"))
    with (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"step": 300, EVIL: 1.0}) + "\n")
        file.write(json.dumps({"step": 301, EVIL: 2.0, "$body&amp;": None}) + "\n")
    (run / f"{EVIL.replace('/', '')}.txt").touch()
    page, _ = report(run)
    assert page.named("script") == []
    assert page.text.count(EVIL) >= 4
    assert "$body&amp;" in page.text
    assert not any("onload" in given for _, given in page.elements)


def test_numbers_come_first_in_large_letters_and_a_folder_is_no_number():
    rows = {
        "run folder": "2024",
        "search": "none <=",
        "J": "-1.5 (99 %)",
        "steps": "12000 in 3 iterations",
        "x": "1e-3",
    }
    assert tiles(rows) == [
        ("J", typeset("-1.5"), "99 %"),
        ("steps", "12,000", "in 3 iterations"),
        ("x", typeset("1e-3"), ""),
        ("run folder", "", "2024"),
        ("search", "", "none <="),
    ]


def test_an_unfinished_run_says_how_far_it_is_and_how_to_go_on(run):
    (run / "summary.json").unlink()
    page, answer = report(run)
    assert (answer["state"], answer["total_steps"]) == ("unfinished", 300)
    assert f"pgts train --resume {run}" in page.text
    last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-2])
    assert answer["rows"]["return of the policy, J"] == f"{last['exact/J']:.4g} in the last iteration"
    assert answer["rows"]["last checkpoint"] == "300 steps in 5 iterations"
    assert "Value v(s) of the policy" in page.text


@pytest.mark.usefixtures("undrawn")
def test_a_failed_run_shows_what_failed(tmp_path, monkeypatch):
    step, calls = vector.TabularVectorEnv.step, iter(range(10**6))

    def wrapped(self, actions):
        observation, reward, *rest = step(self, actions)
        return observation, reward * float("nan") if next(calls) >= 30 else reward, *rest

    monkeypatch.setattr(vector.TabularVectorEnv, "step", wrapped)
    assert train(tmp_path / "run") == 1
    page, answer = report(tmp_path / "run")
    assert (answer["state"], answer["step"], answer["failure"]["tensor"]) == ("failed", 120, "reward")
    assert "Training stopped in iteration 2, at step 120, by a reward that is not finite" in page.text
    assert answer["failure"]["message"] in page.text
    assert "after 120 environment steps" in page.text


def test_values_that_are_not_finite_leave_a_gap_and_lines_that_are_damaged_a_note(run):
    lines = [{"step": 1, "a/x": 1.0, "a/y": None}, {"step": 2, "a/x": None}, {"step": 3, "a/x": 2.0}]
    text = "\n".join(map(json.dumps, lines)) + '\n[1]\n{"step": "x"}\n{"step": 4, "a/x": NaN}\n{"step": 5, "a/'
    (run / "metrics.jsonl").write_text(text)
    page, answer = report(run)
    [panel] = answer["curves"]["More"]
    assert panel["curves"][0]["steps"] == [1, 2, 3, 4]
    assert panel["curves"][0]["values"] == [1.0, None, 2.0, None]
    assert answer["never_finite"] == ["a/y"]
    assert answer["notes"] == ["3 of 7 lines of metrics.jsonl cannot be read; they are left out."]
    assert answer["notes"][0] in page.text


@pytest.mark.parametrize("empty", [True, False])
def test_a_run_without_metrics_and_checkpoints_has_a_page_that_says_so(run, empty):
    shutil.rmtree(run / "checkpoints")
    (run / "summary.json").unlink()
    (run / "versions.json").unlink()
    (run / "metrics.jsonl").write_text("") if empty else (run / "metrics.jsonl").unlink()
    page, answer = report(run)
    assert (answer["state"], answer["step"], answer["curves"], answer["rows"]) == ("unfinished", 0, {}, {})
    assert len(answer["notes"]) == 2
    assert all(note.lower() in page.text.lower() for note in answer["notes"])
    assert page.named("img") == []


def test_a_damaged_checkpoint_is_named_and_the_one_before_it_is_shown(run):
    newest = run / "checkpoints" / "000000000300.pt"
    newest.write_bytes(newest.read_bytes()[:-1])
    page, answer = report(run)
    assert [f"{newest} is damaged: its checksum does not fit its content."] == answer["notes"]
    assert "after 240 environment steps" in page.text


def test_an_environment_that_cannot_be_made_costs_only_the_pictures(run, monkeypatch):
    def fails(*args, **kwargs):
        raise PgtsError("env 'pgts/Ladder-v0' cannot be made")

    monkeypatch.setattr(facts.PGTS, "load", fails)
    page, answer = report(run)
    assert "Value v(s) of the policy" not in page.text
    assert len(page.named("img")) > 5
    [note] = answer["notes"]
    assert note.endswith("there is no picture of it: env 'pgts/Ladder-v0' cannot be made.")


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"deterministic": 1}'])
def test_a_damaged_summary_is_named(run, content):
    (run / "summary.json").write_text(content)
    _, answer = report(run)
    assert answer["state"] == "unfinished"
    [note] = answer["notes"]
    assert "summary.json is damaged (summary" in note


def test_a_curve_of_many_points_is_a_small_drawing():
    lines = [{"step": k, "a/x": float(k * k % 101)} for k in range(20_000)]
    [panel] = panels(lines)[0]["More"]
    [few] = panels(lines[:20])[0]["More"]
    assert len(image(draw(panel))) < 60_000
    assert image(draw(panel)) == image(draw(panel)) != image(draw(few))


def test_a_number_too_large_for_a_drawing_is_none():
    assert not any(facts.number(value) for value in [10**400, float("inf"), float("nan"), None, "1"])
    assert all(facts.number(value) == value for value in [0, -1.5, 10**300])


def test_intervals_are_drawn_around_their_means_and_not_as_curves():
    tag, widths = "eval/sampled_return", [2, 1, None]
    lines = [{"step": k, tag: k, f"{tag}_half_width": width} for k, width in enumerate(widths)]
    [panel] = panels(lines)[0]["Return"]
    [curve] = panel["curves"]
    assert (curve["tag"], curve["half_widths"]) == (tag, widths)
    [without] = panels([{"step": k, tag: k} for k in range(3)])[0]["Return"]
    assert len(draw(panel).axes[0].collections) == 1
    assert len(draw(without).axes[0].collections) == 0


def test_the_command_prints_the_path_or_the_data(run, tmp_path, capsys):
    assert main(["report", str(run)]) == 0
    assert capsys.readouterr().out == f"{run / 'report.html'}\n"
    out = tmp_path / "elsewhere.html"
    assert main(["report", str(run), "--out", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["page"], answer["name"], answer["seed"]) == (str(out), "ladder", 0)
    assert out.read_text() == (run / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        (["none"], "'none' is not a folder"),
        (["."], "'.' is not the folder of a run"),
        (["run", "--out", "config.yaml"], "--out: 'config.yaml'"),
        (["run", "--out", "none/x.html"], "--out: 'none/x.html'"),
    ],
)
def test_a_mistake_is_one_line_with_exit_code_2(run, monkeypatch, capsys, arguments, mistake):
    monkeypatch.chdir(run.parent)
    assert main(["report", *arguments]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert mistake in line
    assert not list(run.parent.rglob("*.html"))


def test_a_configuration_that_cannot_be_read_is_one_line_and_no_page(run, capsys):
    (run / "config.yaml").write_text("sed: 1\n")
    assert main(["report", str(run)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (run / "report.html").exists()
