"""Tree search node by node, one simulation after another, with merging and without."""

import math
from collections.abc import Hashable, Iterator, Sequence
from itertools import repeat
from typing import Any, Self

from torch import Tensor

from pgts_torch.tabular import TabularMDP
from tests.search.models import Masked

Node = dict[str, Any]


def grid(deficit: float) -> int:
    """Deficits that differ by less than this unit are ties."""
    return round(deficit * 2**20)


class SlowTree:
    """The oracle of `mcts` below some roots, without noise: plain floats, plain dictionaries, one path at a time.

    A node is known by the path that leads to it; with `merge` by its state and level, whatever the path and the root.
    """

    def __init__(
        self,
        mdp: TabularMDP | Masked,
        states: Sequence[int],
        bottom: int,
        v_S: Tensor,
        prior_SA: Tensor,
        *,
        root: str,
        rule: str,
        backup: str = "max",
        merge: bool = False,
        exploration: float = 1.25,
    ) -> None:
        self.mdp, self.bottom, self.v, self.prior = mdp, bottom, v_S.tolist(), prior_SA.tolist()
        self.gumbel, self.rule, self.mean, self.exploration = root == "gumbel", rule, backup == "mean", exploration
        self.A, self.merge, self.nodes = mdp.num_actions, merge, dict[Any, Node]()
        self.valued = {(0, state) for state in states}
        self.roots = [self.expand((state, 0), state, 0) for state in states]

    def expand(self, name: Hashable, state: int, level: int) -> Node:
        table = self.mdp.outcomes_of_all if isinstance(self.mdp, Masked) else self.mdp.outcomes
        prob, discount, child = (x[state].tolist() for x in (table.prob_NAK, table.discount_NAK, table.child_NAK))
        node: Node = {"name": name, "state": state, "level": level, "visits": [0] * self.A, "outcome_visits": {}}
        node["reward"] = table.reward_NA[state].tolist()
        node["outcomes"] = {
            (a, k): (prob[a][k], discount[a][k], child[a][k])
            for a in range(self.A)
            for k in range(table.num_outcomes)
            if prob[a][k] > 0 and discount[a][k] > 0 and node["reward"][a] > -math.inf
        }
        # Averages go on below the last level, to take its values again.
        node["open"] = set(node["outcomes"]) if self.mean or level + 1 < self.bottom else set()
        self.nodes[name] = node
        self.valued |= {(level + 1, self.below(node, a, k)) for a, k in node["outcomes"]}
        node["q"] = [self.backed_up(node, a) for a in range(self.A)]
        return node

    def below(self, node: Node, a: int, k: int) -> Hashable:
        """The name of the node that an edge leads to."""
        state = node["outcomes"][a, k][2]
        return (state, node["level"] + 1) if self.merge else (node["name"], a, k)

    def backed_up(self, node: Node, action: int) -> float:
        q = node["reward"][action]
        for (a, k), (p, gamma, state) in node["outcomes"].items():
            if a == action:
                below = self.nodes.get(self.below(node, a, k))
                q += p * gamma * (max(below["q"]) if below else self.v[state])
        return q

    def refresh(self, node: Node) -> None:
        """What the children say now, of their values and of whether something below them is open."""
        if not self.mean:
            node["q"] = [self.backed_up(node, a) for a in range(self.A)]
            children = {edge: self.nodes.get(self.below(node, *edge)) for edge in node["open"]}
            node["open"] = {edge for edge, child in children.items() if child is None or child["open"]}

    def open(self, node: Node, action: int) -> list[int]:
        """The outcomes of an action below which there is something to expand; for averages, all that have weight."""
        return sorted(k for a, k in node["open"] if a == action)

    def simulate(self, node: Node, actions: list[int]) -> float | None:
        """One simulation below a node by one of these actions: its return, or None if it could not be used."""
        actions = [a for a in actions if self.open(node, a)]
        if not actions:
            return max(node["q"]) if self.mean else None
        a = max(actions, key=lambda a: (self.score(node, a), -a))
        visits, counts = node["visits"][a], node["outcome_visits"]
        lack = {k: grid(node["outcomes"][a, k][0] * (visits + 1) - counts.get((a, k), 0)) for k in self.open(node, a)}
        k = max(lack, key=lambda k: (lack[k], -k))
        _, gamma, state = node["outcomes"][a, k]
        name, level = self.below(node, a, k), node["level"] + 1
        if name in self.nodes:
            self.refresh(self.nodes[name])
            value = self.simulate(self.nodes[name], list(range(self.A)))
        elif level < self.bottom:
            value = max(self.expand(name, state, level)["q"])
        else:
            value = self.v[state]
        self.refresh(node)
        if value is None:
            return None
        node["visits"][a] += 1
        counts[a, k] = counts.get((a, k), 0) + 1
        has_weight = sum(p for (b, _), (p, _, _) in node["outcomes"].items() if b == a)
        outcome = node["reward"][a] + has_weight * gamma * value
        if self.mean:
            node["q"][a] += (outcome - node["q"][a]) / (1 + node["visits"][a])
        return outcome

    def score(self, node: Node, a: int) -> float:
        total, visits = sum(node["visits"]), node["visits"][a]
        if self.rule == "gumbel":
            policy = [self.prior_of(node)[b] * math.exp(self.sigma(node, b)) for b in range(self.A)]
            return grid(policy[a] / sum(policy) * (total + 1) - visits)
        if self.rule == "puct":
            bonus = self.prior_of(node)[a] * math.sqrt(1 + total) / (1 + visits)
        else:
            bonus = math.sqrt(math.log(1 + total) / (1 + visits))
        return self.normalized(node, a) + self.exploration * bonus

    def prior_of(self, node: Node) -> list[float]:
        """The policy, given that it takes an action that is allowed."""
        prior = self.prior[node["state"]]
        share = sum(prior[a] for a in range(self.A) if node["reward"][a] > -math.inf)
        return [prior[a] / share if node["reward"][a] > -math.inf else 0.0 for a in range(self.A)]

    def normalized(self, node: Node, a: int) -> float:
        high, low = max(node["q"]), min(q for q in node["q"] if q > -math.inf)
        return (node["q"][a] - high) / max(high - low + 1e-8 * abs(high), 1e-300)

    def sigma(self, node: Node, a: int) -> float:
        return (50 + max(node["visits"])) * 0.1 * self.normalized(node, a)

    def search(self, simulations: int) -> Self:
        """The first simulation is the expansion of the root. In each round every root sends those that are due."""
        left = [simulations - 1] * len(self.roots)
        rounds = [self.rounds(root, simulations) for root in self.roots]
        while True:
            due = []
            for b, root in enumerate(self.roots):
                self.refresh(root)
                if left[b] > 0 and root["open"] and self.bottom > 1:
                    due += [(b, a) for a in next(rounds[b])[: left[b]]]
            if not due:
                break
            for b, a in due:
                left[b] -= self.simulate(self.roots[b], [a]) is not None
        for node in sorted(self.nodes.values(), key=lambda node: -node["level"]):
            self.refresh(node)
        return self

    def rounds(self, root: Node, simulations: int) -> Iterator[list[int]]:
        """The actions of a root that are due next."""
        while not self.gumbel:
            actions = [a for a in range(self.A) if self.open(root, a)]
            yield [max(actions, key=lambda a: (self.score(root, a), -a))]
        survivors, width = list(range(self.A)), sum(reward > -math.inf for reward in root["reward"])
        phases = max(1, math.ceil(math.log2(width)))
        for phase in range(phases):
            exhausted = [a for a in range(self.A) if not self.open(root, a)]
            survivors = [*self.ranked(root, survivors), *exhausted][:width]
            passes = max(1, (simulations - 1) // (phases * width))
            for _ in repeat(0, passes) if phase + 1 < phases else repeat(0):
                yield self.ranked(root, survivors)[:width]
            width = max(2, width // 2)

    def ranked(self, root: Node, survivors: list[int]) -> list[int]:
        """The root's actions that are not complete, best first, survivors before the others."""
        scores = [math.log(self.prior[root["state"]][a]) + self.sigma(root, a) for a in range(self.A)]
        actions = [a for a in range(self.A) if self.open(root, a)]
        return sorted(actions, key=lambda a: (a not in survivors, -scores[a], a))

    def root_values(self) -> list[list[float]]:
        return [root["q"] for root in self.roots]

    def nodes_per_level(self) -> list[int]:
        return [sum(level == each for level, _ in self.valued) for each in range(self.bottom + 1)]
