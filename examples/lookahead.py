"""The lookahead alone: deeper and deeper from the corner of the paper's grid, until the best action changes."""

import torch

from pgts_torch.models import TabularModel
from pgts_torch.search import Topology, expectimax
from pgts_torch.tabular import exact, grid

mdp = grid()
uniform_SA = torch.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions, dtype=torch.float64)
value_S = exact.policy_values(mdp, uniform_SA)
best = int(exact.optimal(mdp).q_SA[0].argmax())

topology = Topology(TabularModel(mdp))  # remembers what the model has said
for depth in (0, 2, 4, 8, 16, 32):
    look = expectimax(topology.model, torch.tensor([0]), depth=depth, v_leaf=value_S.__getitem__, topology=topology)
    action = int(look.q_BA.argmax())
    print(
        f"depth {depth:>2}: action {action}, {look.model_calls:>3} new model calls"
        + ", as the optimum" * (action == best)
    )
