"""The command `pgts evaluate`."""

from dataclasses import asdict

from pgts_torch.cli.arguments import Arguments, Parser, add_run, print_values
from pgts_torch.cli.types import whole


def evaluate(arguments: Arguments) -> None:
    """Evaluate a checkpoint of a run, in new episodes."""
    parser = Parser(evaluate)
    add_run(parser)
    parser.add_argument("--episodes", metavar="N", type=whole(1), default=100, help="how many (default: %(default)s)")
    parser.add_argument("--seed", metavar="N", type=whole(0), default=0, help="of the episodes (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.evaluate import evaluate_run

    options = {name: getattr(given, name) for name in ("checkpoint", "episodes", "seed", "trust_imports")}
    answer = evaluate_run(given.run_dir, **options)
    print_values({kind: asdict(evaluation) for kind, evaluation in answer.items()}, as_json=given.json)
