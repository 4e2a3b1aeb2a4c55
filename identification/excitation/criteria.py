r"""Excitation criteria, and the objective of a search.

They are functions of the Gram matrix :math:`\Phi^T\Phi` (p, p) of the regressor, which is scaled to
unit diagonal against overflow. For a singular matrix each returns its worst value.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array
from identification.excitation.constraints import midpoints
from identification.excitation.motion_precision import Precision
from identification.factor.factor import Factor
from identification.model.friction import JointFriction
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from planner.arrays import Whole, strict
from planner.piecewise_cubic import Trajectory


def information(factor: Factor) -> Array:
    """Return the Gram matrix (p, p) of the stacked regressor, without joint weights."""
    total: Array = factor.gram.sum(axis=0)
    return total[:-1, :-1]


class _Cholesky(NamedTuple):
    """Column norms (p,) and the lower Cholesky factor (p, p) of the Gram of unit columns."""

    scale: Array
    lower: Array

    @property
    def inverse(self) -> Array:
        """The inverse of the Gram matrix (p, p)."""
        half, _ = scipy.linalg.lapack.dpotri(self.lower, lower=1)
        scaled = np.tril(half) + np.tril(half, -1).T
        return np.asarray(scaled / self.scale[:, None] / self.scale)

    @property
    def correlation(self) -> Array:
        """Lower triangle of the correlation matrix (p, p)."""
        half, _ = scipy.linalg.lapack.dpotri(self.lower, lower=1)
        deviation = np.sqrt(np.diag(half))
        return np.asarray(np.tril(half) / deviation[:, None] / deviation)


def _log10_det(gram: _Cholesky, n_samples: float) -> float:
    logs = np.log10(np.diag(gram.lower)) + np.log10(gram.scale) - 0.5 * np.log10(n_samples)
    return float(2.0 * logs.sum())


def _coupling_index(gram: _Cholesky, _: float) -> float:
    return float(np.abs(np.tril(gram.correlation, -1)).sum())


SMALL_CORRELATION: Final = 0.02
"""Correlation below which the slope of I_c is smoothed: I_c has a kink where one changes its sign.
Along the exact slope the NS 16 needed 1.4 times as many steps."""


def _log10_det_slope(gram: _Cholesky) -> Array:
    """Return the derivative (p, p) of log10 det by the Gram matrix: its inverse / ln 10."""
    return np.asarray(gram.inverse / np.log(10.0))


def _coupling_index_slope(gram: _Cholesky) -> Array:
    r"""Return :math:`-C A C` with C the inverse Gram and :math:`A = \partial I_c / \partial C`.

    The absolute value of a correlation r is that of :math:`\sqrt{r^2 + \epsilon^2}`.
    """
    inverse = gram.inverse
    deviation = np.sqrt(np.diag(inverse))
    coupled = inverse / deviation[:, None] / deviation
    np.fill_diagonal(coupled, 0.0)
    sign = coupled / np.hypot(coupled, SMALL_CORRELATION)
    inner = 0.5 * sign / deviation[:, None] / deviation
    np.fill_diagonal(inner, -0.5 * (sign * coupled).sum(axis=1) / deviation**2)
    return -(inverse @ inner @ inverse)


def coupling_index_max(p: int) -> float:
    """Return the largest coupling index of p parameters, p (p - 1) / 2."""
    return p * (p - 1) / 2.0


class Criterion(NamedTuple):
    """A criterion that searches can optimise."""

    score: Callable[[_Cholesky, float], float]  # of a factorised Gram matrix and N time samples
    label: str  # name in messages
    sense: float  # 1 to maximise, -1 to minimise
    title: str  # name in tables and at axes
    meaning: str  # explanation in the report
    decimals: int  # in the report
    relative: bool  # whether the report states its change in percent
    largest: Callable[[int], float] | None = None  # largest value for p parameters
    # derivative (p, p) of the score by the Gram matrix; None: steps along the gradient ignore it
    slope: Callable[[_Cholesky], Array] | None = None

    @property
    def better(self) -> str:
        """Which values are better."""
        return "higher is better" if self.sense > 0.0 else "lower is better"


CRITERIA: Final[Mapping[str, Criterion]] = {
    "log10_det": Criterion(
        _log10_det,
        "log det",
        1.0,
        "log₁₀ det(ΦᵀΦ / N)",
        "eq. 9: information, in SI units",
        2,
        relative=False,
        slope=_log10_det_slope,
    ),
    "coupling_index": Criterion(
        _coupling_index,
        "I_c",
        -1.0,
        "Coupling index I_c",
        "eq. 5: sum of |correlations|",
        1,
        relative=True,
        largest=coupling_index_max,
        slope=_coupling_index_slope,
    ),
}
"""Criteria by the name of their field in :class:`Criteria`; of each motion all are computed."""

SENSE: Final = np.array([criterion.sense for criterion in CRITERIA.values()])
OF_PAPER: Final = ("log10_det", "coupling_index")
"""The criteria of the paper."""


def columns(values: Array, criteria: Sequence[str]) -> Array:
    """Return some `CRITERIA` (..., k) of an array of all (..., d)."""
    names = tuple(CRITERIA)
    return np.take(values, [names.index(name) for name in criteria], axis=-1)


def friction_of_excitation(model: RobotModel) -> JointFriction:
    """Return the friction of a model, reduced below the standstill speed.

    A joint that rests while others move has a speed of rounding or noise, whose sign shows no dry
    friction.
    """
    laws = tuple(
        replace(law, zone="linear", presliding=0.0) if law.standstill > 0.0 else law
        for law in model.friction.laws
    )
    return replace(model.friction, laws=laws)


def measures(gram: Array, n_samples: float) -> dict[str, float]:
    """Return the values of all `CRITERIA` for a Gram matrix (p, p)."""
    root = _factorised(gram)
    return {
        name: -criterion.sense * np.inf if root is None else criterion.score(root, n_samples)
        for name, criterion in CRITERIA.items()
    }


def log10_det(gram: Array, n_samples: int) -> float:
    r"""Return :math:`\log_{10}(\det(\Phi^T\Phi) / N^{N_\pi})`, -inf for a singular matrix (p, p).

    N counts time samples as in the paper's Table 1, not rows.
    """
    return measures(gram, n_samples)["log10_det"]


def coupling_index(gram: Array) -> float:
    """Return I_c (eq. 5), from 0 to :func:`coupling_index_max`; inf for a singular matrix."""
    return measures(gram, 1)["coupling_index"]


def correlation(gram: Array) -> Array:
    r"""Return :math:`\psi_{ij} / \sqrt{\psi_{ii}\psi_{jj}}` of the inverse Gram (p, p).

    Eq. 5 and Fig. 2: the correlation of the estimates under equal, uncorrelated torque noise.
    All entries are NaN for a singular matrix.
    """
    root = _factorised(gram)
    if root is None:
        return np.full(np.shape(gram), np.nan)
    correlated = root.correlation
    correlated += np.tril(correlated, -1).T
    np.fill_diagonal(correlated, 1.0)
    return correlated


def fitness_eq7(
    log10_det: float, coupling_index: float, p: int, weights: tuple[float, float] = (0.7, 0.3)
) -> float:
    r"""Return :math:`\lambda_1 \log_{10}|\det/N^{N_\pi}| + \lambda_2 I_{c,max}/I_c`, as printed.

    The first term is larger by an order of magnitude.

    Args:
        log10_det: of the information; -inf for a singular matrix, as is the result.
        coupling_index: I_c.
        p: number of parameters.
        weights: of the two terms.
    """
    if not np.isfinite(log10_det) or not np.isfinite(coupling_index):
        return -np.inf
    coupling = np.inf if coupling_index == 0.0 else coupling_index_max(p) / coupling_index
    return weights[0] * log10_det + weights[1] * coupling


def condition_number(gram: Array, *, scaled: bool) -> float:
    """Return the condition number of Phi, with columns scaled to unit length or as they are.

    Unscaled it depends on units. inf for a singular matrix.
    """
    matrix = np.asarray(gram, dtype=np.float64)
    scale = np.sqrt(np.diag(matrix))
    if not np.all(np.isfinite(scale) & (scale > 0.0)):
        return np.inf
    if scaled:
        matrix = matrix / scale[:, None] / scale
    values = np.linalg.eigvalsh(matrix)
    if values[0] <= _smallest_pivot(len(matrix)) * values[-1]:
        return np.inf
    return float(np.sqrt(values[-1] / values[0]))


@dataclass(frozen=True)
class Criteria:
    """Excitation criteria of a motion (paper, eqs. 5, 7 and 9)."""

    log10_det: float  #: log10 of det(Phi^T Phi) / N^p; depends on units
    coupling_index: float  #: I_c, to be minimised
    fitness: float  #: eq. 7 with the paper's weights 0.7 and 0.3
    n_samples: int  #: N of eq. 9: time samples of the motion
    condition: float | None = None  #: condition number of Phi; depends on units; None: unknown
    scaled_condition: float | None = None  #: the same with columns of unit length

    @property
    def measures(self) -> tuple[float, ...]:
        """Values of `CRITERIA`, in their order; NaN where an earlier file lacks them."""
        values = (getattr(self, name) for name in CRITERIA)
        return tuple(np.nan if value is None else value for value in values)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Restore what `dataclasses.asdict` returned.

        Raises:
            TypeError, LookupError, ValueError: invalid data.
        """
        given = {name: value for name, value in data.items() if value is not None}
        n_samples = strict(Whole, given.pop("n_samples"))
        return cls(**strict(dict[str, float], given), n_samples=n_samples)

    @classmethod
    def of_gram(cls, gram: Array, n_samples: int, given: float = 0.0) -> Self:
        """Evaluate the criteria for the Gram matrix (p, p) of N time samples and `given` others."""
        values = measures(gram, n_samples + given)
        return cls(
            **values,
            fitness=fitness_eq7(values["log10_det"], values["coupling_index"], len(gram)),
            n_samples=n_samples,
            condition=condition_number(gram, scaled=False),
            scaled_condition=condition_number(gram, scaled=True),
        )


