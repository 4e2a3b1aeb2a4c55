"""What the tables of a cell file are made of: kinds of figures, and a table that knows its keys."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

# Strict: TOML has numbers and truth values of its own, so "yes" and "3" are slips of the pen.
Number = Annotated[FiniteFloat, Field(strict=True)]
Whole = Annotated[int, Field(strict=True)]
Choice = Annotated[bool, Field(strict=True)]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Vector = list[Number]
PositiveVector = list[Positive]
Point = tuple[Number, Number, Number]


class Table(BaseModel):
    """A TOML table that refuses what it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid")
