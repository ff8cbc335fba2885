"""Modules that a user names. Importing one runs its code, so in saved files they need the caller's consent."""

import importlib
import os
import re
import sys
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import Any

from pgts_torch.errors import PgtsError, failure

_NAMES_MODULE = re.compile(r"\s*([^\W\d]\w*(?:\.[^\W\d]\w*)*)\s*:\s*[^\W\d]")
"""MODULE:ID, as in ids of Gymnasium and entry points; it does not match a URL or a time."""


def import_named(module: str) -> ModuleType:
    """Import a module that the user has named. It may lie in the working folder, which is looked at last, so that
    nothing in there takes the place of what is installed; ModuleNotFoundError if there is none."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        here = os.getcwd()
        if error.name != module.partition(".")[0] or here in sys.path:
            raise
    sys.path.append(here)  # for good: it may import its neighbours later
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        sys.path.remove(here)
        raise


def made_by(what: str, make: str, *given: Any, **arguments: Any) -> Any:
    """Return what a class or a function that the user has named, MODULE:NAME, makes.

    Args:
        what: it is, in errors.

    Raises:
        PgtsError: its module cannot be imported, or has no such name, or the call fails.
    """
    module, _, name = make.partition(":")
    of = ""
    try:
        found = import_named(module)
        if (maker := getattr(found, name, None)) is None:
            where = getattr(found, "__file__", None)  # it need not be the file that is meant
            raise AttributeError(f"module {module!r} ({where or 'a folder'}) has no attribute {name!r}")
        of = f" of {' and '.join(map(str, given))}" if given else ""
        return maker(*given, **arguments)
    except BaseException as error:
        raise failure(f"{what} {make}, which cannot be made{of}", error) from error


def check_imports(source: object, env: Any, kwargs: Any, **parts: Any) -> None:
    """Refuse a saved environment, or another part of a training, whose options name a module to import.

    Args:
        source: the file, as named in errors.
        env, kwargs: the id and the arguments of the environment.
        parts: the options of other parts, by name.

    Raises:
        PgtsError: a string in them names a module.
    """
    named = [(name, each) for name, part in ({"environment": [env, kwargs]} | parts).items() for each in _texts(part)]
    for what, text in named:
        is_id = text is env and ":" in text
        if is_id or _NAMES_MODULE.match(text):
            raise PgtsError(
                f"{source} names {text!r} as its {what}; that imports the module {text.rpartition(':')[0]}, which "
                "may do anything: if you trust the file, say so by trust_imports=True, or --trust-imports"
            )


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        yield from _texts([*value.keys(), *value.values()])
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _texts(each)
