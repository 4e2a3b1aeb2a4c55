r"""Payload on the flange, from recordings without and with it.

One weighted least-squares problem over all recordings. The arm's parameters are shared, the ten
parameters of a body at the flange act in loaded recordings only, and each recording k has its own
offset and friction scale of every joint:

.. math:: \tau = W \pi + [\text{loaded}]\, L \beta + \delta_k + \varphi_k \odot f, \qquad
          f = W_f \hat\pi_f

The friction f is that of the previous iteration, with weak priors (:data:`FRICTION_DRIFT_STD`) on
the drifts. The covariance is cluster-robust by time of the motion, and contains the uncertainty of
the torque scale (:mod:`identification.estimators.torque_scale`) if that is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.estimators.payload_problem import (
    AXIS_ROUNDING,
    N_BODY_PARAMETERS,
    BodyFit,
    KnownArm,
    Run,
    about_frame,
    fit_body,
)
from identification.estimators.torque_scale import scale_covariance
from identification.factor.estimation_method import TimeBlocks
from identification.factor.normal_equations import MAX_UNDETERMINED_SHARE
from identification.model.pseudo_inertia import (
    Body,
    body,
    inertial_from_pseudo,
    inertial_parameters,
    pseudo_inertia,
)
from identification.model.robot import RobotModel

_INERTIA_INDICES: Final = np.arange(6)
_DIAGONAL_INDICES: Final = [4, 7, 9]  # of a tensor, among `NAMES`
_NORMAL_95: Final = 1.959963984540054  # standard deviations in half a 95 % interval
_BALL_DENSITY: Final = 1000.0  # kg/m³; a ball of it is the least inertia worth determining
_MIN_DENSITY: Final = 10.0  # kg/m³, of foam: a ball of it contains the centre of what is carried

CONTRADICTION_SIGMAS: Final = 5.0
MASS_TOLERANCE: Final = 0.1
"""Share of the mass by which two weighings may differ: pairs of recordings of a real arm differ by
2 %, and friction by `FRICTION_DRIFT_STD`."""
CENTRE_TOLERANCE: Final = 0.2
"""The same of a first moment, as a share of mass times distance, or times the radius of a ball."""

NAMES: Final = ("mass", "cx", "cy", "cz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Figures of a body: mass, centre of mass, inertia tensor about it."""


def figures_of(carried: Body) -> Array:
    """Return the figures of a body (10,), as `NAMES`."""
    tensor = carried.inertia[np.triu_indices(3)]
    return np.concatenate([[carried.mass], carried.centre, tensor])


class PayloadError(IdentificationError):
    """The recordings do not determine a payload."""


@dataclass(frozen=True, eq=False)
class PayloadEstimate:
    """Payload of the arm at a frame."""

    parameters: Array  # about the frame's origin (10,), as `LINK_SYMBOLS`, unconstrained
    # mass and centre as estimated, with the nearest consistent tensor of the determined moments;
    # None without significant mass
    body: Body | None
    # 95 % intervals of `NAMES` (10, 2), including `body`; infinite if undetermined
    intervals: Array
    # mass times distance of centre from the frame's origin [kg m], and interval
    moment: tuple[float, float, float]
    undetermined: tuple[str, ...]  # figures of the body that are set to zero
    # of those, moments of inertia whose 95 % interval lies below zero: no body has them
    impossible: tuple[str, ...]
    blocks: TimeBlocks  # of the covariance
    # share of the squared interval of the mass that the torque scale makes; no recording reduces it
    scale_share: float = 0.0

    @property
    def is_beyond_reach(self) -> bool:
        """Whether its centre is farther from the frame than any load of this mass is large."""
        _, high = self.intervals[0]
        return self.body is not None and self.moment[1] > high * ball_radius(high, _MIN_DENSITY)


