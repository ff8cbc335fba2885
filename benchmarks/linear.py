"""Linear dynamics with quadratic rewards, whose lookahead values have a closed form."""

from typing import Self, final

import torch
from jaxtyping import Float, Num
from torch import Tensor

from pgts_torch.models.tensor import TensorModel


@final
class LinearQuadratic(TensorModel):
    """s' = F s + G a,    r(s, a) = -(s^T M s + a^T N a),    never an end.

    For v(s) = -s^T P s, positive semidefinite P, both of these are of the same form (Riccati):

        q(s, a) = r(s, a) + gamma v(s')
        (T v)(s) = max_a q(s, a) = -s^T P' s,
            P' = M + gamma F^T P F - gamma^2 F^T P G (N + gamma G^T P G)^-1 G^T P F

    Args:
        F_DD, G_DX, M_DD, N_XX: the matrices; N is positive definite.
        action_AX: the actions, in the order of their numbers; None: actions are vectors.
    """

    def __init__(
        self,
        F_DD: Float[Tensor, "D D"],
        G_DX: Float[Tensor, "D X"],
        M_DD: Float[Tensor, "D D"],
        N_XX: Float[Tensor, "X X"],
        *,
        gamma: float,
        action_AX: Float[Tensor, "A X"] | None = None,
    ) -> None:
        count = 0 if action_AX is None else len(action_AX)
        super().__init__(len(F_DD), count, state_dtype=torch.float64, dtype=torch.float64)
        self.F_DD, self.G_DX, self.M_DD, self.N_XX = (matrix.double() for matrix in (F_DD, G_DX, M_DD, N_XX))
        self.gamma, self._action_AX = gamma, action_AX

    @classmethod
    def double_integrator(cls, *, gamma: float, action_AX: Float[Tensor, "A X"] | None = None) -> Self:
        """A point whose force is chosen: position and speed, in steps of 0.5."""
        F_DD, G_DX = torch.tensor([[1.0, 0.5], [0.0, 1.0]]), torch.tensor([[0.125], [0.5]])
        return cls(F_DD, G_DX, torch.diag(torch.tensor([1.0, 0.1])), torch.eye(1) / 2, gamma=gamma, action_AX=action_AX)

    def step(
        self, state_ND: Num[Tensor, "N D"], action_N: Num[Tensor, "N ..."]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"], Float[Tensor, "N D"]]:
        action_NX = (action_N if self._action_AX is None else self._action_AX[action_N]).double()
        reward_N = -(_form(self.M_DD, state_ND) + _form(self.N_XX, action_NX))
        return reward_N, torch.full_like(reward_N, self.gamma), state_ND @ self.F_DD.T + action_NX @ self.G_DX.T

    def v(self, P_DD: Float[Tensor, "D D"], state_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N"]:
        """-s^T P s."""
        return -_form(P_DD, state_ND)

    def q(
        self, P_DD: Float[Tensor, "D D"], state_ND: Float[Tensor, "N D"], action_NX: Float[Tensor, "N X"]
    ) -> Float[Tensor, "N"]:
        """r(s, a) + gamma v(s')."""
        after_ND = state_ND @ self.F_DD.T + action_NX.double() @ self.G_DX.T
        reward_N = -(_form(self.M_DD, state_ND) + _form(self.N_XX, action_NX.double()))
        return reward_N + self.gamma * self.v(P_DD, after_ND)

    def improved(self, P_DD: Float[Tensor, "D D"]) -> Float[Tensor, "D D"]:
        """P', of T v."""
        ahead_XD = self.gamma * self.G_DX.T @ P_DD @ self.F_DD
        price_XX = self.N_XX + self.gamma * self.G_DX.T @ P_DD @ self.G_DX
        return (
            self.M_DD
            + self.gamma * self.F_DD.T @ P_DD @ self.F_DD
            - ahead_XD.T @ torch.linalg.solve(price_XX, ahead_XD)
        )

    def optimal(self) -> Float[Tensor, "D D"]:
        """P*, of v*, by iteration."""
        P_DD = self.M_DD
        while bool(((after_DD := self.improved(P_DD)) - P_DD).abs().max() > 1e-13 * after_DD.abs().max()):
            P_DD = after_DD
        return P_DD


def _form(matrix_DD: Float[Tensor, "D D"], x_ND: Float[Tensor, "N D"]) -> Float[Tensor, "N"]:
    return torch.einsum("nd,de,ne->n", x_ND, matrix_DD, x_ND)
