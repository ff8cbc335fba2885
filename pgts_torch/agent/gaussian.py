"""A Gaussian policy over actions that are vectors, and the actions that a lookahead draws from it."""

import copy
import math
from typing import Any, NamedTuple, final

import torch
from gymnasium.spaces import Space
from jaxtyping import Float, Int
from torch import Tensor, nn

from pgts_torch.agent.networks import Network, default_network, make_trunk
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.world import ModelWorld
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.drawn_actions import Drawn
from pgts_torch.options.policies import AutoLayers, Gaussian
from pgts_torch.seeding import mix, stream, uniform

_LOG_2PI = math.log(2 * math.pi)
_LEAST = 2.0**-54
"""Half the distance of the numbers of `uniform`, so that none is 0, at which a normal would be infinite."""


class Normals(NamedTuple):
    """A normal distribution with independent entries in each of N states.

    mean_NX, std_NX: means and standard deviations.
    """

    mean_NX: Float[Tensor, "N X"]
    std_NX: Float[Tensor, "N X"]

    def log_density(self, action_NKX: Float[Tensor, "N K X"]) -> Float[Tensor, "N K"]:
        """log pi(a|s)."""
        z_NKX = self.standardised(action_NKX)
        return -(0.5 * z_NKX.square().sum(-1) + (self.std_NX.log() + 0.5 * _LOG_2PI).sum(-1, keepdim=True))

    def standardised(self, action_NKX: Float[Tensor, "N K X"]) -> Float[Tensor, "N K X"]:
        """(a - mean) / std."""
        return (action_NKX - self.mean_NX[:, None]) / self.std_NX[:, None]

    def entropy(self) -> Float[Tensor, "N"]:
        """In nats."""
        return (self.std_NX.log() + 0.5 * (_LOG_2PI + 1)).sum(-1)

    def divergence(self, other: "Normals") -> Float[Tensor, "N"]:
        """KL(self || other), in nats."""
        ratio_NX = self.std_NX / other.std_NX
        shift_NX = (self.mean_NX - other.mean_NX) / other.std_NX
        return (0.5 * (ratio_NX.square() + shift_NX.square() - 1) - ratio_NX.log()).sum(-1)


