"""Reduced samples, and weighted least squares on them (eq. 4 of the paper).

Per joint j a :class:`Factor` holds the Gram matrix of the rows [W | y], a :class:`QRFactor` their
triangular factor. Both add over chunks, repetitions, archives and processes; joint weights are
applied afterwards. Gram matrices square the condition: from 1e5 on triangles are used.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.model.motion import Motion
from identification.model.regressor import CHUNK, joint_arrays
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

# Condition 1e6 leaves four digits of a Gram matrix, enough for torque measurements; rank deficiency
# shows as 1e8 and more.
WORST_CONDITION: Final = 1e6
# Condition 1e10 leaves six digits of rows; structural dependence shows as 1e14 and more.
WORST_ROW_CONDITION: Final = 1e10
QR_CONDITION: Final = 1e5
_PARTICIPATION: Final = 1e-3


class NormalEquations(NamedTuple):
    """``A pi = b`` of a weighted least-squares problem."""

    A: Array  #: sum of the weighted ``W^T W``, shape (p, p)
    b: Array  #: sum of the weighted ``W^T y``, shape (p,)
    yy: float = 0.0  #: sum of the weighted ``y^T y``
    n: int = 0  #: rows (one joint at one time)

    def part(self, chosen: NDArray[np.intp]) -> NormalEquations:
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


@dataclass(frozen=True, eq=False)
class Factor:
    """Gram matrices of the rows of [W | y], joint by joint."""

    matrices: Array  #: (n, p + 1, p + 1)
    samples: NDArray[np.intp]  #: rows per joint (n,)
    parameter_names: tuple[str, ...]  #: the p columns of W

    words: ClassVar[str] = ""
    """Suffix of estimator names."""
    smallest_noise: ClassVar[float] = 1e-6
    """Smallest noise as a share of the torque's RMS, for joints that fit exactly."""

    @classmethod
    def zero(cls, model: RobotModel) -> Self:
        """Return the factor of no samples."""
        n, p = model.n_joints, model.n_parameters
        return cls(np.zeros((n, p + 1, p + 1)), np.zeros(n, dtype=np.intp), model.parameter_names)

    @classmethod
    def of(cls, model: RobotModel, samples: Samples) -> Self:
        """Reduce the usable rows of a recording.

        Raises:
            ShapeError: wrong shape of an array.
        """
        blocks = (rows.blocks for rows in augmented_rows(model, samples))
        return cls.from_blocks(model, blocks, np.count_nonzero(samples.usable, axis=0))

    @classmethod
    def from_samples(
        cls, model: RobotModel, motion: Motion, torque: Array, mask: NDArray[np.bool_] | None = None
    ) -> Self:
        """Reduce m samples of a motion and the torque of W pi [N·m, N] (m, n).

        `mask` (m, n): usable rows, by default all; see :meth:`RobotModel.moving`.

        Raises:
            ShapeError: wrong shape of an array.
        """
        usable = np.ones(np.shape(torque), dtype=np.bool_) if mask is None else mask
        nothing = np.full(model.n_joints, np.inf)
        return cls.of(model, Samples(motion, torque, usable, (), 0.0, nothing))

    @classmethod
    def from_blocks(
        cls, model: RobotModel, chunks: Iterable[Sequence[Array]], samples: NDArray[np.intp]
    ) -> Self:
        """Reduce chunks of :func:`augmented_rows`, with numbers of usable rows (n,)."""
        columns = model.plan.columns
        sums = [np.zeros((len(c) + 1, len(c) + 1)) for c in columns]
        for blocks in chunks:
            for joint, block in enumerate(blocks):
                sums[joint] = cls._accumulate(sums[joint], block)
        factor = cls.zero(model)
        for small, used, target in zip(sums, columns, factor.matrices, strict=True):
            target[:] = cls._expanded(small, np.append(used, model.n_parameters), target)
        factor.samples[:] = samples
        return factor

    @property
    def gram(self) -> Array:
        """The Gram matrices (n, p + 1, p + 1), symmetric."""
        return self.matrices

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return int(self.matrices.shape[0])

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return int(self.matrices.shape[1]) - 1

    def __add__(self, other: Self) -> Self:
        """Return the factor of both sets of samples.

        Raises:
            IdentificationError: the two belong to different models.
        """
        same = self.matrices.shape == other.matrices.shape
        if not same or self.parameter_names != other.parameter_names:
            raise IdentificationError("factors with different joints or parameters cannot be added")
        both = self._added(other)
        return type(self)(both, self.samples + other.samples, self.parameter_names)

    def weighted(self, weights: Array) -> NormalEquations:
        """Return the normal equations with one weight per joint (n,): 1/variance."""
        total = np.tensordot(weights, self.gram, axes=1)
        return NormalEquations(
            A=total[:-1, :-1], b=total[:-1, -1], yy=float(total[-1, -1]), n=int(self.samples.sum())
        )

    def squared_errors(self, values: Array) -> Array:
        """Return the sum of squared torque errors of parameters (p,) per joint (n,)."""
        augmented = np.append(-values, 1.0)
        squares = np.einsum("i,jik,k->j", augmented, self.gram, augmented)
        return np.asarray(np.maximum(squares, 0.0))

    def relative_errors(self, values: Array) -> Array:
        """Return ||e|| / ||tau|| of parameters (p,) per joint (n,), NaN without torque."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt(self.squared_errors(values) / self.gram[:, -1, -1])

    def relative_error(self, values: Array) -> float:
        """Return ||e|| / ||tau|| of parameters (p,) over all joints, NaN without torque."""
        power = float(self.gram[:, -1, -1].sum())
        return float(np.sqrt(self.squared_errors(values).sum() / power)) if power > 0.0 else np.nan

    def rows(self, weights: Array) -> tuple[Array, Array]:
        """Return equivalent rows (k, p) and target (k,) with joint weights (n,)."""
        return rows_of(self.weighted(weights))

    def solve(self, weights: Array) -> Solution:
        """Solve the weighted least-squares problem, weights (n,)."""
        return solve(self.weighted(weights))

    def products(self, directions: Array) -> Array:
        """Return ``D' G_j D`` (n, k, k) for directions D (p, k), or (p + 1, k) with the torque."""
        size = len(directions)
        return np.asarray(directions.T @ self.gram[:, :size, :size] @ directions)

    def _added(self, other: Self) -> Array:
        return self.matrices + other.matrices

    @staticmethod
    def _accumulate(matrix: Array, block: Array) -> Array:
        matrix += block @ block.T
        return matrix

    @staticmethod
    def _expanded(matrix: Array, place: NDArray[np.intp], target: Array) -> Array:
        target[np.ix_(place, place)] = matrix
        return target


