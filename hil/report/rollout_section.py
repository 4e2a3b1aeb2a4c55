"""Figure of a rollout: position errors over the horizon, of each joint and of the tool."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from hil.base.arrays import Array
from hil.report.chart import Caption, Chart, Legend, Plot, Trace, label
from hil.report.figures import NOMINAL, PREDICTED
from hil.results.rollout_result import WANTED_COVERAGE, ArmErrors, RolloutResult
from identification.text import percentage

_PLOT_HEIGHT: Final = 190.0  # px
_MIN_SHOWN_ERROR: Final = 1e-3  # mrad or mm, of logarithmic axes

SAMPLES: Final = Legend("samples", "arms drawn from the posterior", "--wide", 1.0)
POLISHED: Final = Legend("polished", "polished model", "--second", 1.4)
ROLLOUT_LEGENDS: Final[Mapping[str, Legend]] = {
    "samples": SAMPLES,
    "nominal": NOMINAL,
    "predicted": PREDICTED._replace(width=1.8),
    "polished": POLISHED,
}
"""Lines of the figure by name."""

EXPECTED: Final = Legend(
    "expected", " to ".join(map(percentage, WANTED_COVERAGE)), "--muted", 1.0, dashed=True
)
_DOT_SIZE: Final = 6.0  # px
_JOINT_COLOURS: Final = (
    "--first", "--second", "--good", "--route-3", "--outside-3", "--wide", "--warn-line", "--muted",
)  # fmt: skip

Errors = Callable[[ArmErrors], Array]
"""Errors (h,) of an arm, of one joint or of the tool [mrad or mm]."""


def rollout_charts(result: RolloutResult) -> list[Chart]:
    """Return a chart of each joint, then of the tool."""

    def of_joint(joint: int) -> Errors:
        return lambda arm: np.array([at[joint] for at in arm.joints])

    def of_tool(arm: ArmErrors) -> Array:
        return np.array([np.nan if at is None else at for at in arm.tool])

    charts = []
    for joint, (name, unit) in enumerate(zip(result.joint_names, result.units, strict=True)):
        heading = f"error [{'mrad' if unit == 'rad' else 'mm'}]"
        charts.append(_chart(result, of_joint(joint), joint, label(name), heading))
    last = len(charts)
    return [*charts, _chart(result, of_tool, last, f"tool: {label(result.tool)}", "error [mm]")]


def _chart(result: RolloutResult, errors: Errors, number: int, title: str, heading: str) -> Chart:
    """Return position errors over the horizon."""

    def shown(arm: ArmErrors) -> Array:
        return np.maximum(1e3 * errors(arm), _MIN_SHOWN_ERROR)

    horizons = np.array(result.horizons)
    legends = ROLLOUT_LEGENDS
    traces = list[Trace]()
    if result.sample_errors:
        gap = np.full(1, np.nan)
        parts = [part for arm in result.sample_errors for part in (shown(arm), gap)]
        times = np.tile(np.append(horizons, np.nan), len(result.sample_errors))
        samples = legends["samples"].trace(np.concatenate(parts))
        traces.append(samples.over(times))
    if result.nominal is not None:
        traces.append(legends["nominal"].trace(shown(result.nominal)))
    traces.append(legends["predicted"].trace(shown(result.identified)))
    if result.polish is not None:
        traces.append(legends["polished"].trace(shown(result.polish.errors)))
    what = "root mean square position error over the horizon of a simulation"
    return Chart(
        Caption(f"rollout-{number}", title, "", what),
        horizons,
        [Plot(_PLOT_HEIGHT, heading, traces, limits=_limits(traces))],
        foot="horizon [s]",
        joint=number,
        log=True,
        ticks=result.horizons,
    )


def overview_charts(result: RolloutResult) -> list[Chart]:
    """Return the errors of all joints together, and the shares inside the band of each joint."""

    def of_all(arm: ArmErrors) -> Array:
        return np.array([arm.overall(k) for k in range(len(arm.joints))])

    errors = _chart(result, of_all, 0, "", "position error, rms of all joints [mrad or mm]")
    note = f"{label(result.cell)}: {result.windows} windows"
    errors = replace(errors, caption=errors.caption._replace(note=note))
    if not result.inside:
        return [errors]
    horizons = np.array(result.horizons)
    traces = [EXPECTED.trace(np.full(len(horizons), 100.0 * end)) for end in WANTED_COVERAGE]
    for legend, shares in zip(_band_legends(result), zip(*result.inside, strict=True), strict=True):
        line = legend.trace(100.0 * np.array(shares))
        traces += [line, replace(line, dots=True, width=_DOT_SIZE)]
    what = "share of measured positions in the 95 % band of the drawn arms over the horizon"
    plot = Plot(
        _PLOT_HEIGHT, "measured positions in the 95 % band [%]", traces, limits=(0.0, 102.0)
    )
    band = Chart(
        Caption("rollout-band", "", "", what),
        horizons,
        [plot],
        "horizon [s]",
        ticks=horizons.tolist(),
    )
    return [errors, band]


def overview_legends(result: RolloutResult) -> list[Legend]:
    """Return the legends of :func:`overview_charts`."""
    return [*ROLLOUT_LEGENDS.values(), *_band_legends(result), EXPECTED]


def _band_legends(result: RolloutResult) -> list[Legend]:
    """Return the legend of each joint in the shares inside the band."""
    colours = itertools.cycle(_JOINT_COLOURS)
    return [
        Legend(name, label(name), colour, 1.4)
        for name, colour in zip(result.joint_names, colours, strict=False)
    ]


def _limits(traces: Sequence[Trace]) -> tuple[float, float]:
    """Return the range of a logarithmic axis."""
    values = np.concatenate([trace.values for trace in traces])
    finite = values[np.isfinite(values)]
    if not finite.size:
        return _MIN_SHOWN_ERROR, 1.0
    return 0.8 * float(finite.min()), 1.25 * float(finite.max())
