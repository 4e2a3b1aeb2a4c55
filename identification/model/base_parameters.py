"""Base parameters: the parameters that a torque can tell apart (numeric, for any chain)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A column is a base column if the part of it that no other one explains is longer than this share
# of the longest column of its unit. Exact geometry leaves 1e-15 of a dependent column; a URDF whose
# angles are rounded (1.5708 for pi/2) leaves up to 4e-6, which no measurement could use.
TOLERANCE = 1e-5

_ROUNDING = 1e-13
# A gap as wide leaves room for a threshold; a base column's share below the second depends on
# the geometry's last digits.
_CLEAR = 100.0
_WEAK = 1e-3
# Factors below this (a lever of a nanometre) are in the grouping, but not in the words for it.
_UNSPEAKABLE = 1e-9


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Which standard parameters are independent, and what is grouped into each."""

    #: names of the independent parameters, shape (b,): each stands for its group
    names: tuple[str, ...]
    pivots: NDArray[np.intp]  #: indices of the independent standard parameters, rising, shape (b,)
    grouping: Array  #: ``base_values = grouping @ standard_values``, shape (b, s)
    standard_names: tuple[str, ...]  #: names of all standard parameters, shape (s,)
    #: how much of an independent column those before it leave unexplained, as a share of the
    #: longest column of its unit; the smallest over all of them
    smallest_pivot: float
    largest_dropped: float  #: the same, the largest over all dropped: zero but for rounding
    shares: Array  #: the same of each standard parameter, shape (s,)

    @property
    def rank(self) -> int:
        """Number b of base parameters."""
        return len(self.names)

    @property
    def gap(self) -> float:
        """How clear the rank decision is: smallest independent over largest dropped share."""
        return self.smallest_pivot / max(self.largest_dropped, np.finfo(np.float64).tiny)

    def explanation(self) -> str:
        """Return the rank decision in words: how many are independent, how clearly.

        Shares are of the longest column of the same unit, after what those before it
        explain; a parameter is dropped below :data:`TOLERANCE`.
        """
        s = len(self.standard_names)
        absent = s - np.count_nonzero(np.any(np.abs(self.grouping) > _UNSPEAKABLE, axis=0))
        text = (
            f"{self.rank} of {s} standard parameters are independent, {s - self.rank - absent} are"
            f" grouped into them, {absent} act on no torque."
        )
        if self.rank == s:
            return text
        weakest = self.names[int(np.argmin(self.shares[self.pivots]))]
        text += (
            f" The weakest of them, {weakest}, leaves {self.smallest_pivot:.1e} of its column"
            f" unexplained, the strongest dropped one {self.largest_dropped:.1e}; the threshold is"
            f" {TOLERANCE:g}."
        )
        if self.gap < _CLEAR or self.smallest_pivot < _WEAK:
            return (
                f"{text} That is close: small lengths or angles of the robot description decide"
                f" whether {weakest} is a parameter of its own."
            )
        return (
            f"{text} A gap of {np.log10(self.gap):.0f} orders of magnitude: the decision is clear."
        )

    def expressions(self, digits: int = 6) -> tuple[str, ...]:
        """Return each group in words: ``I1yy + I1m + 0.09 m2 + ...``."""
        found = []
        for row, pivot in zip(self.grouping, self.pivots, strict=True):
            text = self.standard_names[pivot]
            for column in np.flatnonzero(np.abs(row) > _UNSPEAKABLE):
                if column != pivot:
                    factor, name = f"{abs(row[column]):.{digits}g}", self.standard_names[column]
                    sign = "+" if row[column] > 0.0 else "-"
                    text += f" {sign} {name}" if factor == "1" else f" {sign} {factor} {name}"
            found.append(text)
        return tuple(found)


def select_base(regressor: Array, names: Sequence[str], units: Sequence[str]) -> BaseParameters:
    """Choose the first independent columns (rows, s), left to right, and group the others.

    A QR factorisation reduces the rows first; Gram-Schmidt walks through the columns in the given
    order. Only columns of one unit are compared in length.
    """
    reduced = np.linalg.qr(regressor, mode="r")
    lengths = np.linalg.norm(reduced, axis=0)
    _, of_unit = np.unique(units, return_inverse=True)
    longest = np.zeros(len(units))
    np.maximum.at(longest, of_unit, lengths)
    scale = np.where(longest > 0.0, longest, 1.0)[of_unit]
    scaled = reduced / scale
    pivots, basis, shares = _first_independent(scaled)
    relation = np.linalg.solve(basis.T @ scaled[:, pivots], basis.T @ scaled)
    # What is no larger than what stays unexplained is rounding, not grouping.
    unexplained = np.linalg.norm(scaled - scaled[:, pivots] @ relation, axis=0).max(initial=0.0)
    relation[np.abs(relation) < max(_ROUNDING, 10.0 * float(unexplained))] = 0.0
    grouping = relation * scale / scale[pivots, None]
    grouping[:, pivots] = np.eye(len(pivots))
    return BaseParameters(
        names=tuple(names[k] for k in pivots),
        pivots=pivots,
        grouping=grouping,
        standard_names=tuple(names),
        smallest_pivot=float(shares[pivots].min(initial=1.0)),
        largest_dropped=float(np.delete(shares, pivots).max(initial=0.0)),
        shares=shares,
    )


def share_left(columns: Array, basis: Array) -> Array:
    """Return per column (rows, k) the share that the columns of `basis` (rows, b) leave of it."""
    orthonormal, _ = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))
    rest = columns - orthonormal @ (orthonormal.T @ columns)
    share: Array = np.linalg.norm(rest, axis=0) / np.linalg.norm(columns, axis=0)
    return share


def _first_independent(columns: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Return the indices, their orthonormal basis, and what earlier ones leave of each column."""
    basis = np.zeros_like(columns)
    pivots: list[int] = []
    shares = np.zeros(columns.shape[1])
    for index in range(columns.shape[1]):
        rest = columns[:, index].copy()
        for _ in range(2):  # twice is enough to be orthogonal to rounding
            known = basis[:, : len(pivots)]
            rest -= known @ (known.T @ rest)
        shares[index] = np.linalg.norm(rest)
        if shares[index] > TOLERANCE and len(pivots) < basis.shape[1]:
            basis[:, len(pivots)] = rest / shares[index]
            pivots.append(index)
    return np.array(pivots, dtype=np.intp), basis[:, : len(pivots)], shares
