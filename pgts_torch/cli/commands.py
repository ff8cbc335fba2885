"""The subcommands of `pgts`, a function each."""

import argparse
import json
import shlex
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from pgts_torch.cli.arguments import (
    WIDTH,
    Parser,
    choice_of,
    command_name,
    describe_options,
    env_scale,
    file_path,
    film_path,
    html_file,
    json_object,
    listed,
    output_folder,
    path_kind,
    positive,
    print_values,
    run_folder,
    unit_interval,
    whole,
)
from pgts_torch.cli.terminal import print_kept, rank
from pgts_torch.config import Config, dump, load
from pgts_torch.experiment.ownership import SUMMARY_FILE
from pgts_torch.options.schema import schema_of
from pgts_torch.trust import check_imports

CHECK_FAILED = 1

Arguments = Sequence[str]
COMMANDS: dict[str, Callable[[Arguments], None]] = {}
"""The subcommands by name; the first line of a function's docstring is its help."""


def command(function: Callable[[Arguments], None]) -> Callable[[Arguments], None]:
    """Register a subcommand under the function's name, with dashes for underscores."""
    COMMANDS[command_name(function)] = function
    return function


@command
def train(arguments: Arguments) -> None:
    """Train a policy with tree search."""
    usage = "%(prog)s [--config FILE | --resume RUN_DIR] [--KEY VALUE ...]"
    parser = Parser(train, usage=usage)
    parser.add_argument(
        "--config",
        metavar="FILE",
        help="YAML file with any of the keys below, or a name of pgts list; none: the defaults",
    )
    parser.add_argument("--resume", metavar="RUN_DIR", type=run_folder, help="go on with an unfinished run")
    parser.add_argument("--overwrite", action="store_true", help="start from the beginning, as --run.overwrite")
    parser.add_argument(
        "--strict-resume", action="store_true", help="refuse a last checkpoint that is damaged or of other versions"
    )
    parser.add_argument(
        "--any-world-size", action="store_true", help="go on with another number of processes than before"
    )
    _add_trust(parser, "with --resume: ")
    _add_launch(parser)
    parser.add_argument("--print-config", action="store_true", help="print the whole configuration as YAML and stop")
    parser.add_argument("--json", action="store_true", help="print the summary as one JSON object")
    if {"-h", "--help"} & set(arguments):
        parser.epilog = "\n".join(describe_options(schema_of(Config).options()))
    fixed, overrides = parser.parse_known_args(arguments)
    if fixed.max_restarts and fixed.processes is None:
        parser.error(f"--max-restarts is {fixed.max_restarts}, which goes with --processes only")
    overrides += ["--run.overwrite"] if fixed.overwrite else []
    if fixed.resume is not None:
        for name in ("config", "run.dir", "run.overwrite", "overwrite"):
            if any(given.partition("=")[0] == f"--{name}" for given in arguments):
                parser.error(f"--{name} does not go with --resume, which takes it from the run")
        overrides += [f"--run.dir={fixed.resume}", "--run.overwrite=false"]
    config = load(fixed.config or (fixed.resume and fixed.resume / "config.yaml"), overrides)
    if fixed.print_config:
        sys.stdout.write(dump(config))
        return
    if fixed.trust_imports and fixed.resume is None:
        parser.error("--trust-imports goes with --resume only: an environment that you name yourself is trusted")
    if fixed.resume is not None and not fixed.trust_imports:
        typed = {override.removeprefix("--").partition("=")[0] for override in overrides}
        saved_id = None if typed & {"env", "env.id"} else config.env.id
        makes = {"model": "model.make", "policy": "policy.make", "critic": "critic.network.make"}
        saved = {name: getattr(config, name).plain() for name, key in makes.items() if not typed & {name, key}}
        check_imports(fixed.resume / "config.yaml", saved_id, config.env.kwargs, **saved)
    if fixed.processes is not None:
        from pgts_torch.experiment.launch import check_launch, launch

        processes = {"processes": fixed.processes, "max_restarts": fixed.max_restarts}
        check_launch(config, **processes)
        own = Parser(train, add_help=False)
        _add_launch(own)
        raise SystemExit(launch(own.parse_known_args(arguments)[1], **processes))
    if fixed.config is None and fixed.resume is None and rank() == 0:
        print(f"no --config: starting from the defaults ({config.env.id})", file=sys.stderr)
    from pgts_torch.experiment import run
    from pgts_torch.experiment.summary import describe

    summary = run.train(config, strict_resume=fixed.strict_resume, any_world_size=fixed.any_world_size)
    if rank() == 0:
        print_kept(json.dumps(asdict(summary)) if fixed.json else describe(summary), kept=f"{SUMMARY_FILE} of the run")


