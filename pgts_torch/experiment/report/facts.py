"""Read the folder of a run for its report. Files that are missing, damaged or being written become notes."""

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pgts_torch.agent.pgts import PGTS
from pgts_torch.config import Config, load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint, ownership
from pgts_torch.experiment.report.curves import panels
from pgts_torch.experiment.resume import flat, names_modules, plain
from pgts_torch.experiment.summary import Summary, rows, summary_in
from pgts_torch.files import PARTIAL
from pgts_torch.options.schema import schema_of

Values = Mapping[str, Any]

PROGRESS = {
    "exact/J": "return of the policy, J",
    "search/stationarity_gap": "stationarity gap",
    "search/certificate": "certificate, J* - J <=",
    "search/gap_bound": "estimate from the gap, J* - J <=",
    "charts/episodic_return": "return of episodes",
}
"""The values of the last iteration that are reported for an unfinished run."""


def gather(run: Path, *, trust_imports: bool = False) -> tuple[dict[str, Any], PGTS | None]:
    """Return the content of a run folder as plain values, and the model of its newest intact checkpoint.

    Among the values: `state`, finished, unfinished or failed; `rows`, its results or its progress, names and values as
    text; `curves` by heading; `config`, each key with its default under the types that were chosen (None for kwargs);
    `notes`, what is missing or damaged.

    Raises:
        PgtsError: the configuration cannot be read.
    """
    config, notes = load(run / ownership.CONFIG_FILE), list[str]()
    summary = None
    try:
        summary = summary_in(run)
    except PgtsError as error:
        notes.append(f"{error}.")
    failure, versions = (_mapping(run / name, notes) for name in (ownership.FAILURE_FILE, ownership.VERSIONS_FILE))
    lines = metrics(run, notes)
    latest = {tag: value for line in lines for tag, value in line.items()}
    curves, constant, never_finite = panels(lines)
    path, last = _last_checkpoint(run, notes)
    algorithm = None
    try:
        if last is not None:
            algorithm = PGTS.load(path, device="cpu", trust_imports=trust_imports)
    except PgtsError as error:
        notes.append(f"The trained policy cannot be loaded, so there is no picture of it: {error}.")
    facts = {
        "run": str(run),
        "name": config.name,
        "env": config.env.id,
        "imports": names_modules(config),
        "seed": config.seed,
        "state": "failed" if failure else "finished" if summary else "unfinished",
        "failure": failure,
        "step": max(0 if last is None else last.env_steps, latest.get("step", 0)),
        "total_steps": config.total_steps,
        "world_size": 1 if last is None else last.world_size,
        "rows": rows(summary) if summary else dict(_progress(last, latest)),
        "certificate": _certificate(summary, latest),
        "curves": curves,
        "constant": constant,
        "never_finite": never_finite,
        "config": list(_settings(config)),
        "versions": versions or {},
        "files": dict(_files(run)),
        "notes": notes,
    }
    return facts, algorithm


def number(value: Any) -> float | None:
    """Return a value that can be plotted, so that differences of two values are finite, too; else None."""
    return value if isinstance(value, int | float) and abs(value) <= 1e300 else None


def _mapping(path: Path, notes: list[str]) -> Values | None:
    """Return the values in a file; None where there is no file, or it has another form."""
    try:
        return dict(json.loads(path.read_bytes()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError, TypeError):
        notes.append(f"{path.name} cannot be read, or is not as this version writes it; it is left out.")
        return None


def metrics(run: Path, notes: list[str]) -> list[Values]:
    """Return the lines of metrics.jsonl that can be read; values that cannot be plotted are None."""
    lines, unread = list[Values](), 0
    with suppress(OSError):
        for raw in (run / ownership.METRICS_FILE).read_bytes().splitlines():
            try:
                line = json.loads(raw)
                lines.append({"step": int(line.pop("step"))} | {tag: number(value) for tag, value in line.items()})
            except (ValueError, RecursionError, AttributeError, TypeError, KeyError):
                unread += 1
    if unread:
        notes.append(f"{unread} of {len(lines) + unread} lines of metrics.jsonl cannot be read; they are left out.")
    if not lines:
        notes.append("metrics.jsonl holds no iteration, so there are no curves.")
    return lines


def _last_checkpoint(run: Path, notes: list[str]) -> tuple[Path, checkpoint.Notes | None]:
    """Return the newest intact checkpoint and its notes."""
    for path in reversed(ownership.checkpoints(run)):
        try:
            return path, checkpoint.read(path)[0]
        except PgtsError as error:
            notes.append(f"{error}.")
    notes.append("There is no intact checkpoint, so nothing can be said about the trained policy itself.")
    return run, None


def _progress(last: checkpoint.Notes | None, latest: Values) -> Iterator[tuple[str, str]]:
    for tag, name in PROGRESS.items():
        if latest.get(tag) is not None:
            yield name, f"{latest[tag]:.4g} in the last iteration"
    if latest.get("search/model_calls") is not None:
        yield "model calls", f"{latest['search/model_calls']:.0f}"
    if last is not None:
        yield "last checkpoint", f"{last.env_steps} steps in {last.iterations} iterations"


def _certificate(summary: Summary | None, latest: Values) -> Values:
    """The certificate, and the exact optimality gap beside it.

    bound: on J* - J^pi; None: there is none.   missing: J* - J^pi, where known.
    trust: how far the bound can be trusted, as in the summary; "estimate" where the metrics tell no more.
    is_known: whether an iteration has reported it.
    """
    if summary is None:
        bound, missing = latest.get("search/certificate"), latest.get("exact/optimality_gap")
        trust: str | None = "proved" if latest.get("search/proved") == 1 else "estimate"
        known = "search/certificate" in latest
        if (posterior := latest.get("search/certificate_posterior")) is not None:
            bound, trust = posterior, "posterior"
    else:
        bound, trust, known, missing = summary.certificate, summary.certificate_trust, True, None
        if summary.J is not None and summary.J_optimal is not None:
            missing = max(summary.J_optimal - summary.J, 0.0)
    return {"bound": bound, "trust": trust, "missing": missing, "is_known": known}


def _settings(config: Config) -> Iterator[Values]:
    values = flat(plain(config))
    defaults = {option.key: option.default for option in schema_of(Config).options() if option.exists(values)}
    for key, value in values.items():
        is_default = key in defaults and value == defaults[key]
        yield {"key": key, "value": value, "default": defaults.get(key), "is_default": is_default}


def _files(run: Path) -> Iterator[tuple[str, int]]:
    """Yield name and size in bytes of each file of a run."""
    hidden = (ownership.CHECKPOINTS, ownership.LOCK_FILE, ownership.MARK_FILE, ownership.REPORT_FILE)
    for path in sorted([*run.iterdir(), *ownership.checkpoints(run)]):
        if path.name not in hidden and not path.name.endswith(PARTIAL):
            with suppress(FileNotFoundError):  # a run that is still training removes old checkpoints
                yield str(path.relative_to(run)), path.stat().st_size
