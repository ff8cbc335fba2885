"""Sampled outcomes as a model that enumerates them: each of C samples has probability 1 / C.

So the merged full-width search over this model is the lookahead of sparse sampling (Kearns, Mansour and Ng 2002).
"""

from collections.abc import Sequence
from typing import Literal, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgts_torch.bellman import Outcomes
from pgts_torch.models.base import EnumeratingModel, Model, SamplingModel
from pgts_torch.search.outcome_table import check_outcomes, has_weight
from pgts_torch.search.table import with_room
from pgts_torch.seeding import mix

Share = Literal["none", "level", "search"]
"""Which paths of a search share their samples: only those from equal roots, those that meet in a state at one level,
or all that meet in a state."""

_PATH = 0x70617468
"""Mixed into the key of a path, so that it differs from what a model mixes into the key of the path's last sample."""


@final
class Empirical(EnumeratingModel):
    """The nodes of one search as states of a model, in the order in which they are met: first the roots, ascending.

    A node is a path ("none"), a state at a level ("level") or a state ("search"). Each call must be for all nodes that
    the call before has met, as `Topology` makes them; so the calls are the levels.

    Args:
        model: samples outcomes; enumerates them where `samples` is None.
        root_B: its states, repeated or not.
        samples: C of each level from the roots down, None where all outcomes are enumerated.
        share: what a node is.
        key: the key of the search, shape [1].
    """

    samples_outcomes = True

    # What the calls of a `Topology` change must be ordinary tensors even if the caller is in inference mode.
    @torch.inference_mode(False)
    @torch.no_grad()
    def __init__(
        self,
        model: Model,
        root_B: Int[Tensor, "B"],
        *,
        samples: Sequence[int | None],
        share: Share,
        key: Int[Tensor, "1"],
    ) -> None:
        self.num_actions, self.device, self.dtype = model.num_actions, model.device, model.dtype
        self.model_calls = 0
        self.num_states = 0
        self._model, self._samples, self._share, self._key = model, samples, share, key
        self._most_samples = max((C for C in samples if C is not None), default=0)
        enumerated = model.num_outcomes if isinstance(model, EnumeratingModel) else None
        self.num_outcomes = max((enumerated or 1) if C is None else C for C in samples)
        # By level: the states and keys of its nodes, and once they were queried for the sampled rewards [n, A, C].
        self._states: list[Tensor] = []
        self._keys: list[Tensor] = []
        self._rewards: list[Tensor] = []
        # With share "search" the node of each state, -1 where there is none yet.
        self._node_S = torch.empty(0, dtype=torch.int64, device=model.device)
        # Nodes 0, 1, ... are the distinct roots in ascending order, so that equal roots share their samples.
        roots = torch.unique(root_B)
        self.root_B: Int[Tensor, "B"] = torch.searchsorted(roots, root_B)
        """The node of each root."""
        if share == "search":
            # Below, a path may come back to a root's state: then that node is met again.
            self._new_nodes(roots)
        self._add(roots, self._state_keys(roots))

    @property
    def state_N(self) -> Int[Tensor, "N"]:
        """The state of the underlying model at each node."""
        return torch.cat(self._states)

    @property
    def key_N(self) -> Int[Tensor, "N"]:
        """The key of each node, which decides what is sampled there."""
        return torch.cat(self._keys)

    @property
    def reward_NAC(self) -> Float[Tensor, "N A C"]:
        """The sampled rewards of each node with outcomes, for the largest C; those beyond a node's own C are 0."""
        return torch.cat(self._rewards)

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The outcomes of the nodes that the call before has met; children are nodes."""
        assert len(state_N) == len(self._states[-1])
        assert int(state_N[0]) == self.num_states - len(state_N)
        # The last nodes that were added, and the C of the level that they form.
        states, key_N, C = self._states[-1], self._keys[-1], self._samples[len(self._rewards)]
        if C is None:
            assert isinstance(self._model, EnumeratingModel)
            answer, reward_NAC = self._model.outcomes(states), key_N.new_zeros(len(states), self.num_actions, 0)
        else:
            assert isinstance(self._model, SamplingModel)
            answer, reward_NAC = sample_outcomes(self._model, states, key_N, C)
        self.model_calls += len(states) * self.num_actions * (1 if C is None else C)
        check_outcomes(self._model, states, answer)
        # The bootstrap reads all levels as one table, as wide as the largest C.
        unfilled = self._most_samples - reward_NAC.shape[-1]
        self._rewards.append(torch.nn.functional.pad(reward_NAC.to(self.dtype), (0, unfilled)))
        weighs_NAK = has_weight(answer)
        # Outcomes without weight get child 0 and no node.
        child_NAK = torch.zeros_like(answer.child_NAK)
        edge_NAK = edge_keys(key_N, self.num_actions, answer.num_outcomes)
        child_NAK[weighs_NAK] = self._met(answer.child_NAK[weighs_NAK], edge_NAK[weighs_NAK])
        return Outcomes(answer.reward_NA, answer.prob_NAK, answer.discount_NAK, child_NAK, self.num_states)

    def _state_keys(self, state_N: Tensor) -> Tensor:
        """The keys of new nodes for these states, at the level that is being met."""
        return mix(self._key, len(self._states), state_N) if self._share == "level" else mix(self._key, state_N)

    def _met(self, state_N: Tensor, edge_N: Tensor) -> Tensor:
        """The nodes of these children, each reached by an outcome with the key `edge_N`; new ones are added."""
        if self._share == "none":
            # Each outcome is a new path, whose key follows from those of the path so far.
            new, key_N = state_N, mix(edge_N, _PATH)
            node_N = self.num_states + torch.arange(len(state_N), device=self.device)
        elif self._share == "level":
            # All nodes of the next level are new; outcomes that lead to one state lead to one node.
            new, row_N = torch.unique(state_N, return_inverse=True)
            node_N, key_N = self.num_states + row_N, self._state_keys(new)
        else:
            # Only states that no level has met get a node.
            new = self._new_nodes(torch.unique(state_N))
            node_N, key_N = self._node_S[state_N], self._state_keys(new)
        self._add(new, key_N)
        return node_N

    def _new_nodes(self, state_N: Tensor) -> Tensor:
        """Those of the distinct states that have no node; they get the next ones."""
        self._node_S = with_room(self._node_S, self._model.num_states)
        new = state_N[self._node_S[state_N] < 0]
        self._node_S[new] = self.num_states + torch.arange(len(new), device=self.device)
        return new

    def _add(self, state_N: Tensor, key_N: Tensor) -> None:
        self._states.append(state_N)
        self._keys.append(key_N)
        self.num_states += len(state_N)


@final
class FixedSamples(EnumeratingModel):
    """C samples of each (state, action) of a model as all its outcomes, the same ones in each query.

    Args:
        key: decides all of them, shape [1].
    """

    def __init__(self, model: SamplingModel, *, samples: int, key: Int[Tensor, "1"]) -> None:
        self.num_actions, self.device, self.dtype = model.num_actions, model.device, model.dtype
        self._model, self._samples, self._key = model, samples, key
        self.num_outcomes = samples

    @property
    def num_states(self) -> int:  # type: ignore[override]  # it grows with the model's
        return self._model.num_states

    def outcomes(self, state_N: Int[Tensor, "N"]) -> Outcomes:
        """The samples of these states; children are states of the model."""
        return sample_outcomes(self._model, state_N, mix(self._key, state_N), self._samples)[0]


def sample_outcomes(
    model: SamplingModel, state_N: Int[Tensor, "N"], key_N: Int[Tensor, "N"], samples: int
) -> tuple[Outcomes, Float[Tensor, "N A C"]]:
    """C samples of every action of these states, as equally likely outcomes, and their rewards."""
    # One pair for each (state, action, sample), in the order of a flattened [N, A, C].
    shape = len(state_N), model.num_actions, samples
    sampled = model.sample(
        state_N.view(-1, 1, 1).expand(shape).reshape(-1),
        torch.arange(model.num_actions, device=model.device).view(-1, 1).expand(shape).reshape(-1),
        key_N=edge_keys(key_N, model.num_actions, samples).reshape(-1),
    )
    reward_NAC = sampled.reward_N.view(shape)
    each_NAK = torch.full((), 1 / samples, dtype=model.dtype, device=model.device).expand(shape)
    # Dividing before summing keeps rewards near the largest number finite.
    mean_NA = (reward_NAC / samples).sum(-1)
    children = sampled.next_state_N.view(shape)
    return Outcomes(mean_NA, each_NAK, sampled.discount_N.view(shape), children, model.num_states), reward_NAC


def edge_keys(key_N: Int[Tensor, "N"], num_actions: int, samples: int) -> Int[Tensor, "N A C"]:
    """A key for each (node, action, sample)."""
    action_A1 = torch.arange(num_actions, device=key_N.device).view(-1, 1)
    return mix(key_N.view(-1, 1, 1), action_A1, torch.arange(samples, device=key_N.device))
