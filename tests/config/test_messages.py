"""What a configuration file or a flag is refused for, and in which words."""

import math
import pickle
import random
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pgts_torch.config import Config, ConfigError, dump, load
from pgts_torch.config.loading import MAX_BYTES, MAX_MISTAKES
from tests import reliability
from tests.config.shipped import SHIPPED


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


def _no_character() -> str:
    """What Python says of a character of this number, which depends on its version."""
    with pytest.raises((OverflowError, ValueError)) as caught:
        chr(0xFFFFFFFF)
    return str(caught.value)


SIZES = "a list of at most 16 whole numbers in [1, 65536]"
KINDS = "auto, expectimax, mcts or sampled"
SCHEDULE = "or linear(FROM, TO, STEPS) or cosine(FROM, TO, STEPS) by environment steps"


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
        ('name: "\\UFFFFFFFF"', f"c.yaml: this is not YAML: {_no_character()}"),
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
        ("seed: -1", "seed is -1; it must be a whole number >= 0 or null"),
        ("total_steps: 1e6", "total_steps is 1e6; it must be a whole number >= 1 (write 1000000)"),
        (
            "total_steps: 9223372036854775808",
            "total_steps is 9223372036854775808; it must be a whole number >= 1 and below 2**63",
        ),
        ("seed: true", "seed is true; it must be a whole number >= 0 or null"),
        ("total_steps:", "total_steps is empty; it must be a whole number >= 1"),
        ("seed: {a: 1}", "seed is a mapping; it must be a whole number >= 0 or null"),
        ("threads: 2000", "threads is 2000; it must be a whole number in [1, 1024]"),
        (
            "name: 010",
            "name is 010; it must be letters, digits, '.', '_', '-', at most 100 (in quotes, to make it text)",
        ),
        ('name: "a\\nb"', "name is 'a\\nb'; it must be letters, digits, '.', '_', '-', at most 100"),
        ("device: gpu", "device is 'gpu'; it must be cpu, cuda or cuda:N"),
        ("env: {gamma: 1.5}", "env.gamma is 1.5; it must be a number in [0, 1] or null"),
        ("env: {gamma: .nan}", "env.gamma is .nan; it must be a number in [0, 1] or null"),
        ("env: {id: }", "env.id is empty; it must be the id of a Gymnasium environment"),
        ("env: {kwargs: 3}", "env.kwargs is 3; it must be a mapping"),
        ("env: {kwargs: {n: [1, .nan]}}", "env.kwargs holds nan; numbers must be finite"),
        ("env: {kwargs: {1: 2}}", "env.kwargs has the key '1', which cannot be the name of an argument"),
        ("env: {kwargs: {gamma: 0.9}}", "env.kwargs must not have the key gamma: env.gamma sets it"),
        ("update: {step_size: 0}", f"update.step_size is 0; it must be a number > 0, {SCHEDULE} or null"),
        (
            "update: {type: adam}",
            "update.type is 'adam'; it must be auto, cmpo, gradient, mirror, mpo, ppo, projected or softmax",
        ),
        (
            "policy: {type: resnet}",
            "policy.type is 'resnet'; it must be auto, cnn, gaussian, mlp, module, nature_cnn, simplex or softmax",
        ),
        (
            "policy: resnet",
            "policy.type is 'resnet'; it must be auto, cnn, gaussian, mlp, module, nature_cnn, simplex or softmax",
        ),
        ("policy: {type: mlp, hidden: 64}", f"policy.hidden is 64; it must be {SIZES}"),
        ("policy: {type: mlp, hidden: [64, 0]}", f"policy.hidden holds 0; it must be {SIZES}"),
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
        ("critic: {type: [1]}", "critic.type is a list; it must be auto, exact, network, rollout or tabular"),
        ("critic: {type: null}", "critic.type is null; it must be auto, exact, network, rollout or tabular"),
        ("critic: {step_size: men}", "critic.step_size is 'men'; it must be a number in (0, 1] or mean"),
        ("critic: {method: {lambda: 2}}", "critic.method.lambda is 2; it must be a number in [0, 1]"),
        (
            "critic: {samples: 3}",
            "critic.samples does not belong to critic.type tabular; it must be left out, or critic.type changed",
        ),
        ("serach: {depth: 4}", "serach is unknown; did you mean search?"),
        ("search: {depht: 4}", "search.depht is unknown; did you mean search.depth?"),
        ("depth: 4", "depth is unknown; did you mean search.depth?"),
        ("search: {type: sampled}", "search.type is unknown; did you mean search.kind?"),
        ("policy: {kind: mlp}", "policy.kind is unknown; did you mean policy.type?"),
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
            "{policy: {type: simplex, init: {type: biased, probability: 1}}, update: {type: mirror, floor: never}}",
            "update.floor is never, so that a mirror step leaves probabilities of 0 at 0; "
            "a policy with policy.init.probability 1 would never move",
        ),
        (
            "{policy: {type: cnn}, critic: {type: tabular}}",
            "critic.type is tabular, which needs numbered states; with policy.type cnn it must be network",
        ),
        (
            "{policy: {type: softmax}, critic: {type: network, network: {type: shared}}}",
            "critic.network.type is shared; policy.type softmax is a table, which has no network to share",
        ),
        (
            "{policy: {type: softmax}, critic: {type: network, network: {type: cnn}}}",
            "critic.network.type is cnn, which takes images; policy.type is softmax, a table of numbered states",
        ),
        (
            "{policy: {type: mlp}, estimator: {type: sampled}}",
            "search.depth is 4; with estimator.type sampled there is no lookahead, it must be 0",
        ),
        (
            "{policy: {type: mlp}, search: {depth: 0, stop_at: 1}, estimator: {type: sampled}}",
            "search.stop_at is 1.0; with estimator.type sampled there is no lookahead, it must be null",
        ),
        (
            "{policy: {type: softmax}, search: {depth: 0}, estimator: {type: sampled}}",
            "estimator.type is sampled, which needs policy.type mlp, cnn, module or gaussian; policy.type is softmax",
        ),
        (
            "{policy: {type: mlp}, search: {depth: 0}, estimator: {type: sampled}, update: {type: mirror}}",
            "update.type is mirror, which needs the advantages of all actions; estimator.type is sampled",
        ),
        (
            "{policy: {type: softmax}, update: {type: ppo}}",
            "update.type is ppo, which needs policy.type mlp, cnn, module or gaussian; policy.type is softmax",
        ),
        (
            "{policy: {type: mlp}, search: {depth: 0}, estimator: {type: sampled}, critic: {target: q}}",
            "critic.type is network and critic.target q; sampled advantages use values learned from earlier episodes, "
            "so estimator.type sampled needs critic.type tabular or network, and critic.target v",
        ),
        (
            "search: {depth: 4, tolerance: 1}",
            "search.tolerance is 1.0, which only search.depth adaptive uses; search.depth is 4",
        ),
        (
            "eval: {stop_at_return: 0}",
            "eval.stop_at_return is 0.0, which needs evaluations during training; eval.every is null",
        ),
        (
            "eval: {keep_best: true}",
            "eval.keep_best is true, which needs evaluations during training; eval.every is null",
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
        (
            ["--search.depth", "[1"],
            "--search.depth: '[1': this is not YAML: expected ',' or ']', but got '<stream end>'",
        ),
        (
            ["--search.depth", "*a"],
            "--search.depth: '*a': anchors (&) and aliases (*) are not allowed; write the value out",
        ),
        (["--total_steps="], "--total_steps is empty; it must be a whole number >= 1"),
        (["--search.depth", "--run.overwrite"], "--search.depth needs a value: a whole number >= 0 or adaptive"),
        (["--run.overwrite", "no"], "--run.overwrite is 'no'; it must be true or false"),
        (["--run.dir", "a\udcff"], "--run.dir is 'a\\udcff'; it must be a folder or null"),
        (["--depth", "4"], "--depth is unknown; did you mean --search.depth?"),
        (["--search.depth.more", "4"], "--search.depth.more is unknown; did you mean --search.depth?"),
        (["--env.", "4"], "--env. is unknown; did you mean --env?"),
        (["--", "4"], "-- is unknown; `pgts train --help` lists all keys"),
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
        f"c.yaml:1: update.step_size is 0; it must be a number > 0, {SCHEDULE}",
        "c.yaml:2: nam is unknown; did you mean name?",
        "c.yaml:3: search.depth is -1; it must be a whole number >= 0 or adaptive",
        "c.yaml:5: the key seed is given twice",
        "c.yaml:6: critic.type is 'x'; it must be auto, exact, network, rollout or tabular",
        "--sed is unknown; did you mean --seed?",
        "'stray' belongs to no option; write --KEY VALUE",
        "--threads is 0; it must be a whole number in [1, 1024]",
    ]


