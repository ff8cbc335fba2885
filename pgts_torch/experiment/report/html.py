"""HTML pages with their pictures inside: they have no scripts, load nothing from elsewhere, and escape all text."""

import base64
import io
import json
import re
from collections.abc import Callable, Mapping
from typing import Any

import jinja2
import matplotlib
from matplotlib.figure import Figure

from pgts_torch.experiment.report.curves import INK

DARK = f'@media (prefers-color-scheme: dark) {{ [style*="{INK}"] {{ fill: #e4e7ec !important }} }}</style>'

Filters = Mapping[str, Callable[..., Any]]


def render(template: str, values: Mapping[str, Any], *, filters: Filters) -> bytes:
    """Return the page that a template of this folder makes of some values."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("pgts_torch.experiment.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"typeset": typeset, "json": json.dumps, **filters}
    return environment.get_template(template).render(values).encode()


def image(figure: Figure, *, transparent: bool = False) -> str:
    """Return a figure as the `src` of an image, the same bytes each time; a transparent one fits a dark page, too."""
    # The salt makes ids reproducible. Simplification by up to a pixel keeps curves of many points small.
    file = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "pgts", "path.simplify_threshold": 1.0}):
        figure.savefig(file, format="svg", dpi=150, transparent=transparent, metadata={"Date": None, "Creator": None})
    svg = file.getvalue().replace("</style>", DARK, 1)
    return f"data:image/svg+xml;base64,{base64.b64encode(svg.encode()).decode()}"


def typeset(text: str) -> str:
    """Replace <=, +- and minus signs of ASCII text by their typographic characters."""
    text = text.replace("<=", "\N{LESS-THAN OR EQUAL TO}").replace("+-", "\N{PLUS-MINUS SIGN}")
    return re.sub(r"(?<![A-Za-z0-9])-(?=[ 0-9])|(?<=[0-9]e)-(?=[0-9])", "\N{MINUS SIGN}", text)
