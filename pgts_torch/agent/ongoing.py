"""Episodes that go on from one iteration to the next."""

from collections.abc import Callable
from typing import Any, NamedTuple, final

import numpy as np
import torch
from torch import Tensor

from pgts_torch.agent.collect import shared_generators
from pgts_torch.agent.episodes import Episodes
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import COLUMNS, Rollout
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.envs.vector import TabularVectorEnv
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.models.base import LearningModel
from pgts_torch.models.snapshots import env_name
from pgts_torch.seeding import seed_sequence


class _Row(NamedTuple):
    """One step of each of B environments.

    before_B, after_B: the observations before and after it.
    read_before_B, read_after_B: the states there, as `ModelWorld.read` returns them; None where there is no model.
    over_B: whether the episode ended with this step: it terminated, was truncated or reached the largest length.
    """

    before_B: Tensor
    after_B: Tensor
    read_before_B: Tensor | None
    read_after_B: Tensor | None
    action_B: np.ndarray
    reward_B: np.ndarray
    discount_B: np.ndarray
    over_B: np.ndarray


@final
class OngoingEpisodes:
    """Episodes that go on from one rollout to the next: an environment is reset only when its episode is over.

    Episode e of environment b is reset with a seed from the stream (seed, "episode", *names, b, e). So the number e and
    the actions since that reset determine the state of the environment, and `load_state_dict` restores it by them.

    Args:
        world: the environments.
        max_length: the largest number of steps of an episode; None: there is none.
        seed, names: the prefix of the streams of seeds.

    Raises:
        PgtsError: several environments share one random generator, so that the state of one does not follow from its
            own seed.
    """

    def __init__(self, world: World, *, max_length: int | None, seed: int, names: tuple[str | int, ...]) -> None:
        B = world.env.num_envs
        if B > 1 and isinstance(world.env, TabularVectorEnv):
            raise PgtsError(
                f"num_envs is {B}; episodes of {env_name(world.env)} that go on from one iteration to the next need "
                "num_envs 1, because its environments share one random generator"
            )
        self._world, self._max_length, self._seed, self._names = world, max_length, seed, names
        self._number_B = [0] * B
        self._seed_B = [self._seed_of(b) for b in range(B)]
        self._begin_all()

    def _begin_all(self) -> None:
        """Let the present episode of each environment begin in the next rollout."""
        B = self._world.env.num_envs
        self._actions_B: list[list[Any]] = [[] for _ in range(B)]
        self._return_B = np.zeros(B)
        self._episodes = self._new_episodes()
        self._has_begun = False

    def _new_episodes(self) -> Episodes:
        world = self._world
        return Episodes(world.env, gamma=world.gamma, seeds=self._seed_B, masks=world.masks)

    def _seed_of(self, b: int) -> int:
        """The seed of the present episode of an environment."""
        return int(seed_sequence(self._seed, "episode", *self._names, b, self._number_B[b]).generate_state(1)[0])

    def collect(
        self,
        policy: Policy,
        length: int,
        *,
        names: tuple[str | int, ...],
        generator: torch.Generator,
        stepped: Callable[[int], None] = lambda steps: None,
    ) -> Rollout:
        """Take `length` steps in each environment, or fewer where a model that learns is to learn from them at once.

        Args:
            names: the stream that the generators of the whole process are seeded from, for environments that use them.
            generator: for actions.
            stepped: called with the number of steps made in each environment.

        Returns:
            A rollout with a column for each episode, or part of one, that lies in these steps; those of the first
            environment come first. `finished` has the episodes that ended.

        Raises:
            PgtsError: as `rollout`. After it the present episodes begin again in the next call.
        """
        try:
            return self._collected(policy, length, names, generator, stepped)
        except BaseException:
            self._begin_all()
            raise

    def _collected(
        self,
        policy: Policy,
        length: int,
        names: tuple[str | int, ...],
        generator: torch.Generator,
        stepped: Callable[[int], None],
    ) -> Rollout:
        world, episodes = self._world, self._episodes
        model = world.model if isinstance(world.model, LearningModel) else None
        rows: list[_Row] = []
        finished: list[tuple[float, int]] = []
        with shared_generators(world, self._seed, names):
            if not self._has_begun:
                with episodes.named("at the start"):
                    episodes.reset()
                self._has_begun = True
            begins_B = [not actions for actions in self._actions_B]
            observation_B, read_B = self._observe()
            for t in range(length):
                stepped(t)
                action_B = policy.sample(world.perceive(observation_B), generator=generator).cpu().numpy()
                with episodes.named(f"in step {t}"):
                    reward_B, discount_B, truncated_B = self._step(action_B)
                    if world.reward_range is not None:
                        world.reward_range.check(reward_B)
                    after_B, read_after_B = self._observe()
                too_long_B = np.array([len(actions) == self._max_length for actions in self._actions_B])
                over_B = (discount_B == 0) | truncated_B | too_long_B
                rows.append(_Row(observation_B, after_B, read_B, read_after_B, action_B, reward_B, discount_B, over_B))
                observation_B, read_B = after_B, read_after_B
                if over_B.any():
                    finished += [(float(self._return_B[b]), len(self._actions_B[b])) for b in over_B.nonzero()[0]]
                    with episodes.named(f"at the end of step {t}"):
                        self._begin(over_B)
                        observation_B, read_B = self._observe()
                if model is None:
                    continue
                is_news = model.is_news(rows[-1].before_B, torch.from_numpy(action_B))
                if is_news or (model.learns_after_episodes and over_B.any()):
                    break
        return self._cut(rows, begins_B, finished)

    def _observe(self) -> tuple[Tensor, Tensor | None]:
        world, observation = self._world, self._episodes.observation
        encoded_B = world.encode(observation)
        return encoded_B, world.read(observation, encoded_B) if isinstance(world, ModelWorld) else None

    def _step(self, action_B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        reward_B, discount_B, truncated_B = self._episodes.step(action_B, np.ones(len(action_B), dtype=bool))
        self._return_B += reward_B
        for actions, action in zip(self._actions_B, action_B.tolist(), strict=True):
            actions.append(action)
        return reward_B, discount_B, truncated_B

    def _begin(self, over_B: np.ndarray) -> None:
        """Begin the next episode in the environments whose episode is over."""
        for b in over_B.nonzero()[0].tolist():
            self._number_B[b], self._actions_B[b], self._return_B[b] = self._number_B[b] + 1, [], 0.0
            self._seed_B[b] = self._seed_of(b)
        self._episodes.restart(over_B, self._seed_B)

    def _cut(self, rows: list[_Row], begins_B: list[bool], finished: list[tuple[float, int]]) -> Rollout:
        """Return the steps as a rollout, with a column for each episode or part of one.

        Args:
            begins_B: whether an episode begins with the first step.
        """
        ends_BT = np.array([row.over_B for row in rows]).T
        ends_BT[:, -1] = True
        # of each of the P columns: its environment, its last step and its first one
        env_P, last_P = ends_BT.nonzero()
        first_P = np.zeros_like(last_P)
        first_P[1:] = np.where(env_P[1:] == env_P[:-1], last_P[:-1] + 1, 0)
        row_T1 = np.arange((last_P - first_P).max() + 1)[:, None]
        alive_TP = row_T1 <= last_P - first_P
        # which of the steps stands in each row of each column; in padding the last one of the part
        step_TP = np.minimum(first_P + row_T1, last_P)
        action_TP, reward_TP, discount_TP = (
            np.array([getattr(row, name) for row in rows])[step_TP, env_P] for name in _Row._fields[4:7]
        )
        weight_TP = np.ones_like(discount_TP)
        weight_TP[1:] = discount_TP[:-1].cumprod(0)
        weight_TP *= alive_TP
        columns = (action_TP, reward_TP, discount_TP, alive_TP, weight_TP, discount_TP)
        device = self._world.device
        tensors: dict[str, Any] = {n: torch.from_numpy(c).to(device) for n, c in zip(COLUMNS, columns, strict=True)}

        def both(before: str, after: str) -> Tensor:
            """Columns of these two fields as [T + 1, P]: `before` each step, then `after` the last, also in padding."""
            before_TB, after_TB = (torch.stack([getattr(row, name) for row in rows]) for name in (before, after))
            if len(env_P) == len(ends_BT):  # no episode ends before the last step
                return torch.cat([before_TB, after_TB[-1:]])
            end_P = after_TB[last_P, env_P]
            after_UP = torch.cat([before_TB[step_TP, env_P], end_P[None]])
            padded = torch.from_numpy(~alive_TP)
            after_UP[:-1][padded] = end_P.expand_as(after_UP[:-1])[padded]
            return after_UP

        observation_UP, state_UP = both("before_B", "after_B"), None
        if isinstance(self._world, ModelWorld):
            read_UP = both("read_before_B", "read_after_B")
            state_UP = self._world.numbers(read_UP.flatten(0, 1)).view(read_UP.shape[:2])
        begins_P = torch.from_numpy((first_P > 0) | np.array(begins_B)[env_P]).to(device)
        return Rollout(observation_UP, **tensors, state_UB=state_UP, begins_B=begins_P, finished=tuple(finished))

    def state_dict(self) -> dict[str, Any]:
        """Return, for each environment, the number of its episode, the actions and the return since the reset, and the
        latest observation."""
        observed_B = self._observe()[0].cpu() if self._has_begun else None
        dtype = torch.int64 if self._world.action_size is None else torch.float32
        actions = [torch.tensor(actions, dtype=dtype) for actions in self._actions_B]
        return {
            "number": list(self._number_B),
            "actions": actions,
            "return": self._return_B.tolist(),
            "observed": observed_B,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the episodes from their seeds and actions.

        Raises:
            PgtsError: episodes of another number of environments; or an environment that, with the same seed and
                actions, comes to another observation, so that training cannot go on with the same bits.
        """
        B = self._world.env.num_envs
        if [len(state[name]) for name in ("number", "actions", "return")] != [B] * 3:
            raise PgtsError(f"it is of {len(state['number'])} environments; this training has {B}")
        for number in state["number"]:
            check_count("number", number, least=0)
        self._number_B, self._return_B = list(state["number"]), np.array(state["return"], dtype=np.float64)
        self._seed_B = [self._seed_of(b) for b in range(B)]
        recorded = [actions.tolist() for actions in state["actions"]]
        self._actions_B, self._has_begun = recorded, state["observed"] is not None
        if not self._has_begun:
            return
        self._episodes = self._new_episodes()
        longest, return_B = max(map(len, recorded)), [0.0] * B
        with shared_generators(self._world, self._seed, ("restored",)), self._episodes.named("when it was repeated"):
            self._episodes.reset()
            for t in range(longest):
                # All episodes reach their latest step together: one of k actions is reset k steps before the end.
                due_B = np.array([len(actions) == longest - t for actions in recorded])
                if t and due_B.any():
                    self._episodes.restart(due_B, self._seed_B)
                begun_B = np.array([len(actions) >= longest - t for actions in recorded])
                none = 0 if self._world.action_size is None else [0.0] * self._world.action_size
                padded = [[none] * (longest - len(actions)) + actions for actions in recorded]
                taken = [actions[t] for actions in padded]
                reward_B = self._episodes.step(np.array(taken), begun_B)[0]
                return_B = [
                    total + float(r) * begun for total, r, begun in zip(return_B, reward_B, begun_B, strict=True)
                ]
            idle_B = np.array([not actions for actions in recorded])
            if longest and idle_B.any():
                self._episodes.restart(idle_B, self._seed_B)
        observed_B = self._observe()[0].cpu()
        differs_B = (observed_B != state["observed"]).reshape(B, -1).any(-1)
        differs_B |= torch.from_numpy(np.array(return_B) != np.array(self._return_B))
        if bool(differs_B.any()):
            b = int(differs_B.nonzero()[0, 0])
            raise PgtsError(
                f"environment {b} of {env_name(self._world.env)} does not repeat its episode from the seed "
                f"{self._seed_B[b]} and {len(recorded[b])} actions, so that the training cannot go on where it was: "
                "its steps depend on something else; take the horizon 'fixed' (rollout.horizon), which resets in each "
                "iteration"
            )
