"""Pictures of a tabular policy and its values."""

from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from pgts_torch.envs.drawing import DIRECTIONS, MOST_OUTLINED
from pgts_torch.tabular import exact
from pgts_torch.tabular.mdp import TabularMDP

FEW = 20
"""Up to so many states values are written in a large font, and all states are numbered."""

NUMBER_WIDTH = 0.45
"""The width of a probability in inches."""


def policy_picture(mdp: TabularMDP, pi_SA: Float[Tensor, "S A"], *, title: str = "") -> Figure:
    """Return a figure of v^pi, as colours over the states laid out as `mdp.shape`, and of pi beside it.

    Where actions are directions in a two-dimensional layout pi is drawn as arrows, else as a column of probabilities
    for each state. Start states are outlined, states that pi does not visit are pale.
    """
    evaluation = exact.evaluate(mdp, pi_SA)
    rows, columns = mdp.shape
    wide = columns > 3 * rows
    size = (min(3 + 0.7 * columns, 12), 5) if wide else (11, 5)
    figure = Figure(figsize=size, layout="constrained")
    value_axes, policy_axes = figure.subplots(2, 1) if wide else figure.subplots(1, 2)
    _draw_values(value_axes, mdp, evaluation.v_S, evaluation.d_S > 0)
    if rows > 1 and all(name in DIRECTIONS for name in mdp.action_names):
        _draw_arrows(policy_axes, mdp, pi_SA, evaluation.d_S > 0)
    else:
        _draw_columns(policy_axes, mdp, pi_SA, width=size[0] if wide else size[0] / 2)
    figure.suptitle(f"{title}   J = {evaluation.J:.4g}".strip())
    return figure


def _draw_values(axes: Axes, mdp: TabularMDP, v_S: Tensor, visited_S: Tensor) -> None:
    rows, columns = mdp.shape
    aspect: Literal["auto", "equal"] = "auto" if columns > 3 * rows else "equal"
    image = axes.imshow(v_S.view(rows, columns).numpy(), cmap="viridis", aspect=aspect)
    axes.figure.colorbar(image, ax=axes, label="reward units")
    _draw_marks(axes, mdp)
    if mdp.num_states <= 100:
        low, high = float(v_S.min()), float(v_S.max())
        digits, size = (3, 9) if mdp.num_states <= FEW else (2, 7)
        for s, value in enumerate(v_S.tolist()):
            color = "w" if value < (low + high) / 2 else "k"
            style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": size, "color": color}
            axes.text(s % columns, s // columns, f"{value:.{digits}g}", alpha=1 if visited_S[s] else 0.5, **style)
    axes.set_title("value of the policy, v(s)")


def _draw_arrows(axes: Axes, mdp: TabularMDP, pi_SA: Tensor, visited_S: Tensor) -> None:
    rows, columns = mdp.shape
    state = np.arange(mdp.num_states)
    shade = np.where(visited_S.numpy(), 1.0, 0.25)
    for a, name in enumerate(mdp.action_names):
        dx, dy = DIRECTIONS[name]
        length = 0.45 * pi_SA[:, a].numpy()
        style: dict[str, Any] = {
            "angles": "xy",
            "scale_units": "xy",
            "scale": 1,
            "color": "C0",
            "width": 0.004,
            "headwidth": 4,
        }
        axes.quiver(state % columns, state // columns, dx * length, dy * length, alpha=shade, **style)
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.set_aspect("equal")
    _draw_marks(axes, mdp)
    axes.set_title("policy, arrow length is probability")


def _draw_columns(axes: Axes, mdp: TabularMDP, pi_SA: Tensor, *, width: float) -> None:
    """Draw pi as a column of probabilities for each state; `width`: of the figure, in inches."""
    image = axes.imshow(pi_SA.T.numpy(), cmap="Blues", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    axes.figure.colorbar(image, ax=axes, label="probability")
    axes.set_yticks(range(mdp.num_actions), mdp.action_names)
    axes.set_xlabel("state")
    if mdp.num_states <= FEW:
        axes.set_xticks(range(mdp.num_states))
    if mdp.num_states * NUMBER_WIDTH <= width:
        for s in range(mdp.num_states):
            for a in range(mdp.num_actions):
                p = float(pi_SA[s, a])
                axes.text(s, a, f"{p:.2f}", ha="center", va="center", fontsize=8, color="w" if p > 0.5 else "k")
    axes.set_title("policy")


def _draw_marks(axes: Axes, mdp: TabularMDP) -> None:
    """Outline the start states, unless all states or more than `MOST_OUTLINED` are."""
    columns = mdp.shape[1]
    starts = torch.nonzero(mdp.start_S).flatten().tolist()
    if len(starts) < mdp.num_states and len(starts) <= MOST_OUTLINED:
        for s in starts:
            corner = (s % columns - 0.5, s // columns - 0.5)
            axes.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor="tab:orange", linewidth=2.5))
    axes.set_xticks([])
    axes.set_yticks([])
