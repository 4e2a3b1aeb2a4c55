"""From sources to samples: time base, delay, smoothing, and which rows count."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.progress import Reporter
from identification.delay import DelayEstimate, estimate_delays
from identification.delay_compensation import compensate
from identification.errors import IdentificationError
from identification.preprocessing import Preprocessing, Samples, prepare
from identification.repetition_noise import repetition_noise
from identification.signals.clock import time_base
from identification.torque_channel import find_torque_bandwidth

from .currents import with_torques
from .options import Options
from .sources import Source, Sources

Array = NDArray[np.float64]

# Where nobody asked for a delay, searching one may cost about a second: in so many samples.
_DELAY_SAMPLES = 8000


@dataclass(frozen=True, eq=False)
class Prepared:
    """Sources as samples, and what was done to them.

    Attributes:
        sources: with the doubts that preparing raised.
        fitted: what the fit reads.
        training: the same recordings as a verdict reads them: torques never smoothed.
        held_out: what is predicted, likewise; `training` where nothing was held out.
        preprocessing: of `fitted`.
        delays: of the torque behind the position, as the longest of the fitted recordings has
            them; None where that cannot be told.
        assumed_delay: what the fit took the delay of each axis to be (n,) [s].
        masked: rows of `fitted` that do not count, per joint (n,), by the first reason against
            them, in words.
        rows: time samples of `fitted`.
        notes: what was found and done, in sentences.
    """

    sources: Sources
    fitted: tuple[Samples, ...]
    training: tuple[Samples, ...]
    held_out: tuple[Samples, ...]
    preprocessing: Preprocessing
    delays: DelayEstimate | None
    assumed_delay: Array
    masked: Mapping[str, NDArray[np.intp]]
    rows: int
    notes: tuple[str, ...]

    @property
    def commanded(self) -> tuple[Array | None, ...]:
        """Commanded positions (m, n) in the rows of each of `fitted`, NaN where there are none."""
        return tuple(source.recording.commanded_position for source in self.sources.training)


def prepare_sources(
    sources: Sources, options: Options, reporter: Reporter, *, look_for_delay: bool = True
) -> Prepared:
    """Smooth every recording, after its time base, noise, low-pass and delay are settled.

    Only what is fitted is looked at to settle them.

    Args:
        sources: the recordings.
        options: how they are turned into samples.
        reporter: of progress.
        look_for_delay: whether a delay that nobody asked for is looked for all the same, to be
            reported; it takes longer than everything else.

    Raises:
        ArchiveError: there are currents only, and nothing that could make torques of them.
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was asked for and there is not one usable row.
    """
    notes = _time_bases(sources)
    sources, noise_note = _with_noise(sources)
    sources = with_torques(sources)
    sources, preprocessing = _with_bandwidth(sources, _settings(sources, options), options)
    delays = None
    if look_for_delay or options.delay == "auto":
        delays = _delays(sources, preprocessing, options, reporter)
    delay_notes: list[str] = []
    assumed = np.full(sources.cell.model.n_joints, preprocessing.torque_delay)
    if delays is not None and options.delay == "auto":
        sources, preprocessing, assumed, delay_notes = _compensated(sources, preprocessing, delays)
    # A verdict on smoothed torque would flatter: what is judged is the torque as recorded.
    judged = replace(preprocessing, smooth_torque=False)
    with reporter.task(
        "smoothing recordings",
        len(sources.training) + (0 if sources.in_sample else len(sources.held_out)),
    ) as task:

        def ready(some: Sequence[Source], how: Preprocessing) -> tuple[Samples, ...]:
            done = []
            for source in some:
                done.append(samples_of(source, sources, how))
                task.advance(1, source.name)
            return tuple(done)

        fitted = ready(sources.training, preprocessing)
        held_out = () if sources.in_sample else ready(sources.held_out, judged)
    training = fitted
    if judged != preprocessing:
        training = tuple(samples_of(source, sources, judged) for source in sources.training)
    if sources.in_sample:
        held_out = training
    masked, rows = _masked(fitted), sum(len(one.torque) for one in fitted)
    return Prepared(
        sources=sources,
        fitted=fitted,
        training=training,
        held_out=held_out,
        preprocessing=preprocessing,
        delays=delays,
        assumed_delay=assumed,
        masked=masked,
        rows=rows,
        notes=(*notes, *noise_note, *delay_notes, *_left_out(sources, masked, rows)),
    )


def samples_of(source: Source, sources: Sources, how: Preprocessing) -> Samples:
    """Samples of one of the sources, with the noise, the rows and the limits of all of them.

    Raises:
        RecordingError: the recording cannot be prepared.
    """
    cell = sources.cell
    return prepare(
        source.recording,
        cell.model,
        noise_variance=sources.noise_variance,
        torque_variance=sources.torque_variance,
        options=how,
        origin=source.origin,
        current_limit=current_limit(cell),
    )


def current_limit(cell: Cell) -> Array | None:
    """Largest current of each motor (n,) [A]; None where no drive train is known."""
    return None if cell.file.drive_train is None else np.array(cell.drive_table.current_limit)


def _time_bases(sources: Sources) -> list[str]:
    """A sentence for each recording whose clock is not as even as a filter would like it."""
    notes = []
    for source in (*sources.training, *sources.held_out):
        if source.merged:
            notes.append(
                f"{source.name}: {source.merged} samples had the time stamp of the one before and "
                "were averaged with it"
            )
        base = time_base(source.recording.time, source.recording.gap_before)
        if not base.uniform or base.gaps:
            notes.append(f"{source.name}: {'; '.join(base.describe())}")
    return notes


def _with_noise(sources: Sources) -> tuple[Sources, list[str]]:
    """Noise of the positions from repetitions, where no standstill was recorded."""
    recordings = [source.recording for source in sources.training]
    if sources.noise_variance is not None:
        return sources, ["the noise of the positions was measured at standstill"]
    if not sources.same_motion or len(recordings) < 2:
        return sources, ["the noise of the positions was taken from their own fast part"]
    try:
        noise = repetition_noise(recordings)
    except IdentificationError:
        return sources, ["the noise of the positions was taken from their own fast part"]
    return (
        replace(
            sources,
            noise_variance=noise.position.white,
            torque_variance=None if noise.torque is None else noise.torque.white,
        ),
        [
            "no standstill was recorded: the noise of the positions was measured on what differs "
            f"between {noise.repetitions} repetitions at equal times"
        ],
    )


def _settings(sources: Sources, options: Options) -> Preprocessing:
    cell, delay = sources.cell, options.delay
    if not isinstance(delay, float):
        controller = cell.file.controller
        delay = controller.current_delay_cycles * cell.period if controller else 0.0
    bandwidth = options.torque_bandwidth
    return Preprocessing(
        smoother=options.smoother,
        smooth_torque=options.method == "paper",
        torque_delay=delay,
        torque_bandwidth=bandwidth if isinstance(bandwidth, float) else None,
    )


def _with_bandwidth(
    sources: Sources, plain: Preprocessing, options: Options
) -> tuple[Sources, Preprocessing]:
    """Look for a low-pass in imported torques; a controller's own currents come through none."""
    recording = sources.training[0].recording
    if options.torque_bandwidth != "auto" or plain.smooth_torque:
        return sources, plain
    if recording.motor_current is not None:
        return sources, plain
    found = find_torque_bandwidth(
        recording, sources.cell.model, noise_variance=sources.noise_variance, options=plain
    )
    if found is None:
        return sources, plain
    doubt = (
        f"the recorded torque seems to have come through a low-pass of {found:.3g} Hz before it "
        "was recorded (found on what was fitted); the model is filtered alike"
    )
    return sources.with_doubt(doubt), replace(plain, torque_bandwidth=found)


