r"""Uncertainty of an estimate caused by elastic gears between measured motors and links.

A gear of compliance c turns its link back by c times the torque :math:`\tau_l` that it transmits.
The motors then feel the torque of links at :math:`q - C \tau_l`, whose difference to that of rigid
gears grows with the square of the frequency, as torques of inertia do at low ones:

.. math:: t = W \pi + E c + e, \quad E_j = \partial \tau_l(q - C \tau_l) / \partial c_j

Parameters take most of that up, so that no residual shows their error. Compliances are fitted
beside them, about zero with the standard deviation of `EXPECTED_RESONANCE`, and their mean square
is added to the covariance of the parameters, which stay as of rigid gears.

The smoothed motion lacks some of the arm's fast motion, and its torque grows less with the
frequency than the measured one: as if the gears were elastic. So the torque that smoothing takes
from the model is subtracted from the measured one here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
import scipy

from identification.arrays import Array
from identification.estimators.delay import DELAY_BANDWIDTH
from identification.factor.estimate import Estimate, inverse_variance
from identification.factor.factor import Factor
from identification.factor.normal_equations import solve
from identification.factor.rows import augmented_rows
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.signals.smoothing import LowPassShape, low_passed

EXPECTED_RESONANCE: Final = 2.0 * np.pi * 15.0
"""Resonance of a joint's links on its gear [rad/s] that compliances are expected at: industrial
arms have their lowest ones at 5 to 25 Hz."""
_POSTURES: Final = 20  # in which the inertia of the links is averaged
# Hz, at which the torque of elastic gears is computed: it has no more than
_SAMPLE_RATE: Final = 125.0
# `DELAY_BANDWIDTH`, as its second derivative would have the noise of accelerations
_SERIES_TERMS: Final = 3  # of a power series
_LINEARISATION_SHARE: Final = 1e-3  # share of the expected compliances by which it is linearised


@dataclass(frozen=True, eq=False)
class ElasticTorque:
    """Sums over the rows of each joint with the torque E (m, n) of compliances of one."""

    products: Array  #: W' E (n, p, n)
    squares: Array  #: E' E (n, n, n)
    measured: Array  #: E' t (n, n), of the measured torque less that lost by smoothing
    lost: Array  #: W' of the torque that is lost by smoothing the motion (n, p)
    #: expected compliances (n,) [rad/(N·m) or m/N], summed over the recordings
    compliance: Array
    recordings: float = 1.0

    @classmethod
    def of(cls, model: RobotModel, samples: Samples, values: Array) -> Self:
        """Return the sums over a recording, with parameters (p,)."""
        n = model.n_joints
        compliance = expected_compliance(model, samples, values)
        products = np.zeros((n, model.n_parameters, n))
        squares = np.zeros((n, n, n))
        measured = np.zeros((n, n))
        lost = np.zeros((n, model.n_parameters))
        missing = lost_torque(model, samples, values)
        torque = elastic_torque(model, samples, values, compliance)
        torque /= np.where(compliance > 0.0, compliance, 1.0)
        for rows, tables in augmented_rows(model, samples):
            for joint, (table, used) in enumerate(zip(tables, model.plan.columns, strict=True)):
                usable = samples.usable[rows, joint]
                effect = np.where(usable[:, None], torque[rows, joint], 0.0)
                without = np.where(usable, missing[rows, joint], 0.0)
                # The table is zero where unusable: copies of its usable columns take longer.
                sums = table @ np.column_stack([effect, without])
                products[joint][used] += sums[:-1, :-1]
                squares[joint] += effect.T @ effect
                measured[joint] += sums[-1, :-1] - effect.T @ without
                lost[joint][used] += sums[:-1, -1]
        return cls(products, squares, measured, lost, compliance)

    def plus(self, other: ElasticTorque) -> ElasticTorque:
        """Return the sums over both."""
        return ElasticTorque(
            self.products + other.products,
            self.squares + other.squares,
            self.measured + other.measured,
            self.lost + other.lost,
            self.compliance + other.compliance,
            self.recordings + other.recordings,
        )

    def scaled(self, share: float) -> ElasticTorque:
        """Return the sums with another weight of the rows."""
        return ElasticTorque(
            share * self.products,
            share * self.squares,
            share * self.measured,
            share * self.lost,
            share * self.compliance,
            share * self.recordings,
        )

    def weighted(self, weights: Array, times: float) -> tuple[Array, Array, Array]:
        """Return W' E (p, n), E' E (n, n) and E' t (n,) of the expected compliances.

        With joint weights (n,), of rows that count so many times.
        """
        size = self.compliance / self.recordings
        products, squares, measured = (
            times * np.tensordot(weights, part, axes=1)
            for part in (self.products, self.squares, self.measured)
        )
        return products * size, squares * np.outer(size, size), measured * size


def lost_torque(model: RobotModel, samples: Samples, values: Array) -> Array:
    """Return the torque of bodies and drives (m, n) lost by smoothing the motion.

    With the smoother S, the smoothed torque lacks ``1/S - 1`` of itself, which is the sum of the
    powers of 1 - S.
    """
    inertial = np.where(model.friction_columns, 0.0, values)
    torque = model.torque(inertial, samples.motion)
    lost = np.zeros_like(torque)
    for segment in samples.segments:
        time = samples.motion.time[segment]
        step = float(np.median(np.diff(time))) if len(time) > 1 else np.inf
        for joint, bandwidth in enumerate(samples.position_bandwidth):
            if 2.0 * bandwidth * step < 1.0:
                term = torque[segment, joint : joint + 1]
                for _ in range(_SERIES_TERMS):
                    term = term - low_passed(time, term, bandwidth)
                    lost[segment, joint] += term[:, 0]
    return lost


def expected_compliance(model: RobotModel, samples: Samples, values: Array) -> Array:
    """Return the compliances (n,) [rad/(N m) or m/N] of gears with the expected resonance.

    Zero for a joint whose links have no inertia by the parameters (p,).
    """
    n = model.n_joints
    rows = np.linspace(0, len(samples.torque) - 1, _POSTURES).astype(int)
    postures = np.repeat(samples.motion.position[rows], n + 1, axis=0)
    pushes = np.tile(np.concatenate((np.eye(n), np.zeros((1, n)))), (_POSTURES, 1))
    pushed = replace(Motion.at_rest(postures), acceleration=pushes)
    torque = model.gear_torque(values, pushed).reshape(_POSTURES, n + 1, n)
    inertia = np.einsum("bjj->bj", torque[:, :n] - torque[:, n:]).mean(axis=0)
    return (
        np.where(inertia > 0.0, 1.0 / np.where(inertia > 0.0, inertia, 1.0), 0.0)
        / EXPECTED_RESONANCE**2
    )


def elastic_torque(model: RobotModel, samples: Samples, values: Array, compliance: Array) -> Array:
    """Return the torque (m, n, n) that each compliance (last index) adds.

    Args:
        model: of the arm.
        samples: of the motion.
        values: parameters (p,).
        compliance: of each joint (n,).
    """
    time = samples.motion.time
    torque = np.zeros((*samples.torque.shape, model.n_joints))
    for segment in samples.segments:
        if segment.stop - segment.start < 2:
            continue
        step = float(np.median(np.diff(time[segment])))
        rows = np.arange(segment.start, segment.stop, max(1, int(1.0 / (_SAMPLE_RATE * step))))
        at = time[rows]
        motion = samples.motion.rows(rows)
        rigid = model.gear_torque(values, motion)
        order = 2
        rate = len(rows) / max(float(np.ptp(at)), step)
        if len(rows) <= 3 * (2 * order + 1) or rate <= 2.0 * DELAY_BANDWIDTH:
            continue
        slow = low_passed(at, rigid, DELAY_BANDWIDTH, LowPassShape(order))
        sag = _LINEARISATION_SHARE * compliance * slow
        sag_rate = np.gradient(sag, at, axis=0)
        sag_acceleration = np.gradient(sag_rate, at, axis=0)
        for joint in np.flatnonzero(compliance):
            only = np.arange(model.n_joints) == joint
            moved = replace(
                motion,
                position=motion.position - only * sag,
                velocity=motion.velocity - only * sag_rate,
                acceleration=motion.acceleration - only * sag_acceleration,
            )
            change = (model.gear_torque(values, moved) - rigid) / _LINEARISATION_SHARE
            for row in range(model.n_joints):
                torque[segment, row, joint] = np.interp(time[segment], at, change[:, row])
    return torque


@dataclass(frozen=True, eq=False)
class FittedGears:
    """Compliances of gears, fitted with the parameters, in units of the expected ones."""

    moved: Array  #: change of the parameters by each (p, n)
    mean: Array  #: (n,)
    covariance: Array  #: (n, n)


@dataclass(frozen=True, eq=False)
class KnownGears:
    """Knowledge of gear compliances, in units of `size`."""

    size: Array  #: (n,) [rad/(N m) or m/N]
    mean: Array  #: (n,)
    covariance: Array  #: (n, n)

    @classmethod
    def unknown(cls, size: Array) -> Self:
        """Return the prior knowledge, with the expected compliances (n,)."""
        return cls(size, np.zeros(len(size)), np.eye(len(size)))


def open_compliance(
    inverse: Array,
    products: Array,
    squares: Array,
    design_effect: float = 1.0,
    known: Array | None = None,
) -> tuple[Array, Array]:
    """Return how compliances move the parameters (p, n), and their own covariance (n, n).

    In units of the expected compliances.

    Args:
        inverse: of the information (p, p).
        products: of the parameters' columns with the compliances' (p, n).
        squares: of the compliances' columns (n, n).
        design_effect: rows that count as one.
        known: covariance of the compliances before these rows (n, n); by default one each.
    """
    moved = inverse @ products
    before = np.eye(len(squares)) if known is None else np.linalg.inv(known)
    beside = (squares - products.T @ moved) / design_effect + before
    return moved, np.asarray(np.linalg.inv(beside))


def expected_square(covariance: Array, mean: Array, scatter: Array) -> Array:
    """Return the expected mean square (n, n) of the fitted compliances of a motion not run yet.

    None is negative; different gears are taken for independent.

    Args:
        covariance: that its recordings will leave (n, n).
        mean: of their estimates (n,).
        scatter: standard deviations of these (n,).
    """
    ratio = mean / np.where(scatter > 0.0, scatter, 1.0)
    above = np.where(scatter > 0.0, scipy.special.ndtr(ratio), mean > 0.0)
    density = scatter * np.exp(-0.5 * ratio**2) / np.sqrt(2.0 * np.pi)
    positive = mean * above + density
    squares = np.outer(positive, positive)
    np.fill_diagonal(squares, (mean**2 + scatter**2) * above + mean * density)
    return np.asarray(covariance + squares)


def with_elastic_gears(estimate: Estimate, gears: FittedGears) -> Estimate:
    """Return the estimate with the mean square of the compliances in its covariance."""
    square = np.outer(gears.mean, gears.mean) + gears.covariance
    return replace(
        estimate,
        covariance=estimate.covariance + gears.moved @ square @ gears.moved.T,
        method=estimate.method.widened("elastic_gears"),
    )


def fitted_gears(
    estimate: Estimate,
    factor: Factor,
    torque: ElasticTorque,
    design_effect: float,
    precision: Array | None = None,
    believed: Array | None = None,
    times: float = 1.0,
    excess: Array | None = None,
) -> FittedGears:
    """Fit the compliances of gears together with the parameters; none is negative.

    Args:
        estimate: of p parameters and n joints, with rigid gears.
        factor: of the fitted rows.
        torque: sums of the factor's rows, or of such a share of them that each stands for `times`
            rows.
        design_effect: rows that count as one.
        precision: information (p, p) of a prior in addition to the rows.
        believed: parameters (p,) of rigid gears by that prior, by default of the estimate;
            what a stronger prior leaves unexplained is no torque of gears.
        times: see `torque`.
        excess: scores (p,) of the rows of `torque`, each `times`, beyond those of the factor; of
            repetitions that differ from the others. None: of the same rows.
    """
    weights = inverse_variance(estimate.noise_std**2)
    products, squares, measured = torque.weighted(weights, times)
    errors = measured - products.T @ (estimate.values if believed is None else believed)
    equations = factor.weighted(weights)
    if precision is not None:
        equations = equations._replace(A=equations.A + precision)
    determined = np.isfinite(np.diag(estimate.covariance))
    inverse = np.where(determined[:, None], solve(equations).inverse, 0.0)
    moved, covariance = open_compliance(inverse, products, squares, design_effect)
    lost = times * np.tensordot(weights, torque.lost, axes=1)
    errors = errors + moved.T @ (lost if excess is None else lost - excess)
    # Correlated compliances cannot be cut off at zero one by one.
    root = np.linalg.cholesky(np.linalg.inv(covariance))
    mean, _ = scipy.optimize.nnls(root.T, root.T @ (covariance @ errors) / design_effect)
    return FittedGears(moved, mean, covariance)
