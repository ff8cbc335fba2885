"""Sparse sampling: lookahead over C sampled outcomes of each action, however many there may be."""

from collections.abc import Iterable, Iterator, Sequence
from typing import get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes, backup
from pgts_torch.errors import PgtsError
from pgts_torch.models.base import EnumeratingModel, Model, SamplingModel
from pgts_torch.options.search import MAX_BYTES, MAX_NODES
from pgts_torch.search.empirical import Empirical, Share
from pgts_torch.search.expectimax import full_width
from pgts_torch.search.lookahead import (
    Leaf,
    Leaves,
    Lookahead,
    check_states,
    check_vector,
    unexpanded,
)
from pgts_torch.search.memory import RESAMPLED
from pgts_torch.search.topology import Topology
from pgts_torch.seeding import mix, sample_keys, uniform

_RESAMPLE = 0x626F6F74
"""Mixed into the keys of the bootstrap, so that they differ from those of the samples."""

_CHUNK = 2**22
"""The most resampled outcomes of one level that are held at a time, or those of one replicate."""


def sampled(
    model: SamplingModel,
    root_B: Int[Tensor, "B"],
    *,
    depth: int,
    q_leaf: Leaf | None = None,
    v_leaf: Leaf | None = None,
    samples: int | Sequence[int | None],
    share: Share = "level",
    generator: torch.Generator,
    replicates: int = 32,
    max_nodes: int = MAX_NODES,
    max_bytes: int = MAX_BYTES,
) -> Lookahead:
    """An estimate of (T^m Q)(s, .) at the roots for m = depth: T^m Q in the MDP of the sampled outcomes.

        q(s, a) = 1/C sum_c [ r_c + gamma_c max_b q(s'_c, b) ]        (Kearns, Mansour and Ng 2002)

    All actions of all nodes are looked at. Leaves are those of `expectimax`, each state once. A sample is named by
    (search, level, state, action, c), so q is the same bit for bit however the roots are split into batches or ordered,
    as long as the generator is in the same state and the model numbers its states alike.

    The error falls as 1 / sqrt(C). The maxima over noisy values make the estimate too high wherever actions are nearly
    tied: E q >= T^m Q, with equality where there is one action and where no maximum is over sampled values. `bias_BA`
    estimates by how much, `stderr_BA` the standard deviation, both by a bootstrap: of the C samples of each (s, a)
    C - 1 are drawn with replacement, which makes the variance of a mean unbiased (Rao and Wu 1988), and all backups are
    done again, `replicates` times. With few samples stderr is rather too large, since what a level inherits from the
    one below varies with both. Both are NaN (not estimated) without replicates and with C = 1 at any level.

    Args:
        model: samples an outcome of a state and an action.
        root_B: states of the model, int64; repeated ones share their samples, whatever `share` says, and cost nothing.
        depth: m, a finite whole number of at least 0.
        q_leaf: an estimate of Q^pi: states [N] to [N, A].
        v_leaf: an estimate of v^pi: states [N] to [N]. Exactly one of the two is given.
        samples: C, or one C for each level from the roots down; the last one serves all deeper levels, and those below
            the leaves are not used. None enumerates all outcomes of a level, which the model must be able to do;
            where all levels are enumerated the search is `expectimax`.
        share: "none": every path has its own samples, and the nodes are a tree. "level": paths that meet in a state at
            one level are one node, with one set of samples. "search": a state has one set of samples at all levels:
            fewest calls, one C, and a closed set as in `expectimax`. All three have the same rate.
        generator: of one key, which decides all samples of this search.
        replicates: R of the bootstrap: 0, or at least 2.
        max_nodes: the most nodes, summed over levels; a level is sampled before its children are counted.
        max_bytes: the most memory that the search may take; a level is estimated before it is sampled.

    Returns:
        `model_calls` counts each (state, action, sample), and one for a (state, action) whose outcomes are enumerated.

    Raises:
        PgtsError: as `expectimax`; C below 1; several C with share="search"; a model that cannot do what is needed.
        NodeBudgetExceeded: more than `max_nodes` or `max_bytes` would be needed.
    """
    return sparse(
        Leaves(model, depth, q_leaf, v_leaf),
        model,
        root_B,
        samples=samples,
        share=share,
        generator=generator,
        replicates=replicates,
        max_nodes=max_nodes,
        max_bytes=max_bytes,
    )