def identify_payload(
    model: RobotModel,
    runs: Sequence[Run],
    scale_std: Array | None = None,
    arm: KnownArm | None = None,
) -> PayloadEstimate:
    """Estimate the body that the loaded recordings carry and the bare ones do not.

    Args:
        model: of the arm.
        runs: the recordings.
        scale_std: relative standard deviation of each joint's torque scale (n,), common to all
            recordings; by default zero.
        arm: what is known of it, in place of bare recordings or in addition.

    Raises:
        PayloadError: undetermined mass, or negative mass.
        IdentificationError: no usable row.
    """
    estimate = _body_estimate(model, runs, scale_std, arm)
    mass, low, high = _determined_mass(estimate)
    intervals = np.tile([-np.inf, np.inf], (N_BODY_PARAMETERS, 1))
    intervals[0] = max(0.0, low), high
    if low <= 0.0:
        undetermined = NAMES[1:]
        return PayloadEstimate(
            estimate.values, None, intervals, estimate.moment, undetermined, (), estimate.blocks
        )
    intervals[1:4] = estimate.centre_intervals
    open_ended = np.isinf(intervals[:, 1])
    centre = np.where(open_ended[1:4], 0.0, estimate.values[6:9] / mass)
    to_centre = about_frame(np.eye(3), -centre)[_INERTIA_INDICES]
    six = to_centre @ estimate.values
    halves = estimate.halves(to_centre)
    lower, upper = _off_centre(mass, (intervals[1:4, 1] - intervals[1:4, 0]) / 2.0)
    intervals[4:] = np.column_stack([six - halves - lower, six + halves + upper])
    negative = _impossible(intervals, AXIS_ROUNDING * mass * (1.0 + float(centre @ centre)))
    if negative.any():  # nor is a tensor with such an entry that of a body
        intervals[4:] = [-np.inf, np.inf]
    intervals[_DIAGONAL_INDICES] = np.maximum(intervals[_DIAGONAL_INDICES], 0.0)
    radius = ball_radius(mass)
    width = (intervals[4:, 1] - intervals[4:, 0]) / 2.0
    zero = (intervals[4:, 0] <= 0.0) & (intervals[4:, 1] >= 0.0)
    open_ended[4:] = np.isinf(width) | (zero & (width > 0.4 * mass * radius**2))
    carried = _consistent(mass, centre, np.where(open_ended[4:], 0.0, six))
    figures = figures_of(carried)
    return PayloadEstimate(
        parameters=estimate.values,
        body=carried,
        intervals=np.column_stack(
            [np.minimum(intervals[:, 0], figures), np.maximum(intervals[:, 1], figures)]
        ),
        moment=estimate.moment,
        undetermined=tuple(np.array(NAMES)[open_ended].tolist()),
        impossible=tuple(np.array(NAMES)[negative].tolist()),
        blocks=estimate.blocks,
        scale_share=estimate.scale_share_of_mass,
    )


def _determined_mass(estimate: _BodyEstimate) -> tuple[float, float, float]:
    """Return mass and interval [kg] of a body; PayloadError if undetermined, or negative."""
    mass, low, high = estimate.mass
    if not np.isfinite(high):
        raise PayloadError(
            "the motion does not separate the mass from other parameters; record one that moves"
            " more axes, with the wrist in many poses"
        )
    if high < 0.0:
        if estimate.moment[1] > -low * ball_radius(-low, _MIN_DENSITY):
            distance = estimate.moment[0] / -mass
            raise PayloadError(
                f"the loaded recordings are {-mass:.3g} kg lighter than the bare ones, with a"
                f" centre of mass {distance:.2g} m from the frame: that is not a load but a "
                f"change of the arm itself; record both on a warm arm, one after the other"
            )
        raise PayloadError(
            f"the bare recordings carry {-mass:.3g} kg more than the loaded ones; check whether"
            " they are interchanged, and the sign of the torques"
        )
    return mass, low, high


def _impossible(intervals: Array, rounding: float) -> NDArray[np.bool_]:
    """Return which figures (10,) are moments of inertia that are negative beyond rounding."""
    negative = np.zeros(N_BODY_PARAMETERS, dtype=np.bool_)
    negative[_DIAGONAL_INDICES] = intervals[_DIAGONAL_INDICES, 1] < -rounding
    return negative


@dataclass(frozen=True)
class Weighing:
    """Body of one recording alone, if it is determined."""

    name: str  # of the recording
    mass: tuple[float, float, float]  # value and 95 % interval [kg]
    centre: Array  # of mass in the frame (3,) [m], NaN where undetermined


def contradiction(
    model: RobotModel,
    runs: Sequence[Run],
    estimate: PayloadEstimate,
    arm: KnownArm | None = None,
) -> tuple[Weighing, Weighing] | None:
    """Return two loaded, or two bare recordings that carry different bodies; None if all agree.

    Each loaded recording is weighed by itself against all bare ones, each bare one against the
    first. Bodies differ if a difference of mass or first moments is above
    `CONTRADICTION_SIGMAS` standard deviations and above the shares of what was weighed that
    friction and model errors explain (`MASS_TOLERANCE`, `CENTRE_TOLERANCE`). The torque scale is
    the same in all recordings.

    Args:
        model: of the arm.
        runs: the recordings.
        estimate: of the payload from all of them.
        arm: what is known of it.
    """
    bare, loaded = ([run for run in runs if run.loaded == kind] for kind in (False, True))
    mass = float(estimate.parameters[9])
    size = max(estimate.moment[0], mass * ball_radius(mass))
    limits = np.array([CENTRE_TOLERANCE * size] * 3 + [MASS_TOLERANCE * mass])
    if len(loaded) > 1:
        single = [_body_estimate(model, [*bare, run], arm=arm) for run in loaded]
        for other, run in zip(single[1:], loaded[1:], strict=True):
            if _differs(single[0], other, limits):
                return _weighing(loaded[0].name, single[0]), _weighing(run.name, other)
    for run in bare[1:]:
        difference = _body_estimate(model, [bare[0], replace(run, loaded=True)])
        if _differs(None, difference, limits):
            nothing = Weighing(bare[0].name, (0.0, 0.0, 0.0), np.full(3, np.nan))
            return nothing, _weighing(run.name, difference)
    return None


