"""Which observations and environments work, and how: docs/environments.md, from what the tests do.

`python -m tests.environments` writes the page. `python -m tests.environments ID...` first trains in these environments,
where their packages are installed (with others than a training here needs, in an environment of their own), and
records what came of it.
"""

import json
import re
import sys
import textwrap
import warnings
from pathlib import Path
from typing import Any

from tests.agent.kinds import KINDS
from tests.agent.masked import ENVIRONMENTS, SEARCHES

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / "docs" / "environments.md"
RESULTS = ROOT / "tests" / "environment_results.json"

TILES = {"num_rows": 4, "num_cols": 4, "num_colours": 3, "num_moves": 10} | dict.fromkeys(
    ("colourless_specials", "colour_specials"), ()
)

TRIED: dict[str, tuple[str, dict[str, Any]]] = {
    "FrozenLake-v1": ("gymnasium", {}),
    "Taxi-v4": ("gymnasium", {}),
    "Blackjack-v1": ("gymnasium", {"depth": 1}),
    "Blackjack-v1, counted": ("gymnasium", {"model": "counts"}),
    "MiniGrid-Empty-5x5-v0": ("minigrid", {"depth": 1, "observation_keys": ["image", "direction"]}),
    "retraced/Env-v0, Box2D": ("gymnasium", {"depth": 0, "max_roots": 16, "env_kwargs": {"env": "LunarLander-v3"}}),
    "highway_env:highway-v0": ("highway-env", {"depth": 1}),
    "gym_simplegrid:SimpleGrid-4x4-v0": ("gym-simplegrid", {"depth": 1}),
    "gymnasium_2048:gymnasium_2048/TwentyFortyEight-v0": ("gymnasium-2048", {"depth": 1}),
    "tetris_gymnasium.envs:tetris_gymnasium/Tetris": ("tetris-gymnasium", {"depth": 1}),
    "flappy_bird_gymnasium:FlappyBird-v0": ("flappy-bird-gymnasium", {"depth": 1}),
    "gym_anytrading:stocks-v0": ("gym-anytrading", {"depth": 1}),
    "popgym:popgym-HigherLowerEasy-v0": ("popgym", {"depth": 1}),
    "popgym:popgym-MineSweeperEasy-v0": ("popgym", {"depth": 1}),
    "minatar.gym:BaseEnv": ("minatar", {"depth": 1, "env_kwargs": {"game": "breakout"}}),
    "kraken_crossing:KrakenCrossing-v0": ("kraken-crossing", {"depth": 1}),
    "numberlink:NumberLinkRGB-v0": ("numberlink", {"depth": 0}),
    "pgtg:pgtg-v5": ("pgtg", {"depth": 1}),
    "tile_match_gym:TileMatch-v0": ("tile-match-gym", {"depth": 0, "env_kwargs": TILES}),
    "connect_four_gymnasium:ConnectFourEnv": ("gymnasium-connect-four", {"depth": 1}),
    "gymnasium_cartpole_swingup:CartPoleSwingUp-v0": (
        "gymnasium-cartpole-swingup",
        {"depth": 0, "policy": "gaussian"},
    ),
    "gymnasium_robotics:PointMaze_UMaze-v3": ("gymnasium-robotics", {"depth": 0, "policy": "gaussian"}),
    "panda_gym:PandaReach-v3": ("panda-gym", {"depth": 0, "policy": "gaussian"}),
    "space_mining:SpaceMining": ("space-mining", {"depth": 0, "policy": "gaussian"}),
    "gym_sailing:SailboatDiscrete-v0": ("gym-sailing", {"depth": 1}),
    "gymnasium_snake_game:Snake-v1": ("gymnasium-snake-game", {"depth": 1}),
    "pickomino_env:Pickomino-v0": ("pickomino-env", {"depth": 1}),
    "minihack:MiniHack-Room-5x5-v0": ("minihack", {"depth": 1, "observation_keys": ["chars_crop"]}),
}
"""By id: the package, and the arguments of `PGTS`."""


_MASKS = textwrap.wrap(
    "An action that is not legal is never taken: not by the policy, a search, an imagined episode or an evaluation, "
    "nor by `predict(observation, action_mask=...)`, which needs the mask. The environment says what is legal, by the "
    'first of these that it has: a method `action_masks()`; `info["action_mask"]` in each reset and step; '
    '`observation["action_mask"]`, an entry of dictionaries with a value from 0 to 1 for each action (`Box` or '
    "`MultiBinary`), of which `predict` takes it and which is no input of policies. In a searched state its simulator "
    "says it. A table says it by rewards of -inf, and then policies are tables, too; so does a `TensorModel` "
    'with `forbids = True`. `action_masks="off"` ignores masks; `"auto"` ignores `info["action_mask"]` beside a '
    'table that says what each action does (Taxi), and `"on"` does not. '
    "Learned models (`counts`, `ensemble`, `latent`) refuse masks.",
    width=116,
    break_long_words=False,
)


