"""The facts about a run as one HTML page: no script, nothing from elsewhere, every text escaped."""

import base64
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from string import Template
from typing import Any

from matplotlib.figure import Figure

from pgts_torch.experiment.pictures import single_pictures
from pgts_torch.experiment.report.curves import Panel
from pgts_torch.experiment.report.drawing import svg
from pgts_torch.experiment.report.facts import Certificate, Facts, Trained
from pgts_torch.experiment.report.markup import Html, element, join, typeset
from pgts_torch.experiment.report.settings import Setting
from pgts_torch.experiment.report.style import STYLE
from pgts_torch.experiment.resume import resuming
from pgts_torch.tabular import exact

PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="generator" content="pgts report">
<title>$title</title>
<style>
$style</style>
</head>
<body>
$body
</body>
</html>
""")

_SIGNS = ('<meta name="generator" content="pgts report">', f"</title>\n<style>\n{STYLE[:200]}")
"""What is in each page, and in those of version 0.1."""

PROVED = (
    "proved",
    "All start states are known, the critic is exact and the model is the environment, so it is a proof.",
)
FOLDER = "run folder"
ESTIMATED = (
    "an estimate",
    "It is off by what the critic is off at the start states. Where these are known from episodes only, it holds with "
    "95 % over their draw, for all iterations together.",
)


def is_page(raw: bytes) -> bool:
    """Whether the content of a file is a page that was made here."""
    return any(sign.encode() in raw for sign in _SIGNS)


def page(facts: Facts, trained: Trained | None) -> str:
    """The whole page."""
    parts = [
        _head(facts),
        _notes(facts.notes),
        _section("Summary", *_tiles(facts.rows)),
        _section("Certificate", *_certificate(facts.certificate)),
        *([_section("Policy", *_pictures(trained))] if trained else []),
        *(_section(heading, _panels(panels)) for heading, panels in facts.curves.items()),
        *_tags_without_a_curve(facts),
        _section("Configuration", *_configuration(facts.config)),
        element(
            "div",
            _section("Versions", _table(facts.versions)),
            _section("Files", _table({name: _size(count) for name, count in facts.files.items()})),
            class_="grid",
        ),
    ]
    return PAGE.substitute(title=escape(f"{facts.name}, {facts.env}"), style=STYLE, body="\n".join(parts))


def _head(facts: Facts) -> Html:
    depth = next((setting.value for setting in facts.config if setting.key == "search.depth"), None)
    return element(
        "header",
        element("h1", facts.name, " ", element("span", facts.state, class_=f"state {facts.state}")),
        element("p", f"{facts.env}, lookahead depth {depth}, seed {facts.seed}", class_="what"),
        *_state(facts),
    )


def _state(facts: Facts) -> Iterator[Html]:
    """Why a run has not come to its end."""
    failure = facts.failure
    if failure is not None:
        tensor = failure.get("tensor")
        what = "" if tensor is None else f", by a {tensor} that is not finite"
        where = f"Training stopped in iteration {failure.get('iteration')}, at step {failure.get('env_step')}{what}"
        yield element("p", f"{where}: {failure.get('message')}", class_="box")
    elif facts.state == "unfinished":
        yield element(
            "p",
            f"{facts.step:,} of {facts.total_steps:,} environment steps are made. Unless it is still being trained, ",
            element("code", resuming(facts.run, facts.world_size, facts.env)),
            " goes on.",
            class_="box",
        )


def _notes(notes: Sequence[str]) -> Html:
    return element("ul", *(element("li", note) for note in notes), class_="box notes") if notes else Html("")


def _section(heading: str, *content: Html) -> Html:
    return element("section", element("h2", heading), *content)


def _tiles(rows: Mapping[str, str]) -> Iterator[Html]:
    """Numbers large, with what is said about them below; then the values that are text."""
    numbers = {name: value for name, value in rows.items() if name != FOLDER and _begins_with_a_number(value)}
    yield element("dl", *(_number(typeset(name), value) for name, value in numbers.items()), class_="tiles")
    texts = [(name, value) for name, value in rows.items() if name not in numbers]
    if texts:
        yield element("dl", *(_tile(name, element("dd", value)) for name, value in texts), class_="tiles text")


def _begins_with_a_number(value: str) -> bool:
    try:
        float(value.partition(" ")[0])
    except ValueError:
        return False
    return True


def _number(name: str, value: str) -> Html:
    first, _, rest = value.partition(" ")
    shown = f"{int(first):,}" if first.isdecimal() else typeset(first)
    remark = [element("dd", typeset(rest.strip("()")), class_="remark")] if rest else []
    return _tile(name, element("dd", shown, class_="number"), *remark)


def _tile(name: str, *values: Html) -> Html:
    return element("div", element("dt", name), *values, class_="tile")


def _certificate(certificate: Certificate) -> Iterator[Html]:
    """What the certificate is, and how far it can be trusted."""
    if not certificate.is_known:
        yield element("p", "Not known yet: no iteration has been written down.")
        return
    if certificate.bound is None:
        yield element(
            "p",
            "None: nothing can be said here. It takes a largest reward that is known, a search that lists outcomes, "
            "and start states that are known or many that were drawn.",
        )
        return
    kind, trust = PROVED if certificate.is_proved else ESTIMATED
    missing = "" if certificate.missing is None else f" The truth is known here: {certificate.missing:.3g}."
    bound = typeset(f"J* - J <= {certificate.bound:.3g} ")
    yield element("p", bound, element("span", kind, class_="remark"), class_="bound")
    yield element(
        "p",
        "It bounds how much more than this policy any policy can get from the start states, in discounted reward. "
        f"{trust}{missing}",
    )


def _pictures(trained: Trained) -> Iterator[Html]:
    """v^pi and pi of the last checkpoint."""
    J = exact.evaluate(trained.mdp, trained.pi_SA).J
    best = exact.optimal(trained.mdp).J
    states, names = trained.mdp.num_states, ", ".join(trained.mdp.action_names)
    yield element(
        "p",
        typeset(
            f"The policy after {trained.step:,} environment steps, held to the exact world: J = {J:.4g}, and the best "
            f"policy has J* = {best:.4g}."
        ),
    )
    value, policy = single_pictures(trained.mdp, trained.pi_SA)
    captions = (
        ("Value v(s) of the policy", f"Exact value of the policy in each of {states} states.", value),
        ("Policy", f"Probability of each action ({names}) in each of {states} states.", policy),
    )
    figures = (
        element("figure", element("figcaption", title), _png(figure, alt), class_="card picture")
        for title, alt, figure in captions
    )
    yield element("div", *figures, class_="wide grid" if _is_row(trained) else "grid")
    if states > 1:
        yield element("p", "Start states are outlined, unless many or all are; states that are never visited are pale.")


def _is_row(trained: Trained) -> bool:
    rows, columns = trained.mdp.shape
    return columns > 3 * max(rows, 4)


def _png(figure: Figure, alt: str) -> Html:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return element("img", src=f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}", alt=alt)


def _panels(panels: Sequence[Panel]) -> Html:
    return element("div", *map(_panel, panels), class_="grid")


def _panel(panel: Panel) -> Html:
    tags = [element("code", curve.tag) for curve in panel.curves]
    caption = element("figcaption", panel.title, " ", element("span", *_listed(tags), class_="tags"))
    return element("figure", caption, svg(panel), class_="card")


def _listed(items: Sequence[str]) -> Iterator[str]:
    for number, item in enumerate(items):
        yield from (", ", item) if number else (item,)


def _tags_without_a_curve(facts: Facts) -> Iterator[Html]:
    if facts.constant:
        values = [join([element("code", tag), f" {value:.6g}"]) for tag, value in facts.constant.items()]
        yield element("p", "The same all the time: ", *_listed(values), ".")
    if facts.never_finite:
        tags = [element("code", tag) for tag in facts.never_finite]
        yield element("p", "Never a finite number: ", *_listed(tags), ".")


def _configuration(settings: Sequence[Setting]) -> Iterator[Html]:
    yield element(
        "p", element("mark", "Marked"), " keys differ from their defaults, which stand behind them unless null."
    )
    yield element("table", element("tbody", *map(_setting, settings)), class_="configuration")


def _setting(setting: Setting) -> Html:
    if setting.is_default:
        return element("tr", element("th", setting.key, scope="row"), element("td", _plain(setting.value)))
    remark = [] if setting.default is None else [" ", element("span", f"({_plain(setting.default)})", class_="remark")]
    value = element("td", element("mark", _plain(setting.value)), *remark)
    return element("tr", element("th", setting.key, scope="row"), value)


def _plain(value: Any) -> str:
    if isinstance(value, str):
        return value
    return f"{value:,}" if type(value) is int else json.dumps(value)


def _table(values: Mapping[str, Any]) -> Html:
    lines = (
        element("tr", element("th", name, scope="row"), element("td", "none" if value is None else str(value)))
        for name, value in values.items()
    )
    return element("table", element("tbody", *lines))


def _size(count: int) -> str:
    if count < 1000:
        return f"{count} bytes"
    return f"{count / 1e3:,.0f} kB" if count < 1e6 else f"{count / 1e6:,.1f} MB"