class QRFactor(Factor):
    """Upper triangular factors of [W | y], one per joint, instead of Gram matrices."""

    words = " by QR"
    # Rounding of the residual by triangular factors.
    smallest_noise = 1e-12

    @property
    def gram(self) -> Array:
        """Gram matrices, with loss of digits."""
        return np.asarray(self.matrices.transpose(0, 2, 1) @ self.matrices)

    def rows(self, weights: Array) -> tuple[Array, Array]:
        """Return the triangle of all joints."""
        rows = np.sqrt(weights)[:, None, None] * self.matrices
        triangle = _triangle(rows.reshape(-1, rows.shape[2]))
        return triangle[:-1, :-1], triangle[:-1, -1]

    def solve(self, weights: Array) -> Solution:
        """Solve the rows, without squaring their condition."""
        return solve_rows(*self.rows(weights))

    def products(self, directions: Array) -> Array:
        """Return squares of the triangles times the directions."""
        through = self.matrices[:, :, : len(directions)] @ directions
        return np.asarray(through.transpose(0, 2, 1) @ through)

    def _added(self, other: Self) -> Array:
        stacked = np.concatenate([self.matrices, other.matrices], axis=1)
        return np.array([_triangle(joint) for joint in stacked])

    @staticmethod
    def _accumulate(matrix: Array, block: Array) -> Array:
        return _triangle(np.concatenate([matrix, block.T]))

    @staticmethod
    def _expanded(matrix: Array, place: NDArray[np.intp], target: Array) -> Array:
        wide = np.zeros((len(matrix), len(target)))
        wide[:, place] = matrix
        # Columns are not sorted, so the expanded rows are not triangular.
        return _triangle(wide)


def _triangle(rows: Array) -> Array:
    """Return upper triangular R with R'R = rows'rows, square, missing rows zero."""
    triangle = np.linalg.qr(rows, mode="r")
    square = np.zeros((rows.shape[1], rows.shape[1]))
    square[: len(triangle)] = triangle
    return square


def _unit_columns(length: Array) -> Array:
    """Return divisors for columns of a length (p,), one for zero."""
    return np.where(length > 0.0, length, 1.0)


def _determined_part(length: Array, size: Array, vectors: Array, worst: float) -> Solution:
    """Return a solution without values, from singular values (p,) and vectors of unit columns."""
    significant = (size > size.max(initial=0.0) / worst) & (size > 0.0)
    lost = np.abs(vectors[:, ~significant]).max(axis=1, initial=0.0)
    smallest = size.min(initial=np.inf) if np.all(length > 0.0) else 0.0
    return Solution(
        values=np.zeros(len(length)),
        root=vectors[:, significant] / size[significant] / _unit_columns(length)[:, None],
        condition=float(size.max() / smallest) if smallest > 0.0 else np.inf,
        determined=np.asarray((length > 0.0) & (lost < _PARTICIPATION)),
    )


