"""A model of images, learned from the steps of an environment: it represents them as vectors, and steps these."""

import math
from typing import Any, final

import numpy as np
import torch
from gymnasium import spaces
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor, nn

from pgts_torch.agent.critics import Critic
from pgts_torch.agent.latent_losses import Unrolled, consistency_loss, equivalence_losses, outcome_losses
from pgts_torch.agent.networks import Network, default_network, make_trunk
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_critic import NetworkCritic
from pgts_torch.agent.optimisers import Optimiser
from pgts_torch.agent.policies import Policy
from pgts_torch.errors import NotFinite, PgtsError, check_count
from pgts_torch.models.base import Experience, Transitions
from pgts_torch.models.fitted import SELDOM, FittedModel
from pgts_torch.models.held_out import held_out_rows, runs, sequences
from pgts_torch.models.state_index import hash_rows
from pgts_torch.options.models import Latent
from pgts_torch.options.policies import CNN, MLP
from pgts_torch.ranks import Ranks
from pgts_torch.seeding import stream

_ENDS = 0.25
"""How many steps that ended an episode are added to a minibatch, as a share of its other steps."""

_MOST_ADDED = math.log(20)
"""The most that is taken off the log odds of an end for its oversampling: what has happened once in thousands of steps
is believed, or a single success would for long be worth nothing. Where chance decides, a rarer end is then taken for
more certain than it is where it can happen."""

_AHEAD = (1, 4)
"""The numbers of steps ahead for which the prediction error is measured."""

_MOST_MEASURED = 256
"""The most starts, the latest ones, from which an error is measured."""


