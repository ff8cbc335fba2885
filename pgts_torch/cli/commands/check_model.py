"""The command `pgts check-model`."""

import json

from pgts_torch.cli.arguments import FAILED, Arguments, Parser, add_kwargs
from pgts_torch.cli.types import whole

HELP = """\
The exit code is 0 if it can, 1 if a check failed, 2 if it cannot be tried.
An environment of your own needs two methods:
  def get_state(self):         # all that step reads or changes, except
      return self.x, self.fuel # self.np_random: bytes, or what pickles
  def set_state(self, state):
      self.x, self.fuel = state
and draws from self.np_random only."""


def check_model(arguments: Arguments) -> None:
    """Try out whether an environment can serve as a model of itself."""
    parser = Parser(check_model, epilog=HELP)
    parser.add_argument("env_id", metavar="ENV_ID", help="as in gymnasium.make; MODULE:ID imports MODULE first")
    add_kwargs(parser)
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the walks (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    given = parser.parse_args(arguments)
    from pgts_torch.experiment import check_model as fidelity

    report = fidelity.answer(given.env_id, kwargs=given.kwargs, seed=given.seed)
    print(json.dumps(fidelity.to_json(report)) if given.json else fidelity.describe(report))
    if not report.usable:
        raise SystemExit(FAILED)
