"""The time series behind the figures; everything else is in the results."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TOO_LARGE: Final = 1e100


class SeriesError(ValueError):
    """A series does not fit the others: carries the field, its shape and the one expected."""

    def __init__(self, field: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
        super().__init__(
            f"{field} has shape {shape}, or is of no numbers that can be drawn; "
            f"{expected} was expected"
        )
        self.field, self.shape, self.expected = field, shape, expected


_SHAPES: Final = {
    "excitation_time": "m",
    "excitation_position": "mn",
    "excitation_velocity": "mn",
    "example_time": "k",
    "example_measured": "kn",
    "example_predicted": "kn",
}
_OPTIONAL: Final = {
    "excitation_fitted": "mn",
    "example_used": "kn",
    "example_inertia": "kn",
    "example_coriolis": "kn",
    "example_gravity": "kn",
    "example_friction": "kn",
    "friction_speed": "cn",
    "friction_torque": "cn",
    "law_speed": "sn",
    "law_torque": "sn",
    "reversal_travel": "rn",
    "reversal_torque": "rn",
    "spectrum_frequency": "f",
    "spectrum_torque": "fn",
    "spectrum_residual": "fn",
    "motion_bandwidth": "n",
}
# The field whose length each letter is; n is the number of joints.
_LENGTHS: Final = {
    "m": "excitation_time",
    "k": "example_time",
    "c": "friction_speed",
    "s": "law_speed",
    "r": "reversal_travel",
    "f": "spectrum_frequency",
}


def _nothing() -> Array:
    return np.empty((0, 0))


@dataclass(frozen=True, eq=False)
class ReportSeries:
    """Motion of the excitation, one validation run in time, and what friction and residual are.

    Torques are in N·m, of joints that slide in N; likewise rad is m. The series after the
    predicted torque may be empty: figures that need them are then left out.

    Attributes:
        excitation_time: (m,) [s].
        excitation_position: (m, n) [rad].
        excitation_velocity: (m, n) [rad/s].
        example_archive: Name of the archive the example was read from.
        example_time: (k,) [s]; k = 0 where no validation run exists.
        example_measured: (k, n) [N·m], already low-passed for display.
        example_predicted: (k, n) [N·m], low-passed alike.
        excitation_fitted: (m, n), 1 where the row was fitted and 0 where not.
        example_used: (k, n), 1 where the row counts in the error of the verdict, else 0.
        example_inertia: (k, n) part of the predicted torque; the four parts add up to it.
        example_coriolis: (k, n), centrifugal torque included.
        example_gravity: (k, n).
        example_friction: (k, n), offsets included.
        friction_speed: (c, n) [rad/s] of fitted rows; NaN where there are fewer.
        friction_torque: (c, n) measured torque less what is predicted without friction.
        law_speed: (s, n) [rad/s] along the friction law.
        law_torque: (s, n) of a joint that slides.
        reversal_travel: (r, n) displacement since a reversal [rad]; NaN where friction jumps.
        reversal_torque: (r, n) of a joint that creeps forwards after it has gone backwards.
        spectrum_frequency: (f,) [Hz] of the example.
        spectrum_torque: (f, n) [N·m/√Hz], of the measured torque, every row.
        spectrum_residual: (f, n) of measured less predicted torque.
        motion_bandwidth: (n,) [Hz] of the smoothed positions of the example; NaN where unknown.

    Raises:
        SeriesError: the shapes do not belong together.
    """

    excitation_time: Array
    excitation_position: Array
    excitation_velocity: Array
    example_archive: str
    example_time: Array
    example_measured: Array
    example_predicted: Array
    excitation_fitted: Array = field(default_factory=_nothing)
    example_used: Array = field(default_factory=_nothing)
    example_inertia: Array = field(default_factory=_nothing)
    example_coriolis: Array = field(default_factory=_nothing)
    example_gravity: Array = field(default_factory=_nothing)
    example_friction: Array = field(default_factory=_nothing)
    friction_speed: Array = field(default_factory=_nothing)
    friction_torque: Array = field(default_factory=_nothing)
    law_speed: Array = field(default_factory=_nothing)
    law_torque: Array = field(default_factory=_nothing)
    reversal_travel: Array = field(default_factory=_nothing)
    reversal_torque: Array = field(default_factory=_nothing)
    spectrum_frequency: Array = field(default_factory=_nothing)
    spectrum_torque: Array = field(default_factory=_nothing)
    spectrum_residual: Array = field(default_factory=_nothing)
    motion_bandwidth: Array = field(default_factory=_nothing)

    def __post_init__(self) -> None:
        position = self.excitation_position
        sizes = {"n": position.shape[1] if position.ndim == 2 else 0}
        for letter, name in _LENGTHS.items():
            values = getattr(self, name)
            sizes[letter] = values.shape[0] if values.ndim else 0
        for name, letters in (_SHAPES | _OPTIONAL).items():
            found = getattr(self, name)
            if name in _OPTIONAL and found.size == 0:
                continue
            shape = tuple(sizes[letter] for letter in letters)
            if found.shape != shape or found.dtype != np.float64 or not _drawable(found):
                raise SeriesError(name, found.shape, shape)

    @property
    def n_joints(self) -> int:
        """Number of joints n."""
        return int(self.excitation_position.shape[1])

    def checked_for(self, n_joints: int) -> ReportSeries:
        """Itself, if it has `n_joints` columns.

        Raises:
            SeriesError: it has another number of joints.
        """
        if self.n_joints != n_joints:
            shape = self.excitation_position.shape
            raise SeriesError("excitation_position", shape, (shape[0], n_joints))
        return self


def _drawable(values: Array) -> bool:
    """Whether no number is so large that an axis cannot be divided."""
    return bool(np.all(np.isnan(values) | (np.abs(values) < _TOO_LARGE)))
