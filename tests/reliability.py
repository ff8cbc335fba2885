"""What can go wrong, what happens then, and which tests make it happen.

`python -m tests.reliability` writes docs/reliability.md from FAULTS, the `@pytest.mark.fault` marks of the tests, and
the results that the long forms of tests have recorded.
"""

import ast
import functools
import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCUMENT = ROOT / "docs" / "reliability.md"
RESULTS = ROOT / "tests" / "long_results.json"

ONE_LINE = "one line for each mistake, exit code 2, nothing written"
NAMED = "refused by name, exit code 2"
DAMAGED = "noticed; the checkpoint before leads to the same bits, with a warning; `--strict-resume` refuses"
STOPPED = "stops before the policy moves; checkpoints stay, `failure.json`, exit code 1"

UNUSED = "not used: the next model is, or the refusal names what is overridden or the step that contradicts it"

CONTRADICTED = "stops before the policy moves; state, action, both answers named, `failure.json`, exit code 2"

FAULTS: dict[str, dict[str, str]] = {
    "Configuration": {
        "unknown key": ONE_LINE,
        "wrong type": ONE_LINE,
        "value out of range": ONE_LINE,
        "NaN or infinity in a configuration": ONE_LINE,
        "duplicate keys": ONE_LINE,
        "aliases": ONE_LINE,
        "nesting 3,000 deep": ONE_LINE,
        "integer of 5,000 digits": ONE_LINE,
        "python tags": ONE_LINE,
        "not UTF-8": ONE_LINE,
        "empty file": ONE_LINE,
        "missing file": ONE_LINE,
        "directory in place of a file": ONE_LINE,
        "any other damaged text": "a valid configuration or clear lines, in less than a second",
    },
    "Environment": {
        "unknown environment": NAMED,
        "deprecated environment": NAMED,
        "missing extra": "the `pip install` that brings it, exit code 2",
        "no time limit and no horizon": "the guard of the geometric horizon, or of evaluations, ends it",
        "autoreset in the next step": "refused with the mode that works",
        "environment that hangs": "after `run.timeout` one line says where, exit code 75; resumed, the same bits",
        "environment raises an error": "environment, step and seed are named, `failure.json`, exit code 2",
        "a table of transitions that is not that of step and reset": UNUSED,
        "environments that differ, or differ from the instance that was given": "the attribute is named",
        "a subclass with a state of its own beside the snapshots of its family": "attribute and remedy are named",
        "get_state or set_state that does not hold what step reads or changes": "refused in the words of `check-model`",
        "a wrapper that has a step of its own, a memory, or draws": "refused by its name; stateless ones are applied",
        "environment without a model": "the two methods that it lacks are named, exit code 2",
        "environment that contradicts its model": CONTRADICTED,
        "probabilities that are not the environment's": f"off by more than 2 %: {CONTRADICTED}; else a warning",
        "environment that draws from global generators": "seeded, put back and said; a lookahead refuses such a step",
        "environment that truncates its own episodes": "never stepped past it; the critic's value stands there",
        "environment leaves the process, or raises what cannot be printed": "as any other error of the environment",
        "environment raises an error in close": "a warning",
        "observation that changes inside the lookahead": "state, action, observation and declared space are named",
        "grad switched off": "trains with the same bits",
        "reward that is not one number": "environment, step, seed and its shape are named, `failure.json`, exit code 2",
        "discount outside [0, 1]": "environment, step and seed are named at every depth, `failure.json`, exit code 2",
        "torch.set_default_dtype(torch.float64)": "trains with the same bits",
        "discount of another meaning in info": "ignored unless the environment declares that it names discounts",
    },
    "MDP files": {
        "rows that do not sum to one": NAMED,
        "negative probability": NAMED,
        "NaN in an MDP": NAMED,
        "wrong shape": NAMED,
        "pickled payload in an MDP": "refused, not run",
        "damaged MDP file": "refused, or read as an MDP",
        "npz file that unpacks to more than memory": "refused with its size before anything is unpacked",
        "rows rounded when they were stored": "divided by their sums within 1e-5, refused beyond",
        "an order of states and actions that nothing tells": "refused unless the order is said",
    },
    "Numbers": {
        "observation that is not finite": STOPPED,
        "reward that is not finite": STOPPED,
        "discount that is not finite": STOPPED,
        "reward so large that what is learned from it is no number": STOPPED,
        "rewards of an MDP whose values are no numbers": "refused, with how large they may be",
        "value that is not finite": STOPPED,
        "lookahead that is not finite": STOPPED,
        "probability that is not finite": STOPPED,
        "loss that is not finite": STOPPED,
        "gradient that is not finite": STOPPED,
        "step that overflows": "taken back: policy and optimiser as before",
    },
    "Learning": {
        "rewards in another unit, tables": "times 2^k, every bit of the policy is the same",
        "a constant in all rewards of a continuing task, tables": "moves no policy",
        "rewards or actions that are all equal, tables": "rounding is no step: every bit of the policy stays",
        "rewards in another unit, networks": "times 2^k, every bit of the policy is the same",
        "a policy that hardly moves": "the summary says so, with what to change",
        "a policy that does not converge": "the summary says so, with what to change",
        "a greedy policy that is worse than sampled actions": "the summary says so",
    },
    "Proofs": {
        "an episode that begins in one of several states": "a proof is over all start states, not over sampled ones",
        "no largest reward is known": "stop_at and adaptive depth are refused, with what to set: env.reward_range",
        "a reward outside reward_range": "training stops before the policy is moved by it, exit code 2",
    },
    "Memory": {
        "lookahead of too many nodes": "refused before the model is queried, with the number and what to set",
        "lookahead larger than memory": "refused before the model is queried, with the number and what to set",
    },
    "Saved models": {
        "flipped bits and missing ends of a saved model": "refused, none accepted",
        "pickled payload in a saved model": "refused, not run",
        "foreign content in a saved model": "refused",
        "saved file that names a module": "refused, and nothing imported, without `--trust-imports`: see SECURITY.md",
        "saved state that no model can be in": "refused by the name of its part; the model is as before",
    },
    "Checkpoints": {
        "flipped bit in a checkpoint": DAMAGED,
        "truncated checkpoint": DAMAGED,
        "last checkpoint missing": "the checkpoint before leads to the same bits",
        "checkpoints mixed up": DAMAGED,
        "damaged last checkpoint": DAMAGED,
        "malicious pickle in a checkpoint": "refused, not run",
        "checkpoint of another format": NAMED,
        "another configuration at resume": "refused key by key, exit code 2, nothing lost",
        "another shape at resume": "refused by the name of the tensor, exit code 2, nothing lost",
        "other versions at resume": "a warning names each; `--strict-resume` refuses",
        "lost metrics": NAMED + "; also where they were changed at equal length",
        "all checkpoints gone": NAMED + "; the run does not start from the beginning",
        "checkpoint with impossible values": NAMED,
        "best model missing or damaged": "a warning; the run ends with one; `--strict-resume` refuses",
        "events missing or damaged": "rebuilt from the metrics, with a warning; `--strict-resume` refuses",
        "disk full": "one line, exit code 2; what was saved stays, and the run goes on once there is room",
        "read-only folder": NAMED,
        "kill while a checkpoint is written": "the one before is intact",
    },
    "Folders": {
        "project folder as run folder": "left as it is, also with `--run.overwrite`; nothing written, exit code 2",
        "files of the user in a run folder": "never touched; one line names them where a run starts from the beginning",
        "run of version 0.1": "refused by version and left as it is; so are its saved models",
        "something else under the name of a file of the run": NAMED + "; links and pipes are not followed",
        "something else in place of a run folder": NAMED,
        "run folder replaced meanwhile": "the run ends with one line, nothing is written there, exit code 2",
        "edited configuration of a run": "kept where it means the same, else refused; never overwritten",
        "damaged mark of a run folder": NAMED + "; nothing is removed",
        "two runs in the same second": "each has a folder of its own",
        "lock that is a symbolic link": NAMED + "; what it leads to is not emptied",
        "file of the user under the name of an output": "refused by name before any work; only our own are replaced",
        "folder of the user as an output": "refused by name, nothing written; files of the user in ours are named",
    },
    "Processes": {
        "kill at any moment": "started again, the run ends with the bits of one that was never killed",
        "tuning killed at any moment": "the same command ends as if it had not been; no trial counts twice",
        "SIGTERM": "the iteration is finished and saved, exit code 143",
        "Ctrl-C": "the iteration is finished and saved, exit code 130",
        "second Ctrl-C": "the process ends at once, exit code 130; the last checkpoint leads to the same bits",
        "closed terminal": "as after SIGTERM, exit code 129; under `nohup` the run goes on",
        "second process in a run folder": "told the id of the first, exit code 2",
        "finished run": "says so, exit code 2; `--run.overwrite` starts from the beginning",
        "closed output": "the run goes on and is whole",
        "full output": "the run goes on and is whole, exit code 0 and a warning; of other commands exit code 2",
        "pipe in place of a file": NAMED + "; it is not waited for",
        "name of more than 255 bytes": NAMED,
        "letters that the locale lacks": NAMED,
        "damaged summary in a sweep": NAMED,
        "reader that leaves early": "exit code 141, no traceback",
        "no terminal": "plain lines in place of a progress bar",
        "C locale": "as in any other",
        "TensorBoard missing": "one line that says what to do, nothing written; `run.tensorboard: false` trains",
    },
    "Diagnostics": {
        "evaluation and logging": "on or off, the trained bits are the same",
        "rendering": "on or off, the trained bits are the same",
    },
    "Several processes": {
        "lost rank": "the others end with exit code 75; the same command goes on and ends with the same bits",
        "rank that hangs": "after `run.timeout` one line names it and says where; all end with exit code 75",
        "launcher killed": "the processes notice, finish the iteration, save and end; the same command goes on",
        "other world size at resume": "refused with both numbers, exit code 2; `--any-world-size` goes on",
    },
}
"""By group: each fault, and what happens then."""


