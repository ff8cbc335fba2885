"""The command `pgts`: help, exit codes, and what it passes on."""

import json
import re
import subprocess
import sys
import tomllib
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pgts_torch import experiment
from pgts_torch.cli.commands import COMMANDS
from pgts_torch.cli.main import main
from pgts_torch.config import Config, dump, load, strict_yaml
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import summary
from pgts_torch.options.schema import schema_of
from tests.forks import PATIENCE, started

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Answer:
    """Stands for what training or an evaluation returns."""

    mean: float
    half_width: float | None = None


class FakeRun(types.ModuleType):
    """Stands for the run loop, and remembers what it was given."""

    def __init__(self) -> None:
        super().__init__("pgts_torch.experiment.run")
        self.calls: list[Any] = []
        self.error: BaseException | None = None

    def train(self, config: Config, *, strict_resume: bool, any_world_size: bool) -> Answer:
        self.calls.append(config)
        if self.error is not None:
            raise self.error
        return Answer(0.5)


class FakeEvaluation(types.ModuleType):
    """Stands for the evaluation of a run, likewise."""

    def __init__(self) -> None:
        super().__init__("pgts_torch.experiment.evaluate")
        self.calls: list[Any] = []

    def evaluate_run(self, run: Path, **options: Any) -> dict[str, Answer]:
        self.calls.append((run, *options.values()))
        return {"sampled": Answer(0.25), "deterministic": Answer(0.5, 0.125)}


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> FakeRun:
    fake = FakeRun()
    monkeypatch.setitem(sys.modules, "pgts_torch.experiment.run", fake)
    monkeypatch.setattr(experiment, "run", fake, raising=False)
    monkeypatch.setattr(summary, "describe", lambda answer: f"mean: {answer.mean}")
    return fake


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        ([], f"a command is missing; choose from {', '.join(COMMANDS)} (see pgts --help)"),
        (["trian"], "'trian' is not a command; did you mean train? (see pgts --help)"),
        (["xyz"], f"'xyz' is not a command; choose from {', '.join(COMMANDS)} (see pgts --help)"),
        (
            ["figures", "--quick"],
            "'figures' is no longer a command of pgts; "
            "run python -m study in a checkout of the repository (see pgts --help)",
        ),
        (["--verbose"], "unrecognized arguments: --verbose (see pgts --help)"),
        (["train", "--config"], "argument --config: expected one argument (see pgts train --help)"),
        (["train", "--config", "none.yaml"], "none.yaml: the configuration cannot be read: No such file or directory"),
        (["train", "--conf", "x.yaml"], "--conf is unknown; `pgts train --help` lists all keys"),
        (["train", "--search.depth", "-1"], "--search.depth is -1; it must be a whole number >= 0 or adaptive"),
        (["evaluate"], "the following arguments are required: RUN_DIR (see pgts evaluate --help)"),
        (["evaluate", "none"], "argument RUN_DIR: 'none' is not a folder (see pgts evaluate --help)"),
        (
            ["evaluate", "."],
            "argument RUN_DIR: '.' is not the folder of a run: it has no config.yaml (see pgts evaluate --help)",
        ),
        (
            ["evaluate", "--episodes", "0", "."],
            "argument --episodes: '0' is not a whole number >= 1 and below 2**63 (see pgts evaluate --help)",
        ),
    ],
)
def test_a_mistake_is_one_line_on_stderr_with_exit_code_2_and_leaves_nothing(
    run: FakeRun, here: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], mistake: str
) -> None:
    assert main(arguments) == 2
    assert capsys.readouterr() == ("", f"error: {mistake}\n")
    assert not run.calls
    assert not list(here.iterdir())


