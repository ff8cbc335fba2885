"""The command `pgts stationary`."""

import argparse
import json

from pgts_torch.cli.arguments import Arguments, Parser
from pgts_torch.cli.types import choice_of, listed, path_kind, unit_interval, whole

MDPS = {
    "ladder": ("n", "gamma", "start"),
    "tightrope": ("gamma", "start"),
    "random": ("states", "actions", "branching", "mdp-seed", "gamma", "start"),
    "grid": ("n", "traps", "gamma", "start"),
    "deep_sea": ("n", "gamma", "start"),
    "file.npz": ("start",),
}
"""The MDPs of `pgts stationary`, each with its options."""

HELP = """\
A file of your own, written by numpy.savez("mdp.npz", P=P, R=R, gamma=0.9):
  P      [S, A, S]  P[s, a] is the distribution of the next state
  R      [S, A]     expected rewards
  gamma  a number   discount in [0, 1]
  start  optional   a state, or a distribution [S]; uniform where it is missing
A terminal state is one that leads to itself and earns 0."""


def stationary(arguments: Arguments) -> None:
    """Count the policies that tree search cannot improve, depth by depth."""
    parser = Parser(stationary, usage="%(prog)s WHAT [--OPTION VALUE ...]", epilog=HELP)
    parser.add_argument("what", metavar="WHAT", type=_mdp_name, help=", ".join(MDPS))
    for name, kind, meaning in [
        ("n", whole(1), "size: ladder (default 5), grid (3), deep_sea (3)"),
        ("states", whole(1), "of random (default 10)"),
        ("actions", whole(1), "of random (default 2)"),
        ("branching", whole(1), "successors of each state and action of random (default: all states)"),
        ("mdp-seed", whole(0), "of random (default 0)"),
        ("traps", listed(whole(0)), "states of the grid that cost 10, as in 1,5 (default: none)"),
        ("gamma", unit_interval, "discount (default 0.9; deep_sea 0.99; a file has its own)"),
        ("start", whole(0, "uniform"), "a state, or uniform over all states (default: state 0; a file has its own)"),
    ]:
        parser.add_argument(f"--{name}", metavar="N", type=kind, help=meaning)
    parser.add_argument("--json", action="store_true", help="print the answer as one JSON object")
    given = vars(parser.parse_args(arguments))
    what, as_json = given.pop("what"), given.pop("json")
    options = {name: value for name, value in given.items() if value is not None}
    known = MDPS.get(what, MDPS["file.npz"])
    for name in (name.replace("_", "-") for name in options):
        if name not in known:
            parser.error(f"--{name} does not apply to {what}, which takes {', '.join(f'--{n}' for n in known)}")
    from pgts_torch.experiment import stationary as sets

    counts = sets.answer(what, **options)
    print(json.dumps(sets.to_json(counts)) if as_json else sets.describe(counts))


def _mdp_name(text: str) -> str:
    """An argparse type: the name of an MDP, or the path of a file that ends in .npz."""
    if not text.endswith(".npz"):
        if text in MDPS:
            return text
        raise argparse.ArgumentTypeError(f"{text!r} is not an MDP; {choice_of(text, MDPS)}")
    if path_kind(text) != "file":
        raise argparse.ArgumentTypeError(f"{text!r} is not a file")
    return text