@final
class GaussianPolicy(Policy):
    """a ~ N(mean(o), diag(std(o)^2)) over vectors a, which the environment takes squashed into its bounds (`Squash`).

        std = least + (first - least) softplus(y) / softplus(0)

    for the second half y of the network's outputs; the first half is the mean. At first mean and y are nearly 0,
    because the head has gain 0.01 (a module of the caller's own without a head returns them as it likes). Densities and
    entropies are those of a before it is squashed.

    num_actions: 0; there are no probabilities of numbered actions.

    Args:
        observation_space: as of a `NetworkPolicy`.
        action_size: X.
        options: of the network and the standard deviation.
        seed: the initial weights are from the stream (seed, "policy").
    """

    num_actions = 0

    def __init__(
        self,
        observation_space: Space[Any],
        action_size: int,
        options: Gaussian = Gaussian(),  # noqa: B008 - frozen
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        generator = stream(seed, "policy")
        given, num_outputs = options.network, 2 * action_size
        layers = default_network(observation_space) if isinstance(given, AutoLayers) else given
        trunk = make_trunk(layers, observation_space, generator=generator, num_outputs=num_outputs)
        self.options, self.action_size = options, action_size
        self.network = Network(trunk, num_outputs, gain=0.01, generator=generator).to(device)

    def probs(self, observation_N: Tensor) -> Float[Tensor, "N A"]:
        """PgtsError: a density has no probabilities of actions."""
        raise PgtsError("a gaussian policy has a density over vectors, and no probabilities of numbered actions")

    def normals(self, observation_N: Tensor) -> Normals:
        """pi(.|o) for each observation, without gradient."""
        return self.read(self.network.outputs(observation_N))

    def read(self, output_ND: Float[Tensor, "N D"]) -> Normals:
        """What outputs of the network mean."""
        mean_NX, y_NX = output_ND.chunk(2, -1)
        return Normals(mean_NX, self.options.min_std + self._span * nn.functional.softplus(y_NX))

    def through(
        self, output_ND: Float[Tensor, "N D"], mean_NX: Float[Tensor, "N X"], log_std_NX: Float[Tensor, "N X"]
    ) -> Float[Tensor, "N D"]:
        """The gradient of a loss in the outputs, from those in means and in logs of standard deviations."""
        y_NX = output_ND.chunk(2, -1)[1]
        return torch.cat([mean_NX, log_std_NX * self._span * y_NX.sigmoid() / self.read(output_ND).std_NX], -1)

    @property
    def _span(self) -> float:
        return (self.options.std - self.options.min_std) / math.log(2)

    def sample(self, observation_N: Tensor, *, generator: torch.Generator) -> Float[Tensor, "N X"]:
        """Sample one vector for each observation; NotFinite if one is not."""
        mean_NX, std_NX = self.normals(observation_N)
        noise_NX = torch.empty_like(mean_NX).normal_(generator=generator)
        return _finite(mean_NX + std_NX * noise_NX)

    def state_dict(self) -> dict[str, Any]:
        return self.network.plain_state()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.network.load_plain_state(state)


@final
class Mean(Policy):
    """Takes the mean of a Gaussian policy."""

    num_actions = 0

    def __init__(self, policy: GaussianPolicy) -> None:
        self.policy = policy

    def probs(self, observation_N: Tensor) -> Float[Tensor, "N A"]:
        """PgtsError, as of the Gaussian policy."""
        return self.policy.probs(observation_N)

    def sample(self, observation_N: Tensor, *, generator: torch.Generator) -> Float[Tensor, "N X"]:
        """The means."""
        return _finite(self.policy.normals(observation_N).mean_NX)

    def state_dict(self) -> dict[str, Any]:
        return self.policy.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.policy.load_state_dict(state)


def _finite(action_NX: Float[Tensor, "N X"]) -> Float[Tensor, "N X"]:
    if not math.isfinite(action_NX.sum()):
        off_N = ~action_NX.isfinite().all(-1)
        if bool(off_N.any()):
            raise NotFinite(f"the policy's action is {action_NX[off_N][0].tolist()}", what="probability")
    return action_NX


@final
class MixtureProposal:
    """K actions in each state from a mixture of the policy and a wider normal distribution around the same mean:

        beta(a|s) = 1/2 N(a; mean, std^2) + 1/2 N(a; mean, (scale std)^2)

    The actions are drawn from the one and the other by turns, each as a low-discrepancy sequence (Kronecker's, by the
    generalised golden ratio) that is shifted at random in each state (Cranley and Patterson 1976): every action has the
    density that it is drawn from, and the first few, or all together, cover it more evenly than independent ones. For
    odd K the shares are those of the numbers drawn. Importance weights pi / beta are at most 2.

    The policy is copied, so that a state has the same actions after an update, until they are drawn again.

    Args:
        world: gives the observations of states.
        num_actions: K.
        scale: of the wider distribution, at least 1.
        key: decides all draws, together with the number of the state.
    """

    def __init__(
        self, world: ModelWorld, policy: GaussianPolicy, num_actions: int, scale: float, key: Int[Tensor, "1"]
    ) -> None:
        self._world, self._key, self._num_actions = world, key, num_actions
        self._policy = copy.copy(policy)
        self._policy.network = copy.deepcopy(policy.network)
        first = (num_actions + 1) // 2
        place_K = torch.arange(num_actions, device=key.device)
        self._wide_K = place_K % 2 == 1
        self._scale_K1 = torch.where(self._wide_K, scale, 1.0)[:, None]
        self._share, self._scale = first / num_actions, scale
        # phi solves phi^(X+1) = phi + 1; multiples of its powers 1/phi, 1/phi^2, ... modulo 1 are evenly spread.
        size, phi = policy.action_size, 2.0
        for _ in range(60):
            phi = (1 + phi) ** (1 / (size + 1))
        power_X = phi ** -torch.arange(1, size + 1, dtype=torch.float64, device=key.device)
        self._point_KX = (place_K // 2)[:, None] * power_X

    def __call__(self, state_N: Int[Tensor, "N"]) -> Drawn:
        """Draw in these states, without gradient."""
        normals = self._policy.normals(self._world.observe(state_N))
        action_NKX = self._draw(normals, state_N)
        log_NK = normals.log_density(action_NKX)
        wider = Normals(normals.mean_NX, self._scale * normals.std_NX)
        # log pi - log beta is minus the log of  share + (1 - share) wide / pi.
        ratio_NK = wider.log_density(action_NKX) - log_NK
        log_rest = math.log1p(-self._share) if self._share < 1 else -math.inf
        parts_2NK = torch.stack([torch.full_like(ratio_NK, math.log(self._share)), ratio_NK + log_rest])
        return Drawn(action_NKX, (-parts_2NK.logsumexp(0)).softmax(-1))

    def _draw(self, normals: Normals, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N K X"]:
        size = normals.mean_NX.shape[1]
        # A shift for each state, part of the mixture and entry.
        entry_2X = torch.arange(2 * size, device=state_N.device).view(2, size)
        shift_N2X = uniform(mix(self._key, state_N[:, None, None], entry_2X))
        shift_NKX = torch.where(self._wide_K[:, None], shift_N2X[:, 1:], shift_N2X[:, :1])
        share_NKX = (shift_NKX + self._point_KX) % 1.0
        z_NKX = torch.special.ndtri((share_NKX + _LEAST).clamp(max=1 - _LEAST)) * self._scale_K1
        return normals.mean_NX[:, None] + normals.std_NX[:, None] * z_NKX.to(normals.std_NX.dtype)
