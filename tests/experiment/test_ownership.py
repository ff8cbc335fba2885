"""Only files that a run has made are ever replaced or removed, whatever else lies in its folder."""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pgts_torch.cli.main import main
from pgts_torch.config import Config, dump, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint, opening, ownership, run
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.ownership import MARK_FILE
from pgts_torch.experiment.tracking import RunFolder, read_metrics
from tests.experiment.runs import put, tree

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

TINY = ["--rollout.num_envs=1", "--rollout.horizon.length=5", "--search.depth=0", "--eval.episodes=1"]
SHORT = [*TINY, "--total_steps=15", "--log.checkpoint_every=1", "--run.tensorboard=false"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def killed(folder: str, monkeypatch: pytest.MonkeyPatch, *arguments: str, after: int = 1) -> Path:
    """The folder of a run that dies after so many lines of metrics."""
    log, lines = RunFolder.log, 0

    class Killed(BaseException):
        """Stands for `kill -9`."""

    def counted(*args):
        nonlocal lines
        log(*args)
        lines += 1
        if lines == after:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "log", counted)
        with pytest.raises(Killed):
            run.train(load(None, [*SHORT, f"--run.dir={folder}", *arguments]))
    return Path(folder)


@pytest.mark.fault("project folder as run folder")
@pytest.mark.parametrize("more", [[], ["--run.overwrite"]])
@pytest.mark.parametrize("ours", [True, False])
def test_a_project_folder_with_a_configuration_is_left_as_it_is(more, ours, here, capsys):
    put(here, thesis_tex="mine", data__a_csv="1,2", _git__HEAD="ref", notes="mine")
    (here / "config.yaml").write_text("total_steps: 15\n" if ours else "learning_rate: 1\n")
    before = tree(here)
    given = ["--config", "config.yaml"] if ours else []
    assert main(["train", *given, *SHORT, "--run.dir=.", *more]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    mistake = "error: run.dir . holds files that no run has left (.git, config.yaml, data, notes, thesis.tex);"
    assert said == f"{mistake} choose another folder"
    assert tree(here) == before


@pytest.mark.fault("files of the user in a run folder")
@pytest.mark.parametrize("unfinished", [True, False])
def test_a_run_that_starts_over_keeps_and_names_the_files_of_the_user(unfinished, here, monkeypatch, capsys):
    if unfinished:
        folder = killed("run", monkeypatch, "--log.checkpoint_every=100")
    else:
        run.train(load(None, [*SHORT, "--run.dir=run"]))
        folder = Path("run")
        put(folder, checkpoints__000000000015__mine_txt="mine", checkpoints__best__model_pt="mine")
    put(here, outside__model_pt="mine")
    put(folder, notes_md="mine", data__model_pt="mine", events_out_tfevents_123_host="mine", x_partial="mine")
    (folder / "link").symlink_to(here / "outside")
    put(folder, _best_pt_mine_partial="mine")
    theirs = {name: content for name, content in tree(folder).items() if content in ("mine", b"mine")}
    more = [] if unfinished else ["--run.overwrite", "--seed=1"]
    checkpointing = "--log.checkpoint_every=100" if unfinished else "--log.checkpoint_every=1"
    assert main(["train", *SHORT, checkpointing, "--run.dir=run", *more]) == 0
    assert {name: tree(folder)[name] for name in theirs} == theirs
    assert (here / "outside" / "model.pt").read_text() == "mine"
    [note] = [line for line in capsys.readouterr().err.splitlines() if "also holds" in line]
    assert note.startswith("note: run.dir run also holds .best.pt.mine.partial, ")
    assert note.endswith(", which no run has left; it stays")
    assert [line["step"] for line in read_metrics(folder)] == [5, 10, 15]
    assert len(ownership.checkpoints(folder)) == (1 if unfinished else 3)
    assert all(checkpoint.read(path) for path in ownership.checkpoints(folder))


@pytest.mark.usefixtures("undrawn")
def test_a_run_that_is_overwritten_leaves_nothing_of_the_one_before(here, capsys):
    run.train(load(None, [*SHORT, "--run.dir=run", "--run.tensorboard=true", "--eval.every=5", "--eval.keep_best"]))
    (here / "run" / ".metrics.jsonl.77.partial").write_text("{")
    (here / "run" / "checkpoints" / ".000000000020.pt.77.partial").write_text("half")
    assert main(["report", "run"]) == 0
    before = tree(here / "run")
    run.train(load(None, ["--run.dir=run", "--run.overwrite", *SHORT, "--total_steps=5", "--seed=3"]))
    after = tree(here / "run")
    new = {".lock", "checkpoints", "config.yaml", MARK_FILE, "metrics.jsonl", "policy.png", "summary.json"}
    saved = {"checkpoints/000000000005.pt"}
    assert after.keys() == new | saved | {"versions.json"}
    assert {"best.pt", "report.html", "checkpoints/.000000000020.pt.77.partial"} < before.keys()
    assert "note" not in capsys.readouterr().err


@pytest.mark.fault("run of version 0.1")
def test_a_run_of_version_0_1_is_named_and_left_as_it_is(here, capsys):
    put(here, run__config_yaml="seed: 1\n", run__checkpoints__000000000005__manifest_json="{}")
    before = tree(here)
    for command in (
        ["train", *SHORT, "--run.dir=run", "--run.overwrite"],
        ["train", "--resume", "run"],
        ["evaluate", "run"],
        ["report", "run"],
    ):
        assert main(command) == 2
        assert "a run of version 0.1" in capsys.readouterr().err
    assert tree(here) == before


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("metrics.jsonl", '{"step": 1, "loss": 0.5}\n'),
        ("versions.json", '{"python": "3", "torch": "2"}'),
        ("summary.json", "{}"),
        ("checkpoints/000000000005.pt", "mine"),
        (".lock", "mine"),
        (".pgts_run.bak", "{}"),
    ],
)
def test_a_folder_that_only_resembles_a_run_is_refused(name, content, here):
    put(here, config_yaml=dump(Config()))
    (here / name).parent.mkdir(parents=True, exist_ok=True)
    (here / name).write_text(content)
    before = tree(here)
    for more in ([], ["--run.overwrite"]):
        with pytest.raises(PgtsError, match=r"^run.dir . holds files that no run has left"):
            run.train(load(None, [*SHORT, "--run.dir=.", *more]))
    assert tree(here) == before


