"""How often do the intervals of a sampled lookahead hold T^m Q?

    python benchmarks/intervals.py [--quick]

Random MDPs of 12 states and 2 actions in which every action has two outcomes, a likely and an unlikely one. Leaf values
are those of a random policy (values), or 0 and the highest, so that what is sampled is a Bernoulli variable (prizes).
The unlikely outcome has a probability between 0 and 1/2 (even), or of 0.02 to 0.1 (rare).
"""

import argparse

import numpy as np
import torch

from pgts_torch.bellman import Outcomes, backup
from pgts_torch.models import TabularModel
from pgts_torch.search.sampled import sampled
from pgts_torch.seeding import numpy_stream, stream
from pgts_torch.tabular import TabularMDP, exact

STATES, ACTIONS, GAMMA = 12, 2, 0.9
SAMPLES, DEPTHS = (2, 4, 8, 16), (0, 1, 2, 3)
UNLIKELY = {"even": (0.0, 0.5), "rare": (0.02, 0.1)}


def case(kind: str, chance: str, mdps: int) -> tuple[TabularMDP, torch.Tensor]:
    """So many MDPs side by side, as one in which no state of one leads to another, and the values at the leaves."""
    random = numpy_stream(0, "coverage", kind, chance)
    S = mdps * STATES
    p_SA = random.uniform(*UNLIKELY[chance], size=(S, ACTIONS))
    first_S11 = (np.arange(S) // STATES * STATES)[:, None, None]
    outcomes = Outcomes(
        torch.from_numpy(random.uniform(0, 1, (S, ACTIONS)) * (kind == "values")),
        torch.from_numpy(np.stack([p_SA, 1 - p_SA], -1)),
        torch.full((S, ACTIONS, 2), GAMMA, dtype=torch.float64),
        torch.from_numpy(first_S11 + random.integers(0, STATES, size=(S, ACTIONS, 2))),
        S,
    )
    mdp = TabularMDP(outcomes, torch.full((S,), 1 / S, dtype=torch.float64))
    if kind == "prizes":
        return mdp, torch.from_numpy(random.integers(0, 2, S).astype(np.float64))
    return mdp, exact.policy_values(mdp, torch.from_numpy(random.dirichlet(np.ones(ACTIONS), size=S)))


def covered(kind: str, chance: str, depth: int, samples: int, mdps: int) -> tuple[float, float, float]:
    """Which share of all q of all MDPs lies in its interval, their mean width in units of the range of values, and
    which share lies within 1.96 standard errors."""
    mdp, v_S = case(kind, chance, mdps)
    model = TabularModel(mdp)
    if kind == "prizes":
        model.lowest_value, model.highest_value = 0.0, 1.0
    every, generator = torch.arange(mdp.num_states), stream(0, "coverage")
    look = sampled(model, every, depth=depth, v_leaf=lambda s: v_S[s], samples=samples, generator=generator)
    truth_SA = exact.lookahead(mdp, backup(mdp.outcomes, v_S), depth)
    low, high = look.interval()
    # Where all samples are the truth itself it is missed by rounding only.
    held_SA = (low <= truth_SA + 1e-12) & (truth_SA <= high + 1e-12)
    normal_SA = (look.q_BA - truth_SA).abs() <= 1.96 * look.stderr_BA + 1e-12
    width = (high - low).mean() / (model.highest_value - model.lowest_value)
    return float(held_SA.double().mean()), float(width), float(normal_SA.double().mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer MDPs")
    mdps = 20 if parser.parse_args().quick else 400
    print(f"{mdps} MDPs of each kind; how often the 95 % interval holds T^m Q, and (its mean width / range of values);")
    print("1.96 stderr: how often q -+ 1.96 stderr does at m = 0")
    print(
        f"{'leaves':<10}{'chance':<8}{'C':>3}"
        + "".join(f"{f'm = {depth}':>16}" for depth in DEPTHS)
        + f"{'1.96 stderr':>13}"
    )
    for kind in ("values", "prizes"):
        for chance in UNLIKELY:
            for samples in SAMPLES:
                cells = [covered(kind, chance, depth, samples, mdps) for depth in DEPTHS]
                shown = "".join(f"{f'{held:.1%} ({width:.2f})':>16}" for held, width, _ in cells)
                print(f"{kind:<10}{chance:<8}{samples:>3}{shown}{cells[0][2]:>13.1%}", flush=True)


if __name__ == "__main__":
    main()
