"""The command `pgts list`."""

import json

from pgts_torch.cli.arguments import Arguments, Parser


def list_(arguments: Arguments) -> None:
    """List configurations, environments with a model at hand, and extras."""
    parser = Parser(list_)
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.at_hand import at_hand, describe

    answer = at_hand()
    print(json.dumps(answer) if given.json else describe(answer))
