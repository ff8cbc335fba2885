"""The documentation site: `sphinx-build -W --keep-going docs docs/_build`, with the extra `docs`.

Pages are the files of docs/, which are also read as they are; the reference is made from docstrings and options.
"""

import re
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes

from pgts_torch.cli.arguments import describe_options
from pgts_torch.cli.commands import COMMANDS
from pgts_torch.config import Config
from pgts_torch.options.schema import schema_of

HERE = Path(__file__).parent

project, author = "pgts_torch", "the authors of pgts_torch"
version = release = tomllib.loads((HERE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
FILES = ["CITATION.cff", "SECURITY.md"]
html_extra_path = [f"../{name}" for name in FILES]
html_static_path, html_css_files, html_show_copyright = ["_static"], ["site.css"], False
highlight_language = "text"  # of blocks without a language: formulas, what a program prints
exclude_patterns = ["_build", "figures"]
# Tutorials are run where they have changed; a cell that fails ends the build.
nb_execution_mode, nb_execution_cache_path = "cache", str(HERE / "_build/.jupyter_cache")
nb_execution_timeout, nb_execution_raise_on_error = 600, True
nb_output_stderr = "remove"  # what an iteration costs on this machine
html_theme, html_title = "furo", f"pgts_torch {version}"
myst_heading_anchors = 3
autodoc_member_order, autodoc_typehints = "bysource", "none"
napoleon_use_rtype = napoleon_use_param = False
suppress_warnings = ["myst.xref_missing"]  # links to files of the repository, which a test follows


def _as_rst(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text: an indented paragraph is a formula, "name: what it is" an item, a name in backticks
    code. Sections (Args, Returns, Raises) are left to napoleon."""
    text: list[str] = []
    in_section = in_formula = in_item = False
    for line, before in zip(lines, ["", *lines], strict=False):
        in_section = in_section or line in _SECTIONS
        if in_formula and line and not line.startswith("    "):
            text.append("")
        begins = not in_section and not in_formula and line.startswith("    ") and not before.strip()
        in_formula = begins or (in_formula and (line.startswith("    ") or not line.strip()))
        if in_section or in_formula:
            in_item = False
            text += (["", "::", ""] if begins else []) + [_escaped(line) if in_section else line]
        elif _ITEM.match(line) and (in_item or not before.strip()):
            text += [*([] if in_item else [""]), f"- {_escaped(line)}"]
            in_item = True
        elif in_item and line.startswith("    "):
            text.append(f"  {_escaped(line.strip())}")
        else:
            text += [*([""] if in_item and line else []), _escaped(line)]
            in_item = False
    lines[:] = text


_SECTIONS = ("Args:", "Returns:", "Raises:", "Yields:")
_ITEM = re.compile(r"[a-zA-Z_]\w*(, [a-zA-Z_]\w*)*: ")


def _escaped(line: str) -> str:
    """A line in which only backticks are markup."""
    parts = re.split(r"``?([^`]+)``?", line)
    return "".join(f"``{part}``" if k % 2 else re.sub(r"([*_|\\])", r"\\\1", part) for k, part in enumerate(parts))


def _write_reference(app: Any) -> None:
    """The pages that are made from options and commands."""
    options = "\n".join(describe_options(schema_of(Config).options()))
    page = f"# Options\n\nAs `pgts train --help` prints them.\n\n```text\n{options}\n```\n"
    (HERE / "reference/options.md").write_text(page, encoding="utf-8")
    commands = "".join(
        f"- `pgts {name}`: {(function.__doc__ or '').splitlines()[0]}\n" for name, function in COMMANDS.items()
    )
    (HERE / "reference/commands.md").write_text(
        f"# Commands\n\n{commands}\nEach explains itself with `--help`.\n", encoding="utf-8"
    )


def _files_of_the_repository(app: Any, doctree: nodes.document, page: str) -> None:
    """Links of the README to files beside it, which `html_extra_path` puts beside the first page."""
    for link in doctree.findall(nodes.reference):
        if link.get("refid") in FILES:
            link["refuri"] = link.attributes.pop("refid")


def setup(app: Any) -> None:
    app.connect("doctree-resolved", _files_of_the_repository)
    app.connect("builder-inited", _write_reference)
    app.connect("autodoc-process-docstring", _as_rst, priority=400)  # before napoleon
