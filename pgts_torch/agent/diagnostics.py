"""What is logged of a training. Nothing here draws a random number or feeds back into it."""

import math
import statistics
from typing import NamedTuple, final

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.parts import Parts
from pgts_torch.agent.policies import exact_probs
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.updates import SoftmaxUpdate, Update
from pgts_torch.ranks import Ranks, Share
from pgts_torch.tabular import exact
from pgts_torch.tabular.ascent import softmax_direction
from pgts_torch.tabular.mdp import TabularMDP


class Counters(NamedTuple):
    """What a training has done so far: iterations, environment steps of all processes, model calls."""

    iterations: int
    env_steps: int
    model_calls: int


class Spread(NamedTuple):
    """What is shown as histograms of an iteration.

    gap_N: the stationarity gap in each visited state.
    nodes_L: how many nodes of the lookahead lie on each level, from the visited states on.
    """

    gap_N: Float[Tensor, "N"]
    nodes_L: tuple[int, ...]


@final
class Diagnostics:
    """The numbers that are logged of a training, all about the policy pi_k that collected the episodes.

    truth: what a policy is compared with; None: the exact MDP is not known.

    Args:
        total_steps: environment steps of the whole training.
        every: iterations from one line of metrics to the next.
        points: in how many lines, evenly over total_steps and in the first and the last, policies are compared with the
            truth and histograms are made, which costs more than all others.
    """

    def __init__(self, parts: Parts, *, total_steps: int, every: int = 1, points: int = 20) -> None:
        self._parts, self._total, self._every, self._points = parts, total_steps, every, points
        self.truth = None if parts.world.mdp is None else Truth(parts.world.mdp, parts.update)
        self._pi_SA = self.policy_table()

    def policy_table(self) -> Float[Tensor, "S A"] | None:
        """The policy in all states, where there is an exact MDP."""
        if self.truth is None:
            return None
        return exact_probs(self._parts.policy, torch.arange(self.truth.mdp.num_states, device=self._parts.world.device))

    def __call__(
        self, iteration: Iteration, counters: Counters, seconds: float
    ) -> tuple[dict[str, float], Spread | None]:
        """The tags of an iteration that took so many seconds, none where no line is due, and what its histograms show,
        where they are due. All processes must call it, once after each iteration."""
        tags: dict[str, float] = {}
        found = None
        if counters.iterations % self._every == 0:
            tags = metrics(self._parts, iteration, counters)
            if self._is_point(counters.env_steps, iteration):
                found = spread(iteration)
                if self.truth is not None and self._pi_SA is not None:
                    tags |= self.truth.metrics(self._pi_SA, iteration)
            tags["charts/SPS"] = iteration.num_steps / seconds
        self._pi_SA = self.policy_table()
        return tags, found

    def _is_point(self, step: int, iteration: Iteration) -> bool:
        """Whether this line is the first one, the last one or the first after one of the points."""
        total, steps = self._total, iteration.num_steps
        every, before = max(1, total // self._points), step - self._every * steps
        # No other line follows if the training ends before as many iterations are made again.
        is_last = step + (self._every - 1) * steps >= total
        return before <= 0 or is_last or step // every > before // every


def metrics(parts: Parts, iteration: Iteration, counters: Counters) -> dict[str, float]:
    """The tags of one iteration. All processes must call it."""
    ranks, depth = iteration.ranks, iteration.depth
    entropy_N = -torch.special.xlogy(iteration.pi_NA, iteration.pi_NA).sum(-1)
    entropy = ranks.share("rows", len(entropy_N)).mean("entropy", entropy_N)
    tags = {
        **_episodes(iteration.experience),
        "losses/entropy": float(entropy),
        **{_tag(name): value for name, value in iteration.losses.items()},
        "search/depth": float(depth),
        "search/model_calls": float(counters.model_calls),
    }
    if parts.model_check.is_active:
        tags["model/contradictions"] = float(parts.model_check.contradictions)
    if iteration.look is not None:
        tags |= {
            "search/nodes": ranks.totals("nodes", iteration.look.nodes)[0],
            "search/pruned": _largest(ranks, iteration.look.pruned_BA),
            "search/stationarity_gap": _largest(ranks, iteration.gap_N),
            "search/certificate": iteration.certificate,
            "search/proved": float(parts.certificates is not None and parts.certificates.trust == "proved"),
        }
        if iteration.gap_bound < math.inf:
            tags["search/gap_bound"] = iteration.gap_bound
        if iteration.posterior is not None:
            tags["search/certificate_posterior"] = iteration.posterior
        if iteration.look.doubt_BA is not None:
            tags["search/doubt"] = _largest(ranks, iteration.look.doubt_BA)
    return tags


def spread(iteration: Iteration) -> Spread | None:
    """What the histograms of an iteration show; None without a lookahead. All processes must call it."""
    if iteration.look is None:
        return None
    [gap_N] = iteration.ranks.rows("gaps", iteration.gap_N)
    nodes_L = iteration.look.nodes_per_level
    most = iteration.ranks.each("levels", len(nodes_L)).max()  # a process without states has none
    filled = (*nodes_L, *[0] * (int(most) - len(nodes_L)))
    return Spread(gap_N.cpu(), tuple(map(int, iteration.ranks.totals("nodes per level", *filled))))


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
        update: whose direction is compared.
    """

    def __init__(self, mdp: TabularMDP, update: Update) -> None:
        self.mdp, self.update = mdp, update
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
