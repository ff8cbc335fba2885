"""The documentation site: `sphinx-build -W --keep-going docs docs/_build`, with the extra `docs`.

Pages are the files of docs/, which are also read as they are; the reference is made from docstrings and options.
"""

import contextlib
import io
import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.util.images import get_image_size

from pgts_torch.cli.arguments import value_text
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
html_favicon, pygments_dark_style = "_static/icon.svg", "github-dark"
smartquotes_action = "D"  # dashes only: quotes are those of code
highlight_language = "text"  # of blocks without a language: formulas, what a program prints
exclude_patterns = ["_build", "figures"]
# Tutorials are run where they have changed; a cell that fails ends the build.
nb_execution_mode, nb_execution_cache_path = "cache", str(HERE / "_build/.jupyter_cache")
nb_execution_timeout, nb_execution_raise_on_error = 600, True
nb_output_stderr, nb_merge_streams = "remove", True  # what an iteration costs on this machine
SHARPNESS = 2  # dots of a tutorial's picture in one of the page
os.environ["MATPLOTLIBRC"] = str(HERE / "matplotlibrc")  # read by the cells
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
    lines[:] = [part for line in lines for part in _SEVERAL.sub(rf"\n{line[: -len(line.lstrip())]}", line).split("\n")]
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
_SEVERAL = re.compile(rf"(?<=[.;])   (?={_ITEM.pattern})")
"""Between two items of a line."""


def _escaped(line: str) -> str:
    """A line in which only backticks are markup."""
    parts = re.split(r"``?([^`]+)``?", line)
    text = "".join(f"``{part}``" if k % 2 else re.sub(r"([*_|\\])", r"\\\1", part) for k, part in enumerate(parts))
    return re.sub(r"docs/(\w+)\.md", r":doc:`\1 </\1>`", text)


def _write_reference(app: Any) -> None:
    """The pages that are made from options and commands."""
    (HERE / "reference/options.rst").write_text("\n".join(_options()), encoding="utf-8")
    (HERE / "reference/commands.md").write_text("\n".join(_commands()), encoding="utf-8")


ABOUT_OPTIONS = """\
Options
=======

Keys of a configuration; ``pgts train`` takes them as ``--KEY VALUE``. A mapping replaces its whole section, as in
``--critic '{type: exact}'``, and so does a word, as in ``--critic exact``.

.. program:: pgts train
"""


def _options() -> Iterator[str]:
    """The lines of the page on options: of each what it may be, its default and its meaning."""
    options = schema_of(Config).options()
    dotted = "|".join(re.escape(option.key) for option in options if "." in option.key)

    def prose(text: str) -> str:
        return _escaped(re.sub(rf"(--)?\b({dotted})\b(\.\w+)?", r"`\g<0>`", text))

    yield ABOUT_OPTIONS
    section = ""
    for option in options:
        if section != (section := option.key.partition(".")[0] if "." in option.key else "general"):
            yield from (section, "-" * len(section), "")
        where = " and ".join(f"``{key}`` {' or '.join(values)}" for key, values in option.when)
        default = f"default ``{value_text(option.default)}``" + (f"; with {where}" if where else "")
        yield from (f".. option:: --{option.key}", "", f"   *{_escaped(option.requirement)}*, {default}", "")
        yield from (f"   {prose(option.meaning)}", "")
        yield from (f"   - ``{value}``: {prose(meaning)}" for value, meaning in option.choices)
        yield ""


def _commands() -> Iterator[str]:
    """The lines of the page on commands: what each says with --help, but for the keys of a configuration."""
    yield from ("# Commands", "")
    for name, command in COMMANDS.items():
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
            command(["--help"])
        text = out.getvalue().partition("\nkeys, each")[0].rstrip()
        yield from (f"## pgts {name}", "", "```text", text, "```", "")
    yield "The keys of `pgts train` are [a page of their own](options.rst)."


def _files_of_the_repository(app: Any, doctree: nodes.document, page: str) -> None:
    """Links of the README to files beside it, which `html_extra_path` puts beside the first page."""
    for link in doctree.findall(nodes.reference):
        if link.get("refid") in FILES:
            link["refuri"] = link.attributes.pop("refid")


def _sharp_pictures(app: Any, doctree: nodes.document, page: str) -> None:
    """Pictures of tutorials in the size that they were drawn for, on screens of every resolution."""
    for image in doctree.findall(nodes.image):
        if page.startswith("tutorials/") and (size := get_image_size(Path(app.srcdir) / image["uri"])):
            image["width"] = f"{size[0] // SHARPNESS}px"


def setup(app: Any) -> None:
    app.connect("doctree-resolved", _files_of_the_repository)
    app.connect("doctree-resolved", _sharp_pictures)
    app.connect("builder-inited", _write_reference)
    app.connect("autodoc-process-docstring", _as_rst, priority=400)  # before napoleon