def test_several_mistakes_are_several_lines(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--seed", "-1", "--threads", "0"]) == 2
    one, other = capsys.readouterr().err.splitlines()
    assert one.startswith("error: --seed is -1; ")
    assert other.startswith("error: --threads is 0; ")


def test_train_passes_on_the_file_with_its_overrides(
    run: FakeRun, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "c.yaml").write_text("search: {depth: 2}\ncritic: {target: q}\n")
    arguments = [
        "--search.depth",
        "4",
        "--config",
        "c.yaml",
        "--seed=1",
        "--run.dir",
        "out",
        "--update.step_size",
        "1e-3",
    ]
    assert main(["train", *arguments]) == 0
    overrides = [argument for argument in arguments if argument not in ("--config", "c.yaml")]
    assert run.calls == [load("c.yaml", overrides)]
    assert (run.calls[0].search.depth, run.calls[0].critic.target, run.calls[0].run.dir) == (4, "q", "out")
    assert capsys.readouterr() == ("mean: 0.5\n", "")


@pytest.mark.parametrize("command", ["evaluate", "report", "watch", "export"])
def test_a_configuration_of_the_user_makes_no_run_of_a_folder(
    here: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    (here / "config.yaml").write_text("name: mine\n")
    assert main([command, "."]) == 2
    mistake = f"argument RUN_DIR: '.' is not the folder of a run: it has no .pgts_run (see pgts {command} --help)"
    assert capsys.readouterr() == ("", f"error: {mistake}\n")
    assert [path.name for path in here.iterdir()] == ["config.yaml"]


def test_train_with_an_environment_says_nothing_of_defaults(run: FakeRun, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--env.id", "CartPole-v1"]) == 0
    assert capsys.readouterr().err == ""


def test_train_without_a_file_says_that_the_defaults_apply(run: FakeRun, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--json"]) == 0
    assert run.calls == [Config()]
    out, err = capsys.readouterr()
    assert json.loads(out) == {"mean": 0.5, "half_width": None}
    assert err == "no --config: starting from the defaults (pgts/Ladder-v0)\n"


def test_print_config_prints_yaml_that_loads_to_the_same_configuration(
    run: FakeRun, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--config", str(ROOT / "configs" / "ladder.yaml"), "--env.kwargs.n", "7", "--run.overwrite"]
    assert main(["train", "--print-config", *arguments]) == 0
    out, err = capsys.readouterr()
    assert Config.model_validate(strict_yaml.parse(out).value) == load(arguments[1], arguments[2:])
    assert (err, run.calls, list(here.iterdir())) == ("", [], [])


def test_evaluate_passes_on_its_arguments_and_prints_for_people_or_programs(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = FakeEvaluation()
    monkeypatch.setitem(sys.modules, "pgts_torch.experiment.evaluate", fake)
    (here / "config.yaml").write_text(dump(Config()))
    (here / ".pgts_run").write_text("{}")
    assert main(["evaluate", ".", "--episodes", "7", "--seed", "3", "--checkpoint", "40"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "sampled.mean              0.25",
        "sampled.half_width        none",
        "deterministic.mean        0.5",
        "deterministic.half_width  0.125",
    ]
    assert main(["evaluate", "--json", "."]) == 0
    assert json.loads(capsys.readouterr().out)["deterministic"] == {"mean": 0.5, "half_width": 0.125}
    assert fake.calls == [(Path("."), 40, 7, 3, False), (Path("."), "last", 100, 0, False)]


def test_an_error_of_the_run_is_one_line_and_ctrl_c_exits_with_130(
    run: FakeRun, capsys: pytest.CaptureFixture[str]
) -> None:
    run.error = PgtsError("no such environment: Laddr-v0")
    assert main(["train", "--seed", "1"]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == "error: no such environment: Laddr-v0"
    run.error = KeyboardInterrupt()
    assert main(["train", "--seed", "1"]) == 130
    assert capsys.readouterr().err.splitlines()[-1] == "interrupted"


def test_a_defect_of_ours_keeps_its_traceback(run: FakeRun) -> None:
    run.error = AssertionError("a defect")
    with pytest.raises(AssertionError, match="a defect"):
        main(["train", "--seed", "1"])


def test_version_and_help_exit_with_0(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert re.fullmatch(r"pgts \d+\.\d+\.\d+\n", capsys.readouterr().out)
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    for name, function in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(str(function.__doc__))}$", out, re.MULTILINE)
        assert main([name, "--help"]) == 0


def test_the_help_of_train_names_every_key_with_requirement_default_and_meaning_within_80_columns(
    capsys: pytest.CaptureFixture[str],
) -> None:
    main(["train", "--help"])
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) < 80
    text = " ".join(out.split())
    options = schema_of(Config).options()
    assert {"seed", "search.depth", "critic.method.lambda", "env.kwargs"} <= {option.key for option in options}
    for option in options:
        default = strict_yaml.parse(_default_in(text, option.key, option.requirement)).value
        assert all(f"{key} {'|'.join(values)}" in text for key, values in option.when)
        assert default == option.default or option.when
        assert option.meaning, option.key
        assert option.meaning in text
        for value, meaning in option.choices:
            assert f"{value}: {meaning}" in text


def _default_in(text: str, key: str, requirement: str) -> str:
    found = re.search(rf"--{re.escape(key)} {re.escape(requirement)} \(default: (.*?)\)", text)
    assert found, key
    return found[1]


@pytest.fixture
def shell(tmp_path: Path) -> Callable[..., "subprocess.CompletedProcess[str]"]:
    def call(*command: str) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=False)

    return call


TORCH_FREE = """
import sys
from pgts_torch.cli.main import main
for arguments in (["--help"], ["train", "--help"], ["train", "--print-config"], ["train", "--search.depth", "-1"],
                  ["train", "--config", "none.yaml"], ["evaluate", "none"], ["trian"], ["sweep", "--help"],
                  ["sweep", "--out", "o", "--seed", "1"], ["check-model", "--help"], ["check-model"],
                  ["stationary", "--help"], ["stationary", "laddr"], ["stationary", "ladder", "--gamma", "2"]):
    main(arguments)
sys.exit(3 if "torch" in sys.modules else 0)
"""


def test_help_and_mistakes_do_not_wait_for_torch(shell: Callable[..., "subprocess.CompletedProcess[str]"]) -> None:
    done = shell(sys.executable, "-c", TORCH_FREE)
    assert done.returncode == 0, "torch was imported"
    assert len(done.stderr.splitlines()) == 8


def test_train_py_is_pgts_train(shell: Callable[..., "subprocess.CompletedProcess[str]"], tmp_path: Path) -> None:
    done = shell(sys.executable, str(ROOT / "train.py"), "--serch.depth", "4")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: --serch.depth is unknown; did you mean --search.depth?\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.fault("reader that leaves early")
def test_a_reader_that_leaves_early_is_no_error(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pgts_torch.cli", "train", "--help"]
    with started(command, cwd=tmp_path, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(PATIENCE) == 141


def test_a_shipped_configuration_is_found_by_its_name_from_any_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--config", "learned/cartpole", "--print-config"]) == 0
    shown = capsys.readouterr().out
    assert shown == dump(load(ROOT / "configs/learned/cartpole.yaml"))
    (tmp_path / "ladder").write_text("name: mine\n")  # a file comes before a name
    assert main(["train", "--config", "ladder", "--print-config"]) == 0
    assert "name: mine" in capsys.readouterr().out
    assert main(["train", "--config", "laddder"]) == 2


def test_list_names_every_configuration_in_lines_that_fit(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 79
    for path in (ROOT / "configs").rglob("*.yaml"):
        assert any(
            line.split()[:1] == [path.relative_to(ROOT / "configs").with_suffix("").as_posix()] for line in lines
        )
    assert main(["list", "--json"]) == 0
    assert "pgts/Ladder-v0" in json.loads(capsys.readouterr().out)["environments"]["table"]


def test_list_says_of_every_extra_for_users_whether_it_is_installed(capsys, monkeypatch):
    found = {"optuna": True, "onnx": True, "onnxscript": True, "onnxruntime": False}
    monkeypatch.setattr("importlib.util.find_spec", found.get)
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    at = lines.index("extras, pip install 'pgts_torch[EXTRA]':")
    said = {line.split()[0]: line.split()[1] for line in lines[at + 1 :]}
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert said == dict.fromkeys(declared.keys() - {"dev", "docs", "bench"}, "missing") | {"tune": "installed"}
