"""docs/reproduction.md, written from the plain data of the parts and nothing else."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from study import PARTS
from study.curves import ARRIVED

Data = Mapping[str, Any]

NOTES = {
    "curves": "Solid: Algorithm 1 with exact quantities. Dashed: PGTS from samples, interquartile mean over seeds with "
    "its 95 % bootstrap interval. Lines that lie on each other are drawn broad (small m) to thin (large m).",
    "depth": "Iterations that exact Algorithm 1 (projected update) needs to make 99 % of the way from the return of "
    "the initial policy to J*. An iteration of depth m costs m more sweeps; that is not counted.",
    "mirage": "`mirage()`: in state 0, right earns 1 a step from then on; left leads to one of several states that "
    "could earn nearly as much but do not under the initial policy. The deeper the lookahead, the less it minds going "
    "left, and the smaller the step that the start state takes.",
    "stationary": "Sufficient depth M (the smallest with Pi^M all optimal) of random MDPs, by enumeration: means with "
    "95 % intervals; groups of fewer than five MDPs are left out.",
}


def document(parts: Mapping[str, Data]) -> str:
    """The whole document. Parts that are missing are named."""
    return "\n".join(_lines(parts)) + "\n"


def claim_rows(parts: Mapping[str, Data]) -> list[tuple[str, Data]]:
    """(part, claim) of all parts, in the order of the document."""
    return [(name, claim) for name in PARTS if name in parts for claim in parts[name]["claims"]]


def is_document(raw: bytes) -> bool:
    """Whether the content of a file is a document that was made here."""
    return raw.startswith(b"# The paper, reproduced and checked\n\nWritten by `python -m study`;")


def _lines(parts: Mapping[str, Data]) -> Iterator[str]:
    yield "# The paper, reproduced and checked"
    yield ""
    yield "Written by `python -m study`; do not edit. Each number and picture comes from `figures/*.json`, which the"
    yield "same command writes. References are to the paper (PGTS)."
    yield ""
    quick = [name for name in PARTS if name in parts and parts[name]["quick"]]
    missing = [name for name in PARTS if name not in parts]
    if quick:
        yield f"**Made with `--quick`** (fewer seeds, depths and readings): {', '.join(quick)}."
        yield ""
    if missing:
        commands = ", ".join(f"`python -m study --only {name}`" for name in missing)
        yield f"**Not computed yet:** {', '.join(missing)}. Run {commands}."
        yield ""
    yield from _summary(parts)
    for name in PARTS:
        if name in parts:
            yield from _part(name, parts[name])
    yield from _errors(parts)
    yield from _silences(parts)


def _summary(parts: Mapping[str, Data]) -> Iterator[str]:
    rows = claim_rows(parts)
    count = [sum(claim["verdict"] == verdict for _, claim in rows) for verdict in ("holds", "does not hold", "depends")]
    yield "## Statements and verdicts"
    yield ""
    yield f"{len(rows)} statements of the paper, each decided by a computation: {count[0]} hold, {count[1]} do not,"
    yield f"{count[2]} depend on something that the paper leaves unsaid, and its readings disagree. Measured is what"
    yield "the reading of the figure gave and, where another one disagrees, what the first of those gave."
    yield ""
    for name in PARTS:
        if name in parts:
            yield f"### {parts[name]['title']}: statements"
            yield ""
            yield from _claims(parts[name]["claims"])


def _claims(claims: Sequence[Data]) -> Iterator[str]:
    rows = [(claim["text"], claim["place"], claim["measured"], _verdict(claim)) for claim in claims]
    yield from _table(("statement", "place", "measured", "verdict"), rows)


def _verdict(claim: Data) -> str:
    verdict = f"**{claim['verdict']}**"
    return f"{verdict}: {claim['condition']}" if claim["condition"] else verdict


def _part(name: str, data: Data) -> Iterator[str]:
    yield f"## {data['title']}"
    yield ""
    yield f"Made by `python -m study --only {name}{' --quick' if data['quick'] else ''}`."
    yield ""
    if name == "stationary":
        yield from _stationary(data)
    elif name == "depth":
        yield from _depth(data)
    else:
        yield from _picture(name, NOTES["curves"] + f" {data['seeds']} seeds.")
        yield "Iterations to 99 % of the way from J of the initial policy to J*, exact / from samples (of the IQM):"
        yield ""
        yield from _sampled_table(data["panels"])
    yield from _table(
        ("parameter", "value", "source"), [(p["name"], p["value"], p["source"]) for p in data["parameters"]]
    )


def _sampled_table(panels: Sequence[Data]) -> Iterator[str]:
    depths = list(panels[0]["sampled"])
    rows = [
        (
            panel["update"],
            panel["start"],
            *(f"{_arrival(panel['exact'][m], panel)} / {_arrival(panel['sampled'][m]['iqm'], panel)}" for m in depths),
        )
        for panel in panels
    ]
    yield from _table(("update", "start", *(f"m = {m}" for m in depths)), rows)


def _arrival(J_K: Sequence[float], panel: Data) -> str:
    """The first iteration with 99 % of the way made, or that there is none among those shown."""
    goal = J_K[0] + ARRIVED * (panel["J_optimal"] - J_K[0])
    return next((str(k) for k, J in enumerate(J_K) if goal <= J), f"> {len(J_K) - 1}")


def _picture(name: str, note: str) -> Iterator[str]:
    yield f"![{name}](figures/{name}.png)"
    yield ""
    yield note
    yield ""


def _stationary(data: Data) -> Iterator[str]:
    yield "### Table 1, printed and correct"
    yield ""
    legend = next(iter(data["table1"].values()))["legend"]
    yield f"Policies by the probability of 'right' in s0, s1, ...: {legend}."
    yield "A class stands in the row of the last depth at which it is stationary. Patterns: how many of the 3^S ones"
    yield "of 0, x and 1 are in Pi^m as a whole."
    yield ""
    for name, table in data["table1"].items():
        yield f"**{name.capitalize()}**"
        yield ""
        yield from _table(("m", "printed", "patterns", "correct: last stationary at m", "patterns"), _table_rows(table))
        yield f"Stationary at every depth: {_classes(table['staying'])}."
        yield ""
        yield from _differences(table)
    yield "### How many, how bad, how deep"
    yield ""
    yield "Deterministic policies, enumerated; `J* - b^m` is how bad the worst stationary policy is, and the bounds of"
    yield "`docs/theory.md` (Prop. 3 and its corollary) stand beside it."
    yield ""
    for name, study in data["counted"].items():
        counted, J = study["num_policies"], _number(study["J_optimal"])
        yield f"**{name}**: {counted} policies, J\\* = {J}, sufficient depth M = {study['sufficient_depth']}"
        yield ""
        keys = ("depth", "count", "worst_return", "lack", "value_bound", "reachable_bound", "closed_form_bound")
        header = ("m", "\\|Pi^m\\|", "b^m", "J\\* - b^m", "bound by values", "by reach", "closed form")
        yield from _table(header, [tuple(_number(row[key]) for key in keys) for row in study["depths"]])
    yield from _picture("stationary", NOTES["stationary"])


def _table_rows(table: Data) -> Iterator[tuple[str, ...]]:
    for printed, correct in zip(table["printed"], table["correct"], strict=True):
        classes = [_classes(correct["leaving"])] if correct["leaving"] else []
        classes += [f"{_classes(some['classes'])} where {some['condition']}" for some in correct["conditional"]]
        yield (
            str(printed["depth"]),
            printed["printed"],
            str(printed["patterns"]),
            ", ".join(classes) or "none",
            str(correct["patterns"]),
        )


def _classes(classes: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in classes)


def _differences(table: Data) -> Iterator[str]:
    if not table["differences"]:
        yield "Printed and correct agree."
        yield ""
        return
    yield "Where they differ, with a witness that a test checks:"
    yield ""
    rows = []
    for row in table["differences"]:
        name = f"`{row['class']}`" + (f" where {row['condition']}" if row["condition"] else "")
        witness = ", ".join(_number(p) for p in row["witness"])
        until = "stationary at every depth" if row["escapes_at"] is None else _until(row)
        rows.append((row["kind"], name, row["printed_in"], row["belongs_in"], f"({witness}): {until}"))
    yield from _table(("", "class", "printed in", "belongs in", "witness"), rows)


def _until(row: Data) -> str:
    if row["stationary_at"] is None:
        return "not stationary at m = 0"
    return f"stationary at m = {row['stationary_at']}, not at m = {row['escapes_at']}"


def _depth(data: Data) -> Iterator[str]:
    yield from _picture("depth", NOTES["depth"])
    rows = [
        (one["mdp"], one["start"], *(str(one[key]) for key in ("faster", "equal", "slower")), *_best(one))
        for one in data["maps"]
    ]
    header = ("MDP", "start", "m >= 1 faster than PG", "equal", "slower (cells)", "PG, best step", "best m >= 1")
    yield from _table(header, rows)
    yield "### Where more depth is slower"
    yield ""
    yield from _picture("mirage", NOTES["mirage"])
    shown = data["mirage"]
    header = ("m", *shown["arrival"])
    yield from _table(
        header,
        [
            ("arrival (iteration)", *(_number(k) for k in shown["arrival"].values())),
            ("advantage of right in state 0", *(f"{a:.4g}" for a in shown["advantage"].values())),
            ("formula", *(f"{a:.4g}" for a in shown["formula"].values())),
        ],
    )
    yield "The Tightrope shows the same. Once s1 goes right, plain PG compares going right with staying left for ever;"
    yield "a lookahead compares it with going right one step later, and the advantage of 'right' in s0 shrinks:"
    yield ""
    advantage = data["tightrope_advantage"]
    yield from _table(("m", *advantage), [("advantage of right in s0", *(f"{a:.3g}" for a in advantage.values()))])


def _best(one: Data) -> tuple[str, str]:
    """The fewest iterations of PG, and of any depth, with the best step size for each."""
    rows = [[float("inf") if k is None else k for k in row] for row in one["iterations"]]
    deepest = min(range(1, len(rows)), key=lambda row: min(rows[row]))
    fewest = min(rows[deepest])
    return _count(min(rows[0])), f"{_count(fewest)} (m = {one['depths'][deepest]})"


def _count(iterations: float) -> str:
    return "never" if iterations == float("inf") else f"{iterations:g}"


def _errors(parts: Mapping[str, Data]) -> Iterator[str]:
    rows = [(name, claim) for name, claim in claim_rows(parts) if claim["verdict"] != "holds"]
    stated = [row for row in rows if not _is_open(row[1])]
    yield "## What the paper gets wrong"
    yield ""
    yield "Its statements that fail, with the evidence."
    yield ""
    yield from _evidence(parts, [row for row in stated if row[1]["verdict"] == "does not hold"])
    yield "Those that fail under some readings of what it leaves unsaid."
    yield ""
    yield from _evidence(parts, [row for row in stated if row[1]["verdict"] == "depends"])
    yield "Where it contradicts itself; both readings were tried."
    yield ""
    for name in PARTS:
        for parameter in parts.get(name, {}).get("parameters", ()):
            if parameter["source"].startswith(CONTRADICTION):
                source = parameter["source"].removeprefix(CONTRADICTION)
                yield f"- {parts[name]['title']}, {parameter['name']}: {source}. Here: {parameter['value']}."
    yield ""
    yield "Its open questions and hypotheses, where the answer is not a plain yes."
    yield ""
    yield from _evidence(parts, [row for row in rows if _is_open(row[1])])


CONTRADICTION = "paper: "
"""How the source of a parameter begins on which the paper contradicts itself."""


def _is_open(claim: Data) -> bool:
    return "question" in claim["place"]


def _evidence(parts: Mapping[str, Data], rows: Sequence[tuple[str, Data]]) -> Iterator[str]:
    for name, claim in rows:
        condition = f" ({claim['condition']})" if claim["condition"] else ""
        where = f"{parts[name]['title']}, {claim['place']}"
        yield f"- {where}: {claim['text']}{condition}. Measured: {claim['measured']}."
    yield ""


def _silences(parts: Mapping[str, Data]) -> Iterator[str]:
    yield "## What the paper does not say"
    yield ""
    yield "Parameters that we had to choose."
    yield ""
    rows = [
        (parts[name]["title"], parameter["name"], parameter["value"])
        for name in PARTS
        for parameter in parts.get(name, {}).get("parameters", ())
        if parameter["source"].startswith("not stated")
    ]
    yield from _table(("part", "parameter", "our choice"), rows)


def _table(header: Sequence[str], rows: Iterator[Sequence[str]] | Sequence[Sequence[str]]) -> Iterator[str]:
    yield "| " + " | ".join(header) + " |"
    yield "|" + "---|" * len(header)
    for row in rows:
        yield "| " + " | ".join(_cell(text) for text in row) + " |"
    yield ""


def _cell(text: str) -> str:
    """Bars would end a cell of the table."""
    return text.replace("\\|", "|").replace("|", "\\|")


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.5g}"