@pytest.mark.fault("something else under the name of a file of the run")
@pytest.mark.parametrize("kind", ["symbolic link", "pipe", "folder"])
@pytest.mark.parametrize("name", ["metrics.jsonl", ".lock", "best.pt", "checkpoints", "config.yaml"])
def test_a_link_pipe_or_folder_under_the_name_of_a_file_of_the_run_is_refused(name, kind, here, monkeypatch, capsys):
    folder = killed("run", monkeypatch, after=2)
    put(here, theirs__model_pt="mine", theirs_txt="mine")
    path = folder / name
    if path.exists():
        path.rename(here / "away")
    if kind == "symbolic link":
        path.symlink_to(here / ("theirs" if name == "checkpoints" else "theirs.txt"))
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
    if name == "checkpoints" and kind == "folder":
        pytest.skip("that is what it is")
    before = tree(here)
    for more in ([], ["--run.overwrite"]):
        assert main(["train", *SHORT, "--run.dir=run", *more]) == 2
        what = "folder" if name == "checkpoints" else "file"
        mistake = f"error: run/{name} is a {kind}; a run keeps a {what} of its own there: move it away"
        assert capsys.readouterr().err.splitlines()[-1] == mistake
    assert tree(here) == before


@pytest.mark.fault("something else in place of a run folder")
def test_a_run_dir_that_is_no_folder_is_refused_by_name(here, capsys):
    (here / "file").write_text("mine")
    os.mkfifo(here / "pipe")
    (here / "lost").symlink_to("nowhere")
    for name, mistake in {
        "file": "is a file; it must be a folder or not exist",
        "pipe": "is a pipe; it must be a folder or not exist",
        "lost": "is a link to nowhere; it must be a folder or not exist",
        "file/run": "cannot be written to: Not a directory",
        "x" * 300: "File name too long",
    }.items():
        for more in ([], ["--run.overwrite"]):
            assert main(["train", *SHORT, f"--run.dir={name}", *more]) == 2
            [said] = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
            assert name in said
            assert said.endswith(mistake)
    assert sorted(tree(here)) == ["file", "lost", "pipe"]


def test_a_link_to_a_folder_serves_as_that_folder(here):
    put(here, thesis__thesis_tex="mine")
    (here / "empty").mkdir()
    for name in ("thesis", "empty"):
        (here / f"to-{name}").symlink_to(name)
    assert main(["train", *SHORT, "--run.dir=to-thesis", "--run.overwrite"]) == 2
    assert main(["train", *SHORT, "--run.dir=to-empty"]) == 0
    assert tree(here / "thesis") == {"thesis.tex": b"mine"}
    assert len(read_metrics(here / "empty")) == 3


