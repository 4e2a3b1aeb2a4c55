"""Archives of an arm with a load and without."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from identification import FrictionLaw
from tests.hil.simulated_logs import Simulated, archive_of

MASS = 4.0
CENTRE = np.array([0.0, 0.09, 0.12])
LAW = FrictionLaw(third=None, offset=True)
CONSTANTS = np.array([0.12, 0.12, 0.1, 0.08, 0.05, 0.04])  # N·m/A, motor side
RATIO = np.array([100.0, 100.0, -100.0, 60.0, 60.0, -60.0])


def archive_of_currents(folder: Path, name: str, simulated: Simulated) -> Path:
    """Positions in motor radians and currents in A, without torque constants."""
    columns = {
        "time": {"column": "t"},
        "position": {"columns": "q", "side": "motor"},
        "motor_current": {"columns": "i"},
        "drive": {"gear_ratio": tuple(RATIO)},
    }
    arrays = {
        "q": simulated.position * RATIO,
        "i": simulated.torque / (RATIO * CONSTANTS),
        "t": simulated.time,
    }
    return archive_of(folder / f"{name}.mcap", simulated.urdf, columns, LAW, **arrays)
