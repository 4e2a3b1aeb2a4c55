"""For tests of programs that drive an arm: the simulated cell, its controller, and their faults.

The pytest plugin (`hil.testing.plugin`) is found by pytest itself and imports nothing heavy before
a fixture is used. The names here are what its fixtures give and are made of.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .faulty import faulty_controller, faulty_link, run_campaign, shortened
    from .udp import UdpController

_HOME = {
    "UdpController": "udp",
    "faulty_controller": "faulty",
    "faulty_link": "faulty",
    "run_campaign": "faulty",
    "shortened": "faulty",
}

__all__ = ["UdpController", "faulty_controller", "faulty_link", "run_campaign", "shortened"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