@command
def sweep(arguments: Arguments) -> None:
    """Train with several seeds at several depths, and compare."""
    parser = Parser(sweep, usage="%(prog)s --out DIR [--config FILE] [--KEY VALUE ...]")
    parser.add_argument("--out", metavar="DIR", type=output_folder, help="for DIR/depth-D/seed-S, a table, a picture")
    parser.add_argument("--config", metavar="FILE", help="as for pgts train; none: the defaults")
    parser.add_argument("--seeds", metavar="N", type=whole(1), default=5, help="0 to N - 1 (default: %(default)s)")
    parser.add_argument(
        "--depths", metavar="LIST", type=listed(whole(0, "adaptive")), default=(), help="as in 0,2,4 (default: its own)"
    )
    parser.add_argument("--jobs", metavar="N", type=whole(1), default=1, help="runs at once (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the table as one JSON object")
    parser.epilog = SWEEP_HELP
    fixed, overrides = parser.parse_known_args(arguments)
    if fixed.out is None:
        parser.error("the following arguments are required: --out")
    from pgts_torch.experiment import sweep as sweeping

    runs = sweeping.plan(fixed.config, overrides, depths=fixed.depths, num_seeds=fixed.seeds, out=fixed.out)
    answer = sweeping.sweep(runs, jobs=fixed.jobs, out=fixed.out)
    print_kept(json.dumps(asdict(answer)) if fixed.json else sweeping.describe(answer), kept=f"{fixed.out}/table.json")
    for name, mistake in answer.failures.items():
        print(f"error: {name}: {mistake}", file=sys.stderr)
    if answer.failures:
        raise SystemExit(CHECK_FAILED)


SWEEP_HELP = """\
Keys of the configuration are those of pgts train. Runs that are finished are
kept and others go on from their last checkpoint, so a sweep that was cut off
goes on when it is started again, and more seeds or depths can be added. Each
run has one thread. A run that fails is named, the others go on, and the exit
code is 1. SIGTERM or Ctrl-C lets the runs finish their iterations and save."""


