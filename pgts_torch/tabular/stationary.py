"""Which policies tree search cannot improve: the stationary sets Pi^m of the paper."""

import torch
from jaxtyping import Float
from torch import Tensor

from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP


def gap(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int) -> Float[Tensor, "S"]:
    """How far pi is from being stationary for a lookahead of m = depth.        [PGTS Lemma 2]

        g_m(s) = max_a (T^m Q^pi)(s, a) - v^pi(s) >= 0   where d^pi(s) > 0,   and 0 elsewhere

    pi is in Pi^m if and only if g_m is 0; g_m grows with m, which is Theorem 1.
    """
    evaluation = exact.evaluate(mdp, pi_SA)
    look_SA = exact.lookahead(mdp, evaluation.q_SA, depth)
    gap_S = (look_SA.amax(-1) - evaluation.v_S).clamp(min=0)
    return torch.where(evaluation.d_S > 0, gap_S, 0.0)


def is_stationary(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], depth: int, *, tolerance: float = 1e-9) -> bool:
    """Whether pi is in Pi^m, m = depth: no visited state sees anything better than v^pi.        [PGTS Lemma 2]

    Args:
        tolerance: largest gap that counts as 0, in reward units.
    """
    return bool((gap(mdp, pi_SA, depth) <= tolerance).all())
