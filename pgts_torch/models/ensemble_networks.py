"""Networks side by side that predict steps of a state vector, with the moments that they standardise numbers by."""

import itertools
from collections.abc import Mapping
from typing import Any, final

import torch
from jaxtyping import Float, Num
from torch import Tensor, nn

from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.models.prediction import Prediction
from pgts_torch.ranks import ALONE, Ranks

_CLIP = 8.0
"""Standardised inputs are clipped to +- this."""


@final
class EnsembleNetworks:
    """E networks of the same sizes, computed as one batched product. They take a state and an action,
    one-hot or a vector that is squashed by tanh, and return
    the change of the state, the reward, both standardised, and the log odds of an end.

    weights: all parameters.
    moments: mean and standard deviation of states, of their changes and of rewards, by name.

    Args:
        state_size: D.
        num_actions: A; 0 where actions are vectors.   action_size: X, of these.
        members: E.
    """

    def __init__(
        self,
        state_size: int,
        num_actions: int,
        members: int,
        hidden: list[int],
        *,
        generator: torch.Generator,
        device: torch.device,
        action_size: int = 0,
    ) -> None:
        self.state_size, self.num_actions, self.members, self._device = state_size, num_actions, members, device
        sizes = [state_size + (num_actions or action_size), *hidden, state_size + 2]
        # the weight [E, inputs, outputs] and the bias [E, 1, outputs] of each layer
        self._layers = [
            (
                nn.Parameter((torch.randn(members, a, b, generator=generator) / a**0.5).to(device)),
                nn.Parameter(torch.zeros(members, 1, b).to(device)),
            )
            for a, b in itertools.pairwise(sizes)
        ]
        self._layers[-1][0].data.mul_(0.1)  # at first all members predict little but the mean
        self.weights = [weight for layer in self._layers for weight in layer]
        self.moments = {
            name: (torch.zeros(size, device=device), torch.ones(size, device=device))
            for name, size in (("state", state_size), ("change", state_size), ("reward", 1))
        }

    def measure(self, values: Mapping[str, Float[Tensor, "N D"]], ranks: Ranks = ALONE, *, rescale: bool) -> None:
        """Take the moments of these values, of all ranks, by name.

        Args:
            rescale: the weights, so that what is predicted stays the same.

        Raises:
            NotFinite: a mean or a deviation is not finite.
        """
        for name, value in values.items():
            mean, deviation = value.mean(0), value.std(0, correction=0)
            if ranks.size > 1:
                count, mean_D, square_D = ranks.moments(f"{name}s", value.double())
                mean, deviation = mean_D.to(mean), (square_D / count).sqrt().to(mean)
            if not bool((mean + deviation).isfinite().all()):
                raise NotFinite(
                    f"the mean of {name}s is {mean.tolist()}; what a model learns must be finite", what="model"
                )
            before = self.moments[name]
            self.moments[name] = mean.to(self._device), deviation.to(self._device)
            if rescale:
                self._rescale(name, before)

    @torch.no_grad()
    def _rescale(self, name: str, before: tuple[Tensor, Tensor]) -> None:
        """Rescale the weights of what was standardised by other moments before, so that what is predicted stays the
        same, but where numbers were or are constant, or inputs clipped (as PopArt, van Hasselt et al. 2016)."""
        (old_mean, old_deviation), (mean, deviation) = before, self.moments[name]
        varies = (deviation > 0) & (old_deviation > 0)
        ratio = torch.where(varies, deviation / old_deviation, 1.0)
        shift = torch.where(varies, (mean - old_mean) / old_deviation, 0.0)
        if name == "state":  # inputs x become (x - shift) / ratio
            weight, bias = self._layers[0]
            bias.add_((shift @ weight[:, : self.state_size])[:, None])
            weight[:, : self.state_size] *= ratio[:, None]
            return
        weight, bias = self._layers[-1]  # outputs, and what they are aimed at
        of = slice(0, self.state_size) if name == "change" else slice(self.state_size, self.state_size + 1)
        weight[..., of] /= ratio
        bias[..., of] = (bias[..., of] - shift) / ratio

    def sum_gradients(self, loss: Tensor, ranks: Ranks) -> Tensor:
        """Replace the gradients of the weights by their sums over ranks, and return the sum of the loss."""
        gradients = [weight.grad for weight in self.weights if weight.grad is not None]
        flat, (loss,) = ranks.summed("the gradient of the model", gradients, loss.detach())
        if ranks.size > 1:
            for own, piece in zip(gradients, flat[0].split([each.numel() for each in gradients]), strict=True):
                own.copy_(piece.view_as(own))
        return loss

    def scaled(self, name: str, value: Tensor) -> Tensor:
        """The standardised value: (value - mean) / deviation; 0 where it has been constant."""
        mean, deviation = self.moments[name]
        return torch.where(deviation > 0, (value - mean) / deviation, 0.0)

    def inputs(self, state_ND: Float[Tensor, "N D"], action_N: Num[Tensor, "N ..."]) -> Float[Tensor, "N I"]:
        if self.num_actions:
            action_NI = nn.functional.one_hot(action_N, self.num_actions).float()
        else:
            action_NI = action_N.float().tanh()  # as far as they are squashed
        return torch.cat([self.scaled("state", state_ND).clamp(-_CLIP, _CLIP), action_NI], -1)

    def outputs(self, x: Float[Tensor, "E N I"]) -> Float[Tensor, "E N O"]:
        for weight, bias in self._layers[:-1]:
            x = nn.functional.silu(torch.baddbmm(bias, x, weight))
        return torch.baddbmm(self._layers[-1][1], x, self._layers[-1][0])

    def predict(self, state_ND: Float[Tensor, "N D"], action_N: Num[Tensor, "N ..."], log_odds: float) -> Prediction:
        """What all members predict; by `log_odds` the log odds of ends are too large."""
        output = self.outputs(self.inputs(state_ND, action_N).expand(self.members, -1, -1))
        (change_mean, change_scale), (reward_mean, reward_scale) = self.moments["change"], self.moments["reward"]
        return Prediction(
            state_ND + change_mean + change_scale * output[..., : self.state_size],
            reward_mean + reward_scale * output[..., -2],
            (output[..., -1] - log_odds).sigmoid(),
        )

    def state_dict(self) -> dict[str, Any]:
        """Weights and moments."""
        return {
            "weights": [weight.detach().cpu().clone() for weight in self.weights],
            "moments": {name: [value.cpu() for value in pair] for name, pair in self.moments.items()},
        }

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        shapes = [tuple(weight.shape) for weight in self.weights]
        if (found := [tuple(weight.shape) for weight in state["weights"]]) != shapes:
            raise PgtsError(f"the weights have shapes {found}; they must have {shapes}")
        for weight, value in zip(self.weights, state["weights"], strict=True):
            weight.copy_(value)
        self.moments = {
            name: (mean.to(self._device), deviation.to(self._device))
            for name, (mean, deviation) in state["moments"].items()
        }
