"""Configuration files and overrides: what is read, what is refused, and in which words."""

import math
import random
import time
from collections.abc import Callable
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
from pgts_torch.agent.neural import NetworkCritic, NetworkPolicy
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.updates import Update
from pgts_torch.agent.world import TabularWorld
from pgts_torch.config import Config, ConfigError, dump, load, strict_yaml
from pgts_torch.config.loading import MAX_BYTES, MAX_MISTAKES
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
)
from pgts_torch.options.arguments import read
from pgts_torch.options.schema import Option, schema_of
from pgts_torch.tabular import ladder
from tests import reliability

SHIPPED = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))


@pytest.fixture
def mistakes(tmp_path: Path) -> Callable[..., list[str]]:
    """The mistakes in a file `c.yaml` of this content and in these arguments, without the folder."""

    def find(content: str | bytes | None, *arguments: str) -> list[str]:
        path = tmp_path / "c.yaml"
        if content is not None:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(ConfigError) as caught:
            load(None if content is None else path, arguments)
        assert caught.value.mistakes == tuple(str(caught.value).splitlines())
        return [line.replace(f"{tmp_path}/", "") for line in caught.value.mistakes]

    return find


SIZES = "a list of at most 16 whole numbers in [1, 65536]"
KINDS = "auto, expectimax, mcts or sampled"


@pytest.mark.fault("empty file", "not UTF-8", "aliases", "python tags", "nesting 3,000 deep", "integer of 5,000 digits")
@pytest.mark.parametrize(
    ("content", "mistake"),
    [
        ("", "c.yaml: the configuration is empty; it must be a mapping of keys to values"),
        ("# nothing\n", "c.yaml: the configuration is empty; it must be a mapping of keys to values"),
        ("- seed", "c.yaml: the configuration is a list; it must be a mapping of keys to values"),
        ("seed", "c.yaml: the configuration is 'seed'; it must be a mapping of keys to values"),
        (b"name: \xff", "c.yaml: the configuration is not UTF-8 (at byte 6)"),
        (b"#" * (MAX_BYTES + 1), f"c.yaml: the configuration is larger than {MAX_BYTES} bytes"),
        ("a: &x 1\nb: *x", "c.yaml:1: anchors (&) and aliases (*) are not allowed; write the value out"),
        ("a: 1\nb: *x", "c.yaml:2: anchors (&) and aliases (*) are not allowed; write the value out"),
        (
            "a: !!python/name:os.system x",
            "c.yaml:1: tags are not allowed, here tag:yaml.org,2002:python/name:os.system; write plain values",
        ),
        ("seed: 1\n---\nseed: 2", "c.yaml:2: a second document starts here; only one is allowed"),
        ("%YAML 1.1\n---\nseed: 1", "c.yaml:1: directives (%) are not allowed; the text is read as YAML 1.2"),
        ("seed: [1, 2", "c.yaml:1: this is not YAML: expected ',' or ']', but got '<stream end>'"),
        ("seed: 1\n\tname: x", "c.yaml:2: this is not YAML: found character '\\t' that cannot start any token"),
        ("a: " + "[" * 3000, "c.yaml:1: values are nested more than 32 deep"),
        ("- " * 3000, "c.yaml:1: values are nested more than 32 deep"),
        ("seed: " + "9" * 5000, f"c.yaml:1: a number cannot be read: {'9' * 57}..."),
        ("[a]: 1", "c.yaml:1: a key must be a word, not a mapping or a sequence"),
        ('name: "\\ud800"', "c.yaml:1: text holds half of a surrogate pair, which is no character"),
        ('name: "\\UFFFFFFFF"', "c.yaml: this is not YAML: Python int too large to convert to C int"),
    ],
)
def test_a_file_that_cannot_be_read_is_one_clear_line(
    mistakes: Callable[..., list[str]], content: str | bytes, mistake: str
) -> None:
    assert mistakes(content) == [mistake]


