"""Low-pass of the recorded torque, estimated from the recording."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.factor.factor import Factor, count_by_block, estimate
from identification.model.robot import RobotModel
from identification.signals.masks import LONGEST_END, edge_rows
from identification.signals.recording import Recording
from identification.signals.samples import RIGID_BANDWIDTH, Preprocessing, prepare
from identification.signals.smoothing import (
    FORWARDS,
    SMOOTHER,
    WITHOUT_PHASE,
    LowPassShape,
    low_passed,
    noiseless_above,
)

Array = NDArray[np.float64]

LOWEST_BANDWIDTH: Final = 0.5  # Hz
_WORTHWHILE: Final = 0.05  # required relative reduction of the residual, mean over joints
_COARSE: Final = 4.0  # candidates per decade of bandwidth, before refinement
_RATE: Final = 250.0  # Hz; rows beyond it are averaged
_SHORTEST: Final = 12  # samples


def torque_noiseless_above(recording: Recording) -> float | None:
    """Return the frequency [Hz] above which the torque has no noise; None if it has."""
    if recording.torque is None:
        return None
    return noiseless_above(recording.time, recording.torque, recording.segments())


def possible_low_passes(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),  # noqa: B008 - frozen
    undelayed: float | None = None,
) -> tuple[Preprocessing, ...]:
    """Return settings with the best-fitting low-pass of each kind.

    Many controllers log a filtered torque, in which Coulomb friction is a slope instead of a step.
    Causal filters are compared without a delay; a kind whose residuals are not clearly smaller than
    with a delay alone is left out. `undelayed` is the delay [s] without a low-pass, by default that
    of the options; `noise_variance` (n,) as for :func:`identification.signals.samples.smooth`.
    """
    still = options.torque_delay if undelayed is None else undelayed
    wide = replace(options, rigid_bandwidth=RIGID_BANDWIDTH, torque_bandwidth=None)
    channels = {
        delay: _Channel.of(recording, model, noise_variance, replace(wide, torque_delay=delay))
        for delay in {still, options.torque_delay}
    }
    # A low-pass must be better than a delay alone.
    enough = min(one.misfit() for one in channels.values()) + math.log(1.0 - _WORTHWHILE)
    found = []
    for delays, shapes in ((tuple(channels), WITHOUT_PHASE), ((still,), FORWARDS)):
        fits = [
            (*channels[delay].best(shape), delay, shape) for delay in delays for shape in shapes
        ]
        misfit, width, delay, shape = min(fits, key=lambda one: one[0])
        if misfit < enough:
            found.append(
                replace(options, torque_delay=delay, torque_bandwidth=width, torque_shape=shape)
            )
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Channel:
    """Unfiltered rows of each joint, averaged to a rate of about 250 Hz."""

    model: RobotModel
    time: Array  # (m,) [s]
    segments: tuple[slice, ...]  # stretches without a gap
    # per joint its columns and, last, the torque of known loads (m, c + 1)
    blocks: tuple[Array, ...]
    torque: Array  # recorded (m, n)
    usable: NDArray[np.bool_]  # (m, n)

    @classmethod
    def of(
        cls,
        recording: Recording,
        model: RobotModel,
        noise_variance: Array | None,
        options: Preprocessing,
    ) -> _Channel:
        samples = prepare(recording, model, noise_variance=noise_variance, options=options)
        # Without the ends, which filters distort.
        usable = samples.usable & ~edge_rows(recording, LONGEST_END)[:, None]
        load = samples.known_torque(model)
        every = max(1, round(1.0 / (_RATE * float(np.median(np.diff(recording.time))))))
        counts = [(one.stop - one.start) // every for one in samples.segments]
        lasting = [
            (one.start, count)
            for one, count in zip(samples.segments, counts, strict=True)
            if count >= _SHORTEST
        ]

        def average(values: Array) -> Array:
            """Average rows, equally for torque and regressor."""
            parts = [
                values[start : start + count * every].reshape(count, every, *values.shape[1:])
                for start, count in lasting
            ]
            return np.concatenate([part.mean(axis=1) for part in parts])

        edges = np.cumsum([0, *(count for _, count in lasting)]).tolist()
        return cls(
            model=model,
            time=average(recording.time),
            segments=tuple(slice(a, b) for a, b in pairwise(edges)),
            blocks=tuple(
                average(np.column_stack([block, own]))
                for block, own in zip(samples.regressor(model).blocks, load.T, strict=True)
            ),
            torque=average(samples.torque + load),
            usable=average(usable.astype(np.float64)) == 1.0,
        )

    def misfit(self, bandwidth: float | None = None, shape: LowPassShape = SMOOTHER) -> float:
        """Return the mean log standard deviation of the residual of moving joints."""
        tables = []
        for joint, block in enumerate(self.blocks):
            if bandwidth is not None:
                parts = [(self.time[one], block[one]) for one in self.segments]
                block = np.concatenate([low_passed(*part, bandwidth, shape) for part in parts])
            table = np.column_stack([block[:, :-1], self.torque[:, joint] - block[:, -1]])
            tables.append(np.where(self.usable[:, joint], table.T, 0.0))
        index = np.zeros(len(self.usable), dtype=np.intp)
        counts, names = count_by_block(index, self.usable), self.model.parameter_names
        factor = Factor.of_rows([(index, tables)], counts, self.model.plan.columns, names)
        found = estimate(self.model, factor)
        return float(np.nanmean(np.log(found.noise_std)))

    def best(self, shape: LowPassShape) -> tuple[float, float]:
        """Return the least misfit of a shape, and its bandwidth [Hz]."""

        def misfit(log_bandwidth: float) -> float:
            return self.misfit(math.exp(log_bandwidth), shape)

        highest = 0.25 / float(np.median(np.diff(self.time)))
        ends = np.log(LOWEST_BANDWIDTH), np.log(max(highest, 2.0 * LOWEST_BANDWIDTH))
        count = max(4, round(_COARSE * (ends[1] - ends[0]) / np.log(10.0)) + 1)
        grid = np.linspace(*ends, count)
        best = int(np.argmin([misfit(point) for point in grid]))
        around = grid[max(best - 1, 0)], grid[min(best + 1, count - 1)]
        fine = scipy.optimize.minimize_scalar(
            misfit, bounds=around, method="bounded", options={"xatol": 0.02}
        )
        return float(fine.fun), float(np.exp(fine.x))