@command
def tune(arguments: Arguments) -> None:
    """Look for good values of options, over several seeds."""
    parser = Parser(tune, usage="%(prog)s --out DIR --option KEY=VALUES ... [--KEY VALUE ...]")
    parser.add_argument("--out", metavar="DIR", type=output_folder, help="for DIR/trial-N/seed-S and the results")
    parser.add_argument(
        "--option",
        metavar="KEY=VALUES",
        action="append",
        default=[],
        help="which values a key may have: uniform(LOW,HIGH), log(LOW,HIGH), int(LOW,HIGH), logint(LOW,HIGH), or "
        "several as in 1,2,4; once for each key",
    )
    parser.add_argument("--config", metavar="FILE", help="as for pgts train; none: the defaults")
    parser.add_argument("--trials", metavar="N", type=whole(1), default=50, help="in all (default: %(default)s)")
    parser.add_argument(
        "--seeds", metavar="N", type=whole(1), default=3, help="of each trial, 0 to N - 1 (default: %(default)s)"
    )
    parser.add_argument("--jobs", metavar="N", type=whole(1), default=1, help="seeds at once (default: %(default)s)")
    parser.add_argument(
        "--metric",
        choices=TUNED_METRICS,
        default=TUNED_METRICS[0],
        help="of the trained policy, higher is better (default: %(default)s)",
    )
    parser.add_argument(
        "--sampler", choices=("tpe", "random"), default="tpe", help="what proposes values (default: %(default)s)"
    )
    parser.add_argument(
        "--prune",
        metavar="SHARE",
        type=unit_interval,
        default=0.5,
        help="end trials whose best evaluation is among this share of the worst; 0: none (default: 0.5, the median)",
    )
    parser.add_argument(
        "--prune-trials",
        metavar="N",
        type=whole(0),
        default=5,
        help="complete trials before any is pruned (default: %(default)s)",
    )
    parser.add_argument(
        "--prune-steps",
        metavar="N",
        type=whole(0),
        default=0,
        help="environment steps, of all seeds together, before a trial is pruned (default: %(default)s)",
    )
    parser.add_argument("--storage", metavar="FILE", type=Path, help="Optuna's, of SQLite (default: DIR/tune.db)")
    parser.add_argument(
        "--confirm", metavar="N", type=whole(0), default=0, help="train the best one with N other seeds (default: 0)"
    )
    parser.add_argument("--json", action="store_true", help="print the results as one JSON object")
    parser.epilog = TUNE_HELP
    given, overrides = parser.parse_known_args(arguments)
    if given.out is None:
        parser.error("the following arguments are required: --out")
    from pgts_torch.experiment.tune import space

    settings = {name: getattr(given, name) for name in ("seeds", "metric", "out")}
    plan = space.plan(given.config, overrides, options=given.option, **settings)
    from pgts_torch.experiment.tune import result
    from pgts_torch.experiment.tune.study import Pruning

    answer = result.tune(
        plan,
        pruning=Pruning(given.prune, given.prune_trials, given.prune_steps),
        **{name: getattr(given, name) for name in ("trials", "jobs", "sampler", "storage", "confirm")},
    )
    print_kept(json.dumps(asdict(answer)) if given.json else result.describe(answer), kept=f"{given.out}/tune.json")
    if answer.best is None:
        raise SystemExit(CHECK_FAILED)


TUNED_METRICS = ("eval/deterministic_return", "eval/sampled_return", "exact/J")

TUNE_HELP = """\
Keys of the configuration and of --option are those of pgts train. Trials that
are done are kept and others go on from their last checkpoint, so a tuning that
was cut off goes on when it is started again, and more trials can be added.
Every run has one thread. A trial that fails is named and the others go on.
tune.json, tune.png and best.yaml are written; pgts train takes the last one."""


