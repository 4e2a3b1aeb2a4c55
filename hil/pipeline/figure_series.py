"""Data of a report's figures, from an identification."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from hil.base.arrays import Array
from hil.cell.nominal import nominal_of
from hil.results.series import ReportSeries, example_series
from identification import RobotModel
from identification.estimators.least_squares import RepeatedEstimate
from identification.export.friction_curve import friction_curve, friction_torque, median_load
from identification.signals.samples import Samples

from .prepared import Prepared, moving_rows
from .sources import Source

FIGURE_SAMPLES: Final = 4000
"""Maximum number of rows of a time series in a figure."""
FRICTION_POINTS: Final = 600
"""Points per joint in a friction figure."""
_MAX_FRICTION_RECORDINGS: Final = 4  # fitted recordings in a friction figure
_MAX_FRICTION_ROWS: Final = 20 * FRICTION_POINTS  # of each; a joint rests in many of them
_CLOCK_STAMPS: Final = 4000  # whose intervals are in a figure
_MARGIN_SECONDS: Final = 1.0  # time shown before and after the motion, s


def report_series(prepared: Prepared, estimate: RepeatedEstimate) -> ReportSeries:
    """Return the figure data of a report: the first fitted and the first held-out recording."""
    sources = prepared.sources
    fitted = prepared.fitted
    example = prepared.held_out[0]
    model = sources.cell.model
    values = estimate.pooled.values
    excitation = fitted[0]
    motion = fitted[0].motion
    shown = _shown(prepared.training[0])
    nominal = nominal_of(sources.cell)
    speed, torque = _friction_data(model, values, fitted)
    slowest, fastest = (end(speed, axis=0, initial=0.0) for end in (np.nanmin, np.nanmax))
    load = median_load(model, values, fitted)
    curves = [
        friction_curve(
            model, values, joint, float(slowest[joint]), float(fastest[joint]), float(load[joint])
        )
        for joint in range(model.n_joints)
    ]
    return ReportSeries(
        excitation_time=motion.time[shown] - excitation.origin,
        excitation_position=motion.position[shown],
        excitation_velocity=motion.velocity[shown],
        example_archive=sources.held_out[0].name,
        excitation_fitted=excitation.usable[shown].astype(np.float64),
        friction_speed=speed,
        friction_torque=torque,
        law_speed=np.column_stack([curve.speed for curve in curves]),
        law_torque=np.column_stack([curve.torque for curve in curves]),
        clock_time=_clock_time(sources.training),
        **example_series(
            model,
            values,
            None if nominal is None else nominal.values,
            example,
            _shown(example),
        ),
    )


def _clock_time(sources: Sequence[Source]) -> Array | None:
    """Return the stamps of the first recording whose samples were given other times."""
    stamps = (source.stamps for source in sources if source.retimed)
    found = next((each for each in stamps if each is not None), None)
    return None if found is None else found[:_CLOCK_STAMPS]


def _shown(samples: Samples) -> slice:
    """Rows of a figure: the motion with a margin before and after it; all if nothing moves."""
    moving = moving_rows(samples)
    time = samples.motion.time
    if moving.start == moving.stop:
        moving = slice(0, len(time))
    first = int(np.searchsorted(time, time[moving.start] - _MARGIN_SECONDS))
    last = int(np.searchsorted(time, time[moving.stop - 1] + _MARGIN_SECONDS, side="right"))
    return slice(first, last, max(1, (last - first) // FIGURE_SAMPLES))


def _fewer_rows(samples: Samples) -> Samples:
    """Return some rows of a long recording; all of one whose low-pass needs them."""
    if samples.torque_bandwidth is not None:
        return samples
    return samples.thinned(max(1, len(samples.torque) // _MAX_FRICTION_ROWS))


def _friction_data(
    model: RobotModel, values: Array, fitted: tuple[Samples, ...]
) -> tuple[Array, Array]:
    """Speed and friction torque of fitted rows, each (FRICTION_POINTS, n), padded with NaN."""
    some = [
        _fewer_rows(samples) for samples in fitted[:: -(-len(fitted) // _MAX_FRICTION_RECORDINGS)]
    ]
    parts = [
        (samples.motion.velocity, friction_torque(model, values, samples), samples.usable)
        for samples in some
    ]
    speed, torque, usable = (np.concatenate(column) for column in zip(*parts, strict=True))
    points = np.full((2, FRICTION_POINTS, model.n_joints), np.nan)
    for joint in range(model.n_joints):
        rows = np.flatnonzero(usable[:, joint])
        count = min(len(rows), FRICTION_POINTS)
        if count:
            chosen = rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]
            points[:, :count, joint] = speed[chosen, joint], torque[chosen, joint]
    return points[0], points[1]
