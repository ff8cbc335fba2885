"""A module that only a saved file names is not imported, unless somebody has said that it may be."""

import sys
from pathlib import Path

import gymnasium
import pytest

from pgts_torch import PGTS
from pgts_torch.cli.main import main
from pgts_torch.config import load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.resume import names_modules
from pgts_torch.experiment.run import build
from pgts_torch.options import OwnModel
from pgts_torch.trust import check_imports

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

MODULE = """
from pathlib import Path
import gymnasium
from pgts_torch.envs import entry_points
Path("trace").write_text("imported")
if "Mine-v0" not in gymnasium.registry:
    gymnasium.register("Mine-v0", entry_point=entry_points.ladder, vector_entry_point=entry_points.ladder_vector)
"""
TINY = ["--rollout.num_envs=1", "--rollout.horizon.length=5", "--search.depth=0", "--eval.episodes=1"]
ENV = "environments_of_mine:Mine-v0"
SHORT = [*TINY, "--total_steps=10", "--run.tensorboard=false", "--run.dir=run"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a module of environments that leaves a trace where it is imported."""
    (tmp_path / "environments_of_mine.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("environments_of_mine", None)


def forgotten() -> Path:
    """The trace of an import, and nobody has imported the module yet."""
    sys.modules.pop("environments_of_mine", None)
    trace = Path("trace")
    trace.unlink(missing_ok=True)
    return trace


@pytest.mark.fault("saved file that names a module")
def test_a_saved_model_imports_the_module_of_its_environment_only_where_it_is_trusted(here):
    PGTS(ENV, depth=0, num_envs=1).save("model.pt")
    trace = forgotten()
    with pytest.raises(PgtsError, match=r"^model\.pt names 'environments_of_mine:Mine-v0' .* trust_imports=True"):
        PGTS.load("model.pt")
    assert not trace.exists()
    assert PGTS.load("model.pt", trust_imports=True).num_env_steps == 0
    assert trace.exists()


@pytest.mark.usefixtures("undrawn")
@pytest.mark.fault("saved file that names a module")
def test_the_folder_of_a_run_imports_a_module_only_where_it_is_trusted(here, capsys):
    assert main(["train", f"--env.id={ENV}", *SHORT]) == 0  # typed by the user, who so consents
    trace = forgotten()
    for command in (["train", "--resume", "run"], ["evaluate", "run"]):
        assert main(command) == 2
        assert "names 'environments_of_mine:Mine-v0' as its environment" in capsys.readouterr().err
        assert not trace.exists()
    assert main(["report", "run"]) == 0
    assert not trace.exists()
    assert "trust_imports=True, or --trust-imports" in Path("run/report.html").read_text()
    assert main(["report", "run", "--trust-imports"]) == 0
    assert trace.exists()
    assert main(["evaluate", "run", "--trust-imports", "--episodes=1"]) == 0
    for consent in (["--trust-imports"], [f"--env.id={ENV}"]):
        assert main(["train", "--resume", "run", *consent]) == 2
        assert "holds a finished run" in capsys.readouterr().err
    assert main(["train", "--trust-imports"]) == 2
    assert "error: --trust-imports goes with --resume only" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("env", "kwargs", "refused"),
    [
        ("os:Path-v0", {}, True),
        ("a.b:c:Id-v0", {}, True),
        (" os : x", {}, True),
        (None, {"make": "os:system"}, True),
        ("CartPole-v1", {"inner": [{"env": ("a_b.c:D-v0",)}]}, True),
        ("CartPole-v1", {"os:system": 1}, True),
        ("ALE/Pong-v5", {"url": "http://x.org:80/a", "time": "12:30", "n": 3}, False),
        (None, {}, False),
        (None, None, False),
    ],
)
def test_what_names_a_module_is_told_from_what_does_not(env, kwargs, refused):
    if refused:
        with pytest.raises(PgtsError, match="imports the module"):
            check_imports("file", env, kwargs)
    else:
        check_imports("file", env, kwargs)


OWN = """
from pathlib import Path
from pgts_torch.models import TabularModel
from pgts_torch.tabular import ladder
Path("trace").write_text("imported")

def model():
    return TabularModel(ladder(start=0))

def nothing():
    return None

def of_size(length):
    return TabularModel(ladder(length, start=0))
"""


def test_a_model_of_the_callers_own_is_named_in_a_configuration_and_imported_only_where_it_is_trusted(here, capsys):
    (here / "models_of_mine.py").write_text(OWN)
    own = {"type": "own", "make": "models_of_mine:model"}
    main(["train", *SHORT, "--model", "models_of_mine:model"])
    assert type(PGTS("pgts/Ladder-v0", model=own, env_kwargs={"start": 0}).world.model).__name__ == "TabularModel"
    trace = forgotten()
    sys.modules.pop("models_of_mine", None)
    saved = next(Path("run/checkpoints").glob("*.pt"))
    with pytest.raises(PgtsError, match="names 'models_of_mine:model' as its model; that imports"):
        PGTS.load(saved)
    assert main(["train", "--resume=run", "--total_steps=20"]) == 2
    assert "names 'models_of_mine:model' as its model" in capsys.readouterr().err
    assert not trace.exists()
    PGTS.load(saved, trust_imports=True)
    assert trace.exists()
    sys.modules.pop("models_of_mine", None)


def test_a_network_of_the_callers_own_of_a_run_is_imported_only_where_it_is_trusted(here, capsys):
    (here / "nets_of_mine.py").write_text("from tests.agent.modules import Plain\nclass Net(Plain):\n    pass\n")
    for part in ("policy", "critic"):
        main(["train", *SHORT, f"--run.dir={part}", f"--{part}", "nets_of_mine:Net"])
        sys.modules.pop("nets_of_mine", None)
        for command in (["train", "--resume", part], ["evaluate", part]):
            assert main(command) == 2
            assert f"names 'nets_of_mine:Net' as its {part}" in capsys.readouterr().err
        assert "nets_of_mine" not in sys.modules
        assert main(["evaluate", part, "--trust-imports", "--episodes=1"]) == 0
        sys.modules.pop("nets_of_mine", None)


def test_a_model_of_the_callers_own_takes_arguments(here, tmp_path):
    (here / "models_of_mine.py").write_text(OWN)
    (here / "own.yaml").write_text(
        "env: {kwargs: {n: 7}}\nmodel: {make: 'models_of_mine:of_size', arguments: {length: 7}}"
    )
    flags = ["--model", "models_of_mine:of_size", "--model.arguments.length", "7", "--env.kwargs.n", "7"]
    for config in (load(here / "own.yaml"), load(None, flags)):
        assert config.model == OwnModel(make="models_of_mine:of_size", arguments={"length": 7})
        training = build(config)
        assert training.world.model.num_states == training.world.env.single_observation_space.n == 7
    training.save(here / "model.pt")
    assert PGTS.load(here / "model.pt", trust_imports=True).world.model.num_states == 7
    with pytest.raises(PgtsError, match=r"models_of_mine:of_size, which cannot be made.*missing 1 required"):
        PGTS("pgts/Ladder-v0", model="models_of_mine:of_size")
    with pytest.raises(PgtsError, match=r"model\.arguments holds inf; numbers must be finite"):
        PGTS("pgts/Ladder-v0", model={"make": "models_of_mine:of_size", "arguments": {"length": float("inf")}})
    sys.modules.pop("models_of_mine", None)


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (None, r"model\.make is missing"),
        ("models_of_mine:nothing", r"made None; it must be a pgts_torch\.models\.Model"),
        ("models_of_mine:missing", "cannot be made"),
        ("no_such_module:model", "cannot be made"),
    ],
)
def test_a_model_that_cannot_be_made_is_refused(here, make, why):
    (here / "models_of_mine.py").write_text(OWN)
    with pytest.raises(PgtsError, match=why):
        PGTS("pgts/Ladder-v0", model={"type": "own"} | ({} if make is None else {"make": make}))
    sys.modules.pop("models_of_mine", None)


def test_a_module_in_the_working_folder_is_found_and_hides_no_installed_one(here, capsys, monkeypatch):
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each not in ("", str(here))])
    for name in ("zipapp.py", "game_of_mine.py"):
        (here / name).write_text(
            "import gymnasium\nfrom gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv\n"
            "gymnasium.register('Pond-v0', FrozenLakeEnv, max_episode_steps=50)\n"
        )
    try:
        for env_id, code in (("zipapp:Pond-v0", 2), ("game_of_mine:Pond", 0)):
            assert main(["train", "--env.id", env_id, "--total_steps", "20", "--run.dir", "run"]) == code
        (here / "neighbour.py").write_text("import no_such_module")
        assert main(["train", "--env.id", "neighbour:Pond-v0", "--total_steps", "20"]) == 2
        assert "neighbour:Pond-v0 cannot be made: No module named 'no_such_module'" in capsys.readouterr().err
    finally:
        gymnasium.registry.pop("Pond-v0", None)
        sys.modules.pop("game_of_mine", None)


@pytest.mark.parametrize("flags", ["--policy a:Net", "--policy.type gaussian --policy.network a:Net", "--critic a:Net"])
def test_the_command_that_resumes_a_run_with_a_network_of_ones_own_trusts_it(flags):
    assert names_modules(load(None, flags.split()))
    assert not names_modules(load(None, ["--policy.type", "gaussian", "--policy.network.type", "mlp"]))
