"""The command `pgts tune`."""

import json
from dataclasses import asdict
from pathlib import Path

from pgts_torch.cli.arguments import FAILED, Arguments, Parser
from pgts_torch.cli.terminal import print_kept
from pgts_torch.cli.types import output_folder, unit_interval, whole

TUNED_METRICS = ("eval/deterministic_return", "eval/sampled_return", "exact/J")

HELP = """\
Keys of the configuration and of --option are those of pgts train. Trials that
are done are kept and others go on from their last checkpoint, so a tuning that
was cut off goes on when it is started again, and more trials can be added.
Every run has one thread. A trial that fails is named and the others go on.
tune.json, tune.png and best.yaml are written; pgts train takes the last one."""


def tune(arguments: Arguments) -> None:
    """Look for good values of options, over several seeds."""
    parser = Parser(tune, usage="%(prog)s --out DIR --option KEY=VALUES ... [--KEY VALUE ...]", epilog=HELP)
    _add_arguments(parser)
    given, overrides = parser.parse_known_args(arguments)
    if given.out is None:
        parser.error("the following arguments are required: --out")
    from pgts_torch.experiment.tune import space

    settings = {name: getattr(given, name) for name in ("seeds", "metric", "out", "batch")}
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
        raise SystemExit(FAILED)


def _add_arguments(parser: Parser) -> None:
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
    for name, least, default, meaning in [
        ("trials", 1, 50, "in all"),
        ("seeds", 1, 3, "of each trial, 0 to N - 1"),
        ("batch", 1, 1, "trials that are proposed at once, without knowing of each other, and trained side by side"),
        ("jobs", 1, 1, "runs at once: no more than seeds times --batch are of use"),
        ("confirm", 0, 0, "train the best one with N other seeds"),
        ("prune-trials", 0, 5, "complete trials before any is pruned"),
        ("prune-steps", 0, 0, "environment steps, of all seeds together, before a trial is pruned"),
    ]:
        meaning += " (default: %(default)s)"
        parser.add_argument(f"--{name}", metavar="N", type=whole(least), default=default, help=meaning)
    parser.add_argument(
        "--prune",
        metavar="SHARE",
        type=unit_interval,
        default=0.5,
        help="end trials whose best evaluation is among this share of the worst; 0: none (default: 0.5, the median)",
    )
    parser.add_argument(
        "--metric",
        choices=TUNED_METRICS,
        default=TUNED_METRICS[0],
        help="of the trained policy, higher is better (default: %(default)s)",
    )
    parser.add_argument(
        "--sampler", choices=("tpe", "random"), default="tpe", help="what proposes values (default: %(default)s)"
    )
    parser.add_argument("--storage", metavar="FILE", type=Path, help="Optuna's, of SQLite (default: DIR/tune.db)")
    parser.add_argument("--json", action="store_true", help="print the results as one JSON object")
