"""What the folder of a run says about it. Whatever of it is missing or damaged becomes a note."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import PgtsError
from pgts_torch.experiment import checkpoint
from pgts_torch.experiment.checkpoint import Notes
from pgts_torch.experiment.loading import load
from pgts_torch.experiment.ownership import CONFIG_FILE, VERSIONS_FILE
from pgts_torch.experiment.report import reading
from pgts_torch.experiment.report.curves import Panel, panels
from pgts_torch.experiment.report.settings import Setting, settings
from pgts_torch.experiment.summary import Summary, rows
from pgts_torch.tabular.mdp import TabularMDP


@dataclass(frozen=True)
class Certificate:
    """An upper bound on J* - J^pi; None: there is none.

    is_proved: whether that is a proof.
    missing: J* - J^pi itself, where it is known.
    is_known: whether there was an iteration that could say.
    """

    bound: float | None
    is_proved: bool
    missing: float | None
    is_known: bool


@dataclass(frozen=True)
class Facts:
    """What there is to say about a run.

    state: finished, unfinished or failed.
    failure: what failure.json says.
    step: environment steps that were made.
    world_size: how many processes made them.
    rows: what the run came to, or how far it is: names and values as text.
    curves: by heading.
    files: their sizes in bytes; a folder counts as one.
    notes: what is missing or damaged.
    """

    run: str
    name: str
    env: str
    seed: int
    state: str
    failure: Mapping[str, Any] | None
    step: int
    total_steps: int
    world_size: int
    rows: Mapping[str, str]
    certificate: Certificate
    curves: Mapping[str, Sequence[Panel]]
    constant: Mapping[str, float]
    never_finite: Sequence[str]
    config: Sequence[Setting]
    versions: Mapping[str, Any]
    files: Mapping[str, int]
    notes: Sequence[str]


@dataclass(frozen=True)
class Trained:
    """The policy of the newest intact checkpoint, where all states can be listed."""

    mdp: TabularMDP
    pi_SA: Tensor
    step: int


def gather(run: Path, *, trust_imports: bool = False) -> tuple[Facts, Trained | None]:
    """What a run folder says, and the policy in it.

    Raises:
        PgtsError: its configuration cannot be read.
    """
    config = load(run / CONFIG_FILE)
    notes: list[str] = []
    summary, failure = reading.summary(run, notes), reading.failure(run, notes)
    lines = reading.metrics(run, notes)
    path, last = reading.last_checkpoint(run, notes) or (None, None)
    trained = None if path is None or last is None else _trained(path, last, notes, trust_imports=trust_imports)
    latest = {tag: value for line in lines for tag, value in line.items()}
    curves = panels(lines)
    facts = Facts(
        run=str(run),
        name=config.name,
        env=config.env.id,
        seed=config.seed,
        state="failed" if failure is not None else "unfinished" if summary is None else "finished",
        failure=failure,
        step=max(0 if last is None else last.env_steps, latest.get("step", 0)),
        total_steps=config.total_steps,
        world_size=1 if last is None else last.world_size,
        rows=dict(_progress(last, latest)) if summary is None else rows(summary),
        certificate=_certificate(summary, latest),
        curves=curves.groups,
        constant=curves.constant,
        never_finite=curves.never_finite,
        config=list(settings(config)),
        versions=reading.json_object(run / VERSIONS_FILE, notes) or {},
        files=dict(reading.files(run)),
        notes=notes,
    )
    return facts, trained


def _trained(path: Path, last: Notes, notes: list[str], *, trust_imports: bool) -> Trained | None:
    try:
        algorithm = PGTS.load(path / checkpoint.MODEL_FILE, device="cpu", trust_imports=trust_imports)
    except PgtsError as error:
        notes.append(f"The trained policy cannot be loaded, so there are no pictures of it: {error}.")
        return None
    if algorithm.world.mdp is None:
        return None
    return Trained(algorithm.mdp, algorithm.policy_table().cpu(), last.env_steps)


def _certificate(summary: Summary | None, latest: Mapping[str, Any]) -> Certificate:
    if summary is None:
        bound, missing = latest.get("search/certificate"), latest.get("exact/optimality_gap")
        is_proved = latest.get("search/proved") == 1
    else:
        bound, missing, is_proved = summary.certificate, None, summary.certificate_is_proved
        if summary.J is not None and summary.J_optimal is not None:
            missing = max(summary.J_optimal - summary.J, 0.0)
    is_known = summary is not None or "search/certificate" in latest
    return Certificate(bound, is_proved, missing, is_known)


def _progress(last: Notes | None, latest: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """How far an unfinished run is, in the order of a summary."""
    J, missing = latest.get("exact/J"), latest.get("exact/optimality_gap")
    if J is not None and missing is not None:
        yield "return of the policy, J", f"{J:.4g} in the last iteration"
        yield "optimal return, J*", f"{J + missing:.4g}"
    for tag, name in [
        ("search/stationarity_gap", "stationarity gap"),
        ("search/certificate", "certificate, J* - J <="),
        ("charts/episodic_return", "return of episodes"),
    ]:
        if latest.get(tag) is not None:
            yield name, f"{latest[tag]:.4g} in the last iteration"
    if latest.get("search/model_calls") is not None:
        yield "model calls", f"{latest['search/model_calls']:.0f}"
    if last is not None:
        yield "last checkpoint", f"{last.env_steps} steps in {last.iterations} iterations"
        if reading.is_number(last.progress.get("seconds")):
            yield "seconds", f"{last.progress['seconds']:.1f} up to the last checkpoint"
