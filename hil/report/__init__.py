"""Pages. Pictures of their charts load matplotlib on first use."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.report.panels import box_panel, chart_panel, matrix_panel

__all__ = ["box_panel", "chart_panel", "matrix_panel"]

if not TYPE_CHECKING:  # which would accept any name

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module("hil.report.panels"), name)


def __dir__() -> list[str]:
    """Return all names, including names that are not loaded yet."""
    return [*globals(), *__all__]
