"""Time series for the figures of the report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TOO_LARGE: Final = 1e100


class SeriesError(ValueError):
    """A series has a wrong shape or values that cannot be drawn."""


@dataclass(frozen=True, eq=False)
class ReportSeries:
    """Motion of the excitation, one validation run, and friction; n joints.

    Units are s, rad, N·m; of prismatic joints m, N.

    Raises:
        SeriesError: shapes are inconsistent.
    """

    excitation_time: Array  #: (m,)
    excitation_position: Array  #: (m, n)
    excitation_velocity: Array  #: (m, n)
    excitation_fitted: Array  #: 1 for fitted rows, else 0 (m, n)
    example_archive: str  #: name of the archive the example was read from
    example_time: Array  #: (k,)
    example_measured: Array  #: low-passed for display (k, n)
    example_predicted: Array  #: low-passed for display (k, n)
    example_used: Array  #: 1 for rows used for the error of the verdict, else 0 (k, n)
    #: measured torque of fitted rows minus prediction without friction (c, n), padded with NaN
    friction_torque: Array
    friction_speed: Array  #: speeds of these (c, n)
    law_torque: Array  #: friction law without presliding (s, n)
    law_speed: Array  #: speeds of these (s, n)

    def __post_init__(self) -> None:
        n = self.excitation_position.shape[-1]
        lengths = {
            "excitation": len(self.excitation_time),
            "example": len(self.example_time),
            "friction": len(self.friction_torque),
            "law": len(self.law_torque),
        }
        for name, found in vars(self).items():
            if isinstance(found, str):
                continue
            length = lengths[name.partition("_")[0]]
            shape = (length,) if name.endswith("_time") else (length, n)
            numbers = found.dtype == np.float64 and not np.any(np.abs(found) >= _TOO_LARGE)
            if found.shape != shape or not numbers:
                raise SeriesError(
                    f"{name} has shape {found.shape} (expected {shape}), or values that cannot be"
                    " drawn"
                )

    def checked_for(self, n_joints: int) -> ReportSeries:
        """Return the series, or raise SeriesError unless they have `n_joints`."""
        found = self.excitation_position.shape[1]
        if found != n_joints:
            raise SeriesError(f"excitation_position has {found} columns, not {n_joints}")
        return self
