"""A held-out motion of an arm without torque over time, for pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.results.servo_result import ServoContact


@dataclass(frozen=True, eq=False)
class ServoSeries:
    """A motion of m instants and n joints [rad or m], simulated from its commands alone.

    Attributes:
        archive: its name.
        time: (m,) [s].
        measured, commanded, identified: (m, n).
        simulators: with the terms of an engine alone (m, n), by its name.
        compared: of the parameters to compare with, None without.
        contacts: joints that something held.
        stuck: joints (n,) that never moved in the fitted motions, though their command did.
    """

    archive: str
    time: Array
    measured: Array
    commanded: Array
    identified: Array
    simulators: Mapping[str, Array]
    compared: Array | None
    contacts: tuple[ServoContact, ...]
    stuck: NDArray[np.bool_]

    @property
    def free(self) -> NDArray[np.bool_]:
        """Whether nothing held a joint (m,)."""
        held = [(self.time >= c.start) & (self.time <= c.end) for c in self.contacts]
        return ~np.any(held, axis=0) if held else np.ones(len(self.time), np.bool_)
