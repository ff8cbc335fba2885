"""The paper in the exact world: policies that no update can improve, depth by depth, and Algorithm 1."""

import torch

from pgts_torch.tabular import ascent, exact, ladder, stationary_sets

mdp = ladder(5)
sets = stationary_sets.enumerate_sets(mdp)
for depth in range(sets.sufficient_depth + 1):
    print(
        f"depth {depth}: {sets.count(depth):>2} stationary policies, the worst has J = {sets.worst_return(depth):.2f}"
    )

left_SA = torch.tensor([[0.99, 0.01]], dtype=torch.float64).expand(mdp.num_states, 2)
for depth in (0, 4):
    trained = ascent.ascend(mdp, left_SA, depth=depth, step_size=1.0, iterations=300)
    print(f"depth {depth}: J = {exact.evaluate(mdp, trained.pi_SA).J:.2f} after 300 updates")
print(f"J* = {exact.optimal(mdp).J:.2f}, J of the start = {exact.evaluate(mdp, left_SA).J:.2f}")
