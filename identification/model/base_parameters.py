"""Base parameters: the independent combinations of the standard parameters, found numerically."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

# Smallest residual of a base column after projection on the columns before it, relative to the
# longest column of its unit. Exact geometry leaves 1e-15 of a dependent column, a URDF with rounded
# angles (1.5708 for pi/2) up to 4e-6.
DEPENDENCE_TOLERANCE = 1e-5

_RELATION_ROUNDING = 1e-13
_NEGLIGIBLE_FACTOR = 1e-9  # factors below this are left out of texts


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Independent standard parameters, and the groups of parameters that they represent."""

    names: tuple[str, ...]  #: of the independent parameters, (b,)
    pivots: NDArray[np.intp]  #: indices of the independent standard parameters, rising, (b,)
    grouping: Array  #: ``base_values = grouping @ standard_values``, (b, s)
    standard_names: tuple[str, ...]  #: names of all standard parameters, (s,)
    #: smallest residual of an independent column after projection on those before it, relative to
    #: the longest column of its unit
    smallest_pivot: float
    largest_dropped: float  #: largest residual of a dependent column: zero except for rounding
    shares: Array  #: residual of each standard parameter's column, (s,)
    #: terms (factor, name) of parameters lumped into others without a group, by the other's name
    lumped: Mapping[str, Sequence[tuple[float, str]]] = field(default_factory=dict)

    @property
    def rank(self) -> int:
        """Number b of base parameters."""
        return len(self.names)

    def explanation(self) -> str:
        """Return a message about the rank decision and its margin."""
        s = len(self.standard_names)
        absent = s - np.count_nonzero(np.any(np.abs(self.grouping) > _NEGLIGIBLE_FACTOR, axis=0))
        weakest = self.names[int(np.argmin(self.shares[self.pivots]))]
        return (
            f"{self.rank} of {s} standard parameters are independent, {s - self.rank - absent} are"
            f" grouped with them, {absent} do not affect the torque. The smallest residual of an"
            f" independent column is {self.smallest_pivot:.1e} ({weakest}), the largest of a"
            f" dependent one {self.largest_dropped:.1e}; the threshold is {DEPENDENCE_TOLERANCE:g}."
        )

    def expressions(self, digits: int = 6) -> tuple[str, ...]:
        """Return each group as a formula: ``I1yy + I1m + 0.09 m2 + ...``."""
        formulas = []
        for row, pivot in zip(self.grouping, self.pivots, strict=True):
            text = self.standard_names[pivot]
            others = [
                (row[column], self.standard_names[column])
                for column in np.flatnonzero(np.abs(row) > _NEGLIGIBLE_FACTOR)
                if column != pivot
            ]
            formulas.append(self.expression(text, others, digits))
        return tuple(formulas)

    def expression(
        self, name: str, others: Sequence[tuple[float, str]] = (), digits: int = 6
    ) -> str:
        """Return a parameter as a formula with the terms lumped into it."""
        text = name
        for value, other in (*others, *self.lumped.get(name, ())):
            factor = f"{abs(value):.{digits}g}"
            sign = "+" if value > 0.0 else "-"
            text += f" {sign} {other}" if factor == "1" else f" {sign} {factor} {other}"
        return text


def select_base(regressor: Array, names: Sequence[str], units: Sequence[str]) -> BaseParameters:
    """Choose independent columns of (rows, s) from left to right, and group the others.

    QR factorisation of the rows, then Gram-Schmidt. Lengths are relative within one unit.
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
    residual = np.linalg.norm(scaled - scaled[:, pivots] @ relation, axis=0).max(initial=0.0)
    relation[np.abs(relation) < max(_RELATION_ROUNDING, 10.0 * float(residual))] = 0.0
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
    """Return the relative residual of columns (rows, k) after projection on `basis` (rows, b)."""
    orthonormal, _ = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))
    residual = columns - orthonormal @ (orthonormal.T @ columns)
    return np.asarray(np.linalg.norm(residual, axis=0) / np.linalg.norm(columns, axis=0))


def _first_independent(columns: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Return the indices of independent columns, their orthonormal basis, and all residuals."""
    basis = np.zeros_like(columns)
    pivots: list[int] = []
    shares = np.zeros(columns.shape[1])
    for index in range(columns.shape[1]):
        residual = columns[:, index].copy()
        for _ in range(2):  # twice, against rounding
            earlier = basis[:, : len(pivots)]
            residual -= earlier @ (earlier.T @ residual)
        shares[index] = np.linalg.norm(residual)
        if shares[index] > DEPENDENCE_TOLERANCE and len(pivots) < basis.shape[1]:
            basis[:, len(pivots)] = residual / shares[index]
            pivots.append(index)
    return np.array(pivots, dtype=np.intp), basis[:, : len(pivots)], shares