@pytest.mark.fault("missing file", "directory in place of a file")
def test_a_missing_file_and_a_folder_are_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: the configuration cannot be read: No such file or directory$"):
        load(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match=r"the configuration cannot be read: Is a directory$"):
        load(tmp_path)


@pytest.mark.fault("unknown key", "wrong type", "value out of range", "duplicate keys")
@pytest.mark.parametrize(
    ("content", "mistake"),
    [
        ("seed: -1", "seed is -1; it must be a whole number >= 0"),
        ("seed: 1.0", "seed is 1.0; it must be a whole number >= 0 (write 1)"),
        ("total_steps: 1e6", "total_steps is 1e6; it must be a whole number >= 1 (write 1000000)"),
        ("seed: 9223372036854775808", "seed is 9223372036854775808; it must be a whole number >= 0 and below 2**63"),
        ("seed: '1'", "seed is '1'; it must be a whole number >= 0"),
        ("seed: true", "seed is true; it must be a whole number >= 0"),
        ("seed:", "seed is empty; it must be a whole number >= 0"),
        ("seed: {a: 1}", "seed is a mapping; it must be a whole number >= 0"),
        ("threads: 2000", "threads is 2000; it must be a whole number in [1, 1024]"),
        (
            "name: 010",
            "name is 010; it must be letters, digits, '.', '_', '-', at most 100 (in quotes, to make it text)",
        ),
        ("name: ../x", "name is '../x'; it must be letters, digits, '.', '_', '-', at most 100"),
        ('name: "a\\nb"', "name is 'a\\nb'; it must be letters, digits, '.', '_', '-', at most 100"),
        ("device: gpu", "device is 'gpu'; it must be cpu, cuda or cuda:N"),
        ("env: {gamma: 1.5}", "env.gamma is 1.5; it must be a number in [0, 1] or null"),
        ("env: {gamma: .nan}", "env.gamma is .nan; it must be a number in [0, 1] or null"),
        ("env: {id: }", "env.id is empty; it must be the id of a Gymnasium environment"),
        ("env: {kwargs: 3}", "env.kwargs is 3; it must be a mapping"),
        ("env: {kwargs: {n: .inf}}", "env.kwargs holds inf; numbers must be finite"),
        ("env: {kwargs: {n: [1, .nan]}}", "env.kwargs holds nan; numbers must be finite"),
        ("env: {kwargs: {1: 2}}", "env.kwargs has the key '1', which cannot be the name of an argument"),
        ("env: {kwargs: {gamma: 0.9}}", "env.kwargs must not have the key gamma: env.gamma sets it"),
        ("update: {step_size: 0}", "update.step_size is 0; it must be a number > 0 or null"),
        ("update: {type: softmax, step_size: .inf}", "update.step_size is .inf; it must be a number > 0"),
        (
            "update: {type: adam}",
            "update.type is 'adam'; it must be auto, cmpo, gradient, mirror, ppo, projected or softmax",
        ),
        ("policy: {type: resnet}", "policy.type is 'resnet'; it must be auto, cnn, mlp, simplex or softmax"),
        ("policy: resnet", "policy.type is 'resnet'; it must be auto, cnn, mlp, simplex or softmax"),
        ("policy: {type: mlp, hidden: 64}", f"policy.hidden is 64; it must be {SIZES}"),
        ("policy: {type: mlp, hidden: [64, 0]}", f"policy.hidden holds 0; it must be {SIZES}"),
        ("policy: {type: mlp, hidden: [[64]]}", f"policy.hidden holds a list; it must be {SIZES}"),
        ("policy: {type: cnn, channels: [1.5]}", f"policy.channels holds 1.5; it must be {SIZES}"),
        (
            "policy: {type: mlp, init: {type: random}}",
            "policy.init does not belong to policy.type mlp; it must be left out, or policy.type changed",
        ),
        (
            "{policy: {type: mlp}, critic: {step_size: 0.3}}",
            "critic.step_size does not belong to critic.type network; it must be left out, or critic.type changed",
        ),
        (
            "{policy: {type: mlp}, update: {max_grad_norm: off}}",
            "update.max_grad_norm is 'off'; it must be a number > 0 or never",
        ),
        ("run: {overwrite: yes}", "run.overwrite is 'yes'; it must be true or false"),
        ("run: {dir: 5}", "run.dir is 5; it must be a folder or null (in quotes, to make it text)"),
        ("search: 4", f"search is 4; it must be {KINDS}, or a mapping with such a kind"),
        ("search:", f"search is empty; it must be {KINDS}, or a mapping with such a kind"),
        ("critic: {type: neural}", "critic.type is 'neural'; it must be auto, exact, network, rollout or tabular"),
        ("critic: {type: [1]}", "critic.type is a list; it must be auto, exact, network, rollout or tabular"),
        ("critic: {type: null}", "critic.type is null; it must be auto, exact, network, rollout or tabular"),
        ("critic: {step_size: men}", "critic.step_size is 'men'; it must be a number in (0, 1] or mean"),
        ("critic: {method: {lambda: 2}}", "critic.method.lambda is 2; it must be a number in [0, 1]"),
        ("critic: {method: {type: td}}", "critic.method.type is 'td'; it must be monte_carlo or td_lambda"),
        (
            "critic: {samples: 3}",
            "critic.samples does not belong to critic.type tabular; it must be left out, or critic.type changed",
        ),
        ("critic: {method: {lamda: 1}}", "critic.method.lamda is unknown; did you mean critic.method.lambda?"),
        ("serach: {depth: 4}", "serach is unknown; did you mean search?"),
        ("search: {depht: 4}", "search.depht is unknown; did you mean search.depth?"),
        ("depth: 4", "depth is unknown; did you mean search.depth?"),
        ("xyz: 4", "xyz is unknown; `pgts train --help` lists all keys"),
        ("<<: {seed: 1}", "<< is unknown; `pgts train --help` lists all keys"),
        ("seed: 1\nseed: 2", "the key seed is given twice"),
        ("env: {kwargs: {n: 1, n: 2}}", "the key env.kwargs.n is given twice"),
        (
            "policy: {init: {type: biased, probability: 1.0}}",
            "policy.init.probability is 1, which policy.type softmax cannot represent (infinite logits); "
            "it must be below 1, or policy.type simplex",
        ),
        (
            "{policy: {type: softmax}, update: {type: projected}}",
            "update.type is projected, which needs policy.type simplex; policy.type is softmax",
        ),
        (
            "{policy: {type: simplex}, update: {type: softmax}}",
            "update.type is softmax, which needs policy.type softmax; policy.type is simplex",
        ),
        (
            "{policy: {type: simplex, init: {type: biased, probability: 1}}, update: {type: mirror, floor: never}}",
            "update.floor is never, so that a mirror step leaves probabilities of 0 at 0; "
            "a policy with policy.init.probability 1 would never move",
        ),
        (
            "{env: {observation_key: image}, policy: {type: softmax}}",
            "env.observation_key is image, a part of dictionary observations; "
            "policy.type softmax is a table of numbered states, it must be mlp or cnn",
        ),
        (
            "{policy: {type: cnn}, critic: {type: tabular}}",
            "critic.type is tabular, which needs numbered states; with policy.type cnn it must be network",
        ),
        (
            "{env: {observation_key: image}, policy: {type: mlp}, critic: {type: exact}}",
            "critic.type is exact, which needs numbered states; with env.observation_key image it must be network",
        ),
        (
            "{policy: {type: softmax}, critic: {type: network, network: {type: shared}}}",
            "critic.network.type is shared; policy.type softmax is a table, which has no network to share",
        ),
        (
            "{policy: {type: mlp}, critic: {network: {type: cnn}}}",
            "critic.network.type is cnn and policy.type is mlp; a cnn takes images, the others do not",
        ),
        (
            "{policy: {type: cnn}, critic: {network: {type: mlp}}}",
            "critic.network.type is mlp and policy.type is cnn; a cnn takes images, the others do not",
        ),
        (
            "{policy: {type: mlp}, estimator: {type: sampled}}",
            "search.depth is 4; with estimator.type sampled there is no lookahead, it must be 0",
        ),
        (
            "{policy: {type: mlp}, search: {depth: 0, kind: mcts}, estimator: {type: sampled}}",
            "search.kind is mcts; with estimator.type sampled there is no lookahead, it must be auto",
        ),
        (
            "{policy: {type: mlp}, search: {depth: 0, max_bytes: 9}, estimator: {type: sampled}}",
            "search.max_bytes is 9; with estimator.type sampled there is no lookahead, it must be 4294967296",
        ),
        (
            "{policy: {type: mlp}, search: {depth: 0, stop_at: 1}, estimator: {type: sampled}}",
            "search.stop_at is 1.0; with estimator.type sampled there is no lookahead, it must be null",
        ),
        (
            "{policy: {type: softmax}, search: {depth: 0}, estimator: {type: sampled}}",
            "estimator.type is sampled, which needs policy.type mlp or cnn; policy.type is softmax",
        ),
        (
            "{policy: {type: mlp}, search: {depth: 0}, estimator: {type: sampled}, update: {type: mirror}}",
            "update.type is mirror, which needs the advantages of all actions; estimator.type is sampled",
        ),
        (
            "{policy: {type: softmax}, update: {type: ppo}}",
            "update.type is ppo, which needs policy.type mlp or cnn; policy.type is softmax",
        ),
        (
            "{policy: {type: mlp}, update: {type: softmax}}",
            "update.type is softmax, which needs policy.type softmax; policy.type is mlp",
        ),
        (
            "{policy: {type: softmax}, update: {type: mirror, temperature: 2}}",
            "update.temperature is 2.0, which the mirror update of a table does not use; policy.type is softmax",
        ),
        (
            "{policy: {type: mlp}, update: {type: mirror, step_size: 2}}",
            "update.step_size is 2.0, which the mirror update of a network does not use; policy.type is mlp",
        ),
    ],
)
def test_a_wrong_value_is_named_with_its_line_its_key_and_what_is_required(
    mistakes: Callable[..., list[str]], content: str, mistake: str
) -> None:
    line = 1 + content.count("\n")
    assert mistakes(content) == [f"c.yaml:{line}: {mistake}"]