def _differs(first: _BodyEstimate | None, second: _BodyEstimate, limits: Array) -> bool:
    """Return whether first moments and mass (4,) differ, beyond chance and limits; None is zero."""
    rows = np.eye(N_BODY_PARAMETERS)[6:]
    change = rows @ second.values
    variance = second.variances(rows)
    if first is not None:
        change = change - rows @ first.values
        variance = variance + first.variances(rows)
    # Infinite variances are never exceeded.
    beyond = np.abs(change) > np.maximum(limits, CONTRADICTION_SIGMAS * np.sqrt(variance))
    return bool(beyond.any())


def _weighing(name: str, estimate: _BodyEstimate) -> Weighing:
    determined = estimate.is_determined(np.eye(N_BODY_PARAMETERS)[6:])
    centre = (
        estimate.values[6:9] / estimate.values[9]
        if estimate.values[9] != 0.0
        else np.full(3, np.nan)
    )
    return Weighing(name, estimate.mass, np.where(determined[:3], centre, np.nan))


def reach(model: RobotModel, frame: str | None, travel: Array) -> float:
    """Return how far a frame can be from the first joint's axis [m].

    The sum of the chain's lengths; `travel` (n,) is the largest displacement of each joint from
    zero [rad or m], of which that of prismatic joints counts.

    Raises:
        ModelError: the description has no such frame, or it is fixed to the base.
    """
    joint, _, translation = model.chain.frame(frame)
    path = list(model.chain.ancestors(joint))
    lengths = np.linalg.norm(model.chain.translation[path[1:]], axis=1)
    slides = np.where(model.chain.revolute, 0.0, travel)[path]
    return float(lengths.sum() + slides.sum() + np.linalg.norm(translation))


def ball_radius(mass: float, density: float = _BALL_DENSITY) -> float:
    """Return the radius of a ball [m], by default with the density of water [kg/m³]."""
    return float((3.0 * mass / (4.0 * np.pi * density)) ** (1.0 / 3.0))


def mass_difference(model: RobotModel, runs: Sequence[Run]) -> tuple[float, float, float]:
    """Return the mass difference of loaded to bare recordings [kg], and its 95 % interval.

    Raises:
        IdentificationError: no usable row.
    """
    return _body_estimate(model, runs).mass


def _consistent(mass: float, centre: Array, six: Array) -> Body:
    """Return the body with the second moments of a tensor (6,) about its centre, or zero."""
    about = body(np.concatenate([six, np.zeros(3), [mass]]))
    moments, axes = np.linalg.eigh(pseudo_inertia(inertial_parameters(about)))
    inside = inertial_from_pseudo((axes * np.maximum(moments, 0.0)) @ axes.T)
    return Body(mass, centre, body(inside).inertia)


def _off_centre(mass: float, reach: Array) -> tuple[Array, Array]:
    """Return how much smaller and larger a tensor may be (6,), (6,) by centre errors (3,)."""
    with np.errstate(invalid="ignore"):
        products = mass * np.nan_to_num(np.outer(reach, reach), nan=np.inf, posinf=np.inf)
    xx, xy, xz, yy, yz, zz = products[np.triu_indices(3)]
    off_diagonal = np.array([0.0, xy, xz, 0.0, yz, 0.0])
    return off_diagonal + np.array([yy + zz, 0.0, 0.0, xx + zz, 0.0, xx + yy]), off_diagonal


