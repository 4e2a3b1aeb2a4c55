"""Identification from archives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .options import Options

if TYPE_CHECKING:
    from .run import Identification, identify_archives, identify_campaign, identify_paths

__all__ = [
    "Identification",
    "Options",
    "identify_archives",
    "identify_campaign",
    "identify_paths",
]


def __getattr__(name: str) -> Any:
    """Import `run`, which needs the report pages, on first use: batch workers never use it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import run

    return getattr(run, name)


def __dir__() -> list[str]:
    """Return all names, also those that are not loaded yet."""
    return [*globals(), *__all__]
