"""Options of the update of a policy."""

from typing import Literal

from pgts_torch.options.fields import Clip, Count, Positive
from pgts_torch.options.part import Part, null
from pgts_torch.options.schedules import ScheduledNonNegative, ScheduledPositive

StateWeight = Literal["occupancy", "visits", "uniform"]


class AutoUpdate(Part):
    """By the policy: mirror for softmax, projected for simplex, cmpo for networks, mpo for gaussian; ppo with sampled
    advantages."""

    type: Literal["auto"] = "auto"


class TableUpdate(Part):
    """One step at the visited rows of a table."""

    step_size: ScheduledPositive = 0.1
    """eta, by which the weighted lookahead values are multiplied."""

    state_weight: StateWeight = "occupancy"
    """The weight of a visited state: its discounted occupancy, its fraction of all visits, or 1."""


class Projected(TableUpdate):
    """Euclidean projection onto the simplex, the paper's; needs policy.type simplex."""

    type: Literal["projected"] = "projected"


class SoftmaxGradient(TableUpdate):
    """Gradient in the logits; needs policy.type softmax."""

    type: Literal["softmax"] = "softmax"


class NetworkUpdate(Part):
    """Gradient steps on the parameters of a network."""

    learning_rate: ScheduledPositive = 3e-4
    """Step size of the optimizer."""

    optimizer: Literal["adam", "sgd"] = "adam"
    """Adam, or plain gradient descent."""

    max_grad_norm: Clip = 0.5
    """The norm to which longer gradients are clipped."""

    state_weight: StateWeight = "visits"
    """The weight of a visited state: its discounted occupancy, its fraction of all visits, or 1."""


class Gradient(NetworkUpdate):
    """One step up the gradient of all actions' advantages; needs a network policy."""

    type: Literal["gradient"] = "gradient"

    entropy_coef: ScheduledNonNegative = 0.0
    """The weight of the entropy (in nats), in reward units."""


class Epochs(NetworkUpdate):
    """Many steps, on minibatches of the visited states."""

    num_epochs: Count = 10
    """Passes over the visited states in each iteration."""

    minibatch_size: Count = 64
    """States in each step."""


class PPO(Epochs):
    """Many steps up a clipped objective (Schulman et al. 2017); needs a network policy."""

    type: Literal["ppo"] = "ppo"

    clip_range: ScheduledPositive = 0.2
    """The relative change of an action's probability at which the objective is clipped."""

    entropy_coef: ScheduledNonNegative = 0.0
    """The weight of the entropy (in nats), in units of the advantages."""

    target_kl: Positive | None = None
    """The steps end once KL(pi_old || pi) exceeds this, in nats; null: never."""

    normalize_advantage: bool = True
    """Divide advantages by their root mean square."""


class CMPO(Epochs):
    """Clipped MPO, whose steps do not depend on the scale of rewards (Hessel et al. 2021); needs a network policy and
    the advantages of all actions."""

    type: Literal["cmpo"] = "cmpo"

    learning_rate: ScheduledPositive = 1e-3
    """Step size of the optimizer."""

    temperature: Positive = 0.1
    """By which advantages, in units of their mean size, are divided; smaller temperatures make longer steps."""

    clip: ScheduledPositive = 3.0
    """The largest change of log pi(a|s) in one iteration, before normalisation."""


class MPO(Epochs):
    """Weighted regression on drawn actions within a trust region (Abdolmaleki et al. 2018); needs policy.type gaussian
    and a lookahead. Its steps do not depend on the scale of rewards."""

    type: Literal["mpo"] = "mpo"

    learning_rate: ScheduledPositive = 1e-3
    """Step size of the optimizer."""

    kl: Positive = 0.5
    """By how much the improved policy over drawn actions may differ from the old one, in nats; it decides the
    temperature."""

    kl_mean: Positive = 0.1
    """How far the mean may move in one iteration, in nats."""

    kl_std: Positive = 0.001
    """How far each standard deviation may move in one iteration, in nats. What is looked for must be found before it
    is small: a wide policy leaves a poor way of acting that a narrow one only improves."""


class Mirror(Part):
    """Mirror ascent with the KL divergence; for all policies. The steps of tables do not depend on the scale of the
    rewards."""

    type: Literal["mirror"] = "mirror"

    state_weight: StateWeight | None = null(tables="uniform", networks="visits")
    """The weight of a visited state: its discounted occupancy, its fraction of all visits, or 1."""

    step_size: ScheduledPositive | None = null(tables=1.0)
    """eta, by which the weighted advantages are multiplied. Only for tables, as the next two."""

    normalize: Literal["rms", "none"] | None = null(tables="rms")
    """rms: advantages are divided by their root mean square, or by the standard error of the lookahead where that is
    larger; none: they are in reward units, as in the paper."""

    floor: Clip | None = null(tables=12.0)
    """How far the log of a probability may be below the largest of its state."""

    temperature: Positive | None = null(networks=1.0)
    """By which the lookahead values are divided, in reward units. Only for networks, as all that follow."""

    learning_rate: ScheduledPositive | None = null(networks=3e-4)
    """Step size of the optimizer."""

    optimizer: Literal["adam", "sgd"] | None = null(networks="adam")
    """Adam, or plain gradient descent."""

    max_grad_norm: Clip | None = null(networks=0.5)
    """The norm to which longer gradients are clipped."""

    num_epochs: Count | None = null(networks=10)
    """Passes over the visited states in each iteration."""

    minibatch_size: Count | None = null(networks=64)
    """States in each step."""


Update = Projected | SoftmaxGradient | Mirror | Gradient | PPO | CMPO | MPO
