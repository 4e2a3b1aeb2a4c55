"""What data of a file hold, type by type; nothing is mistaken for what it only resembles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from planner.arrays import Array, read_only

# What reading damaged data can raise, whatever is wrong with them: texts in place of tables,
# numbers too large for a float or with too many digits, lists too deep.
DAMAGED = (
    TypeError,
    ValueError,
    AttributeError,
    LookupError,
    ArithmeticError,
    RecursionError,
)


def number(value: Any) -> float:
    """Return a number.

    Raises:
        TypeError: it is a text, True or False, or anything else.
        OverflowError: it is too large.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r:.80} is not a number")
    return float(value)


def whole(value: Any) -> int:
    """Return a whole number.

    Raises:
        TypeError: it is none.
        OverflowError: 64 bits do not hold it.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{value!r:.80} is not a whole number")
    if not -(2**63) <= value < 2**63:
        raise OverflowError("a whole number is too large")
    return value


def numbers(values: Any, dimensions: int) -> Array:
    """Return nested lists of numbers as a read-only array with so many dimensions.

    Raises:
        TypeError: an entry is not a number, or a list is missing.
        ValueError: the lists differ in length.
        OverflowError: a number is too large.
    """
    array = read_only(_nested(values, dimensions))
    if array.ndim != dimensions and array.size:
        raise ValueError(f"{values!r:.80} is not what it should be")
    return array


def one_or_more(value: Any) -> float | Array:
    """Return a number, or a list of numbers as an array; raises as `numbers` does."""
    return numbers(value, 1) if isinstance(value, list | tuple) else number(value)


def text(value: Any) -> str:
    """Return a text.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.80} is not a text")
    return value


def texts(value: Any) -> tuple[str, ...]:
    """Return a list of texts.

    Raises:
        TypeError: it is none.
    """
    return tuple(text(one) for one in rows(value))


def table(value: Any) -> Mapping[str, Any]:
    """Return named values.

    Raises:
        TypeError: these are none.
    """
    if not isinstance(value, Mapping):
        raise TypeError(f"{value!r:.80} is not a table of named values")
    return value


def rows(value: Any) -> list[Any]:
    """Return a list.

    Raises:
        TypeError: it is none.
    """
    if not isinstance(value, list | tuple):
        raise TypeError(f"{value!r:.80} is not a list")
    return list(value)


def _nested(values: Any, dimensions: int) -> Any:
    if dimensions == 0:
        return number(values)
    return [_nested(value, dimensions - 1) for value in rows(values)]
