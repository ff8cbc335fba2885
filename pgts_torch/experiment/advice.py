"""Advice at the end of a run: the policy hardly moved, has not converged, or is worse when it acts greedily."""

import copy
import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.agent.evaluate import Evaluation
from pgts_torch.agent.gaussian import GaussianPolicy
from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.policies import Policy, TabularPolicy
from pgts_torch.agent.states import check_keys
from pgts_torch.agent.target_updates import TargetUpdate
from pgts_torch.agent.updates import TabularUpdate, Update
from pgts_torch.errors import PgtsError
from pgts_torch.options.schedules import value_at

HARDLY = 0.05
"""A policy whose total variation distance from the initial one is smaller has hardly moved."""

UNSTEADY = 0.05
"""A policy that still moves by a larger total variation distance per iteration at the end has not converged."""

LARGE = 0.1
"""An optimality gap is large if it is more than this share of max_a q - min_a q."""

_DECAY = 0.9
"""Decay of the running mean over iterations: about the last ten count."""


class Movement:
    """How far a policy has moved since the first iteration, and how much better a lookahead still finds its actions.

    before: the policy before the next iteration; set it before the first one of this process.
    """

    def __init__(self, first: Policy) -> None:
        self.first = self.before = first
        self.moved: float | None = None
        self.gap_share: float | None = None
        self.pace: float | None = None

    def follow(self, algorithm: PGTS, iteration: Iteration) -> None:
        """Update `pace` with the latest iteration: a running mean of

            sum_s w(s) 1/2 sum_a |pi_{k+1}(a|s) - pi_k(a|s)|,        in [0, 1], w the weights of the update, of sum 1

        Of tabular policies only, where it costs next to nothing. An iteration with replay has many updates; the states
        and weights are those of the last one.
        """
        if isinstance(algorithm.policy, TabularPolicy):
            moved = _distance(algorithm, iteration, self.before.probs(iteration.observation_N))
            self.before = copy.deepcopy(algorithm.policy)
            self.pace = moved if self.pace is None else _DECAY * self.pace + (1 - _DECAY) * moved

    def measure(self, algorithm: PGTS, iteration: Iteration) -> None:
        """Update, at the states of the latest iteration and with their weights in the update:

        moved = mean of 1/2 sum_a |pi - pi_first|, in [0, 1]; None where pi is a density.
        gap_share = mean g_m / mean (max_a q - min_a q)
        """
        if not isinstance(algorithm.policy, GaussianPolicy):
            self.moved = _distance(algorithm, iteration, self.first.probs(iteration.observation_N))
        self.gap_share = None
        if iteration.look is not None:
            span, gap = _mean(iteration, span_of(iteration.look.q_BA)), _mean(iteration, iteration.gap_N)
            self.gap_share = gap / span if 0 < span < math.inf else None

    def state_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {"moved": self.moved, "gap_share": self.gap_share, "pace": self.pace}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned; PgtsError if it is something else."""
        check_keys("movement", state, {"moved", "gap_share", "pace"})
        if not all(isinstance(value, float | None) for value in state.values()):
            raise PgtsError(f"movement is {state}; it must be numbers")
        self.moved, self.gap_share, self.pace = state["moved"], state["gap_share"], state["pace"]


def _distance(algorithm: PGTS, iteration: Iteration, other_NA: Tensor) -> float:
    """Return the mean total variation distance between the policy and another one."""
    probs_NA = algorithm.policy.probs(iteration.observation_N)
    return _mean(iteration, (probs_NA - other_NA).abs().sum(-1)) / 2


def _mean(iteration: Iteration, value_N: Tensor) -> float:
    """Return the mean over the states of an iteration, in all processes, by their weights in the update."""
    share_N = iteration.weight_N / iteration.ranks.sum("weights", iteration.weight_N.sum())
    return iteration.ranks.totals("the mean of states", value_N.to(share_N.dtype) @ share_N)[0]


def span_of(q_NA: Float[Tensor, "N A"]) -> Float[Tensor, "N"]:
    """max_a q - min_a q, over the legal actions (q > -inf)."""
    least_NA = torch.where(q_NA.isfinite(), q_NA, math.inf)
    return q_NA.amax(-1) - least_NA.amin(-1)


def learned_little(
    movement: Movement,
    update: Update,
    *,
    depth: int,
    missing_share: float | None,
    stationary_share: float | None,
) -> str | None:
    """Advice where the optimality gap is large though the policy hardly moved, or still moves at the end; else None.

    Args:
        depth: m, the largest of the run.
        missing_share: (J* - J) / (max q* - min q*), where the truth is known; None: the gap of the last lookahead is
            used instead.
        stationary_share: the largest exact g_m in the same unit, where the truth is known.
    """
    share = movement.gap_share if missing_share is None else missing_share
    if share is None or share <= LARGE:
        return None
    if movement.moved is not None and movement.moved < HARDLY:
        moved = f"the policy hardly moved: {movement.moved:.1%} of its probability is elsewhere than at the start, and"
        if stationary_share is not None and stationary_share <= LARGE * share:
            return (
                f"{moved} J is far from J*. A lookahead of depth {depth} finds no better actions: set a deeper one, "
                f"search.depth above {depth}"
            )
        seen = (
            f"a lookahead of depth {depth} still finds better actions" if missing_share is None else "J is far from J*"
        )
        return (
            f"{moved} {seen}. Set {_longer_steps(update)}, more total_steps, or a deeper lookahead, search.depth above "
            f"{depth}"
        )
    if movement.pace is not None and movement.pace >= UNSTEADY:
        step_size = update.step_size if isinstance(update, TabularUpdate) else None
        smaller = "" if step_size is None else f", or with a smaller update.step_size than {step_size:g}"
        return (
            f"the policy has not converged: the last iterations moved {movement.pace:.0%} of its probability each, and "
            "the optimality gap is large. Train for more total_steps; if J goes up and down, with more "
            f"rollout.num_envs{smaller}"
        )
    return None


def _longer_steps(update: Update) -> str:
    if isinstance(update, TabularUpdate):
        return f"a larger update.step_size than {update.step_size:g}"
    now = value_at(getattr(update.options, "learning_rate", 0), update.num_env_steps)
    rate = f"a larger update.learning_rate than {now:g}"
    return f"{rate}, a smaller update.temperature" if isinstance(update, TargetUpdate) else rate


def greedy_is_worse(greedy: Evaluation, sampled: Evaluation) -> str | None:
    """Advice where greedy episodes return less than sampled ones, beyond both confidence intervals; else None."""
    one, other = greedy.episodic_return, sampled.episodic_return
    if one.half_width is None or other.half_width is None or one.mean + one.half_width >= other.mean - other.half_width:
        return None
    return (
        "the most probable actions are worse than sampled ones, beyond the confidence intervals: act by sampled "
        "actions, predict(..., deterministic=False), or train on until they agree"
    )
