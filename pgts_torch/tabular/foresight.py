"""What a training from rollouts will come to, foreseen in the exact world: Algorithm 1 without noise, as far as its
rollouts let it see (docs/rates.md, Sec. 9)."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.bellman import backup, policy_mean
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.options.fields import limit
from pgts_torch.options.updates import Mirror, Projected, SoftmaxGradient
from pgts_torch.tabular import exact
from pgts_torch.tabular.ascent import Ascent, centred, floored, projected_step, scaled, softmax_step
from pgts_torch.tabular.mdp import TabularMDP

EVEN = 0.5
"""A state counts as visited from the iteration on in which it is more likely than not to have been."""


def foresee(
    mdp: TabularMDP,
    pi_SA: Float[Tensor, "S A"],
    *,
    depth: int,
    iterations: int,
    update: Projected | SoftmaxGradient | Mirror = Mirror(),  # noqa: B008 - frozen
    num_envs: int = 16,
    length: int = 200,
    trace: float = 0.9,
    critic_step_size: float = 0.5,
) -> Ascent:
    """The returns that a training from rollouts is expected to have, without one sample.

    It is Algorithm 1 with expectations in place of samples. In each iteration a state takes the expected step: with the
    occupancy of rollouts of `length` steps as its weight, or, with weight 1, with the probability that one of
    `num_envs` rollouts visits it. States that are not likely to have been visited so far take no step, and have the
    mean value of the visits; the values of the others move toward expected lambda returns, as those of a tabular critic
    do. Chance finds, and noise that decides between nearly equal actions, are not foreseen.

    It costs `length` products of S x S matrices an iteration: for tables of up to some hundred states. The defaults are
    those of `PGTS` for tables.

    Args:
        update: its options; the step size must be a number.
        num_envs, length: rollouts of an iteration, with a fixed horizon.
        trace, critic_step_size: lambda and step size of the critic.
    """
    for name, count in (("depth", depth), ("iterations", iterations)):
        check_count(name, count, least=0)
    for name, count in (("num_envs", num_envs), ("length", length)):
        check_count(name, count)
    update = update.filled("tables") if isinstance(update, Mirror) else update
    if isinstance(update.step_size, str):
        raise PgtsError(f"update.step_size is {update.step_size}; it must be a number here, not a schedule")
    pi_SA = exact.check_policy(mdp, pi_SA)
    unseen_S = torch.ones(mdp.num_states, dtype=torch.float64)
    v_S, known_S = torch.zeros_like(unseen_S), torch.zeros_like(unseen_S, dtype=torch.bool)
    returns = []
    for _ in range(iterations):
        returns.append(float(mdp.start_S @ exact.policy_values(mdp, pi_SA)))
        visits_S, occupancy_S, visited_S = expected_visits(mdp, pi_SA, num_envs=num_envs, length=length)
        unseen_S = unseen_S * (1 - visited_S)
        seen_S = unseen_S <= EVEN
        v_S = _fitted(mdp, pi_SA, v_S, known_S, seen_S, (visits_S, visited_S), trace, critic_step_size)
        known_S = seen_S
        look_SA = exact.lookahead(mdp, backup(mdp.outcomes, v_S), depth)
        weights = {"occupancy": occupancy_S, "visits": visits_S / visits_S.sum(), "uniform": visited_S}
        weight_N = weights[str(update.state_weight)][seen_S]
        pi_SA = pi_SA.clone()
        pi_SA[seen_S] = _moved(update, pi_SA[seen_S], look_SA[seen_S], weight_N, visited_S[seen_S])
    returns.append(float(mdp.start_S @ exact.policy_values(mdp, pi_SA)))
    return Ascent(torch.tensor(returns, dtype=torch.float64), pi_SA, depth)


def _moved(
    update: Projected | SoftmaxGradient | Mirror, pi_NA: Tensor, q_NA: Tensor, weight_N: Tensor, visited_N: Tensor
) -> Float[Tensor, "N A"]:
    """The policy after the expected step in states that are visited with these probabilities."""
    eta = float(update.step_size or 0)
    if not isinstance(update, Mirror):
        return (projected_step if isinstance(update, Projected) else softmax_step)(pi_NA, q_NA, weight_N, eta)
    advantage_NA = centred(q_NA, pi_NA)
    if update.normalize == "rms":
        # Of the states that are visited in an iteration, each as often as it is one of them.
        share_N = visited_N if update.state_weight == "uniform" else torch.ones_like(visited_N)
        scale = ((share_N * policy_mean(pi_NA, advantage_NA.square())).sum() / share_N.sum()).sqrt()
        advantage_NA = advantage_NA / scale if scale > 0 else advantage_NA
    floor = None if update.floor is None else limit(update.floor)
    return floored(pi_NA.log(), scaled(advantage_NA, eta * weight_N), floor).softmax(-1)


def expected_visits(
    mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], *, num_envs: int, length: int
) -> tuple[Float[Tensor, "S"], Float[Tensor, "S"], Float[Tensor, "S"]]:
    """Of each state in rollouts of at most `length` steps: the expected number of visits in one, the same discounted,
    and the probability that at least one of `num_envs` visits it."""
    step_SS, discounted_SS = (matrix_SS.numpy() for matrix_SS in _policy_matrices(mdp, pi_SA))
    S, start_S = mdp.num_states, mdp.start_S.numpy()
    # Row x of the first S follows the episodes that have not been in state x yet: what comes into x is taken out, and
    # is the probability of a first visit. The last row follows all episodes.
    here_XS, later_S = np.tile(start_S, (S + 1, 1)), start_S
    first_S, visits_S, occupancy_S = np.zeros(S), np.zeros(S), np.zeros(S)
    own = np.arange(S)
    for _ in range(length):  # numpy, because operations on a few numbers cost several times more in torch
        visits_S += here_XS[-1]
        occupancy_S += later_S
        first_S += here_XS[own, own]
        here_XS[own, own] = 0
        here_XS, later_S = here_XS @ step_SS, later_S @ discounted_SS
    visited_S = 1 - (1 - first_S.clip(max=1)) ** num_envs
    return torch.from_numpy(visits_S), torch.from_numpy(occupancy_S), torch.from_numpy(visited_S)


def _policy_matrices(mdp: TabularMDP, pi_SA: Tensor) -> tuple[Float[Tensor, "S S"], Float[Tensor, "S S"]]:
    """P^pi between states of an episode that goes on, without and with discounts."""
    outcomes, S = mdp.outcomes, mdp.num_states
    prob_SAK = pi_SA[:, :, None] * outcomes.prob_NAK * (outcomes.discount_NAK > 0)
    child_SK = outcomes.child_NAK.reshape(S, -1)
    step_SS = torch.zeros(S, S, dtype=torch.float64)
    return (
        step_SS.scatter_add(1, child_SK, prob_SAK.reshape(S, -1)),
        step_SS.scatter_add(1, child_SK, (prob_SAK * outcomes.discount_NAK).reshape(S, -1)),
    )


def _fitted(
    mdp: TabularMDP,
    pi_SA: Tensor,
    v_S: Tensor,
    known_S: Tensor,
    seen_S: Tensor,
    visits: tuple[Tensor, Tensor],
    trace: float,
    step_size: float,
) -> Float[Tensor, "S"]:
    """The values after one fit of a tabular critic; states not seen so far have the mean w of the visits' targets.

    The targets u = v + (I - lambda gamma P)^-1 (r + gamma P v - v) are affine in w, so two solves find them.
    """
    visits_S, visited_S = visits
    _, discounted_SS = _policy_matrices(mdp, pi_SA)
    reward_S = policy_mean(pi_SA, mdp.outcomes.reward_NA)
    share_S = torch.where(seen_S, visits_S, 0.0)
    share_S = share_S / share_S.sum()

    def targets(value_S: Tensor) -> Tensor:
        # Episodes are followed within the states that have been seen; elsewhere the value is what it is.
        within_SS = trace * discounted_SS * seen_S
        error_S = torch.where(seen_S, reward_S + discounted_SS @ value_S - value_S, 0.0)
        eye_SS = torch.eye(len(value_S), dtype=torch.float64)
        return value_S + torch.linalg.solve(eye_SS - within_SS, error_S)

    at_0 = share_S @ targets(torch.where(known_S, v_S, 0.0))
    at_1 = share_S @ targets(torch.where(known_S, v_S, 1.0))
    w = at_0 / (1 - at_1 + at_0).clamp(min=torch.finfo(torch.float64).tiny)
    before_S = torch.where(known_S, v_S, w)
    return torch.where(seen_S, before_S + step_size * visited_S * (targets(before_S) - before_S), w)
