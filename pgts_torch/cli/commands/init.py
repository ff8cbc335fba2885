"""The command `pgts init`."""

import json
import shlex
import textwrap
from pathlib import Path

from pgts_torch.cli.arguments import WIDTH, Arguments, Parser, add_kwargs
from pgts_torch.cli.types import whole

HELP = """\
It makes the environment, looks for a model of it as training does, runs two
iterations at a few depths and takes the deepest lookahead with which the
training takes less than ten minutes. The file has all options that apply,
each with its meaning and range; those that have their defaults are commented
out."""


def init(arguments: Arguments) -> None:
    """Write a configuration to begin with, for an environment."""
    parser = Parser(init, epilog=HELP)
    parser.add_argument(
        "env_id", metavar="ENV", help="as in gymnasium.make; MODULE:ID imports MODULE first; or MODULE:CLASS"
    )
    parser.add_argument("-o", "--out", metavar="FILE", type=Path, help="where to write (default: NAME.yaml)")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE if it exists")
    add_kwargs(parser)
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the training (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
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
