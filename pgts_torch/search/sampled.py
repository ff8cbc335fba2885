"""Sparse sampling: lookahead over C sampled outcomes of each action, however many there may be."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.errors import PgtsError
from pgts_torch.models.base import EnumeratingModel, Model, SamplingModel
from pgts_torch.options.search import MAX_BYTES, MAX_NODES, Sampled
from pgts_torch.search.bootstrap import Step, bootstrap, spread
from pgts_torch.search.empirical import Empirical, Share
from pgts_torch.search.expectimax import search_levels
from pgts_torch.search.levels import back_up
from pgts_torch.search.lookahead import Leaf, Leaves, Lookahead, check_roots, unexpanded
from pgts_torch.search.memory import RESAMPLED
from pgts_torch.search.topology import Topology
from pgts_torch.seeding import sample_keys


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

    All actions of all nodes are expanded. A sample is named by (search, level, state, action, c), so q is the same bit
    for bit however the roots are split into batches or ordered, if the generator is in the same state and the model
    numbers its states alike.

    The error falls as 1 / sqrt(C). Maxima over noisy values make the estimate too high wherever actions are nearly
    tied: E q >= T^m Q. `bias_BA` estimates by how much, `stderr_BA` the standard deviation, both by a bootstrap: of the
    C samples of each (s, a) C - 1 are drawn with replacement, which makes the variance of a mean unbiased (Rao and Wu
    1988), and all backups are done again, `replicates` times. With few samples stderr is rather too large. Both are NaN
    (not estimated) without replicates and with C = 1 at any level.

    Args:
        model: samples an outcome of a state and an action.
        root_B: as in `expectimax`; repeated states share their samples, whatever `share` says.
        depth, q_leaf, v_leaf: as in `expectimax`.
        samples: C, or one C for each level from the roots down, of which the last serves all deeper levels. None
            enumerates all outcomes of a level, which the model must be able to do; with None alone the search is
            `expectimax`.
        share: "none": every path has its own samples, and the nodes are a tree. "level": paths that meet in a state at
            one level share a node and its samples. "search": a state has one set of samples at all levels, which needs
            one C: fewest calls, and a closed set as in `expectimax`. The error has the same rate with each.
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
    options = Sampled(samples=samples, share=share, max_nodes=max_nodes, max_bytes=max_bytes)
    return search_samples(
        Leaves(model, depth, q_leaf, v_leaf), model, root_B, options, generator, replicates=replicates
    )


@torch.no_grad()
def search_samples(
    leaves: Leaves,
    model: SamplingModel,
    root_B: Int[Tensor, "B"],
    options: Sampled,
    generator: torch.Generator,
    *,
    replicates: int,
) -> Lookahead:
    """`sampled`, with the leaves at hand."""
    check_roots(root_B, model.num_states)
    plan = plan_levels(options, leaves.expansions, model)
    if replicates < 0 or replicates == 1:
        raise PgtsError(f"replicates is {replicates}; it must be 0 or at least 2")
    key = sample_keys(1, generator=generator).to(model.device)
    if not plan:
        return unexpanded(leaves, root_B)
    # Without a sampled level there is nothing empirical: the search is exact.
    if all(C is None for C in plan):
        assert isinstance(model, EnumeratingModel)
        topology = Topology(model, max_bytes=options.max_bytes)
        return search_levels(leaves, topology, root_B, max_nodes=options.max_nodes)
    empirical = Empirical(model, root_B, samples=plan, share=options.share, key=key)
    topology = Topology(empirical, max_bytes=options.max_bytes)
    topology.table.meter = leaves.meter
    # The empirical model's states are nodes: expand them, value the lowest, back up as in `expectimax`.
    steps, bottom_N, nodes_per_level = _expanded(empirical, topology, leaves.expansions, options)
    v_N = _leaf_values(leaves, empirical, steps, bottom_N)
    q_BA = back_up([outcomes for _, outcomes in reversed(steps)], v_N)[empirical.root_B]
    stderr_BA = bias_BA = torch.full_like(q_BA, torch.nan)
    fewest = min(C for C in plan if C is not None)
    if replicates and fewest > 1:
        # The bootstrap may fill what the levels leave of the memory.
        free = max(0, options.max_bytes - topology.bytes(0, kept=sum(outcomes.num_states for _, outcomes in steps)))
        again_RNA = bootstrap(empirical, plan, steps, v_N, replicates, at_once=free // RESAMPLED)
        stderr_BA, bias_BA = spread(q_BA, again_RNA[:, empirical.root_B])
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


def plan_levels(options: Sampled, expansions: int, model: Model) -> tuple[int | None, ...]:
    """C of each of `expansions` levels, None where outcomes are enumerated; PgtsError if the model cannot do that."""
    samples = options.samples if isinstance(options.samples, list) else [options.samples]
    # The last C serves all deeper levels.
    plan = tuple(samples[min(level, len(samples) - 1)] for level in range(expansions))
    if options.share == "search" and len(set(plan)) > 1:
        raise PgtsError(f"samples is {samples}; with share='search' a state has one C at all levels")
    if None in plan and not isinstance(model, EnumeratingModel):
        raise PgtsError(
            f"samples is {samples}; {type(model).__name__} cannot enumerate outcomes, so None is not possible"
        )
    if set(plan) - {None} and not isinstance(model, SamplingModel):
        raise PgtsError(f"samples is {samples}; {type(model).__name__} cannot sample outcomes, only enumerate them")
    return plan


def _expanded(
    empirical: Empirical, topology: Topology, expansions: int, options: Sampled
) -> tuple[list[Step], Tensor | None, tuple[int, ...]]:
    """The levels from the roots down, the nodes at the bottom (None: every path ends above), and how many there are."""
    # One level at a time: a set that closes early ends the sampling.
    for expanded in range(1, expansions + 1):
        levels = topology.levels(empirical.root_B, expanded, max_nodes=options.max_nodes)
        if levels.closed is not None:
            break
    steps: list[Step] = list(zip(levels.frontiers, levels.outcomes, strict=False))
    if levels.closed is None:
        return steps, levels.plan(expansions).bottom, levels.plan(expansions).nodes_per_level
    if options.share == "search":
        # States recur: the remaining levels are the closed set, again and again.
        topology.levels(empirical.root_B, expansions, max_nodes=options.max_nodes)
        steps += [(levels.closed_states, levels.closed)] * levels.sweeps(expansions)
        return steps, levels.plan(expansions).bottom, levels.plan(expansions).nodes_per_level
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
