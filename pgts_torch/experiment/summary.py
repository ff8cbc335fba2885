"""What a finished run came to, for programs and for people."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pgts_torch.agent.evaluate import Evaluation, Score

EndedBy = Literal["total_steps", "certificate", "return"]

_ENDINGS: dict[EndedBy, str] = {
    "total_steps": "total_steps",
    "certificate": "the certificate, which has reached search.stop_at",
    "return": "the return of greedy episodes: eval.stop_at_return",
}


@dataclass(frozen=True)
class Summary:
    """What a finished run came to.

    J, J_optimal: exact return of the trained policy and of the best one; None where nothing exact is known.
    depth: m, the largest if it was adaptive.
    search: how the lookahead was made, and why where it chose that itself.
    stationarity_gap: max over visited states of the exact g_m; None likewise.
    certificate: an upper bound on J* - J^pi; None: there is none. A proof is one of the trained policy, an estimate
        is that of the last iteration, before its update.
    certificate_is_proved: whether it is a proof: the start distribution is known, the critic exact and the model the
        environment. If not, it is as far right as the critic is at the start states.
    certificate_confidence: 1 where all start states are known, else the probability with which all certificates of the
        run hold over the starts that were drawn, as far as the critic is right.
    ended_by: what ended the training: the certificate came down to `search.stop_at`, greedy episodes reached
        `eval.stop_at_return`, or neither before `total_steps`.
    notes: what the user should know of a run that learned little (`experiment.advice`).
    parts: the classes of policy, critic and update, also where the environment chose them.
    """

    run: str
    seed: int
    depth: int
    search: str
    J: float | None
    J_optimal: float | None
    stationarity_gap: float | None
    certificate: float | None
    certificate_is_proved: bool
    ended_by: EndedBy
    iterations: int
    env_steps: int
    model_calls: int
    seconds: float
    deterministic: Evaluation
    sampled: Evaluation
    certificate_confidence: float = 1.0
    notes: tuple[str, ...] = ()
    parts: str = ""


def from_json(content: Mapping[str, Any]) -> Summary:
    """The summary that a run has left as JSON; TypeError or KeyError if it is of another form."""
    evaluations = {kind: _evaluation(content[kind]) for kind in ("deterministic", "sampled")}
    return Summary(**{**content, **evaluations, "notes": tuple(content.get("notes", ()))})


def _evaluation(content: Mapping[str, Any]) -> Evaluation:
    scores = {name: Score(**value) for name, value in content.items() if name != "episodes"}
    return Evaluation(episodes=content["episodes"], **scores)


def describe(summary: Summary) -> str:
    """The summary as a person reads it, within 80 columns."""
    return "\n".join(f"{name:<28}{_folded(name, value)}" for name, value in rows(summary).items())


def _folded(name: str, value: str) -> str:
    """Long values on several lines; a path stays whole."""
    return value if name == "run folder" else textwrap.fill(value, 50).replace("\n", "\n" + 28 * " ")


def rows(summary: Summary) -> dict[str, str]:
    """What `describe` says, by name."""
    rows: dict[str, str] = {}
    if summary.J is not None and summary.J_optimal is not None:
        share = f" ({summary.J / summary.J_optimal:.1%} of the optimum)" if summary.J_optimal > 0 <= summary.J else ""
        rows |= {
            "return of the policy, J": f"{summary.J:.4g}{share}",
            "optimal return, J*": f"{summary.J_optimal:.4g}",
            f"stationarity gap, depth {summary.depth}": f"{summary.stationarity_gap:.3g}",
        }
    if summary.certificate is not None:
        confidence = summary.certificate_confidence
        drawn = "" if confidence == 1 else f" with {confidence:.0%} over the starts,"
        told = "proved" if summary.certificate_is_proved else f"an estimate:{drawn} as far as the critic is right"
        rows["certificate, J* - J <="] = f"{summary.certificate:.3g} ({told})"
    ended = _ENDINGS[summary.ended_by]
    if summary.ended_by == "certificate" and not summary.certificate_is_proved:
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


def _score_text(evaluation: Evaluation) -> str:
    score = evaluation.episodic_return
    spread = "" if score.half_width is None else f" +- {score.half_width:.2g}"
    return f"{score.mean:.4g}{spread} over {evaluation.episodes} episodes"
