"""Values of a TOML text whose numbers were read as `Decimal`, which keeps angles exact."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from typing import Any

from planner.degrees import radians_of


def radians_in(name: str, value: Any) -> Any:
    """Return degrees, one number or nested lists of them, in rad.

    Args:
        name: of the field, for the error.
        value: as read.

    Raises:
        ValueError: an entry is not a number.
    """
    if isinstance(value, list):
        return [radians_in(name, entry) for entry in value]
    if isinstance(value, bool) or not isinstance(value, Decimal | int):
        raise ValueError(f"{name}: {value!r} is not a number of degrees")
    return radians_of(value)


def without_decimals(value: Any) -> Any:
    """Return a value, whatever it is nested in, with a float for each `Decimal`."""
    if isinstance(value, Decimal):
        return float(value)
    if isinstance(value, list):
        return [without_decimals(entry) for entry in value]
    if isinstance(value, Mapping):
        return {name: without_decimals(entry) for name, entry in value.items()}
    return value
