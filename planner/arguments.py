"""What a service was called with, as numbers; anything else is no number, never an error."""

from __future__ import annotations

from enum import IntEnum
from math import nan
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np

from planner.arrays import Array, read_only

E = TypeVar("E", bound=IntEnum)


def real(value: Any) -> float:
    """Return a number as a float; NaN, which no range holds, for what is none, as True or "1"."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return nan
    try:
        return float(value)
    except OverflowError:
        return nan


def whole(value: Any) -> int | None:
    """Return a whole number, of Python's or numpy's types; None for what is none."""
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None


def member(kind: type[E], value: Any) -> E | None:
    """Return the member of an enumeration with this number; None where there is none."""
    number = whole(value)
    return kind(number) if number is not None and number in kind._value2member_map_ else None


def reals(values: Any) -> Array:
    """Return numbers, one or rows of them, as a read-only array.

    Raises:
        ValueError: an entry is no number, as True or "1", is too large for one, or rows differ
            in length.
    """
    raw = np.asarray(values)
    if raw.dtype == object:  # whole numbers beyond 64 bits, or what is none
        raw = np.array([real(value) for value in raw.flat]).reshape(raw.shape)
        if np.any(np.isnan(raw)):
            raise ValueError(f"{values!r:.80} holds what is no number")
    if raw.dtype.kind not in "iuf" or _holds_truth(values):
        raise ValueError(f"{values!r:.80} is not made of numbers")
    return read_only(raw)


def _holds_truth(values: Any) -> bool:
    """Whether True or False is among numbers, which an array would make 1 and 0 of."""
    if isinstance(values, list | tuple):
        return any(_holds_truth(value) for value in values)
    return isinstance(values, bool | np.bool_)
