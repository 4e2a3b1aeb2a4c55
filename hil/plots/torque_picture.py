"""Picture of measured and predicted torque of one motion, a panel for each joint."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from hil.plots import style
from hil.report.drawing import label
from hil.report.series import ReportSeries
from hil.results import Results

_WIDTH, _HEIGHT = 9.0, 1.5  # inch, of all panels and of one


def draw_torques(results: Results, series: ReportSeries) -> Figure:
    """Draw the torque of the example of a report, low-passed at 30 Hz, and the error in it."""
    joints = results.judgement.joints
    time = series.example_time - series.example_time[:1].sum()
    with style.page():
        figure = Figure((_WIDTH, _HEIGHT * len(joints) + 0.6), layout="constrained")
        panels = np.ravel(figure.subplots(len(joints), 1, sharex=True, squeeze=False))
        for j, (panel, joint) in enumerate(zip(panels, joints, strict=True)):
            measured = series.example_measured[:, j]
            predicted = series.example_predicted[:, j]
            panel.plot(
                time, measured, color=style.POSITION, alpha=0.35, linewidth=3.0, label="measured"
            )
            if series.example_nominal is not None:
                panel.plot(
                    time, series.example_nominal[:, j], color=style.MUTED, linewidth=0.8,
                    linestyle="--", label="nominal model",
                )  # fmt: skip
            panel.plot(time, predicted, color=style.INK, linewidth=0.9, label="identified model")
            panel.plot(
                time, measured - predicted, color=style.ACCELERATION, linewidth=0.7,
                label="error of the identified model",
            )  # fmt: skip
            panel.set_title(label(joint.joint))
            panel.set_ylabel(f"torque [{joint.unit}]" if joint.unit == "N·m" else "force [N]")
        panels[-1].set_xlabel("time [s]")
        handles, names = panels[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper center", ncols=4, fontsize=style.SMALL)
    return figure
