r"""The R factors of [W | y], one per joint: what a fit needs where Gram matrices lose digits.

.. math:: [W_j \; y_j] = Q_j R_j, \qquad R_j^T R_j = G_j

A Gram matrix squares the condition number. From a scaled condition of 1e5 on it leaves fewer
than six of sixteen digits; triangular factors keep eleven. They add as Gram matrices do, over
chunks, repetitions, archives and machines: the factor of two sets of rows is that of their
factors stacked (Golub and Van Loan 2013, section 6.5; "TSQR").
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.factor.augmented_rows import augmented_rows
from identification.factor.estimation import Estimate, Solution, mark_undetermined, solve, total
from identification.factor.gram import Factor
from identification.factor.row_solution import rows_of, solve_rows, undetermined_names
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

Array = NDArray[np.float64]

QR_CONDITION: Final = 1e5
# Share of the torque's own RMS below which a residual is rounding, not noise. A triangular factor
# gives the residual to about 1e-13 of the torque.
_SMALLEST_NOISE: Final = 1e-12


class WeightedRows(NamedTuple):
    """``R pi = z`` that stands for all rows of a weighted least-squares problem.

    Attributes:
        R: upper triangular (p, p), R'R is the weighted sum of W'W.
        z: (p,), R'z is the weighted sum of W'y.
        rest: what no parameters explain: the weighted residual norm is at least this.
        n: rows (one joint at one instant) they stand for.
    """

    R: Array
    z: Array
    rest: float
    n: int


@dataclass(frozen=True, eq=False)
class QRFactor:
    """Triangular factors of [W | y], one per joint; made and added like :class:`Factor`.

    Attributes:
        triangle: shape (n, p + 1, p + 1), upper triangular.
        samples: rows per joint, shape (n,).
        parameter_names: the p columns of W, shape (p,).
    """

    triangle: Array
    samples: NDArray[np.intp]
    parameter_names: tuple[str, ...]

    @classmethod
    def zero(cls, model: RobotModel) -> QRFactor:
        """Return the factor of no samples: what a sum starts from."""
        n, p = model.n_joints, model.n_parameters
        return cls(np.zeros((n, p + 1, p + 1)), np.zeros(n, dtype=np.intp), model.parameter_names)

    @classmethod
    def from_samples(cls, model: RobotModel, samples: Samples) -> QRFactor:
        """Reduce the usable rows of a recording.

        Raises:
            ShapeError: an array does not have the shape it should have.
        """
        return cls.from_blocks(
            model,
            (blocks for _, blocks in augmented_rows(model, samples)),
            np.count_nonzero(samples.usable, axis=0),
        )

    @classmethod
    def from_blocks(
        cls, model: RobotModel, chunks: Iterable[list[Array]], samples: NDArray[np.intp]
    ) -> QRFactor:
        """Reduce rows as :func:`augmented_rows` gives them, which may have been weighted.

        Args:
            model: the robot.
            chunks: per chunk and joint (c_j + 1, k).
            samples: rows that count, per joint (n,).
        """
        columns = model.plan.columns
        triangles = [np.zeros((0, len(c) + 1)) for c in columns]
        for blocks in chunks:
            for joint, block in enumerate(blocks):
                triangles[joint] = _triangle(np.concatenate([triangles[joint], block.T]))
        factor = cls.zero(model)
        p = model.n_parameters
        for joint, (small, used) in enumerate(zip(triangles, columns, strict=True)):
            wide = np.zeros((len(small), p + 1))
            wide[:, np.append(used, p)] = small
            # Columns of a joint need not rise, and then the wide rows are not triangular.
            factor.triangle[joint] = _square(wide)
        factor.samples[:] = samples
        return factor

    @property
    def n_joints(self) -> int:
        """Number n of joints."""
        return int(self.triangle.shape[0])

    @property
    def n_parameters(self) -> int:
        """Number p of parameters."""
        return int(self.triangle.shape[1]) - 1

    @property
    def gram(self) -> Factor:
        """The same samples as Gram matrices, for what works on those; loses digits."""
        return Factor(
            np.asarray(self.triangle.transpose(0, 2, 1) @ self.triangle),
            self.samples,
            self.parameter_names,
        )

    def __add__(self, other: QRFactor) -> QRFactor:
        """Return the factor of both sets of samples.

        Raises:
            IdentificationError: the two belong to different models.
        """
        same = self.triangle.shape == other.triangle.shape
        if not same or self.parameter_names != other.parameter_names:
            raise IdentificationError(
                "two factors with different joints or parameters cannot be added: "
                f"{self.n_joints} joints and {self.n_parameters} parameters, "
                f"{other.n_joints} joints and {other.n_parameters} parameters"
            )
        stacked = np.concatenate([self.triangle, other.triangle], axis=1)
        triangle = np.array([_square(joint) for joint in stacked])
        return QRFactor(triangle, self.samples + other.samples, self.parameter_names)

    def weighted(self, weights: Array) -> WeightedRows:
        """Return the rows for one weight per joint, shape (n,): 1/variance.

        Raises:
            ShapeError: not one weight per joint.
        """
        weights = np.asarray(weights, dtype=np.float64)
        if weights.shape != (self.n_joints,):
            raise ShapeError("weights", weights.shape, f"({self.n_joints},)")
        rows = np.sqrt(weights)[:, None, None] * self.triangle
        triangle = _square(rows.reshape(-1, rows.shape[2]))
        return WeightedRows(
            R=triangle[:-1, :-1],
            z=triangle[:-1, -1],
            rest=abs(float(triangle[-1, -1])),
            n=int(self.samples.sum()),
        )

    def solve(self, weights: Array) -> Solution:
        """Solve the weighted least-squares problem, weights (n,)."""
        rows = self.weighted(weights)
        return solve_rows(rows.R, rows.z)


def qr_residual_variance(factor: QRFactor, solution: Solution, weights: Array) -> Array:
    """Variance of the torque residual per joint (n,), NaN for a joint without rows.

    Degrees of freedom as in :func:`identification.factor.estimation.residual_variance`.
    """
    left = factor.triangle @ np.append(-solution.values, 1.0)
    squares = (left**2).sum(axis=1)
    spent = weights * ((factor.triangle[:, :, :-1] @ solution.root) ** 2).sum(axis=(1, 2))
    rows = np.maximum(factor.samples, 1)
    floor = _SMALLEST_NOISE**2 * (factor.triangle[:, :, -1] ** 2).sum(axis=1) / rows
    floor = np.maximum(floor, np.finfo(np.float64).tiny)
    variance = squares / np.maximum(factor.samples - spent, 1.0)
    return np.where(factor.samples > 0, np.maximum(variance, floor), np.nan)


def qr_joint_weights(factor: QRFactor) -> Array:
    """Inverse variance of each joint's residual in an ordinary fit (n,), zero without rows."""
    ordinary = np.ones(factor.n_joints)
    variance = qr_residual_variance(factor, factor.solve(ordinary), ordinary)
    return np.where(np.isnan(variance), 0.0, 1.0 / variance)


