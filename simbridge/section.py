"""What every section of a mission file has in common."""

from __future__ import annotations

from typing import Annotated, NoReturn

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Ratio = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Point = tuple[Finite, Finite]
Vector = tuple[Finite, Finite, Finite]


class Section(BaseModel):
    """A part of a mission file: unknown keys are refused, values cannot be changed after loading."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def refuse(location: tuple[str | int, ...], value: object, reason: str) -> NoReturn:
    """Refuse a part of a section from within a validator of the whole, so that the error names the part.

    Raises: ValidationError: with the location counted from that section.
    """
    kind = PydanticCustomError("misfit", "{reason}", {"reason": reason})
    raise ValidationError.from_exception_data("mission", [InitErrorDetails(type=kind, loc=location, input=value)])
