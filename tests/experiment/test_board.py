"""What TensorBoard shows of a training, by the command line and by `learn`, as TensorBoard itself reads it."""

import io
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from pgts_torch import PGTS, EvalCallback
from pgts_torch.agent import board as boards
from pgts_torch.agent.board import Events, is_drawn
from pgts_torch.agent.diagnostics import spread
from pgts_torch.envs.drawing import BAR, Drawing, policy_pixels
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import run
from pgts_torch.experiment.summary import summary_in
from pgts_torch.tabular import exact, grid, ladder
from tests.experiment.cut_off import configured, cut_off
from tests.forks import on_ranks

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

ALL: dict[str, int] = dict.fromkeys(("scalars", "images", "histograms", "tensors"), 0)
SMALL: dict[str, Any] = {"num_envs": 4, "horizon": {"type": "fixed", "length": 15}, "depth": 2}


def events_in(folder: Path) -> EventAccumulator:
    return EventAccumulator(str(folder), size_guidance=ALL).Reload()


def steps(folder: Path) -> dict[str, list[int]]:
    """The steps of every point of every tag."""
    events = events_in(folder)
    kinds = {
        "scalars": events.Scalars,
        "images": events.Images,
        "histograms": events.Histograms,
        "tensors": events.Tensors,
    }
    return {tag: [each.step for each in read(tag)] for kind, read in kinds.items() for tag in events.Tags()[kind]}


