"""What the members of an ensemble predict, and by how much they differ."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class Prediction(NamedTuple):
    """The predictions of E members for N pairs (state, action); `end_EN` is the probability that the episode ends."""

    next_END: Float[Tensor, "E N D"]
    reward_EN: Float[Tensor, "E N"]
    end_EN: Float[Tensor, "E N"]

    def spread(self, deviation_D: Float[Tensor, "D"], width: float) -> Float[Tensor, "N"]:
        """An estimate of the error of r + gamma (1 - p) v(s'), with |x| the largest x of a member less the smallest:

            |r| + width * disagreement

        for values v whose range times gamma has this width, and which change by no more over one deviation of states.
        """
        return _range(self.reward_EN) + width * self.disagreement(deviation_D)

    def disagreement(self, deviation_D: Float[Tensor, "D"]) -> Float[Tensor, "N"]:
        """How much members differ on what follows, as a share of the value span:

            min(1, |p| + root mean square of |s'| / deviation)

        A number of the state that has never changed, of deviation 0, does not count.
        """
        moved_ND = torch.where(deviation_D > 0, _range(self.next_END) / deviation_D, 0.0)
        return (_range(self.end_EN) + moved_ND.square().mean(-1).sqrt()).clamp(max=1)


def _range(value_EN: Tensor) -> Tensor:
    """The largest value of a member less the smallest."""
    return value_EN.amax(0) - value_EN.amin(0)