@pytest.mark.parametrize(
    ("arguments", "mistake"),
    [
        (["--search.depth", "-1"], "--search.depth is -1; it must be a whole number >= 0 or adaptive"),
        (["--search.depth=-1"], "--search.depth is -1; it must be a whole number >= 0 or adaptive"),
        (
            ["--search.depth", "[1"],
            "--search.depth: '[1': this is not YAML: expected ',' or ']', but got '<stream end>'",
        ),
        (
            ["--search.depth", "*a"],
            "--search.depth: '*a': anchors (&) and aliases (*) are not allowed; write the value out",
        ),
        (["--seed="], "--seed is empty; it must be a whole number >= 0"),
        (["--name="], "--name is empty; it must be letters, digits, '.', '_', '-', at most 100"),
        (["--search.depth"], "--search.depth needs a value: a whole number >= 0 or adaptive"),
        (["--search.depth", "--run.overwrite"], "--search.depth needs a value: a whole number >= 0 or adaptive"),
        (["--run.overwrite", "no"], "--run.overwrite is 'no'; it must be true or false"),
        (["--run.dir", "a\udcff"], "--run.dir is 'a\\udcff'; it must be a folder or null"),
        (["--search.depht", "4"], "--search.depht is unknown; did you mean --search.depth?"),
        (["--depth", "4"], "--depth is unknown; did you mean --search.depth?"),
        (["--search.depth.more", "4"], "--search.depth.more is unknown; did you mean --search.depth?"),
        (["--env.", "4"], "--env. is unknown; did you mean --env?"),
        (["--", "4"], "-- is unknown; `pgts train --help` lists all keys"),
        (["depth"], "'depth' belongs to no option; write --KEY VALUE"),
        (["--seed", "1", "2"], "'2' belongs to no option; write --KEY VALUE"),
        (["--critic", "{type: exact, target: x}"], "--critic: critic.target is 'x'; it must be v or q"),
        (["--critic", "{type: exact, type: exact}"], "--critic: the key type is given twice"),
        (
            ["--critic.type", "exact", "--critic.method.lambda", "0.4"],
            "--critic.method.lambda: critic.method does not belong to critic.type exact; it must be left out, "
            "or critic.type changed",
        ),
        (
            ["--policy.type", "simplex", "--update.type", "softmax"],
            "--update.type: update.type is softmax, which needs policy.type softmax; policy.type is simplex",
        ),
        (["--env.kwargs.n"], "--env.kwargs.n needs a value: a plain value"),
        (["--env.kwargs.id", "x"], "--env.kwargs.id: env.kwargs must not have the key id: env.id sets it"),
    ],
)
def test_a_wrong_argument_is_named_with_its_flag_and_what_is_required(
    mistakes: Callable[..., list[str]], arguments: list[str], mistake: str
) -> None:
    assert mistakes(None, *arguments) == [mistake]