@functools.cache
def marked() -> dict[str, list[str]]:
    """The tests of each fault that is named in a mark, as path::name, by the text of the test files."""
    found = defaultdict[str, list[str]](list)
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                for fault in _faults_of(node):
                    found[fault].append(f"{path.relative_to(ROOT)}::{node.name}")
    return found


def _faults_of(function: ast.FunctionDef) -> Iterator[str]:
    for decorator in function.decorator_list:
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.fault":
            yield from (ast.literal_eval(name) for name in decorator.args)


def document() -> str:
    """The text of docs/reliability.md."""
    tests = marked()
    lines = [
        "# What can go wrong",
        "",
        "Each fault below is made to happen by the tests beside it. `python -m tests.reliability` writes this page",
        "from the marks of the tests; a test compares it with them.",
    ]
    for group, faults in FAULTS.items():
        lines += ["", f"## {group}", "", "| fault | what happens | test |", "|---|---|---|"]
        for fault, behaviour in faults.items():
            links = "<br>".join(f"[{_sentence(test)}](../{test.partition('::')[0]})" for test in tests[fault])
            lines.append(f"| {fault} | {behaviour} | {links} |")
    lines += [
        "",
        "## Long forms",
        "",
        "`pytest -m long` runs the long forms of some of these tests and records what came of them:",
        "",
        "| what | result |",
        "|---|---|",
    ]
    for name, result in sorted(json.loads(RESULTS.read_text(encoding="utf-8")).items()):
        lines.append(f"| {name} | {_listing(result)} |")
    return "\n".join(lines) + "\n"


def _sentence(test: str) -> str:
    return test.partition("::test_")[2].replace("_", " ")


def _listing(result: dict[str, float]) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in result.items())


def record(name: str, **result: float) -> None:
    """Keep what the long form of a test found, and put it on the page."""
    results = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    RESULTS.write_text(json.dumps(results | {name: result}, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    write()


def write() -> None:
    """Write the page."""
    DOCUMENT.write_text(document(), encoding="utf-8")


if __name__ == "__main__":
    write()
