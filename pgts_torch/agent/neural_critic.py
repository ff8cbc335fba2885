"""Critics that are networks."""

import copy
import math
from typing import Any, final

import torch
from gymnasium.spaces import Space
from jaxtyping import Float, Num
from torch import Tensor, nn

from pgts_torch.agent.advantages import critic_targets
from pgts_torch.agent.components import legal_only
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.dense_steps import compile_as_steps, dense_steps
from pgts_torch.agent.gradients import Forward
from pgts_torch.agent.networks import Network, Scaled, Trunk, default_network, make_trunk
from pgts_torch.agent.optimisers import Optimiser, minibatches
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.states import check_keys
from pgts_torch.bellman import policy_mean
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.options.critics import NetworkValues
from pgts_torch.options.fields import limit
from pgts_torch.options.policies import Network as Options
from pgts_torch.options.schedules import value_at
from pgts_torch.ranks import Ranks, Share
from pgts_torch.readings import Readings
from pgts_torch.seeding import stream

_ROUNDING = torch.finfo(torch.float32).eps
_SLOWEST_RATE = 0.1


@final
class NetworkCritic(Critic):
    """v(o), or Q(o, .), fitted by least squares to targets from rollouts.

        minimise  mean over visits of ((y_t - mean) / scale - net(o_t))^2,    v(o) = mean + scale * net(o)

    y_t are lambda-returns or Monte-Carlo returns, bootstrapped with the target network where an episode was cut off and
    not where it terminated. mean and scale are running statistics of the targets, with the rate 1/k in fit k, at least
    1/10; when they change, the head is rescaled so that v stays the same (PopArt; van Hasselt et al. 2016). Before
    the first fit scale is 0, and so are all values. So rewards times 2^k give values times 2^k, bit for bit.

    Values are in the range that all rewards and discounts of the fits so far allow,

        min(0, least r) / (1 - largest gamma)  to  max(0, greatest r) / (1 - largest gamma)

    because outside it they can only be errors, which feed on themselves where targets are bootstrapped in states that
    are none of the visits, as after imagined episodes that were cut off where the model knows too little.

    Args:
        trunk: the trunk of a policy, which is then shared, in place of `options.network`. Both train it; its running
            statistics of observations are changed by the policy's update alone.
        seed: the initial weights are from the stream (seed, "critic").
    """

    dtype = torch.float32
    options: Any

    def __init__(
        self,
        observation_space: Space[Any],
        num_actions: int,
        options: NetworkValues = NetworkValues(),  # noqa: B008 - frozen
        *,
        trunk: Trunk | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        self.options = filled = options.filled("sampled")
        self.target, self.num_actions = options.target, num_actions
        outputs = 1 if self.target == "v" else num_actions
        generator = stream(seed, "critic")
        if trunk is None:
            own = options.network
            network = own if isinstance(own, Options) else default_network(observation_space)
            trunk = make_trunk(network, observation_space, generator=generator, num_outputs=outputs)
        self.network = Network(trunk, outputs, gain=1.0, generator=generator, rescaled=True).to(device)
        self._lags = options.lags
        self._target_network = copy.deepcopy(self.network) if self._lags else self.network
        self._rate = filled.learning_rate
        self._optimiser = Optimiser(learning_rate=value_at(self._rate, 0), max_grad_norm=limit(options.max_grad_norm))
        for each in {self.network, self._target_network}:
            compile_as_steps(each, self._optimiser)
        self._policy: Policy | None = None
        self._queried: tuple[Rollout, tuple[Tensor, Tensor]] | None = None
        self._mean, self._scale = (torch.tensor(0.0, dtype=torch.float64, device=device) for _ in range(2))
        self._num_fits = 0
        # The least reward, minus the greatest one and minus the largest discount; infinite before any was seen.
        self._seen_3 = torch.full((3,), math.inf, dtype=torch.float64, device=device)
        self._low, self._high = (torch.tensor(x, dtype=torch.float64, device=device) for x in (-math.inf, math.inf))

    def fit(self, policy: Policy, rollout: Rollout, *, generator: torch.Generator) -> dict[str, float]:
        """Fit the network to the targets of all visits.

        Returns:
            value: the mean squared error in squared reward units. explained_variance: 1 - Var(error) / Var(targets).
            Both are of the values before the fit. value_grad_norm: mean over the gradient steps.

        Raises:
            PgtsError: a target, a loss or a gradient is not finite.
        """
        if self.target == "q" and policy is not self._policy:
            self._queried = None  # they were means over the actions of another policy
        self._policy = policy
        self._optimiser.learning_rate = value_at(self._rate, self.num_env_steps)
        num_fits, tensors = self._num_fits, [*self.network.tensors, self._mean, self._scale]
        tensors += [self._seen_3, self._low, self._high, *(self._target_network.tensors if self._lags else [])]
        try:
            with self._optimiser.attempt(tensors) as readings:
                v_TB, target_V = self._targets(rollout, readings)
                error_V = target_V - self._before_fit(rollout, v_TB)
                error, unexplained = mean_and_variance("errors", error_V, rollout.ranks)
                readings.add(value=error_V.square().mean() if rollout.ranks.size == 1 else error**2 + unexplained)
                readings.add(spread=mean_and_variance("targets", target_V, rollout.ranks)[1], unexplained=unexplained)
                self._see(rollout)
                self._fit_all(rollout, target_V, generator, readings)
        except PgtsError:
            self._num_fits = num_fits
            raise
        found = readings.means
        return {
            "value": found["value"],
            "explained_variance": 1 - found["unexplained"] / found["spread"] if found["spread"] else 0.0,
            "value_grad_norm": found["value_grad_norm"],
        }

    def _see(self, rollout: Rollout) -> None:
        """Widen the range of values to what these rewards and discounts allow, and 0 after an end."""
        lowest, highest = rollout.of_visits(rollout.reward_TB).aminmax()
        discount = rollout.of_visits(rollout.discount_TB).amax()
        least_3 = torch.stack([lowest, -highest, -discount]).clamp_(max=0).to(self._seen_3)
        seen_3 = rollout.ranks.least("rewards and discounts", least_3)
        if not (seen_3.is_cpu and bool((seen_3 >= self._seen_3).all())):  # to ask a GPU takes longer than to compute
            self._keep_within(torch.minimum(self._seen_3, seen_3))

    def _keep_within(self, seen_3: Float[Tensor, "3"]) -> None:
        """Take these as seen, and the range of values that follows: `models.rewards.value_range`, without a read."""
        self._seen_3.copy_(seen_3)
        size_2 = seen_3[:2].clamp(max=0)  # minus how far below and above 0 a reward can be
        reach_2 = torch.where(size_2 < 0, size_2 / (1 + seen_3[2]), 0.0)
        self._low.copy_(reach_2[0])
        self._high.copy_(-reach_2[1])

    def _before_fit(self, rollout: Rollout, v_TB: Float[Tensor, "T B"]) -> Float[Tensor, "V"]:
        """The values of the visits that the fit changes; v_TB are those of the target network."""
        if not self._lags and self.target == "v":
            return rollout.of_visits(v_TB)
        action_V = rollout.of_visits(rollout.action_TB)
        return self._taken(self._values(self.network, rollout.observation_V), action_V)

    def _fit_all(
        self, rollout: Rollout, target_V: Float[Tensor, "V"], generator: torch.Generator, readings: Readings
    ) -> None:
        """Fit the network to these targets, and to those that it makes itself then, as often as the options say."""
        observation_V, action_V = rollout.observation_V, rollout.of_visits(rollout.action_TB)
        if self.target == "v":  # which has no use for them, whatever they are
            action_V = torch.zeros(len(action_V), dtype=torch.int64, device=action_V.device)
        encoder = self.network.encoder
        if encoder.fresh or not _shares_trunk(self._policy, self.network):
            encoder.absorb(observation_V, rollout.ranks)
        input_V = self.network.encode(observation_V)
        fits, passes = (self.options.num_epochs, 1) if self.options.fresh_targets else (1, self.options.num_epochs)
        self._fit((input_V, action_V, target_V), rollout.share, passes, generator, readings)
        for _ in range(fits - 1):
            target_V = self._targets(rollout, readings)[1]
            self._fit((input_V, action_V, target_V), rollout.share, passes, generator, readings)

    def _fit(
        self,
        visits: tuple[Tensor, Tensor, Tensor],
        share: Share,
        num_passes: int,
        generator: torch.Generator,
        readings: Readings,
    ) -> None:
        """Fit the network to given targets.

        Args:
            visits: the encoded observations, the actions and the targets of this process.
            share: which of all visits these are.
        """
        input_V, action_V, target_V = visits
        if self.options.normalize_returns:
            self._rescale(target_V, share.ranks)
            target_V = torch.where(self._scale == 0, 0.0, (target_V - self._mean) / self._scale)
        columns = input_V, action_V, target_V.float()
        steps = dense_steps(self.network, self._optimiser)
        for _ in range(num_passes):
            for count, part in minibatches(columns, self.options.minibatch_size, share, generator=generator):
                if steps is None:
                    norm: Tensor | float = self._step(count, part, share.ranks)
                else:
                    norm = steps.values(count, part, share.ranks)[0]
                readings.add(value_grad_norm=norm)
        self._num_fits += 1
        self._move_target_network()

    def _step(self, count: int, part: tuple[Tensor, ...], ranks: Ranks) -> Tensor:
        """Take a step on these rows of a minibatch, which has `count` in all processes. Return the gradient's norm."""
        input_N, action_N, y_N = part
        made = Forward(self.network, input_N)
        off_N = self._taken(made.output_ND, action_N) - y_N
        # The gradient of mean_n off_n^2 in the outputs, of which each row has one that counts.
        down_N1 = (2 / count * off_N)[:, None]
        if self.target == "v":
            down_ND = down_N1
        else:
            down_ND = torch.zeros_like(made.output_ND).scatter_(-1, action_N[:, None], down_N1)
        own = made.gradients(down_ND), off_N.square().sum() / count
        gradients, (loss,) = ranks.summed("the gradient of values", *own)
        return self._optimiser.step(self.network.weights, gradients, loss, "value")

    def v(self, observation_N: Tensor) -> Float[Tensor, "N"]:
        """The network's value; for a network of Q, sum_a pi(a|o) Q(o, a)."""
        return self._v(self.network, observation_N)

    def values(self, rollout: Rollout) -> tuple[Float[Tensor, "T B"], Float[Tensor, "T B"]]:
        """v(s_t) and v(s_{t+1}). They are kept for the next fit if it is to the same rollout."""
        self._queried = rollout, rollout.values(self.v)
        return self._queried[1]

    def q(self, observation_N: Tensor) -> Float[Tensor, "N A"]:
        if self.target != "q":
            raise PgtsError("this critic learns v; it has no Q. Make it with target='q', or search with v_leaf")
        legal_NA = self.network.encoder.legal(observation_N)
        return legal_only(self._values(self.network, observation_N), legal_NA)

    def state_dict(self) -> dict[str, Any]:
        state = {
            "network": self.network.plain_state(),
            "optimiser": self._optimiser.state_dict(),
            "mean": float(self._mean),
            "scale": float(self._scale),
            "num_fits": self._num_fits,
        }
        if self._seen_3.isfinite().all():
            state["seen"] = self._seen_3.tolist()
        return state | ({"target_network": self._target_network.plain_state()} if self._lags else {})

    def load_state_dict(self, state: dict[str, Any]) -> None:
        lagging = {"target_network"} if self._lags else set()
        names = {"network", "optimiser", "mean", "scale", "num_fits", *lagging}
        check_keys("the state of a network critic", state, names, others={"seen"})
        if not isinstance(state["mean"], float):
            raise PgtsError(f"mean is {state['mean']!r}; it must be a number")
        if not (isinstance(state["scale"], float) and state["scale"] >= 0):
            raise PgtsError(f"scale is {state['scale']!r}; it must be at least 0")
        check_count("num_fits", state["num_fits"], least=0)
        seen = state.get("seen")
        if seen is not None and not (
            isinstance(seen, list) and len(seen) == 3 and all(isinstance(x, float) and x <= 0 for x in seen)
        ):
            raise PgtsError(f"seen is {seen!r}; it must be three numbers of at most 0")
        self.network.load_plain_state(state["network"])
        if self._lags:
            self._target_network.load_plain_state(state["target_network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._optimiser.check_fits(self.network.weights)
        self._queried, self._num_fits = None, state["num_fits"]
        self._mean.fill_(state["mean"])
        self._scale.fill_(state["scale"])
        if seen is None:
            for each, unlimited in (self._seen_3, math.inf), (self._low, -math.inf), (self._high, math.inf):
                each.fill_(unlimited)
        else:
            self._keep_within(torch.tensor(seen, dtype=torch.float64))

    def _values(self, network: Network, observation_N: Tensor) -> Float[Tensor, "N D"]:
        """The network's outputs in reward units."""
        outputs_ND = network.outputs(observation_N)
        values_ND = self._mean + self._scale * outputs_ND if self.options.normalize_returns else outputs_ND
        return values_ND.clamp(self._low, self._high)

    def _v(self, network: Network, observation_N: Tensor) -> Float[Tensor, "N"]:
        if self.target == "v":
            return self._values(network, observation_N).squeeze(-1)
        if self._policy is None:
            raise PgtsError("the critic has no values yet; call fit or iterate before querying it")
        return policy_mean(self._policy.probs(observation_N), self._values(network, observation_N))

    def _taken(self, value_ND: Float[Tensor, "N D"], action_N: Num[Tensor, "N ..."]) -> Float[Tensor, "N"]:
        """v, or Q of the actions taken."""
        return value_ND.squeeze(-1) if self.target == "v" else value_ND.gather(-1, action_N[:, None]).squeeze(-1)

    def _targets(self, rollout: Rollout, readings: Readings) -> tuple[Float[Tensor, "T B"], Float[Tensor, "V"]]:
        """Return v of the target network, and the targets of the visits that are bootstrapped with it."""
        queried, self._queried = self._queried, None
        if queried is not None and queried[0] is rollout and not self._lags:
            v_TB, next_v_TB = queried[1]
        else:
            v_TB, next_v_TB = rollout.values(lambda observation_N: self._v(self._target_network, observation_N))
        return v_TB, critic_targets(rollout, next_v_TB, self.options.method, readings)

    @torch.no_grad()
    def _rescale(self, target_V: Float[Tensor, "V"], ranks: Ranks) -> None:
        """Update mean and scale by the targets, and rescale the heads so that values in reward units stay the same."""
        rate = max(1 / (self._num_fits + 1), _SLOWEST_RATE)
        old_mean, old_scale = self._mean.clone(), self._scale.clone()
        new_mean, new_var = (x.double() for x in mean_and_variance("new targets", target_V, ranks))
        mean = old_mean + rate * (new_mean - old_mean)
        spread = (1 - rate) * (old_scale**2 + (old_mean - mean) ** 2) + rate * (new_var + (new_mean - mean) ** 2)
        # A deviation below the rounding error of the targets is replaced by it. If all targets are 0, so is the scale.
        self._mean.copy_(mean)
        largest = -ranks.least("the largest target", -target_V.abs().max())
        self._scale.copy_(torch.maximum(spread.sqrt(), _ROUNDING * largest))
        if self._num_fits:
            factor = torch.where(self._scale == 0, 1.0, old_scale / self._scale)
            shift = torch.where(self._scale == 0, 0.0, (old_mean - mean) / self._scale)
            for network in {self.network, self._target_network}:
                assert isinstance(network.head, nn.Linear | Scaled)
                network.head.weight.mul_(factor)
                network.head.bias.mul_(factor).add_(shift)

    @torch.no_grad()
    def _move_target_network(self) -> None:
        if not self._lags or self._num_fits % self.options.target_period:
            return
        self._target_network.follow(self.network, self.options.polyak)


def mean_and_variance(what: str, x_V: Float[Tensor, "V"], ranks: Ranks) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Mean and variance over the rows of all ranks; `what` names the exchange."""
    if ranks.size == 1:
        return x_V.mean(), x_V.var(correction=0)
    count, mean_D, square_D = ranks.moments(what, x_V.double()[:, None])
    return mean_D[0], square_D[0] / count


def _shares_trunk(policy: Policy | None, network: Network) -> bool:
    own = getattr(policy, "network", None)
    return isinstance(own, Network) and own.trunk is network.trunk
