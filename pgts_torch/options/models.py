"""Options of the model that a lookahead queries."""

from typing import Any, Literal

from pydantic import Field, ValidationInfo

from pgts_torch.options.fields import Ascending, Between, Count, NonNegative, Positive, Share, Sizes, checks, conflict
from pgts_torch.options.own import OwnModel
from pgts_torch.options.part import Part, null
from pgts_torch.options.policies import CNN, NatureCNN


class AutoModel(Part):
    """The given model, if the environment has one."""

    type: Literal["auto"] = "auto"


class GivenModel(Part):
    """What is known of the environment: its table, its dynamics in torch, or a simulator that is restored from
    snapshots."""

    type: Literal["given"] = "given"


class Counts(Part):
    """A table that counts what followed each state and action; needs numbered states."""

    type: Literal["counts"] = "counts"

    optimism: Literal["rmax", "bonus", "prior", "posterior", "none"] = "prior"
    """The probability u of an unknown outcome after n visits to a state and action: 1 for n = 0, and then, with c =
    strength (K - 1) and K the largest number of outcomes that any of them has had, rmax: 1 up to c visits, else 0;
    bonus: c / sqrt(n), at most 1; prior: c / (n + c); posterior: sampled, as the probabilities of all outcomes are,
    from a Dirichlet distribution with c for the unknown; none: 0. An unknown outcome is worth the upper end of the
    value range, or somewhat more where that follows from rewards; with none, the lower end."""

    strength: Positive | None = null(rmax=4.0, bonus=0.3, prior=1.0, posterior=1.0)
    """How many more visits each further outcome asks for. Where nothing has had two outcomes, it is divided by 1 + the
    number of states and actions that were visited more than once: the more of them were certain, the more are."""

    value_range: Ascending | None = None
    """The lowest and the highest value of a state, in reward units; null: what the rewards seen so far allow."""

    confidence: Share | None = None
    """The probability with which the error that is stated of the table, for search.doubt, is not exceeded anywhere,
    however it was learned; null: none is stated. It needs model.value_range, and a step from any value of it to stay in
    it."""

    certificate: Between | None = None
    """The posterior probability with which certificates hold, upper bounds on the optimality gap of the trained policy:
    whenever a tenth more steps were taken, and at the end, it is bounded in tables that are sampled from what the
    counts leave possible (search/certificate_posterior), which proves nothing; null: there are none. It needs
    model.value_range, as model.confidence does."""

    @checks("confidence", "certificate")
    def _has_range(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("value_range", ...) is None:
            raise conflict(
                f"model.{info.field_name} is {value}, which needs model.value_range: rewards seen so far bound nothing"
            )
        return value

    @checks("strength")
    def _has_optimism(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("optimism") == "none":
            raise conflict(f"model.strength is {value}, which model.optimism none does not use")
        return value


class Ensemble(Part):
    """Networks that learn from the steps of the environment alone what follows a vector of numbers and an action: the
    next vector, the reward, and whether the episode ends (Chua et al. 2018)."""

    type: Literal["ensemble"] = "ensemble"

    members: Count = 3
    """The number of networks. Each has its own initial weights, minibatches and bootstrap sample of the steps."""

    hidden: Sizes = Field(default=[64, 64])
    """Sizes of the hidden layers of each network."""

    max_disagreement: Share = 0.2
    """An imagined episode is cut off before a step on which the members differ by more: the largest difference of their
    probabilities of an end, plus that of their next vectors, in standard deviations of what was seen (root mean square
    over the numbers of a vector); 1: never, as with repeated actions."""

    learning_rate: Positive = 3e-3
    """Step size of Adam."""

    weight_decay: NonNegative = 1e-5
    """The weight of the squared weights in the loss."""

    minibatch_size: Count = 256
    """Steps of the environment in each gradient step, for each member."""

    updates_per_step: Positive = 2.0
    """Gradient steps for each environment step."""

    first_updates: Count = 600
    """Gradient steps after the first rollouts."""


class AutoNetwork(Part):
    """A cnn, with strides where images are large."""

    type: Literal["auto"] = "auto"


class Latent(Part):
    """Networks that learn from the steps of the environment alone to represent an image as a vector, and what follows a
    vector and an action: the next vector, the reward, and whether the episode ends (Schrittwieser et al. 2020)."""

    type: Literal["latent"] = "latent"

    network: AutoNetwork | CNN | NatureCNN = Field(default=AutoNetwork(), discriminator="type")
    """The network that represents images."""

    size: Count = 64
    """Numbers of a vector."""

    hidden: Sizes = Field(default=[128])
    """Sizes of the hidden layers of the network that steps vectors."""

    unroll: Count = 5
    """Steps that are predicted one after another in each gradient step."""

    learning_rate: Positive = 2e-3
    """Step size of Adam."""

    minibatch_size: Count = 32
    """Sequences of steps of the environment in each gradient step."""

    updates_per_step: Positive = 0.5
    """Gradient steps for each environment step."""

    first_updates: Count = 500
    """Gradient steps after the first rollouts."""


Model = AutoModel | GivenModel | Counts | Ensemble | Latent | OwnModel
"""Options of the model."""

LEARNED = (Counts, Ensemble, Latent)
"""Those that learn from the steps of the environment."""
