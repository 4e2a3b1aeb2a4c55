"""Pictures of motions, for people who compare them with what a teach pendant shows."""

from __future__ import annotations

from hil.plots.plan_picture import check_format, draw_plan, save

__all__ = ["check_format", "draw_plan", "save"]
