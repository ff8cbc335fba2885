"""Dyna: many updates from episodes that are imagined in the model and start in states visited before."""

import copy
from collections.abc import Iterator
from typing import Any, final

import torch

from pgts_torch.agent.draws import Draws
from pgts_torch.agent.explorer import Explorer
from pgts_torch.agent.gaussian import GaussianPolicy
from pgts_torch.agent.imagine import imagine
from pgts_torch.agent.model_check import ModelCheck
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.world import ModelWorld
from pgts_torch.agent.worlds import SimulatedWorld
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.models.base import LearningModel
from pgts_torch.models.replay import ReplayBuffer
from pgts_torch.options.replay import UniformReplay


@final
class Dyna:
    """Fits a model that can learn to each rollout of the environment, and makes the rollouts that the policy is updated
    from: episodes in the model that start in states sampled from those visited so far (Sutton 1990).

    Each of several processes keeps the states that it has visited itself, and imagines its part of the episodes from
    these. In tables, where all keep all states, they begin in its part of them.

    policy: the policy that imagined episodes follow. For a network it is a slow copy of the trained one, a moving
        average that steps toward it by `polyak` after each update; with polyak 1, and for a table, the trained policy.
    replay: the visited states, in the column "state".

    num_due: how many updates of this iteration are not over.

    Args:
        model_check: compares steps of the environment with a model that claims to be exact, before it is queried.
        explorer: a policy that visits states in place of the trained one, which does if this is None.
    """

    def __init__(
        self,
        world: ModelWorld,
        trained: Policy,
        options: UniformReplay,
        model_check: ModelCheck,
        explorer: Explorer | None = None,
    ) -> None:
        self._world, self._trained, self.options, self._model_check = world, trained, options, model_check
        self.explorer, self._model = explorer, world.model if explorer is None else explorer.world.model
        self.policy = trained
        if isinstance(trained, NetworkPolicy | GaussianPolicy) and options.polyak < 1:
            self.policy = copy.deepcopy(trained)
        model = self._model
        own = model.replay if isinstance(model, LearningModel) else None
        self._owns_replay = own is None
        self.replay = ReplayBuffer(options.capacity) if own is None else own
        if own is None:
            self.replay.add(state=world.export(torch.zeros(0, dtype=torch.int64, device=world.device)))
        self.num_updates = self._steps = self.num_due = 0

    @property
    def model_calls(self) -> int:
        """For how many (state, action) the model has been queried, but for the lookahead of the trained policy."""
        return self._steps + (0 if self.explorer is None else self.explorer.model_calls)

    def learn(self, experience: Rollout, draws: Draws) -> dict[str, float]:
        """Check the steps against the model, keep the visited states, and let the model learn from the steps.

        Returns:
            The losses and errors of the model, by name.

        Raises:
            ModelMismatch: a step contradicts the model.
        """
        self._model_check(experience, draws.number)
        model, losses = self._model, {}
        is_table = self._world.keeps_numbers
        if self._owns_replay:
            states = self._world.export(experience.state_TB[experience.alive_TB])
            if is_table:
                assert isinstance(states, torch.Tensor)
                [states] = draws.ranks.rows("visited states", states)
            self.replay.add(state=states)
        if isinstance(model, LearningModel):
            losses = model.learn(experience.steps(), generator=draws.common if is_table else draws.own)
        return {f"model_{name}": value for name, value in losses.items()}

    def rollouts(self, draws: Draws) -> Iterator[tuple[Rollout, Draws]]:
        """Yield imagined rollouts, each with its random generators. The caller updates the policy after each one.

        Their number is `updates_per_step` times the number of visits in all iterations so far, minus the rollouts that
        earlier iterations have made, and at least one.
        """
        assert self.options.updates_per_step is not None
        assert self.options.length is not None
        assert self.options.search_every is not None
        is_table, ranks = self._world.keeps_numbers, draws.ranks
        added = self.replay.num_added if is_table else int(ranks.totals("visits", self.replay.num_added)[0])
        due = int(self.options.updates_per_step * added) - self.num_updates
        every = ranks.part(self.replay.rows("state").unique()) if self.options.starts == "all" else None
        kept_R = None if is_table else ranks.each("kept states", len(self.replay))[:, 0].tolist()
        for number in range(max(due, 1)):
            self.num_due = max(due, 1) - number
            own = draws.update(number)
            self._world.reset_numbers()
            start_B = self._world.adopt(self._sampled(own, kept_R) if every is None else every)
            imagined = imagine(
                self._world,
                self.policy,
                start_B,
                self.options.length,
                search_every=self.options.search_every,
                generator=own.own,
            ).shared(ranks)
            self._steps += imagined.num_steps
            yield imagined, own
            self.num_updates += 1
            if self.explorer is not None:
                self.explorer.improve(start_B, self.options.length, own)
            if self.policy is not self._trained:
                assert isinstance(self.policy, NetworkPolicy | GaussianPolicy)
                assert isinstance(self._trained, NetworkPolicy | GaussianPolicy)
                self.policy.network.follow(self._trained.network, self.options.polyak)

    def _sampled(self, draws: Draws, kept_R: list[float] | None) -> Any:
        """This process's part of a sample of the visited states, as the world exports them.

        Args:
            kept_R: how many states each process keeps; None: all keep the same.
        """
        assert isinstance(self.options.starts, int)
        if kept_R is None:
            return self.replay.rows(
                "state", draws.ranks.part(self.replay.sample(self.options.starts, generator=draws.common))
            )
        count = draws.ranks.portion(self.options.starts, kept_R)
        return self.replay.rows("state", self.replay.sample(count, generator=draws.own))

    def state_dict(self) -> dict[str, Any]:
        """Return what was kept and learned, as tensors on the CPU and plain values.

        Raises:
            PgtsError: the states that were kept are snapshots of a simulator, which are objects.
        """
        model, replay = self._model, self.replay.state_dict() if self._owns_replay else None
        if replay is not None and isinstance(self._world, SimulatedWorld):
            try:
                replay["columns"] = self._world.model.packed(replay["columns"]["state"])
            except PgtsError as error:
                raise PgtsError(
                    f"replay keeps {error}: train in Python without saving, or without replay (replay.type none)"
                ) from error
        return {
            "num_updates": self.num_updates,
            "replay": replay,
            "model": model.state_dict() if isinstance(model, LearningModel) else None,
            "explorer": None if self.explorer is None else self.explorer.state_dict(),
            "policy": self.policy.state_dict() if self.policy is not self._trained else None,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned; PgtsError unless it fits."""
        check_count("num_updates", state["num_updates"], least=0)
        self.num_updates, model = state["num_updates"], self._model
        if self.explorer is not None:
            self.explorer.load_state_dict(state["explorer"])
        if self._owns_replay:
            replay = state["replay"]
            if isinstance(self._world, SimulatedWorld):
                replay = replay | {"columns": {"state": self._world.model.unpacked(replay["columns"])}}
            self.replay.load_state_dict(replay)
        if isinstance(model, LearningModel):
            model.load_state_dict(state["model"])
        if self.policy is not self._trained:
            self.policy.load_state_dict(state["policy"])
