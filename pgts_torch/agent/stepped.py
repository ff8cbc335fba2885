"""What all updates by gradient steps have in common."""

from abc import ABC
from typing import Any

from pgts_torch.agent.dense_steps import compile_as_steps
from pgts_torch.agent.gaussian import GaussianPolicy
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.optimisers import Optimiser
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.updates import Update
from pgts_torch.options.fields import limit
from pgts_torch.options.schedules import at


class SteppedUpdate(Update, ABC):
    """An update by the steps of one optimiser, which is its state.

    options: of the class, by default.
    now: the options, with the present values of those that are schedules.
    """

    def __init__(self, options: Any = None) -> None:
        self.options = options = self.options if options is None else options
        self.state_weight = options.state_weight
        self.now = at(options, 0)
        self._optimiser = Optimiser(
            learning_rate=self.now.learning_rate,
            max_grad_norm=limit(options.max_grad_norm),
            method=options.optimizer,
        )

    def _follow_schedules(self) -> None:
        self.now = at(self.options, self.num_env_steps)
        self._optimiser.learning_rate = self.now.learning_rate

    def state_dict(self) -> dict[str, Any]:
        return self._optimiser.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._optimiser.load_state_dict(state)

    def check(self, policy: Policy) -> None:
        super().check(policy)
        if isinstance(policy, NetworkPolicy | GaussianPolicy):
            self._optimiser.check_fits(policy.network.weights)
        if isinstance(policy, NetworkPolicy):
            compile_as_steps(policy.network, self._optimiser)