def tried(name: str) -> dict[str, Any]:
    """Train for one short iteration, with the lookahead, or without where there is no model for it."""
    from pgts_torch import PGTS
    from pgts_torch.errors import MissingModel

    arguments: dict[str, Any] = {"num_envs": 1, "seed": 0} | TRIED[name][1]
    if "model" not in arguments:
        arguments["horizon"] = {"type": "fixed", "length": 3}
    env = name.partition(",")[0]
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        why = ""
        try:
            training = PGTS(env, **arguments)
        except MissingModel as missing:
            why = str(missing).rpartition("are not enough: ")[2].partition(";")[0]
            arguments |= {"depth": 0, "estimator": "sampled"}
            training = PGTS(env, **arguments)
        training.iterate()
    model = "none" if training.world.model is None else type(training.world.model).__name__
    return {
        "observations": _shown(training.world.env.single_observation_space),
        "policy": training.options.policy.type,
        "model": model,
        "why": why,
    }


def _shown(space: Any) -> str:
    """A space in one line, without addresses."""
    return " ".join(re.sub(r"<function [^>]*>", "...", str(space)).split())


def results() -> dict[str, dict[str, Any]]:
    """What was recorded, by id."""
    found: dict[str, dict[str, Any]] = json.loads(RESULTS.read_text(encoding="utf-8"))
    return found


def record(names: list[str]) -> None:
    """Try these, and keep what came of it."""
    RESULTS.write_text(
        json.dumps(results() | {name: tried(name) for name in names}, indent=2, sort_keys=True) + "\n", encoding="utf-8"
    )


def document() -> str:
    """The text of docs/environments.md."""
    lines = [
        "# Observations, action masks, environments",
        "",
        "Each kind of observation below is trained on, saved, loaded, evaluated and resumed by",
        "[tests/agent/test_spaces.py](../tests/agent/test_spaces.py), with each of its networks and with",
        "[one of the caller's own](start/your_network.md), with a lookahead, without one, and with the model that is",
        "learned of it. Kinds may be nested in dictionaries and tuples in any way; dictionaries are seen whole, or by",
        "`observation_keys`. Text, graphs and sequences are refused.",
        "`python -m tests.environments` writes this page from these cases; a test compares it with them.",
        "",
        "| observation | space | network by default | others | model that is learned |",
        "|---|---|---|---|---|",
    ]
    for kind, (space, _, policies, learned) in KINDS.items():
        shown = _shown(space)
        others = ", ".join([*policies[1:], *(["a table, with counts"] if learned == "counts" else [])])
        lines.append(f"| {kind} | `{shown}` | {policies[0]} | {others} | {learned or 'none'} |")
    lines += [
        "",
        "## Action masks",
        "",
        *_MASKS,
        "",
        "In each of these an illegal action is an error. They are trained in, saved, loaded, resumed and evaluated by",
        "[tests/agent/test_action_masks.py](../tests/agent/test_action_masks.py), with and without a lookahead:",
        "",
        *[f"- `{name.partition(',')[0]}`{name[len(name.partition(',')[0]) :]}" for name in ENVIRONMENTS],
        "",
        f"`info` and `observation` are searched by each of: {', '.join(each for each in SEARCHES if each != 'none')}.",
        "",
        "## Environments that were tried",
        "",
        "`python -m tests.environments ID` trains for one short iteration, no more, and records what came of it. The",
        "model is that of the lookahead; where there is none the training was one without, and the reason is given.",
        "",
        "| environment | package | observations | policy | model |",
        "|---|---|---|---|---|",
    ]
    known = results()
    for name, (package, arguments) in TRIED.items():
        if (result := known.get(name)) is None:
            continue
        call = ", ".join([f'"{name.partition(",")[0]}"', *(f"{key}={value!r}" for key, value in arguments.items())])
        shown, why = result["observations"].replace("|", "\\|"), f": {result['why']}" if result["why"] else ""
        lines.append(f"| `PGTS({call})` | {package} | `{shown}` | {result['policy']} | {result['model']}{why} |")
    return "\n".join(lines) + "\n"


def write() -> None:
    """Write the page."""
    DOCUMENT.write_text(document(), encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:]:
        record(sys.argv[1:])
    write()
