"""Windows of a measured motion, on an even time grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.arrays import Array, runs_of
from identification.errors import IdentificationError
from identification.model.motion import Motion
from identification.signals.samples import Samples

STEP_SECONDS: Final = 5e-3
"""Time step of a simulation [s]."""
WINDOW_STRIDE: Final = 0.1
"""Time between the starts of simulations [s]."""
_MIN_SAMPLES: Final = 4  # of a stretch that is interpolated


class NoWindowError(IdentificationError):
    """The motion has no stretch that is long enough."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A measured motion without gap, on an even grid of g instants.

    MuJoCo's step advances the velocity by the torque, then the position by the new velocity. With
    velocities half a step before and after an instant, and the mean torque about the instant, this
    is of second order (Störmer and Verlet).
    """

    motion: Motion  #: smoothed, at the instants
    before: Array  #: velocity half a step before (g, n) [rad/s or m/s]
    after: Array  #: velocity half a step after (g, n) [rad/s or m/s]
    torque: Array  #: recorded, mean over a step about each instant (g, n) [N·m or N]
    time: Array  #: of the samples that it comes from (m,) [s]
    part: slice  #: these samples in their recording
    commanded: Array | None = None  #: commanded position at the instants (g, n) [rad or m]

    def mean_about_instants(self, values: Array) -> Array:
        """Return the mean of values at the samples (m, c) over a step about each instant (g, c)."""
        return mean_about(self.time, values, self.motion.time)


@dataclass(frozen=True, eq=False)
class Windows:
    """w windows of K steps, of several stretches."""

    stretches: tuple[Stretch, ...]
    stretch: NDArray[np.intp]  #: of each window (w,)
    first: NDArray[np.intp]  #: instant of its stretch at which it starts (w,)
    step: float  #: time step [s]
    steps: int  #: number K of steps

    def __len__(self) -> int:
        return len(self.first)

    def cut(self, parts: Sequence[Array], shift: int = 0) -> Array:
        """Return the windows (w, K, n) of arrays at the instants of each stretch (g, n).

        With `shift` of these so many instants later.
        """
        offsets = shift + np.arange(self.steps)
        windows = np.empty((len(self), self.steps, parts[0].shape[1]))
        for k, values in enumerate(parts):
            inside = self.stretch == k
            windows[inside] = values[self.first[inside][:, None] + offsets]
        return windows

    def at_start(self, parts: Sequence[Array]) -> Array:
        """Return arrays at the instants of each stretch (g, n) where each window starts (w, n)."""
        return np.array([parts[k][row] for k, row in zip(self.stretch, self.first, strict=True)])

    @cached_property
    def position(self) -> Array:
        """Measured positions before each step (w, K, n) [rad or m]."""
        return self.cut([stretch.motion.position for stretch in self.stretches])

    @cached_property
    def reached(self) -> Array:
        """Measured positions after each step (w, K, n) [rad or m]."""
        return self.cut([stretch.motion.position for stretch in self.stretches], 1)

    @cached_property
    def start(self) -> Array:
        """Measured velocity half a step before each window (w, n) [rad/s or m/s]."""
        return self.at_start([stretch.before for stretch in self.stretches])

    @cached_property
    def torque(self) -> Array:
        """Recorded torque, mean over a step about each instant (w, K, n) [N·m or N]."""
        return self.cut([stretch.torque for stretch in self.stretches])

    def some(self, most: int) -> Windows:
        """Return at most `most` windows, evenly distributed."""
        if len(self) <= most:
            return self
        chosen = np.linspace(0, len(self) - 1, most).round().astype(np.intp)
        return replace(self, stretch=self.stretch[chosen], first=self.first[chosen])


def stretches_of(
    samples: Samples, load: Array, step: float, commanded: Array | None = None
) -> list[Stretch]:
    """Return the stretches of a recording without gap.

    The positions are interpolated by a cubic spline, whose derivative is the velocity.

    Args:
        samples: of the recording.
        load: torque (m, n) that was subtracted from the samples' torque, and is added again.
        step: of the simulation [s].
        commanded: positions (m, n); samples without (NaN) are gaps if others have one.
    """
    stretches = []
    parts: Sequence[slice] = samples.segments
    with_command = np.zeros(len(samples.torque), np.bool_)
    if commanded is not None:
        with_command = np.asarray(np.isfinite(commanded).all(axis=1))
    if with_command.any():
        parts = [
            slice(part.start + first, part.start + end)
            for part in parts
            for first, end in runs_of(with_command[part])
        ]
    for part in parts:
        motion = samples.motion.rows(part)
        time = motion.time
        if len(time) < _MIN_SAMPLES or time[-1] - time[0] < 2.0 * step:
            continue
        count = int((time[-1] - time[0]) / step - 1.0 + 1e-9) + 1
        grid = time[0] + step * (0.5 + np.arange(count))
        spline = scipy.interpolate.CubicSpline(time, motion.position)
        on_grid = Motion(grid, spline(grid), spline(grid, 1), spline(grid, 2))
        before, after = (spline(grid + shift, 1) for shift in (-0.5 * step, 0.5 * step))
        command = None
        if commanded is not None and with_command.any():
            columns = commanded[part].T
            command = np.column_stack([np.interp(grid, time, column) for column in columns])
        torque = mean_about(time, (samples.torque + load)[part], grid)
        stretches.append(Stretch(on_grid, before, after, torque, time, part, command))
    return stretches


def mean_about(time: Array, values: Array, grid: Array) -> Array:
    """Return the mean of values (m, c) over one step about each instant of an even grid (g, c).

    The values are interpolated linearly.
    """
    step = float(grid[1] - grid[0]) if len(grid) > 1 else float(time[-1] - time[0])
    edges = np.append(grid - 0.5 * step, grid[-1] + 0.5 * step)
    widths = np.diff(time)[:, None]
    areas = np.cumsum(0.5 * widths * (values[1:] + values[:-1]), axis=0)
    integral = np.concatenate([np.zeros((1, values.shape[1])), areas])
    index = np.clip(np.searchsorted(time, edges, side="right") - 1, 0, len(time) - 2)
    share = ((edges - time[index]) / widths[index, 0])[:, None]
    slope = values[index + 1] - values[index]
    at = integral[index] + widths[index] * (share * values[index] + 0.5 * share**2 * slope)
    return np.asarray(np.diff(at, axis=0) / step)


def windows_of(
    stretches: Sequence[Stretch], step: float, horizon: float, stride: float, lead: float = 0.0
) -> Windows:
    """Return windows of equal duration.

    Args:
        stretches: of the recordings.
        step: of the simulation [s].
        horizon: duration of a window [s].
        stride: between the starts of windows [s].
        lead: of the first window after the start of its stretch [s]: what acts on an arm so much
            later, such as a delayed command, is not known before.

    Raises:
        NoWindowError: no stretch is as long.
    """
    steps = round(horizon / step)
    between = max(1, round(stride / step))
    before = int(np.ceil(lead / step - 1e-9))
    starts = [
        np.arange(before, len(stretch.motion.time) - steps, between, dtype=np.intp)
        for stretch in stretches
    ]
    if not sum(len(first) for first in starts):
        longest = max((np.ptp(stretch.motion.time) for stretch in stretches), default=0.0)
        raise NoWindowError(
            f"no part of the motion without gap lasts {horizon + lead:g} s; the longest lasts"
            f" {longest:.3g} s"
        )
    stretch = np.repeat(np.arange(len(starts)), [len(first) for first in starts])
    return Windows(tuple(stretches), stretch, np.concatenate(starts), step, steps)
