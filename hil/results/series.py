"""Time series and curves in the figures of a report."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.safe_input import open_file
from identification import RobotModel
from identification.signals.samples import Samples
from identification.signals.spectrum import power_density
from identification.validation.prediction import for_figure

SERIES: Final = "report_series.npz"
"""File of the series in a folder of results."""
_MAX_BYTES: Final = 1 << 30
"""Most bytes of the series in a file, a hundred times the size for a campaign of 30 repetitions."""
_MAX_MAGNITUDE: Final = 1e100
_MAX_ROWS: Final = 30_000
"""Most rows of the example that a file holds."""
_SHOWN_RATE: Final = 125.0
"""Rows per second of torques that are low-passed at 30 Hz for a figure, at least."""
_SPECTRUM_TIME: Final = 4.0  # of one periodogram, s
_SPECTRUM_BINS: Final = 160  # of a spectrum


class SeriesError(ValueError):
    """A series has a wrong shape or values that cannot be drawn."""


@dataclass(frozen=True, eq=False)
class ReportSeries:
    """Motion of the excitation, one validation run, and friction; n joints.

    Units are s, rad, N·m; of prismatic joints m, N. What may be None is unknown, for example in
    files of earlier versions.

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
    example_nominal: Array | None = None  #: of the nominal model, as the prediction (k, n)
    example_inertia: Array | None = None  #: part of the prediction that acceleration causes (k, n)
    example_coriolis: Array | None = None  #: Coriolis and centrifugal part (k, n)
    example_gravity: Array | None = None  #: (k, n)
    example_friction: Array | None = None  #: with offset (k, n)
    example_elements: Array | None = None  #: ripple, identified springs and balancers (k, n)
    spectrum_frequency: Array | None = None  #: (f,) [Hz]
    #: amplitude spectral density of the measured torque of the example (f, n) [N·m/√Hz]
    spectrum_measured: Array | None = None
    spectrum_residual: Array | None = None  #: of measured minus predicted torque (f, n)
    #: recorded time stamps of the excitation, where its samples were given other times (c,)
    clock_time: Array | None = None

    def __post_init__(self) -> None:
        n = self.excitation_position.shape[-1]
        lengths = {
            "excitation": len(self.excitation_time),
            "example": len(self.example_time),
            "friction": len(self.friction_torque),
            "law": len(self.law_torque),
            "clock": 0 if self.clock_time is None else len(self.clock_time),
            "spectrum": 0 if self.spectrum_frequency is None else len(self.spectrum_frequency),
        }
        for name, array in self.arrays.items():
            length = lengths[name.partition("_")[0]]
            alone = name.endswith(("_time", "_frequency"))
            shape = (length,) if alone else (length, n)
            numbers = array.dtype == np.float64 and not np.any(np.abs(array) >= _MAX_MAGNITUDE)
            if array.shape != shape or not numbers:
                raise SeriesError(
                    f"{name} has shape {array.shape} (expected {shape}), or values that cannot be"
                    " drawn"
                )

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> ReportSeries:
        """Build the series from the arrays of a file; KeyError if a needed one is missing."""
        names = [
            field.name
            for field in fields(cls)
            if field.name in arrays or field.name not in _OPTIONAL
        ]
        return cls(**{name: arrays[name] for name in names})

    @property
    def arrays(self) -> dict[str, Array]:
        """All arrays that are known, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}

    def to_bytes(self) -> bytes:
        """Return the content of a `.npz` file."""
        content = BytesIO()
        arrays: dict[str, Any] = {"example_archive": self.example_archive, **self.arrays}
        np.savez_compressed(content, **arrays)
        return content.getvalue()

    def checked_for(self, n_joints: int) -> ReportSeries:
        """Return the series, or raise SeriesError unless they have `n_joints`."""
        columns = self.excitation_position.shape[1]
        if columns != n_joints:
            raise SeriesError(f"excitation_position has {columns} columns, not {n_joints}")
        return self


_OPTIONAL: Final = tuple(field.name for field in fields(ReportSeries) if field.default is None)


def load_series(folder: Path, n_joints: int) -> ReportSeries:
    """Read the series in a folder of results.

    Raises:
        InputError: there are none, or of another number of joints.
    """
    path = folder / SERIES
    try:
        arrays = read_arrays(path)
        arrays["example_archive"] = str(arrays["example_archive"])
        return ReportSeries.from_arrays(arrays).checked_for(n_joints)
    except Exception as error:  # readers of a corrupt file may raise anything
        raise not_series(path, error) from error


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of a `.npz` file by name; a corrupt one raises anything.

    Raises:
        ValueError: it is too large.
    """
    with open_file(path) as stream:
        with zipfile.ZipFile(stream) as members:
            size = sum(member.file_size for member in members.infolist())
        if size > _MAX_BYTES:
            raise ValueError(f"it would take {size} bytes")
        stream.seek(0)
        with np.load(stream, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}


def not_series(path: Path, error: Exception) -> InputError:
    """Return the error of a file that has no series of a report."""
    problem = f"does not contain the series of a report ({error})"
    remedy = "identify again from the archives (`hil identify`)"
    return InputError(path, problem, remedy=remedy)


