"""Figures of the report, one panel for each joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.report.drawing import (
    BAND,
    FIRST,
    INK,
    MUTED,
    SECOND,
    WIDE,
    Caption,
    Panel,
    Plot,
    Trace,
    matrix_panel,
    padded,
    panel,
    single,
    time_panel,
)
from hil.report.numbers import fixed, percent, significant
from hil.results import FittedResult, Results, ValidationResult

Array = NDArray[np.float64]

_INTERVAL: Final = 1.96  # Half a 95 % interval, in standard errors
# Percentiles of the torque inside the axes; outliers may lie outside.
_SHOWN: Final = (0.5, 99.5)


class Joint(NamedTuple):
    """A joint with its number from 0, name, unit of torque, and error on the example."""

    number: int
    name: str
    unit: str
    error: str

    @property
    def angle(self) -> str:
        """Unit of its position."""
        return "rad" if self.unit == "N·m" else "m"


def joints_of(results: Results) -> list[Joint]:
    """Return the joints with their errors on the first run, or else on the fitted recording."""
    example: ValidationResult | FittedResult = results.fitted
    if results.validation:
        example = results.validation[0]
    elif len(results.repetitions) > 1:
        return [Joint(j, one.joint, one.unit, "") for j, one in enumerate(results.judgement.joints)]
    errors = zip(example.relative_error, example.all_rows_joint_errors, strict=True)
    return [
        Joint(
            j,
            one.joint,
            one.unit,
            f"error in motion {percent(moving)} %, whole recording {percent(every)} %",
        )
        for j, (one, (moving, every)) in enumerate(
            zip(results.judgement.joints, errors, strict=True)
        )
    ]


def excitation_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Draw position and velocity of each joint (paper, Fig. 1)."""
    time = series.excitation_time - series.excitation_time[0]
    panels = []
    for joint in joints:
        j, unit = joint.number, joint.angle
        position, velocity = series.excitation_position[:, j], series.excitation_velocity[:, j]
        note = f"{fixed(float(position.min()), 2)} to {fixed(float(position.max()), 2)} {unit}"
        shaded = _left_out(time, series.excitation_fitted, j)
        plots = (
            Plot(78.0, f"position [{unit}]", [Trace(position, FIRST, 1.5)], shaded),
            Plot(78.0, f"velocity [{unit}/s]", [Trace(velocity, SECOND, 1.5)], shaded),
        )
        caption = Caption(f"x{j}", joint.name, note, "position and velocity over time")
        panels.append(time_panel(time, plots, caption))
    return panels