def test_flags_are_checked_where_the_file_cannot_be_read_but_not_against_its_values(
    mistakes: Callable[..., list[str]],
) -> None:
    found = mistakes("[", "--threads", "0", "--update.type", "projected", "--critic.samples", "3")
    assert len(found) == 2
    assert found[0].startswith("c.yaml:1: this is not YAML")
    assert found[1] == "--threads is 0; it must be a whole number in [1, 1024]"


def test_a_long_list_of_mistakes_is_cut(mistakes: Callable[..., list[str]]) -> None:
    found = mistakes("\n".join(f"key_{n}: 1" for n in range(MAX_MISTAKES + 7)))
    assert len(found) == MAX_MISTAKES + 1
    assert found[-1] == "and 7 more"


CHARACTERS = [chr(n) for n in range(1, 300)]


def _mutated(text: str, generator: random.Random) -> str:
    """`text` after one to five small changes."""
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
    texts = [path.read_text().partition("\n")[2] for path in SHIPPED.values()] + [dump(Config())]
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


def test_mistakes_arrive_whole_from_another_process():
    with pytest.raises(ConfigError) as raised:
        load(arguments=["--sed", "1", "--serach", "2"])
    arrived = pickle.loads(pickle.dumps(raised.value))
    assert arrived.mistakes == raised.value.mistakes
    assert str(arrived) == str(raised.value)
