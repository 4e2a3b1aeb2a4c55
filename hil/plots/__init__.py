"""Pictures of motions, plans, designs and archives. Names are imported on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hil.base.first_use import on_first_use

if TYPE_CHECKING:
    from hil.plots.plan_picture import check_format, draw_plan, save
    from hil.report.chart_picture import draw_charts, draw_torque

__all__ = ["check_format", "draw_charts", "draw_plan", "draw_torque", "save"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = on_first_use(
        __name__,
        {
            "hil.plots.plan_picture": ("check_format", "draw_plan", "save"),
            "hil.report.chart_picture": ("draw_charts", "draw_torque"),
        },
    )
