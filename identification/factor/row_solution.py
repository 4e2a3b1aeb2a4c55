"""Least squares on a few rows that stand for all samples: R x = z, without squaring R.

Forming R'R squares the condition number; a singular value decomposition of R itself does not
(Golub and Van Loan 2013, section 5.3).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.factor.estimation import WORST_CONDITION, Solution
from identification.factor.gram import NormalEquations

Array = NDArray[np.float64]

# Columns of unit length whose condition is 1e10 leave six of sixteen digits, more than any torque
# measurement has. What is dependent by construction shows as 1e14 and more.
WORST_ROW_CONDITION: Final = 1e10
_PARTICIPATION: Final = 1e-3


def undetermined_names(names: tuple[str, ...], determined: NDArray[np.bool_]) -> tuple[str, ...]:
    """Names (p,) of what is not determined (p,)."""
    return tuple(name for name, known in zip(names, determined, strict=True) if not known)


def solve_rows(rows: Array, target: Array, worst: float = WORST_ROW_CONDITION) -> Solution:
    """Solve ``rows @ x = target`` by least squares, naming what the rows do not determine.

    Columns are scaled to unit length first, so that the condition does not depend on units.

    Args:
        rows: (k, p).
        target: (k,).
        worst: directions in which the condition exceeds this are left out; the parameters that
            take part in one of them are undetermined.
    """
    length = np.linalg.norm(rows, axis=0)
    present = length > 0.0
    scale = np.where(present, length, 1.0)
    left, singular, right = np.linalg.svd(rows / scale, full_matrices=True)
    p = rows.shape[1]
    padded = np.zeros(p)
    padded[: len(singular)] = singular
    kept = (padded > padded.max(initial=0.0) / worst) & (padded > 0.0)
    lost = right[~kept]
    determined = present & (np.abs(lost).max(axis=0, initial=0.0) < _PARTICIPATION)
    root = right[kept].T / padded[kept] / scale[:, None]
    smallest = padded.min(initial=np.inf) if present.all() else 0.0
    return Solution(
        values=root @ (left[:, : len(singular)].T @ target)[kept[: len(singular)]],
        root=root,
        condition=float(padded[0] / smallest) if smallest > 0.0 else np.inf,
        determined=np.asarray(determined),
    )


def rows_of(equations: NormalEquations) -> tuple[Array, Array]:
    """Return rows (k, p) and target (k,) with ``rows'rows = A`` and ``rows'target = b``.

    Directions in which A holds nothing but its own rounding (condition above
    `identification.factor.estimation.WORST_CONDITION`) are left out: they carry no information.
    """
    length = np.sqrt(np.maximum(np.diag(equations.A), 0.0))
    scale = np.where(length > 0.0, length, 1.0)
    eigenvalues, vectors = np.linalg.eigh(equations.A / np.outer(scale, scale))
    kept = eigenvalues > max(eigenvalues[-1], 0.0) / WORST_CONDITION**2
    singular = np.sqrt(eigenvalues[kept])
    basis = vectors[:, kept].T
    return singular[:, None] * basis * scale, (basis @ (equations.b / scale)) / singular
