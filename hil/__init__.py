"""Hardware-in-the-loop identification of an industrial robot's dynamics.

The public names are imported when they are first used, so that the command line can settle how
many threads the linear algebra may take before numpy is loaded.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hil import errors

if TYPE_CHECKING:
    from hil.campaign import Campaign
    from hil.cell import Cell
    from hil.recordings import open_recording

_HOME = {"Campaign": "hil.campaign", "Cell": "hil.cell", "open_recording": "hil.recordings"}

__all__ = ["Campaign", "Cell", "errors", "open_recording"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
