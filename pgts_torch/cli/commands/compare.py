"""The command `pgts compare`."""

import json

from pgts_torch.cli.arguments import Arguments, Parser
from pgts_torch.cli.types import env_scale, output_folder


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