def _factorised(gram: Array) -> _Cholesky | None:
    """Return the factor of a Gram matrix (p, p), None if it is singular."""
    matrix = np.asarray(gram, dtype=np.float64)
    scale = np.sqrt(np.diag(matrix))
    if not np.all(np.isfinite(scale) & (scale > 0.0)):
        return None
    lower, info = scipy.linalg.lapack.dpotrf(matrix / scale[:, None] / scale, lower=1)
    if info != 0 or np.min(np.diag(lower)) ** 2 <= _smallest_pivot(len(matrix)):
        return None
    return _Cholesky(scale, lower)


def _smallest_pivot(p: int) -> float:
    """Return the largest pivot that rounding can leave in place of zero, for unit columns."""
    return 4.0 * p * float(np.finfo(np.float64).eps)


@dataclass(frozen=True, eq=False)
class Given:
    """Information of earlier recordings, to which a motion adds its own."""

    mean: Array  #: Gram matrix of the regressor (p, p), of one time sample on average
    duration: float  #: of their motions together [s]

    def count(self, step: float) -> float:
        """Return to how many samples of a step [s] the recordings amount."""
        return self.duration / step


class _JointSums(NamedTuple):
    """Sums over a motion, of each joint."""

    grams: list[Array]  # Gram matrix of its columns
    rows: list[Array]  # of its rows


