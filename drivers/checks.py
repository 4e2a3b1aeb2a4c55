"""How a number outside its bound becomes an error. Comparisons are such that NaN fails them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from drivers.errors import GuardError, NotFinite, PositionLimit

Array = NDArray[np.float64]


def require_finite(values: Array, where: NDArray[np.bool_], cycle: int) -> None:
    """Raise `NotFinite` for the first joint of `where` (n,) whose value (n,) is no number."""
    bad = where & ~np.isfinite(values)
    if bad.any():
        joint = int(np.argmax(bad))
        raise NotFinite(joint, float(values[joint]), np.inf, cycle)


def require(
    where: NDArray[np.bool_],
    values: Array,
    bounds: Array,
    error: type[GuardError],
    cycle: int,
    unit: str | None = None,
) -> None:
    """Raise `error` for the first joint of `where` (n,) whose value (n,) is above its bound."""
    bad = where & ~(values <= bounds)
    if bad.any():
        joint = int(np.argmax(bad))
        kind = error if np.isfinite(values[joint]) else NotFinite
        raise kind(joint, float(values[joint]), float(bounds[joint]), cycle, unit)


def report(
    magnitude: Array,
    found: Array,
    allowed: Array,
    checks: tuple[type[GuardError], ...],
    cycle: int,
    position_limits: Callable[[int, float], tuple[float, float]] | None = None,
) -> NoReturn:
    """Raise for the first row and joint outside its bound; NaN before everything else.

    Args:
        magnitude: (k, n) compared with `allowed`.
        found: (k, n) with its sign, for the error.
        allowed: (k, n).
        checks: (k,) error of each row.
        cycle: for the error.
        position_limits: turns joint and value of a position into those to be reported.
    """
    not_finite = ~np.isfinite(magnitude)
    bad = not_finite if not_finite.any() else ~(magnitude <= allowed)
    row, joint = (int(index) for index in np.argwhere(bad)[0])
    value, bound = float(found[row, joint]), float(allowed[row, joint])
    kind = NotFinite if not_finite.any() else checks[row]
    if kind is PositionLimit and position_limits is not None:
        value, bound = position_limits(joint, value)
    raise kind(joint, value, bound, cycle)
