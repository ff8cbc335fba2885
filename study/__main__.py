"""The command `python -m study`, run in a checkout of the repository."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from pgts_torch.cli.arguments import Parser
from pgts_torch.cli.main import exit_code
from pgts_torch.cli.types import output_folder
from study import PARTS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with these arguments (default: those of the process); the exit codes are those of `pgts`."""
    return exit_code(reproduce, sys.argv[1:] if arguments is None else arguments)


def reproduce(arguments: Sequence[str]) -> None:
    """Reproduce the figures and tables of the paper, and check what it says."""
    parser = Parser(reproduce, prog="python -m study")
    parser.add_argument("--only", choices=PARTS, help="compute this part; keep the others as they are in --out")
    parser.add_argument(
        "--quick", action="store_true", help="minutes instead of half an hour: fewer seeds and readings"
    )
    parser.add_argument(
        "--out", metavar="DIR", type=output_folder, default=Path("docs"), help="where to write (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print the data as one JSON object")
    given = parser.parse_args(arguments)
    from study import command  # imports torch, for which help and mistakes do not wait

    effort = command.QUICK if given.quick else command.FULL
    parts = command.run(only=given.only, effort=effort, out=given.out)
    print(json.dumps(parts) if given.json else command.describe(parts))


if __name__ == "__main__":
    sys.exit(main())
