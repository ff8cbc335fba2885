"""The base class of all options."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pgts_torch.errors import PgtsError
from pgts_torch.options.mistakes import explain


class Part(BaseModel):
    """Options that belong together, as a frozen pydantic model.

    The docstring under a field is its meaning in `pgts train --help`, its annotation the range there and in messages.

    Raises:
        PgtsError: one line for each option that is unknown or out of range.
    """

    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        validate_default=True,
        use_attribute_docstrings=True,
    )

    if not TYPE_CHECKING:  # type checkers see the fields

        def __init__(self, **options: Any) -> None:
            try:
                super().__init__(**options)
            except ValidationError as error:
                lines = dict.fromkeys(f"{type(self).__name__}: {each.message}" for each in explain(type(self), error))
                raise PgtsError("\n".join(lines)) from None

        # Makes pydantic validate nested options at once, with the path of each mistake.
        __init__.__pydantic_base_init__ = True

    @model_validator(mode="before")
    @classmethod
    def _expand_shorthands(cls, data: Any) -> Any:
        """Replace a word by a mapping with this type, and add a missing type, the default's."""
        if not isinstance(data, Mapping):
            return data
        data = dict(data)
        if "lambda_" in data and "lambda_" in cls.model_fields:  # because lambda is a keyword of Python
            data["lambda"] = data.pop("lambda_")
        for name, field in cls.model_fields.items():
            tag, value = field.discriminator, data.get(name)
            if isinstance(tag, str) and isinstance(value, str | Mapping):
                given = {tag: value} if isinstance(value, str) else dict(value)
                data[name] = {tag: getattr(field.default, tag)} | given
        return data

    def plain(self) -> dict[str, Any]:
        """Return the options as plain values, without those that are null."""
        return self.model_dump(by_alias=True, exclude_none=True)

    @classmethod
    def standing(cls, case: str) -> dict[str, Any]:
        """Return the values that null stands for in a case, by option (`null`)."""
        extras = {name: field.json_schema_extra for name, field in cls.model_fields.items()}
        nulls: dict[str, Any] = {
            name: extra.get("null", {}) for name, extra in extras.items() if isinstance(extra, dict)
        }
        return {name: cases[case] for name, cases in nulls.items() if case in cases}

    def filled(self, case: str) -> Any:
        """Return the options with null replaced by its value in a case."""
        standing = {name: value for name, value in self.standing(case).items() if getattr(self, name) is None}
        return self.model_copy(update=standing)


def null(**standing: Any) -> Any:
    """A default of null that stands for a value in each case, as in `null(tables="uniform", networks="visits")`. In
    other cases the option has no effect."""
    return Field(default=None, json_schema_extra={"null": standing})
