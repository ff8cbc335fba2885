"""Dynamics learned from the steps of an environment: an ensemble of networks."""

import copy
import math
from collections.abc import Sequence
from typing import Any, final

import torch
from jaxtyping import Bool, Float, Int, Num
from torch import Tensor, nn

from pgts_torch.errors import NotFinite, PgtsError, check_count, warn
from pgts_torch.models.base import Experience, FallibleModel, Transitions
from pgts_torch.models.ensemble_networks import EnsembleNetworks
from pgts_torch.models.fitted import SELDOM, FittedModel
from pgts_torch.models.held_out import held_out_rows, prediction_errors
from pgts_torch.models.prediction import Prediction
from pgts_torch.models.rewards import value_range
from pgts_torch.options.models import Ensemble
from pgts_torch.ranks import Ranks
from pgts_torch.seeding import stream

_ENDS = 0.25
"""The share of a minibatch that is sampled from steps that ended an episode, which may be rare among all steps."""

_ENOUGH_STEPS, _UNEXPLAINED = 2000, 0.5
"""With so many steps and a larger share of the variance of changes unexplained, a warning is given."""


@final
class EnsembleModel(FittedModel, FallibleModel):
    """E networks that learn from steps alone what follows a state, a vector of D numbers, and an action:

        change of the state      smooth L1 loss, in standard deviations of changes
        reward                   squared error, in standard deviations of rewards
        end of the episode       cross-entropy; ends are oversampled, and the predicted odds corrected for that

    The networks are fitted to minibatches of all steps seen so far except a tenth, which is held out. Each member has
    its own initial weights, minibatches and bootstrap sample of the steps (Chua et al. 2018). `step` returns the means
    over members, with the discount gamma (1 - p) for the probability p of an end; `sample` samples the end, the one
    thing that is random in this model, and trusts no step on which members differ much. The model is an estimate:
    steps of the environment measure its error, and no step contradicts it.

    Args (others as of `FittedModel`):
        options: of networks and fits.
        seed: initial weights are from the stream (seed, "model").
    """

    def __init__(
        self,
        state_size: int,
        num_actions: int,
        *,
        gamma: float,
        options: Ensemble = Ensemble(),  # noqa: B008 - frozen
        capacity: int = 100_000,
        seed: int = 0,
        device: torch.device | str = "cpu",
        action_repeat: int = 1,
        action_size: int = 0,
    ) -> None:
        super().__init__(
            state_size,
            num_actions,
            torch.zeros(0, state_size),
            gamma=gamma,
            capacity=capacity,
            device=device,
            action_repeat=action_repeat,
            action_size=action_size,
            copies=torch.zeros(0, options.members),
        )
        self.options = options
        self._warned, self._end_share = False, 0.0
        self._reward_limits: tuple[float, float] | None = None
        self._networks = EnsembleNetworks(
            state_size,
            num_actions,
            options.members,
            options.hidden,
            generator=stream(seed, "model"),
            device=self.device,
            action_size=action_size,
        )
        self._optimiser = torch.optim.Adam(
            self._networks.weights, lr=options.learning_rate, weight_decay=options.weight_decay, fused=True
        )

    @torch.inference_mode(False)
    @torch.enable_grad()
    def learn(self, experience: Experience, *, generator: torch.Generator) -> dict[str, float]:
        """Keep the steps, and fit the networks to all that are kept.

        Returns:
            loss: the mean over the gradient steps. error_1, error_4, error_16: the root mean square error of the state
            predicted so many steps ahead, on held-out steps, in standard deviations of states; left out where too few
            are held out. unexplained: the share of the variance of changes not predicted there, but for outliers.

        Raises:
            PgtsError: steps with a discount other than gamma and 0; observations that are no vectors of D numbers.
            NotFinite: a number of the steps, or a loss, is not finite.

        Warns:
            UserWarning: once, where half of the variance of changes is unexplained: observations may not be states.
        """
        if (shape := experience.observation_N.shape)[1:] != (self.state_size,):
            raise PgtsError(
                f"an observation has shape {tuple(shape[1:])}; an ensemble learns from vectors of {self.state_size} "
                "numbers"
            )
        ends, ranks, is_first = self._ends(experience.discount_N), experience.ranks, self.replay.num_added == 0
        self._keep(experience, copies=self._copies(ends, generator))
        self._measure_moments(ranks)
        held_out = held_out_rows(self.replay)
        trained = torch.nonzero(~held_out).flatten()
        ended = trained[self.replay.rows("end", trained) > 0]
        new_R, *rows = ranks.each("kept steps", len(ends), len(trained), len(ended)).T.tolist()
        self._end_share = sum(rows[1]) / sum(rows[0])
        count = self.options.first_updates if is_first else round(self.options.updates_per_step * sum(new_R))
        losses = [self._fit(trained, ended, rows, generator, ranks) for _ in range(count)]
        found = torch.stack(losses).tolist() if losses else []
        for value in found:
            if not math.isfinite(value):
                raise NotFinite(f"the loss of the learned model is {value}", what="model")
        self.generation += 1
        return {"loss": sum(found) / max(count, 1), **self._errors(held_out, ranks)}

    def _copies(self, end_N: Bool[Tensor, "N"], generator: torch.Generator) -> Float[Tensor, "N E"]:
        """How often each member has each step: Poisson with mean 1, as in a bootstrap sample of many steps (Oza and
        Russell 2001). All have the ends, which may be too few to miss one."""
        if self.options.members == 1:
            return torch.ones(len(end_N), 1)
        mean_NE = torch.ones(len(end_N), self.options.members, device=generator.device)
        return torch.where(end_N[:, None].cpu(), 1.0, torch.poisson(mean_NE, generator=generator).cpu())

    def _measure_moments(self, ranks: Ranks) -> None:
        state_ND, next_ND, reward_N = (self.replay.rows(name) for name in ("state", "next_state", "reward"))
        seen = {"state": state_ND, "change": next_ND - state_ND, "reward": reward_N[:, None]}
        self._networks.measure(seen, ranks, rescale=self.generation > 0)  # before nothing is predicted
        limits = ranks.least("limits of rewards", torch.stack([reward_N.min(), -reward_N.max()]))
        self._reward_limits = float(limits[0]), -float(limits[1])

    def _fit(
        self,
        trained: Int[Tensor, "R"],
        ended: Int[Tensor, "Q"],
        rows: Sequence[Sequence[float]],
        generator: torch.Generator,
        ranks: Ranks,
    ) -> Tensor:
        """Take one gradient step, with a minibatch for each member, but none where the loss is not finite. Return the
        loss; nothing is read back from the device.

        Args:
            trained: the rows that are not held out.
            ended: those of them that ended an episode; if there are any, a quarter of each minibatch is of these.
            rows: how many of both each process has. A minibatch has as large a part of each process.
        """
        E, N = self.options.members, self.options.minibatch_size
        extra = round(N * _ENDS) if sum(rows[1]) else 0
        own, own_extra = ranks.portion(N - extra, rows[0]), ranks.portion(extra, rows[1]) if extra else 0

        def sampled(rows: Tensor, count: int) -> Tensor:
            return rows[torch.randint(len(rows), (E, count), generator=generator, device=generator.device).cpu()]

        at = torch.cat([sampled(trained, own), sampled(ended, own_extra)] if own_extra else [sampled(trained, own)], 1)
        columns = ("state", "action", "reward", "end", "next_state")
        state, action, reward, end, after = (self.replay.rows(c, at.flatten()).to(self.device) for c in columns)
        # The frequency of a row among all steps, divided by that in the minibatch, where ends are oversampled. The loss
        # of ends has no such weight: their log odds are corrected by `_log_odds_added`.
        copies = self.replay.rows("copies")[at, torch.arange(E)[:, None]].flatten().to(self.device)
        weight = copies / (1 - _ENDS + _ENDS * end / self._end_share) if extra else copies
        output = self._networks.outputs(self._networks.inputs(state, action).view(*at.shape, -1)).flatten(0, 1)
        scaled = self._networks.scaled
        aimed = torch.cat([scaled("change", after - state), scaled("reward", reward[:, None])], -1)
        changes, rewards, logits = output.split([self.state_size, 1, 1], -1)
        loss = (
            weight @ nn.functional.smooth_l1_loss(changes, aimed[:, :-1], reduction="none").mean(-1) / (E * N)
            + weight @ (rewards - aimed[:, -1:]).square()[:, 0] / (E * N)
            + nn.functional.binary_cross_entropy_with_logits(logits[:, 0], end, copies) * (len(weight) / (E * N))
        )
        self._optimiser.zero_grad()
        loss.backward()
        loss = self._networks.sum_gradients(loss, ranks)
        # What torch's gradient scaler sets: a step with it is left out, without a branch on the host.
        self._optimiser.found_inf = (~loss.detach().isfinite()).to(torch.float32)  # type: ignore[attr-defined]  # Adam reads it
        self._optimiser.step()
        return loss.detach()

    @torch.no_grad()
    def members(self, state_ND: Float[Tensor, "N D"], action_N: Num[Tensor, "N ..."]) -> Prediction:
        """The predictions of all members."""
        said = self._networks.predict(state_ND, action_N, self._log_odds_added)
        return said._replace(end_EN=torch.where(said.end_EN < SELDOM, 0.0, said.end_EN))

    @property
    def _log_odds_added(self) -> float:
        """By how much the log odds of an end are larger in minibatches than among all steps (King and Zeng 2001)."""
        return math.log1p(_ENDS / ((1 - _ENDS) * self._end_share)) if self._end_share else 0.0

    @property
    def _deviations(self) -> dict[str, Tensor]:
        """Standard deviations of states, of their changes and of rewards."""
        return {name: deviation for name, (_, deviation) in self._networks.moments.items()}

    def step(
        self, state_ND: Float[Tensor, "N D"], action_N: Num[Tensor, "N ..."]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N D"]]:
        """The means over members, rewards within those seen; the discount is gamma (1 - p)."""
        return self._means(self.members(state_ND, action_N))

    def _means(self, said: Prediction) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N D"]]:
        low, high = self._reward_limits or (-math.inf, math.inf)
        reward_N = said.reward_EN.mean(0).double().clamp(low, high)
        return reward_N, self.gamma * (1 - said.end_EN.mean(0).double()), said.next_END.mean(0)

    def sample(
        self, state_N: Int[Tensor, "N"], action_N: Num[Tensor, "N ..."], *, key_N: Int[Tensor, "N"]
    ) -> Transitions:
        """The means over members; the episode ends with their mean probability, and the discount is then 0, else gamma.
        A step is trusted where `Prediction.disagreement` is at most `max_disagreement`. With repeated actions no end is
        sampled, the discount is the mean one, as that of `step`, and all steps are trusted."""
        if self.action_repeat > 1:
            return super().sample(state_N, action_N, key_N=key_N)
        said = self.members(self.states(state_N), action_N)
        trusted_N = said.disagreement(self._deviations["state"]) <= self.options.max_disagreement
        return self._with_ends(*self._means(said), key_N=key_N, trusted_N=trusted_N)

    def step_error(self, state_N: Int[Tensor, "N"]) -> Float[Tensor, "N A"] | None:
        """An estimate, `Prediction.spread` for the values [l, u] that the rewards seen allow; None with one member,
        repeated actions or gamma 1."""
        if self.options.members == 1 or self.action_repeat > 1 or self.gamma == 1:
            return None
        action_N = torch.arange(self.num_actions, device=self.device).repeat(len(state_N))
        said = self.members(self.states(state_N).repeat_interleave(self.num_actions, 0), action_N)
        rewards = self.replay.rows("reward")
        limits = self._reward_limits or (float(rewards.min()), float(rewards.max()))
        low, high = value_range(limits, self.gamma)
        spread_N = said.spread(self._deviations["state"], self.gamma * (high - low))
        return spread_N.double().view(-1, self.num_actions)

    def _errors(self, held_out: Tensor, ranks: Ranks) -> dict[str, float]:
        """The errors on held-out steps, by name (`learn`)."""
        errors = prediction_errors(self.replay, held_out, self.step, self._deviations, ranks)
        if errors.get("unexplained", 0.0) > _UNEXPLAINED and len(self.replay) >= _ENOUGH_STEPS and not self._warned:
            self._warned = True
            warn(
                f"after {self.replay.num_added:,} steps {errors['unexplained']:.0%} of what changes in an observation "
                "is not predicted from the one before: the observation may not be the state (give it what is missing, "
                "as speeds or earlier observations), or chance decides what follows"
            )
        return errors

    def state_dict(self) -> dict[str, Any]:
        """Weights, moments, optimiser and replay."""
        return {
            **self._networks.state_dict(),
            "optimiser": {
                number: {name: value.cpu().clone() for name, value in each.items()}
                for number, each in self._optimiser.state_dict()["state"].items()
            },
            "replay": self.replay.state_dict(),
            "end_share": self._end_share,
            "warned": self._warned,
            "generation": self.generation,
            "reward_limits": self._reward_limits,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        check_count("generation", state["generation"], least=0)
        if not (isinstance(state["end_share"], float) and 0 <= state["end_share"] <= 1):
            raise PgtsError(f"end_share is {state['end_share']!r}; it must be a share")
        self._networks.load_state_dict(state)
        groups = self._optimiser.state_dict()["param_groups"]
        self._optimiser.load_state_dict({"state": copy.deepcopy(state["optimiser"]), "param_groups": groups})
        self.replay.load_state_dict(state["replay"])
        self._end_share = state["end_share"]
        self._warned, self.generation = bool(state["warned"]), state["generation"]
        self._reward_limits = state.get("reward_limits")
