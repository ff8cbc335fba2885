"""Ids of environments: what is imported for them, what they name, and errors of Gymnasium as one of ours."""

import importlib
import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec, find_highest_version, get_env_id, parse_env_id

from pgts_torch.errors import PgtsError, failure
from pgts_torch.trust import import_named

Maker = Callable[..., gymnasium.Env]
"""Makes a new environment; takes the arguments of `gymnasium.make`, which it uses if it makes environments by an id."""

_MODULES = {"MiniGrid-": ("minigrid", "envs"), "BabyAI-": ("minigrid", "envs"), "ALE/": ("ale_py", "atari")}
"""Environments that are registered by a module, by the start of their ids, and the extra that installs it."""


def import_modules(env_id: str) -> None:
    """Import what registers an environment with Gymnasium, the module of `MODULE:ID` or a known one; PgtsError if it is
    not installed, which names the extra, if there is one."""
    own, colon, _ = env_id.rpartition(":")
    needed = [(own, "")] if colon else []
    for module, extra in needed + [needs for start, needs in _MODULES.items() if env_id.startswith(start)]:
        try:
            import_named(module)
        except ModuleNotFoundError as error:
            why = f"needs {module}: pip install 'pgts_torch[{extra}]'" if extra else f"cannot be made: {error}"
            raise PgtsError(f"{env_id} {why}") from error
        except BaseException as error:
            raise failure(f"{env_id} cannot be made, for importing {module} fails", error) from error


def maker_named(env_id: str) -> Callable[..., gymnasium.Env] | None:
    """The class or the function of MODULE:NAME, which makes environments; None where a module has no such name."""
    module, colon, name = env_id.rpartition(":")
    found = getattr(import_named(module), name, None) if colon else None
    return found if callable(found) else None


def spec_of(env_id: str) -> EnvSpec | None:
    """The spec of an id; that of the latest version where the id has none, as gymnasium.make takes it."""
    name = env_id.rpartition(":")[2]
    if name not in gymnasium.registry and importlib.util.find_spec("ale_py"):
        importlib.import_module("ale_py")  # Atari has ids without a namespace, too
    try:
        namespace, short, version = parse_env_id(name)
    except gymnasium.error.Error:
        return None
    if version is None and name not in gymnasium.registry:
        name = get_env_id(namespace, short, find_highest_version(namespace, short))
    return gymnasium.registry.get(name)


def registered(env: str | EnvSpec, /, **kwargs: Any) -> Maker:
    return lambda **options: gymnasium.make(env, **(options | kwargs))


@contextmanager
def making(name: str) -> Iterator[None]:
    """An error of an environment that is being made, as one of ours."""
    try:
        yield
    except PgtsError:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        raise PgtsError(f"{name} needs something that is not installed: {error}") from error
    except (gymnasium.error.NameNotFound, gymnasium.error.NamespaceNotFound) as error:
        own, colon, _ = name.rpartition(":")
        way_out = f"MODULE:{name} imports the module that registers it"
        if colon:
            way_out = f"Importing {own} does not register it: name a module that does, or MODULE:CLASS"
        raise PgtsError(f"{name} cannot be made: {error} {way_out}") from error
    except (gymnasium.error.Error, ImportError, LookupError, TypeError) as error:
        raise PgtsError(f"{name} cannot be made: {error}") from error
    except BaseException as error:
        raise failure(f"{name} cannot be made", error) from error
