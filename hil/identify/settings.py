"""Settings of an identification, and sources made samples under them.

What is decided (:mod:`hil.identify.deciding`) stands apart from what applies it: the same settings
make the same samples of an archive wherever it is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from identification.estimators.consistent import Shrinkage
from identification.estimators.delay import compensate
from identification.model.robot import RobotModel
from identification.selection.inner_prediction import Choice
from identification.signals.samples import RIGID_BANDWIDTH, Preprocessing, Samples, prepare

from .options import Options
from .sources import Source

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """How archives of one arm become samples, and samples an estimate: figures and words only.

    Attributes:
        preprocessing: of recordings, with the delay of the torque.
        friction: entries of `[robot.friction]` that differ from the cell's.
        noise_variance: of the positions (n,) [rad² or m²]; None takes each recording's own.
        torque_variance: of the torques (n,) [N²·m² or N²]; likewise.
        stated_delay: of the torque, before any was looked for [s].
        axis_delays: by which torques are read earlier, axis by axis (n,) [s]; None for none.
        delay_variance: of a delay that was found [s²]; zero where it is known.
        shrinkage: of the automatic estimator.
        choices: what was chosen by inner prediction.
    """

    preprocessing: Preprocessing
    friction: Mapping[str, Any] = field(default_factory=dict)
    noise_variance: tuple[float, ...] | None = None
    torque_variance: tuple[float, ...] | None = None
    stated_delay: float = 0.0
    axis_delays: tuple[float, ...] | None = None
    delay_variance: float = 0.0
    shrinkage: Shrinkage = Shrinkage()  # noqa: RUF009 - frozen
    choices: tuple[Choice, ...] = ()

    def preprocessed(self, **changes: Any) -> Settings:
        """These settings with others of the preprocessing."""
        return replace(self, preprocessing=replace(self.preprocessing, **changes))

    def law(self, cell: Cell) -> Cell:
        """The cell with the friction law of these settings."""
        return cell.with_friction(**self.friction) if self.friction else cell

    def delays(self, n_joints: int) -> Array:
        """Delay of the torque of each axis (n,) [s]."""
        if self.axis_delays is not None:
            return np.array(self.axis_delays)
        return np.full(n_joints, self.preprocessing.torque_delay)


def stated_delay(cell: Cell) -> float:
    """Time by which the torque lags the position, as `[controller]` states it [s]."""
    controller = cell.file.controller
    return controller.current_delay_cycles * cell.period if controller else 0.0


def stated_settings(cell: Cell, options: Options) -> Settings:
    """What is known or asked for before anything is looked for or chosen."""
    delay, bandwidth = options.delay, options.torque_bandwidth
    delay = delay if isinstance(delay, float) else stated_delay(cell)
    return Settings(
        Preprocessing(
            rigid_bandwidth=RIGID_BANDWIDTH if options.bandwidth == "auto" else options.bandwidth,
            velocity="position" if options.velocity == "auto" else options.velocity,
            left_out=None if options.standstill == "auto" else options.standstill,
            smooth_torque=options.method == "paper",
            torque_delay=delay,
            torque_bandwidth=bandwidth if isinstance(bandwidth, float) else None,
        ),
        friction={} if options.friction == "auto" else dict(options.friction),
        stated_delay=delay,
    )


def signals_of(source: Source, settings: Settings) -> Source:
    """The source with each axis's torque at the time of its position, where axes differ in that."""
    if settings.axis_delays is None:
        return source
    return replace(
        source, recording=compensate(source.recording, settings.axis_delays), context=None
    )


def samples_of(
    source: Source, cell: Cell, settings: Settings, model: RobotModel | None = None
) -> Samples:
    """Samples of a source, as a fit reads them, once it went through :func:`signals_of`.

    The cell has the law of the settings; the model is by default its own.

    Raises:
        RecordingError: the recording cannot be prepared.
    """
    recording, start = source.context or (source.recording, 0)
    whole = prepare(
        recording,
        model or cell.model,
        noise_variance=_array(settings.noise_variance),
        torque_variance=_array(settings.torque_variance),
        options=settings.preprocessing,
        origin=source.origin,
        current_limit=_current_limit(cell),
    )
    if source.context is None:
        return whole
    return whole.between(start, start + source.recording.n_samples)


def judged_samples(source: Source, cell: Cell, settings: Settings) -> Samples:
    """Samples of a source, as a verdict reads them: moving, and of the torque as recorded.

    A verdict on smoothed torque would flatter.

    Raises:
        RecordingError: the recording cannot be prepared.
    """
    return samples_of(source, cell, settings.preprocessed(smooth_torque=False)).moving()


def _array(figures: tuple[float, ...] | None) -> Array | None:
    return None if figures is None else np.array(figures)


def _current_limit(cell: Cell) -> Array | None:
    """Largest current of each motor (n,) [A]; None where no drive train is known."""
    return None if cell.file.drive_train is None else np.array(cell.drive_table.current_limit)
