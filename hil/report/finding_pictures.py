"""Findings of the page, each with the picture that shows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.report.chart import FIRST, INK, MUTED, SECOND, WIDE, Caption, Chart, Plot, Trace, padded
from hil.report.figures import FRICTION_LAW, MEASURED, RESIDUAL, Joint
from hil.report.numbers import significant
from hil.results.results import Results
from hil.results.series import ReportSeries
from identification.distributions import MAD_TO_STD
from identification.validation.finding import Level

if TYPE_CHECKING:
    from hil.report.panels import Panel

Picture = Literal[
    "torque", "modelled", "nominal", "outliers", "spectrum", "friction", "friction over time",
    "speed", "position", "motion", "clock", "correlation", "consistency",
]  # fmt: skip
"""What is drawn of a joint; of the last two there is a section only."""

_SECTIONS: Final[Mapping[Picture, str]] = {
    "torque": "torque",
    "modelled": "torque",
    "nominal": "torque",
    "outliers": "torque",
    "spectrum": "torque",
    "friction": "friction",
    "friction over time": "friction",
    "speed": "residuals",
    "position": "residuals",
    "motion": "excitation",
    "clock": "excitation",
    "correlation": "correlation",
    "consistency": "consistency",
}
"""Section of the page with the figure of all joints."""

BY_KEY: Final[Mapping[str, Picture | None]] = {
    "nothing held out": None,
    "no repetitions": None,
    "spikes": "outliers",
    "retimed": "clock",
    "undetermined": "correlation",
    "poor excitation": "correlation",
    "friction of a part": "friction over time",
    "negative Coulomb friction": "friction",
    "little friction at speed": "friction",
}
"""Pictures of findings that other findings of the same check do not have."""

BY_CHECK: Final[Mapping[str, Picture]] = {
    "tested": "motion",
    "rows": "motion",
    "positions": "motion",
    "position jumps": "motion",
    "play": "motion",
    "wrapped angles": "motion",
    "time": "motion",
    "times": "nominal",
    "rate of the torque": "torque",
    "torque and motion": "torque",
    "clock": "motion",
    "resolution": "motion",
    "excitation": "motion",
    "sampling rate": "spectrum",
    "torque bandwidth": "spectrum",
    "whiteness": "spectrum",
    "torque ripple": "spectrum",
    "saturation": "torque",
    "delay": "torque",
    "load": "torque",
    "sameness": "torque",
    "error on unseen motion": "torque",
    "unexplained error": "torque",
    "undetermined by the motion": "torque",
    "generalisation": "torque",
    "systematic error": "torque",
    "repetitions": "torque",
    "against the nominal model": "torque",
    "against the controller's model": "torque",
    "against the controller's inertia": "torque",
    "bodies in the torque": "torque",
    "arm of the URDF": "torque",
    "variance explained (R²)": "modelled",
    "scale of the torque": "nominal",
    "torque constant": "modelled",
    "direction of axes": "modelled",
    "order of joints": "modelled",
    "coupled angles": "modelled",
    "outliers": "outliers",
    "friction over load": "friction",
    "friction law": "friction",
    "form of friction": "friction",
    "friction": "friction over time",
    "friction over time": "friction over time",
    "gravity": "position",
    "springs": "position",
    "zeros": "position",
    "residual over position": "position",
    "residual over speed": "speed",
    "physical signs": "consistency",
}
"""Pictures of all others."""

_OUTLIER: Final = 6.0  # robust standard deviations
_WIDTH: Final = 300.0  # of a picture next to its finding [px]
_HEIGHT: Final = 150.0
_LOWER: Final = 0.7  # of the height in the figure of all joints
_WITHOUT_GAPS: Final = 99.5  # per cent of the intervals: a single gap would hide the others
_MOST_SHOWN: Final = 1.2  # of these
_FIGURE_ROWS: Final = 2000  # dots

Draw = Callable[..., "Panel"]


class FoundRow(NamedTuple):
    """A finding of the page, with the figure that shows it."""

    level: Level
    words: str
    step: str
    section: str  #: with this figure of all joints; empty without one
    panel: Panel | None  #: of the joint with the largest error that it names
    what: str  #: description of the panel


def found_rows(
    results: Results,
    series: ReportSeries,
    joints: Sequence[Joint],
    charts: Mapping[str, Sequence[Chart]],
    draw: Draw,
) -> list[FoundRow]:
    """Return what is wrong or doubtful, the most consequential first; then remarks.

    A picture that an earlier finding has is not repeated.

    Args:
        results: with the findings.
        series: motion, torque and friction that pictures show.
        joints: of the arm.
        charts: of the page, by figure, one for each joint.
        draw: draws a chart in a `width` [px].
    """
    rows: list[FoundRow] = []
    shown: set[tuple[Picture, int]] = set()
    for finding in results.judgement.worst_first:
        if finding.level not in ("wrong", "doubtful"):
            continue
        picture = picture_of(finding.check, finding.key)
        panel = None
        what = ""
        joint = worst_joint(results, finding.joints)
        if picture is not None and (picture, joint) not in shown:
            shown.add((picture, joint))
            chart = chart_of(picture, joints[joint], series, charts)
            if chart is not None:
                panel = draw(chart, width=_WIDTH)
                what = chart.caption.what
        section = "" if picture is None else _SECTIONS[picture]
        rows.append(FoundRow(finding.level, finding.words, finding.next_step, section, panel, what))
    return rows + [FoundRow("doubtful", remark, "", "", None, "") for remark in results.remarks]


def picture_of(check: str, key: str) -> Picture | None:
    """Return what shows a finding: by its key, which earlier files lack, or else its check."""
    return BY_KEY[key] if key in BY_KEY else BY_CHECK.get(check)


def worst_joint(results: Results, joints: Sequence[int] = ()) -> int:
    """Return the joint with the largest relative error of these, or of all, from 0."""
    errors = np.nan_to_num([joint.relative or 0.0 for joint in results.judgement.joints])
    return max(joints or range(len(errors)), key=lambda joint: errors[joint])


def chart_of(
    picture: Picture, joint: Joint, series: ReportSeries, charts: Mapping[str, Sequence[Chart]]
) -> Chart | None:
    """Return the chart of a joint that shows a finding; None where it has no data.

    Args:
        picture: which one.
        joint: of the finding.
        series: of the report.
        charts: of the page, by figure, one for each joint.
    """
    figures: dict[Picture, str] = {
        "torque": "torques",
        "spectrum": "spectra",
        "friction": "friction",
        "speed": "speed",
        "position": "position",
        "motion": "excitation",
    }
    if picture in figures:
        own = (chart for chart in charts[figures[picture]] if chart.joint == joint.number)
        chart = next(own, None)
    elif picture == "modelled":
        chart = _modelled(series, joint, series.example_predicted)
    elif picture == "nominal":
        chart = _modelled(series, joint, series.example_nominal)
    elif picture == "outliers":
        chart = _outliers(series, joint)
    elif picture == "friction over time":
        chart = _friction_over_time(series, joint)
    elif picture == "clock":
        chart = _clock(series)
    else:
        return None
    if chart is None:
        return None
    low = [replace(plot, height=_LOWER * plot.height) for plot in chart.plots]
    caption = chart.caption._replace(key=f"found-{chart.caption.key}")
    return replace(chart, caption=caption, plots=low)


def _modelled(series: ReportSeries, joint: Joint, torque: Array | None) -> Chart | None:
    """Return measured over modelled torque (k, n): a slope is a factor, a loop a delay."""
    if torque is None:
        return None
    used = series.example_used[:, joint.number] > 0.0
    measured = series.example_measured[used, joint.number]
    if not measured.size:
        return None
    modelled = torque[used, joint.number]
    some = slice(None, None, -(-len(measured) // _FIGURE_ROWS))
    ends = np.array(padded(np.concatenate([measured, modelled])))
    traces = [
        Trace(ends, MUTED, 1.0, x=ends, name="equal"),
        Trace(measured[some], FIRST, 2.2, x=modelled[some], dots=True),
    ]
    plot = Plot(_HEIGHT, f"measured [{joint.unit}]", traces, limits=(ends[0], ends[1]), origin=True)
    model = "nominal" if torque is series.example_nominal else "identified"
    what = f"measured torque over the torque of the {model} model; on the line both are equal"
    caption = Caption(f"g{joint.number}", joint.name, "", what)
    foot = f"modelled [{joint.unit}]"
    return Chart(
        caption, ends, [plot], foot, joint=joint.number, x_range=(ends[0], ends[1]), shares_x=False
    )


def _outliers(series: ReportSeries, joint: Joint) -> Chart | None:
    """Return the torque over time, with marks where its error stands out."""
    if not series.example_time.size:
        return None
    time = series.example_time - series.example_time[0]
    measured = series.example_measured[:, joint.number]
    error = measured - series.example_predicted[:, joint.number]
    deviation = np.abs(error - np.median(error))
    far = deviation > _OUTLIER * MAD_TO_STD * np.median(deviation)
    marks = {"x": time[far], "dots": True}
    plots = (
        Plot(
            100.0, f"torque [{joint.unit}]",
            [MEASURED.trace(measured), Trace(measured[far], SECOND, 4.0, **marks)],
        ),
        Plot(
            58.0, f"measured − predicted [{joint.unit}]",
            [RESIDUAL.trace(error), Trace(error[far], SECOND, 4.0, **marks)],
        ),
    )  # fmt: skip
    what = f"torque of held-out motion, low-passed; {int(far.sum())} isolated samples"
    return Chart(
        Caption(f"o{joint.number}", joint.name, "", what), time, plots, joint=joint.number,
        x_range=(0.0, max(float(time[-1]), 1e-9)),
    )  # fmt: skip


def _friction_over_time(series: ReportSeries, joint: Joint) -> Chart | None:
    """Return friction over velocity in the first and the last third of the fitted rows."""
    speed = series.friction_speed[:, joint.number]
    there = np.isfinite(speed + series.friction_torque[:, joint.number])
    speed = speed[there]
    torque = series.friction_torque[there, joint.number]
    third = len(torque) // 3
    if not third:
        return None
    law = series.law_torque[:, joint.number]
    shown = np.concatenate([np.percentile(torque, (0.5, 99.5)), law, [0.0]])
    traces = [
        Trace(torque[:third], WIDE, 3.2, x=speed[:third], dots=True),
        Trace(torque[-third:], INK, 2.0, x=speed[-third:], dots=True),
        replace(FRICTION_LAW.trace(law), x=series.law_speed[:, joint.number]),
    ]
    heading = f"friction [{joint.unit}]"
    plot = Plot(_HEIGHT, heading, traces, limits=padded(shown), origin=True)
    what = "friction over velocity, first third of the fitted rows (light) and last third (dark)"
    caption = Caption(f"m{joint.number}", joint.name, "", what)
    foot = f"speed [{joint.angle}/s]"
    return Chart(
        caption, speed, [plot], foot, joint=joint.number, x_range=padded(speed), shares_x=False
    )


def _clock(series: ReportSeries) -> Chart | None:
    """Return the intervals between the time stamps of a recording."""
    if series.clock_time is None or len(series.clock_time) < 2:
        return None
    intervals = 1e3 * np.diff(series.clock_time)
    time = series.clock_time[1:] - series.clock_time[0]
    usual = float(np.median(intervals))
    what = f"intervals between time stamps; usual one {significant(usual)} ms"
    traces = [_line(intervals, WIDE), Trace(intervals, FIRST, 1.8, x=time, dots=True)]
    most = _MOST_SHOWN * float(np.percentile(intervals, _WITHOUT_GAPS))
    plot = Plot(_HEIGHT, "interval [ms]", traces, limits=(min(0.0, float(intervals.min())), most))
    x_range = float(time[0]), max(float(time[-1]), float(time[0]) + 1e-9)
    return Chart(Caption("u", "Time stamps", "", what), time, [plot], x_range=x_range)


def _line(values: Array, colour: str) -> Trace:
    return Trace(values, colour, 0.8)