def test_all_mistakes_are_reported_at_once_in_the_order_of_lines_then_flags(
    mistakes: Callable[..., list[str]],
) -> None:
    content = (
        "update: {type: projected, step_size: 0}\nnam: x\nsearch: {depth: -1}\nseed: 1\nseed: 2\ncritic: {type: x}\n"
    )
    assert mistakes(content, "--sed", "3", "--threads", "0", "stray") == [
        "c.yaml:1: update.step_size is 0; it must be a number > 0",
        "c.yaml:2: nam is unknown; did you mean name?",
        "c.yaml:3: search.depth is -1; it must be a whole number >= 0 or adaptive",
        "c.yaml:5: the key seed is given twice",
        "c.yaml:6: critic.type is 'x'; it must be auto, exact, network, rollout or tabular",
        "--sed is unknown; did you mean --seed?",
        "'stray' belongs to no option; write --KEY VALUE",
        "--threads is 0; it must be a whole number in [1, 1024]",
    ]


def test_flags_are_checked_even_if_the_file_cannot_be_read_but_not_against_what_it_might_say(
    mistakes: Callable[..., list[str]],
) -> None:
    found = mistakes("[", "--threads", "0", "--update.type", "projected", "--critic.samples", "3")
    assert len(found) == 2
    assert found[0].startswith("c.yaml:1: this is not YAML")
    assert found[1] == "--threads is 0; it must be a whole number in [1, 1024]"