def solve(equations: NormalEquations, worst: float = WORST_CONDITION) -> Solution:
    """Solve ``A x = b`` with unit columns; parameters of a condition above `worst` are open."""
    length = np.sqrt(np.diag(equations.A))
    scale = _unit_columns(length)
    eigenvalues, vectors = np.linalg.eigh(equations.A / np.outer(scale, scale))
    found = _determined_part(length, np.sqrt(np.maximum(eigenvalues, 0.0)), vectors, worst)
    return found._replace(values=found.root @ (found.root.T @ equations.b))


def solve_rows(rows: Array, target: Array, worst: float = WORST_ROW_CONDITION) -> Solution:
    """Solve ``rows @ x = target`` (k, p), (k,) without squaring the condition.

    By a singular value decomposition (Golub and Van Loan 2013, section 5.3); `worst` as for
    :func:`solve`.
    """
    length = np.linalg.norm(rows, axis=0)
    left, singular, right = np.linalg.svd(rows / _unit_columns(length), full_matrices=True)
    size = np.zeros(rows.shape[1])
    size[: len(singular)] = singular
    found = _determined_part(length, size, right.T, worst)
    # Significant values come first.
    return found._replace(values=found.root @ (left[:, : found.root.shape[1]].T @ target))


def rows_of(equations: NormalEquations) -> tuple[Array, Array]:
    """Return rows (k, p) and target (k,) with ``rows'rows = A`` and ``rows'target = b``."""
    length = np.sqrt(np.maximum(np.diag(equations.A), 0.0))
    scale = _unit_columns(length)
    eigenvalues, vectors = np.linalg.eigh(equations.A / np.outer(scale, scale))
    significant = eigenvalues > max(eigenvalues[-1], 0.0) / WORST_CONDITION**2
    singular = np.sqrt(eigenvalues[significant])
    basis = vectors[:, significant].T
    # Exactly zero for columns without data.
    return singular[:, None] * basis * length, (basis @ (equations.b / scale)) / singular


def residual_variance(factor: Factor, values: Array, root: Array, weights: Array) -> Array:
    """Return the variance of the torque residual per joint (n,), NaN without rows.

    Degrees of freedom are shared by the information trace(w_j S' G_j S) of joints, S = root (p, k).
    """
    squares = factor.products(np.append(-values, 1.0)[:, None])[:, 0, 0]
    spent = weights * np.trace(factor.products(root), axis1=1, axis2=2)
    torque = factor.products(np.eye(factor.n_parameters + 1)[:, -1:])[:, 0, 0]
    floor = factor.smallest_noise**2 * torque / np.maximum(factor.samples, 1)
    floor = np.maximum(floor, np.finfo(np.float64).tiny)
    variance = np.maximum(squares, 0.0) / np.maximum(factor.samples - spent, 1.0)
    return np.where(factor.samples > 0, np.maximum(variance, floor), np.nan)


def joint_weights(factor: Factor) -> Array:
    """Return the inverse residual variance per joint in an ordinary fit (n,), zero without rows."""
    ordinary = np.ones(factor.n_joints)
    first = factor.solve(ordinary)
    return inverse_variance(residual_variance(factor, first.values, first.root, ordinary))


