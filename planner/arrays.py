"""Array type of the package, and strict checks of data read from files."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, TypeAdapter

Array = NDArray[np.float64]


def read_only(values: ArrayLike) -> Array:
    """Return a read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


# What reading damaged data can raise: a text in place of a table, numbers too large for a float or
# with too many digits, lists nested too deep.
DAMAGED_DATA_ERRORS = (
    TypeError,
    ValueError,
    AttributeError,
    LookupError,
    ArithmeticError,
    RecursionError,
)


Whole = Annotated[int, Field(ge=-(2**63), lt=2**63)]
"""Integer of 64 bits."""


def strict(kind: Any, value: Any) -> Any:
    """Return a value checked to be of a type, without conversion (True and "1" are no numbers).

    Raises:
        ValueError: it is of another type (pydantic's `ValidationError`).
    """
    return _adapter(kind).validate_python(value, strict=True)


def numbers(values: Any, dimensions: int) -> Array:
    """Return nested lists of numbers as a read-only array with `dimensions` dimensions.

    Raises:
        ValueError: an entry is not a number, or the lists differ in length.
    """
    kind: Any = float
    for _ in range(dimensions):
        kind = list[kind]
    return read_only(strict(kind, values))


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)
