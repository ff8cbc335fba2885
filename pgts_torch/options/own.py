"""Parts of the caller's own, which are named, MODULE:NAME, and made by importing that."""

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from pgts_torch.options.fields import KEY, Arguments, Make, checks, conflict
from pgts_torch.options.part import Part


class Own(Part):
    """A part that is made by a class or a function of the caller's own."""

    make: Make = None
    """A class or a function that makes it, MODULE:NAME; its module is imported. MODULE:NAME alone is short for it."""

    arguments: Arguments = Field(default={})
    """Arguments of that class or function, as in --model.arguments.size 7."""

    @checks("make")
    def _is_given(cls, value: Any) -> Any:
        if value is None:
            raise conflict(f"{KEY} is missing; it must be MODULE:NAME, a class or a function that makes it", KEY)
        return value


class OwnModel(Own):
    """A model of your own, whose states are observations."""

    type: Literal["own"] = "own"


class OwnModule(Own):
    """A network of your own: a torch.nn.Module that is made of the space of its inputs and the number of outputs."""

    type: Literal["module"] = "module"

    head: bool = False
    """The module is made of the space alone and returns features, of which a linear layer makes the outputs; such a
    module can be shared. false: it returns the outputs, logits or values."""

    normalize: bool = False
    """Subtract the running mean of vectors, or of each channel, and divide by their running deviation."""


def by_name(value: Any, kind: type[Own]) -> Any:
    """Return the options of a part that is given as a class, a function or MODULE:NAME, or without a type; anything
    else as it is."""
    section = {"type": value} if isinstance(value, str) else {"make": value} if callable(value) else value
    if not isinstance(section, Mapping):
        return value
    own = {"type": kind.model_fields["type"].default}
    if isinstance(name := section.get("type"), str) and ":" in name:
        return {**section, **own, "make": name}
    return {**own, **section} if "make" in section else value
