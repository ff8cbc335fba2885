"""A model of your own in place of the environment's: the cart of MountainCar, written in torch."""

import torch

from pgts_torch import PGTS
from pgts_torch.models import TensorModel


class Car(TensorModel):
    def __init__(self):
        super().__init__(2, num_actions=3, action_repeat=4)

    def step(self, state_ND, action_N):
        position, speed = state_ND.double().unbind(1)
        speed = (speed + (action_N - 1) * 0.001 - 0.0025 * torch.cos(3 * position)).clamp(-0.07, 0.07)
        position = (position + speed).clamp(-1.2, 0.6)
        speed = torch.where((position == -1.2) & (speed < 0), 0.0, speed)
        discount = torch.where((position >= 0.5) & (speed >= 0), 0.0, 0.99)
        return torch.full_like(discount, -1.0).float(), discount.float(), torch.stack([position, speed], 1).float()


model = PGTS("MountainCar-v0", model=Car(), depth=2, model_check="warn")
iteration = model.iterate()
print(f"{iteration.num_steps:,} steps, {iteration.model_calls:,} model calls")
