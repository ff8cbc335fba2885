"""What the texts and the pictures show."""

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from pgts_torch.envs import TabularEnv, TabularVectorEnv
from pgts_torch.envs.drawing import AGENT, GOAL, LINE, MAX_SIDE, PAPER, SHADE, START, TRAP, Drawing
from pgts_torch.errors import PgtsError
from pgts_torch.tabular import TabularMDP, deep_sea, grid, ladder, random_mdp, tightrope


def rendered(mdp, actions, mode):
    env = TabularEnv(mdp, render_mode=mode)
    env.reset(seed=0)
    for action in actions:
        env.step(action)
    return env.render()


def test_the_ladder_as_text():
    assert rendered(ladder(n=5), [], "ansi") == "step 0\n[S] .  .  .  +\n"
    assert rendered(ladder(n=5), [1, 1], "ansi") == "step 2, action right\n S  . [.] .  +\n"


def test_a_fall_from_the_tightrope_as_text():
    assert rendered(tightrope(), [1, 0], "ansi") == "step 2, action left\n S  .  + [-]\n"


def test_the_grid_as_text():
    assert (
        rendered(grid(size=3, traps=(4,), slip=0.0), [1], "ansi")
        == "step 1, action right\n S [.] .\n .  -  .\n .  .  +\n"
    )


def test_states_that_no_episode_enters_are_left_out_of_the_text():
    assert rendered(deep_sea(n=3), [1], "ansi") == "step 1, action right\n S\n . [.]\n .  .  +\n"


def test_a_terminal_state_is_entered():
    mdp = TabularMDP.from_transitions([[[(1.0, 1, 1.0, True)]], [[(1.0, 1, 0.0, True)]]], 0.9, start=0)
    assert rendered(mdp, [0], "ansi") == "step 1, action 0\n + [.]\n"


def test_a_start_everywhere_is_not_marked():
    assert Drawing(ladder(n=3, start=None)).text(1, last_action=None, num_steps=0) == "step 0\n . [.] +\n"


def test_a_long_chain_is_wrapped():
    assert Drawing(ladder(n=32)).text(0, last_action=None, num_steps=0).count("\n") == 2
    lines = Drawing(ladder(n=40)).text(8, last_action=None, num_steps=0).splitlines()[1:]
    assert [len(line) for line in lines] == [20] * 5 + [14]  # seven to a line, five in the last
    assert lines[1].startswith(" . [.] .")


def in_rows(mdp, rows):
    return TabularMDP(mdp.outcomes, mdp.start_S, shape=(rows, mdp.num_states // rows))


def cell_colour(image, mdp, state, offset):
    """The colour at (offset, offset) pixels from the corner of a state's cell."""
    row, column = divmod(state, mdp.shape[1])
    cell = image.shape[0] // mdp.shape[0]
    return image[row * cell + offset, column * cell + offset]


def test_the_picture_of_a_grid():
    mdp = grid(size=4, traps=(5, 6))
    image = rendered(mdp, [], "rgb_array")
    assert image.shape == (256, 256, 3)
    assert image.dtype == np.uint8
    expected = {(0, 0): LINE, (0, 3): START, (0, 32): AGENT, (3, 32): PAPER, (5, 32): TRAP, (15, 32): GOAL}
    for (state, offset), colour in expected.items():
        assert (cell_colour(image, mdp, state, offset) == colour).all(), (state, offset)


def test_states_that_no_episode_enters_are_shaded():
    mdp = deep_sea(n=4)
    image = rendered(mdp, [], "rgb_array")
    assert (cell_colour(image, mdp, 3, 32) == SHADE).all()
    assert (cell_colour(image, mdp, 15, 32) == GOAL).all()


def test_a_greater_reward_has_a_deeper_green():
    mdp = random_mdp(seed=0)
    image = Drawing(mdp).picture(0)
    best = mdp.outcomes.reward_NA.amax(-1)[1:]
    red_channel = [int(cell_colour(image, mdp, s, 25)[0]) for s in range(1, 10)]
    assert np.argsort(best.numpy()).tolist() == np.argsort(red_channel)[::-1].tolist()


def test_the_agent_is_the_only_thing_that_moves():
    drawing = Drawing(ladder(n=5))
    before, after = drawing.picture(1), drawing.picture(2)
    changed = np.unique(np.argwhere((before != after).any(-1))[:, 1] // 64)
    assert changed.tolist() == [1, 2]
    assert (drawing.picture(1) == before).all()


@pytest.mark.parametrize(
    ("mdp", "shape"),
    [
        (ladder(n=1), (64, 64)),
        (ladder(n=8), (64, 512)),
        (ladder(n=100), (510, 510)),
        (grid(size=32), (512, 512)),
        (ladder(n=1000), (512, 512)),
        (in_rows(ladder(n=1024), 2), (2, 512)),
    ],
)
def test_pictures_fit_into_512_pixels_and_show_the_agent(mdp, shape):
    image = Drawing(mdp).picture(0)
    assert image.shape == (*shape, 3)
    assert max(shape) <= MAX_SIDE
    assert (image == AGENT).all(-1).any()


def test_a_picture_of_too_many_cells_is_refused():
    with pytest.raises(PgtsError, match="a picture has at most 512 rows and columns; the MDP has 1000 x 2"):
        Drawing(in_rows(ladder(n=2000), 1000)).picture(0)


def test_a_made_environment_renders_in_its_modes_and_in_those_of_gymnasiums_wrappers():
    for mode, kind in [("ansi", str), ("rgb_array", np.ndarray)]:
        env = gymnasium.make("pgts/Ladder-v0", render_mode=mode)
        env.reset(seed=0)
        assert isinstance(env.render(), kind)
    env = gymnasium.make("pgts/Ladder-v0", render_mode="rgb_array_list")
    env.reset(seed=0)
    env.step(0)
    assert len(env.render()) == 2


def test_many_environments_render_as_one_picture_each():
    envs = TabularVectorEnv(ladder(n=4), 3, render_mode="rgb_array")
    envs.reset(options={"state": [0, 2, 2]})
    frames = envs.render()
    assert [(frame == Drawing(envs.mdp).picture(state)).all() for frame, state in zip(frames, [0, 2, 2], strict=True)]
    assert (frames[1] == frames[2]).all()
    assert (frames[0] != frames[1]).any()


def test_what_cannot_be_rendered_is_refused():
    with pytest.raises(PgtsError, match=r"render_mode is 'human'; it must be None or one of \['ansi', 'rgb_array'\]"):
        TabularEnv(ladder(), render_mode="human")
    with pytest.raises(PgtsError, match=r"render_mode is 'ansi'; it must be None or one of \['rgb_array'\]"):
        TabularVectorEnv(ladder(), 2, render_mode="ansi")
    with pytest.raises(PgtsError, match="num_envs is 65; at most 64 environments can be rendered"):
        TabularVectorEnv(ladder(), 65, render_mode="rgb_array")
    for env, maker in [(TabularEnv(ladder()), "make"), (TabularVectorEnv(ladder()), "make_vec")]:
        with pytest.raises(PgtsError, match=f"render_mode is None; give render_mode=.* to gymnasium.{maker}$"):
            env.render()
    for env in (TabularEnv(ladder(), render_mode="ansi"), TabularVectorEnv(ladder(), render_mode="rgb_array")):
        with pytest.raises(ResetNeeded, match=r"Cannot call env.render\(\) before calling env.reset\(\)"):
            env.render()
