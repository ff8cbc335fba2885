"""Episodes that are watched: they are those of `predict`, with the values of `lookahead`; training does not notice."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from PIL import Image

from pgts_torch import PGTS
from pgts_torch.agent import recording, showing
from pgts_torch.agent.recording import Seen
from pgts_torch.agent.watching import Choice, Moment, NoPicture
from pgts_torch.errors import PgtsError
from tests.agent.kinds import Corridor
from tests.agent.masked import LEGAL_SA, ByMethod
from tests.support import same_values
from tests.test_documents import PAGES, blocks

SHORT: dict[str, Any] = {"num_envs": 2, "horizon": {"type": "fixed", "length": 6}}


class Drawn(gymnasium.Env):
    """A walk on seven cells with slippery steps, drawn as a row of pixels; it can be restored.

    Args:
        shape: of what is rendered.
        renders: whether it knows any render mode.
    """

    metadata = {"render_modes": ["rgb_array", "ansi"], "render_fps": 20}  # noqa: RUF012
    observation_space, action_space = spaces.Box(0, 6, (1,), np.float32), spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None, shape: tuple[int, ...] = (4, 7, 3)) -> None:
        self.render_mode, self.shape = render_mode, shape

    def _seen(self) -> np.ndarray:
        return np.array([self.cell], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = int(self.np_random.integers(2, 5))
        return self._seen(), {}

    def step(self, action):
        slips = self.np_random.random() < 0.25
        self.cell += 1 if bool(action) != slips else -1
        return self._seen(), float(self.cell == 6), self.cell in (0, 6), False, {}

    def render(self):
        if self.render_mode == "ansi":
            return "".join("\x1b[41mx\x1b[0m" if at == self.cell else "." for at in range(7)) + "\n"
        picture = np.zeros(self.shape, np.uint8)
        picture[:, self.cell] = 255
        return picture

    def get_state(self):
        return (self.cell,)

    def set_state(self, state):
        (self.cell,) = state


gymnasium.register("tests/Drawn-v0", entry_point=Drawn, max_episode_steps=30)


def moments(model: PGTS, episodes: int = 1, **options: Any) -> list[Moment]:
    watching = model.watching(**options)
    found = list(watching(episodes))
    watching.close()
    return found


def table() -> PGTS:
    return PGTS("CliffWalking-v1", depth=3, gamma=0.95, **SHORT).learn(100)


MODELS: dict[str, Any] = {
    "a table": table,
    "dynamics": lambda: PGTS("CartPole-v1", depth=2, **SHORT).learn(20),
    "a simulator": lambda: PGTS("tests/Drawn-v0", policy="mlp", depth=2, **SHORT).learn(20),
    "a simulator without chance": lambda: PGTS(
        lambda: TimeLimit(Corridor("a vector"), 10), policy="mlp", depth=2, **SHORT
    ).learn(20),
    "an ensemble": lambda: PGTS(
        lambda: TimeLimit(Corridor("a vector"), 10),
        depth=1,
        horizon={"type": "steps", "length": 10, "first": 60},
        replay={"updates_per_step": 0.05, "starts": 4, "length": 4},
        model={"type": "ensemble", "members": 2, "hidden": [8], "first_updates": 3, "updates_per_step": 0.1},
    ).learn(60),
    "counts": lambda: PGTS(
        lambda: TimeLimit(Corridor(), 10), depth=4, model="counts", horizon={"type": "steps", "length": 20}
    ).learn(20),
    "no model": lambda: PGTS("CartPole-v1", depth=0, estimator="sampled", **SHORT).learn(20),
    "a gaussian policy": lambda: PGTS("Pendulum-v1", policy="gaussian", actions=4, depth=1, **SHORT).learn(20),
}


@pytest.mark.parametrize("kind", MODELS)
def test_a_watched_episode_is_the_one_that_predict_makes(kind):
    model = MODELS[kind]()
    env = model.source.make_one()
    found = moments(model, episodes=2, seed=5, steps=8)
    for k in range(2):
        episode = [moment for moment in found if moment.episode == k]
        observation, _ = env.reset(seed=5 + k)
        total = 0.0
        for step, moment in enumerate(episode[:-1]):
            assert same_values(np.asarray(moment.observation).tolist(), np.asarray(observation).tolist())
            assert (moment.step, moment.seed) == (step, 5 + k)
            assert moment.total == pytest.approx(total)
            observation, reward, terminated, truncated, _ = env.step(model.predict(observation))
            total += float(reward)
        assert episode[-1].ended
        assert terminated or truncated or len(episode) == 9
        assert episode[-1].total == pytest.approx(total)


def test_beside_a_state_are_the_policy_and_the_lookahead_there():
    model = table()
    for depth in (None, 0, 1):
        for moment in moments(model, depth=depth, steps=4)[:-1]:
            state = torch.tensor([int(moment.observation)])
            look = model.lookahead(state, depth=3 if depth is None else depth)
            assert [choice.value for choice in moment.choices] == look.q_BA[0].tolist()
            assert [choice.prob for choice in moment.choices] == model.policy_table()[state][0].tolist()
            assert moment.depth == (3 if depth is None else depth)
    deep, flat = (moments(model, depth=depth, steps=1)[0].choices for depth in (3, 0))
    assert deep != flat


@pytest.mark.parametrize("kind", ["dynamics", "a simulator without chance"])
def test_values_are_those_of_the_states_that_the_training_itself_would_read(kind):
    model = MODELS[kind]()
    first = moments(model, seed=4, steps=1)[0]
    world = model.world
    observation, _ = world.env.reset(seed=[4] * world.env.num_envs)
    states = world.numbers(world.read(observation, world.encode(observation)))
    wanted = model.lookahead(states).q_BA[0]
    np.testing.assert_allclose([choice.value for choice in first.choices], wanted, rtol=1e-6)


def test_values_of_drawn_actions_come_with_the_best_first():
    first = moments(MODELS["a gaussian policy"](), steps=1)[0]
    taken, *drawn = first.choices
    assert taken.is_taken
    assert taken.value is taken.prob is None
    assert len(drawn) == 4
    assert [choice.value for choice in drawn] == sorted((choice.value for choice in drawn), reverse=True)
    assert sum(choice.prob for choice in drawn) == pytest.approx(1)
    assert "mean" in first.note


def test_actions_that_are_not_legal_are_said_to_be_so():
    model = PGTS(lambda: TimeLimit(ByMethod(vector=True), 20), policy="mlp", depth=2, **SHORT)
    model.iterate()
    for moment in moments(model, episodes=4, deterministic=False)[:-1]:
        if moment.choices:
            legal = LEGAL_SA[int(np.argmax(moment.observation))]
            assert [choice.value > -np.inf for choice in moment.choices] == legal.astype(bool).tolist()
            assert ("not legal" in showing.text(moment, coloured=False)) == (not legal.all())


@pytest.mark.parametrize("kind", [kind for kind in MODELS if kind not in ("counts",)])
def test_training_does_not_notice_that_it_is_watched(kind):
    watched, other = MODELS[kind](), MODELS[kind]()
    before = torch.get_rng_state()
    moments(watched, steps=3)
    assert torch.equal(before, torch.get_rng_state())
    for model in (watched, other):
        model.iterate()
    assert same_values(watched.state_dict()["policy"], other.state_dict()["policy"])
    assert same_values(watched.state_dict()["critic"], other.state_dict()["critic"])
    assert watched.num_model_calls == other.num_model_calls


def test_sampled_actions_are_sampled():
    model = PGTS("FrozenLake-v1", depth=1, gamma=0.99, **SHORT)
    taken = [
        next(a for a, choice in enumerate(moment.choices) if choice.is_taken)
        for moment in moments(model, episodes=20, deterministic=False, steps=1)
        if moment.choices
    ]
    assert len(set(taken)) > 1


def test_a_model_with_images_as_vectors_can_be_watched():
    model = PGTS(
        "images/Catch-v0",
        depth=1,
        policy="mlp",
        model={"type": "latent", "size": 4, "hidden": [8], "first_updates": 3, "updates_per_step": 0.1, "unroll": 2},
        horizon={"type": "steps", "length": 10, "first": 60},
        replay={"updates_per_step": 0.05, "starts": 4, "length": 4},
    )
    model.iterate()
    found = moments(model, mode="rgb_array")
    for moment in found:
        assert (moment.picture[..., :1] == moment.observation).all()
    assert len(found) == 10


# Files


def frames(path: Path) -> list[np.ndarray]:
    with Image.open(path) as film:
        return [np.asarray(film.convert("RGB")) for k in range(film.n_frames) if film.seek(k) is None]


def test_a_gif_shows_each_state_of_the_episode_beside_its_values(tmp_path):
    model = MODELS["a simulator"]()
    path = tmp_path / "film.gif"
    [seen] = model.record(path, seed=3)
    found = moments(model, seed=3)
    shown = frames(path)
    assert seen == Seen(3, len(found) - 1, found[-1].total, found[-1].ended)
    cells = [int(moment.observation[0]) for moment in found]
    side = (shown[0].shape[1] - 440) // 7  # the picture is seven pixels wide, enlarged
    where = [int(frame[frame.shape[0] // 2, side // 2 : 7 * side : side, 0].argmax()) for frame in shown]
    assert where == cells
    with Image.open(path) as film:
        assert film.info["duration"] == 50


def test_an_mp4_has_as_many_pictures_a_second_as_asked_for(tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "film.mp4"
    [seen] = MODELS["a simulator"]().record(path, seed=3, fps=5)
    with imageio.get_reader(path) as film:
        assert film.get_meta_data()["fps"] == 5
        assert film.count_frames() == seen.length + 5  # the last one stays for a second


def test_text_has_what_the_environment_renders_as_text_and_at_most_80_columns(tmp_path):
    model = MODELS["a simulator"]()
    path = tmp_path / "film.txt"
    model.record(path, seed=3)
    text = path.read_text()
    assert text.startswith("episode 0, step 0, return 0\n")
    assert re.search(r"^\.*\[x\]\.*$", text, re.MULTILINE)
    assert "T^2 Q" in text
    assert max(map(len, text.splitlines())) <= 80
    assert "\x1b" in showing.text(moments(model, mode="ansi", steps=1)[0], coloured=True)


def test_text_has_the_observation_where_nothing_is_rendered(tmp_path):
    path = tmp_path / "film.txt"
    MODELS["a gaussian policy"]().record(path, steps=2)
    text = path.read_text()
    assert text.count("observation  ") == 3
    assert text.count("policy  mean") == 2
    assert max(map(len, text.splitlines())) <= 80


def moment(choices: Sequence[Choice], observation: Any = 0, picture: Any = None) -> Moment:
    return Moment(0, 0, 3, 1e6, observation, choices, 2, "", None, picture)


def test_of_many_actions_the_best_and_the_one_taken_are_shown():
    choices = [Choice(f"action {a}", 0.01, float(a % 50), a == 0) for a in range(100)]
    shown = showing.text(moment(choices), coloured=False)
    assert "> action 0 " in shown
    assert "action 49" in shown
    assert "action 99" in shown
    assert "action 10 " not in shown
    assert "and 88 more" in shown


@pytest.mark.parametrize("scale", [1e-3, 1e6])
def test_long_names_large_numbers_and_large_observations_fit(scale):
    choices = [Choice("a name that nobody would give to an action " * 3, 1.0, -scale / 3, True)]
    observation = {"near": np.full(40, scale / 7), "image": np.zeros((9, 9, 3), np.uint8), "at": (1, "go there")}
    shown = showing.text(moment(choices, observation), coloured=False)
    assert max(map(len, shown.splitlines())) <= 80
    assert "uint8 (9, 9, 3)" in shown
    assert "'go there'" in shown
    for size in [(2000, 9), (9, 2000), (1, 1), (3, 9)]:
        picture = showing.picture(moment(choices, picture=np.zeros((*size, 3), np.uint8)), "name " * 50, 1)
        assert picture.height <= 640
        assert picture.width <= 640 + 442
        assert picture.width % 2 == picture.height % 2 == 0


# What cannot be drawn


def test_an_environment_that_cannot_be_drawn_is_refused_in_a_sentence_and_leaves_nothing(tmp_path):
    corridor = PGTS(lambda: TimeLimit(Corridor("a vector"), 10), depth=1, **SHORT)
    with pytest.raises(NoPicture, match="cannot be drawn: it has no render modes; a picture needs rgb_array"):
        corridor.record(tmp_path / "film.gif")
    function = PGTS(lambda: TimeLimit(Drawn(), 10), policy="mlp", depth=1, **SHORT)
    with pytest.raises(NoPicture, match="it is made with render_mode None; a picture needs 'rgb_array'"):
        function.record(tmp_path / "film.gif")
    flat = PGTS(lambda: TimeLimit(Drawn("rgb_array", (4, 7)), 10), policy="mlp", depth=1, **SHORT)
    with pytest.raises(NoPicture, match=r"it renders uint8 of the shape \(4, 7\)"):
        flat.record(tmp_path / "film.gif")
    assert not list(tmp_path.iterdir())
    PGTS(lambda: TimeLimit(Drawn("rgb_array"), 10), policy="mlp", depth=1, **SHORT).record(tmp_path / "film.gif")
    assert (tmp_path / "film.gif").read_bytes()[:4] == b"GIF8"


class Broken(Drawn):
    """It cannot render."""

    def render(self):
        raise ZeroDivisionError("no pixels")


def test_an_error_of_render_names_the_environment(tmp_path):
    model = PGTS(lambda: TimeLimit(Broken("rgb_array"), 10), policy="mlp", depth=1, **SHORT)
    with pytest.raises(PgtsError, match=r"failed in render: ZeroDivisionError: no pixels"):
        model.record(tmp_path / "film.gif")


class Fickle(Drawn):
    """Two instances of it do not do the same."""

    made = 0

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        Fickle.made += 1
        self.number = Fickle.made

    def _seen(self):
        return np.array([self.cell + self.number / 1000], np.float32)


def test_an_environment_that_does_not_repeat_itself_is_not_drawn(tmp_path):
    model = PGTS(
        lambda: TimeLimit(Fickle("rgb_array"), 10), policy="mlp", depth=0, estimator="sampled", update="ppo", **SHORT
    )
    with pytest.raises(PgtsError, match=r"does not do the same twice, with the same seed .* \(step 0 of episode 0\)"):
        model.record(tmp_path / "film.gif")
    assert not list(tmp_path.iterdir())


class Shared(Drawn):
    """Its chance is that of the generator of the whole process."""

    def step(self, action):
        self.cell += 1 if np.random.random() < 0.5 else -1  # noqa: NPY002
        return self._seen(), 0.0, self.cell in (0, 6), False, {}


def test_chance_of_the_whole_process_is_the_same_for_what_acts_and_what_is_drawn(tmp_path):
    make = {"policy": "mlp", "depth": 0, "estimator": "sampled", "update": "ppo"}
    model = PGTS(lambda: TimeLimit(Shared("rgb_array"), 30), **make, **SHORT)
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    first, again = (model.record(tmp_path / "film.gif", episodes=3) for _ in range(2))
    assert first == again
    assert len({seen.length for seen in model.record(tmp_path / "film.gif", episodes=12)}) > 1
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "episodes is 0; it must be"),
        ({"seed": -1}, "seed is -1; it must be"),
        ({"steps": 0}, "steps is 0; it must be"),
        ({"depth": -1}, "depth is -1; it must be"),
        ({"fps": 0}, "fps is 0; it must be above 0"),
        ({"path": "film.avi"}, "film.avi ends in '.avi'; a recording is a .gif, an .mp4 or, as text, a .txt"),
        ({"path": "mine.txt"}, "mine.txt exists and is not a .txt file"),
    ],
)
def test_wrong_arguments_are_named(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.txt").write_text("a letter")
    with pytest.raises(PgtsError, match=re.escape(message)):
        table().record(**{"path": "film.txt"} | arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_depth_without_a_lookahead_is_refused():
    with pytest.raises(PgtsError, match="depth is 3; with sampled advantages there is no lookahead"):
        MODELS["no model"]().watching(depth=3)


def test_without_what_writes_videos_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(recording, "find_spec", lambda package: None)
    with pytest.raises(PgtsError, match=r"an mp4 needs imageio with ffmpeg: pip install 'pgts_torch\[video\]'"):
        table().record(tmp_path / "film.mp4")


@pytest.mark.parametrize("kind", ["a table", "a simulator without chance", "a gaussian policy"])
def test_policies_are_evaluated_by_stable_baselines3_as_its_own_are(kind):
    evaluation = pytest.importorskip("stable_baselines3.common.evaluation")
    monitor = pytest.importorskip("stable_baselines3.common.monitor")
    model = MODELS[kind]()
    env, other = (TimeLimit(model.source.make_one(), 20) for _ in range(2))
    env.reset(seed=8)  # the generator goes on from here, when it is reset without a seed
    other.reset(seed=8)
    returns, lengths = evaluation.evaluate_policy(
        model, monitor.Monitor(env), n_eval_episodes=1, return_episode_rewards=True
    )
    observation, _ = other.reset()
    total, length, over = 0.0, 0, False
    while not over:
        observation, reward, terminated, truncated, _ = other.step(model.predict(observation))
        total, length, over = total + float(reward), length + 1, terminated or truncated
    assert lengths == [length]
    np.testing.assert_allclose(returns, [total], rtol=1e-5)
    actions, state = model.predict(np.asarray(observation)[None], state="kept", episode_start=np.array([True]))
    assert state == "kept"
    assert len(actions) == 1


def test_the_page_evaluates_a_model_by_stable_baselines3_as_printed():
    pytest.importorskip("stable_baselines3")
    text = PAGES["docs/start/after_training.md"].read_text(encoding="utf-8")
    [script] = [block.text for block in blocks(text) if "import evaluate_policy" in block.text]
    names: dict[str, Any] = {"model": MODELS["dynamics"]()}
    exec(script, names)
    assert 5 < names["mean"] <= 500
