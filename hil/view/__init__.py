"""A motion in three dimensions, in the browser, where `viser` is installed."""

from __future__ import annotations

from hil.view.show import require_viewer, show

__all__ = ["require_viewer", "show"]
