"""Torque and current brought back to the time of the positions they belong to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.errors import IdentificationError, ShapeError
from identification.recording import Recording

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
        kept = (inside + shift.min() >= inside[0]) & (inside + shift.max() <= inside[-1])
        if not kept.any() or len(inside) < 2:
            continue
        keep[segment] = kept
        gap[segment.start + int(np.argmax(kept))] = True
        for array in moved.values():
            array[segment] = _read_later(inside, array[segment], shift)
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


def _read_later(time: Array, values: Array, shift: Array) -> Array:
    """Values (m, n) of one stretch, each channel read its own shift (n,) later."""
    # Local: where Coulomb friction jumps, a global spline would ring.
    source = scipy.interpolate.CubicHermiteSpline(time, values, np.gradient(values, time, axis=0))
    later = values.copy()
    for joint in np.flatnonzero(shift):
        at = np.clip(time + shift[joint], time[0], time[-1])
        later[:, joint] = source(at)[:, joint]
    return later