def torque_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Draw measured and predicted torque of each joint, and their difference (paper, Fig. 4)."""
    if series.example_time.size == 0:
        return []
    time = series.example_time - series.example_time[0]
    panels = []
    for j, name, unit, error in joints:
        measured, predicted = series.example_measured[:, j], series.example_predicted[:, j]
        both = [Trace(measured, WIDE, 4.0), Trace(predicted, INK, 1.1)]
        difference = [Trace(measured - predicted, SECOND, 0.9)]
        shaded = _left_out(time, series.example_used, j)
        plots = (
            Plot(128.0, f"torque [{unit}]", both, shaded),
            Plot(50.0, f"measured − predicted [{unit}]", difference, shaded),
        )
        caption = Caption(f"t{j}", name, error, "measured and predicted torque over time")
        panels.append(time_panel(time, plots, caption))
    return panels


def _left_out(time: Array, used: Array, joint: int) -> Sequence[tuple[float, float]]:
    """Return intervals of time (m,) in which rows (m, n) of a joint are zero."""
    out = np.concatenate([[False], used[:, joint] < 0.5, [False]])
    edges = np.concatenate([time[:1], 0.5 * (time[1:] + time[:-1]), time[-1:]])
    changes = edges[np.flatnonzero(np.diff(out.astype(np.int8)))].tolist()
    return tuple(zip(changes[::2], changes[1::2], strict=True))


def friction_panels(series: ReportSeries, joints: Sequence[Joint]) -> list[Panel]:
    """Draw the friction law of each joint that moved, with the fitted rows."""
    panels: list[Panel] = []
    for j, name, unit, _ in joints:
        speed, law = series.law_speed[:, j], series.law_torque[:, j]
        if not np.ptp(speed):
            continue
        there = np.isfinite(series.friction_speed[:, j])
        torque = series.friction_torque[there, j]
        ends = " to ".join(significant(float(end)) for end in law[[0, -1]])
        caption = Caption(f"k{j}", name, f"{ends} {unit}", "friction over velocity")
        foot = f"speed [{joints[j].angle}/s]"
        axes = single(210.0, f"friction [{unit}]", foot)
        endless = np.array([-np.inf, np.inf])
        shown = np.percentile(torque, _SHOWN) if torque.size else np.empty(0)
        values = np.concatenate([shown, law, [0.0]])
        room = 0.08 * float(np.ptp(values)) or 1.0
        axes.y_limits = float(values.min()) - room, float(values.max()) + room
        speeds = np.concatenate([series.friction_speed[there, j], speed])
        axes.x_limits = padded(speeds)
        axes.segments(np.array([endless, [0.0, 0.0]]), np.array([[0.0, 0.0], endless]), MUTED, 0.8)
        axes.dots(series.friction_speed[there, j], torque, WIDE, 2.2)
        axes.line(speed, law, SECOND, 1.8)
        panels.append(panel([axes], caption))
    return panels


def residual_panels(results: Results) -> dict[str, list[Panel]]:
    """Draw the mean residual of each joint over speed and over position."""
    judgement = results.judgement
    found: dict[str, list[Panel]] = {"speed_panels": [], "position_panels": []}
    for what, per, profiles in (
        ("speed", "/s", judgement.speed),
        ("position", "", judgement.position),
    ):
        panels = found[f"{what}_panels"]
        for j, (joint, profile) in enumerate(zip(judgement.joints, profiles, strict=True)):
            mean, std = np.array(profile.mean, np.float64), np.array(profile.std, np.float64)
            if not np.isfinite(mean + std).any():
                continue
            angle = "rad" if joint.unit == "N·m" else "m"
            note = f"RMS error {significant(joint.rms)} {joint.unit}"
            caption = Caption(f"{what[0]}{j}", joint.joint, note, f"mean residual over {what}")
            heading, foot = f"mean residual [{joint.unit}]", f"{what} [{angle}{per}]"
            axes = single(170.0, heading, foot, x_ticks=6)
            centre, endless = np.array(profile.centre, np.float64), np.array([-np.inf, np.inf])
            axes.bands(endless[None], np.array([[-joint.rms, joint.rms]]), BAND)
            reach = np.where(np.isfinite(std), _INTERVAL * std, 0.0)
            ends = np.stack([mean - reach, mean + reach], axis=1)
            axes.y_limits = padded(np.concatenate([ends.ravel(), [0.0, -joint.rms, joint.rms]]))
            axes.x_limits = padded(centre[np.isfinite(mean)])
            axes.segments(endless[None], np.zeros((1, 2)), MUTED, 0.9)
            axes.segments(np.stack([centre, centre], axis=1), ends, FIRST, 1.2)
            axes.line(centre, mean, FIRST, 1.2)
            axes.dots(centre, mean, FIRST, 4.5)
            panels.append(panel([axes], caption))
    return found


def correlation_matrix(results: Results) -> Panel | None:
    """Draw |Ψ_ij| / sqrt(Ψ_ii Ψ_jj) of the base parameters, 0 white, 1 black (paper, Fig. 2)."""
    n = results.n_base
    if n == 0:
        return None
    matrix = np.array(results.correlation, dtype=np.float64)[:n, :n]
    return matrix_panel(matrix, [p.label for p in results.parameters[:n]], "c", "Base parameters")
