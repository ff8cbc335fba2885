"""docs/reproduction.md, written from the plain data of the parts and nothing else."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from study import PARTS
from study.curves import ARRIVED

Data = Mapping[str, Any]

HEAD = "# The paper, reproduced and checked\n\nWritten by `python -m study`;"
"""How each document begins."""

CONTRADICTION = "paper: "
"""How the source of a parameter begins on which the paper contradicts itself."""


def document(parts: Mapping[str, Data]) -> str:
    """The whole document. Parts that are missing are named."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"number": number, "codes": codes, "depth": "m = {}".format}
    functions = {"head": head, "row": row, "arrivals": arrivals, "until": until, "best": best}
    claims = [{"part": parts[name], **claim} for name, claim in claim_rows(parts)]
    return environment.get_template("document.md.jinja").render(
        parts={name: parts[name] for name in PARTS if name in parts},
        quick=[name for name in PARTS if name in parts and parts[name]["quick"]],
        missing=[name for name in PARTS if name not in parts],
        claims=claims,
        verdicts=[claim["verdict"] for claim in claims],
        failed=[claim for claim in claims if claim["verdict"] != "holds" and "question" not in claim["place"]],
        unanswered=[claim for claim in claims if claim["verdict"] != "holds" and "question" in claim["place"]],
        contradiction=CONTRADICTION,
        beginning=HEAD,
        **functions,
    )


def claim_rows(parts: Mapping[str, Data]) -> list[tuple[str, Data]]:
    """(part, claim) of all parts, in the order of the document."""
    return [(name, claim) for name in PARTS if name in parts for claim in parts[name]["claims"]]


def is_document(raw: bytes) -> bool:
    """Whether the content of a file is a document that was made here."""
    return raw.startswith(HEAD.encode())


def head(*columns: str) -> str:
    """The first two lines of a table."""
    return f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}"


def row(*cells: Any) -> str:
    """A line of a table, in which bars would end a cell."""
    return f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in cells)} |"


def number(value: float | None, digits: int = 5) -> str:
    """So many digits, or none."""
    return "none" if value is None else f"{value:.{digits}g}"


def codes(names: Iterable[str]) -> str:
    """Names in the letters of code, one after the other."""
    return ", ".join(f"`{name}`" for name in names)


def arrivals(panel: Data) -> list[str]:
    """For each sampled depth the arrival of the exact curve and that of the sampled ones."""
    found = ((panel["exact"][m], band["iqm"]) for m, band in panel["sampled"].items())
    return [" / ".join(_arrival(J_K, panel["J_optimal"]) for J_K in pair) for pair in found]


def _arrival(J_K: Sequence[float], J_optimal: float) -> str:
    """The first iteration with 99 % of the way made, or that there is none among those shown."""
    goal = J_K[0] + ARRIVED * (J_optimal - J_K[0])
    return next((str(k) for k, J in enumerate(J_K) if goal <= J), f"> {len(J_K) - 1}")


def until(witness: Data) -> str:
    """At which depths a witness is stationary."""
    if witness["escapes_at"] is None:
        return "stationary at every depth"
    if witness["stationary_at"] is None:
        return "not stationary at m = 0"
    return f"stationary at m = {witness['stationary_at']}, not at m = {witness['escapes_at']}"


def best(one: Data) -> tuple[str, str]:
    """The fewest iterations of PG, and of any depth, with the best step size for each."""
    fewest = [min((k for k in row if k is not None), default=float("inf")) for row in one["iterations"]]
    shown = ["never" if k == float("inf") else f"{k:g}" for k in fewest]
    deepest = min(range(1, len(fewest)), key=fewest.__getitem__)
    return shown[0], f"{shown[deepest]} (m = {one['depths'][deepest]})"