def inverse_variance(variance: Array) -> Array:
    """Return weights (n,) of joints, zero for variances of NaN or infinity."""
    known = np.isfinite(variance)
    return np.where(known, 1.0 / np.where(known, variance, 1.0), 0.0)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters with their covariance."""

    names: tuple[str, ...]  #: (p,)
    units: tuple[str, ...]  #: (p,)
    values: Array  #: (p,)
    covariance: Array  #: (p, p); the variance of an undetermined parameter is infinite
    noise_std: Array  #: standard deviation of the torque residual per joint (n,) [N·m or N]
    samples: NDArray[np.intp]  #: rows per joint (n,)
    method: str  #: description of estimator and covariance
    condition: float  #: condition number of the weighted regressor with unit columns
    undetermined: tuple[str, ...] = ()  #: undetermined parameters, alone or in a combination
    #: standard deviations in half a 95 % interval: 1.96, more for covariances of few data
    interval_factor: float = 1.96

    @property
    def std(self) -> Array:
        """Standard deviations (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def value(self, name: str) -> float:
        """Return one parameter by name."""
        return float(self.values[self.names.index(name)])


def estimate(model: RobotModel, factor: Factor, weights: Array | None = None) -> Estimate:
    """Estimate by weighted least squares (eq. 4); weights (n,) by default from an ordinary fit.

    The covariance is the classical one, A^-1, valid for white residuals; see
    :mod:`identification.estimators.covariance` for others.

    Raises:
        IdentificationError: the factor has no rows.
    """
    require_rows(model, factor)
    if weights is None:
        weights = joint_weights(factor)
    method = f"weighted least squares{factor.words}, classical covariance (white residuals)"
    return estimate_of(model.units, factor, factor.solve(weights), weights, method)


def estimate_of(
    units: Sequence[str],
    factor: Factor,
    solution: Solution,
    weights: Array,
    method: str,
    covariance: Array | None = None,
    interval_factor: float = 1.96,
) -> Estimate:
    """Return the estimate of a solution with weights (n,); covariance by default A^-1."""
    covariance = solution.inverse if covariance is None else covariance.copy()
    mark_undetermined(covariance, solution.determined)
    variance = residual_variance(factor, solution.values, solution.root, weights)
    return Estimate(
        names=factor.parameter_names,
        units=tuple(units),
        values=solution.values,
        covariance=covariance,
        noise_std=np.sqrt(variance),
        samples=factor.samples,
        method=method,
        condition=solution.condition,
        undetermined=undetermined_names(factor.parameter_names, solution.determined),
        interval_factor=interval_factor,
    )


def require_rows(model: RobotModel, factor: Factor) -> None:
    """Raise IdentificationError without usable rows."""
    if not factor.samples.any():
        raise IdentificationError(no_rows_message(model))


def no_rows_message(model: RobotModel) -> str:
    """Return the error message for no usable rows."""
    slowest = float(np.min(model.friction.standstill))
    return (
        "there is not one usable sample: no joint moves faster than the standstill speed of"
        f" {slowest:g} rad/s or m/s away from ends and gaps of the recording"
    )


def mark_undetermined(covariance: Array, determined: NDArray[np.bool_]) -> None:
    """Set infinite variance and zero covariance of undetermined parameters, in place."""
    covariance[~determined, :] = 0.0
    covariance[:, ~determined] = 0.0
    covariance[~determined, ~determined] = np.inf


def undetermined_names(names: Sequence[str], determined: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return the names (p,) of undetermined parameters (p,)."""
    return tuple(name for name, known in zip(names, determined, strict=True) if not known)


def reduced(model: RobotModel, recordings: Sequence[Samples], gram: Factor) -> Factor:
    """Return Gram matrices of recordings, or triangles if the condition exceeds `QR_CONDITION`.

    Triangles read the samples once more; without recordings the Gram matrices are returned.

    Raises:
        IdentificationError: no usable row.
    """
    require_rows(model, gram)
    if not recordings or gram.solve(np.ones(model.n_joints)).condition <= QR_CONDITION:
        return gram
    return sum((QRFactor.of(model, samples) for samples in recordings), QRFactor.zero(model))


class Rows(NamedTuple):
    """Rows of k consecutive samples, joint by joint."""

    part: slice  # of the recording
    # per joint j its columns and, last, its torque (c_j + 1, k), zero for unusable rows; valid
    # until the next chunk
    blocks: list[Array]


def augmented_rows(model: RobotModel, samples: Samples) -> Iterator[Rows]:
    """Yield [W | y] of a recording in chunks, zero for unusable rows.

    ``model.plan.columns[j]`` are the parameters of the columns of joint j.

    Raises:
        ShapeError: wrong shape of an array.
    """
    q, qd, qdd, torque = joint_arrays(
        model.n_joints,
        position=samples.motion.position,
        velocity=samples.motion.velocity,
        acceleration=samples.motion.acceleration,
        torque=samples.torque,
    )
    chunks: Iterable[tuple[slice, list[Array]]]
    if samples.torque_bandwidth is None:
        chunks = model.plan.chunks(q, qd, qdd, samples.motion.direction, response=torque)
    else:
        chunks = _filtered(model, samples)
    for part, blocks in chunks:
        for block, lost in zip(blocks, ~samples.usable[part].T, strict=True):
            if lost.any():
                # Unusable rows may be NaN.
                block[:, np.flatnonzero(lost)] = 0.0
        yield Rows(part, blocks)


def _filtered(model: RobotModel, samples: Samples) -> Iterator[tuple[slice, list[Array]]]:
    blocks, _ = samples.regressor(model)
    tables = [
        np.concatenate([block.T, torque[None]])
        for block, torque in zip(blocks, samples.torque.T, strict=True)
    ]
    for start in range(0, len(samples.torque), CHUNK):
        part = slice(start, min(start + CHUNK, len(samples.torque)))
        yield part, [table[:, part] for table in tables]