class _BodyEstimate(NamedTuple):
    """Ten parameters of a body, and which of them are determined."""

    values: Array  # (10,)
    determined: Array  # determined combinations (r, 10)
    fit: BodyFit  # of those
    by_scale: Array  # covariance of those that the torque scale makes (r, r)

    @property
    def blocks(self) -> TimeBlocks:
        """Blocks of time of its covariance."""
        return self.fit.clustered.blocks

    @property
    def scale_share_of_mass(self) -> float:
        """Share of the squared interval of the mass that the torque scale makes."""
        mass = np.linalg.pinv(self.determined)[9]
        by_scale = _NORMAL_95**2 * float(mass @ self.by_scale @ mass)
        return by_scale / float(self.squares(np.eye(N_BODY_PARAMETERS)[[9]])[0, 0])

    def squares(self, rows: Array) -> Array:
        """Return the matrix (k, k) whose diagonal are squared halves of 95 % intervals.

        Of functions (k, 10) of the parameters, determined part. Student's factor is for variances
        that are estimated from blocks, that of the scale is stated.
        """
        if not np.isfinite(self.fit.covariance).all():
            return np.full((len(rows), len(rows)), np.inf)
        combinations = rows @ np.linalg.pinv(self.determined)
        scaled = combinations * self.fit.interval_factors(combinations)[:, None]
        by_scale = _NORMAL_95**2 * combinations @ self.by_scale @ combinations.T
        return np.asarray(scaled @ self.fit.covariance @ scaled.T + by_scale)

    def halves(self, rows: Array) -> Array:
        """Return halves of 95 % intervals of functions (k, 10), infinite if undetermined."""
        return np.where(self.is_determined(rows), np.sqrt(np.diag(self.squares(rows))), np.inf)

    def variances(self, rows: Array) -> Array:
        """Return variances of functions (k, 10) for a known scale, infinite if undetermined."""
        combinations = rows @ np.linalg.pinv(self.determined)
        variance = np.einsum("kr,rs,ks->k", combinations, self.fit.covariance, combinations)
        return np.where(self.is_determined(rows), variance, np.inf)

    def is_determined(self, rows: Array) -> NDArray[np.bool_]:
        """Return whether functions (k, 10) of the parameters are determined."""
        scale = np.linalg.norm(self.determined, axis=0)  # for equal units
        scale = np.where(scale > AXIS_ROUNDING * scale.max(initial=0.0), scale, 1.0)
        lost = (rows - rows @ np.linalg.pinv(self.determined) @ self.determined) / scale
        length = np.linalg.norm(rows / scale, axis=1)
        return np.asarray(np.linalg.norm(lost, axis=1) < MAX_UNDETERMINED_SHARE * length)

    @property
    def mass(self) -> tuple[float, float, float]:
        """Mass and its interval [kg], infinite if undetermined."""
        value = float(self.values[9])
        half = float(self.halves(np.eye(N_BODY_PARAMETERS)[[9]])[0])
        return value, value - half, value + half

    @property
    def moment(self) -> tuple[float, float, float]:
        """Length of the first moment and its interval [kg m]."""
        first = self.values[6:9]
        length = float(np.linalg.norm(first))
        row = np.zeros((1, N_BODY_PARAMETERS))
        row[0, 6:9] = first / length if length > 0.0 else 1.0 / np.sqrt(3.0)
        half = float(self.halves(row)[0])
        return length, max(0.0, length - half), length + half

    @property
    def centre_intervals(self) -> Array:
        """95 % intervals of the centre (3, 2), a ratio (Fieller 1954)."""
        determined = self.is_determined(np.eye(N_BODY_PARAMETERS))
        covariance = self.squares(np.eye(N_BODY_PARAMETERS))
        first = self.values[6:9]
        mass = self.values[9]
        a = mass**2 - covariance[9, 9]
        b = first * mass - covariance[9, 6:9]
        c = first**2 - np.diag(covariance)[6:9]
        root = np.where(determined[6:9], np.sqrt(np.maximum(b**2 - a * c, 0.0)), np.inf)
        return np.column_stack([(b - root) / a, (b + root) / a])


def _body_estimate(
    model: RobotModel,
    runs: Sequence[Run],
    scale_std: Array | None = None,
    arm: KnownArm | None = None,
) -> _BodyEstimate:
    """Estimate the body of the loaded runs, of least norm where undetermined."""
    fit = fit_body(model, runs, np.eye(N_BODY_PARAMETERS), arm)
    determined = np.eye(N_BODY_PARAMETERS)
    directions = fit.determined
    if len(directions) < N_BODY_PARAMETERS:
        determined = directions
        fit = fit_body(model, runs, np.asarray(np.linalg.pinv(determined)), arm)
    std = np.zeros(model.n_joints) if scale_std is None else scale_std
    return _BodyEstimate(
        values=np.linalg.pinv(determined) @ fit.values,
        determined=determined,
        fit=fit,
        by_scale=scale_covariance(fit.sensitivity, std),
    )


def parameter_change(model: RobotModel, frame: str | None) -> Array:
    """Return the change of an arm's parameters by a body at a frame (p, 10).

    Raises:
        ModelError: the description has no such frame, or it is fixed to the base.
    """
    joint, rotation, translation = model.chain.frame(frame)
    change = np.zeros((model.n_parameters, N_BODY_PARAMETERS))
    links = model.base.grouping[:, model.layout.links[joint]]
    change[: model.base.rank] = links @ about_frame(rotation, translation)
    return change
