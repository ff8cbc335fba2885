"""The adapter of environments that nobody has written one for: their attributes, pickled."""

import io
import pickle
from collections.abc import Mapping
from typing import Any, final

from gymnasium import spaces

from pgts_torch.models.adapters import same_content
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter

_NO_STATE = frozenset(
    {"spec", "metadata", "render_mode", "action_space", "observation_space", "_np_random", "_np_random_seed"}
)


@final
class PickledAttributes(SnapshotAdapter):
    """All attributes of an environment, but its spaces, its generator, and what does not pickle, as windows.

    That this is its whole state is a guess: it can only be used where walks that are restored (`models.restoring`) go
    on bit for bit as at first, and steps are compared with the model for as long as it is used.

    left_out: the attributes that do not pickle.
    """

    name = "its attributes, pickled"

    def __init__(self) -> None:
        self.left_out = set[str]()
        self._fixed: Mapping[str, Any] = {}

    def get_state(self, env: Any) -> Snapshot:
        try:
            content = self._pickled(env, self._state(env))
        except Exception:  # which errors an object raises that does not pickle is its own affair
            self.left_out.update(name for name, value in self._state(env).items() if not self._pickles(env, value))
            content = self._pickled(env, self._state(env))
        return Snapshot(content, content)

    def set_state(self, env: Any, data: Any) -> None:
        attributes = _unpickled(data, self._parts(env))
        if vars(env).keys() != attributes.keys():
            for name in self._state(env).keys() - attributes.keys():
                delattr(env, name)
        vars(env).update(attributes)

    def same_state(self, one: Snapshot, other: Snapshot) -> bool:
        """Pickles of one state may differ, as where an object is met twice; so what they hold is compared."""
        return one.key == other.key or same_content(*(_unpickled(each.data, None) for each in (one, other)))

    def _state(self, env: Any) -> dict[str, Any]:
        held, left_out = vars(env), self.left_out
        return {name: held[name] for name in sorted(held) if name not in _NO_STATE and name not in left_out}

    def _parts(self, env: Any) -> Mapping[str, Any]:
        """What of an environment stays where it is though attributes refer to it, by name."""
        known = self._fixed
        if not known or known["self"] is not env or known["np_random"] is not env.np_random:
            held = {name: value for name, value in vars(env).items() if isinstance(value, spaces.Space)}
            self._fixed = held | {"self": env, "np_random": env.np_random}
        return self._fixed

    def _pickled(self, env: Any, value: Any) -> bytes:
        file = io.BytesIO()
        pickler, names = pickle.Pickler(file, protocol=5), {id(part): name for name, part in self._parts(env).items()}
        pickler.persistent_id = lambda part: names.get(id(part))  # type: ignore[method-assign]
        pickler.dump(value)
        return file.getvalue()

    def _pickles(self, env: Any, value: Any) -> bool:
        try:
            self._pickled(env, value)
        except Exception:
            return False
        return True


def _unpickled(content: bytes, parts: Mapping[str, Any] | None) -> Any:
    """What was pickled, with parts of an environment in place of their names, or without one with the names."""
    unpickler = pickle.Unpickler(io.BytesIO(content))
    unpickler.persistent_load = str if parts is None else parts.__getitem__  # type: ignore[method-assign]
    return unpickler.load()
