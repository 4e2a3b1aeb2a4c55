r"""Zero-phase Butterworth smoothing: the alternative to the smoothing spline.

The filter of order k is run forwards and backwards, so that its gain is

.. math:: |H(f)|^2 = \frac{1}{1 + (f / f_c)^{2k}}

and its phase zero: at the cut-off it halves a sine. The derivatives are those of the quintic
spline through the filtered positions, exact where central differences lose a share (2 pi f h)²/6
of a velocity at frequency f. The filter needs uniform samples: uneven recordings are resampled
for it and read again at their own times.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.errors import ShapeError
from identification.model.motion import Motion
from identification.signals.clock import time_base
from identification.signals.noise import difference_variance
from identification.signals.recording import Recording, RecordingError
from identification.signals.resampling import resample

Array = NDArray[np.float64]

ORDER: Final = 4
LOWEST_CUTOFF: Final = 0.5  # Hz; below it nothing of a robot's motion would be left
# Of the sampling rate: higher, the filter is none and the bilinear transform bends it.
HIGHEST_CUTOFF: Final = 0.4
# The filter starts from the signal's point reflection at its end, for so many of its periods.
_PADDING_PERIODS: Final = 3.0
_SHORTEST: Final = 24  # samples
_CANDIDATES: Final = 80
# A periodogram of white noise exceeds its mean by this factor in two of 10^9 frequencies.
_CLEAR: Final = 20.0


def choose_cutoff(
    recording: Recording,
    noise_variance: Array | None = None,
    *,
    order: int = ORDER,
    widest: float = np.inf,
) -> Array:
    """Cut-off per joint (n,) [Hz] with the least estimated error of the acceleration.

    What the filter takes from the part of the spectrum that stands clear of the noise, and what
    it leaves of the noise, both as accelerations, on the longest stretch. The accelerations
    decide what a fit is worth; a residual as large as the noise (the spline's rule; with filters,
    Winter's residual analysis) chooses for the positions, and too low for them.

    Args:
        recording: checked.
        noise_variance: of the positions (n,) [rad² or m²]; None: estimated from their differences.
        order: of the filter, one way.
        widest: highest cut-off [Hz], however little noise there is.

    Raises:
        RecordingError: no stretch is long enough.
    """
    own = max(recording.segments(), key=lambda segment: int(segment.stop - segment.start))
    _refuse_short(own.stop - own.start)
    if noise_variance is None:
        noise_variance = difference_variance(recording.time[own], recording.position[own])
    uniform = _uniform(_bare(recording.between(own.start, own.stop)))
    step = float(np.median(np.diff(uniform.time)))
    highest = min(widest, HIGHEST_CUTOFF / step)
    candidates = np.geomspace(min(LOWEST_CUTOFF, 0.5 * highest), highest, _CANDIDATES)
    # A window that closes smoothly: what leaks from the slow motion would pass for fast signal.
    frequency, power = scipy.signal.periodogram(
        uniform.position, 1.0 / step, window="blackmanharris", detrend="linear", axis=0
    )
    noise = 2.0 * step * np.asarray(noise_variance, dtype=np.float64)  # one-sided density
    signal = np.where(power > _CLEAR * noise, power, 0.0)
    bent = np.tan(np.minimum(np.pi * frequency * step, 0.4999 * np.pi))
    ratio = bent / np.tan(np.pi * candidates * step)[:, None]
    gain = 1.0 / (1.0 + ratio ** (2 * order))
    fourth = frequency**4
    lost = ((1.0 - gain) ** 2 * fourth) @ signal
    left = (gain**2 * fourth).sum(axis=1)[:, None] * noise
    return np.asarray(candidates[np.argmin(lost + left, axis=0)])


def butterworth_motion(
    recording: Recording, cutoff: Array, *, order: int = ORDER, delay: float = 0.0
) -> Motion:
    """Filtered motion in the rows of the recording, at each instant less the delay.

    Rows of a stretch too short to filter keep their position, at rest.

    Args:
        recording: checked.
        cutoff: per joint (n,) [Hz].
        order: of the filter, one way.
        delay: time by which what the motion is to be compared with lags it [s].

    Raises:
        ShapeError: not one cut-off per joint.
        ValueError: a cut-off that is not positive or not below the Nyquist frequency.
    """
    cutoff = np.asarray(cutoff, dtype=np.float64)
    if cutoff.shape != (recording.n_joints,):
        raise ShapeError("cutoff", cutoff.shape, f"({recording.n_joints},)")
    nyquist = 0.5 / float(np.median(np.diff(recording.time)))
    if not np.all((cutoff > 0.0) & (cutoff < nyquist)):
        raise ValueError(f"cut-offs {cutoff} Hz are not between zero and Nyquist's {nyquist:.6g}")
    q = recording.position.copy()
    qd, qdd = np.zeros_like(q), np.zeros_like(q)
    for segment in recording.segments():
        inside = recording.time[segment]
        if len(inside) < _SHORTEST:
            continue
        spline = _filtered_spline(recording.between(segment.start, segment.stop), cutoff, order)
        at = np.clip(inside - delay, inside[0], spline.t[-1])
        q[segment], qd[segment] = spline(at), spline(at, 1)
        qdd[segment] = spline(at, 2)
    return Motion(recording.time, q, qd, qdd)


def _bare(one: Recording) -> Recording:
    """One stretch with positions alone: what else was recorded need not be resampled."""
    return replace(one, torque=None, motor_current=None, commanded_position=None, gap_before=None)


def _uniform(recording: Recording) -> Recording:
    if time_base(recording.time, recording.gap_before).uniform:
        return recording
    return resample(recording)


def _filtered_spline(one: Recording, cutoff: Array, order: int) -> scipy.interpolate.BSpline:
    """Quintic spline through the filtered positions of one stretch."""
    uniform = _uniform(_bare(one))
    step = float(np.median(np.diff(uniform.time)))
    columns = [
        _filtered(channel, float(frequency), step, order)
        for channel, frequency in zip(uniform.position.T, cutoff, strict=True)
    ]
    return scipy.interpolate.make_interp_spline(uniform.time, np.column_stack(columns), k=5)


def _filtered(channel: Array, cutoff: float, step: float, order: int) -> Array:
    """One channel, forwards and backwards."""
    sections = scipy.signal.butter(order, cutoff, fs=1.0 / step, output="sos")
    padding = min(len(channel) - 1, int(np.ceil(_PADDING_PERIODS / (cutoff * step))))
    return np.asarray(scipy.signal.sosfiltfilt(sections, channel, padlen=padding))


def _refuse_short(samples: int) -> None:
    if samples < _SHORTEST:
        raise RecordingError(
            "shape", f"a filter needs a stretch of {_SHORTEST} samples, the longest has {samples}"
        )
