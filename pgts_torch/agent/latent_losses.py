"""What the networks of a latent model are fitted to: rewards and ends, the images seen, values and policy."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from pgts_torch.agent.networks import Network
from pgts_torch.ranks import Ranks

TEMPERATURE = 0.1
"""Of the contrastive loss, in mean squared differences of two vectors; those of two independent ones are 2."""


class Unrolled(NamedTuple):
    """K steps from each of N images.

    predicted_KND: the vectors after each step, from the first image and the actions alone.
    seen_KND: those that represent the images after each step.
    image_KN: a hash of each of these images.
    goes_on_KN: whether the step counts, and the episode goes on after it; in host memory.
    """

    predicted_KND: Float[Tensor, "K N D"]
    seen_KND: Float[Tensor, "K N D"]
    image_KN: Int[Tensor, "K N"]
    goes_on_KN: Bool[Tensor, "K N"]

    def of_all(self, ranks: Ranks) -> "Unrolled":
        """The steps of all processes, of which those of this one keep their gradient."""
        columns = (column.transpose(0, 1) for column in self)
        return Unrolled(*(column.transpose(0, 1) for column in ranks.rows("vectors", *columns)))


def outcome_losses(
    output_C3: Float[Tensor, "C 3"], reward_C: Float[Tensor, "C"], end_C: Float[Tensor, "C"]
) -> dict[str, Tensor]:
    """The losses of the reward, r_1 where the episode ended and else r_0, and of the end.

    Args:
        output_C3: r_0, r_1 and the log odds of an end.
        reward_C: in the unit of r_0 and r_1.
        end_C: 1 where the episode ended, else 0.
    """
    said_C = torch.where(end_C > 0, output_C3[:, 1], output_C3[:, 0])
    end = nn.functional.binary_cross_entropy_with_logits(output_C3[:, 2], end_C)
    return {"reward": (said_C - reward_C).square().mean(), "end": end}


def consistency_loss(steps: Unrolled) -> Tensor:
    """The mean over K of the squared difference of predicted vector x_n and seen vector y_n, plus, with all seen after
    as many steps,

        - log  exp(-|x_n - y_n|^2 / T) / sum_j exp(-|x_n - y_j|^2 / T)        (van den Oord et al. 2018)

    where j = n, and all j whose images differ from that of n; |.|^2 is a mean over D. Gradients of the difference do
    not move y.
    """
    loss = steps.predicted_KND.new_zeros(())
    for predicted_ND, seen_ND, image_N, goes_on_N in zip(*steps, strict=True):
        x_MD, y_MD, image_M = predicted_ND[goes_on_N], seen_ND[goes_on_N], image_N[goes_on_N]
        if len(image_M) == 0:
            continue
        own_M = torch.arange(len(image_M), device=image_M.device)
        log_MM = (x_MD[:, None] - y_MD).square().mean(-1) / -TEMPERATURE
        equal_MM = (image_M[:, None] == image_M) & (own_M[:, None] != own_M)
        contrast = nn.functional.cross_entropy(log_MM.masked_fill(equal_MM, -torch.inf), own_M)
        loss = loss + contrast + (x_MD - y_MD.detach()).square().mean()
    return loss / len(steps.goes_on_KN)


def equivalence_losses(steps: Unrolled, values: Network, logits: Network) -> dict[str, Tensor]:
    """The mean squared difference of values, and the mean KL divergence of policies, between the predicted and the seen
    vectors (value equivalence, Grimm et al. 2020). Gradients move neither networks nor seen vectors."""
    predicted_MD = steps.predicted_KND[steps.goes_on_KN]
    with torch.no_grad():
        seen_MD = steps.seen_KND[steps.goes_on_KN]
        value_MO, log_MA = values(seen_MD), logits(seen_MD).log_softmax(-1)
    said_MA = logits(predicted_MD).log_softmax(-1)
    return {
        "value": (values(predicted_MD) - value_MO).square().sum() / max(1, value_MO.numel()),
        "policy": (log_MA.exp() * (log_MA - said_MA)).sum() / max(1, len(log_MA)),
    }
