"""What an environment does is held to its model."""

from pgts_torch.agent.pgts import PGTS
from pgts_torch.models import SimulatorModel
from pgts_torch.models.base import Model


def test_models_that_claim_to_be_the_environment_are_exact_and_others_are_not_unless_they_say_so():
    assert PGTS("pgts/Ladder-v0").world.model.exact
    assert PGTS("CartPole-v1").world.model.exact
    assert SimulatorModel("FrozenLake-v1", gamma=0.9).exact
    assert not Model.exact
