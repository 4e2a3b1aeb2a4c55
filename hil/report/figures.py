"""Figures of the report, one panel for each joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.report.chart import (
    FIRST,
    MUTED,
    Caption,
    Chart,
    Legend,
    Matrix,
    Plot,
    Trace,
    correlations,
    error_bars,
    padded,
    rule,
)  # fmt: skip
from hil.report.numbers import MISSING, fixed, percent, significant
from hil.results.results import FittedResult, Results, ValidationResult, by_id
from hil.results.series import ReportSeries
from identification.distributions import NORMAL_95

# Percentiles of the torque inside the axes; outliers may lie outside.
_SHOWN_PERCENTILES: Final = (0.5, 99.5)
_MAX_REPETITION_TICKS: Final = 6  # with a tick each


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
        return [
            Joint(j, judgement.joint, judgement.unit, "")
            for j, judgement in enumerate(results.judgement.joints)
        ]
    errors = zip(example.relative_error, example.all_rows_joint_errors, strict=True)
    return [
        Joint(
            j,
            judgement.joint,
            judgement.unit,
            f"error in motion {_share(moving)}, whole recording {_share(every)}",
        )
        for j, (judgement, (moving, every)) in enumerate(
            zip(results.judgement.joints, errors, strict=True)
        )
    ]


def _share(fraction: float | None) -> str:
    """Format a fraction in per cent; a dash without a sign for a joint at rest."""
    text = percent(fraction)
    return text if text == MISSING else f"{text} %"


MEASURED = Legend("measured", "measured", "--wide", 4.0)
PREDICTED = Legend("predicted", "identified model", "--ink", 1.1)
NOMINAL = Legend("nominal", "nominal model", "--muted", 1.0, dashed=True)
RESIDUAL = Legend("residual", "error of the identified model", "--second", 0.9)
NOMINAL_RESIDUAL = NOMINAL._replace(key="nominal residual", width=0.8)
POSITION = Legend("position", "position", "--first", 1.5)
VELOCITY = Legend("velocity", "velocity", "--second", 1.5)
PARTS = (
    Legend("inertia", "inertia: of acceleration", "--first", 1.2),
    Legend("coriolis", "Coriolis and centrifugal", "--route-3", 1.2),
    Legend("gravity", "gravity", "--good", 1.2),
    Legend("friction", "friction and offset", "--second", 1.2),
    Legend("elements", "ripple, springs and balancers", "--outside-3", 1.2),
)
SPECTRUM_MEASURED = Legend("measured", "measured torque", "--wide", 2.4)
SPECTRUM_RESIDUAL = RESIDUAL._replace(width=1.4)
LEGENDS = {
    "measured": MEASURED,
    "predicted": PREDICTED,
    "nominal": NOMINAL,
    "residual": RESIDUAL,
    "spectrum_measured": SPECTRUM_MEASURED,
    "spectrum_residual": SPECTRUM_RESIDUAL,
}
"""Entries of legends by their names in the templates."""


def excitation_charts(series: ReportSeries, joints: Sequence[Joint]) -> list[Chart]:
    """Return position and velocity of each joint (paper, Fig. 1)."""
    time = series.excitation_time - series.excitation_time[0]
    charts = []
    for joint in joints:
        j = joint.number
        unit = joint.angle
        position = series.excitation_position[:, j]
        velocity = series.excitation_velocity[:, j]
        note = f"{fixed(float(position.min()), 2)} to {fixed(float(position.max()), 2)} {unit}"
        shaded = _left_out(time, series.excitation_fitted, j)
        plots = (
            Plot(78.0, f"position [{unit}]", [POSITION.trace(position)], shaded),
            Plot(78.0, f"velocity [{unit}/s]", [VELOCITY.trace(velocity)], shaded),
        )
        caption = Caption(f"x{j}", joint.name, note, "position and velocity over time")
        charts.append(Chart(caption, time, plots, joint=j))
    return charts


def torque_charts(series: ReportSeries, joints: Sequence[Joint]) -> list[Chart]:
    """Return measured and predicted torque of each joint, and their difference (paper, Fig. 4)."""
    if series.example_time.size == 0:
        return []
    time = series.example_time - series.example_time[0]
    charts = []
    for j, name, unit, error in joints:
        measured = series.example_measured[:, j]
        predicted = series.example_predicted[:, j]
        torques = [MEASURED.trace(measured), PREDICTED.trace(predicted)]
        errors = [RESIDUAL.trace(measured - predicted)]
        what = "measured and predicted torque over time, and their difference"
        if series.example_nominal is not None:
            nominal = series.example_nominal[:, j]
            torques.insert(1, NOMINAL.trace(nominal, loose=True))
            errors.insert(0, NOMINAL_RESIDUAL.trace(measured - nominal, loose=True))
            what += ", of the identified and of the nominal model"
        shaded = _left_out(time, series.example_used, j)
        plots = (
            Plot(118.0, f"torque [{unit}]", torques, shaded),
            Plot(58.0, f"measured − predicted [{unit}]", errors, shaded),
        )
        charts.append(Chart(Caption(f"t{j}", name, error, what), time, plots, joint=j))
    return charts


def known_parts(series: ReportSeries) -> list[Legend]:
    """Return the parts of the torque that the series contain."""
    return [part for part in PARTS if getattr(series, f"example_{part.key}") is not None]


def part_charts(series: ReportSeries, joints: Sequence[Joint]) -> list[Chart]:
    """Return the predicted torque of each joint and what it consists of."""
    contributions = [(part, getattr(series, f"example_{part.key}")) for part in known_parts(series)]
    if not contributions or series.example_time.size == 0:
        return []
    time = series.example_time - series.example_time[0]
    charts = []
    for j, name, unit, _ in joints:
        traces = [
            PREDICTED._replace(colour="--wide", width=3.0).trace(series.example_predicted[:, j])
        ]
        traces += [part.trace(values[:, j]) for part, values in contributions]
        sizes = [float(np.sqrt(np.mean(values[:, j] ** 2))) for _, values in contributions]
        largest = contributions[int(np.argmax(sizes))][0]
        note = f"largest: {largest.key}, RMS {significant(max(sizes))} {unit}"
        caption = Caption(f"d{j}", name, note, "predicted torque by part over time")
        plot = Plot(176.0, f"torque [{unit}]", traces)
        charts.append(Chart(caption, time, [plot], joint=j))
    return charts


def spectrum_charts(series: ReportSeries, joints: Sequence[Joint]) -> list[Chart]:
    """Return the spectra of the measured torque and of the residual of each joint."""
    frequency = series.spectrum_frequency
    measured = series.spectrum_measured
    residual = series.spectrum_residual
    if frequency is None or measured is None or residual is None or not len(frequency):
        return []
    charts = []
    for j, name, unit, _ in joints:
        traces = [
            SPECTRUM_MEASURED.trace(measured[:, j]),
            SPECTRUM_RESIDUAL.trace(residual[:, j]),
        ]
        every = np.concatenate([measured[:, j], residual[:, j]])
        positive = every[every > 0.0]
        if not positive.size:
            continue
        top = float(positive.max())
        limits = max(0.7 * float(positive.min()), 1e-6 * top), 1.4 * top
        weighed = residual[:, j] * np.sqrt(frequency)  # on a logarithmic axis of frequency
        note = f"most of the residual at {significant(float(frequency[np.argmax(weighed)]), 2)} Hz"
        what = "amplitude spectral density of measured torque and residual over frequency"
        plot = Plot(176.0, f"torque [{unit}/√Hz]", traces, limits=limits)
        caption = Caption(f"f{j}", name, note, what)
        charts.append(Chart(caption, frequency, [plot], "frequency [Hz]", joint=j, log=True))
    return charts


def _left_out(time: Array, used: Array, joint: int) -> Sequence[tuple[float, float]]:
    """Return intervals of time (m,) in which rows (m, n) of a joint are zero."""
    out = np.concatenate([[False], used[:, joint] < 0.5, [False]])
    edges = np.concatenate([time[:1], 0.5 * (time[1:] + time[:-1]), time[-1:]])
    changes = edges[np.flatnonzero(np.diff(out.astype(np.int8)))].tolist()
    return tuple(zip(changes[::2], changes[1::2], strict=True))


MEASURED_FRICTION = Legend(
    "measured", "measured torque − predicted torque without friction", "--wide", 2.2
)
FRICTION_LAW = Legend("law", "friction law, as identified", "--second", 1.8)


def friction_charts(series: ReportSeries, joints: Sequence[Joint]) -> list[Chart]:
    """Return the friction law of each joint that moved, with the fitted rows."""
    charts: list[Chart] = []
    for j, name, unit, _ in joints:
        speed = series.law_speed[:, j]
        law = series.law_torque[:, j]
        if not np.ptp(speed):
            continue
        there = np.isfinite(series.friction_speed[:, j] + series.friction_torque[:, j])
        torque = series.friction_torque[there, j]
        ends = " to ".join(significant(float(end)) for end in law[[0, -1]])
        caption = Caption(f"k{j}", name, f"{ends} {unit}", "friction over velocity")
        shown = np.percentile(torque, _SHOWN_PERCENTILES) if torque.size else np.empty(0)
        values = np.concatenate([shown, law, [0.0]])
        margin = 0.08 * float(np.ptp(values)) or 1.0
        dots = replace(
            MEASURED_FRICTION.trace(torque), x=series.friction_speed[there, j], dots=True
        )
        traces = [dots, replace(FRICTION_LAW.trace(law), x=speed)]
        plot = Plot(
            150.0, f"friction [{unit}]", traces,
            limits=(float(values.min()) - margin, float(values.max()) + margin), origin=True,
        )  # fmt: skip
        foot = f"speed [{joints[j].angle}/s]"
        charts.append(Chart(caption, speed, [plot], foot, joint=j, shares_x=False))
    return charts


def residual_charts(results: Results) -> dict[str, list[Chart]]:
    """Return the mean residual of each joint over speed and over position."""
    judgement = results.judgement
    charts: dict[str, list[Chart]] = {"speed": [], "position": []}
    for what, per, profiles in (
        ("speed", "/s", judgement.speed),
        ("position", "", judgement.position),
    ):
        for j, (joint, profile) in enumerate(zip(judgement.joints, profiles, strict=True)):
            mean = np.array(profile.mean, np.float64)
            std = np.array(profile.std, np.float64)
            if not np.isfinite(mean + std).any():
                continue
            angle = "rad" if joint.unit == "N·m" else "m"
            note = f"RMS error {significant(joint.rms)} {joint.unit}"
            caption = Caption(f"{what[0]}{j}", joint.joint, note, f"mean residual over {what}")
            centre = np.array(profile.centre, np.float64)
            reach = np.where(np.isfinite(std), NORMAL_95 * std, 0.0)
            ends = np.stack([mean - reach, mean + reach], axis=1)
            x_range = padded(centre[np.isfinite(mean)])
            traces = [
                rule(0.0, x_range),
                error_bars(centre, ends, FIRST, 1.2),
                Trace(mean, FIRST, 1.2, name="mean"),
                Trace(mean, FIRST, 4.5, dots=True),
            ]
            plot = Plot(
                110.0, f"mean residual [{joint.unit}]", traces, band=(-joint.rms, joint.rms),
                limits=padded(np.concatenate([ends.ravel(), [0.0, -joint.rms, joint.rms]])),
            )  # fmt: skip
            foot = f"{what} [{angle}{per}]"
            charts[what].append(
                Chart(caption, centre, [plot], foot, joint=j, x_range=x_range, shares_x=False)
            )
    return charts


def precision_charts(results: Results) -> list[Chart]:
    """Return each required precision over the repetitions, with what the design promised."""
    charts = []
    required = results.conduct.precision if results.conduct is not None else []
    for k, requirement in enumerate(required):
        count = np.array(requirement.repetitions, np.float64)
        ratio = np.array(requirement.ratio)
        note = f"{requirement.worst} is worst"
        what = "ratio of the 95 % interval to the required one, over repetitions"
        x_range = 0.5, float(count.max()) + 0.5
        traces = [rule(1.0, x_range)]
        shown = [*ratio, 0.0, 1.1]
        if requirement.promised is not None:
            promised = np.full(2, requirement.promised)
            traces.append(Trace(promised, MUTED, 1.4, dashed=True, x=np.array(x_range)))
            shown.append(requirement.promised)
        traces += [Trace(ratio, FIRST, 1.2, name="ratio"), Trace(ratio, FIRST, 4.5, dots=True)]
        limits = padded(np.array(shown))
        step = max(1, -(-int(count.max()) // _MAX_REPETITION_TICKS))
        charts.append(
            Chart(
                Caption(f"q{k}", requirement.requirement, note, what), count,
                [Plot(110.0, "interval / required", traces, limits=limits)], "repetitions",
                ticks=range(step, int(count.max()) + 1, step), x_range=x_range, shares_x=False,
            )
        )  # fmt: skip
    return charts


def correlation_matrix(results: Results) -> Matrix | None:
    """Return |Ψ_ij| / sqrt(Ψ_ii Ψ_jj) of the base parameters, 0 white, 1 black (paper, Fig. 2)."""
    n = results.n_base
    if n == 0:
        return None
    matrix = np.array(results.correlation, dtype=np.float64)[:n, :n]
    base = results.parameters[:n]
    order = [base.index(parameter) for parameter in by_id(base)]
    labels = [base[k].label for k in order]
    return correlations(matrix[np.ix_(order, order)], labels, "c", "Base parameters")
