"""Measured and predicted torque as a picture and as series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hil import plots  # its pictures load matplotlib, on first use
from hil.base.errors import InputError
from hil.report.figures import MEASURED, NOMINAL, PREDICTED, RESIDUAL, joints_of, torque_charts
from hil.results.results import Results
from hil.results.series import ReportSeries

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DOTS_PER_INCH: Final = 100  # per inch, of a picture in a notebook


@dataclass(frozen=True, eq=False)
class TorquePlot:
    """Torque of the held-out motion as a picture, which a notebook shows, and as numbers.

    Attributes:
        figure: matplotlib's.
        series: measured, predicted and nominal torque [N·m, N] by joint over time [s], low-passed
            as drawn; the columns are (quantity, joint).
    """

    figure: Figure
    series: pandas.DataFrame

    @property
    def axes(self) -> list[Axes]:
        """Axes of the figure."""
        return list(self.figure.axes)

    def savefig(self, *arguments: Any, **options: Any) -> None:
        """Write the picture, as :meth:`matplotlib.figure.Figure.savefig`."""
        self.figure.savefig(*arguments, **options)

    def png(self) -> bytes:
        """Return the picture as a PNG."""
        content = BytesIO()
        self.figure.savefig(content, format="png", dpi=_DOTS_PER_INCH)
        return content.getvalue()

    def _repr_png_(self) -> bytes:
        """Return what a notebook shows."""
        return self.png()


def torque_plot(
    results: Results,
    series: ReportSeries,
    joints: Sequence[str | int] | str | int | None,
    size: tuple[float, float] | None,
    axes: Axes | Sequence[Axes] | None,
) -> TorquePlot:
    """Draw torque of joints, see :meth:`IdentifiedArm.plot`.

    Args:
        results: of the identification.
        series: of the figures.
        joints: by name or number, by default all.
        size: of the figure [inch].
        axes: to draw on.

    Raises:
        InputError: there is no such joint, or another number of axes than of joints.
    """
    chosen = _numbers(joints, results.joint_names)
    charts = [chart for chart in torque_charts(series, joints_of(results)) if chart.joint in chosen]
    legends = [MEASURED, PREDICTED, NOMINAL, RESIDUAL]
    if axes is None:
        figure = plots.draw_charts([charts], legends, size=size)
    else:
        places = [*axes] if isinstance(axes, Sequence | np.ndarray) else [axes]
        if len(places) != len(charts):
            problem = f"{len(places)} axes are given for {len(charts)} joints"
            raise InputError(None, problem, field="axes", remedy="give one for each joint")
        for place, chart in zip(places, charts, strict=True):
            plots.draw_torque(place, chart, legends)
        figure = places[0].figure.get_figure(root=True)
    return TorquePlot(figure, _frame(results, series, chosen))


def _numbers(joints: Sequence[str | int] | str | int | None, names: Sequence[str]) -> list[int]:
    """Return joints as numbers from 0: of names, or of numbers from 0."""
    if joints is None:
        return [*range(len(names))]
    numbers = []
    for joint in [joints] if isinstance(joints, str | int) else joints:
        if joint in names:
            numbers.append([*names].index(str(joint)))
        elif isinstance(joint, int | np.integer) and 0 <= joint < len(names):
            numbers.append(int(joint))
        else:
            remedy = f"name {', '.join(names)}, or give a number from 0"
            raise InputError(None, f"there is no joint {joint!r}", field="joints", remedy=remedy)
    return numbers


def _frame(results: Results, series: ReportSeries, chosen: Sequence[int]) -> pandas.DataFrame:
    import pandas  # only for this table

    names = [results.joint_names[joint] for joint in chosen]
    time = pandas.Index(series.example_time - series.example_time[:1].sum(), name="time")
    torques = {
        "measured": series.example_measured,
        "predicted": series.example_predicted,
        "nominal": series.example_nominal,
    }
    return pandas.concat(
        {
            name: pandas.DataFrame(values[:, [*chosen]], index=time, columns=names)
            for name, values in torques.items()
            if values is not None
        },
        axis="columns",
        names=["torque", "joint"],
    )
