"""The subcommands of `pgts`: a file each, with a function of the same name, whose docstring is the command's help."""

import importlib
import pkgutil
from collections.abc import Callable

from pgts_torch.cli.arguments import Arguments, command_name

_FOUND = [module.name for module in pkgutil.iter_modules(__path__)]

COMMANDS: dict[str, Callable[[Arguments], None]] = {
    command_name(function): function
    for function in (getattr(importlib.import_module(f"{__name__}.{name}"), name) for name in _FOUND)
}
"""By name, in alphabetical order."""
