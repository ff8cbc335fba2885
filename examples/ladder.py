"""Out of a trap: a policy that starts 99 % left, on a ladder whose only reward is at the top."""

from pgts_torch import PGTS, evaluate
from pgts_torch.tabular import exact

left = {"type": "softmax", "init": {"type": "biased", "action": 0, "probability": 0.99}}

for depth in (0, 2, 4):
    model = PGTS("pgts/Ladder-v0", policy=left, depth=depth).learn(10_000)
    best = exact.optimal(model.mdp).J
    print(f"depth {depth}: {evaluate(model, episodes=20).discounted_return.mean:.2f} of {best:.2f}")