@command
def evaluate(arguments: Arguments) -> None:
    """Evaluate the last checkpoint of a run, in new episodes."""
    parser = Parser(evaluate)
    parser.add_argument("run_dir", metavar="RUN_DIR", type=run_folder, help="the folder of a run")
    parser.add_argument("--episodes", metavar="N", type=whole(1), default=100, help="how many (default: %(default)s)")
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the episodes (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    _add_trust(parser)
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.evaluate import evaluate_run

    options = {"episodes": given.episodes, "seed": given.seed, "trust_imports": given.trust_imports}
    answer = evaluate_run(given.run_dir, **options)
    print_values({kind: asdict(evaluation) for kind, evaluation in answer.items()}, as_json=given.json)


@command
def watch(arguments: Arguments) -> None:
    """Show episodes of a run, with what the lookahead says."""
    parser = Parser(watch)
    parser.add_argument("run_dir", metavar="RUN_DIR", type=run_folder, help="the folder of a run")
    parser.add_argument(
        "--out", metavar="FILE", type=film_path, help="a .gif, .mp4 or .txt (default: text, in the terminal)"
    )
    _add_checkpoint(parser)
    for name, kind, default, meaning in [
        ("episodes", whole(1), 1, "how many (default: %(default)s)"),
        ("seed", whole(0), 0, "episode k begins with reset(seed=N + k) (default: %(default)s)"),
        ("steps", whole(1), None, "the most steps of an episode (default: its time limit, or 1,000)"),
        ("depth", whole(0), None, "of the lookahead (default: that of the training)"),
        ("fps", positive, None, "pictures a second (default: as the environment says); of text, the most steps"),
    ]:
        parser.add_argument(f"--{name}", metavar="N", type=kind, default=default, help=meaning)
    parser.add_argument(
        "--sampled", action="store_true", help="sample actions from the policy (default: the most probable ones)"
    )
    parser.add_argument("--json", action="store_true", help="print length and return of each episode as JSON, no text")
    parser.epilog = WATCH_HELP
    _add_trust(parser)
    given = parser.parse_args(arguments)
    from pgts_torch.experiment import watch as watching

    options = {name: getattr(given, name) for name in ("checkpoint", "episodes", "seed", "steps", "depth", "fps")}
    options |= {"deterministic": not given.sampled, "quiet": given.json, "trust_imports": given.trust_imports}
    answer = watching.watch_run(given.run_dir, given.out, **options)
    print(json.dumps(answer) if given.json else watching.describe(answer))


WATCH_HELP = """\
Each step has the probabilities of the actions by the policy and their values
by the lookahead; > is the one taken. Text has what the environment renders as
text, else the observation. .mp4 needs pip install 'pgts_torch[video]'."""


@command
def export(arguments: Arguments) -> None:
    """Write the policy of a run as a program of torch or ONNX."""
    parser = Parser(export)
    parser.add_argument("run_dir", metavar="RUN_DIR", type=run_folder, help="the folder of a run")
    parser.add_argument("--format", choices=["torch", "onnx"], help="default: by the end of FILE, or torch")
    parser.add_argument(
        "--out", metavar="FILE", type=file_path, help="where to write (default: RUN_DIR/policy.pt2, or policy.onnx)"
    )
    _add_checkpoint(parser)
    parser.add_argument("--json", action="store_true", help="print what the file says of itself as one JSON object")
    parser.epilog = EXPORT_HELP
    _add_trust(parser)
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.export import export_run

    options = {"format": given.format, "checkpoint": given.checkpoint, "trust_imports": given.trust_imports}
    print_values(export_run(given.run_dir, given.out, **options), as_json=given.json)


EXPORT_HELP = """\
The program maps observations, as the environment gives them, to the
probabilities of actions (or mean and std) and to the action that the policy
takes, in the environment's own form. It needs torch, or an ONNX runtime, and
not pgts_torch. ONNX needs pip install 'pgts_torch[onnx]'."""


@command
def report(arguments: Arguments) -> None:
    """Write one HTML page about a run, finished or not."""
    parser = Parser(report)
    parser.add_argument("run_dir", metavar="RUN_DIR", type=run_folder, help="the folder of a run, finished or not")
    parser.add_argument("--out", metavar="FILE", type=html_file, help="where to write (default: RUN_DIR/report.html)")
    parser.add_argument("--json", action="store_true", help="print what the page shows as one JSON object")
    _add_trust(parser)
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.report.page import write

    answer = write(given.run_dir, given.out, trust_imports=given.trust_imports)
    print(json.dumps(answer) if given.json else answer["page"])


@command
def compare(arguments: Arguments) -> None:
    """Compare runs: learning curves with intervals, and tables."""
    parser = Parser(compare, usage="%(prog)s RUN [RUN ...] [--OPTION VALUE ...]")
    parser.add_argument("runs", metavar="RUN", nargs="+", type=output_folder, help="a run, or a folder with runs in it")
    parser.add_argument(
        "--by",
        metavar="WHAT",
        default="config",
        help="runs of one group have the same config (default), up to the seed; name; folder; or what a regular "
        "expression matches in their paths, as in 'depth-[0-9]+'",
    )
    parser.add_argument(
        "--x", choices=("steps", "calls", "seconds"), default="steps", help="what was spent (default: %(default)s)"
    )
    parser.add_argument(
        "--metric", metavar="TAG", help="of metrics.jsonl (default: exact/J, else that of greedy or training episodes)"
    )
    parser.add_argument("--finished", action="store_true", help="leave out runs that are not finished")
    parser.add_argument(
        "--scale",
        metavar="ENV=LOW,HIGH",
        type=env_scale,
        action="append",
        default=[],
        help="returns that count as 0 and 1 in the mean over environments; once for each",
    )
    parser.add_argument("--out", metavar="DIR", type=output_folder, help="for compare.html and compare.png")
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.compare import comparison, text

    options = {name: getattr(given, name) for name in ("by", "x", "metric", "finished")}
    answer = comparison.compare(given.runs, scale=dict(given.scale), **options)
    written = []
    if given.out is not None:
        from pgts_torch.experiment.compare.drawing import write

        written = write(answer, given.out)
    print(json.dumps(text.to_json(answer)) if given.json else text.describe(answer))
    for path in () if given.json else written:
        print(path)


@command
def list_(arguments: Arguments) -> None:
    """List configurations, and environments with a model at hand."""
    parser = Parser(list_)
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.at_hand import at_hand, describe

    answer = at_hand()
    print(json.dumps(answer) if given.json else describe(answer))


@command
def init(arguments: Arguments) -> None:
    """Write a configuration to begin with, for an environment."""
    parser = Parser(init)
    parser.add_argument(
        "env_id", metavar="ENV", help="as in gymnasium.make; MODULE:ID imports MODULE first; or MODULE:CLASS"
    )
    parser.add_argument("-o", "--out", metavar="FILE", type=Path, help="where to write (default: NAME.yaml)")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE if it exists")
    _add_kwargs(parser)
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the training (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    parser.epilog = INIT_HELP
    given = parser.parse_args(arguments)
    from pgts_torch.experiment import initial

    path = initial.target(given.env_id, given.out, overwrite=given.overwrite)
    proposal = initial.propose(given.env_id, kwargs=given.kwargs, seed=given.seed)
    initial.write(path, proposal, overwrite=given.overwrite)
    if given.json:
        print(json.dumps(initial.to_json(proposal, path)))
        return
    for sentence in initial.describe(proposal):
        print(textwrap.fill(sentence, WIDTH, break_on_hyphens=False))
    print(f"\n{path} is written; pgts train --config {shlex.quote(str(path))}")


INIT_HELP = """\
It makes the environment, looks for a model of it as training does, runs two
iterations at a few depths and takes the deepest lookahead with which the
training takes less than ten minutes. The file has all options that apply,
each with its meaning and range; those that have their defaults are commented
out."""

STATIONARY_OPTIONS = {
    "ladder": ("n", "gamma", "start"),
    "tightrope": ("gamma", "start"),
    "random": ("states", "actions", "branching", "mdp-seed", "gamma", "start"),
    "grid": ("n", "traps", "gamma", "start"),
    "deep_sea": ("n", "gamma", "start"),
    "file.npz": ("start",),
}
"""The MDPs of `pgts stationary`, each with its options."""


@command
def stationary(arguments: Arguments) -> None:
    """Count the policies that tree search cannot improve, depth by depth."""
    parser = Parser(stationary, usage="%(prog)s WHAT [--OPTION VALUE ...]")
    parser.add_argument("what", metavar="WHAT", type=_mdp_name, help=", ".join(STATIONARY_OPTIONS))
    for name, kind, meaning in [
        ("n", whole(1), "size: ladder (default 5), grid (3), deep_sea (3)"),
        ("states", whole(1), "of random (default 10)"),
        ("actions", whole(1), "of random (default 2)"),
        ("branching", whole(1), "successors of each state and action of random (default: all states)"),
        ("mdp-seed", whole(0), "of random (default 0)"),
        ("traps", listed(whole(0)), "states of the grid that cost 10, as in 1,5 (default: none)"),
        ("gamma", unit_interval, "discount (default 0.9; deep_sea 0.99; a file has its own)"),
        ("start", whole(0, "uniform"), "a state, or uniform over all states (default: state 0; a file has its own)"),
    ]:
        parser.add_argument(f"--{name}", metavar="N", type=kind, help=meaning)
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    parser.epilog = NPZ_HELP
    given = vars(parser.parse_args(arguments))
    what, as_json = given.pop("what"), given.pop("json")
    options = {name: value for name, value in given.items() if value is not None}
    known = STATIONARY_OPTIONS.get(what, STATIONARY_OPTIONS["file.npz"])
    for name in (name.replace("_", "-") for name in options):
        if name not in known:
            parser.error(f"--{name} does not apply to {what}, which takes {', '.join(f'--{n}' for n in known)}")
    from pgts_torch.experiment import stationary as sets

    counts = sets.answer(what, **options)
    print(json.dumps(sets.to_json(counts)) if as_json else sets.describe(counts))


NPZ_HELP = """\
A file of your own, written by numpy.savez("mdp.npz", P=P, R=R, gamma=0.9):
  P      [S, A, S]  P[s, a] is the distribution of the next state
  R      [S, A]     expected rewards
  gamma  a number   discount in [0, 1]
  start  optional   a state, or a distribution [S]; uniform where it is missing
A terminal state is one that leads to itself and earns 0."""


@command
def check_model(arguments: Arguments) -> None:
    """Try out whether an environment can serve as a model of itself."""
    parser = Parser(check_model)
    parser.add_argument("env_id", metavar="ENV_ID", help="as in gymnasium.make; MODULE:ID imports MODULE first")
    _add_kwargs(parser)
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the walks (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    parser.epilog = PROTOCOL_HELP
    given = parser.parse_args(arguments)
    from pgts_torch.experiment import check_model as fidelity

    report = fidelity.answer(given.env_id, kwargs=given.kwargs, seed=given.seed)
    print(json.dumps(fidelity.to_json(report)) if given.json else fidelity.describe(report))
    if not report.usable:
        raise SystemExit(CHECK_FAILED)


PROTOCOL_HELP = """\
The exit code is 0 if it can, 1 if a check failed, 2 if it cannot be tried.
An environment of your own needs two methods:
  def get_state(self):         # all that step reads or changes, except
      return self.x, self.fuel # self.np_random: bytes, or what pickles
  def set_state(self, state):
      self.x, self.fuel = state
and draws from self.np_random only."""


def _add_kwargs(parser: Parser) -> None:
    parser.add_argument(
        "--kwargs", metavar="JSON", type=json_object, default={}, help='for gymnasium.make, as {"is_slippery": false}'
    )


def _add_launch(parser: Parser) -> None:
    parser.add_argument(
        "--processes", metavar="N", type=whole(1), help="train in N processes of this machine, which share the work"
    )
    parser.add_argument(
        "--max-restarts",
        metavar="K",
        type=whole(0),
        default=0,
        help="with --processes: begin again from the last checkpoint, K times, where one is lost or hangs (default: 0)",
    )


def _add_trust(parser: Parser, when: str = "") -> None:
    parser.add_argument(
        "--trust-imports",
        action="store_true",
        help=f"{when}import the modules that the saved environment and model name, as MODULE:ID (see SECURITY.md)",
    )


def _add_checkpoint(parser: Parser) -> None:
    parser.add_argument(
        "--checkpoint",
        choices=["last", "best"],
        default="last",
        help="the last one, or the best model by the evaluations of a run with eval.keep_best (default: %(default)s)",
    )


def _mdp_name(text: str) -> str:
    """An argparse type: the name of an MDP, or the path of a file that ends in .npz."""
    if not text.endswith(".npz"):
        if text in STATIONARY_OPTIONS:
            return text
        raise argparse.ArgumentTypeError(f"{text!r} is not an MDP; {choice_of(text, STATIONARY_OPTIONS)}")
    if path_kind(text) != "file":
        raise argparse.ArgumentTypeError(f"{text!r} is not a file")
    return text
