"""Names of modules in saved files: importing a module runs its code, so it needs the caller's consent."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from pgts_torch.errors import PgtsError

_NAMES_MODULE = re.compile(r"\s*([^\W\d]\w*(?:\.[^\W\d]\w*)*)\s*:\s*[^\W\d]")
"""MODULE:ID, as in ids of Gymnasium and entry points; it does not match a URL or a time."""


def check_imports(source: object, env: Any, kwargs: Any, model: Any = None) -> None:
    """Refuse a saved environment or model whose options name a module to import.

    Args:
        source: the file, as named in errors.
        env, kwargs: the id and the arguments of the environment.
        model: the options of its model.

    Raises:
        PgtsError: a string in them names a module.
    """
    named = [("environment", each) for each in _texts([env, kwargs])] + [("model", each) for each in _texts(model)]
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