def test_a_flood_of_mistakes_is_cut(mistakes: Callable[..., list[str]]) -> None:
    found = mistakes("\n".join(f"key_{n}: 1" for n in range(MAX_MISTAKES + 7)))
    assert len(found) == MAX_MISTAKES + 1
    assert found[-1] == "and 7 more"


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


def test_a_section_without_type_has_the_default_one() -> None:
    horizon = load(None, ["--rollout.horizon.length", "7"]).rollout.horizon
    assert horizon == FixedHorizon(length=7)


def test_a_configuration_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Config().seed = 1


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_configuration_is_valid_and_says_what_it_shows(path: Path) -> None:
    config = load(path)
    assert path.read_text().startswith("# ")
    assert config.name == path.stem
    if config.env.id.startswith("MiniGrid-"):
        pytest.importorskip("minigrid", exc_type=ImportError)
    made = EnvSource.of(config.env.id, kwargs=config.env.kwargs).make_one()
    assert made.spec is not None
    assert made.spec.id == config.env.id
    made.close()


def test_the_shipped_configurations_are_those_of_the_paper_and_of_gymnasium() -> None:
    own = {"deep_sea", "deep_sea_bsuite", "deep_sea_stochastic", "grid", "ladder", "random", "tightrope"}
    toy_text = {"cliff_walking", "frozen_lake_4x4", "frozen_lake_8x8", "taxi"}
    others = toy_text | {"acrobot", "cartpole", "mountain_car", "door_key"}
    assert {path.stem for path in SHIPPED} == own | others
    assert own == {path.stem for path in SHIPPED if load(path).env.id.startswith("pgts/")}


