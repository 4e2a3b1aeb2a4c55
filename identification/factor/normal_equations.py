"""Least squares as normal equations or as rows, with what they leave undetermined."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array, Indices

# Condition 1e6 leaves four digits of a Gram matrix, enough for torque measurements; rank deficiency
# shows as 1e8 and more.
MAX_CONDITION: Final = 1e6

# Condition 1e10 leaves six digits of rows; structural dependence shows as 1e14 and more.
MAX_ROW_CONDITION: Final = 1e10

MAX_UNDETERMINED_SHARE: Final = 1e-3
"""Share in undetermined directions up to which a parameter is determined."""

_MIN_COLUMN_RATIO: Final = 1e-10  # length of a column that is rounding, over that of the longest


class NormalEquations(NamedTuple):
    """``A pi = b`` of a weighted least-squares problem."""

    A: Array  #: sum of the weighted ``W^T W``, shape (p, p)
    b: Array  #: sum of the weighted ``W^T y``, shape (p,)
    yy: float = 0.0  #: sum of the weighted ``y^T y``
    n: int = 0  #: rows (one joint at one time)

    def part(self, chosen: Indices) -> NormalEquations:
        """Return the equations of some parameters (k,), the others zero."""
        return self._replace(A=self.A[np.ix_(chosen, chosen)], b=self.b[chosen])


class Solution(NamedTuple):
    """Solution of a least-squares problem, of normal equations ``A x = b`` or of rows."""

    values: Array  # (p,), of least (scaled) norm where undetermined
    root: Array  # S (p, k) with S S' the inverse of A on the k determined directions
    condition: float  # of the regressor with unit columns, infinite without some column
    determined: NDArray[np.bool_]  # (p,)

    @property
    def inverse(self) -> Array:
        """Inverse of A on what is determined, zero elsewhere (p, p)."""
        return np.asarray(self.root @ self.root.T)


def or_one(length: Array) -> Array:
    """Return divisors for columns of a length (p,), one for zero."""
    return np.where(length > 0.0, length, 1.0)


def _determined_part(length: Array, size: Array, vectors: Array, worst: float) -> Solution:
    """Return a solution without values, from singular values (p,) and vectors of unit columns."""
    significant = (size > size.max(initial=0.0) / worst) & (size > 0.0)
    lost = np.abs(vectors[:, ~significant]).max(axis=1, initial=0.0)
    smallest = size.min(initial=np.inf) if np.all(length > 0.0) else 0.0
    return Solution(
        values=np.zeros(len(length)),
        root=vectors[:, significant] / size[significant] / or_one(length)[:, None],
        condition=float(size.max() / smallest) if smallest > 0.0 else np.inf,
        determined=np.asarray((length > 0.0) & (lost < MAX_UNDETERMINED_SHARE)),
    )


def solve(equations: NormalEquations, worst: float = MAX_CONDITION) -> Solution:
    """Solve ``A x = b`` with unit columns; parameters of a condition above `worst` are open."""
    length = np.sqrt(np.diag(equations.A))
    scale = or_one(length)
    eigenvalues, vectors = np.linalg.eigh(equations.A / np.outer(scale, scale))
    part = _determined_part(length, np.sqrt(np.maximum(eigenvalues, 0.0)), vectors, worst)
    return part._replace(values=part.root @ (part.root.T @ equations.b))


def solve_with_ridge(gram: Array, cross: Array, ridge: float) -> Array:
    """Solve ``G x = b`` (k, k), (k,), with a ridge as a share of each column's information.

    Several times faster than :func:`solve`; columns of zeros, but for rounding, have parameters of
    zero.
    """
    length = np.sqrt(np.maximum(np.diag(gram), 0.0))
    present = length > _MIN_COLUMN_RATIO * length.max(initial=0.0)
    scale = np.where(present, length, 1.0)
    normal = gram / np.outer(scale, scale)
    np.fill_diagonal(normal, np.where(present, 1.0 + ridge, 1.0))
    return solve_positive(normal, cross / scale) / scale


def solve_positive(matrix: Array, right: Array) -> Array:
    """Solve ``M x = r`` with a positive definite matrix (k, k), (k,).

    Raises:
        numpy.linalg.LinAlgError: the matrix is singular.
    """
    _, solution, failed = scipy.linalg.lapack.dposv(matrix.T, right)
    # A matrix that rounding made indefinite.
    return np.asarray(np.linalg.solve(matrix, right) if failed else solution)


def solve_rows(rows: Array, target: Array, worst: float = MAX_ROW_CONDITION) -> Solution:
    """Solve ``rows @ x = target`` (k, p), (k,) without squaring the condition.

    By a singular value decomposition (Golub and Van Loan 2013, section 5.3); `worst` as for
    :func:`solve`.
    """
    length = np.linalg.norm(rows, axis=0)
    left, singular, right = np.linalg.svd(rows / or_one(length), full_matrices=True)
    size = np.zeros(rows.shape[1])
    size[: len(singular)] = singular
    part = _determined_part(length, size, right.T, worst)
    # Significant values come first.
    return part._replace(values=part.root @ (left[:, : part.root.shape[1]].T @ target))


def rows_of(equations: NormalEquations) -> tuple[Array, Array]:
    """Return rows (k, p) and target (k,) with ``rows'rows = A`` and ``rows'target = b``."""
    length = np.sqrt(np.maximum(np.diag(equations.A), 0.0))
    scale = or_one(length)
    eigenvalues, vectors = np.linalg.eigh(equations.A / np.outer(scale, scale))
    significant = eigenvalues > max(eigenvalues[-1], 0.0) / MAX_CONDITION**2
    singular = np.sqrt(eigenvalues[significant])
    basis = vectors[:, significant].T
    # Exactly zero for columns without data.
    return singular[:, None] * basis * length, (basis @ (equations.b / scale)) / singular
