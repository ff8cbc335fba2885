"""A process of `pgts train --processes`: `python -m pgts_torch.cli.rank REPORTS ...` is `pgts train ...`.

An exit code other than 0 makes torchrun's agent end the others at once. So a process that has ended by itself, whatever
its exit code, leaves it in REPORTS and exits with 0; one that has lost another process leaves what it knows of that.
"""

import json
import sys
import warnings
from pathlib import Path

from pgts_torch.cli.arguments import Arguments
from pgts_torch.cli.commands import COMMANDS
from pgts_torch.cli.main import exit_code
from pgts_torch.cli.terminal import rank
from pgts_torch.errors import LOST, RankLost


def main() -> int:
    report, lost = Path(sys.argv[1]) / str(rank()), ""

    def train(arguments: Arguments) -> None:
        nonlocal lost
        try:
            COMMANDS["train"](arguments)
        except RankLost as error:
            lost = str(error)
            raise SystemExit(LOST) from None

    if rank():
        warnings.simplefilter("ignore")  # the first process says them, which runs the same code
    code = exit_code(train, sys.argv[2:])
    report.write_text(json.dumps({"code": code, "lost": lost}), encoding="utf-8")
    return LOST if lost else 0


if __name__ == "__main__":
    sys.exit(main())
