"""A held-out motion of an arm without torque over time, for pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hil.base.arrays import Array


@dataclass(frozen=True, eq=False)
class ServoSeries:
    """A motion of m instants and n joints [rad or m], simulated from its commands alone.

    Attributes:
        archive: its name.
        time: (m,) [s].
        measured, commanded, identified: (m, n).
        simulators: with the terms of an engine alone (m, n), by its name.
        compared: of the parameters to compare with, None without.
    """

    archive: str
    time: Array
    measured: Array
    commanded: Array
    identified: Array
    simulators: Mapping[str, Array]
    compared: Array | None
