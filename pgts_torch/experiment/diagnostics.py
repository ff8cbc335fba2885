"""The logged metrics of an iteration. Nothing here draws a random number or feeds back into training."""

import statistics

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.updates import SoftmaxUpdate
from pgts_torch.tabular import exact
from pgts_torch.tabular.ascent import softmax_direction


def metrics(algorithm: PGTS, iteration: Iteration) -> dict[str, float]:
    """The tags of one iteration, all about the policy pi_k that collected its episodes."""
    episodes = iteration.experience
    entropy_N = -torch.special.xlogy(iteration.pi_NA, iteration.pi_NA).sum(-1)
    tags = {
        **_episodes(episodes),
        "losses/entropy": float(entropy_N.mean()),
        **{_tag(name): value for name, value in iteration.losses.items()},
        "search/depth": float(iteration.depth),
        "search/model_calls": float(algorithm.num_model_calls),
    }
    if algorithm.model_check.is_active:
        tags["model/contradictions"] = float(algorithm.model_check.contradictions)
    if iteration.look is not None:
        tags |= {
            "search/nodes": float(iteration.look.nodes),
            "search/pruned": float(iteration.look.pruned_BA.max()),
            "search/stationarity_gap": float(iteration.gap_N.max()),
            "search/certificate": iteration.certificate,
            "search/proved": float(algorithm.certificates is not None and algorithm.certificates.trust == "proved"),
        }
        if iteration.posterior is not None:
            tags["search/certificate_posterior"] = iteration.posterior
        if iteration.look.doubt_BA is not None:
            tags["search/doubt"] = float(iteration.look.doubt_BA.max())
    return tags


def _tag(name: str) -> str:
    return f"model/{name.removeprefix('model_')}" if name.startswith("model_") else f"losses/{name}"


def _episodes(rollout: Rollout) -> dict[str, float]:
    """The tags of episodes; of those that ended, where they go on from one iteration to the next."""
    if rollout.finished is None:
        return {
            "charts/episodic_return": float((rollout.reward_TB * rollout.alive_TB).sum(0).mean()),
            "charts/discounted_return": float(rollout.returns().mean()),
            "charts/episodic_length": rollout.num_steps / rollout.num_episodes,
        }
    if not rollout.finished:
        return {}
    returns, lengths = zip(*rollout.finished, strict=True)
    return {"charts/episodic_return": statistics.fmean(returns), "charts/episodic_length": statistics.fmean(lengths)}


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
        """The `exact/*` tags of an iteration whose policy was pi_SA.

        J and J* - J; with a lookahead also its largest error at the visited states, and the cosine between the
        estimated and the exact update direction, left out where one of the two is 0.
        """
        evaluation = exact.evaluate(self.mdp, pi_SA)
        tags = {"exact/J": evaluation.J, "exact/optimality_gap": max(self.optimum.J - evaluation.J, 0.0)}
        if iteration.look is None or iteration.state_N is None:
            return tags
        look_SA = exact.lookahead(self.mdp, evaluation.q_SA, iteration.depth)
        states = iteration.state_N.cpu()
        error_NA = iteration.look.q_BA.cpu() - look_SA[states]
        tags["exact/lookahead_error"] = float(error_NA.abs().max())
        weight_S = evaluation.d_S if self.update.state_weight != "uniform" else (evaluation.d_S > 0).double()
        true_SA = self._direction(pi_SA, look_SA, weight_S)
        estimated_SA = torch.zeros_like(true_SA)
        estimated_SA[states] = self._direction(pi_SA[states], iteration.look.q_BA.cpu(), iteration.weight_N.cpu())
        norms = float(true_SA.norm() * estimated_SA.norm())
        if norms > 0:
            tags["exact/gradient_cosine"] = float((true_SA * estimated_SA).sum()) / norms
        return tags

    def _direction(self, pi_NA: Tensor, q_NA: Tensor, weight_N: Tensor) -> Tensor:
        """The update direction, projected on the tangent space of the simplex (its entries sum to 0)."""
        if isinstance(self.update, SoftmaxUpdate):
            return softmax_direction(pi_NA, q_NA, weight_N)
        return weight_N[:, None] * (q_NA - q_NA.mean(-1, keepdim=True))