@torch.no_grad()
def sparse(
    leaves: Leaves,
    model: SamplingModel,
    root_B: Int[Tensor, "B"],
    *,
    samples: int | Sequence[int | None],
    share: Share,
    generator: torch.Generator,
    replicates: int,
    max_nodes: int,
    max_bytes: int,
) -> Lookahead:
    """`sampled`, with its leaves at hand."""
    check_vector(root_B)
    check_states(root_B, model.num_states)
    plan = plan_levels(samples, leaves.expansions, share, model)
    if replicates < 0 or replicates == 1:
        raise PgtsError(f"replicates is {replicates}; it must be 0 or at least 2")
    key = sample_keys(1, generator=generator).to(model.device)
    if not plan:
        return unexpanded(leaves, root_B)
    # Without a sampled level there is nothing empirical: the search is exact.
    if all(C is None for C in plan):
        assert isinstance(model, EnumeratingModel)
        topology = Topology(model, max_bytes=max_bytes)
        return full_width(leaves, topology, root_B, max_nodes=max_nodes)
    empirical = Empirical(model, root_B, samples=plan, share=share, key=key)
    topology = Topology(empirical, max_bytes=max_bytes)
    # The empirical model's states are nodes: expand them, value the lowest, back up as in `expectimax`.
    steps, bottom_N, nodes_per_level = _expanded(empirical, topology, leaves.expansions, share, max_nodes)
    v_N = _leaf_values(leaves, empirical, steps, bottom_N)
    q_BA = _backups([outcomes for _, outcomes in reversed(steps)], v_N)[empirical.root_B]
    stderr_BA = bias_BA = torch.full_like(q_BA, torch.nan)
    fewest = min(C for C in plan if C is not None)
    if replicates and fewest > 1:
        # The bootstrap may fill what the levels leave of the memory.
        kept = sum(outcomes.num_states for _, outcomes in steps)
        free = max(0, max_bytes - topology.bytes(0, kept=kept))
        again_RNA = _bootstrap(empirical, plan, steps, v_N, replicates, at_once=free // RESAMPLED)
        stderr_BA, bias_BA = _spread(q_BA, again_RNA[:, empirical.root_B])
        if len(plan) == 1:
            # No maximum over samples was taken: what differs from 0 is noise of the bootstrap.
            bias_BA = torch.zeros_like(bias_BA)
    return Lookahead(
        q_BA,
        stderr_BA=stderr_BA,
        bias_BA=bias_BA,
        pruned_BA=torch.zeros_like(q_BA),
        model_calls=empirical.model_calls,
        critic_calls=leaves.calls,
        nodes_per_level=nodes_per_level,
        samples=fewest,
        value_range=(0.0, 0.0) if model.is_certain else (model.lowest_value, model.highest_value),
    )


def plan_levels(
    samples: int | Sequence[int | None], expansions: int, share: str, model: Model
) -> tuple[int | None, ...]:
    """C of each of `expansions` levels, None where outcomes are enumerated."""
    given = list(samples) if isinstance(samples, Sequence) else [samples]
    for C in given:
        if C is not None and (isinstance(C, bool) or not isinstance(C, int) or C < 1):
            raise PgtsError(f"samples is {samples}; each must be a whole number of at least 1, or None")
    if not given:
        raise PgtsError("samples is empty; give C, or one C for each level")
    if share not in get_args(Share):
        raise PgtsError(f"share is {share!r}; it must be one of {', '.join(get_args(Share))}")
    # The last C serves all deeper levels.
    plan = tuple(given[min(level, len(given) - 1)] for level in range(expansions))
    if share == "search" and len(set(plan)) > 1:
        raise PgtsError(f"samples is {samples}; with share='search' a state has one C at all levels")
    if None in plan and not isinstance(model, EnumeratingModel):
        raise PgtsError(
            f"samples is {samples}; {type(model).__name__} cannot enumerate outcomes, so None is not possible"
        )
    if set(plan) - {None} and not isinstance(model, SamplingModel):
        raise PgtsError(f"samples is {samples}; {type(model).__name__} cannot sample outcomes, only enumerate them")
    return plan


Step = tuple[Tensor, Outcomes]
"""The nodes of one level, shape [N], and their outcomes."""


def _expanded(
    empirical: Empirical, topology: Topology, expansions: int, share: Share, max_nodes: int
) -> tuple[list[Step], Tensor | None, tuple[int, ...]]:
    """The levels from the roots down, the nodes at the bottom (None: every path ends above), and how many there are."""
    # One level at a time: a set that closes early ends the sampling.
    for expanded in range(1, expansions + 1):
        levels = topology.levels(empirical.root_B, expanded, max_nodes=max_nodes)
        if levels.closed is not None:
            break
    steps: list[Step] = list(zip(levels.frontiers, levels.outcomes, strict=False))
    if levels.closed is None:
        return steps, levels.leaves(expansions), levels.nodes_per_level(expansions)
    if share == "search":
        # States recur: the remaining levels are the closed set, again and again.
        topology.levels(empirical.root_B, expansions, max_nodes=max_nodes)
        steps += [(levels.closed_states, levels.closed)] * levels.sweeps(expansions)
        return steps, levels.leaves(expansions), levels.nodes_per_level(expansions)
    # Paths, and states at a level, never recur: where no new node is met, no outcome of the level before has weight.
    widths = [len(frontier) for frontier in levels.frontiers]
    return steps, None, (*widths, *[0] * (expansions + 1 - len(widths)))


def _leaf_values(
    leaves: Leaves, empirical: Empirical, steps: list[Step], bottom_N: Tensor | None
) -> Float[Tensor, "leaves"]:
    """The critic's values of the nodes at the bottom; where every path ends above, zeros to which no outcome leads."""
    if bottom_N is None:
        return torch.zeros(steps[-1][1].num_children, dtype=empirical.dtype, device=empirical.device)
    # Several nodes may be of one state, which the critic values once.
    state_N, row_N = torch.unique(empirical.state_N[bottom_N], return_inverse=True)
    return leaves.v(state_N)[row_N]


def _backups(outcomes: Iterable[Outcomes], v_N: Float[Tensor, "leaves"]) -> Float[Tensor, "N A"]:
    """Values at the roots, from values v at the leaves.

    Args:
        outcomes: of the levels, from the lowest up.
    """
    for step in outcomes:
        q_NA = backup(step, v_N)
        v_N = q_NA.amax(-1)
    return q_NA


def _bootstrap(
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
    chunks = torch.arange(replicates, device=v_N.device).split(1 + min(at_once, _CHUNK) // largest)
    A = empirical.num_actions
    return torch.cat([_backups(resampled(chunk), v_N.repeat(len(chunk))).view(len(chunk), -1, A) for chunk in chunks])


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


def _spread(q_BA: Tensor, again_RBA: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviation of the replicates, and their mean minus q; both 0 where an action is not allowed."""
    off_RBA = torch.where(q_BA > -torch.inf, again_RBA - q_BA, 0.0)
    # Each row is summed in one order, however many there are; in units of the largest deviation no square overflows.
    off_BAR = off_RBA.movedim(0, -1).contiguous()
    unit_BA1 = off_BAR.abs().amax(-1, keepdim=True).clamp(min=torch.finfo(q_BA.dtype).tiny)
    off_BAR = off_BAR / unit_BA1
    return off_BAR.std(-1) * unit_BA1.squeeze(-1), off_BAR.mean(-1) * unit_BA1.squeeze(-1)
