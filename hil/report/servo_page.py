"""Page of an arm without torque: prediction over time, parameters with intervals, choices."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from hil import report  # its pictures load matplotlib, on first use
from hil.base.files import write_files
from hil.report.chart import Caption, Chart, Legend, Plot, label
from hil.report.interactive import chart_data, library
from hil.report.output_files import REPORT
from hil.report.rendering import environment, page_bytes, template_text
from hil.results.provenance import RESULTS
from hil.results.servo_result import ServoResults
from hil.results.servo_series import ServoSeries, load_servo_series
from identification.arrays import root_mean_square
from identification.text import interval_text

MEASURED: Final = Legend("measured", "measured", "--first", 1.6)
COMMANDED: Final = Legend("commanded", "command", "--muted", 1.0, dashed=True)
IDENTIFIED: Final = Legend("identified", "identified, from the commands alone", "--second", 1.6)
COMPARED: Final = Legend("compared", "parameters of the maker's file", "--wide", 1.4)
LEGENDS: Final = (MEASURED, COMMANDED, COMPARED, IDENTIFIED)
MEANINGS: Final = {
    "kp": "stiffness of the servo",
    "kd": "damping of the servo, by the velocity of its position error",
    "armature": "inertia of the rotor, at the joint",
    "viscous": "friction by velocity",
    "coulomb": "dry friction of a moving joint",
    "static": "additional dry friction at rest",
    "speed": "velocity at which static friction has faded to 37 %",
    "load": "dry friction per N·m (N) of load from the bodies",
    "limit": "largest torque of the servo",
    "dead_band": "position error up to which the servo exerts no torque",
    "acceleration": "largest acceleration of the set-point on its way to a command",
    "delay": "time from a command to the servo",
    "offset": "servo zero relative to the encoder's zero",
}
HELD: Final = "something held the arm"
_MOTIONS: Final = 4  # on a page
_PICTURE_JOINTS: Final = 3  # of the picture
_PLOT_HEIGHT: Final = 170.0  # px
_LINE_BINS: Final = 400
_MILLI: Final = 1e3


def motion_charts(
    results: ServoResults, series: ServoSeries, most: int = _PICTURE_JOINTS
) -> list[Chart]:
    """Return charts of the joints with the largest errors of the command, in their order."""
    errors = root_mean_square(series.commanded - series.measured)
    chosen = np.sort(np.argsort(-errors)[:most])
    return [_chart(results, series, int(joint)) for joint in chosen]


def _chart(results: ServoResults, series: ServoSeries, joint: int) -> Chart:
    unit = results.joint_units[joint]
    error = _MILLI * np.sqrt(
        np.mean((series.identified[:, joint] - series.measured[:, joint]) ** 2)
    )
    traces = [
        COMMANDED.trace(series.commanded[:, joint]),
        MEASURED.trace(series.measured[:, joint]),
        *([] if series.compared is None else [COMPARED.trace(series.compared[:, joint])]),
        IDENTIFIED.trace(series.identified[:, joint]),
    ]
    held = [(contact.start, contact.end) for contact in series.contacts]
    note = f"{label(series.archive)}: {error:.3g} {'mrad' if unit == 'rad' else 'mm'} rms"
    return Chart(
        Caption(
            f"{label(series.archive)}-{joint}",
            label(results.joint_names[joint]),
            note,
            "position over time",
        ),
        series.time,
        [Plot(_PLOT_HEIGHT, f"position [{unit}]", traces, shaded=held, shade=HELD)],
        joint=joint,
    )


def rewrite_servo_report(folder: Path) -> ServoResults:
    """Create the report again from results and series in a folder.

    Raises:
        InputError: one of them cannot be read.
        OutputError: the report cannot be written.
    """
    results = ServoResults.load(folder / RESULTS)
    page = servo_page_bytes(results, load_servo_series(folder, results))
    write_files(folder, {REPORT: page})
    return results


def servo_page_bytes(results: ServoResults, series: Sequence[ServoSeries]) -> bytes:
    """Return the page as one HTML file; the same input gives the same bytes."""
    count = len(results.joint_names)
    figures = {
        f"motion-{k}": motion_charts(results, each, count)
        for k, each in enumerate(series[:_MOTIONS])
    }
    by_joint = {
        joint: [value for value in results.servo if value.joint == joint]
        for joint in results.joint_names
    }
    context = {
        "results": results,
        "by_joint": by_joint,
        "meanings": {
            name: meaning
            for name, meaning in MEANINGS.items()
            if any(value.name == name and value.present for value in results.servo)
        },
        "motions": [
            (name, each.archive, [report.chart_panel(chart, _LINE_BINS) for chart in charts], held)
            for (name, charts), each in zip(figures.items(), series, strict=False)
            for held in [bool(each.contacts)]
        ],
        "interval": interval_text,
        "legends": [
            legend
            for legend in LEGENDS
            if legend is not COMPARED or (series and series[0].compared is not None)
        ],
        "held_legend": HELD,
        "chart_data": chart_data(figures, results.joint_names),
    }
    scripts = (*library(), template_text("charts.js"))
    return page_bytes(environment(*scripts).get_template("servo.html.j2").render(**context))
