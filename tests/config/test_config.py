"""What a configuration means: defaults, files, overrides, and the parts that the library makes of it."""

from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from torch import nn

from pgts_torch import PGTS
from pgts_torch.agent import build
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.updates import Update
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.config import Config, dump, load, strict_yaml
from pgts_torch.models.environments import EnvSource
from pgts_torch.options import (
    CMPO,
    MLP,
    PPO,
    FixedHorizon,
    GeometricHorizon,
    Mirror,
    MonteCarlo,
    NetworkValues,
    SharedNetwork,
    TabularValues,
    TDLambda,
)
from pgts_torch.options.arguments import read
from pgts_torch.options.schema import Option, schema_of
from pgts_torch.tabular import ladder
from tests.config.shipped import SHIPPED, skip_unless_installed


def test_without_file_and_overrides_the_defaults_apply() -> None:
    assert load() == Config()


def test_the_readable_forms_of_yaml_1_2_mean_what_they_say(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(b"\xef\xbb\xbftotal_steps: 1_000\r\nseed: 010\r\nupdate: {step_size: 5e-2}\r\nname: no\r\n")
    config = load(path)
    assert (config.total_steps, config.seed, config.update.step_size, config.name) == (
        1000,
        10,
        0.05,
        "no",
    )


def test_an_override_changes_one_key_and_a_mapping_replaces_a_section(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("critic: {type: tabular, target: q, step_size: 0.3}\nsearch: {depth: 2, max_nodes: 7}\n")
    config = load(path, ["--critic.step_size", "mean", "--search", "{depth: 3}"])
    assert config.critic.model_dump() == TabularValues(target="q", step_size="mean").model_dump()
    assert config.search == Config().search.model_copy(update={"depth": 3})
    assert load(path, ["--critic", "{type: exact}"]).critic.model_dump() == {"type": "exact", "target": "v"}


def test_the_later_override_wins() -> None:
    config = load(None, ["--seed", "1", "--critic.target", "q", "--seed=2", "--critic", "{type: exact}"])
    assert (config.seed, config.critic.target) == (2, "v")


def test_text_stays_text_on_the_command_line() -> None:
    config = load(None, ["--name", "010", "--run.dir", "1e3", "--env.kwargs.n", "010", "--env.kwargs.word", "'010'"])
    assert (config.name, config.run.dir, config.env.kwargs) == ("010", "1e3", {"n": 10, "word": "010"})
    assert load(None, ["--run.dir", "x", "--run.dir", "null"]).run.dir is None
    assert load(None, ["--name", "null"]).name == "null"


def test_a_bare_flag_turns_a_switch_on() -> None:
    assert load(None, ["--run.overwrite", "--seed", "3"]) == load(None, ["--seed=3", "--run.overwrite", "true"])
    assert load(None, ["--run.overwrite"]).run.overwrite


def test_a_word_stands_for_the_part_of_this_type(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(
        "policy: mlp\ncritic: {network: shared, method: monte_carlo}\nrollout: {horizon: geometric}"
    )
    config = load(tmp_path / "c.yaml", ["--search", "mcts", "--update", "ppo"])
    critic = NetworkValues(network=SharedNetwork(), method=MonteCarlo())
    assert (config.policy, config.critic, config.update, config.search.kind) == (MLP(), critic, PPO(), "mcts")
    assert config.rollout.horizon == GeometricHorizon()


def test_an_override_goes_below_a_word(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("{policy: mlp, search: mcts}")
    flags = ["--policy.hidden", "[8]", "--search.depth=2", "--critic=network", "--critic.method.lambda=0.5"]
    config = load(tmp_path / "c.yaml", flags)
    assert (config.policy, config.search.kind, config.search.depth) == (MLP(hidden=[8]), "mcts", 2)
    assert config.critic == NetworkValues(method=TDLambda(lambda_=0.5))


def test_a_section_without_type_has_the_default_one() -> None:
    horizon = load(None, ["--rollout.horizon.length", "7"]).rollout.horizon
    assert horizon == FixedHorizon(length=7)


def test_a_configuration_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Config().seed = 1


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_configuration_is_valid_and_says_what_it_shows(name: str) -> None:
    config = load(SHIPPED[name])
    assert SHIPPED[name].read_text().startswith("# ")
    assert config.name == name
    skip_unless_installed(name)
    made = EnvSource.of(config.env.id, kwargs=config.env.kwargs).make_one()
    assert made.spec is not None
    assert made.spec.id == config.env.id
    made.close()


def test_the_shipped_configurations_are_those_of_the_paper_and_of_gymnasium() -> None:
    own = {"deep_sea", "deep_sea_bsuite", "deep_sea_stochastic", "grid", "ladder", "random", "tightrope"}
    toy_text = {"cliff_walking", "frozen_lake_4x4", "frozen_lake_8x8", "taxi"}
    others = toy_text | {"acrobot", "cartpole", "mountain_car", "mountain_car_continuous", "door_key"}
    box2d = {"lunar_lander"}
    images = {"catch", "minigrid_door_key", "minigrid_empty"}
    learned = {f"learned_{name}" for name in (toy_text | {"acrobot", "cartpole", "deep_sea", "mountain_car"} | images)}
    games = {f"atari_{name}" for name in ("breakout", "freeway", "montezuma_revenge", "pong")}
    emulators = games | {"mujoco_inverted_pendulum", "mujoco_hopper", "mujoco_half_cheetah"}
    assert set(SHIPPED) == own | others | box2d | learned | emulators
    assert own | {"learned_deep_sea"} == {
        name for name, path in SHIPPED.items() if load(path).env.id.startswith("pgts/")
    }


@pytest.mark.parametrize("path", [None, *SHIPPED.values()], ids=["defaults", *SHIPPED])
def test_a_printed_configuration_loads_to_the_same_one(path: Path | None, tmp_path: Path) -> None:
    config = load(path)
    (tmp_path / "c.yaml").write_text(dump(config))
    assert load(tmp_path / "c.yaml") == config


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)
"""What may stand in env.kwargs."""

SCHEDULE = "or linear(FROM, TO, STEPS) or cosine(FROM, TO, STEPS) by environment steps"
SCHEDULES = st.builds("{}({}, {}, {})".format, st.sampled_from(["linear", "cosine"]), *[st.integers(1, 9)] * 3)
SAMPLES: dict[str, st.SearchStrategy[Any]] = {
    "a whole number >= 0": st.integers(0, 2**63 - 1),
    "a whole number >= 1": st.integers(1, 2**63 - 1),
    "a whole number in [1, 1024]": st.integers(1, 1024),
    "a whole number in [2, 10000] or null": st.none() | st.integers(2, 10_000),
    "a number or null": st.none() | st.floats(allow_nan=False, allow_infinity=False),
    "a number or mean": st.just("mean") | st.floats(allow_nan=False, allow_infinity=False),
    "a number > 0": st.floats(0, exclude_min=True, allow_infinity=False),
    "a whole number >= 0 or adaptive": st.just("adaptive") | st.integers(0, 2**63 - 1),
    "a whole number >= 1 or null": st.none() | st.integers(1, 2**63 - 1),
    "a whole number >= 2 or null": st.none() | st.integers(2, 2**63 - 1),
    "a whole number >= 1 or all or null": st.sampled_from([None, "all", 3]),
    "true or false or null": st.none() | st.booleans(),
    "a whole number >= 1, or a list of such and null, one for each level": st.sampled_from([1, 7, [3, None]]),
    "a whole number >= 0 or null": st.none() | st.integers(0, 2**63 - 1),
    "a number >= 0 or null": st.none() | st.floats(0, allow_infinity=False),
    "a number in [0, 1]": st.floats(0, 1),
    "a number in (0, 1]": st.floats(0, 0.5, exclude_min=True),
    "a number in (0, 1] or null": st.none() | st.floats(0, 1, exclude_min=True),
    "a number in (0, 1) or null": st.none() | st.floats(0, 1, exclude_min=True, exclude_max=True),
    "a number in [0, 1] or null": st.none() | st.floats(0, 1),
    "a number in (0, 1] or mean": st.just("mean") | st.floats(0, 1, exclude_min=True),
    "true or false": st.booleans(),
    "a list of keys or null": st.sampled_from([None, ["image"], ["image", "at:1"]]),
    "a folder or null": st.none() | st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), min_size=1),
    "the id of a Gymnasium environment": st.from_regex(r"[A-Za-z0-9_.:/-]{1,20}", fullmatch=True),
    "letters, digits, '.', '_', '-', at most 100": st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", fullmatch=True),
    "cpu, cuda or cuda:N": st.sampled_from(["cpu", "cuda", "cuda:3"]),
    "a number >= 1 or null": st.none() | st.floats(1, allow_infinity=False),
    "a number > 0 or null": st.none() | st.floats(0, exclude_min=True, allow_infinity=False),
    "a number > 0 or never": st.just("never") | st.floats(0, exclude_min=True, allow_infinity=False),
    "a number > 0 or never or null": st.sampled_from([None, "never", 0.25]),
    "a number >= 0": st.floats(0, allow_infinity=False),
    f"a number > 0, {SCHEDULE}": SCHEDULES | st.floats(0, exclude_min=True, allow_infinity=False),
    f"a number > 0, {SCHEDULE} or null": st.none() | SCHEDULES,
    f"a number >= 0, {SCHEDULE}": SCHEDULES | st.floats(0, allow_infinity=False),
    "rms or none or null": st.sampled_from([None, "rms", "none"]),
    "first or last or null": st.sampled_from([None, "first", "last"]),
    "adam or sgd or null": st.sampled_from([None, "adam", "sgd"]),
    "occupancy, visits or uniform or null": st.sampled_from([None, "occupancy", "visits", "uniform"]),
    "a key of dictionary observations or null": st.none() | st.from_regex(r"[A-Za-z0-9_.:-]{1,20}", fullmatch=True),
    "a list of at most 16 whole numbers in [1, 65536]": st.lists(st.integers(1, 65536), max_size=16),
    "a whole number in [1, 65536], or a list of such, one for each layer": st.integers(1, 2**16),
    "a list of two ascending numbers or null": st.sampled_from([None, [0, 1], [-1.5, -1.5]]),
    "a mapping": st.dictionaries(st.sampled_from(["n", "traps", "word"]), PLAIN),
}
"""Valid values for each requirement."""


OPTIONS = schema_of(Config).options()


UPDATES = {
    "auto": ["auto", "softmax", "projected", "gradient", "ppo", "cmpo"],
    "softmax": ["auto", "softmax", "mirror"],
    "simplex": ["auto", "projected", "mirror"],
    "mlp": ["auto", "gradient", "ppo", "mirror", "cmpo"],
    "cnn": ["auto", "gradient", "ppo", "mirror", "cmpo"],
    "nature_cnn": ["auto", "gradient", "ppo", "mirror", "cmpo"],
    "module": ["auto", "gradient", "ppo", "mirror", "cmpo"],
    "gaussian": ["auto", "gradient", "ppo", "mpo"],
}
"""What can move a policy of each type."""


@st.composite
def configurations(draw: st.DrawFn) -> Config:
    """Every key with any valid value; choices that must fit each other do."""
    given: dict[str, Any] = {}
    types = {option.key: draw(st.sampled_from(_words(option))) for option in OPTIONS if option.choices}
    policy = types["policy.type"]
    is_table = policy in ("softmax", "simplex")
    types["update.type"] = draw(st.sampled_from(UPDATES[policy]))
    networks = ["own", "mlp"] if is_table else ["own", "shared"] + [policy] * (policy not in ("auto", "gaussian"))
    types["critic.network.type"] = draw(st.sampled_from(networks))
    types["critic.type"] = "network" if policy.endswith("cnn") or policy == "gaussian" else types["critic.type"]
    if policy == "gaussian":
        types["search.kind"] = draw(st.sampled_from(["auto", "expectimax", "mcts"]))
        types["model.type"] = draw(st.sampled_from(["auto", "ensemble", "own"]))
    needs_all = is_table or types["update.type"] in ("mirror", "cmpo", "mpo")
    types["estimator.type"] = "lookahead" if needs_all else types["estimator.type"]
    if types["estimator.type"] == "sampled" and types["critic.type"] in ("exact", "rollout"):
        types["critic.type"] = "network"
    if types["model.type"] in ("counts", "ensemble", "latent") and types["replay.type"] == "none":
        types["replay.type"] = "auto"  # they learn from what replay keeps
    for option in OPTIONS:
        if option.exists(types):
            words = st.sampled_from(_words(option))
            given[option.key] = types.get(option.key) or draw(SAMPLES.get(option.requirement, words))
    if types["update.type"] == "mirror":
        used = {"type", *Mirror.standing("tables" if is_table else "networks")}
        ignored = [key for key in given if key.startswith("update.") and key.removeprefix("update.") not in used]
        given |= dict.fromkeys(ignored)
    if given["eval.every"] is None:
        given |= {"eval.stop_at_return": None, "eval.keep_best": False}
    if policy == "gaussian":
        given |= {
            "search.depth": 3,
            "search.stop_at": None,
            "critic.target": "v",
            "policy.std": 0.5,
            "policy.min_std": 0.25,
        }
        given |= {"search.samples": None} if types["search.kind"] == "mcts" else {}
    else:
        given |= {"search.actions": None, "search.proposal_scale": None}
        given |= {"search.widening": None} if types["search.kind"] == "mcts" else {}
    if given["search.depth"] != "adaptive":
        given["search.max_depth"] = given["search.tolerance"] = None
    if types["critic.type"] == "network" and (given["critic.polyak"] < 1 or given["critic.target_period"] > 1):
        given["critic.fresh_targets"] = None
    if given["search.kind"] == "mcts":
        given |= {"search.exploration": None} if given["search.rule"] == "gumbel" else {"search.prior": "uniform"}
        given |= {"search.merge": False} if given["search.backup"] == "mean" else {}
        if given["search.widening"] is None:
            given["search.widening_power"] = None
        else:
            given |= {"search.wave": 1, "search.backup": "max", "search.merge": None}
    given |= {key: "mine:made" for key in given if key.endswith(".make")}
    if policy == "module" and types["critic.network.type"] == "shared":
        given["policy.head"] = True
    if types["model.type"] == "counts" and given["model.optimism"] == "none":
        given["model.strength"] = None
    if types["model.type"] == "counts" and given["model.value_range"] is None:
        given["model.confidence"] = given["model.certificate"] = None
    convolved = {"cnn", "nature_cnn"} & {types["policy.type"], types.get("critic.network.type")}
    if types["model.type"] == "latent" and convolved:
        types = types | {"model.type": "auto"}
        given = {key: value for key, value in given.items() if not key.startswith("model.")}
    silent = {
        "latent": True,
        "counts": given.get("model.confidence") is None,
        "ensemble": given.get("model.members") == 1 or given.get("search.action_repeat", 1) > 1,
    }
    if given.get("search.doubt") and (given["search.max_width"] is not None or silent.get(types["model.type"])):
        given["search.doubt"] = False
    is_learned = types["model.type"] in ("counts", "ensemble", "latent")
    if is_learned and given.get("model.certificate") is None:
        given["search.stop_at"] = None
    goes_on, is_sampled = types["rollout.horizon.type"] == "steps", types["estimator.type"] == "sampled"
    if goes_on and not is_sampled and (types["replay.type"], is_learned) != ("auto", True):
        given = {key: value for key, value in given.items() if not key.startswith("replay.")}
        given["replay.type"] = "uniform"
    if is_sampled:
        given = {key: value for key, value in given.items() if not key.startswith(("model.", "replay."))}
        given |= {"update.state_weight": "visits"} if goes_on and "update.state_weight" in given else {}
        given |= {"critic.target": "v"} if types["critic.type"] != "auto" else {}
        given = {key: value for key, value in given.items() if not key.startswith("search.")} | {"search.depth": 0}
    return Config.model_validate(_nested(given))


def _words(option: Option) -> list[str]:
    return option.requirement.replace(" or ", ", ").split(", ")


def _nested(values: dict[str, Any]) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for key, value in values.items():
        *sections, name = key.split(".")
        section = data
        for part in sections:
            section = section.setdefault(part, {})
        section[name] = value
    return data


@pytest.mark.usefixtures("unchecked_shapes")
@given(configurations())
def test_any_configuration_survives_printing_and_loading(config: Config) -> None:
    assert Config.model_validate(strict_yaml.parse(dump(config)).value) == config
    assert dump(config).isascii()


@pytest.mark.parametrize("kind", ["auto", "expectimax", "sampled", "mcts"])
def test_a_file_of_version_0_1_with_null_for_what_another_kind_of_search_has_means_what_it_did(
    kind: str, tmp_path: Path
) -> None:
    nulls = {"max_width": None, "samples": None, "share": None, "simulations": None, "merge": None}
    text = strict_yaml.dump({"search": {"depth": 2, "kind": kind} | nulls})
    (tmp_path / "c.yaml").write_text(text)
    assert load(tmp_path / "c.yaml") == load(None, ["--search.depth", "2", "--search.kind", kind])


def test_every_default_is_the_one_that_the_help_names() -> None:
    defaults = Config().model_dump(by_alias=True)
    types = {key: _look_up(defaults, key) for key in _leaves(defaults) if key.endswith((".type", ".kind"))}
    options = {option.key: option for option in OPTIONS if option.exists(types)}
    for key, option in options.items():
        assert _look_up(defaults, key) == option.default, key
    assert set(options) == set(_leaves(defaults))


def _look_up(data: Any, key: str) -> Any:
    for part in key.split("."):
        data = data[part]
    return data


def _leaves(data: dict[str, Any], prefix: str = "") -> list[str]:
    leaves: list[str] = []
    for name, value in data.items():
        leaves += _leaves(value, f"{prefix}{name}.") if isinstance(value, dict) and value else [f"{prefix}{name}"]
    return leaves


NUMBERED = TabularWorld(EnvSource.of("pgts/Ladder-v0").make(1), ladder())
PICTURED = SimpleNamespace(
    perceived_space=spaces.Box(0, 255, (7, 7, 3), np.uint8),
    num_actions=2,
    action_size=2,
    device=torch.device("cpu"),
    model=None,
)
"""The world of a numbered environment, and as much of one with images as parts ask for."""

CRITIC = ["--critic.network.make", "tests.agent.modules:Plain", "--critic.network.arguments.width", "3"]
PARTS = [
    [],
    ["--policy.type", "simplex", "--update.type", "projected"],
    ["--policy.init.type", "random", "--update.type", "mirror", "--update.step_size", "0.2"],
    ["--policy.init.type", "biased", "--critic.method.type", "monte_carlo"],
    ["--critic.type", "exact", "--rollout.horizon.type", "geometric"],
    ["--critic.type", "rollout", "--critic.horizon.type", "fixed"],
    ["--critic.type", "rollout", "--critic.horizon.type", "geometric", "--search.kind", "expectimax"],
    ["--critic.type", "network", "--critic.method.type", "monte_carlo", "--search.kind", "mcts"],
    ["--policy.type", "mlp", "--critic.type", "tabular", "--search.kind", "sampled"],
    ["--policy.type", "mlp", "--critic.network.type", "mlp", "--critic.network.hidden", "[]"],
    ["--policy.type", "mlp", "--critic.network.type", "shared", "--update.type", "gradient"],
    ["--policy.type", "softmax", "--update.type", "softmax"],
    ["--policy.hidden", "[8]", "--update", "{type: cmpo, clip: 0.5}"],
    ["--policy.type", "mlp", "--update", "{type: mirror, temperature: 0.5, max_grad_norm: never}"],
    ["--policy.type", "cnn", "--policy.scale", "10", "--update.target_kl", "0.1", "--critic.target", "q"],
    ["--policy.type", "cnn", "--critic.network", "{type: cnn, channels: [4]}", "--critic.polyak", "0.1"],
    [
        *("--policy", "{type: nature_cnn, kernel_size: 2, stride: 1, hidden: [8]}"),
        *("--critic.network", "{type: nature_cnn, kernel_size: [3, 2, 2], stride: 1, hidden: [8]}"),
    ],
    ["--policy", "tests.agent.modules:Plain", "--critic.network.type", "module", *CRITIC],
    ["--policy.type", "mlp", "--search.depth", "0", "--estimator.type", "sampled", "--estimator.lambda", "0.9"],
    ["--rollout.horizon.type", "fixed", "--model.type", "given", "--replay.type", "none"],
    ["--rollout.horizon", "{length: 5, max_length: 9}", "--search.depth=0", "--estimator=sampled", "--policy=mlp"],
    ["--model.type", "counts", "--rollout.horizon.first", "7"],
    ["--model.type", "own", "--model.make", "models_of_mine:model"],
    ["--model.type", "latent", "--replay.length", "3"],
    ["--model.type", "latent", "--model.network.type", "cnn"],
    ["--model.type", "latent", "--model.network.type", "nature_cnn"],
    ["--model.members", "2", "--replay.length", "3"],
    ["--policy.type", "gaussian", "--search.actions", "4"],
    ["--policy.type", "gaussian", "--policy.network.type", "mlp", "--update.type", "mpo"],
    ["--policy.type", "gaussian", "--policy.network", "tests.agent.modules:Plain"],
    ["--policy", "{type: gaussian, network: cnn, std: 0.5}", "--update", "{kl: 0.2}"],
    [
        "--policy",
        "{type: gaussian, network: {type: nature_cnn, kernel_size: 2, stride: 1}}",
        "--update.type",
        "gradient",
    ],
]
"""Command lines that together name every type there is."""


def made(arguments: list[str]) -> tuple[Policy, Critic, Update]:
    """What the library makes of a configuration."""
    config = load(None, arguments)
    world: Any = PICTURED if config.policy.type.endswith("cnn") or config.policy.type == "gaussian" else NUMBERED
    options = build.chosen(read(config.arguments()), world)
    policy = build.make_policy(options.policy, world, seed=0)
    critic = build.make_critic(options.critic, world, policy, options.estimator, seed=0)
    build.make_search(options.search, NUMBERED.model)
    return policy, critic, build.make_update(options.update, policy)


@pytest.mark.parametrize("arguments", PARTS, ids=" ".join)
def test_the_library_builds_what_is_configured(arguments: list[str]) -> None:
    policy, critic, update = made(arguments)
    config = load(None, arguments)
    assert critic.target == getattr(config.critic, "target", "v")
    network = getattr(config.policy, "network", config.policy)
    assert policy.options == config.policy or network.type == "auto"
    update.check(policy)


def test_these_parts_name_every_type_there_is() -> None:
    named: dict[str, set[str]] = {}
    for arguments in PARTS:
        data = load(None, arguments).model_dump(by_alias=True)
        for key in (key for key in _leaves(data) if key.endswith((".type", ".kind"))):
            named.setdefault(key, set()).add(_look_up(data, key))
    assert named == {option.key: {tag for tag, _ in option.choices} for option in OPTIONS if option.choices}


def test_what_is_configured_reaches_the_part() -> None:
    sizes = ["--policy.type", "mlp", "--policy.hidden", "[7, 5]"]
    policy, own, update = made([*sizes, "--update.max_grad_norm", "never"])
    assert isinstance(policy, NetworkPolicy)
    assert [layer.out_features for layer in policy.network.modules() if isinstance(layer, nn.Linear)] == [7, 5, 2]
    assert update.options == CMPO(max_grad_norm="never")
    assert isinstance(own, NetworkCritic)
    assert [layer.out_features for layer in own.network.modules() if isinstance(layer, nn.Linear)] == [7, 5, 1]
    assert own.options.learning_rate == 1e-3
    other, critic, _ = made([*sizes, "--critic.network.type", "shared"])
    assert isinstance(other, NetworkPolicy)
    assert isinstance(critic, NetworkCritic)
    assert critic.network.trunk is other.network.trunk is not own.network.trunk
    _, critic, _ = made(["--policy.type", "mlp", "--search.depth", "0", "--estimator.type", "sampled"])
    assert critic.options.learning_rate == 3e-4


@pytest.mark.parametrize("path", [None, *SHIPPED.values()], ids=["defaults", *SHIPPED])
def test_the_arguments_of_a_configuration_are_its_options(path: Path | None) -> None:
    config = load(path)
    options = read(config.arguments())
    for name in ("policy", "rollout", "search", "estimator", "update"):
        assert getattr(options, name) == getattr(config, name)
    assert config.arguments().keys() == signature(PGTS).parameters.keys()


def test_an_option_goes_with_the_option_that_it_needs() -> None:
    adaptive = load(None, ["--search.depth", "adaptive", "--search.max_depth", "3", "--search.tolerance", "1"]).search
    assert (adaptive.max_depth, adaptive.tolerance) == (3, 1)
    evaluated = load(None, ["--eval.every", "100", "--eval.stop_at_return", "0", "--eval.keep_best"]).eval
    assert (evaluated.stop_at_return, evaluated.keep_best) == (0, True)


@pytest.mark.parametrize("policy", ["mlp", "cnn"])
def test_a_network_policy_brings_a_network_critic_with_it(policy: str, tmp_path: Path) -> None:
    config = load(None, ["--policy.type", policy, "--update.learning_rate", "1e-3"])
    assert (config.critic.type, config.update.type) == ("network", "cmpo")
    assert Config.model_validate({"policy": {"type": policy}, "update": {"learning_rate": 1e-3}}) == config
    (tmp_path / "c.yaml").write_text(dump(config))
    assert load(tmp_path / "c.yaml") == config


def test_the_environment_chooses_what_is_not_configured() -> None:
    config = Config()
    assert {config.policy.type, config.critic.type, config.update.type} == {"auto"}
    assert Config.model_validate({"policy": {}, "critic": {}, "update": {}}) == config


@pytest.mark.parametrize(
    ("keys", "types"),
    [
        ({"policy.init.type": "random"}, ("softmax", "auto", "auto")),
        ({"policy.hidden": "[8]"}, ("mlp", "network", "auto")),
        ({"policy.channels": "[8]"}, ("cnn", "network", "auto")),
        ({"critic.step_size": "0.1"}, ("auto", "tabular", "auto")),
        ({"critic.learning_rate": "0.1"}, ("auto", "network", "auto")),
        ({"update.step_size": "0.1"}, ("auto", "auto", "mirror")),
        ({"policy.type": "simplex", "update.step_size": "0.1"}, ("simplex", "auto", "projected")),
        ({"update.learning_rate": "0.1"}, ("auto", "auto", "cmpo")),
        ({"update.clip_range": "0.1"}, ("auto", "auto", "ppo")),
        (
            {"search.depth": "0", "estimator.type": "sampled", "update.learning_rate": "0.1"},
            ("auto", "auto", "ppo"),
        ),
    ],
)
def test_a_section_without_type_is_of_the_first_type_that_knows_its_keys(
    keys: dict[str, str], types: tuple[str, ...]
) -> None:
    config = load(None, [part for key, value in keys.items() for part in (f"--{key}", value)])
    assert (config.policy.type, config.critic.type, config.update.type) == types
