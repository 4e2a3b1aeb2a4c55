"""Time series for the figures of the report."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields
from typing import Annotated, Final, get_type_hints

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TOO_LARGE: Final = 1e100


class SeriesError(ValueError):
    """A series has a wrong shape or values that cannot be drawn."""


# The field whose length each letter is; n is the number of joints.
_LENGTHS: Final = {
    "m": "excitation_time",
    "k": "example_time",
    "c": "friction_speed",
    "s": "law_speed",
    "r": "reversal_travel",
    "f": "spectrum_frequency",
}


def _empty() -> Array:
    return np.empty((0, 0))


@dataclass(frozen=True, eq=False)
class ReportSeries:
    """Motion of the excitation, one validation run, friction and residual.

    Shapes are in the annotations, with n joints. Units are s, rad, N·m; of prismatic joints m, N.
    Series with a default may be empty; their figures are then omitted.

    Raises:
        SeriesError: shapes are inconsistent.
    """

    excitation_time: Annotated[Array, "m"]
    excitation_position: Annotated[Array, "mn"]
    excitation_velocity: Annotated[Array, "mn"]
    example_archive: str  #: name of the archive the example was read from
    example_time: Annotated[Array, "k"]  #: empty without a validation run
    #: low-passed for display
    example_measured: Annotated[Array, "kn"]
    example_predicted: Annotated[Array, "kn"]
    #: 1 for fitted rows, else 0
    excitation_fitted: Annotated[Array, "mn"] = field(default_factory=_empty)
    #: 1 for rows used for the error of the verdict, else 0
    example_used: Annotated[Array, "kn"] = field(default_factory=_empty)
    #: contributions to the predicted torque
    example_inertia: Annotated[Array, "kn"] = field(default_factory=_empty)
    example_coriolis: Annotated[Array, "kn"] = field(default_factory=_empty)
    example_gravity: Annotated[Array, "kn"] = field(default_factory=_empty)
    example_friction: Annotated[Array, "kn"] = field(default_factory=_empty)
    #: measured torque of fitted rows minus prediction without friction; padded with NaN
    friction_speed: Annotated[Array, "cn"] = field(default_factory=_empty)
    friction_torque: Annotated[Array, "cn"] = field(default_factory=_empty)
    #: friction law without presliding
    law_speed: Annotated[Array, "sn"] = field(default_factory=_empty)
    law_torque: Annotated[Array, "sn"] = field(default_factory=_empty)
    #: displacement and friction torque after a reversal at low speed; NaN without presliding
    reversal_travel: Annotated[Array, "rn"] = field(default_factory=_empty)
    reversal_torque: Annotated[Array, "rn"] = field(default_factory=_empty)
    spectrum_frequency: Annotated[Array, "f"] = field(default_factory=_empty)  #: [Hz]
    #: of the example, all rows [N·m/√Hz]
    spectrum_torque: Annotated[Array, "fn"] = field(default_factory=_empty)
    spectrum_residual: Annotated[Array, "fn"] = field(default_factory=_empty)
    #: of the smoothed positions of the example [Hz]; NaN where unknown
    motion_bandwidth: Annotated[Array, "n"] = field(default_factory=_empty)

    def __post_init__(self) -> None:
        position = self.excitation_position
        sizes = {"n": position.shape[1] if position.ndim == 2 else 0}
        for letter, name in _LENGTHS.items():
            values = getattr(self, name)
            sizes[letter] = values.shape[0] if values.ndim else 0
        hints = get_type_hints(type(self), include_extras=True)
        for one in fields(self):
            found, letters = getattr(self, one.name), getattr(hints[one.name], "__metadata__", None)
            optional = one.default_factory is not MISSING
            if letters is None or (optional and found.size == 0):
                continue
            shape = tuple(sizes[letter] for letter in letters[0])
            numbers = found.dtype == np.float64
            if found.shape != shape or not numbers or np.any(np.abs(found) >= _TOO_LARGE):
                raise SeriesError(
                    f"{one.name} has shape {found.shape} (expected {shape}), or values that "
                    "cannot be drawn"
                )

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return int(self.excitation_position.shape[1])

    def checked_for(self, n_joints: int) -> ReportSeries:
        """Return the series, or raise SeriesError unless they have `n_joints`."""
        if self.n_joints != n_joints:
            raise SeriesError(f"excitation_position has {self.n_joints} columns, not {n_joints}")
        return self
