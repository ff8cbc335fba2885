"""From env.step alone: networks learn the environment, the policy learns in them."""

from pgts_torch import PGTS, evaluate

model = PGTS("CartPole-v1", model="ensemble", depth=1)
print(f"at first: return {evaluate(model, episodes=10).episodic_return.mean:.0f}")
model.learn(500)
print(f"after {model.num_env_steps:,} steps: return {evaluate(model, episodes=10).episodic_return.mean:.0f}")
