"""Pictures of motions, plans, designs and archives."""

from __future__ import annotations

from hil.plots.plan_picture import check_format, draw_plan, save

__all__ = ["check_format", "draw_plan", "save"]
