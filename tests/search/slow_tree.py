"""Tree search node by node, one simulation after another."""

import math
from typing import Any, Self

from torch import Tensor

from pgts_torch.tabular import TabularMDP

Node = dict[str, Any]


def grid(deficit: float) -> int:
    """Deficits that differ by less than this unit are ties."""
    return round(deficit * 2**20)


class SlowTree:
    """The oracle of `mcts` below one root, without noise: plain floats, plain dictionaries, one path at a time."""

    def __init__(
        self,
        mdp: TabularMDP,
        state: int,
        bottom: int,
        v_S: Tensor,
        prior_SA: Tensor,
        *,
        root: str,
        rule: str,
        backup: str,
        exploration: float = 1.25,
    ) -> None:
        self.mdp, self.bottom, self.v, self.prior = mdp, bottom, v_S.tolist(), prior_SA.tolist()
        self.gumbel, self.rule, self.mean, self.exploration = root == "gumbel", rule, backup == "mean", exploration
        self.A, self.K = mdp.num_actions, mdp.outcomes.num_outcomes
        self.root = self.expand(state, 0)

    def expand(self, state: int, level: int) -> Node:
        table = self.mdp.outcomes
        prob, discount, child = (x[state].tolist() for x in (table.prob_NAK, table.discount_NAK, table.child_NAK))
        node: Node = {"state": state, "level": level, "children": {}, "visits": [0] * self.A, "outcome_visits": {}}
        node["reward"] = table.reward_NA[state].tolist()
        node["outcomes"] = {
            (a, k): (prob[a][k], discount[a][k], child[a][k])
            for a in range(self.A)
            for k in range(self.K)
            if prob[a][k] > 0 and discount[a][k] > 0
        }
        node["q"] = [self.backed_up(node, a) for a in range(self.A)]
        return node

    def backed_up(self, node: Node, action: int) -> float:
        q = node["reward"][action]
        for (a, k), (p, gamma, state) in node["outcomes"].items():
            if a == action:
                below = node["children"].get((a, k))
                q += p * gamma * (max(below["q"]) if below else self.v[state])
        return q

    def open(self, node: Node, action: int) -> list[int]:
        """The outcomes of an action below which there is something to expand; for averages, all that have weight."""
        ks = [k for a, k in node["outcomes"] if a == action]
        return ks if self.mean else [k for k in ks if not self.complete(node, action, k)]

    def complete(self, node: Node, a: int, k: int) -> bool:
        if node["level"] + 1 >= self.bottom:
            return True
        below = node["children"].get((a, k))
        return below is not None and all(self.complete(below, *edge) for edge in below["outcomes"])

    def simulate(self, node: Node, actions: list[int]) -> float | None:
        """One simulation below a node by one of these actions; the return, where averages are backed up."""
        actions = [a for a in actions if self.open(node, a)]
        if not actions:
            return max(node["q"])
        a = max(actions, key=lambda a: (self.score(node, a), -a))
        visits, counts = node["visits"][a], node["outcome_visits"]
        lack = {k: grid(node["outcomes"][a, k][0] * (visits + 1) - counts.get((a, k), 0)) for k in self.open(node, a)}
        k = max(lack, key=lambda k: (lack[k], -k))
        _, gamma, state = node["outcomes"][a, k]
        if (a, k) in node["children"]:
            value = self.simulate(node["children"][a, k], list(range(self.A)))
        elif node["level"] + 1 < self.bottom:
            node["children"][a, k] = self.expand(state, node["level"] + 1)
            value = max(node["children"][a, k]["q"])
        else:
            value = self.v[state]
        node["visits"][a] += 1
        counts[a, k] = counts.get((a, k), 0) + 1
        if not self.mean:
            node["q"][a] = self.backed_up(node, a)
            return None
        has_weight = sum(p for (b, _), (p, _, _) in node["outcomes"].items() if b == a)
        outcome = node["reward"][a] + has_weight * gamma * value
        node["q"][a] += (outcome - node["q"][a]) / (1 + node["visits"][a])
        return outcome

    def score(self, node: Node, a: int) -> float:
        total, visits = sum(node["visits"]), node["visits"][a]
        if self.rule == "gumbel":
            policy = [self.prior[node["state"]][b] * math.exp(self.sigma(node, b)) for b in range(self.A)]
            return grid(policy[a] / sum(policy) * (total + 1) - visits)
        if self.rule == "puct":
            bonus = self.prior[node["state"]][a] * math.sqrt(1 + total) / (1 + visits)
        else:
            bonus = math.sqrt(math.log(1 + total) / (1 + visits))
        return self.normalized(node, a) + self.exploration * bonus

    def normalized(self, node: Node, a: int) -> float:
        high, low = max(node["q"]), min(node["q"])
        return (node["q"][a] - high) / max(high - low + 1e-8 * abs(high), 1e-300)

    def sigma(self, node: Node, a: int) -> float:
        return (50 + max(node["visits"])) * 0.1 * self.normalized(node, a)

    def search(self, simulations: int) -> Self:
        """The first simulation is the expansion of the root."""
        left = simulations - 1
        if not self.gumbel:
            for _ in range(left):
                if self.bottom > 1 and any(self.open(self.root, a) for a in range(self.A)):
                    self.simulate(self.root, list(range(self.A)))
            return self
        if self.bottom <= 1:
            return self
        survivors, width, phases = list(range(self.A)), self.A, max(1, math.ceil(math.log2(self.A)))
        for phase in range(phases):
            exhausted = [a for a in range(self.A) if not self.open(self.root, a)]
            survivors = [*self.ranked(survivors), *exhausted][:width]
            last, passes = phase + 1 == phases, max(1, (simulations - 1) // (phases * width))
            while left > 0 and (last or passes > 0) and self.ranked(survivors):
                for a in self.ranked(survivors)[: min(width, left)]:
                    self.simulate(self.root, [a])
                    left -= 1
                passes -= 1
            width = max(2, width // 2)
        return self

    def ranked(self, survivors: list[int]) -> list[int]:
        """The root's actions that are not complete, best first, survivors before the others."""
        scores = [math.log(self.prior[self.root["state"]][a]) + self.sigma(self.root, a) for a in range(self.A)]
        actions = [a for a in range(self.A) if self.open(self.root, a)]
        return sorted(actions, key=lambda a: (a not in survivors, -scores[a], a))

    def root_values(self) -> list[float]:
        return self.root["q"]

    def nodes_per_level(self) -> list[int]:
        answer, level = [1], [self.root]
        for _ in range(self.bottom):
            answer.append(sum(len(node["outcomes"]) for node in level))
            level = [child for node in level for child in node["children"].values()]
        return answer