@pytest.mark.fault("run folder replaced meanwhile")
def test_nothing_is_written_into_a_folder_that_took_the_place_of_the_runs(here, monkeypatch, capsys):
    log = RunFolder.log

    def replaced(self, step, tags):
        log(self, step, tags)
        if step == 10:
            Path("run").rename("moved")
            put(here, run__thesis_tex="mine", run__checkpoints__000000000001__model_pt="mine")

    monkeypatch.setattr(RunFolder, "log", replaced)
    assert main(["train", *SHORT, "--run.dir=run"]) == 2
    assert "error: run.dir run was moved or replaced while this run had it" in capsys.readouterr().err
    files = {name: content for name, content in tree(here / "run").items() if content is not None}
    assert files == {"thesis.tex": b"mine", "checkpoints/000000000001/model.pt": b"mine"}
    assert [path.name for path in ownership.checkpoints(here / "moved")] == ["000000000005.pt"]


@pytest.mark.fault("edited configuration of a run")
def test_an_edited_configuration_is_kept_or_refused_and_never_overwritten(here, monkeypatch, capsys):
    folder = killed("run", monkeypatch, after=2)
    edited = (folder / "config.yaml").read_text() + "# what I found: it works\n"
    (folder / "config.yaml").write_text(edited)
    for more in (["--name=other"], ["--run.overwrite", "--seed=1"]):
        assert main(["train", *SHORT, "--run.dir=run", *more]) == 2
        mistake = "error: run/config.yaml is not as a run has written it, and says something else than this one: move"
        assert mistake in capsys.readouterr().err
    assert main(["train", "--resume", "run"]) == 0
    assert main(["train", *SHORT, "--run.dir=run", "--run.overwrite"]) == 0
    assert (folder / "config.yaml").read_text() == edited


@pytest.mark.fault("damaged mark of a run folder")
def test_a_damaged_mark_is_named_and_nothing_is_removed(here, monkeypatch, capsys):
    folder = killed("run", monkeypatch)
    (folder / MARK_FILE).write_bytes((folder / MARK_FILE).read_bytes()[:-9])
    before = tree(folder)
    for more in ([], ["--run.overwrite"]):
        assert main(["train", *SHORT, "--run.dir=run", *more]) == 2
        assert "error: run/.pgts_run is damaged or of another version" in capsys.readouterr().err
    assert tree(folder) == before


@pytest.mark.fault("two runs in the same second")
def test_runs_that_start_in_the_same_second_have_folders_of_their_own(here, monkeypatch):
    monkeypatch.setattr(time, "strftime", lambda form: "now")
    config = Config()
    with ThreadPoolExecutor(8) as pool:
        paths = list(pool.map(lambda _: opening.new_folder(config), range(24)))
    assert len(set(paths)) == 24
    assert all(path.is_dir() for path in paths)
    with opening.claimed(config) as first, opening.claimed(config) as second:
        assert first.path != second.path


@pytest.mark.fault("lock that is a symbolic link")
@pytest.mark.parametrize("kind", ["link", "content"])
def test_a_lock_is_not_followed_and_nothing_foreign_is_emptied(kind, here):
    put(here, theirs_txt="mine", run__x="")
    if kind == "link":
        (here / "run" / ".lock").symlink_to(here / "theirs.txt")
    else:
        put(here / "run", _lock="mine")
    complaint = {"link": "run cannot be written to: Too many levels of", "content": "is not the lock of a run"}
    with pytest.raises(PgtsError, match=complaint[kind]):
        RunLock(Path("run"))
    assert (here / "theirs.txt").read_text() == (here / "run" / ".lock").read_text() == "mine"


class FakeMsvcrt:
    """What Windows has in place of fcntl: a byte is locked, for others also those of this process."""

    LK_NBLCK = 1

    def __init__(self) -> None:
        self.locked = set[tuple[int, int]]()

    def locking(self, handle: int, mode: int, count: int) -> None:
        place = (os.fstat(handle).st_ino, os.lseek(handle, 0, os.SEEK_CUR))
        if place in self.locked:
            raise PermissionError(13, "Permission denied")
        self.locked.add(place)


def test_a_lock_works_where_there_is_no_fcntl(here, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "msvcrt", FakeMsvcrt())
    monkeypatch.setattr("pgts_torch.experiment.locking.fcntl", None)
    with RunLock(Path("run")) as lock:
        lock.check()
        with pytest.raises(PgtsError, match=f"^run.dir run is in use by the process {os.getpid()}$"):
            RunLock(Path("run"))
