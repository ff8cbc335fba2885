"""Policies that are networks."""

from typing import Any, final

import torch
from gymnasium.spaces import Space
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.agent.components import legal_only
from pgts_torch.agent.dense_forward import dense_choices
from pgts_torch.agent.networks import Network, make_trunk
from pgts_torch.agent.policies import Policy
from pgts_torch.options.policies import MLP
from pgts_torch.options.policies import Network as Options
from pgts_torch.seeding import stream


@final
class NetworkPolicy(Policy):
    """pi(a|o) ~ exp(logit_a(o)) in float32, over the legal actions; nearly uniform at first, because the head has gain
    0.01.

    Args:
        observation_space: of the rows, which may end with the legal actions.
        seed: the initial weights are from the stream (seed, "policy"), the same on every device.

    Raises:
        PgtsError: the network does not take such observations.
    """

    def __init__(
        self,
        observation_space: Space[Any],
        num_actions: int,
        options: Options = MLP(),  # noqa: B008 - frozen
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        generator = stream(seed, "policy")
        trunk = make_trunk(options, observation_space, generator=generator, num_outputs=num_actions)
        self.options = options
        self.network = Network(trunk, num_actions, gain=0.01, generator=generator).to(device)
        self.num_actions = num_actions

    def probs(self, observation_N: Tensor) -> Float[Tensor, "N A"]:
        """softmax of the logits of the legal actions."""
        legal_NA = self.network.encoder.legal(observation_N)
        return legal_only(self.network.outputs(observation_N), legal_NA).softmax(-1)

    def sample(self, observation_N: Tensor, *, generator: torch.Generator) -> Int[Tensor, "N"]:
        """As `Policy.sample`; up to rounding the same actions where the network is computed by compiled loops."""
        network = self.network
        if network.loops() and network.encoder.legal(observation_N) is None:
            shape = observation_N.shape[0], self.num_actions
            random_NA = torch.empty(shape, dtype=torch.float32).exponential_(generator=generator)
            action_N = dense_choices(network.theta_D, network.dense_form, network.encode(observation_N), random_NA)
            if action_N is not None:
                return action_N
        return super().sample(observation_N, generator=generator)

    def state_dict(self) -> dict[str, Any]:
        return self.network.plain_state()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.network.load_plain_state(state)
