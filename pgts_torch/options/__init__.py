"""The options of a training. Each class is an argument of `PGTS`, a section of a configuration and a saved value.

    PGTS("CartPole-v1", policy=MLP(hidden=[32]), update=PPO(clip_range=0.1), estimator=SampledAdvantages(), depth=0)

Nothing here imports torch.
"""

from pgts_torch.options.critics import (
    AutoCritic,
    ExactValues,
    MonteCarlo,
    NetworkTDLambda,
    NetworkValues,
    OwnNetwork,
    RolloutValues,
    SharedNetwork,
    TabularValues,
    TDLambda,
)
from pgts_torch.options.models import AutoModel, Counts, Ensemble, GivenModel, Latent
from pgts_torch.options.own import OwnModel, OwnModule
from pgts_torch.options.part import Part
from pgts_torch.options.policies import (
    CNN,
    MLP,
    AutoPolicy,
    Biased,
    Gaussian,
    NatureCNN,
    Random,
    Simplex,
    Softmax,
    Uniform,
)
from pgts_torch.options.replay import AutoReplay, NoReplay, UniformReplay
from pgts_torch.options.rollouts import (
    AutoHorizon,
    FixedHorizon,
    GeometricHorizon,
    LookaheadAdvantages,
    SampledAdvantages,
    StepsHorizon,
)
from pgts_torch.options.search import MCTS, Auto, Expectimax, Sampled
from pgts_torch.options.updates import CMPO, MPO, PPO, AutoUpdate, Gradient, Mirror, Projected, SoftmaxGradient

__all__ = [
    "CMPO",
    "CNN",
    "MCTS",
    "MLP",
    "MPO",
    "PPO",
    "Auto",
    "AutoCritic",
    "AutoHorizon",
    "AutoModel",
    "AutoPolicy",
    "AutoReplay",
    "AutoUpdate",
    "Biased",
    "Counts",
    "Ensemble",
    "ExactValues",
    "Expectimax",
    "FixedHorizon",
    "Gaussian",
    "GeometricHorizon",
    "GivenModel",
    "Gradient",
    "Latent",
    "LookaheadAdvantages",
    "Mirror",
    "MonteCarlo",
    "NatureCNN",
    "NetworkTDLambda",
    "NetworkValues",
    "NoReplay",
    "OwnModel",
    "OwnModule",
    "OwnNetwork",
    "Part",
    "Projected",
    "Random",
    "RolloutValues",
    "Sampled",
    "SampledAdvantages",
    "SharedNetwork",
    "Simplex",
    "Softmax",
    "SoftmaxGradient",
    "StepsHorizon",
    "TDLambda",
    "TabularValues",
    "Uniform",
    "UniformReplay",
]
