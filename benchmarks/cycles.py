"""Does training with the default step of tables ever go round? Small deterministic MDPs, exact quantities, fixed depth.

    python benchmarks/cycles.py [--mdps N] [--iterations K] [--quick]

Samples MDPs of 3 to 5 states and 2 actions, gamma 0.9, rewards in {-1, 0, 1}, and takes the default mirror step at the
states with d(s) > 1e-6, with exact d and T^m Q, from the uniform policy or random logits in [-12, 0]. Restless: the
policy at a visited state still moves by more than 0.01 in each of the last 40 iterations. Low: J falls, in one of
these, below 99 % of the way from the uniform policy to J*.
"""

import argparse
import itertools

import torch
from torch import Tensor

from pgts_torch.seeding import numpy_stream
from pgts_torch.tabular.ascent import floored

GAMMA, LAST, SEEN = 0.9, 40, 1e-6


class Batch:
    """M deterministic MDPs of S states and 2 actions: `child_MSA`, `reward_MSA`; episodes start in state 0."""

    def __init__(self, count: int, S: int) -> None:
        random = numpy_stream(0, "cycles", S)
        self.child_MSA = torch.from_numpy(random.integers(0, S, size=(count, S, 2)))
        self.reward_MSA = torch.from_numpy(random.integers(-1, 2, size=(count, S, 2))).double()
        self.step_MSAS = torch.nn.functional.one_hot(self.child_MSA, S).double()

    def backup(self, v_MS: Tensor) -> Tensor:
        """r(s, a) + gamma v(s')."""
        return self.reward_MSA + GAMMA * (self.step_MSAS @ v_MS[:, None, :, None]).squeeze(-1)

    def evaluate(self, pi_MSA: Tensor) -> tuple[Tensor, Tensor]:
        """v^pi, and d^pi from state 0."""
        within_MSS = torch.eye(pi_MSA.shape[1]).double() - GAMMA * (pi_MSA[..., None] * self.step_MSAS).sum(2)
        start_MS = torch.zeros_like(pi_MSA[..., 0])
        start_MS[:, 0] = 1
        v_MS = torch.linalg.solve(within_MSS, (pi_MSA * self.reward_MSA).sum(-1))
        return v_MS, torch.linalg.solve(within_MSS.mT, start_MS)


def moved(log_MSA: Tensor, pi_MSA: Tensor, look_MSA: Tensor, seen_MS: Tensor) -> Tensor:
    """The logits after the default step of each MDP, with one scale over the seen states of each."""
    rounding_M11 = 16 * torch.finfo(torch.float64).eps * look_MSA.abs().amax((1, 2), keepdim=True)
    below_MSA = look_MSA - look_MSA.amax(-1, keepdim=True)
    advantage_MSA = below_MSA - (pi_MSA * below_MSA).sum(-1, keepdim=True)
    advantage_MSA = torch.where(advantage_MSA.abs() > rounding_M11, advantage_MSA, 0.0)
    square_MS = (pi_MSA * advantage_MSA.square()).sum(-1) * seen_MS
    scale_M11 = (square_MS.sum(-1) / seen_MS.sum(-1)).sqrt()[:, None, None]
    moves = (advantage_MSA != 0).any(-1, keepdim=True)
    next_MSA = floored(log_MSA, advantage_MSA / torch.where(scale_M11 > 0, scale_M11, 1.0), 12.0)
    return torch.where(moves, next_MSA, log_MSA)


def search(batch: Batch, depth: int, iterations: int, *, is_random: bool) -> tuple[Tensor, Tensor, Tensor]:
    """J in the last iterations [K, M]; which are low, and which never came to rest [M]."""
    log_MSA = torch.zeros_like(batch.reward_MSA)
    if is_random:
        log_MSA -= 12 * torch.from_numpy(numpy_stream(1, "cycles").random(log_MSA.shape))
    J_KM: list[Tensor] = []
    restless_M = torch.ones(len(log_MSA), dtype=torch.bool)
    for k in range(iterations):
        pi_MSA = log_MSA.softmax(-1)
        v_MS, d_MS = batch.evaluate(pi_MSA)
        look_MSA = batch.backup(v_MS)
        for _ in range(depth):
            look_MSA = batch.backup(look_MSA.amax(-1))
        seen_MS = d_MS > SEEN
        log_MSA = torch.where(seen_MS[..., None], moved(log_MSA, pi_MSA, look_MSA, seen_MS), log_MSA)
        if k >= iterations - LAST:
            J_KM.append(v_MS[:, 0])
            restless_M &= ((log_MSA.softmax(-1) - pi_MSA).abs() * seen_MS[..., None]).amax((1, 2)) > 0.01
    best_MS = torch.zeros_like(v_MS)
    for _ in range(400):
        best_MS = batch.backup(best_MS).amax(-1)
    uniform_MS, _ = batch.evaluate(torch.full_like(log_MSA, 0.5))
    lack_M = (best_MS - torch.stack(J_KM).amin(0)[:, None])[:, 0]
    return torch.stack(J_KM), lack_M > 0.01 * (best_MS - uniform_MS)[:, 0] + 1e-9, restless_M


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--mdps", type=int, default=1000, help="of each size")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--quick", action="store_true", help="50 of each size")
    given = parser.parse_args()
    torch.set_num_threads(1)
    print("start    states  depth   MDPs  restless  and low  low in all")
    for S in (3, 4, 5):
        batch = Batch(50 if given.quick else given.mdps, S)
        for start, depth in itertools.product(("uniform", "random"), (0, 1, 2, 4)):
            J_KM, low_M, restless_M = search(batch, depth, given.iterations, is_random=start == "random")
            both_M = low_M & restless_M
            print(
                f"{start:8} {S:6} {depth:6} {len(low_M):6} {restless_M.sum():9} {both_M.sum():8} {low_M.sum():11}",
                flush=True,
            )
            for m in both_M.nonzero().flatten()[:1].tolist():
                table = f"next states {batch.child_MSA[m].tolist()}, rewards {batch.reward_MSA[m].int().tolist()}"
                print(f"       {table}: J {[round(x, 3) for x in J_KM[-8:, m].tolist()]}")


if __name__ == "__main__":
    main()
