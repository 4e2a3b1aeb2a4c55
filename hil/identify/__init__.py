"""From archives to a result: reads archives and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .options import Options

if TYPE_CHECKING:
    from .run import Identification, identify_archives, identify_campaign, identify_sources

__all__ = [
    "Identification",
    "Options",
    "identify_archives",
    "identify_campaign",
    "identify_sources",
]


def __getattr__(name: str) -> Any:
    """What needs the pages of a report is imported when it is used: workers of a batch do not."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import run

    return getattr(run, name)
