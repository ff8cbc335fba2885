"""The command `pgts train`."""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from pgts_torch.cli.arguments import Arguments, Parser, add_trust, describe_options
from pgts_torch.cli.terminal import print_kept, rank
from pgts_torch.cli.types import run_folder, whole
from pgts_torch.config import Config, dump, load
from pgts_torch.experiment.ownership import CONFIG_FILE, SUMMARY_FILE
from pgts_torch.options.schema import schema_of
from pgts_torch.trust import check_imports


def train(arguments: Arguments) -> None:
    """Train a policy with tree search."""
    usage = "%(prog)s [--config FILE | --resume RUN_DIR] [--KEY VALUE ...]"
    parser = Parser(train, usage=usage)
    parser.add_argument(
        "--config",
        metavar="FILE",
        help="YAML file with any of the keys below, or a name of pgts list; none: the defaults",
    )
    parser.add_argument("--resume", metavar="RUN_DIR", type=run_folder, help="go on with an unfinished run")
    parser.add_argument("--overwrite", action="store_true", help="start from the beginning, as --run.overwrite")
    parser.add_argument(
        "--strict-resume", action="store_true", help="refuse a last checkpoint that is damaged or of other versions"
    )
    parser.add_argument(
        "--any-world-size", action="store_true", help="go on with another number of processes than before"
    )
    add_trust(parser, "with --resume: ")
    _add_launch(parser)
    parser.add_argument("--print-config", action="store_true", help="print the whole configuration as YAML and stop")
    parser.add_argument("--json", action="store_true", help="print the summary as one JSON object")
    if {"-h", "--help"} & set(arguments):
        parser.epilog = "\n".join(describe_options(schema_of(Config).options()))
    fixed, overrides = parser.parse_known_args(arguments)
    if fixed.max_restarts and fixed.processes is None:
        parser.error(f"--max-restarts is {fixed.max_restarts}, which goes with --processes only")
    overrides += ["--run.overwrite"] if fixed.overwrite else []
    if fixed.resume is not None:
        for name in ("config", "run.dir", "run.overwrite", "overwrite"):
            if any(given.partition("=")[0] == f"--{name}" for given in arguments):
                parser.error(f"--{name} does not go with --resume, which takes it from the run")
        overrides += [f"--run.dir={fixed.resume}", "--run.overwrite=false"]
    config = load(fixed.config or (fixed.resume and fixed.resume / CONFIG_FILE), overrides)
    if fixed.print_config:
        sys.stdout.write(dump(config))
        return
    if fixed.trust_imports and fixed.resume is None:
        parser.error("--trust-imports goes with --resume only: an environment that you name yourself is trusted")
    if fixed.resume is not None and not fixed.trust_imports:
        _check_imports(fixed.resume, config, overrides)
    if fixed.processes is not None:
        from pgts_torch.experiment.launch import check_launch, launch

        processes = {"processes": fixed.processes, "max_restarts": fixed.max_restarts}
        check_launch(config, **processes)
        own = Parser(train, add_help=False)
        _add_launch(own)
        raise SystemExit(launch(own.parse_known_args(arguments)[1], **processes))
    is_named = fixed.config or fixed.resume or any(override.startswith("--env") for override in overrides)
    if not is_named and rank() == 0:
        print(f"no --config: starting from the defaults ({config.env.id})", file=sys.stderr)
    from pgts_torch.experiment import run
    from pgts_torch.experiment.summary import describe

    summary = run.train(config, strict_resume=fixed.strict_resume, any_world_size=fixed.any_world_size)
    if rank() == 0:
        print_kept(json.dumps(asdict(summary)) if fixed.json else describe(summary), kept=f"{SUMMARY_FILE} of the run")


def _check_imports(run: Path, config: Config, overrides: Sequence[str]) -> None:
    """PgtsError where a saved configuration would import modules that are not named by the overrides."""
    typed = {override.removeprefix("--").partition("=")[0] for override in overrides}
    saved_id = None if typed & {"env", "env.id"} else config.env.id
    makes = {"model": "model.make", "policy": "policy.make", "critic": "critic.network.make"}
    saved = {name: getattr(config, name).plain() for name, key in makes.items() if not typed & {name, key}}
    check_imports(run / CONFIG_FILE, saved_id, config.env.kwargs, **saved)


def _add_launch(parser: Parser) -> None:
    parser.add_argument(
        "--processes", metavar="N", type=whole(1), help="train in N processes of this machine, which share the work"
    )
    parser.add_argument(
        "--max-restarts",
        metavar="K",
        type=whole(0),
        default=0,
        help="with --processes: begin again from the last checkpoint, K times, where one is lost or hangs (default: 0)",
    )
