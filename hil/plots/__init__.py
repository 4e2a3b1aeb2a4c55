"""Pictures of motions, plans, designs and archives. Names are imported on first use."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.plots.plan_picture import check_format, draw_plan, save
    from hil.report.chart_picture import draw_charts, draw_torque

__all__ = ["check_format", "draw_charts", "draw_plan", "draw_torque", "save"]
_MODULE_OF_NAME = {
    **dict.fromkeys(("check_format", "draw_plan", "save"), "hil.plots.plan_picture"),
    **dict.fromkeys(("draw_charts", "draw_torque"), "hil.report.chart_picture"),
}

if not TYPE_CHECKING:  # which would accept any name

    def __getattr__(name: str) -> Any:
        if name not in _MODULE_OF_NAME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_MODULE_OF_NAME[name]), name)


def __dir__() -> list[str]:
    """Return all names, including names that are not loaded yet."""
    return [*globals(), *__all__]
