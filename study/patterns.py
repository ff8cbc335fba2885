"""Stationary sets of all policies of two-action MDPs, stochastic ones too, decided pattern by pattern.

A pattern says of each state whether its policy never, sometimes or always takes action 1: one character of `0x1` a
state, as in the paper's pi_{xy0z0} with x, y, z strictly between 0 and 1. All policies of a pattern visit the same
states. Numbers are fractions, so that a gap is 0 or is not, whatever its size.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import torch

from pgts_torch.errors import PgtsError
from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular.mdp import TabularMDP

NEVER, SOMETIMES, ALWAYS = "0", "x", "1"

LARGEST_DENOMINATOR = 10**6
"""Rewards, probabilities and discounts are read as the nearest fraction up to this: 0.9 is 9/10."""

INTERIOR = tuple(map(Fraction, ("1/1000", "1/10", "1/2", "9/10", "999/1000")))
"""Interior probabilities that are tried in all states at once, and mixed."""

MIXED = 6
"""How many policies with probabilities that differ from state to state are tried."""

BISECTIONS = 44
"""Narrow an interval to 6e-14, in which there is one fraction up to LARGEST_DENOMINATOR."""

STEP_ASIDE = Fraction(1, 10**9)
"""Beside a threshold, membership is checked this far away."""


@dataclass(frozen=True)
class Membership:
    """Which policies of a pattern are in Pi^m: all, none, or some.

    If one probability decides, `state` says whose it is, `threshold` its critical value, and `below` whether the
    stationary ones lie below it. The threshold itself is stationary, as Pi^m is closed.
    """

    verdict: Literal["all", "none", "some"]
    state: int | None = None
    threshold: Fraction | None = None
    below: bool | None = None


def patterns(num_states: int) -> Iterator[str]:
    """All 3^S patterns."""
    return ("".join(marks) for marks in itertools.product(NEVER + SOMETIMES + ALWAYS, repeat=num_states))


def memberships(mdp: TabularMDP, pattern: str, depths: int) -> list[Membership]:
    """The membership of a pattern in Pi^0 .. Pi^{depths - 1}.        [PGTS Table 1]

    Decided on policies with interior probabilities from 1/1000 to 999/1000, equal and mixed. That is a proof where the
    answer is "some"; "all" and "none" hold for the policies tried.

    Raises:
        PgtsError: the MDP has not two actions, or the pattern does not fit it.
    """
    exact = _Fractions.of(mdp)
    if len(pattern) != mdp.num_states or set(pattern) - {NEVER, SOMETIMES, ALWAYS}:
        raise PgtsError(f"pattern is {pattern!r}; it must be {mdp.num_states} characters of 0, x and 1")
    tried = _policies(pattern)
    verdicts = [exact.stationary_depths(right_S, depths) for right_S in tried]
    return [_membership(exact, pattern, tried, [row[m] for row in verdicts], m) for m in range(depths)]


def _membership(
    exact: "_Fractions", pattern: str, tried: list[tuple[Fraction, ...]], member: list[bool], depth: int
) -> Membership:
    if len(set(member)) == 1:
        return Membership("all" if member[0] else "none")
    found = [_threshold(exact, tried, s, depth) for s, mark in enumerate(pattern) if mark == SOMETIMES]
    deciding = [answer for answer in found if answer is not None]
    return deciding[0] if len(deciding) == 1 else Membership("some")


def _threshold(exact: "_Fractions", tried: list[tuple[Fraction, ...]], state: int, depth: int) -> Membership | None:
    """The critical probability of one state, if it is the same whatever the other states do; else None."""

    def member(right_S: tuple[Fraction, ...], probability: Fraction) -> bool:
        return exact.stationary_depths((*right_S[:state], probability, *right_S[state + 1 :]), depth + 1)[depth]

    low, high = INTERIOR[0], INTERIOR[-1]
    below = member(tried[0], low)
    if member(tried[0], high) == below:
        return None
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if member(tried[0], middle) == below else (low, middle)
    threshold = ((low + high) / 2).limit_denominator(LARGEST_DENOMINATOR)
    expected = {threshold - STEP_ASIDE: below, threshold: True, threshold + STEP_ASIDE: not below}
    if any(member(right_S, p) != answer for right_S in tried for p, answer in expected.items()):
        return None
    return Membership("some", state, threshold, below)


def _policies(pattern: str) -> list[tuple[Fraction, ...]]:
    """Policies of the pattern: all x alike, then x mixed at random."""
    free = pattern.count(SOMETIMES)
    random = numpy_stream(0, "patterns", pattern)
    mixed = [[INTERIOR[k] for k in random.integers(0, len(INTERIOR), size=free)] for _ in range(MIXED)]
    fillings = dict.fromkeys(map(tuple, [[value] * free for value in INTERIOR] + mixed))
    return [_filled(pattern, values) for values in fillings]


def _filled(pattern: str, values: tuple[Fraction, ...]) -> tuple[Fraction, ...]:
    rest = iter(values)
    return tuple(next(rest) if mark == SOMETIMES else Fraction(mark) for mark in pattern)


@dataclass(frozen=True)
class _Fractions:
    """A two-action MDP in fractions: reward[s][a], successors[s][a] as {child: p gamma}, and the start states."""

    reward: list[list[Fraction]]
    successors: list[list[dict[int, Fraction]]]
    starts: list[int]

    @classmethod
    def of(cls, mdp: TabularMDP) -> "_Fractions":
        if mdp.num_actions != 2:
            raise PgtsError(f"the MDP has {mdp.num_actions} actions; patterns are those of two")
        reward = [[_fraction(r) for r in row] for row in mdp.outcomes.reward_NA.tolist()]
        weight_SAS = mdp.outcomes.weight.to_dense().view(mdp.num_states, 2, mdp.num_states)
        successors = [
            [{t: _fraction(w) for t, w in enumerate(row) if w} for row in rows] for rows in weight_SAS.tolist()
        ]
        return cls(reward, successors, torch.nonzero(mdp.start_S).flatten().tolist())

    def stationary_depths(self, right_S: Sequence[Fraction], depths: int) -> list[bool]:
        """For each m below `depths` whether the policy is in Pi^m: whether T^{m+1} v = v where it goes."""
        v = self._values(right_S)
        visited, best, answer = self._visited(right_S), v, []
        for _ in range(depths):
            best = [max(self._backups(s, best)) for s in range(len(v))]
            answer.append(all(best[s] == v[s] for s in visited))
        return answer

    def _backups(self, s: int, v: list[Fraction]) -> list[Fraction]:
        """r(s, a) + gamma sum_s' P(s'|s, a) v(s') for both actions."""
        return [
            reward + sum((w * v[t] for t, w in successors.items() if v[t]), Fraction(0))
            for reward, successors in zip(self.reward[s], self.successors[s], strict=True)
        ]

    def _visited(self, right_S: Sequence[Fraction]) -> set[int]:
        visited, frontier = set(self.starts), list(self.starts)
        while frontier:
            s = frontier.pop()
            taken = [a for a, p in enumerate((1 - right_S[s], right_S[s])) if p]
            new = {t for a in taken for t in self.successors[s][a]} - visited
            visited |= new
            frontier += new
        return visited

    def _values(self, right_S: Sequence[Fraction]) -> list[Fraction]:
        """v^pi by Gauss-Jordan elimination of (I - gamma P^pi) v = R^pi."""
        S = len(self.reward)
        rows = [self._equation(s, right_S[s]) for s in range(S)]
        for s in range(S):
            # Fractions do not round, so any pivot that is not 0 will do.
            pivot = next(t for t in range(s, S) if rows[t][s])
            rows[s], rows[pivot] = rows[pivot], rows[s]
            rows[s] = [x / rows[s][s] if x else x for x in rows[s]]
            for t in range(S):
                if t != s and (factor := rows[t][s]):
                    rows[t] = [x - factor * y if y else x for x, y in zip(rows[t], rows[s], strict=True)]
        return [row[S] for row in rows]

    def _equation(self, s: int, right: Fraction) -> list[Fraction]:
        """Row s of (I - gamma P^pi | R^pi)."""
        S = len(self.reward)
        row = [Fraction(s == t) for t in range(S)] + [Fraction(0)]
        for a, p in enumerate((1 - right, right)):
            if p:
                row[S] += p * self.reward[s][a]
                for t, w in self.successors[s][a].items():
                    row[t] -= p * w
        return row


def _fraction(number: float) -> Fraction:
    return Fraction(number).limit_denominator(LARGEST_DENOMINATOR)
