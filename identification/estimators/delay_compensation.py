"""Torque read at the time of its position, and what an uncertain delay does to an estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.factor.factor import Estimate, Factor, solve
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Samples

Array = NDArray[np.float64]


def compensate(recording: Recording, delays: Sequence[float] | Array) -> Recording:
    """Return the recording with torque and current brought back to the positions' time.

    Each channel is read `delays` later, between samples by the cubic through its neighbours, never
    across a gap;
    samples at the ends of a segment for which there is nothing to read are left out. Where one
    delay serves all axes, :attr:`Preprocessing.torque_delay` does the same without touching the
    torque.

    Args:
        recording: checked.
        delays: by which torque and current lag the position (n,) [s].

    Raises:
        ShapeError: not one delay per joint.
        IdentificationError: no sample is left.
    """
    shift = np.asarray(delays, dtype=np.float64)
    if shift.shape != (recording.n_joints,) or not np.all(np.isfinite(shift)):
        raise ShapeError("delays", shift.shape, f"({recording.n_joints},), finite")
    time = recording.time
    keep = np.zeros(recording.n_samples, dtype=np.bool_)
    gap = np.zeros(recording.n_samples, dtype=np.bool_)
    channels = {"torque": recording.torque, "motor_current": recording.motor_current}
    moved = {name: array.copy() for name, array in channels.items() if array is not None}
    for segment in recording.segments():
        inside = time[segment]
        covered = (inside + shift.min() >= inside[0]) & (inside + shift.max() <= inside[-1])
        if not covered.any() or len(inside) < 2:
            continue
        keep[segment] = covered
        gap[segment.start + int(np.argmax(covered))] = True
        for array in moved.values():
            for joint in np.flatnonzero(shift):
                array[segment, joint] = read_at(
                    inside, array[segment, joint], inside + shift[joint]
                )
    if not keep.any():
        raise IdentificationError("every stretch of the recording is shorter than the delay")
    commanded = recording.commanded_position
    return replace(
        recording,
        time=time[keep],
        position=recording.position[keep],
        velocity=None if recording.velocity is None else recording.velocity[keep],
        commanded_position=None if commanded is None else commanded[keep],
        gap_before=gap[keep],
        torque=moved["torque"][keep] if "torque" in moved else None,
        motor_current=moved["motor_current"][keep] if "motor_current" in moved else None,
    )


def read_at(time: Array, values: Array, at: Array) -> Array:
    """Values (m, ...) of one stretch at other times (k,), those of its ends beyond them."""
    # Local: where Coulomb friction jumps, a global spline would ring.
    source = scipy.interpolate.CubicHermiteSpline(time, values, np.gradient(values, time, axis=0))
    return np.asarray(source(np.clip(at, time[0], time[-1])))


def payload_torque(model: RobotModel, samples: Samples) -> Array:
    """Torque of the known payload (m, n), as the torque channel would have recorded it."""
    load = model.load_torque(*samples.motion[1:4])
    for joint in range(model.n_joints if model.has_load else 0):
        load[:, joint] = samples.as_measured(joint, load[:, joint : joint + 1])[:, 0]
    return load


def predicted_rate(samples: Samples, torque: Array) -> Array:
    """Time derivative of predicted torques (m, ...), zero in stretches too short for one."""
    rate = np.zeros_like(torque)
    for segment in samples.segments:
        if segment.stop - segment.start > 1:
            rate[segment] = np.gradient(torque[segment], samples.motion.time[segment], axis=0)
    return rate


def rate_products(model: RobotModel, samples: Samples) -> Array:
    """Sums ``W' d[W | t]/dt`` over the usable rows per joint (n, p, p + 1); recordings add up.

    The torque t is that of the known payload.
    """
    products = np.zeros((model.n_joints, model.n_parameters, model.n_parameters + 1))
    load = payload_torque(model, samples)
    for joint, (block, columns) in enumerate(zip(*samples.regressor(model), strict=True)):
        rows = samples.usable[:, joint]
        rate = predicted_rate(samples, np.column_stack([block, load[:, joint]]))
        places = np.ix_(columns, np.append(columns, model.n_parameters))
        products[joint][places] = block[rows].T @ rate[rows]
    return products


def delay_sensitivity(factor: Factor, products: Array, weights: Array, values: Array) -> Array:
    """Change of the estimated parameters per second of delay applied to the torque (p,).

    A later delay compares the torque with earlier motion, which is another torque by its rate of
    change; the parameters move by the fit of that rate.

    Args:
        factor: of what was fitted.
        products: its `rate_products` (n, p, p + 1).
        weights: per joint (n,).
        values: the estimate (p,).
    """
    rate = np.tensordot(weights, products, axes=1) @ np.append(values, 1.0)
    return solve(factor.weighted(weights)._replace(b=rate)).values


def with_uncertain_delay(
    estimate: Estimate, factor: Factor, products: Array, variance: float
) -> Estimate:
    """Return the estimate with the uncertainty of the delay in its covariance.

    Args:
        estimate: made with one delay assumed certain.
        factor: of what was fitted.
        products: its `rate_products` (n, p, p + 1).
        variance: of the delay [s²].
    """
    noise = estimate.noise_std
    weights = np.where(np.isfinite(noise), noise, np.inf) ** -2.0
    moved = delay_sensitivity(factor, products, weights, estimate.values)
    known = np.where(np.isfinite(np.diag(estimate.covariance)), moved, 0.0)
    return replace(estimate, covariance=estimate.covariance + variance * np.outer(known, known))
