"""Simulated cell and controller with faults, for tests of programs that drive an arm.

The pytest plugin is `hil.testing.plugin`; the names here are those behind its fixtures.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hil.base.first_use import on_first_use

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

if not TYPE_CHECKING:
    __getattr__, __dir__ = on_first_use(__name__, {"hil.testing.faulty": __all__})