@pytest.mark.parametrize("path", [None, *SHIPPED], ids=lambda path: path.stem if path else "defaults")
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
    "true or false or null": st.none() | st.booleans(),
    "a whole number >= 1, or a list of such and null, one for each level": st.sampled_from([1, 7, [3, None]]),
    "a whole number >= 0 or null": st.none() | st.integers(0, 2**63 - 1),
    "a number >= 0 or null": st.none() | st.floats(0, allow_infinity=False),
    "a number in [0, 1]": st.floats(0, 1),
    "a number in (0, 1]": st.floats(0, 0.5, exclude_min=True),
    "a number in [0, 1] or null": st.none() | st.floats(0, 1),
    "a number in (0, 1] or mean": st.just("mean") | st.floats(0, 1, exclude_min=True),
    "true or false": st.booleans(),
    "a folder or null": st.none() | st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), min_size=1),
    "the id of a Gymnasium environment": st.from_regex(r"[A-Za-z0-9_.:/-]{1,20}", fullmatch=True),
    "letters, digits, '.', '_', '-', at most 100": st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", fullmatch=True),
    "cpu, cuda or cuda:N": st.sampled_from(["cpu", "cuda", "cuda:3"]),
    "a number > 0 or null": st.none() | st.floats(0, exclude_min=True, allow_infinity=False),
    "a number > 0 or never": st.just("never") | st.floats(0, exclude_min=True, allow_infinity=False),
    "a number > 0 or never or null": st.sampled_from([None, "never", 0.25]),
    "a number >= 0": st.floats(0, allow_infinity=False),
    "rms or none or null": st.sampled_from([None, "rms", "none"]),
    "adam or sgd or null": st.sampled_from([None, "adam", "sgd"]),
    "occupancy, visits or uniform or null": st.sampled_from([None, "occupancy", "visits", "uniform"]),
    "a key of dictionary observations or null": st.none() | st.from_regex(r"[A-Za-z0-9_.:-]{1,20}", fullmatch=True),
    SIZES: st.lists(st.integers(1, 65536), max_size=16),
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
    networks = ["own", "mlp"] if is_table else ["own", "shared"] + [policy] * (policy != "auto")
    types["critic.network.type"] = draw(st.sampled_from(networks))
    types["critic.type"] = "network" if policy == "cnn" else types["critic.type"]
    needs_all = is_table or types["update.type"] in ("mirror", "cmpo")
    types["estimator.type"] = "lookahead" if needs_all else types["estimator.type"]
    if types["estimator.type"] == "sampled" and types["critic.type"] in ("exact", "rollout"):
        types["critic.type"] = "network"
    for option in OPTIONS:
        if option.exists(types):
            words = st.sampled_from(_words(option))
            given[option.key] = types.get(option.key) or draw(SAMPLES.get(option.requirement, words))
    if is_table or types["critic.type"] != "network":
        given["env.observation_key"] = None
    if types["update.type"] == "mirror":
        heeded = {"type", *Mirror.standing("tables" if is_table else "networks")}
        ignored = [key for key in given if key.startswith("update.") and key.removeprefix("update.") not in heeded]
        given |= dict.fromkeys(ignored)
    if given["eval.every"] is None:
        given |= {"eval.stop_at_return": None, "eval.keep_best": False}
    if given["search.depth"] != "adaptive":
        given["search.max_depth"] = given["search.tolerance"] = None
    if types["critic.type"] == "network" and (given["critic.polyak"] < 1 or given["critic.target_period"] > 1):
        given["critic.fresh_targets"] = None
    if given["search.kind"] == "mcts":
        given |= {"search.exploration": None} if given["search.rule"] == "gumbel" else {"search.prior": "uniform"}
        given |= {"search.merge": False} if given["search.backup"] == "mean" else {}
    if types["estimator.type"] == "sampled":
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


