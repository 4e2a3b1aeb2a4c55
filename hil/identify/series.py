"""Series behind the figures of the report: a few thousand rows, from all samples."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.report import ReportSeries
from identification.estimators.repetitions import RepeatedEstimate
from identification.export.friction_curve import friction_curve, friction_torque
from identification.export.torque_parts import torque_parts
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.signals.spectrum import spectrum
from identification.validation.prediction import for_figure

from .prepared import Prepared
from .summary import moving_rows

Array = NDArray[np.float64]

FIGURE_SAMPLES: Final = 4000
"""Rows of a time series behind a figure, at most."""
FRICTION_POINTS: Final = 600
"""Points per joint behind a friction curve."""
_RECORDINGS: Final = 4  # of those that were fitted: more say the same again
_MARGIN: Final = 1.0  # s of rest that is shown before and after the motion


def report_series(prepared: Prepared, estimate: RepeatedEstimate) -> ReportSeries:
    """The series of a report: the first motion that was fitted, the first that was held out."""
    sources, fitted, example = prepared.sources, prepared.fitted, prepared.held_out[0]
    model, values = sources.cell.model, estimate.pooled.values
    excitation, motion = fitted[0], fitted[0].motion
    shown, seen = _shown(prepared.training[0]), _shown(example)
    time = example.motion.time
    predicted = example.predicted_torque(model, values)
    parts = torque_parts(model, values, example)
    both = np.column_stack([example.torque, example.torque - predicted])
    frequency, density = spectrum(time, both, example.segments)
    speed, torque = _friction_data(model, values, fitted)
    curves = [
        friction_curve(
            model,
            values,
            joint,
            float(np.nanmin(speed[:, joint], initial=0.0)),
            float(np.nanmax(speed[:, joint], initial=0.0)),
        )
        for joint in range(model.n_joints)
    ]
    return ReportSeries(
        excitation_time=motion.time[shown] - excitation.origin,
        excitation_position=motion.position[shown],
        excitation_velocity=motion.velocity[shown],
        example_archive=sources.held_out[0].name,
        example_time=time[seen] - example.origin,
        example_measured=for_figure(time, example.torque)[seen],
        example_predicted=for_figure(time, predicted)[seen],
        excitation_fitted=excitation.usable[shown].astype(np.float64),
        example_used=example.usable[seen].astype(np.float64),
        example_inertia=for_figure(time, parts.inertia)[seen],
        example_coriolis=for_figure(time, parts.coriolis)[seen],
        example_gravity=for_figure(time, parts.gravity)[seen],
        example_friction=for_figure(time, parts.friction)[seen],
        friction_speed=speed,
        friction_torque=torque,
        law_speed=np.column_stack([curve.speed for curve in curves]),
        law_torque=np.column_stack([curve.sliding for curve in curves]),
        reversal_travel=np.column_stack([curve.travel for curve in curves]),
        reversal_torque=np.column_stack([curve.turning for curve in curves]),
        spectrum_frequency=frequency,
        spectrum_torque=density[:, : model.n_joints],
        spectrum_residual=density[:, model.n_joints :],
        motion_bandwidth=np.where(
            np.isfinite(example.position_bandwidth), example.position_bandwidth, np.nan
        ),
    )


def _shown(samples: Samples) -> slice:
    """Rows for a figure: the motion, and a little of the rest before and after it."""
    moving, time = moving_rows(samples), samples.motion.time
    if moving.start == moving.stop:
        return moving
    first = int(np.searchsorted(time, time[moving.start] - _MARGIN))
    last = int(np.searchsorted(time, time[moving.stop - 1] + _MARGIN, side="right"))
    return slice(first, last, max(1, (last - first) // FIGURE_SAMPLES))


def _friction_data(
    model: RobotModel, values: Array, fitted: tuple[Samples, ...]
) -> tuple[Array, Array]:
    """Speed and friction torque of fitted rows (FRICTION_POINTS, n), NaN where there are fewer."""
    some = fitted[:: -(-len(fitted) // _RECORDINGS)]
    speed = np.concatenate([samples.motion.velocity for samples in some])
    torque = np.concatenate([friction_torque(model, values, samples) for samples in some])
    usable = np.concatenate([samples.usable for samples in some])
    found = np.full((2, FRICTION_POINTS, model.n_joints), np.nan)
    for joint in range(model.n_joints):
        rows = np.flatnonzero(usable[:, joint])
        count = min(len(rows), FRICTION_POINTS)
        if count:
            chosen = rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]
            found[:, :count, joint] = speed[chosen, joint], torque[chosen, joint]
    return found[0], found[1]