@dataclass(frozen=True, eq=False)
class Objective:
    """Evaluates motions by the information on a model's parameters.

    The paper's criteria use all parameters, no weights (section 3.1) and information per sample,
    so that motions of different length compare (section 3.2).
    """

    model: RobotModel  #: the robot, with p parameters
    parameters: NDArray[np.intp] | None = None  #: indices (e,) of those in the criteria; None: all
    #: of earlier recordings: the criteria describe all recordings and the motion together
    given: Given | None = None
    precision: Precision | None = None  #: required; adds a criterion to the `CRITERIA`

    @property
    def n_parameters(self) -> int:
        """Number e of parameters in the criteria."""
        return self.model.n_parameters if self.parameters is None else len(self.parameters)

    def information(self, motion: Motion) -> Array:
        """Return the information (e, e) of a uniformly sampled motion, and of what is given.

        Raises:
            ShapeError: an array of the motion has the wrong shape.
        """
        return self._judged(motion, self._gram(self._joint_sums(motion).grams))

    def _judged(self, motion: Motion, total: Array) -> Array:
        """Return the Gram matrix (e, e) of what is judged, with what is given."""
        if self.given is not None:
            total = total + self.n_given(motion) * self.given.mean
        return total if self.parameters is None else total[np.ix_(self.parameters, self.parameters)]

    def measures(self, motion: Motion) -> dict[str, float]:
        """Return the `CRITERIA` of a sampled motion by name (see :meth:`information`)."""
        return measures(self.information(motion), motion.n_samples + self.n_given(motion))

    def scores(self, motion: Motion) -> tuple[dict[str, float], float]:
        """Return the `CRITERIA` of a sampled motion, and the criterion of the precision, else 0."""
        sums = self._joint_sums(motion)
        values = measures(
            self._judged(motion, self._gram(sums.grams)), motion.n_samples + self.n_given(motion)
        )
        if self.precision is None:
            return values, 0.0
        return values, self.precision.criterion(self._precise(motion, sums))

    def precise_grams(self, motion: Motion) -> Array:
        """Return the Gram matrix (n, p, p) of the rows of each joint, as the precision has them."""
        p = self.model.n_parameters
        grams = np.zeros((self.model.n_joints, p, p))
        by_joint = self._precise_by_joint(motion, self._joint_sums(motion))
        for joint, (index, gram) in enumerate(zip(self._block_indices, by_joint, strict=True)):
            grams[joint][index] = gram
        return grams

    def precise_information(self, motion: Motion) -> Array:
        """Return the information (p, p) of a sampled motion by the stated torque error."""
        return self._precise(motion, self._joint_sums(motion))

    def precise_means(self, motion: Motion) -> list[Array] | None:
        """Return the mean of each joint's columns, from which the precision counts them.

        None if it counts them from zero.
        """
        if self.precision is None or not self.precision.has_offsets:
            return None
        return [row / motion.n_samples for row in self._joint_sums(motion).rows]

    def _precise(self, motion: Motion, sums: _JointSums) -> Array:
        return self._gram(self._precise_by_joint(motion, sums), self._joint_weights(motion))

    def _precise_by_joint(self, motion: Motion, sums: _JointSums) -> list[Array]:
        """Return the Gram matrix of each joint's columns; from their mean if it has an offset.

        What an unknown offset of the torque leaves: the offset is eliminated from the equations.
        """
        assert self.precision is not None
        if not self.precision.has_offsets:
            return sums.grams
        return [
            gram - np.outer(row, row) / motion.n_samples
            for gram, row in zip(sums.grams, sums.rows, strict=True)
        ]

    def _joint_weights(self, motion: Motion) -> Array:
        """Return the weight of a sample of each joint (n,) by the stated torque error."""
        assert self.precision is not None
        return np.asarray((motion.time[1] - motion.time[0]) / self.precision.density)

    def n_given(self, motion: Motion) -> float:
        """Return the samples that the given recordings have at the period of a motion."""
        if self.given is None:
            return 0.0
        return self.given.count(float(motion.time[1] - motion.time[0]))

    def criteria(self, trajectory: Trajectory, period: float) -> Criteria:
        """Return all criteria of a planned motion, sampled every `period` [s]."""
        motion = midpoints(trajectory, period)
        return Criteria.of_gram(self.information(motion), motion.n_samples, self.n_given(motion))

    def slope(self, gram: Array, weights: Array) -> Array:
        """Return the derivative (e, e) of `weights` (d,) times the `CRITERIA` by an information.

        It is zero where the information is singular.
        """
        root = _factorised(gram)
        total = np.zeros_like(gram)
        if root is not None:
            for weight, criterion in zip(weights.tolist(), CRITERIA.values(), strict=True):
                if weight != 0.0 and criterion.slope is not None:
                    total += weight * criterion.slope(root)
        return total

    def along(
        self,
        motion: Motion,
        matrix: Array,
        weights: Array | None = None,
        means: Sequence[Array] | None = None,
    ) -> Array:
        r"""Return :math:`\mathrm{tr}(\Phi_t M \Phi_t^T)` of each sample (m,).

        Args:
            motion: of m samples.
            matrix: M (e, e); with weights (p, p), of all parameters.
            weights: of the rows of the joints (n,).
            means: subtracted from each joint's columns.
        """
        model = self.model
        if self.parameters is not None and weights is None:
            whole = np.zeros((model.n_parameters, model.n_parameters))
            whole[np.ix_(self.parameters, self.parameters)] = matrix
            matrix = whole
        blocks = [matrix[index] for index in self._block_indices]
        if weights is not None:
            blocks = [weight * block for weight, block in zip(weights, blocks, strict=True)]
        total = np.zeros(motion.n_samples)
        for part, rows in model.chunks(self._with_direction(motion)):
            for joint, (columns, block) in enumerate(zip(rows, blocks, strict=True)):
                if means is not None:
                    columns = columns - means[joint][:, None]
                total[part] += np.einsum("pm,pm->m", columns, block @ columns)
        return total

    @cached_property
    def _friction(self) -> JointFriction:
        return friction_of_excitation(self.model)

    def _with_direction(self, motion: Motion) -> Motion:
        """Return the motion, checked, with the direction of dry friction in an excitation."""
        motion = motion.checked(self.model.n_joints)
        timeless = replace(motion, time=np.zeros(motion.n_samples))
        return replace(motion, direction=self._friction.direction(timeless))

    def _joint_sums(self, motion: Motion) -> _JointSums:
        """Return the sums over the rows of each joint."""
        grams = [np.zeros((len(used), len(used))) for used in self.model.plan.columns]
        totals = [np.zeros(len(used)) for used in self.model.plan.columns]
        for _, rows in self.model.chunks(self._with_direction(motion)):
            for joint, block in enumerate(rows):
                grams[joint] += block @ block.T
                totals[joint] += block.sum(axis=1)
        return _JointSums(grams, totals)

    def _gram(self, grams: Sequence[Array], weights: Array | None = None) -> Array:
        """Return the Gram matrix (p, p) of all joints, of weights (n,) or equal ones."""
        total = np.zeros((self.model.n_parameters, self.model.n_parameters))
        for joint, (index, gram) in enumerate(zip(self._block_indices, grams, strict=True)):
            total[index] += gram if weights is None else weights[joint] * gram
        return total

    @cached_property
    def _block_indices(self) -> list[tuple[NDArray[np.intp], ...]]:
        """Index of each joint's block in the Gram matrix."""
        return [np.ix_(used, used) for used in self.model.plan.columns]
