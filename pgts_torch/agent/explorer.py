"""A policy that visits what is not known yet."""

from typing import Any, final

from jaxtyping import Int
from torch import Tensor

from pgts_torch.agent.critics import Critic
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.estimators import Estimator
from pgts_torch.agent.imagine import imagine
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.updates import Update
from pgts_torch.agent.world import ModelWorld
from pgts_torch.search.engine import Search


@final
class Explorer:
    """A policy that is trained in a model with optimism, to visit what is not known yet, beside the policy that is
    trained in the same model without it.

    Args:
        policy: is trained by lookaheads of `estimator`, with the values of `critic` at the leaves.
    """

    def __init__(
        self, world: ModelWorld, policy: Policy, critic: Critic, update: Update, search: Search, estimator: Estimator
    ) -> None:
        self.world, self.policy, self.search = world, policy, search
        self._critic, self._update, self._estimator = critic, update, estimator
        self._steps = 0

    @property
    def learners(self) -> tuple[Critic, Update]:
        """What it learns by."""
        return self._critic, self._update

    @property
    def model_calls(self) -> int:
        """For how many (state, action) the model has been queried so far."""
        return self._steps + self.search.model_calls + self._critic.model_calls

    def improve(self, start_B: Int[Tensor, "B"], length: int, draws: Draws) -> None:
        """Update the policy from episodes that are imagined in the model, from these states on."""
        imagined = imagine(self.world, self.policy, start_B, length, generator=draws.own).shared(draws.ranks)
        self._steps += imagined.num_steps
        self._estimator.evaluate(imagined, draws)
        self._update(self.policy, self._estimator(imagined, draws), generator=draws.common)

    def state_dict(self) -> dict[str, Any]:
        """The states of policy, critic and update."""
        learned = {"critic": self._critic.state_dict(), "update": self._update.state_dict()}
        return {"policy": self.policy.state_dict(), **learned}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.policy.load_state_dict(state["policy"])
        self._critic.load_state_dict(state["critic"])
        self._update.load_state_dict(state["update"])
