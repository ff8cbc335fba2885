"""The logged metrics of an iteration. Nothing here draws a random number or feeds back into training."""

import math
import statistics

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.updates import SoftmaxUpdate
from pgts_torch.ranks import Ranks, Share
from pgts_torch.tabular import exact
from pgts_torch.tabular.ascent import softmax_direction


def metrics(algorithm: PGTS, iteration: Iteration) -> dict[str, float]:
    """The tags of one iteration, all about the policy pi_k that collected its episodes. All processes must call it."""
    ranks, depth = iteration.ranks, iteration.depth
    entropy_N = -torch.special.xlogy(iteration.pi_NA, iteration.pi_NA).sum(-1)
    entropy = ranks.share("rows", len(entropy_N)).mean("entropy", entropy_N)
    tags = {
        **_episodes(iteration.experience),
        "losses/entropy": float(entropy),
        **{_tag(name): value for name, value in iteration.losses.items()},
        "search/depth": float(depth),
        "search/model_calls": float(algorithm.num_model_calls),
    }
    if algorithm.model_check.is_active:
        tags["model/contradictions"] = float(algorithm.model_check.contradictions)
    if iteration.look is not None:
        tags |= {
            "search/nodes": ranks.totals("nodes", iteration.look.nodes)[0],
            "search/pruned": _largest(ranks, iteration.look.pruned_BA),
            "search/stationarity_gap": _largest(ranks, iteration.gap_N),
            "search/certificate": iteration.certificate,
            "search/proved": float(algorithm.certificates is not None and algorithm.certificates.trust == "proved"),
        }
        if iteration.posterior is not None:
            tags["search/certificate_posterior"] = iteration.posterior
        if iteration.look.doubt_BA is not None:
            tags["search/doubt"] = _largest(ranks, iteration.look.doubt_BA)
    return tags


def _tag(name: str) -> str:
    return f"model/{name.removeprefix('model_')}" if name.startswith("model_") else f"losses/{name}"


def _episodes(rollout: Rollout) -> dict[str, float]:
    """The tags of the episodes of all processes; of those that ended, where they go on from one iteration to the
    next."""
    if rollout.finished is None:
        share = Share(rollout.ranks, 0, rollout.whole.episodes)
        return {
            "charts/episodic_return": float(share.mean("returns", (rollout.reward_TB * rollout.alive_TB).sum(0))),
            "charts/discounted_return": float(share.mean("discounted returns", rollout.returns())),
            "charts/episodic_length": rollout.share.total / rollout.whole.episodes,
        }
    finished = torch.tensor(rollout.finished, dtype=torch.float64).view(-1, 2)
    return_E, length_E = rollout.ranks.rows("finished episodes", *finished.T)
    if not len(return_E):
        return {}
    means = (statistics.fmean(x_E.tolist()) for x_E in (return_E, length_E))
    return dict(zip(("charts/episodic_return", "charts/episodic_length"), means, strict=True))


def _largest(ranks: Ranks, x: Tensor) -> float:
    """The largest number of all processes, of which some may have none."""
    return float(ranks.each("the largest", x.max() if x.numel() else -math.inf).max())


class Truth:
    """Compares a policy and its lookahead estimates with the exact values of the MDP.

    Args:
        algorithm: whose `mdp` and `update` are used.
    """

    def __init__(self, algorithm: PGTS) -> None:
        self.mdp = algorithm.mdp
        self.update = algorithm.update
        self.optimum = exact.optimal(self.mdp)

    def metrics(self, pi_SA: Float[Tensor, "S A"], iteration: Iteration) -> dict[str, float]:
        """The `exact/*` tags of an iteration whose policy was pi_SA. All processes must call it.

        J and J* - J; with a lookahead also its largest error at the visited states, and the cosine between the
        estimated and the exact update direction, left out where one of the two is 0.
        """
        evaluation = exact.evaluate(self.mdp, pi_SA)
        tags = {"exact/J": evaluation.J, "exact/optimality_gap": max(self.optimum.J - evaluation.J, 0.0)}
        if iteration.look is None or iteration.state_N is None:
            return tags
        look_SA = exact.lookahead(self.mdp, evaluation.q_SA, iteration.depth)
        columns = iteration.state_N, iteration.look.q_BA, iteration.weight_N
        states, q_NA, weight_N = (column.cpu() for column in iteration.ranks.rows("rows of a table", *columns))
        error_NA = (q_NA - look_SA[states])[self.mdp.outcomes.legal_NA[states]]
        tags["exact/lookahead_error"] = float(error_NA.abs().max())
        weight_S = evaluation.d_S if self.update.state_weight != "uniform" else (evaluation.d_S > 0).double()
        true_SA = self._direction(pi_SA, look_SA, weight_S)
        estimated_SA = torch.zeros_like(true_SA)
        estimated_SA[states] = self._direction(pi_SA[states], q_NA, weight_N)
        norms = float(true_SA.norm() * estimated_SA.norm())
        if norms > 0:
            tags["exact/gradient_cosine"] = float((true_SA * estimated_SA).sum()) / norms
        return tags

    def _direction(self, pi_NA: Tensor, q_NA: Tensor, weight_N: Tensor) -> Tensor:
        """The update direction over the actions that are allowed, projected on the tangent space of the simplex (its
        entries sum to 0)."""
        if isinstance(self.update, SoftmaxUpdate):
            return softmax_direction(pi_NA, q_NA, weight_N)
        legal_NA = q_NA > -math.inf
        if legal_NA.all():
            return weight_N[:, None] * (q_NA - q_NA.mean(-1, keepdim=True))
        mean_N1 = torch.where(legal_NA, q_NA, 0.0).sum(-1, keepdim=True) / legal_NA.sum(-1, keepdim=True)
        return weight_N[:, None] * torch.where(legal_NA, q_NA - mean_N1, 0.0)
