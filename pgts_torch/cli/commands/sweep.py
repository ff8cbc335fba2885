"""The command `pgts sweep`."""

import json
import sys
from dataclasses import asdict

from pgts_torch.cli.arguments import FAILED, Arguments, Parser
from pgts_torch.cli.terminal import print_kept
from pgts_torch.cli.types import listed, output_folder, whole

HELP = """\
Keys of the configuration are those of pgts train. Runs that are finished are
kept and others go on from their last checkpoint, so a sweep that was cut off
goes on when it is started again, and more seeds or depths can be added. Each
run has one thread. A run that fails is named, the others go on, and the exit
code is 1. SIGTERM or Ctrl-C lets the runs finish their iterations and save."""


def sweep(arguments: Arguments) -> None:
    """Train with several seeds at several depths, and compare."""
    parser = Parser(sweep, usage="%(prog)s --out DIR [--config FILE] [--KEY VALUE ...]", epilog=HELP)
    parser.add_argument("--out", metavar="DIR", type=output_folder, help="for DIR/depth-D/seed-S, a table, a picture")
    parser.add_argument("--config", metavar="FILE", help="as for pgts train; none: the defaults")
    parser.add_argument("--seeds", metavar="N", type=whole(1), default=5, help="0 to N - 1 (default: %(default)s)")
    parser.add_argument(
        "--depths", metavar="LIST", type=listed(whole(0, "adaptive")), default=(), help="as in 0,2,4 (default: its own)"
    )
    parser.add_argument("--jobs", metavar="N", type=whole(1), default=1, help="runs at once (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the table as one JSON object")
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
        raise SystemExit(FAILED)
