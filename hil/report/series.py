"""The time series behind the figures; everything else is in the results."""

from __future__ import annotations

from dataclasses import dataclass
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


@dataclass(frozen=True, eq=False)
class ReportSeries:
    """Motion of the excitation, and one validation run in time.

    Attributes:
        excitation_time: (m,) [s].
        excitation_position: (m, n) [rad].
        excitation_velocity: (m, n) [rad/s].
        example_archive: Name of the archive the example was read from.
        example_time: (k,) [s]; k = 0 where no validation run exists.
        example_measured: (k, n) [N·m], already low-passed for display.
        example_predicted: (k, n) [N·m], low-passed alike.

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

    def __post_init__(self) -> None:
        position = self.excitation_position
        n = position.shape[1] if position.ndim == 2 else 0
        m, k = self.excitation_time.size, self.example_time.size
        expected = {
            "excitation_time": (m,),
            "excitation_position": (m, n),
            "excitation_velocity": (m, n),
            "example_time": (k,),
            "example_measured": (k, n),
            "example_predicted": (k, n),
        }
        for field, shape in expected.items():
            found = getattr(self, field)
            if found.shape != shape or found.dtype != np.float64 or not _drawable(found):
                raise SeriesError(field, found.shape, shape)

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