def example_series(
    model: RobotModel, values: Array, nominal: Array | None, samples: Samples, shown: slice
) -> dict[str, Array]:
    """Return the example's torque, as measured, predicted, nominal and by part, and its spectra.

    By the names of :class:`ReportSeries`.

    Args:
        model: of the arm.
        values: identified parameters (p,).
        nominal: parameters of the nominal model (p,).
        samples: of a held-out recording.
        shown: rows of it that are in the figures.
    """
    step = _step(samples)
    few = samples if step == 1 else samples.thinned(step)
    predicted = samples.predicted_torque(model, values)
    torques = {
        "example_measured": _means(samples.torque, step),
        "example_predicted": _means(predicted, step),
    }
    parts = torque_parts(model, values, few)
    # Means of dry friction, which has steps.
    others = sum(part for name, part in parts.items() if name != "friction")
    parts["friction"] = torques["example_predicted"] - others
    torques |= {f"example_{name}": part for name, part in parts.items()}
    if nominal is not None:
        torques["example_nominal"] = _means(samples.predicted_torque(model, nominal), step)
    time = few.motion.time
    rows = _rows_within(time, samples.motion.time[shown])
    low_passed = {name: for_figure(time, torque)[rows] for name, torque in torques.items()}
    return {
        "example_time": time[rows] - samples.origin,
        "example_used": few.usable[rows].astype(np.float64),
        **low_passed,
        **_spectra(samples, samples.torque - predicted),
    }


def _step(samples: Samples) -> int:
    """Return how many rows one row of a figure represents, an odd number.

    One of a torque with a low-pass, which applies to rows side by side.
    """
    time = samples.motion.time
    m = len(samples.torque)
    if m < 2 or samples.torque_bandwidth is not None:
        return 1
    step = max(1, int((m - 1) / max(float(time[-1] - time[0]), 1e-9) / (2.0 * _SHOWN_RATE)))
    return step - 1 + step % 2


def _means(torque: Array, step: int) -> Array:
    """Return means of torques (m, n) over `step` rows about the rows of :meth:`Samples.thinned`."""
    if step == 1:
        return torque
    starts = np.arange(0, len(torque), step)
    sums = np.add.reduceat(torque, starts, axis=0)
    means = sums / np.diff(np.append(starts, len(torque)))[:, None]
    return np.asarray(means[: len(torque[step // 2 :: step])])


def torque_parts(model: RobotModel, values: Array, samples: Samples) -> dict[str, Array]:
    """Return the predicted torque by its causes, (m, n) each; their sum is the prediction."""
    friction = np.zeros(model.n_parameters, np.bool_)
    friction[model.friction_part] = True
    elements = np.zeros_like(friction)
    elements[model.element_part] = True
    bodies = ~(friction | elements)
    whole = samples.predicted_torque(model, values, bodies)
    at_rest = _with_motion(samples, velocity=False, acceleration=False)
    without_velocity = _with_motion(samples, velocity=False, acceleration=True)
    gravity = at_rest.predicted_torque(model, values, bodies)
    inertia = without_velocity.predicted_torque(model, values, bodies) - gravity
    parts = {
        "inertia": inertia,
        "coriolis": whole - inertia - gravity,
        "gravity": gravity,
        "friction": samples.predicted_torque(model, values, friction),
    }
    if elements.any():
        parts["elements"] = samples.predicted_torque(model, values, elements)
    return parts


def _with_motion(samples: Samples, *, velocity: bool, acceleration: bool) -> Samples:
    """Return samples at the same positions, with velocity or acceleration or zero."""
    motion = samples.motion
    moving = replace(
        motion,
        velocity=motion.velocity if velocity else np.zeros_like(motion.velocity),
        acceleration=motion.acceleration if acceleration else np.zeros_like(motion.acceleration),
    )
    if samples.parent is None:
        return replace(samples, motion=moving)
    parent, part = samples.parent
    parent = _with_motion(parent, velocity=velocity, acceleration=acceleration)
    return replace(samples, motion=moving, parent=(parent, part))


def _rows_within(time: Array, shown: Array) -> slice:
    """Return rows of the shown times (m,), some `_SHOWN_RATE` a second, at most `_MAX_ROWS`."""
    if not shown.size:
        return slice(0, 0)
    start = int(np.searchsorted(time, shown[0] - 1e-9))
    stop = int(np.searchsorted(time, shown[-1] + 1e-9, side="right"))
    rows = stop - start
    duration = max(float(shown[-1] - shown[0]), 1e-9)
    return slice(start, stop, max(int(rows / duration / _SHOWN_RATE), -(-rows // _MAX_ROWS), 1))


def _spectra(samples: Samples, error: Array) -> dict[str, Array]:
    """Return the spectra of the longest stretch without a gap; none of less than 16 rows."""
    part = max(
        samples.segments, key=lambda segment: segment.stop - segment.start, default=slice(0, 0)
    )
    rows = part.stop - part.start
    if rows < 16:
        return {}
    rate = 1.0 / float(np.median(np.diff(samples.motion.time[part])))
    both = np.hstack([samples.torque[part], error[part]])
    frequency, power = power_density(both, rate, min(rows, max(16, round(_SPECTRUM_TIME * rate))))
    frequency, density = _by_ratio(frequency, power)
    measured, residual = np.split(np.sqrt(density), 2, axis=1)
    return {
        "spectrum_frequency": frequency,
        "spectrum_measured": measured,
        "spectrum_residual": residual,
    }


def _by_ratio(frequency: Array, power: Array) -> tuple[Array, Array]:
    """Return the mean power (f, c) in bins of equal ratio of frequency (f,), empty ones omitted."""
    edges = np.geomspace(frequency[0], frequency[-1] * (1.0 + 1e-9), _SPECTRUM_BINS + 1)
    bins = np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, _SPECTRUM_BINS - 1)
    starts = np.flatnonzero(np.diff(bins, prepend=-1))
    counts = np.diff(np.append(starts, len(frequency)))
    mean_frequency = np.add.reduceat(frequency, starts) / counts
    return mean_frequency, np.add.reduceat(power, starts, axis=0) / counts[:, None]
