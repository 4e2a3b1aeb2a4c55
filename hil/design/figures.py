"""The figures of a design's file, taken only for what they must be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.excitation import Criteria

Array = NDArray[np.float64]

_FRONT = ("log10_det", "coupling_index", "duration")


class FigureError(ValueError):
    """A figure that cannot be what it stands for.

    Attributes:
        field: its dotted name.
        problem: what it is, and what it should be.
    """

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field} {problem}")
        self.field = field
        self.problem = problem


def criteria_of(table: Mapping[str, Any]) -> Criteria:
    """Return what `[criteria]` says of the motion.

    Raises:
        FigureError: a figure is missing, is no number, or is one that no motion has.
    """

    def figure(name: str, least: float = -math.inf) -> float:
        return number(table, "criteria", name, least=least)

    def condition(name: str) -> float | None:
        return figure(name, 1.0) if name in table else None

    return Criteria(
        log10_det=figure("log10_det"),
        coupling_index=figure("coupling_index", 0.0),
        fitness=figure("fitness"),
        n_samples=count(table, "criteria", "n_samples", least=1),
        condition=condition("condition"),
        scaled_condition=condition("scaled_condition"),
    )


def front_of(table: Mapping[str, Any]) -> Array:
    """Return log10 det, coupling index and duration [s] of each point of `[front]`, (k, 3).

    Raises:
        FigureError: a list is missing, holds what is no number, or is not as long as the others.
    """
    columns = []
    for name in _FRONT:
        values = table.get(name)
        if not isinstance(values, Sequence) or isinstance(values, str):
            raise FigureError(f"front.{name}", f"is {values!r:.60}, not a list of numbers")
        entries = dict(enumerate(values))
        columns.append([number(entries, f"front.{name}", k) for k in entries])
        if len(columns[-1]) != len(columns[0]):
            raise FigureError(
                f"front.{name}", f"has {len(values)} entries, {_FRONT[0]} has {len(columns[0])}"
            )
    return np.array(columns, dtype=np.float64).T


def number(
    table: Mapping[Any, Any], where: str, name: str | int, *, least: float = -math.inf
) -> float:
    """Return a finite number that is not below `least`.

    Raises:
        FigureError: it is missing, or anything else.
    """
    field = f"{where}.{name}" if isinstance(name, str) else f"{where}[{name}]"
    value = table.get(name)
    found = math.nan
    if isinstance(value, int | float) and not isinstance(value, bool):
        found = float(value)
    if not math.isfinite(found) or found < least:
        bound = "" if least == -math.inf else f" from {least:g} on"
        raise FigureError(field, f"is {value!r:.60}, not a finite number{bound}")
    return found


def count(table: Mapping[str, Any], where: str, name: str, *, least: int = 0) -> int:
    """Return a whole number that is not below `least`.

    Raises:
        FigureError: it is missing, or anything else.
    """
    value = table.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise FigureError(f"{where}.{name}", f"is {value!r:.60}, not a whole number from {least}")
    return value
