"""Play between an encoder and its link: steps of one size, to and fro, where the load reverses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.distributions import MAD_TO_STD
from identification.signals.noise import smallest_steps
from identification.signals.recording import MIN_MOVEMENT, Recording

_HALF_WINDOW: Final = 0.06  # s, on either side of a step, in which the motion is a cubic
_TRANSITION: Final = 0.012  # s, on either side, in which the play is crossed
_MIN_ROWS: Final = 4  # of either side
_STEP_SIGMAS: Final = 8.0  # robust standard deviations of a step
_MIN_RESOLUTIONS: Final = 3.0  # of the position, that a step exceeds
_MIN_STEPS: Final = 4
_SAME_SIZE: Final = 0.15  # relative, of steps of one size
_MIN_SHARE: Final = 0.7  # of steps of one size, and of these that are where the load reverses
_MIN_ALTERNATING: Final = 0.8  # share of steps of one size against the one before


class ToAndFro(NamedTuple):
    """Steps of one size of a position, most of them against the one before.

    Attributes:
        joint: index.
        size: of the steps [rad or m].
        half_interval: of it, 95 %.
        time: of the steps of each recording (k,) [s].
        up: the direction of each, 1 or -1, of each recording (k,).
    """

    joint: int
    size: float
    half_interval: float
    time: tuple[Array, ...]
    up: tuple[Array, ...]

    @property
    def number(self) -> int:
        """Number of steps."""
        return sum(map(len, self.up))

    def follows(self, times: Sequence[Array], loads: Sequence[Array]) -> bool:
        """Return whether the steps are where the load of the joint reverses.

        Args:
            times: of rows of each recording (m,) [s].
            loads: of the joint's gear in these rows (m,) [N·m or N].
        """
        sides = []
        for at, up, time, load in zip(self.time, self.up, times, loads, strict=True):
            before, after = (
                np.sign(np.interp(at + shift, time, load))
                for shift in (-_HALF_WINDOW, _HALF_WINDOW)
            )
            sides.append(0.5 * (after - before) * up)
        return abs(float(np.mean(np.concatenate(sides)))) > _MIN_SHARE


def steps_to_and_fro(recordings: Sequence[Recording]) -> Iterator[ToAndFro]:
    """Yield the joints whose measured position steps to and fro by one size.

    Encoders on the motor side of a gear with play do so where the load reverses. Rounded positions
    and lost counts do not: the former step on in the direction of motion, the latter by any size.
    """
    for joint in range(recordings[0].n_joints):
        found = [_Steps.of(each, joint) for each in recordings]
        sizes = np.abs(np.concatenate([each.size for each in found]))
        if len(sizes) < _MIN_STEPS:
            continue
        size = float(np.median(sizes))
        same = [each.of_size(size) for each in found]
        sizes_alike = np.concatenate([np.abs(each.size) for each in same])
        if len(sizes_alike) < max(_MIN_STEPS, _MIN_SHARE * len(sizes)):
            continue
        changes = np.concatenate([each.size[1:] * each.size[:-1] < 0.0 for each in same])
        if not len(changes) or np.mean(changes) < _MIN_ALTERNATING:
            continue
        spread = max(float(np.std(sizes_alike)), *(each.noise for each in same))
        yield ToAndFro(
            joint,
            size,
            2.0 * spread / float(np.sqrt(len(sizes_alike))),
            tuple(each.time for each in same),
            tuple(np.sign(each.size) for each in same),
        )


class _Steps(NamedTuple):
    """Steps of a joint in a recording."""

    time: Array  # (k,) [s]
    size: Array  # (k,) [rad or m]
    noise: float  # of a size

    def of_size(self, size: float) -> _Steps:
        """Return the steps of about a size; two crossings soon after each other show another."""
        same = np.abs(np.abs(self.size) - size) < _SAME_SIZE * size
        return self._replace(time=self.time[same], size=self.size[same])

    @classmethod
    def of(cls, recording: Recording, joint: int) -> _Steps:
        time = recording.time
        step = float(np.median(np.diff(time)))
        reach, inner = round(_HALF_WINDOW / step), round(_TRANSITION / step)
        position = recording.position[:, joint]
        sizes = np.zeros(len(time))
        if reach - inner >= _MIN_ROWS and np.ptp(position) > MIN_MOVEMENT:
            kernel = _kernel(reach, inner)
            for part in recording.segments():
                if part.stop - part.start > 2 * reach:
                    values = position[part] - position[part.start]
                    inside = slice(part.start + reach, part.stop - reach)
                    sizes[inside] = np.correlate(values, kernel, mode="valid")
        distance = np.abs(sizes)
        if not distance.any():
            return cls(np.zeros(0), np.zeros(0), 0.0)
        noise = MAD_TO_STD * float(np.median(distance[distance > 0.0]))
        resolution = float(smallest_steps(recording.position[:, joint : joint + 1])[0])
        least = max(_STEP_SIGMAS * noise, _MIN_RESOLUTIONS * resolution)
        rows = [
            _middle(sizes, row, reach)
            for row in np.flatnonzero(distance > least).tolist()
            if distance[row] == distance[max(row - reach, 0) : row + reach + 1].max()
        ]
        return cls(time[rows], sizes[rows], noise)


def _kernel(reach: int, inner: int) -> Array:
    """Return the weights (2 reach + 1,) of a step at the middle, by least squares with a cubic."""
    offset = np.arange(-reach, reach + 1)
    used = np.abs(offset) > inner
    x = offset[used] / reach
    basis = np.column_stack([x**0, x, x**2, x**3, 0.5 * np.sign(x)])
    kernel = np.zeros(len(offset))
    kernel[used] = np.linalg.pinv(basis)[-1]
    return kernel


def _middle(sizes: Array, row: int, reach: int) -> int:
    """Return the row of a step, whose size beside it is larger on either side."""
    first = max(row - reach, 0)
    around = sizes[first : row + reach + 1] * np.sign(sizes[row])
    return first + round(float(np.flatnonzero(around > 0.5 * abs(sizes[row])).mean()))
