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
from identification.inner_prediction import Choice, Question, Settings, choose_settings
from identification.model import RobotModel
from identification.preprocessing import RIGID_BANDWIDTH, Preprocessing, Samples, prepare
from identification.repetition_noise import repetition_noise
from identification.shrinkage import Shrinkage
from identification.signals.clock import time_base
from identification.thresholds import Thresholds
from identification.torque_channel import possible_low_passes

from .currents import with_torques
from .options import Options
from .sources import Source, Sources

Array = NDArray[np.float64]

# Repetitions of one motion that settings are chosen on: more say the same again.
_REPETITIONS = 1
# Where the delay is stated it is looked for all the same, to be reported: in so many samples.
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
        delay_variance: of the delay that was applied [s²]; zero where it is known.
        shrinkage: of the automatic estimator.
        choices: what was chosen by inner prediction.
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
    delay_variance: float = 0.0
    shrinkage: Shrinkage = Shrinkage()  # noqa: RUF009 - frozen
    choices: tuple[Choice, ...] = ()

    @property
    def commanded(self) -> tuple[Array | None, ...]:
        """Commanded positions (m, n) in the rows of each of `fitted`, NaN where there are none."""
        return tuple(source.recording.commanded_position for source in self.sources.training)


def prepare_sources(
    sources: Sources, options: Options, reporter: Reporter, *, look_for_delay: bool = True
) -> Prepared:
    """Smooth every recording, after its time base, noise, delay and settings are decided.

    Only what is fitted is looked at to decide them.

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
    sources, stated = _stated(sources, options)
    preprocessing, delays = stated, None
    if look_for_delay or options.delay == "auto":
        delays = _delays(sources, preprocessing, options, reporter)
    delay_notes: list[str] = []
    assumed = np.full(sources.cell.model.n_joints, preprocessing.torque_delay)
    by_axis = options.delay == "auto"
    if delays is not None and (by_axis or (options.delay is None and _other(sources, delays))):
        sources, preprocessing, assumed, delay_notes = _compensated(
            sources, preprocessing, delays, by_axis=by_axis
        )
    undelayed = (preprocessing if by_axis else stated).torque_delay
    sources, chosen, choices = _chosen(sources, preprocessing, undelayed, options, reporter)
    how = chosen.preprocessing
    lags = how.torque_bandwidth is not None and how.torque_shape.causal
    if delays is not None and (lags or how.torque_delay != preprocessing.torque_delay):
        # It was found without the low-pass, and may be nothing but the lag of that.
        delays, assumed = None, np.full(sources.cell.model.n_joints, undelayed)
        delay_notes = [
            f"no other delay than the assumed {undelayed * 1e3:.3g} ms was applied beside the"
            " low-pass of the torque"
        ]
    preprocessing = how
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
    training, held_out = (tuple(one.moving() for one in some) for some in (training, held_out))
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
        delay_variance=delays.variance if delays is not None and delay_notes else 0.0,
        shrinkage=chosen.shrinkage,
        choices=choices,
    )


def samples_of(
    source: Source, sources: Sources, how: Preprocessing, model: RobotModel | None = None
) -> Samples:
    """Samples of one of the sources, with the noise, the rows and the limits of all of them.

    Args:
        source: one of them.
        sources: all.
        how: to prepare it.
        model: the robot, by default the cell's.

    Raises:
        RecordingError: the recording cannot be prepared.
    """
    cell = sources.cell
    recording, start = source.context or (source.recording, 0)
    whole = prepare(
        recording,
        model or cell.model,
        noise_variance=sources.noise_variance,
        torque_variance=sources.torque_variance,
        options=how,
        origin=source.origin,
        current_limit=current_limit(cell),
    )
    if source.context is None:
        return whole
    return whole.between(start, start + source.recording.n_samples)


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
        notes += [f"{source.name}: {line}" for line in source.clock]
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


def _stated(sources: Sources, options: Options) -> tuple[Sources, Preprocessing]:
    """What is known or asked for before anything is chosen."""
    cell, delay = sources.cell, options.delay
    if not isinstance(delay, float):
        controller = cell.file.controller
        delay = controller.current_delay_cycles * cell.period if controller else 0.0
    if options.friction != "auto":
        cell = cell.with_friction(**options.friction)
    bandwidth = options.torque_bandwidth
    return replace(sources, cell=cell), Preprocessing(
        smoother=options.smoother,
        rigid_bandwidth=RIGID_BANDWIDTH if options.bandwidth == "auto" else options.bandwidth,
        velocity="position" if options.velocity == "auto" else options.velocity,
        left_out=None if options.standstill == "auto" else options.standstill,
        smooth_torque=options.method == "paper",
        torque_delay=delay,
        torque_bandwidth=bandwidth if isinstance(bandwidth, float) else None,
    )


def _questions(sources: Sources, options: Options) -> set[Question]:
    """What inner prediction has to decide."""
    recorded = [source.recording for source in sources.training]
    asked: dict[Question, bool] = {
        "bandwidth": options.bandwidth == "auto",
        "velocity": options.velocity == "auto"
        and options.smoother == "spline"
        and all(one.velocity is not None for one in recorded),
        "presliding": options.friction == "auto",
        "rows": options.standstill == "auto",
        # A cell file with a drive train says which terms are wanted.
        "friction": options.friction == "auto" and sources.cell.file.drive_train is None,
        # A controller's own currents come through no low-pass.
        "low-pass": options.torque_bandwidth == "auto"
        and options.method == "default"
        and recorded[0].motor_current is None,
        "estimator": options.estimator == "auto",
    }
    return {question for question, wanted in asked.items() if wanted}


def _chosen(
    sources: Sources,
    preprocessing: Preprocessing,
    undelayed: float,
    options: Options,
    reporter: Reporter,
) -> tuple[Sources, Settings, tuple[Choice, ...]]:
    """Choose what is automatic, on the fitted part alone.

    Args:
        sources: the recordings.
        preprocessing: what is known, and the delay that was found.
        undelayed: delay of the torque beside a causal low-pass [s].
        options: what is automatic.
        reporter: of progress.
    """
    start = Settings(sources.cell.model, preprocessing)
    questions = _questions(sources, options)
    if not questions:
        return sources, start, ()
    read = _read_to_choose(sources)

    def ready(model: RobotModel, how: Preprocessing) -> list[Samples]:
        return [samples_of(source, sources, how, model) for source in read]

    def low_passes(model: RobotModel, how: Preprocessing) -> tuple[Preprocessing, ...]:
        return possible_low_passes(
            read[0].recording,
            model,
            noise_variance=sources.noise_variance,
            options=how,
            undelayed=undelayed,
        )

    with reporter.task("choosing settings by inner prediction", 1) as task:
        settings, choices = choose_settings(ready, start, questions, low_passes)
        task.advance(1)
    law = settings.model.friction.laws[0]
    cell = sources.cell
    if "presliding" in questions:
        cell = cell.with_friction(presliding=law.presliding)
    if "friction" in questions:
        cell = cell.with_friction(third=law.third or "none", stribeck=law.stribeck or 0.0)
    return replace(sources, cell=cell), settings, choices


def _read_to_choose(sources: Sources) -> Sequence[Source]:
    """Recordings that settings are chosen on: repetitions of one motion say the same again."""
    if sources.same_motion:
        return sources.training[:_REPETITIONS]
    return sources.training


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
    sources: Sources, plain: Preprocessing, found: DelayEstimate, *, by_axis: bool
) -> tuple[Sources, Preprocessing, Array, list[str]]:
    """Sources without the delays that were found, the delay of each axis (n,), and words.

    One delay of all axes moves the time at which the motion is read; delays axis by axis, where
    somebody asked for them, move the torques.
    """
    notes = [f"delay of the torque behind the position, {line}" for line in found.describe()]
    n = len(found.joint_names)
    if not found.significant:
        notes.append(f"no other delay than the assumed {found.assumed * 1e3:.3g} ms was applied")
        return sources, plain, found.applied, notes
    if found.agree or not by_axis:
        notes.append(f"a delay of {found.common * 1e3:.3g} ms of all axes was compensated")
        common = replace(plain, torque_delay=found.common)
        return sources, common, np.full(n, found.common), notes
    notes.append("each axis was compensated by its own delay")
    none = replace(plain, torque_delay=0.0)

    def shifted(some: tuple[Source, ...]) -> tuple[Source, ...]:
        return tuple(
            replace(source, recording=compensate(source.recording, found.applied), context=None)
            for source in some
        )

    moved = replace(sources, training=shifted(sources.training), held_out=shifted(sources.held_out))
    return moved, none, found.applied, notes


def _other(sources: Sources, found: DelayEstimate) -> bool:
    """Whether a delay that was found replaces the cell's.

    That of a controller is known: only what is well determined and differs by more than the
    estimate errs in closed loop is another one.
    """
    if sources.cell.file.controller is None:
        return True
    apart = abs(found.common - found.assumed) > Thresholds().delay * found.cycle
    return apart and bool(found.determined.all())


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
