"""`pgts init` writes a configuration that trains as it is, for environments of every kind."""

import contextlib
import io
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from pgts_torch.agent.pgts import PGTS
from pgts_torch.cli.main import main
from pgts_torch.config import Config, load
from pgts_torch.experiment import commented, initial, run
from pgts_torch.models.environments import EnvSource
from pgts_torch.options.schema import schema_of

pytestmark = [
    pytest.mark.usefixtures("unchecked_shapes", "here"),
    pytest.mark.filterwarnings("ignore:.*has no get_state", "ignore:.*has random steps", "ignore:.*is out of date"),
]

BRIEF = ["--total_steps=1", "--eval.episodes=1", "--run.tensorboard=false", "--run.dir=run"]

OWN = '''
import gymnasium
import numpy as np


class Walk(gymnasium.Env):
    """Eight steps to the right pay a million."""

    observation_space = gymnasium.spaces.Box(0, 10, (1,))
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, goal=8, pays=1e6):
        self.goal, self.pays = goal, pays

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = 0
        return self.shown(), self.info()

    def step(self, action):
        self.position = max(0, self.position + (1 if action else -1))
        done = self.position == self.goal
        return self.shown(), self.pays * done, done, False, self.info()

    def shown(self):
        return np.array([self.position], dtype=np.float32)

    def info(self):
        return {}


class Restored(Walk):
    def get_state(self):
        return self.position

    def set_state(self, state):
        self.position = state


class Hidden(Walk):
    """Where it is stands in a generator, which nothing can restore."""

    def reset(self, **given):
        self.steps = self.walk()
        next(self.steps)
        return super().reset(**given)

    def step(self, action):
        self.position = self.steps.send(action)
        done = self.position == self.goal
        return self.shown(), self.pays * done, done, False, {}

    def walk(self):
        position = 0
        while True:
            position = max(0, position + (1 if (yield position) else -1))


class Masked(Restored):
    def action_masks(self):
        return np.array([self.position > 0, True])


gymnasium.register("Walk-v0", Walk, max_episode_steps=30, kwargs={"pays": 1e-3})
'''


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The module of environments of one's own, where Python finds it."""
    folder = tmp_path_factory.mktemp("walks")
    (folder / "walks.py").write_text(OWN)
    sys.path.append(str(folder))
    yield
    sys.path.remove(str(folder))
    sys.modules.pop("walks", None)
    gymnasium.registry.pop("Walk-v0", None)


