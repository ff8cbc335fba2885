"""Run a subcommand of `pgts`, and turn what happens into an exit code."""

import argparse
import importlib.metadata
import sys
from collections.abc import Callable

from pgts_torch.cli.arguments import Arguments, Parser, summary
from pgts_torch.cli.commands import COMMANDS
from pgts_torch.cli.terminal import plain_warnings, rank, safe_output
from pgts_torch.cli.types import choice_of
from pgts_torch.errors import LOST, NotFinite, PgtsError, RankLost, Stopped

TRAINING_FAILED = 1
USAGE_ERROR, INTERRUPTED, BROKEN_PIPE = 2, 130, 141


def main(arguments: Arguments | None = None) -> int:
    """Run `pgts` with these arguments (default: those of the process).

    Returns:
        The exit code: 0; 1 if `check-model` says no, a run of a sweep failed or a number in training was not finite; 2
        after a mistake of the caller, reported on stderr, a line each; 75 where another process of a training is lost
        or hangs; 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP.
    """
    return exit_code(_run_command, sys.argv[1:] if arguments is None else arguments)


@safe_output()
@plain_warnings()
def exit_code(function: Callable[[Arguments], None], arguments: Arguments) -> int:
    """Run a command and return its exit code, as `main` says; mistakes and failures go to stderr, a line each."""
    try:
        code = _call(function, arguments)
        sys.stdout.flush()  # so that a broken pipe is noticed here, not while the interpreter shuts down
        return code
    except PgtsError as error:
        if rank() == (error.rank or 0):  # an error that all processes raise is printed by the first
            for line in str(error).splitlines():
                print(f"error: {f'[rank {rank()}] ' if rank() else ''}{line}", file=sys.stderr)
        if isinstance(error, RankLost):
            return LOST
        return TRAINING_FAILED if isinstance(error, NotFinite) else USAGE_ERROR
    except BrokenPipeError:
        return BROKEN_PIPE
    except Stopped as stopped:
        if rank() == 0:
            print(stopped, file=sys.stderr)
        return 128 + stopped.signal
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def _call(function: Callable[[Arguments], None], arguments: Arguments) -> int:
    """Run a command and return its exit code; argparse raises SystemExit after --help."""
    try:
        function(arguments)
    except SystemExit as leave:
        return leave.code if isinstance(leave.code, int) else int(leave.code is not None)
    return 0


def _run_command(arguments: Arguments) -> None:
    """Call the function of a subcommand with the arguments after it."""
    summaries = [f"  {name:<12}{summary(function)}" for name, function in COMMANDS.items()]
    usage = "pgts [-h] [--version] COMMAND ..."
    parser = Parser(main, prog="pgts", usage=usage, description="Policy gradient with tree search.")
    parser.epilog = "\n".join(
        ["commands:", *summaries, "", "pgts init ENV is where to begin; pgts COMMAND --help explains each."]
    )
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    parser.add_argument("command", metavar="COMMAND", nargs="?", help="what to do")
    parser.add_argument("arguments", metavar="...", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.version:
        print(f"pgts {importlib.metadata.version('pgts_torch')}")
    elif given.command is None:
        parser.error(f"a command is missing; choose from {', '.join(COMMANDS)}")
    elif given.command == "figures":
        parser.error("'figures' is no longer a command of pgts; run python -m study in a checkout of the repository")
    elif given.command not in COMMANDS:
        parser.error(f"{given.command!r} is not a command; {choice_of(given.command, COMMANDS)}")
    else:
        COMMANDS[given.command](given.arguments)