def qr_estimate(model: RobotModel, factor: QRFactor, weights: Array | None = None) -> Estimate:
    """Weighted least squares (eq. 4) on triangular factors.

    Values, covariance and undetermined parameters as those of
    :func:`identification.factor.estimation.estimate`, up to a scaled condition of
    `identification.factor.row_solution.WORST_ROW_CONDITION`.

    Args:
        model: the robot.
        factor: the samples; of one repetition, or a sum.
        weights: per joint (n,); by default the inverse residual variance of an ordinary fit.

    Raises:
        IdentificationError: the factor holds no rows.
    """
    if not factor.samples.any():
        raise IdentificationError("there is not one usable sample to estimate from")
    if weights is None:
        weights = qr_joint_weights(factor)
    solution = factor.solve(weights)
    covariance = solution.inverse
    mark_undetermined(covariance, solution.determined)
    return Estimate(
        names=model.parameter_names,
        units=model.units,
        values=solution.values,
        covariance=covariance,
        noise_std=np.sqrt(qr_residual_variance(factor, solution, weights)),
        samples=factor.samples,
        method="weighted least squares by QR, classical covariance (white residuals)",
        condition=solution.condition,
        undetermined=undetermined_names(model.parameter_names, solution.determined),
    )


def reduced(
    model: RobotModel, recordings: Iterable[Samples], gram: Factor | None = None
) -> Factor | QRFactor:
    """Reduce recordings to Gram matrices, or to triangles where the condition demands it.

    The Gram matrices come first, being five times as fast; the samples are read a second time
    only if the scaled condition of the ordinary problem exceeds `QR_CONDITION`.

    Args:
        model: the robot.
        recordings: can be gone through twice: a sequence, not a generator.
        gram: their factor, if it is known; without recordings all there is.

    Raises:
        IdentificationError: neither recordings nor factor, or they can be gone through only once.
    """
    if iter(recordings) is recordings:
        raise IdentificationError("recordings may have to be read twice: a sequence is needed")
    if gram is None:
        factors = [samples.factor(model) for samples in recordings]
        if not factors:
            raise IdentificationError("there are no recordings to estimate from")
        gram = total(factors)
    alone = isinstance(recordings, Sequence) and not recordings
    if alone or solve(gram.weighted(np.ones(model.n_joints))).condition <= QR_CONDITION:
        return gram
    triangles = (QRFactor.from_samples(model, samples) for samples in recordings)
    return sum(triangles, QRFactor.zero(model))


def solve_weighted(factor: Factor | QRFactor, weights: Array) -> Solution:
    """Solve the weighted least-squares problem of either kind of factor, weights (n,)."""
    if isinstance(factor, QRFactor):
        return factor.solve(weights)
    return solve_rows(*rows_of(factor.weighted(weights)))


def _triangle(rows: Array) -> Array:
    """Upper triangular R with R'R = rows'rows, of at most as many rows as columns."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def _square(rows: Array) -> Array:
    """Upper triangular R with R'R = rows'rows and as many rows as columns, missing ones zero."""
    triangle = _triangle(rows)
    square = np.zeros((rows.shape[1], rows.shape[1]))
    square[: len(triangle)] = triangle
    return square
