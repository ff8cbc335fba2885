"""The command `pgts watch`."""

import json

from pgts_torch.cli.arguments import Arguments, Parser, add_run
from pgts_torch.cli.types import film_path, positive, whole

HELP = """\
Each step has the probabilities of the actions by the policy and their values
by the lookahead; > is the one taken. Text has what the environment renders as
text, else the observation. .mp4 needs pip install 'pgts_torch[video]'."""


def watch(arguments: Arguments) -> None:
    """Show episodes of a run, with what the lookahead says."""
    parser = Parser(watch, epilog=HELP)
    add_run(parser)
    parser.add_argument(
        "--out", metavar="FILE", type=film_path, help="a .gif, .mp4 or .txt (default: text, in the terminal)"
    )
    for name, kind, default, meaning in [
        ("episodes", whole(1), 1, "how many (default: %(default)s)"),
        ("seed", whole(0), 0, "episode k begins with reset(seed=N + k) (default: %(default)s)"),
        ("steps", whole(1), None, "the most steps of an episode (default: its time limit, or 1,000)"),
        ("depth", whole(0), None, "of the lookahead (default: that of the training)"),
        ("fps", positive, None, "pictures a second (default: as the environment says); of text, the most steps"),
    ]:
        parser.add_argument(f"--{name}", metavar="N", type=kind, default=default, help=meaning)
    parser.add_argument(
        "--sampled", action="store_true", help="sample actions from the policy (default: the most probable ones)"
    )
    parser.add_argument("--json", action="store_true", help="print length and return of each episode as JSON, no text")
    given = parser.parse_args(arguments)
    from pgts_torch.experiment import watch as watching

    options = {name: getattr(given, name) for name in ("checkpoint", "episodes", "seed", "steps", "depth", "fps")}
    options |= {"deterministic": not given.sampled, "quiet": given.json, "trust_imports": given.trust_imports}
    answer = watching.watch_run(given.run_dir, given.out, **options)
    print(json.dumps(answer) if given.json else watching.describe(answer))
