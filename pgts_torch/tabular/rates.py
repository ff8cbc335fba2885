"""How many iterations, and how many samples: bounds in closed form or from the tables of an MDP.

The proofs are in docs/rates.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pgts_torch.bellman import backup, policy_mean, sweep
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP
from pgts_torch.tabular.stationary import TOLERANCE, largest_discount, worst_policy

MAX_DEPTH = 10_000
"""Deeper than this, margins are not looked for."""


def greedy_bound(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int, iterations: int) -> Float[Tensor, "K"]:
    """What pi_0 .. pi_K lack at most, with steps so large that all states become greedy (docs/rates.md, Prop. 1).

        J* - J^{pi_k} <= mu^T (gamma P^{pi*})^{(m+1) k} (v* - v^{pi_0}) <= gamma^{(m+1) k} ||v* - v^{pi_0}||

    [Efroni et al. 2018 for the second]. Steps are as large as that at all states where a projected step has
    eta w(s) (q(s, a) - q(s, b)) >= 2 for the best a and every b that is not as good.
    """
    check_count("depth", depth, least=0)
    optimum = exact.optimal(mdp)
    lack_S = (optimum.v_S - exact.policy_values(mdp, pi_SA)).clamp(min=0)
    free = mdp.outcomes.paying(torch.zeros_like(mdp.outcomes.reward_NA))
    bounds = [float(mdp.start_S @ lack_S)]
    for _ in range(check_count("iterations", iterations, least=0)):
        lack_S = sweep(free, lack_S, depth + 1, optimum.pi_SA.argmax(-1))
        bounds.append(float(mdp.start_S @ lack_S))
    return torch.tensor(bounds, dtype=torch.float64)


def finite_step_bound(
    mdp: TabularMDP,
    pi_SA: Float[Tensor, "S A"],
    next_SA: Float[Tensor, "S A"],
    depth: int,
    step_S: Float[Tensor, "S"],
    update: Literal["projected", "mirror"],
) -> Float[Tensor, "S"]:
    """What the next policy lacks at most in each state, after a finite step in all of them (docs/rates.md, Prop. 2).

        v* - v' <= (gamma P^{pi*})^{m+1} (v* - v^pi) + (I - gamma P')^{-1} D / step
        D(s) = min over p that take best actions only of |p - pi(s)|^2 / 2 (projected), of KL(p, pi(s)) (mirror)

    Args:
        next_SA: the policy after the step, pi'.
        step_S: eta w(s), positive everywhere.
    """
    optimum, evaluation = exact.optimal(mdp), exact.evaluate(mdp, pi_SA)
    free = mdp.outcomes.paying(torch.zeros_like(mdp.outcomes.reward_NA))
    lack_S = sweep(free, (optimum.v_S - evaluation.v_S).clamp(min=0), depth + 1, optimum.pi_SA.argmax(-1))
    look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
    best_SA = look_SA >= look_SA.amax(-1, keepdim=True)
    if update == "mirror":
        distance_S = -torch.where(best_SA, pi_SA, 0.0).sum(-1).log()
    else:
        # The nearest p adds the same to each best action.
        off_S = torch.where(best_SA, 0.0, pi_SA).sum(-1)
        distance_S = (off_S.square() / best_SA.sum(-1) + torch.where(best_SA, 0.0, pi_SA).square().sum(-1)) / 2
    paid = mdp.outcomes.paying((distance_S / step_S)[:, None].expand_as(pi_SA))
    return lack_S + exact.policy_values(TabularMDP(paid, mdp.start_S), next_SA)


# Depths at which every policy is moved toward optimal actions


def margin(mdp: TabularMDP, depth: int) -> Float[Tensor, "S"]:
    """By how much a lookahead of m = depth prefers optimal actions in each state, whatever the policy is.

        delta_m(s) = min over optimal a of (T^m Q_min)(s, a)  -  max over all other b of Q*(s, b)

    Q_min are the least action values of any policy. T^m Q^pi lies between T^m Q_min and Q*, so where delta_m(s) > 0 its
    best actions are optimal for every pi, by delta_m(s) (docs/rates.md, Prop. 3). It grows with m to the action gap of
    s; infinite where all actions are optimal.
    """
    check_count("depth", depth, least=0)
    look_SA = exact.lookahead(mdp, backup(mdp.outcomes, exact.policy_values(mdp, worst_policy(mdp))), depth)
    return _margin(look_SA, *_optimal_actions(mdp))


def certain_depth(mdp: TabularMDP) -> int:
    """The smallest m at which `margin` is positive wherever optimal policies go from the start.

    From it on, finite steps of the projected and the mirror update cannot go the wrong way there, and `iteration_bound`
    is finite. The sufficient depth of `stationary_sets` is at most this one, and often much smaller.

    Raises:
        PgtsError: there is none within MAX_DEPTH, which needs a discount very near 1.
    """
    best_SA, q_SA = _optimal_actions(mdp)
    seen_S = torch.cat(_layers(mdp, best_SA)).unique()
    look_SA = backup(mdp.outcomes, exact.policy_values(mdp, worst_policy(mdp)))
    for depth in range(MAX_DEPTH + 1):
        if (_margin(look_SA, best_SA, q_SA)[seen_S] > 0).all():
            return depth
        look_SA = exact.bellman(mdp, look_SA)
    raise PgtsError(f"no depth up to {MAX_DEPTH} tells optimal actions from others whatever the policy is")


def iteration_bound(
    mdp: TabularMDP,
    pi_SA: Float[Tensor, "S A"],
    *,
    depth: int,
    step_size: float,
    state_weight: Literal["occupancy", "uniform"] = "occupancy",
) -> float:
    """After how many exact projected steps, at visited states only, J is J* for certain (docs/rates.md, Prop. 4).

        K = sum_n max { ceil( 2 x(s) / (eta w(s) delta_m(s)) ) : pi* reaches s in n steps and no fewer }

    x(s) is the probability of other than optimal actions in pi_0; w(s) = gamma_{1..n} P(pi* is in s after n steps) with
    the occupancy as weight, 1 with uniform weights. Infinite where a margin is not positive, and where a state that
    pi* visits has several optimal actions that lead to different states.
    """
    if not 0 < step_size < math.inf:
        raise PgtsError(f"step_size is {step_size}; it must be positive and finite")
    best_SA, _ = _optimal_actions(mdp)
    delta_S, off_S = margin(mdp, depth), torch.where(best_SA, 0.0, exact.check_policy(mdp, pi_SA)).sum(-1)
    total, here_S = 0.0, mdp.start_S
    for layer_L in _layers(mdp, best_SA):
        if not (delta_S[layer_L] > 0).all() or _has_choice(mdp, best_SA, layer_L):
            return math.inf
        weight_L = here_S[layer_L] if state_weight == "occupancy" else torch.ones(len(layer_L), dtype=torch.float64)
        total += float((2 * off_S[layer_L] / (step_size * weight_L * delta_S[layer_L])).ceil().max())
        here_S = _moved(mdp, best_SA, here_S)
    return total


def _optimal_actions(mdp: TabularMDP) -> tuple[Bool[Tensor, "S A"], Float[Tensor, "S A"]]:
    """Which actions are optimal, ties included, and Q*."""
    q_SA = exact.optimal(mdp).q_SA
    slack = TOLERANCE * float(q_SA[mdp.outcomes.legal_NA].abs().max())
    return q_SA >= q_SA.amax(-1, keepdim=True) - slack, q_SA


def _margin(look_SA: Tensor, best_SA: Tensor, q_SA: Tensor) -> Float[Tensor, "S"]:
    others_S = torch.where(best_SA, -math.inf, q_SA).amax(-1)
    return torch.where(best_SA, look_SA, math.inf).amin(-1) - others_S


def _layers(mdp: TabularMDP, best_SA: Tensor) -> list[Int[Tensor, "L"]]:
    """The states that optimal actions reach in 0, 1, 2, ... steps and no fewer."""
    found_S, here_S, layers = torch.zeros(mdp.num_states, dtype=torch.bool), mdp.start_S > 0, []
    while (new_S := here_S & ~found_S).any():
        layers.append(new_S.nonzero().flatten())
        found_S = found_S | new_S
        here_S = _moved(mdp, best_SA, new_S.double()) > 0
    return layers


def _has_choice(mdp: TabularMDP, best_SA: Tensor, state_L: Int[Tensor, "L"]) -> bool:
    """Whether optimal actions of one of these states lead to different states."""
    for s in state_L[best_SA[state_L].sum(-1) > 1].tolist():
        rows = mdp.outcomes.rows(torch.tensor([s])).weight.to_dense()[best_SA[s]]
        if (rows - rows[0]).abs().max() > TOLERANCE:
            return True
    return False


def _moved(mdp: TabularMDP, best_SA: Tensor, here_S: Tensor) -> Float[Tensor, "S"]:
    """Discounted probabilities one step later, where each optimal action is as likely as the others."""
    outcomes = mdp.outcomes
    share_SA = here_S[:, None] * best_SA / best_SA.sum(-1, keepdim=True)
    flow_SAK = share_SA[:, :, None] * outcomes.prob_NAK * outcomes.discount_NAK
    return torch.zeros_like(here_S).index_add(0, outcomes.child_NAK.flatten(), flow_SAK.flatten())


# Samples


@dataclass(frozen=True)
class SampleBound:
    """What a sampled lookahead is off by at most, with the probability asked for.

    error: the largest |q - T^m Q^pi| over roots and actions, from sampling and from the critic.
    model_calls: how many samples that takes at most.
    """

    error: float
    model_calls: float


def sample_bound(
    mdp: TabularMDP,
    v_S: Float[Tensor, "S"],
    root_N: Sequence[int],
    *,
    depth: int,
    samples: int,
    failure: float = 0.05,
    share: Literal["none", "level", "search"] = "level",
    critic_error: float = 0.0,
) -> SampleBound:
    """The error of `search.sampled`, with probability 1 - failure or more (docs/rates.md, Prop. 7).

        |q - T^m Q| <= sum_{i=0..m} beta_i gamma^i + gamma^{m+1} critic_error
        beta_i = W_i sqrt( ln(2 n / failure) / 2 C )

    W_i is the largest difference between two outcomes r_k + gamma_k V(s'_k) of one state and action that level i may
    hold, V = T^{m-i} v; n counts what is averaged: the (state, action) of all levels, or, without sharing, the nodes
    of the tree. gamma is the largest discount, and levels where W is 0 cost nothing.

    Args:
        v_S: the true values of the policy.
        root_N: the states looked ahead from.
        samples: C, outcomes sampled of each (state, action).
        share: as the option of the search: samples of each node, of each (state, action) at one level, or in all.
        critic_error: the largest error of the critic at the leaves.
    """
    check_count("samples", samples)
    check_count("depth", depth, least=0)
    if not 0 < failure < 1:
        raise PgtsError(f"failure is {failure}; it must be between 0 and 1")
    outcomes, A = mdp.outcomes, mdp.num_actions
    values = [v_S]
    for _ in range(depth):
        values.append(backup(outcomes, values[-1]).amax(-1))
    alive_NAK = (outcomes.prob_NAK > 0) & (outcomes.discount_NAK > 0)
    here_S = torch.zeros(mdp.num_states, dtype=torch.bool)
    here_S[torch.as_tensor(root_N)] = True
    met_S, widths, pairs, nodes, paths = here_S, list[float](), 0, 0.0, float(here_S.sum())
    for value_S in reversed(values):  # from the roots down
        met_S = met_S | here_S
        widths.append(_width(mdp, value_S, here_S))
        pairs += A * int(here_S.sum())
        nodes += A * paths
        paths *= A * samples
        next_S = torch.zeros_like(here_S)
        next_S[outcomes.child_NAK[alive_NAK & here_S[:, None, None]]] = True
        here_S = next_S
    count = {"none": nodes, "level": pairs, "search": pairs}[share]
    rate = math.sqrt(math.log(2 * count / failure) / (2 * samples))
    gamma = largest_discount(outcomes)
    error = sum(width * gamma**i for i, width in enumerate(widths)) * rate + gamma ** (depth + 1) * critic_error
    return SampleBound(error, samples * {"none": nodes, "level": pairs, "search": A * int(met_S.sum())}[share])


def _width(mdp: TabularMDP, v_S: Tensor, here_S: Tensor) -> float:
    """The largest difference between two outcomes r_k + gamma_k v(s'_k) of one state and action."""
    if not here_S.any():
        return 0.0
    outcomes = mdp.outcomes
    possible_NAK = outcomes.prob_NAK[here_S] > 0
    worth_NAK = mdp.outcome_reward_SAK[here_S] + outcomes.discount_NAK[here_S] * v_S[outcomes.child_NAK[here_S]]
    high_NA = torch.where(possible_NAK, worth_NAK, -math.inf).amax(-1)
    return float((high_NA - torch.where(possible_NAK, worth_NAK, math.inf).amin(-1)).max())


def gradient_bound(
    mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], *, depth: int, episodes: int, lookahead_error: float = 0.0
) -> float:
    """What the direction of an iteration is off by in the mean, at most (docs/rates.md, Prop. 8).

        E sum_s max_a |w(s) A(s, a) - d(s) A_m(s, a)| <= sum_s max_a |A_m(s, a)| sd(s) / sqrt(n) + 2 e sum_s d(s)
        sd(s)^2 = d(s) (2 G(s, s) - 1) - d(s)^2,        G = (I - gamma P^pi)^-1

    A_m = T^m Q^pi - <pi, T^m Q^pi>; w are the mean visits of n episodes, of a geometric horizon or with discounts and
    no end but the environment's; A are the advantages of a lookahead that is off by e at most. Error and spread of the
    values come in, their level does not.
    """
    check_count("episodes", episodes)
    if not lookahead_error >= 0:
        raise PgtsError(f"lookahead_error is {lookahead_error}; it must be at least 0")
    evaluation = exact.evaluate(mdp, pi_SA)
    look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
    above_SA = torch.where(mdp.outcomes.legal_NA, look_SA - policy_mean(pi_SA, look_SA)[:, None], 0.0)
    d_S = evaluation.d_S
    visited_N = d_S.nonzero().flatten()
    # G(s, s): the occupancy of s by an episode that starts there
    own_N = [
        exact.occupancy(replace(mdp, start_S=torch.nn.functional.one_hot(s, mdp.num_states).double()), pi_SA)[s]
        for s in visited_N
    ]
    d_N = d_S[visited_N]
    spread_N = (d_N * (2 * torch.stack(own_N) - 1) - d_N.square()).clamp(min=0).sqrt()
    chance = float((above_SA[visited_N].abs().amax(-1) * spread_N).sum()) / math.sqrt(episodes)
    return chance + 2 * lookahead_error * float(d_S.sum())