def _delays(
    sources: Sources, plain: Preprocessing, options: Options, reporter: Reporter
) -> DelayEstimate | None:
    """Delays in the longest of the fitted recordings, or in its beginning if nobody asked.

    Raises:
        IdentificationError: they were asked for, and there is not one usable row.
    """
    recording = max((source.recording for source in sources.training), key=lambda r: r.n_samples)
    wanted = options.delay == "auto"
    if not wanted:
        recording = recording.between(0, min(recording.n_samples, _DELAY_SAMPLES))
    with reporter.task("looking for a delay", 1) as task:
        try:
            found = estimate_delays(
                recording,
                sources.cell.model,
                noise_variance=sources.noise_variance,
                options=replace(plain, smooth_torque=False),
            )
        except IdentificationError:
            if wanted:
                raise
            return None
        task.advance(1)
    return found


def _compensated(
    sources: Sources, plain: Preprocessing, found: DelayEstimate
) -> tuple[Sources, Preprocessing, Array, list[str]]:
    """Sources without the delays that were found, the delay of each axis (n,), and words."""
    notes = [f"delay of the torque behind the position, {line}" for line in found.describe()]
    n = len(found.joint_names)
    if found.determined.any() and found.agree:
        notes.append(f"the torque of every axis was read {found.common * 1e3:.3g} ms later")
        common = replace(plain, torque_delay=found.common)
        return sources, common, np.full(n, found.common), notes
    none = replace(plain, torque_delay=0.0)
    if not found.determined.any():
        notes.append("no axis determines a delay: none was compensated")
        return sources, none, np.zeros(n), notes
    notes.append("each axis was compensated by its own delay, axes without one not at all")

    def shifted(some: tuple[Source, ...]) -> tuple[Source, ...]:
        return tuple(
            replace(source, recording=compensate(source.recording, found.applied))
            for source in some
        )

    moved = replace(sources, training=shifted(sources.training), held_out=shifted(sources.held_out))
    return moved, none, found.applied, notes


def _masked(fitted: Sequence[Samples]) -> dict[str, NDArray[np.intp]]:
    total: dict[str, NDArray[np.intp]] = {}
    for samples in fitted:
        if samples.mask is not None:
            for reason, rows in samples.mask.counts.items():
                total[reason] = total.get(reason, 0) + rows
    return total


def _left_out(sources: Sources, masked: Mapping[str, NDArray[np.intp]], rows: int) -> list[str]:
    """What was left out in all, and why."""
    everything = rows * len(sources.cell.joint_names)
    left_out = {reason: int(counts.sum()) for reason, counts in masked.items() if counts.any()}
    if not left_out:
        return []
    parts = ", ".join(f"{count / everything:.2%} {reason}" for reason, count in left_out.items())
    return [
        f"of {everything} rows (one joint at one instant) "
        f"{1.0 - sum(left_out.values()) / everything:.1%} were fitted; left out: {parts}"
    ]
