"""The command `pgts export`."""

from pgts_torch.cli.arguments import Arguments, Parser, add_run, print_values
from pgts_torch.cli.types import file_path

HELP = """\
The program maps observations, as the environment gives them, to the
probabilities of actions (or mean and std) and to the action that the policy
takes, in the environment's own form. It needs torch, or an ONNX runtime, and
not pgts_torch. ONNX needs pip install 'pgts_torch[onnx]'."""


def export(arguments: Arguments) -> None:
    """Write the policy of a run as a program of torch or ONNX."""
    parser = Parser(export, epilog=HELP)
    add_run(parser)
    parser.add_argument("--format", choices=["torch", "onnx"], help="default: by the end of FILE, or torch")
    parser.add_argument(
        "--out", metavar="FILE", type=file_path, help="where to write (default: RUN_DIR/policy.pt2, or policy.onnx)"
    )
    parser.add_argument("--json", action="store_true", help="print what the file says of itself as one JSON object")
    given = parser.parse_args(arguments)
    from pgts_torch.experiment.export import export_run

    options = {"format": given.format, "checkpoint": given.checkpoint, "trust_imports": given.trust_imports}
    print_values(export_run(given.run_dir, given.out, **options), as_json=given.json)
