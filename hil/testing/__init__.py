"""Simulated cell and controller with faults, for tests of programs that drive an arm.

The pytest plugin is `hil.testing.plugin`; the names here are those behind its fixtures.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .faulty import (
        SessionError,
        UdpController,
        faulty_controller,
        faulty_link,
        run_campaign,
        shortened,
    )

__all__ = [
    "SessionError",
    "UdpController",
    "faulty_controller",
    "faulty_link",
    "run_campaign",
    "shortened",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module(f"{__name__}.faulty"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return all names, including names that are not loaded yet."""
    return [*globals(), *__all__]
