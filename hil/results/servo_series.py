"""A held-out motion of an arm without torque over time, for pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.results.series import SERIES, SeriesError, not_series, read_arrays
from hil.results.servo_result import ServoContact, ServoResults

_PLOTTED: Final = ("measured", "commanded", "identified", "compared")


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


def servo_series_bytes(series: Sequence[ServoSeries]) -> bytes:
    """Return what a report draws of motions, as the content of a `.npz` file."""
    content = BytesIO()
    arrays: dict[str, Any] = {}
    for k, each in enumerate(series):
        known = {name: getattr(each, name) for name in ("time", *_PLOTTED)}
        arrays |= {f"{name}_{k}": value for name, value in known.items() if value is not None}
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def load_servo_series(folder: Path, results: ServoResults) -> list[ServoSeries]:
    """Read the motions in a folder of results; what the engines simulated is left out.

    Raises:
        InputError: there are none, or of another number of joints.
    """
    path = folder / SERIES
    stuck = np.array([name in results.stuck for name in results.joint_names], np.bool_)
    series = []
    try:
        arrays = read_arrays(path)
        for k, prediction in enumerate(results.validation):
            time = np.asarray(arrays[f"time_{k}"], np.float64)
            plotted = {name: arrays.get(f"{name}_{k}") for name in _PLOTTED}
            shape = (len(time), len(stuck))
            if any(values is not None and values.shape != shape for values in plotted.values()):
                raise SeriesError(f"motion {k} is not of shape {shape}")
            series.append(
                ServoSeries(
                    prediction.archive,
                    time,
                    arrays[f"measured_{k}"],
                    arrays[f"commanded_{k}"],
                    arrays[f"identified_{k}"],
                    simulators={},
                    compared=plotted["compared"],
                    contacts=prediction.contacts,
                    stuck=stuck,
                )
            )
    except Exception as error:  # readers of a corrupt file may raise anything
        raise not_series(path, error) from error
    return series