def values(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """All scalars but those of the clock."""
    events = events_in(folder)
    tags = set(events.Tags()["scalars"]) - {"charts/SPS", "final/seconds"}
    return {tag: [(each.step, each.value) for each in events.Scalars(tag)] for tag in tags}


def hyperparameters(folder: Path) -> dict[str, Any]:
    raw = events_in(folder).summary_metadata["_hparams_/session_start_info"].plugin_data.content
    fields = HParamsPluginData.FromString(raw).session_start_info.hparams
    return {name: getattr(field, field.WhichOneof("kind")) for name, field in fields.items()}


def shown_beside(logdir: Path) -> tuple[dict[str, bool], set[str]]:
    """The columns of TensorBoard's table of runs, as its server finds them: hyper-parameters, and whether they differ
    between runs; and the numbers that can stand beside them."""
    from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
    from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
    from tensorboard.context import RequestContext
    from tensorboard.plugins.base_plugin import TBContext
    from tensorboard.plugins.hparams.backend_context import Context

    read = EventMultiplexer().AddRunsFromDirectory(str(logdir)).Reload()
    context = Context(TBContext(data_provider=MultiplexerDataProvider(read, str(logdir))))
    found = context.experiment_from_metadata(
        RequestContext(), "", True, context.hparams_metadata(RequestContext(), ""), []
    )
    return {each.name: each.differs for each in found.hparam_infos}, {each.name.tag for each in found.metric_infos}


def text(folder: Path) -> str:
    return events_in(folder).Tensors("configuration/text_summary")[0].tensor_proto.string_val[0].decode()


@pytest.fixture(scope="module")
def by_command(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board") / "run"
    run.train(configured(folder, "--search.depth=2", "--eval.every=60", "--update.step_size=3"))
    return folder


@pytest.fixture(scope="module")
def by_learn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board") / "api"
    evaluations = [EvalCallback(every=60, episodes=2, deterministic=kind) for kind in (True, False)]
    update = {"type": "mirror", "step_size": 3.0}
    PGTS("pgts/Ladder-v0", **SMALL, update=update).learn(300, callback=evaluations, tensorboard=folder)
    return folder


def test_hyper_parameters_are_what_differs_from_the_defaults_with_the_results_of_the_run_beside_them(by_command):
    found = hyperparameters(by_command)
    assert found == {
        "env": "pgts/Ladder-v0",
        "gamma": pytest.approx(0.9),
        "seed": 0,
        "depth": 2,
        "num_envs": 4,
        "horizon": "fixed",
        "horizon.length": 15,
        "policy": "softmax",
        "critic": "tabular",
        "update": "mirror",
        "update.step_size": 3,
    }
    summary = summary_in(by_command)
    last = {tag: points[-1] for tag, points in values(by_command).items() if tag.startswith("final/")}
    assert last["final/J"] == (summary.env_steps, pytest.approx(summary.J))
    assert last["final/deterministic_return"][1] == pytest.approx(summary.deterministic.episodic_return.mean)
    assert last["final/model_calls"][1] == summary.model_calls
    tags = events_in(by_command).Tags()["scalars"]
    assert shown_beside(by_command.parent) == (dict.fromkeys(found, False), set(tags))


@pytest.mark.filterwarnings("ignore:html5lib")
def test_options_that_only_one_of_several_runs_names_have_a_column_and_what_differs_comes_first(by_command, tmp_path):
    shutil.copytree(by_command, tmp_path / "logs/second")
    PGTS("pgts/Ladder-v0", **SMALL, seed=1).learn(60, tensorboard=tmp_path / "logs/first")
    columns, numbers = shown_beside(tmp_path / "logs")
    assert next(iter(columns)) == "seed"
    assert [name for name, differs in columns.items() if differs] == ["seed"]
    assert columns.keys() == hyperparameters(by_command).keys() > hyperparameters(tmp_path / "logs/first").keys()
    assert {"final/J", "final/optimality_gap", "final/model_calls", "charts/episodic_return"} < numbers


@pytest.mark.filterwarnings("ignore:html5lib")
def test_the_configuration_as_text_is_that_of_the_run_also_as_a_page(by_command, by_learn):
    from tensorboard.plugin_util import markdown_to_safe_html  # its import warns

    yaml = (by_command / "config.yaml").read_text().strip()
    assert text(by_command) == f"```\n{yaml}\n```"
    assert markdown_to_safe_html(text(by_command)).startswith("<pre><code>")
    assert "PGTS('pgts/Ladder-v0', num_envs=4" in text(by_learn)
    assert '"id": "pgts/Ladder-v0"' in text(by_learn)


def test_learn_writes_the_tags_points_and_numbers_of_the_command_line(by_command, by_learn):
    command, api = values(by_command), values(by_learn)
    only = {"deterministic_return", "sampled_return", "stationarity_gap", "certificate"}
    assert set(command) - set(api) <= {f"final/{name}" for name in only}
    assert {tag: command[tag] for tag in api} == api
    assert len(api["search/stationarity_gap"]) == 5
    others = steps(by_learn)
    for tag in ("search/gap", "search/depth_reached", "configuration/text_summary", "policy/evaluations"):
        assert others[tag] == steps(by_command)[tag], tag
    assert hyperparameters(by_learn) == hyperparameters(by_command)


def test_histograms_count_the_gap_of_each_visited_state_and_the_nodes_of_each_level(by_command):
    model = PGTS("pgts/Ladder-v0", **SMALL, update={"type": "mirror", "step_size": 3.0})
    iteration = model.iterate()
    events = events_in(by_command)
    gap = events.Histograms("search/gap")[0].histogram_value
    assert gap.num == len(iteration.gap_N) > 1
    assert gap.max == float(iteration.gap_N.max()) > 0
    assert values(by_command)["search/stationarity_gap"][0][1] == pytest.approx(gap.max)
    depth = events.Histograms("search/depth_reached")[0].histogram_value
    assert depth.num == iteration.look.nodes == values(by_command)["search/nodes"][0][1]
    counts = [count for count in depth.bucket if count]
    assert counts == [count for count in iteration.look.nodes_per_level if count]
    assert depth.max == 3  # with values of states at the leaves: one more level than the depth


def test_without_a_lookahead_there_are_no_histograms(tmp_path):
    model = PGTS("CartPole-v1", depth=0, estimator="sampled", policy="mlp", num_envs=2)
    model.learn(100, tensorboard=tmp_path / "tb")
    tags = events_in(tmp_path / "tb").Tags()
    assert tags["histograms"] == tags["images"] == []
    assert "final/J" not in tags["scalars"]


@pytest.mark.parametrize("logs", [1, 2])
def test_a_run_that_was_killed_shows_every_point_once_and_what_an_uninterrupted_one_shows(
    by_command, logs, tmp_path, monkeypatch
):
    arguments = ["--search.depth=2", "--eval.every=60", "--update.step_size=3"]
    config = configured(tmp_path / "run", *arguments)
    cut_off(config, monkeypatch, after=2, logs=logs)
    before = steps(tmp_path / "run")
    run.train(config)
    assert steps(tmp_path / "run") == steps(by_command) != before
    assert values(tmp_path / "run") == values(by_command)
    for tag, points in steps(tmp_path / "run").items():
        assert not [step for step, count in Counter(points).items() if count > 1], tag


def test_a_run_that_was_killed_while_it_wrote_its_results_shows_them_once(by_command, tmp_path, monkeypatch):
    config = configured(tmp_path / "run", "--search.depth=2", "--eval.every=60", "--update.step_size=3")
    end = Events.end

    def killed(self: Events, *arguments: Any) -> None:
        end(self, *arguments)
        self.flush()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Events, "end", killed)
        with pytest.raises(KeyboardInterrupt):
            run.train(config)
    assert "final/J" in steps(tmp_path / "run")
    run.train(config)
    assert steps(tmp_path / "run") == steps(by_command)
    assert len(steps(tmp_path / "run")["final/J"]) == 1


def test_a_training_that_is_saved_and_goes_on_by_learn_hides_what_came_after(tmp_path):
    whole, again = tmp_path / "whole", tmp_path / "again"
    PGTS("pgts/Ladder-v0", **SMALL).learn(300, tensorboard=whole)
    model = PGTS("pgts/Ladder-v0", **SMALL).learn(120, tensorboard=again)
    model.save(tmp_path / "model.pt")
    model.learn(240, tensorboard=again)  # what a killed process has left
    PGTS.load(tmp_path / "model.pt").learn(300, tensorboard=again)
    shown, expected = values(again), values(whole)
    for tag in ("search/model_calls", "losses/value", "charts/episodic_return"):
        assert shown[tag] == expected[tag]
    assert [step for step, _ in shown["final/J"]] == [120, 300]


@pytest.mark.fault("evaluation and logging")
def test_what_tensorboard_is_shown_does_not_change_a_bit(tmp_path):
    silent, shown = (PGTS("pgts/Ladder-v0", **SMALL) for _ in range(2))
    silent.learn(300)
    shown.learn(300, callback=EvalCallback(every=60, episodes=2), tensorboard=tmp_path / "tb")
    assert torch.equal(silent.policy.table(), shown.policy.table())
    assert silent.num_model_calls == shown.num_model_calls
    assert shown.board is None


def test_several_processes_write_one_board_with_the_rows_of_all(tmp_path):
    def gaps() -> list[Any]:
        model = PGTS("pgts/Ladder-v0", **SMALL)
        own = len(model.iterate().gap_N)
        model.learn(300, tensorboard=tmp_path / "two")
        return [own, spread(model.iterate())]

    found = on_ranks(2, gaps)
    own = [rows for rows, _ in found]
    assert found[0][1].nodes_L == found[1][1].nodes_L
    assert len(found[0][1].gap_N) == len(found[1][1].gap_N) > max(own) - 1
    assert len(list((tmp_path / "two").iterdir())) == 1
    assert len(steps(tmp_path / "two")["charts/SPS"]) == len(set(steps(tmp_path / "two")["charts/SPS"]))


@pytest.mark.parametrize(
    ("every", "num_steps", "total", "drawn"),
    [(60, 60, 300, 5), (60, 60, 6000, 8), (1, 64, 6400, 8), (50, 130, 10_000, 8)],
)
def test_pictures_are_at_most_eight_and_only_where_there_is_an_evaluation(every, num_steps, total, drawn):
    ends = range(num_steps, total + num_steps, num_steps)
    at = [step for step in ends if is_drawn(step, num_steps, every=every, total_steps=total)]
    assert drawn - 1 <= len(at) <= drawn
    assert all(step // every > (step - num_steps) // every for step in at)


def test_a_picture_of_a_grid_shows_values_as_colours_and_actions_as_lines():
    mdp = grid(3, traps=(4,))
    right_SA = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64).expand(9, 4)
    assert mdp.action_names[1] == "right"
    evaluation = exact.evaluate(mdp, right_SA)
    pixels = policy_pixels(mdp, evaluation.v_S, right_SA, evaluation.d_S > 0)
    side = 3 * 48
    assert pixels.shape == (side + 18, 2 * side + 18, 3)
    cells = pixels[18:, side + 18 :].reshape(3, 48, 3, 48, 3).swapaxes(1, 2)
    inked = (cells == BAR.astype(np.uint8)).all(-1)
    assert inked[:, :, :, 26:].any((2, 3)).all()  # right of the centre
    assert not inked[:, :, :, :20].any()
    colour = pixels[18 + side - 8, :side].reshape(3, 48, 3)[:, 8]
    best, worst = int(evaluation.v_S[6:].argmax()), int(evaluation.v_S[6:].argmin())
    assert colour[best].sum() > colour[worst].sum()


def test_bars_of_a_policy_without_directions_are_as_high_as_its_probabilities():
    mdp = ladder(5)
    pi_SA = torch.tensor([[1.0, 0.0], [0.75, 0.25], [0.5, 0.5], [0.25, 0.75], [0.0, 1.0]], dtype=torch.float64)
    pixels = policy_pixels(mdp, torch.zeros(5), pi_SA, torch.ones(5, dtype=torch.bool))
    policy = pixels[18 + 48 + 18 :].reshape(48, 5, 48, 3).swapaxes(0, 1)
    inked = (policy == BAR.astype(np.uint8)).all(-1)
    height_SA = np.stack([inked[:, :, 10].sum(1), inked[:, :, 34].sum(1)], 1)
    assert np.abs(height_SA - pi_SA.numpy() * 47).max() <= 2


def test_a_table_that_is_too_large_is_not_drawn_and_costs_no_evaluation(tmp_path, monkeypatch):
    monkeypatch.setattr(boards, "MOST_DRAWN", 4)
    monkeypatch.setattr(boards, "policy_pixels", lambda *arguments: pytest.fail("drawn"))
    PGTS("pgts/Ladder-v0", **SMALL).learn(60, tensorboard=tmp_path / "tb")
    assert events_in(tmp_path / "tb").Tags()["images"] == []


def test_the_pictures_in_the_events_are_those_that_are_drawn(by_learn):
    [first, *_] = events_in(by_learn).Images("policy/evaluations")
    image = np.asarray(Image.open(io.BytesIO(first.encoded_image_string)))
    side = Drawing(ladder(5), side=384, cell=48).columns * 48
    assert image.shape[:2] == (2 * (48 + 18), side)


@pytest.mark.parametrize(
    ("given", "message"),
    [(3, r"^tensorboard is 3; it must be the path of a folder$"), ("", "^tensorboard is ''; it must be the path")],
)
def test_a_folder_that_is_none_is_refused_before_anything_is_trained(given, message):
    model = PGTS("pgts/Ladder-v0", **SMALL)
    with pytest.raises(PgtsError, match=message):
        model.learn(60, tensorboard=given)
    assert model.num_env_steps == 0


@pytest.mark.fault("file of the user under the name of an output")
def test_a_file_or_the_events_of_another_training_are_left_alone(by_learn, tmp_path):
    (tmp_path / "notes").write_text("mine")
    model = PGTS("pgts/Ladder-v0", **SMALL)
    with pytest.raises(PgtsError, match=r"notes', which is a file; it must be a folder or not exist$"):
        model.learn(60, tensorboard=tmp_path / "notes")
    shutil.copytree(by_learn, tmp_path / "other")
    before = sorted(path.name for path in (tmp_path / "other").iterdir())
    with pytest.raises(PgtsError, match=r"other holds the events of another training \(events\.out.*choose another"):
        model.learn(60, tensorboard=tmp_path / "other")
    assert sorted(path.name for path in (tmp_path / "other").iterdir()) == before
    assert (tmp_path / "notes").read_text() == "mine"
    assert model.num_env_steps == 0


@pytest.mark.fault("folder of the user as an output")
def test_a_folder_with_other_things_only_is_left_alone(tmp_path):
    model = PGTS("pgts/Ladder-v0", **SMALL)
    (tmp_path / "thesis.tex").write_text("mine")
    refusal = (
        rf"^tensorboard {tmp_path} holds files, but no events \(thesis\.tex\); choose another folder, as {tmp_path}/"
    )
    with pytest.raises(PgtsError, match=refusal):
        model.learn(60, tensorboard=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert model.num_env_steps == 0
    (tmp_path / "empty").mkdir()
    model.learn(60, tensorboard=tmp_path / "empty")
    (tmp_path / "empty/thesis.tex").write_text("mine")
    model.learn(120, tensorboard=tmp_path / "empty")  # which is ours by now
    assert values(tmp_path / "empty")["final/env_steps"][-1] == (120, 120)


def test_a_line_of_numbers_is_one_event(tmp_path, monkeypatch):
    written: list[Any] = []
    with Events(tmp_path) as events:
        writer = events._writer._get_file_writer()
        monkeypatch.setattr(writer, "add_summary", lambda summary, step: written.append(summary))
        events.scalars(1, {"a": 1.0, "b": None, "c": 3.0})
    assert [[value.tag for value in summary.value] for summary in written] == [["a", "b", "c"]]