@pytest.mark.parametrize("key", ["max_depth", "tolerance"])
def test_what_only_an_adaptive_depth_heeds_is_refused_beside_a_number(key: str) -> None:
    assert load(None, ["--search.depth", "adaptive", f"--search.{key}", "1"]).search.depth == "adaptive"
    with pytest.raises(ConfigError, match=f"search.{key} is 1.*, which only search.depth adaptive uses"):
        load(None, ["--search.depth", "4", f"--search.{key}", "1"])


@pytest.mark.parametrize("kind", ["auto", "expectimax", "sampled", "mcts"])
def test_a_file_of_version_0_1_with_null_for_what_another_kind_of_search_has_means_what_it_did(
    kind: str, tmp_path: Path
) -> None:
    nulls = {"max_width": None, "samples": None, "share": None, "simulations": None, "merge": None}
    text = strict_yaml.dump({"search": {"depth": 2, "kind": kind} | nulls})
    (tmp_path / "c.yaml").write_text(text)
    assert load(tmp_path / "c.yaml") == load(None, ["--search.depth", "2", "--search.kind", kind])
    with pytest.raises(ConfigError, match=r"--search.best is unknown"):
        load(tmp_path / "c.yaml", ["--search.best", "null"])


@pytest.mark.parametrize(("key", "value"), [("stop_at_return", 0.5), ("stop_at_return", 0.0), ("keep_best", True)])
def test_what_only_evaluations_during_training_heed_is_refused_without_them(key: str, value: Any) -> None:
    word = str(value).lower()
    assert getattr(load(None, ["--eval.every", "100", f"--eval.{key}={word}"]).eval, key) == value
    with pytest.raises(ConfigError, match=f"eval.{key} is {word}, which needs .*; eval.every is null"):
        load(None, [f"--eval.{key}={word}"])


def test_every_default_is_the_one_that_the_help_names() -> None:
    defaults = Config().model_dump(by_alias=True)
    types = {key: _look_up(defaults, key) for key in _leaves(defaults) if key.endswith(".type")}
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
    observation_space=spaces.Box(0, 255, (7, 7, 3), np.uint8), num_actions=2, device=torch.device("cpu")
)
"""The world of a numbered environment, and as much of one with images as parts ask for."""

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
    ["--policy.type", "mlp", "--search.depth", "0", "--estimator.type", "sampled", "--estimator.lambda", "0.9"],
]
"""Command lines that together name every type there is."""


def made(arguments: list[str]) -> tuple[Policy, Critic, Update]:
    """What the library makes of a configuration."""
    config = load(None, arguments)
    world: Any = PICTURED if config.policy.type == "cnn" else NUMBERED
    options = build.chosen(read(config.arguments()), world)
    policy = build.make_policy(options.policy, world, seed=0)
    critic = build.make_critic(options.critic, world, policy, options.estimator, seed=0)
    build.make_search(options.search, NUMBERED)
    return policy, critic, build.make_update(options.update, policy)


