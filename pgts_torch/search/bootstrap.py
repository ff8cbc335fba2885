"""How far sampled values can be trusted: all backups again, with resampled outcomes."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.search.empirical import Empirical
from pgts_torch.search.levels import back_up
from pgts_torch.seeding import mix, uniform

Step = tuple[Tensor, Outcomes]
"""The nodes of one level, shape [N], and their outcomes."""

_RESAMPLE = 0x626F6F74
"""Mixed into the keys of the bootstrap, so that they differ from those of the samples."""

CHUNK = 2**22
"""The most resampled outcomes of one level that are held at a time, or those of one replicate."""


def bootstrap(
    empirical: Empirical,
    plan: Sequence[int | None],
    steps: list[Step],
    v_N: Tensor,
    replicates: int,
    at_once: int,
) -> Float[Tensor, "R N A"]:
    """Values at the roots, backed up again with resampled outcomes.

    Args:
        at_once: about how many resampled outcomes may be held beyond those of one replicate.
    """
    key_N, reward_NAC = empirical.key_N, empirical.reward_NAC

    def resampled(replicate_R: Tensor) -> Iterator[Outcomes]:
        done: tuple[Outcomes, Outcomes] | None = None  # the levels of a closed set are one, resampled once
        for (node_N, outcomes), C in zip(reversed(steps), reversed(plan[: len(steps)]), strict=True):
            if done is None or done[0] is not outcomes:
                reward = reward_NAC[node_N, :, : C or 0]
                done = outcomes, _resampled(outcomes, C, mix(key_N[node_N], _RESAMPLE), reward, replicate_R)
            yield done[1]

    # As many replicates at once as fit, at least one; each of their levels has R * N rows.
    largest = max(outcomes.child_NAK.numel() for _, outcomes in steps)
    chunks = torch.arange(replicates, device=v_N.device).split(1 + min(at_once, CHUNK) // largest)
    A = empirical.num_actions
    return torch.cat([back_up(resampled(chunk), v_N.repeat(len(chunk))).view(len(chunk), -1, A) for chunk in chunks])


def _resampled(outcomes: Outcomes, C: int | None, key_N: Tensor, reward_NAC: Tensor, replicate_R: Tensor) -> Outcomes:
    """R replicates of the outcomes as one table of R * N rows: of the C outcomes of each (s, a) C - 1 with replacement;
    where C is None all are kept. The children of replicate r are the r-th block of R * num_children values."""
    R, N, A = len(replicate_R), outcomes.num_states, outcomes.num_actions
    if C is None:
        prob, discount, child = outcomes.prob_NAK, outcomes.discount_NAK, outcomes.child_NAK
        prob, discount, child = (x.expand(R, -1, -1, -1) for x in (prob, discount, child))
        reward = outcomes.reward_NA.expand(R, -1, -1)
    else:
        device = replicate_R.device
        # A random number for each (replicate, node, action, c), and the position of the sample that it picks.
        row_RNA = mix(key_N.view(-1, 1), replicate_R.view(-1, 1, 1), torch.arange(A, device=device))
        draw_RNAC = mix(row_RNA.unsqueeze(-1), torch.arange(C - 1, device=device))
        pick = (uniform(draw_RNAC) * C).long()

        def picked(x_NAC: Tensor) -> Tensor:
            return x_NAC.expand(R, -1, -1, -1).gather(-1, pick)

        # C - 1 resampled outcomes, equally likely, with the mean of their rewards.
        prob = torch.full((), 1 / (C - 1), dtype=outcomes.dtype, device=device).expand(pick.shape)
        discount, child = picked(outcomes.discount_NAK[..., :C]), picked(outcomes.child_NAK[..., :C])
        reward = (picked(reward_NAC) / (C - 1)).sum(-1)
    # Replicate r reads its own block of child values.
    child = child + outcomes.num_children * torch.arange(R, device=child.device).view(-1, 1, 1, 1)
    return Outcomes(
        reward.reshape(R * N, A),
        prob.reshape(R * N, A, -1),
        discount.reshape(R * N, A, -1),
        child.reshape(R * N, A, -1),
        R * outcomes.num_children,
    )


def spread(q_BA: Tensor, again_RBA: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviation of the replicates, and their mean minus q; both 0 where an action is not allowed."""
    off_RBA = torch.where(q_BA > -torch.inf, again_RBA - q_BA, 0.0)
    # Each row is summed in one order, however many there are; in units of the largest deviation no square overflows.
    off_BAR = off_RBA.movedim(0, -1).contiguous()
    unit_BA1 = off_BAR.abs().amax(-1, keepdim=True).clamp(min=torch.finfo(q_BA.dtype).tiny)
    off_BAR = off_BAR / unit_BA1
    return off_BAR.std(-1) * unit_BA1.squeeze(-1), off_BAR.mean(-1) * unit_BA1.squeeze(-1)
