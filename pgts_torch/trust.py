"""Names of modules in what was saved: importing one runs its code, so somebody must have said that it may be."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from pgts_torch.errors import PgtsError

_NAMES_MODULE = re.compile(r"\s*([^\W\d]\w*(?:\.[^\W\d]\w*)*)\s*:\s*[^\W\d]")
"""MODULE:ID, as an id of Gymnasium or an entry point has it; not a URL or a time."""


def check_imports(source: object, env: Any, kwargs: Any) -> None:
    """Make sure that to make an environment imports nothing that only a saved file names.

    Args:
        source: the file, as errors name it.
        env, kwargs: the id, and the arguments of the environment.

    Raises:
        PgtsError: a text in them names a module.
    """
    for text in _texts([env, kwargs]):
        is_id = text is env and ":" in text
        if is_id or _NAMES_MODULE.match(text):
            raise PgtsError(
                f"{source} names {text!r} as its environment; that imports the module {text.rpartition(':')[0]}, which "
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
