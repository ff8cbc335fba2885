"""The command `pgts report`."""

import json

from pgts_torch.cli.arguments import Arguments, Parser, add_trust
from pgts_torch.cli.types import html_file, run_folder


def report(arguments: Arguments) -> None:
    """Write one HTML page about a run, finished or not."""
    parser = Parser(report)
    parser.add_argument("run_dir", metavar="RUN_DIR", type=run_folder, help="the folder of a run, finished or not")
    parser.add_argument("--out", metavar="FILE", type=html_file, help="where to write (default: RUN_DIR/report.html)")
    parser.add_argument("--json", action="store_true", help="print what the page shows as one JSON object")
    add_trust(parser)
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.report.page import write

    answer = write(given.run_dir, given.out, trust_imports=given.trust_imports)
    print(json.dumps(answer) if given.json else answer["page"])
