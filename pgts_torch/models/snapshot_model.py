"""Models whose states are snapshots, numbered as they are met, equal ones with the same number."""

import itertools
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Bool, Int
from torch import Tensor

from pgts_torch.errors import MissingModel, ModelMismatch, PgtsError, check_count, failure
from pgts_torch.models.adapters_generic import Layered
from pgts_torch.models.answers import Seen, Step, observed
from pgts_torch.models.base import Transitions
from pgts_torch.models.environments import Given
from pgts_torch.models.exact_model import ExactModel
from pgts_torch.models.masks import ActionMasks
from pgts_torch.models.provenance import draws_its_own
from pgts_torch.models.snapshots import Snapshot, SnapshotAdapter, env_name, of_key
from pgts_torch.models.stepper import Stepper
from pgts_torch.seeding import SharedGenerators
from pgts_torch.tabular.mdp import check_gamma


class SnapshotModel(ExactModel):
    """An instance of an environment that is put into states and stepped: numbers their snapshots, and remembers the
    observation of each.

    env: the instance.   adapter: of its snapshots.

    Args:
        As in `SimulatorModel`, which says what is raised.
    """

    kind, is_cheap = "simulator", False

    def __init__(
        self,
        env: Given,
        *,
        gamma: float,
        actions: Sequence[Any] | None,
        action_repeat: int,
        adapter: SnapshotAdapter | None,
        observe: Callable[[Any], Any] | None,
        masks: ActionMasks | None = None,
        device: torch.device | str,
        dtype: torch.dtype,
    ) -> None:
        check_gamma(gamma)
        check_count("action_repeat", action_repeat)
        self._stepper = stepper = Stepper(
            env, gamma=gamma, actions=actions, adapter=adapter, observe=observe, masks=masks
        )
        self.gamma, self.action_repeat, self.dtype = gamma, action_repeat, dtype
        self.name, self.env, self.adapter, self._observe = stepper.name, stepper.env, stepper.adapter, observe
        self.device = torch.empty(0, device=device).device
        self._masks = masks
        self._draws_its_own = draws_its_own(stepper.made)
        self.num_states = 0
        # By number: the state. By the name of a snapshot: the number.
        self._seen: list[Seen] = []
        self._number: dict[Hashable, int] = {}
        # The instances whose class, map and constants were compared with the model's own.
        self._compared: list[Any] = []

    @property
    def simulator_steps(self) -> int:  # type: ignore[override]
        """How often the simulator was stepped."""
        return self._stepper.steps

    @contextmanager
    def _watched(self, forget: Callable[[], None] = lambda: None) -> Iterator[None]:
        """MissingModel where a step in this context has drawn from a generator that the whole process shares.

        Args:
            forget: called first: what such steps gave may have been remembered.
        """
        if self._draws_its_own:
            yield
            return
        with SharedGenerators() as shared:
            yield
        if shared.used:
            forget()
            raise MissingModel(
                f"{self.name} cannot be a model: step draws from the global generator of {shared.used[0]}: draw from "
                "self.np_random only; or take depth 0 and the estimator 'sampled', which need no model"
            )

    def clear(self) -> None:
        """Drop all states. Their numbers are given to other states from here on."""
        self.generation += 1
        self.num_states = 0
        self._seen.clear()
        self._number.clear()
        self._compared.clear()

    def root(self, env: gymnasium.Env, observation: Any = None, legal_A: np.ndarray | None = None) -> int:
        """The number of the state that another instance of this environment is in. Nothing of that instance changes.

        Args:
            env: wrapped or not; it has been reset.
            observation: its observation there, through its wrappers; needed only by critics that read observations.
            legal_A: the legal actions there, if there are action masks.

        Raises:
            PgtsError: it is another environment, or has another map or other constants than the model's.
        """
        base: Any = env if isinstance(self.adapter, Layered) else env.unwrapped
        if not any(base is known for known in self._compared):
            if not self.adapter.same_world(base, self.env):
                raise PgtsError(
                    f"{env_name(env)} is not the environment that the model was made from ({self.name}): its class, "
                    "map or constants differ; make both with the same arguments"
                )
            self._compared.append(base)
        return self.number(self.adapter.get_state(base), observation, legal_A)

    def roots(
        self,
        envs: Iterable[gymnasium.Env],
        observations: Iterable[Any] | None = None,
        legal_BA: Iterable[np.ndarray] | None = None,
    ) -> Int[Tensor, "B"]:
        """`root` of each of several instances."""
        unknown = itertools.repeat(None)
        each = zip(envs, observations or unknown, unknown if legal_BA is None else legal_BA, strict=False)
        return torch.tensor([self.root(*one) for one in each], dtype=torch.int64, device=self.device)

    def number(self, snapshot: Snapshot, observation: Any = None, legal_A: np.ndarray | None = None) -> int:
        """The number of a state: a new one if no equal state was met before. Where no action is legal the episode was
        over, and which are legal there is not known."""
        number = self._enter(Seen(snapshot, legal=legal_A.tobytes() if legal_A is not None and legal_A.any() else None))
        if observation is not None and self._seen[number].observation is None:
            self._seen[number].observation = observed(observation, self._observe)
        return number

    def _enter(self, seen: Seen) -> int:
        """The number of a state. What is known of its observation here or there is then known in both."""
        number = self._number.setdefault(seen.snapshot.name, self.num_states)
        if number == self.num_states:
            self.num_states += 1
            self._seen.append(seen)
            return number
        known = self._seen[number]
        if known.observation is None:
            known.observation = seen.observation
        else:
            seen.observation = known.observation
        if seen.legal is not None and seen.legal != known.legal:
            if known.legal is not None:
                raise ModelMismatch(
                    f"{self.name} allows the actions {_allowed(seen.legal)} where it allowed {_allowed(known.legal)} "
                    f"before, in {self.state_text(number)}: its action mask must be a function of what get_state gives"
                )
            known.legal = seen.legal
        return number

    def _entered(self, steps: Iterable[Step]) -> list[tuple[Step, int]]:
        """Steps, each with the number of the state reached."""
        numbers, entered = self._number, list[tuple[Step, int]]()
        for step in steps:
            # Most states are new, in a search where states do not recur.
            if (number := numbers.setdefault(step.child.snapshot.name, self.num_states)) == self.num_states:
                self.num_states += 1
                self._seen.append(step.child)
            else:
                self._enter(step.child)
                # The record by which the state is known, so that equal ones are kept in memory once.
                step.child = self._seen[number]
            entered.append((step, number))
        return entered

    def export(self, state_N: Int[Tensor, "N"]) -> list[tuple[Any, ...]]:
        """The snapshot of each state, what `observe` made of its observation, and its legal actions where these are
        known, for `adopt` in another process."""
        each = [self._seen[state] for state in self._checked("state", state_N, self.num_states)]
        return [(seen.snapshot, seen.observation, *([] if seen.legal is None else [seen.legal])) for seen in each]

    def adopt(self, exported: Iterable[tuple[Any, ...]]) -> Int[Tensor, "N"]:
        """The numbers of states that another model of the same environment has exported."""
        numbers = [self._enter(Seen(one[0], one[1], legal=one[2] if len(one) > 2 else None)) for one in exported]
        return torch.tensor(numbers, dtype=torch.int64, device=self.device)

    def packed(self, exported: Sequence[tuple[Any, ...]]) -> dict[str, Tensor]:
        """What `export` has returned as tensors, for files.

        Raises:
            PgtsError: the snapshots are objects.
        """
        if not self.adapter.is_plain or self._masks is not None:
            raise PgtsError(f"snapshots of {self.name} are objects of its simulator, which cannot be saved")
        size = len(self.adapter.get_state(self.env).data)
        data = bytearray().join(snapshot.data for snapshot, _ in exported)
        return {
            "data": torch.from_numpy(np.frombuffer(data, np.uint8).reshape(-1, size)),
            "cut": torch.tensor([snapshot.cut for snapshot, _ in exported], dtype=torch.bool),
            "observation": torch.from_numpy(np.array([seen for _, seen in exported])),
        }

    def unpacked(self, packed: Mapping[str, Tensor]) -> list[tuple[Any, ...]]:
        """What was `packed`; PgtsError unless these can be states of this simulator."""
        data_NL, size = packed["data"].numpy(), len(self.adapter.get_state(self.env).data)
        if data_NL.dtype != np.uint8 or data_NL.shape[1:] != (size,):
            raise PgtsError(f"snapshots are {data_NL.dtype} of shape {data_NL.shape[1:]}; they must be {size} bytes")
        rows = zip(data_NL, packed["cut"].tolist(), packed["observation"].numpy(), strict=True)
        return [(of_key(data.tobytes())._replace(cut=cut), seen) for data, cut, seen in rows]

    def legal(self, state_N: Int[Tensor, "N"]) -> Bool[np.ndarray, "N A"]:
        """The legal actions in each state; all where they are not known, as after an end."""
        every = b"\1" * self.num_actions
        rows = [self._seen[state].legal or every for state in self._checked("state", state_N, self.num_states)]
        return np.frombuffer(b"".join(rows), dtype=bool).reshape(len(rows), self.num_actions)

    def snapshot(self, state: int) -> Snapshot:
        """The snapshot behind the number of a state."""
        self._check("state", state, self.num_states)
        return self._seen[state].snapshot

    def is_cut(self, state_N: Int[Tensor, "N"]) -> Bool[Tensor, "N"]:
        """Whether the episode was truncated in these states, so that no other step follows."""
        return torch.tensor([self._seen[state].snapshot.cut for state in state_N.tolist()], device=self.device)

    def observations(self, state_N: Int[Tensor, "N"]) -> np.ndarray:
        """What `observe` made of the observation of each state, stacked: [N, ...].

        Without `observe` that is [N, *shape] of a Box, [N] of a Discrete space, and `gymnasium.spaces.flatten` of any
        other, in the dtype of the space.

        Raises:
            PgtsError: one of them is not known, because a root was given without it; or it cannot be flattened.
        """
        rows, space = [self._observation(state) for state in state_N.tolist()], self._stepper.space
        if self._observe is None and not isinstance(space, spaces.Box | spaces.Discrete):
            try:
                rows = [spaces.flatten(space, row) for row in rows]
            except NotImplementedError:
                raise PgtsError(f"{self.name}: {space} cannot be flattened: give `observe`") from None
        return np.asarray(rows)

    def _observation(self, state: int) -> Any:
        self._check("state", state, self.num_states)
        seen = self._seen[state]
        if seen.observation is None and self._stepper.observes_late:
            made = seen.like or seen
            if made.observation is None:
                try:
                    made.observation = self._stepper.observation(made.snapshot.data)
                except BaseException as error:
                    raise failure(f"{self.name} failed to observe state {state}", error) from error
            seen.observation = made.observation
        if seen.observation is None:
            raise PgtsError(f"{self.name}: the observation of state {state} was not given, or `observe` made it None")
        return seen.observation

    def _is_same(self, step: Step, reward: float, discount: float, next_state: int, follows: bool) -> bool:
        """Whether a step of the simulator is, bit for bit, what happened, because the same code has made both."""
        reached = step.child.snapshot
        # A truncated episode cannot have gone on.
        if step.reward != reward or step.discount != discount or (reached.cut and follows):
            return False
        # After an end the next state does not matter.
        return discount == 0 or self.adapter.same_state(reached, self.snapshot(next_state))

    def _answer(self, steps: Sequence[tuple[Step, int]]) -> Transitions:
        """What `_entered` has returned, as tensors."""
        return Transitions(
            torch.tensor([step.reward for step, _ in steps], dtype=self.dtype, device=self.device),
            torch.tensor([step.discount for step, _ in steps], dtype=self.dtype, device=self.device),
            torch.tensor([child for _, child in steps], dtype=torch.int64, device=self.device),
        )

    def state_text(self, state: int) -> str:
        """With its observation, or else its snapshot."""
        snapshot, seen = self._seen[state].snapshot, self._seen[state].observation
        what = repr(snapshot.key) if seen is None else np.array2string(np.asarray(seen), threshold=20)
        return f"state {state} ({what})" if snapshot.clock is None else f"state {state} ({what} at {snapshot.clock})"

    def _checked(self, what: str, number_N: Int[Tensor, "N"], count: int) -> Sequence[int]:
        """These numbers, each of them below a count; PgtsError if one is not."""
        numbers = number_N.tolist()
        if numbers:
            self._check(what, min(numbers), count)
            self._check(what, max(numbers), count)
        return numbers

    def _check(self, what: str, number: int, count: int) -> None:
        if not 0 <= number < count:
            raise PgtsError(f"{self.name}: {what} {number} does not exist; there are {count}, from 0 on")


def _allowed(legal: bytes) -> list[int]:
    return [action for action, is_legal in enumerate(legal) if is_legal]