@pytest.fixture
def here(walks: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder, and small trainings: rollouts of at most 20 steps, and few depths."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(initial, "LONGEST_EPISODE", 20)
    monkeypatch.setattr(initial, "TABLE_DEPTHS", (1, 2))
    monkeypatch.setattr(initial, "OTHER_DEPTHS", (0, 1))
    return tmp_path


def made(env: str, *more: str) -> tuple[Config, dict[str, Any]]:
    """The configuration that is written for an environment, and what is said of it."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(["init", env, "-o", "it.yaml", "--json", *more]) == 0
    return load("it.yaml"), json.loads(out.getvalue())


@pytest.mark.parametrize(
    ("env", "model", "parts"),
    [
        ("FrozenLake-v1", "table of 16 states", ("softmax", "tabular", "mirror")),
        ("pgts/Ladder-v0", "table of 5 states", ("softmax", "tabular", "mirror")),
        ("CartPole-v1", "dynamics in torch", ("mlp", "network", "cmpo")),
        ("Blackjack-v1", "simulator", ("mlp", "network", "cmpo")),
        ("walks:Walk-v0", "simulator", ("mlp", "network", "cmpo")),
        ("walks:Restored", "simulator", ("mlp", "network", "cmpo")),
        ("walks:Masked", "simulator", ("mlp", "network", "cmpo")),
        ("images/Catch-v0", "simulator", ("cnn", "network", "cmpo")),
        pytest.param("MiniGrid-Empty-5x5-v0", "simulator", ("cnn", "network", "cmpo"), marks=pytest.mark.long),
        pytest.param("Pendulum-v1", "dynamics in torch", ("gaussian", "network", "mpo"), marks=pytest.mark.long),
        pytest.param("walks:Hidden", "learned from the steps", ("mlp", "network", "cmpo"), marks=pytest.mark.long),
        pytest.param("Taxi-v4", "table of 500 states", ("softmax", "tabular", "mirror"), marks=pytest.mark.long),
    ],
)
def test_what_is_written_trains_as_it_is(env, model, parts, here):
    if env.startswith("MiniGrid"):
        pytest.importorskip("minigrid")
    config, said = made(env)
    assert model in said["model"]
    if env == "walks:Masked":  # the legal actions beside it are no part of what it shows
        assert "tuples" not in said["shows"]
    assert (config.policy.type, config.critic.type, config.update.type) == parts
    assert ("learned" in model) == bool(said["why"])
    assert re.match(r"an iteration takes (about|up to) [\d,.]+ (model calls and|s)", said["price"])
    summary = run.train(load("it.yaml", BRIEF))
    assert summary.env_steps >= 1
    assert summary.parts.startswith({"softmax": "Softmax", "gaussian": "Gaussian"}.get(parts[0], "Network"))


def test_what_is_written_is_the_training_that_the_environment_chooses(here):
    config, _ = made("pgts/Ladder-v0", "--kwargs", '{"n": 6}')
    assert config.env.kwargs == {"n": 6}
    written = run.build(config)
    chosen = PGTS("pgts/Ladder-v0", env_kwargs={"n": 6}, depth=2, horizon={"type": "fixed", "length": 20})
    assert written.options.model_copy(update={"env": chosen.options.env}) == chosen.options
    for model in (written, chosen):
        model.iterate()
    assert torch.equal(written.policy.table(), chosen.policy.table())


def test_every_option_that_applies_stands_there_with_its_meaning_and_range_and_what_is_behind_a_hash_is_the_default(
    here,
):
    config, _ = made("CartPole-v1")
    text = Path("it.yaml").read_text()
    uncovered = re.sub(r"^#(\s*\w+:)", r"\1", text, flags=re.MULTILINE)
    assert uncovered != text
    Path("all.yaml").write_text(uncovered)
    assert load("all.yaml") == config
    options = {each.key: each for each in schema_of(Config).options()}
    depth = commented._sentence(options["search.depth"].meaning)
    assert f"  # {depth} (a whole number >= 0 or adaptive)\n  depth: " in text
    assert "# Step size of Adam (a number > 0, or linear(FROM, TO, STEPS)" in text
    assert len(re.findall(r"^\s*# .*\)$\n#?\s*\w+:", text, re.MULTILINE)) > 50
    Path("changed.yaml").write_text(uncovered.replace("keep_best: false", "keep_best: true"))
    assert load("changed.yaml").eval.keep_best


def test_a_file_is_replaced_only_where_that_is_asked_for(here, capsys):
    assert main(["init", "pgts/Ladder-v0"]) == 0
    assert "ladder.yaml is written; pgts train --config ladder.yaml" in capsys.readouterr().out
    Path("ladder.yaml").write_text("mine")
    assert main(["init", "pgts/Ladder-v0"]) == 2
    assert "error: ladder.yaml exists: give --overwrite to replace it, or another name by -o" in capsys.readouterr().err
    assert Path("ladder.yaml").read_text() == "mine"
    assert main(["init", "pgts/Ladder-v0", "--overwrite"]) == 0
    assert load("ladder.yaml").env.id == "pgts/Ladder-v0"
    assert all(len(line) <= 79 for line in capsys.readouterr().out.splitlines())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["NoSuch-v0"], "NoSuch-v0"),
        (["walks:NoSuch"], "walks:NoSuch"),
        (["nowhere:Walk"], "No module named 'nowhere'"),
        (["pgts/Ladder-v0", "-o", "."], ". is a folder; -o must name a file"),
        (["pgts/Ladder-v0", "-o", "no/it.yaml"], "no/it.yaml cannot be written: no is not a folder"),
        (["pgts/Ladder-v0", "--kwargs", "3"], "'3' is not a JSON object"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(arguments, message, here, capsys):
    before = {path.name for path in here.iterdir()} | {"__pycache__"}
    assert main(["init", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert {path.name for path in here.iterdir()} <= before


def test_the_deepest_lookahead_that_is_not_too_slow_is_taken(here, monkeypatch):
    tried: list[int] = []

    class Fake:
        tables, branching, iteration, roots = False, 3, 1.0, 10

        def __init__(self, depth: int) -> None:
            self.depth, self.seconds = depth, 50.0 * 3**depth

        def again(self, *, depth: int) -> "Fake":
            tried.append(depth)
            return Fake(depth)

    monkeypatch.setattr(initial, "OTHER_DEPTHS", (0, 1, 2, 4))
    assert initial._deepest(Fake(1)).depth == 2  # type: ignore[arg-type]  # 450 s; depth 4 would take over an hour
    assert tried == [0, 2]
    monkeypatch.setattr(initial, "PATIENCE", 100.0)
    assert initial._deepest(Fake(1)).depth == 0  # type: ignore[arg-type]


def test_a_slow_simulator_gets_a_small_iteration_and_is_not_tried_at_the_usual_size(here, monkeypatch):
    monkeypatch.setattr(initial, "SLOW", 0.0)
    monkeypatch.setattr(initial, "_deepest", lambda tried: pytest.fail("tried"))
    config, said = made("walks:Restored")
    assert (config.rollout.num_envs, config.search.max_roots, config.search.depth) == (4, 50, 0)
    assert config.rollout.horizon.length == 20
    assert "simulator" in said["model"]


def test_a_class_is_named_by_its_module_wherever_an_id_is(here):
    env = EnvSource.of("walks:Restored", kwargs={"goal": 3}).make_one()
    assert isinstance(env, gymnasium.Env)
    assert env.unwrapped.goal == 3
    model = PGTS("walks:Restored", depth=1, num_envs=2, horizon={"type": "fixed", "length": 10})
    model.learn(20)
    model.save("model.pt")
    with pytest.raises(Exception, match="which may do anything: if you trust the file"):
        PGTS.load("model.pt")
    again = PGTS.load("model.pt", trust_imports=True)
    assert again.num_env_steps == model.num_env_steps
    observation = np.zeros(1, dtype=np.float32)
    assert again.predict(observation) == model.predict(observation)


def test_short_episodes_are_foreseen_as_short_ones(here):
    episodes = PGTS(
        "walks:Restored", depth=0, num_envs=4, env_kwargs={"goal": 1}, horizon={"type": "fixed", "length": 100}
    )
    made = episodes.iterate()
    foreseen = initial._usual_steps(made.experience, made.num_steps, 16 * 200)
    assert foreseen == 16 * made.num_steps / 4 < 16 * 20
    cut_off = PGTS(
        "walks:Restored", depth=0, num_envs=4, env_kwargs={"goal": 999}, horizon={"type": "fixed", "length": 100}
    )
    made = cut_off.iterate()
    assert initial._usual_steps(made.experience, made.num_steps, 16 * 200) == 16 * 200


def test_an_iteration_of_the_usual_size_is_foreseen_from_a_small_one(here, monkeypatch):
    general = {"name": "it", "seed": 0, "env": {"id": "walks:Restored"}}
    small = general | {"rollout": {"num_envs": 2, "horizon": {"type": "fixed", "length": 20}}}
    few = initial._Tried.of(small | {"search": {"max_roots": 4}}, 0)
    monkeypatch.setattr(initial, "FIRST", initial.FIRST | {"num_envs": 2, "length": 20})
    foreseen = initial._Tried.of(small | {"search": {"max_roots": 4}}, 0, 4000)
    assert few.roots <= 4 < foreseen.roots < 400  # the walk has nine states, in which its steps meet again
    assert foreseen.iteration > foreseen.looking > 0
    assert foreseen.seconds >= foreseen.iteration * Config().total_steps / 4000


def test_a_long_lookahead_starts_from_few_states_in_what_is_tried_at_the_usual_size_too(here, monkeypatch):
    tried, of = [], initial._Tried.of

    def noted(data: dict[str, Any], depth: int, steps: int | None = None) -> Any:
        tried.append((data["rollout"].get("num_envs", 16), data["search"]["max_roots"], steps))
        return of(data, depth, steps)

    monkeypatch.setattr(initial, "LONG", 1e-9)
    monkeypatch.setattr(initial._Tried, "of", noted)
    config, _ = made("walks:Walk-v0")
    assert config.search.max_roots == 20  # the fewest, to one digit
    assert {(4, 50, 320), (16, 20, None)} == set(tried)
