"""Pages. Pictures of their charts load matplotlib on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hil.base.first_use import on_first_use

if TYPE_CHECKING:
    from hil.report.panels import box_panel, chart_panel, matrix_panel

__all__ = ["box_panel", "chart_panel", "matrix_panel"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = on_first_use(__name__, {"hil.report.panels": __all__})
