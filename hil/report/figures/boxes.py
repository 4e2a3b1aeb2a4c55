"""Spread of the torque prediction error over the validation runs (the paper's Fig. 3)."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.report import numbers
from hil.report.figures.canvas import blank, headed, place, ruled
from hil.report.figures.palette import BAND, FIRST, INK, MUTED, SECOND
from hil.report.figures.svg import Panel, drawing, to_panel
from hil.results import Results

_WIDTH, _HEIGHT = 190.0, 226.0
_FEWEST_FOR_A_BOX = 5  # quartiles of fewer are nearly the runs themselves

# Mean |e| of normal residuals of standard deviation 1.
MEAN_ABS_OF_NORMAL = math.sqrt(2.0 / math.pi)


def error_boxes(results: Results) -> list[Panel]:
    """Mean |e| of every validation run, one panel and scale per joint; one run has no spread."""
    if len(results.validation) < 2:
        return []
    errors = np.array([run.mean_abs_error for run in results.validation])
    if not np.isfinite(errors).any(axis=0).all():
        return []
    return [
        _joint(j, name, errors[:, j], MEAN_ABS_OF_NORMAL * results.noise_std[j])
        for j, name in enumerate(results.joint_names)
    ]


def _joint(j: int, name: str, errors: NDArray[np.float64], expected: float) -> Panel:
    errors = errors[np.isfinite(errors)]
    low, middle, high = (float(v) for v in np.percentile(errors, (25.0, 50.0, 75.0)))
    alt = (
        f"{name}: mean absolute torque error of {errors.size} runs, median"
        f" {numbers.significant(middle)} N·m, quartiles {numbers.significant(low)} and"
        f" {numbers.significant(high)}, largest {numbers.significant(float(errors.max()))}."
    )
    with drawing():
        figure = blank(_WIDTH, _HEIGHT)
        axes = place(figure, 46.0, 24.0, _WIDTH - 54.0, _HEIGHT - 34.0)
        top = max(float(errors.max()), 1e-12)
        if errors.size >= _FEWEST_FOR_A_BOX:
            _box(axes, errors)
        axes.scatter(
            _spread(errors), errors, s=16.0, color=FIRST, alpha=0.85, linewidths=0.0, zorder=3
        )
        if math.isfinite(expected):
            top = max(top, expected)
            axes.axhline(expected, color=SECOND, linewidth=1.3, linestyle=(0, (4, 3)), zorder=4)
        ruled(axes, "y", y_ticks=5)
        axes.set_xlim(0.4, 1.6)
        axes.set_xticks([])
        axes.set_ylim(0.0, 1.12 * top)
        axes.spines["bottom"].set_visible(False)
        headed(axes, "mean |e| [N·m]")
        note = f"median {numbers.significant(middle)} N·m"
        return to_panel(figure, key=f"b{j}", title=name, note=note, alt=alt)


def _box(axes: Axes, errors: NDArray[np.float64]) -> None:
    thin = {"color": MUTED, "linewidth": 1.1}
    axes.boxplot(
        errors,
        positions=[1.0],
        widths=0.55,
        showfliers=False,  # every run is drawn as a dot of its own
        patch_artist=True,
        boxprops={"facecolor": BAND, "edgecolor": MUTED, "linewidth": 1.1},
        medianprops={"color": INK, "linewidth": 2.2},
        whiskerprops=thin,
        capprops=thin,
    )


def _spread(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Side steps that keep neighbours in value apart; the golden ratio never lines up."""
    rank = np.argsort(np.argsort(errors, kind="stable"), kind="stable")
    steps = (rank * 0.6180339887498949) % 1.0 - 0.5
    return np.asarray(1.0 + 0.34 * steps, dtype=np.float64)