@pytest.mark.parametrize("arguments", PARTS, ids=" ".join)
def test_the_library_builds_what_is_configured(arguments: list[str]) -> None:
    policy, critic, update = made(arguments)
    config = load(None, arguments)
    assert critic.target == getattr(config.critic, "target", "v")
    assert policy.options == config.policy or config.policy.type == "auto"
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


@pytest.mark.parametrize("path", [None, *SHIPPED], ids=lambda path: path.stem if path else "defaults")
def test_the_arguments_of_a_configuration_are_its_options(path: Path | None) -> None:
    config = load(path)
    options = read(config.arguments())
    for name in ("policy", "rollout", "search", "estimator", "update"):
        assert getattr(options, name) == getattr(config, name)
    assert config.arguments().keys() == signature(PGTS).parameters.keys()


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


CHARACTERS = [chr(n) for n in range(1, 300)]


def _mutated(text: str, generator: random.Random) -> str:
    """`text` after one to five small accidents."""
    for _ in range(generator.randint(1, 5)):
        at, end = sorted(generator.choices(range(len(text) + 1), k=2))
        insert = generator.choice(
            [*"{}[]:,-?&*!|>%@`'\"#\n\t \\0~.", "---\n", "null", "1e9", "\x00", "\ud7ff", "é", "!!int "]
        )
        match generator.randrange(4):
            case 0:
                text = text[:at] + insert + text[at:]
            case 1:
                text = text[:at] + text[min(end, at + 5) :]
            case 2:
                text = text[:at] + insert * generator.choice([2, 40]) + text[at:]
            case _:
                text = text[:at] + text[end : end + 40] + text[at:]
    return text


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.fault("any other damaged text")
@pytest.mark.parametrize("count", [400, pytest.param(10_000, marks=pytest.mark.long)])
def test_damaged_files_give_a_configuration_or_clear_lines_in_less_than_a_second_and_nothing_else(
    count: int, tmp_path: Path
) -> None:
    generator = random.Random(0)
    texts = [path.read_text().partition("\n")[2] for path in SHIPPED] + [dump(Config())]
    outcome = {"valid": 0, "refused": 0}
    slowest = 0.0
    for n in range(count):
        text = "".join(generator.choices(CHARACTERS, k=30)) if n % 8 == 0 else ""
        text = text or _mutated(generator.choice(texts), generator)
        path = tmp_path / "c.yaml"
        path.write_bytes(text.encode("utf-8"))
        started = time.process_time()
        try:
            load(path)
            outcome["valid"] += 1
        except ConfigError as error:
            outcome["refused"] += 1
            for line in str(error).splitlines():
                assert line.isprintable()
                assert line.startswith((f"{path}:", "and "))
        slowest = max(slowest, time.process_time() - started)
    assert min(outcome.values()) >= 5
    assert slowest < 1
    if count >= 10_000:
        reliability.record("fuzzed configuration texts", **outcome, slowest_seconds=round(slowest, 2))


def _mistakes_in(argument: str) -> tuple[str, ...]:
    try:
        load(None, [argument])
    except ConfigError as error:
        return error.mistakes
    return ()


@pytest.mark.fault("any other damaged text")
@given(st.text(max_size=60))
def test_any_argument_gives_a_configuration_or_clear_lines(text: str) -> None:
    for argument in (text, f"--{text}", f"--search.depth={text}", f"--env.kwargs={text}", f"--env.kwargs.n={text}"):
        assert all(line.isprintable() for line in _mistakes_in(argument))


@pytest.mark.fault("NaN or infinity in a configuration")
def test_numbers_that_are_not_finite_are_refused_wherever_they_stand() -> None:
    for key in ("env.gamma", "update.step_size", "critic.step_size", "critic.method.lambda", "env.kwargs.x"):
        for value in (".nan", ".inf", "1e999", "-.inf"):
            with pytest.raises(ConfigError):
                load(None, [f"--{key}", value])
    assert math.isfinite(load(None, ["--update.step_size", "1e300"]).update.step_size)
