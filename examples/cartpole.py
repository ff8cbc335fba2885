"""A network that balances a pole, evaluated while it learns, stopped when it is good enough, saved and loaded."""

import tempfile
from pathlib import Path

from pgts_torch import PGTS, EvalCallback, evaluate

with tempfile.TemporaryDirectory() as folder:
    best = Path(folder) / "best.pt"
    watch = EvalCallback(every=1_000, episodes=10, best_path=best, stop_at_return=475)
    model = PGTS("CartPole-v1", depth=1, policy={"type": "mlp", "hidden": [32, 32]})
    model.learn(20_000, callback=watch)
    print(f"{model.num_env_steps:,} steps")
    print(f"return {evaluate(PGTS.load(best), episodes=20).episodic_return.mean:.0f}")