@final
class LatentModel(FittedModel):
    """Networks that represent an image as a latent vector z of D numbers, with mean 0 and variance 1, and step it:

        z = norm(h(image)),    (change, r_0, r_1, logit) = g(z, a),    z' = norm(z + change)

        reward = (1 - p) r_0 + p r_1,    discount = gamma (1 - p),    p = the probability of an end

    so r_0 is the reward of a step after which the episode goes on, r_1 that of a step that ends it. Nothing is decoded
    (MuZero, Schrittwieser et al. 2020). Over K steps from an image, with the actions that were taken, these are added:

        reward          squared error, in standard deviations of rewards
        end             cross-entropy; ends are oversampled, and the predicted odds corrected for that
        consistency     of the predicted vector and that of the image seen: the mean squared difference, and
                        cross-entropy of the image among those of the minibatch (van den Oord et al. 2018), without
                        which all images may become the same vector as long as no reward has been seen
        value, policy   squared difference of v and KL divergence of pi, of critic and policy in training, between the
                        two vectors (value equivalence, Grimm et al. 2020)

    `step` is deterministic, `sample` samples the end. A tenth of the steps is held out to measure errors.

    space: of the vectors.   representation: the network h.
    replay: its columns "state" and "next_state" have the images, as they came.

    Args (others as of `FittedModel`):
        space: of images, (height, width, channels).
        options: of networks and fits.
        seed: initial weights are from the stream (seed, "model").
    """

    def __init__(
        self,
        space: spaces.Box,
        num_actions: int,
        *,
        gamma: float,
        options: Latent = Latent(),  # noqa: B008 - frozen
        capacity: int = 100_000,
        seed: int = 0,
        device: torch.device | str = "cpu",
        action_repeat: int = 1,
    ) -> None:
        super().__init__(
            options.size,
            num_actions,
            torch.from_numpy(np.zeros((0, *space.shape), space.dtype)),
            gamma=gamma,
            capacity=capacity,
            device=device,
            action_repeat=action_repeat,
        )
        self.options = options
        generator, inputs = stream(seed, "model"), spaces.Box(-np.inf, np.inf, (options.size + num_actions,))
        self.space = spaces.Box(-np.inf, np.inf, (options.size,))
        network = options.network if isinstance(options.network, CNN) else default_network(space)
        image_trunk = make_trunk(network, space, generator=generator)
        step_trunk = make_trunk(MLP(hidden=options.hidden, activation="relu"), inputs, generator=generator)
        self.representation = Network(image_trunk, options.size, gain=1.0, generator=generator).to(device)
        # a small gain: at first nothing changes
        self._dynamics = Network(step_trunk, options.size + 3, gain=0.1, generator=generator).to(device)
        self._optimiser = Optimiser(learning_rate=options.learning_rate, max_grad_norm=None)
        self._reward_mean = self._reward_scale = self._log_odds_added = 0.0

    def serve(self, critic: Critic, policy: Policy) -> None:
        """Learn vectors for these, which take them in place of images; to be called before `learn`.

        Raises:
            PgtsError: they are no networks.
        """
        if not isinstance(critic, NetworkCritic) or not isinstance(policy, NetworkPolicy):
            raise PgtsError(
                f"model is 'latent', which needs networks; the critic is a {type(critic).__name__} and the policy a "
                f"{type(policy).__name__}"
            )
        self._values, self._logits = critic.network, policy.network

    def represent(self, image_N: Shaped[Tensor, "N ..."]) -> Float[Tensor, "N D"]:
        """The vectors of images, without gradient; vectors are returned as they are."""
        return image_N if image_N.ndim == 2 else standardised(self.representation.outputs(image_N.to(self.device)))

    @torch.inference_mode(False)
    @torch.enable_grad()
    def learn(self, experience: Experience, *, generator: torch.Generator) -> dict[str, float]:
        """Keep the steps, and fit the networks to all that are kept.

        Returns:
            reward, end, consistency, value, policy: the losses, means over the gradient steps. error_1, error_4: the
            root mean square error of the vector predicted so many steps ahead, on held-out steps, in standard
            deviations of vectors; left out where too few are held out.

        Raises:
            PgtsError: steps with a discount other than gamma and 0.
            NotFinite: a reward, a loss or a gradient is not finite.
        """
        ends, ranks, is_first = self._ends(experience.discount_N), experience.ranks, self.replay.num_added == 0
        self._keep(experience)
        self.representation.trunk.encoder.absorb(experience.observation_N.to(self.device), ranks)
        self._measure_rewards(ranks)
        held_out = held_out_rows(self.replay)
        count = self.options.updates_per_step * ranks.totals("steps", len(ends))[0]
        losses = self._fit(held_out, self.options.first_updates if is_first else round(count), generator, ranks)
        self.generation += 1
        return {**losses, **self._errors(held_out, ranks)}

    def _measure_rewards(self, ranks: Ranks) -> None:
        rewards = self.replay.rows("reward")
        mean, scale = float(rewards.mean()), float(rewards.std(correction=0))
        if ranks.size > 1:
            number, mean_1, square_1 = ranks.moments("rewards", rewards.double()[:, None])
            mean, scale = float(mean_1), math.sqrt(square_1 / number)
        if not mean + scale < float("inf"):
            raise NotFinite(f"the mean of rewards is {mean}; what a model learns must be finite", what="model")
        self._reward_mean, self._reward_scale = mean, scale

    def _fit(
        self, held_out: Bool[Tensor, "R"], count: int, generator: torch.Generator, ranks: Ranks
    ) -> dict[str, float]:
        """Take so many gradient steps. Return the means of the losses, by name. A minibatch has a part of each rank, in
        proportion to the steps that it keeps; losses compare all of it, so the vectors of all are exchanged."""
        trained = torch.nonzero(~held_out).flatten()
        ended = trained[self.replay.rows("end", trained) > 0]
        weights, num_counted = self.representation.weights + self._dynamics.weights, 0

        def sampled(rows: Tensor, number: int) -> Tensor:
            return rows[torch.randint(len(rows), (number,), generator=generator, device=generator.device).cpu()]

        trained_R, ended_R = ranks.each("kept steps", len(trained), len(ended)).T.tolist()
        extra = round(_ENDS * self.options.minibatch_size * self.options.unroll) if sum(ended_R) else 0
        own = ranks.portion(self.options.minibatch_size, trained_R)
        own_extra = ranks.portion(extra, ended_R) if extra else 0
        with self._optimiser.attempt(self.representation.tensors + self._dynamics.tensors) as readings:
            for _ in range(count):
                starts = sampled(trained, own)
                at_KN, counts_KN = sequences(self.replay, held_out, starts, self.options.unroll)
                more = sampled(ended, own_extra) if own_extra else starts[:0]
                losses, num_rows = self._losses(at_KN, counts_KN, more, ranks)
                loss = torch.stack(list(losses.values())).sum()
                gradients, _ = ranks.summed("the gradient of the model", torch.autograd.grad(loss, weights))
                self._optimiser.step(weights, gradients, loss, "model")
                readings.add(**losses)
                num_counted += num_rows - extra
        if extra and count:
            # By how much the log odds of an end are larger than among all steps (King and Zeng 2001).
            share = sum(ended_R) / sum(trained_R)
            self._log_odds_added = min(_MOST_ADDED, math.log1p(extra * count / (num_counted * share)))
        return readings.means

    def _losses(
        self, at_KN: Int[Tensor, "K N"], counts_KN: Bool[Tensor, "K N"], ended_M: Int[Tensor, "M"], ranks: Ranks
    ) -> tuple[dict[str, Tensor], int]:
        """The losses of sequences of rows, and of M more rows with ends, of all ranks: by name, and how many rows count
        for rewards and ends."""
        steps, output_C3 = self._unrolled(at_KN, counts_KN)
        at_C = at_KN[counts_KN]
        if len(ended_M):
            latent_MD = self._represented(self._rows("state", ended_M))
            output_M3 = self._advanced(latent_MD, self._rows("action", ended_M))[1]
            at_C, output_C3 = torch.cat([at_C, ended_M]), torch.cat([output_C3, output_M3])
        reward_C, end_C = self._rows("reward", at_C) - self._reward_mean, self._rows("end", at_C)
        steps, (output_C3, reward_C, end_C) = steps.of_all(ranks), ranks.rows("outcomes", output_C3, reward_C, end_C)
        losses = outcome_losses(output_C3, reward_C / (self._reward_scale or 1.0), end_C)
        losses["consistency"] = consistency_loss(steps)
        return losses | equivalence_losses(steps, self._values, self._logits), len(end_C)

    def _rows(self, name: str, at_N: Int[Tensor, "N"]) -> Tensor:
        rows: Tensor = self.replay.rows(name, at_N)
        return rows.to(self.device)

    def _represented(self, image_N: Shaped[Tensor, "N ..."]) -> Float[Tensor, "N D"]:
        """The vectors of images, with gradient."""
        return standardised(self.representation(self.representation.encode(image_N)))

    def _advanced(
        self, latent_ND: Float[Tensor, "N D"], action_N: Int[Tensor, "N"]
    ) -> tuple[Float[Tensor, "N D"], Float[Tensor, "N 3"]]:
        """The next vectors; and (r_0, r_1, logit), with rewards in standard deviations from their mean."""
        action_NA = nn.functional.one_hot(action_N, self.num_actions).float()
        output_NO = self._dynamics(torch.cat([latent_ND, action_NA], -1))
        return standardised(latent_ND + output_NO[:, :-3]), output_NO[:, -3:]

    def _unrolled(
        self, at_KN: Int[Tensor, "K N"], counts_KN: Bool[Tensor, "K N"]
    ) -> tuple[Unrolled, Float[Tensor, "C 3"]]:
        """Step along sequences of rows. Return their vectors, and what `_advanced` says of the steps that count."""
        K, N = at_KN.shape
        image_M = self._rows("next_state", at_KN.flatten())
        latent_MD = self._represented(torch.cat([self._rows("state", at_KN[0]), image_M]))
        latent_ND, predicted, outputs = latent_MD[:N], [], []
        for action_N in self._rows("action", at_KN.flatten()).view(K, N):
            latent_ND, output_N3 = self._advanced(latent_ND, action_N)
            predicted.append(latent_ND)
            outputs.append(output_N3)
        goes_on_KN = counts_KN & (self.replay.rows("end", at_KN.flatten()).view(K, N) == 0)
        hash_KN = hash_rows(image_M.flatten(1).double().view(torch.int64)).view(K, N)
        # The masks stay in host memory, as the replay: with one on a GPU, an index would wait for its count.
        steps = Unrolled(torch.stack(predicted), latent_MD[N:].view(K, N, -1), hash_KN, goes_on_KN)
        return steps, torch.stack(outputs)[counts_KN]

    @torch.no_grad()
    def step(
        self, state_ND: Float[Tensor, "N D"], action_N: Int[Tensor, "N"]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N D"]]:
        """The expected reward, the discount gamma (1 - p), and the next vector."""
        next_ND, output_N3 = self._advanced(state_ND, action_N)
        end_N = (output_N3[:, 2].double() - self._log_odds_added).sigmoid()
        end_N = torch.where(end_N < SELDOM, 0.0, end_N)
        reward_N2 = self._reward_mean + self._reward_scale * output_N3[:, :2].double()
        return reward_N2[:, 0].lerp(reward_N2[:, 1], end_N), self.gamma * (1 - end_N), next_ND

    def sample(self, state_N: Int[Tensor, "N"], action_N: Int[Tensor, "N"], *, key_N: Int[Tensor, "N"]) -> Transitions:
        """As `step`; the episode ends with probability p, and the discount is then 0, else gamma. With repeated actions
        no end is sampled, and the discount is the mean one, as that of `step`."""
        if self.action_repeat > 1:
            return super().sample(state_N, action_N, key_N=key_N)
        return self._with_ends(*self.step(self.states(state_N), action_N), key_N=key_N)

    @torch.no_grad()
    def _errors(self, held_out: Bool[Tensor, "R"], ranks: Ranks) -> dict[str, float]:
        """The errors on held-out steps of all ranks after which the episode goes on, by name (`learn`)."""
        errors = {}
        for steps in _AHEAD:
            starts = runs(held_out, self.replay.rows("follows"), steps)
            last = (starts + steps - 1) % self.replay.capacity
            starts = starts[self.replay.rows("end", last) == 0][-_MOST_MEASURED:]
            if ranks.totals("held-out steps", len(starts))[0] < 2:
                continue
            latent_ND = self.represent(self.replay.rows("state", starts))
            for ahead in range(steps):
                at_N = (starts + ahead) % self.replay.capacity
                latent_ND = self._advanced(latent_ND, self._rows("action", at_N))[0]
            true_ND = self.represent(self.replay.rows("next_state", at_N))
            latent_ND, true_ND = ranks.rows("held-out vectors", latent_ND, true_ND)
            spread = float(true_ND.var(0, correction=0).mean())
            errors[f"error_{steps}"] = float((latent_ND - true_ND).square().mean() / max(spread, 1e-12)) ** 0.5
        return errors

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimiser, moments of rewards, and replay."""
        return {
            "representation": self.representation.plain_state(),
            "dynamics": self._dynamics.plain_state(),
            "optimiser": self._optimiser.state_dict(),
            "rewards": [self._reward_mean, self._reward_scale],
            "log_odds_added": self._log_odds_added,
            "replay": self.replay.state_dict(),
            "generation": self.generation,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        check_count("generation", state["generation"], least=0)
        self.representation.load_plain_state(state["representation"])
        self._dynamics.load_plain_state(state["dynamics"])
        self._optimiser.load_state_dict(state["optimiser"])
        self._optimiser.check_fits(self.representation.weights + self._dynamics.weights)
        self.replay.load_state_dict(state["replay"])
        self._reward_mean, self._reward_scale = map(float, state["rewards"])
        self._log_odds_added, self.generation = float(state["log_odds_added"]), state["generation"]


def standardised(x_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N D"]:
    """Rows of mean 0 and variance 1."""
    return nn.functional.layer_norm(x_ND, x_ND.shape[-1:])
