"""Options of models that are learned from the steps of the environment."""

from typing import Any, Literal

from pydantic import ValidationInfo, field_validator

from pgts_torch.options.fields import Ascending, Positive, conflict
from pgts_torch.options.part import Part, null


class Counts(Part):
    """A table that counts what followed each state and action; needs numbered states."""

    type: Literal["counts"] = "counts"

    optimism: Literal["rmax", "bonus", "prior", "posterior", "none"] = "posterior"
    """The probability u of an unknown outcome after n visits to a state and action: 1 for n = 0, and then, with c =
    strength (K - 1) and K the largest number of outcomes that any of them has had, rmax: 1 below 1 + c visits, else 0;
    bonus: c / sqrt(n), at most 1; prior: c / (n + c); posterior: sampled, with that mean, as the probabilities of all
    outcomes are; none: 0. An unknown outcome is worth the upper end of the value range; with none, the lower end."""

    strength: Positive | None = null(rmax=4.0, bonus=0.1, prior=0.2, posterior=0.2)
    """How many more visits each further outcome asks for. Where nothing has had two outcomes, one visit is enough."""

    value_range: Ascending | None = None
    """The lowest and the highest value of a state, in reward units; null: what the rewards seen so far allow."""

    @field_validator("strength")
    @classmethod
    def _has_optimism(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("optimism") == "none":
            raise conflict(f"model.strength is {value}, which model.optimism none does not use")
        return value
