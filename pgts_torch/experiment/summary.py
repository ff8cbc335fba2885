"""The summary of a finished run, as data and as text."""

import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from pgts_torch import files
from pgts_torch.agent.certificate import Trust
from pgts_torch.agent.evaluate import Evaluation
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.ownership import SUMMARY_FILE

EndedBy = Literal["total_steps", "certificate", "return"]

_ENDINGS: dict[EndedBy, str] = {
    "total_steps": "total_steps",
    "certificate": "the certificate, which has reached search.stop_at",
    "return": "the return of greedy episodes: eval.stop_at_return",
}


@dataclass(frozen=True)
class Summary:
    """The results of a finished run.

    J, J_optimal: exact return of the trained policy and of an optimal one; None where the exact MDP is not known.
    depth: m; the largest if it was adaptive.
    search: the kind of search, with a reason where it was chosen automatically.
    stationarity_gap: max over visited states of the exact g_m; None where the exact MDP is not known.
    certificate: an upper bound on J* - J^pi; None: there is none. If it is a proof or from counts, it is for the
        trained policy; an estimate is for the policy before the last update.
    certificate_trust: how far it can be trusted; None: there is none.
    certificate_confidence: 1 where all start states are known; else the probability that all certificates of the run
        hold, over the sampled start states and up to the critic's error; from counts, the posterior probability that
        this one holds. None: there is no certificate.
    gap_bound: an estimate of an upper bound on J* - J^pi from the gap of the last iteration, where there is no
        certificate (`Certificates.gap_bound`); None: there is none.
    ended_by: why training ended: the certificate is at most `search.stop_at`, greedy episodes return at least
        `eval.stop_at_return`, or `total_steps` are done.
    notes: advice to the user where the run learned little (`experiment.advice`).
    parts: the classes of policy, critic and update, also where the environment chose them.
    """

    run: str
    seed: int
    depth: int
    search: str
    J: float | None
    J_optimal: float | None
    stationarity_gap: float | None
    ended_by: EndedBy
    iterations: int
    env_steps: int
    model_calls: int
    seconds: float
    deterministic: Evaluation
    sampled: Evaluation
    certificate: float | None = None
    certificate_trust: Trust | None = None
    certificate_confidence: float | None = None
    gap_bound: float | None = None
    notes: tuple[str, ...] = ()
    parts: str = ""


def results(summary: Summary) -> dict[str, float]:
    """Return the results that TensorBoard shows beside the hyper-parameters, those that there are."""
    gap = None if summary.J is None or summary.J_optimal is None else max(summary.J_optimal - summary.J, 0.0)
    found = {
        "deterministic_return": summary.deterministic.episodic_return.mean,
        "sampled_return": summary.sampled.episodic_return.mean,
        "J": summary.J,
        "optimality_gap": gap,
        "stationarity_gap": summary.stationarity_gap,
        "certificate": summary.certificate,
        "env_steps": summary.env_steps,
        "model_calls": summary.model_calls,
        "seconds": summary.seconds,
    }
    return {name: float(value) for name, value in found.items() if value is not None}


_SUMMARY = TypeAdapter(Summary)


def summary_in(folder: Path) -> Summary | None:
    """What a finished run came to; None if it is not finished; PgtsError where that cannot be read, or is damaged."""
    path = folder / SUMMARY_FILE
    if files.kind(path) is None:
        return None
    try:
        return _SUMMARY.validate_json(files.read(path), strict=True)
    except ValidationError as error:
        raise PgtsError(
            f"{path} is damaged ({first_mistake(error, 'summary')}): remove it, and the run is summed up again from "
            "its last checkpoint"
        ) from error


def first_mistake(error: ValidationError, what: str) -> str:
    """The first of the mistakes that pydantic has found in `what`, with the name of the value."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, (what, *first['loc'])))}: {first['msg']}"


def describe(summary: Summary) -> str:
    """Return the summary as text within 80 columns."""
    return "\n".join(f"{name:<28}{_folded(name, value)}" for name, value in rows(summary).items())


def _folded(name: str, value: str) -> str:
    """Wrap a long value into several lines, except for a path."""
    return value if name == "run folder" else textwrap.fill(value, 50).replace("\n", "\n" + 28 * " ")


def rows(summary: Summary) -> dict[str, str]:
    """Return the rows of `describe`, by name."""
    rows: dict[str, str] = {}
    if summary.J is not None and summary.J_optimal is not None:
        ratio = f" ({summary.J / summary.J_optimal:.1%} of the optimum)" if summary.J_optimal > 0 <= summary.J else ""
        rows |= {
            "return of the policy, J": f"{summary.J:.4g}{ratio}",
            "optimal return, J*": f"{summary.J_optimal:.4g}",
            f"stationarity gap, depth {summary.depth}": f"{summary.stationarity_gap:.3g}",
        }
    if summary.certificate is not None:
        rows["certificate, J* - J <="] = f"{summary.certificate:.3g} ({_trust_text(summary)})"
    elif summary.gap_bound is not None:
        rows["from the gap, J* - J <="] = f"{summary.gap_bound:.3g} (an estimate, no certificate)"
    ended = _ENDINGS[summary.ended_by]
    if summary.ended_by == "certificate" and summary.certificate_trust != "proved":
        ended = "an estimated certificate: it is at search.stop_at"
    rows |= {
        "greedy episodes, return": _score_text(summary.deterministic),
        "sampled episodes, return": _score_text(summary.sampled),
        **({"note": "; ".join(summary.notes)} if summary.notes else {}),
        **({"policy, critic, update": summary.parts} if summary.parts else {}),
        "search": summary.search,
        "training ended by": ended,
        "environment steps": f"{summary.env_steps} in {summary.iterations} iterations",
        "model calls": str(summary.model_calls),
        "seconds": f"{summary.seconds:.1f}",
        "run folder": summary.run,
    }
    return rows


def _trust_text(summary: Summary) -> str:
    if summary.certificate_trust == "proved":
        return "proved"
    if summary.certificate_trust == "posterior":
        return f"posterior, {100 * (summary.certificate_confidence or 0):.6g} %"
    sampled = f" with {summary.certificate_confidence:.0%} over the starts," * (summary.certificate_trust != "critic")
    return f"an estimate:{sampled} as far as the critic is right"


def _score_text(evaluation: Evaluation) -> str:
    score = evaluation.episodic_return
    spread = "" if score.half_width is None else f" +- {score.half_width:.2g}"
    return f"{score.mean:.4g}{spread} over {evaluation.episodes} episodes"
