"""Preparation: settings, stated or chosen from the fitted data, and recordings to samples."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Reporter, Silent
from hil.cell import Cell
from hil.cell.robot_model import ripples
from identification.errors import IdentificationError
from identification.estimators.delay import (
    CLOSED_LOOP_BIAS,
    CombinedDelay,
    DelayEstimate,
    estimate_delay,
)
from identification.estimators.torque_channel import possible_low_passes
from identification.model.elements import TorqueRipple
from identification.model.robot import RobotModel
from identification.reduction.reduction import MAX_UNMODELLED_REPETITIONS, Reduction, reduce
from identification.selection.questions import (
    DELAY,
    SELECTION_RATE,
    Question,
    SuggestedDelay,
    choose_settings,
)
from identification.selection.scores import Known
from identification.selection.settings import Settings
from identification.signals.masks import MIN_STRETCH_SAMPLES, RowReason
from identification.signals.recording import RIGID_RATE, Recording, in_succession
from identification.signals.sample_times import time_base
from identification.signals.samples import (
    RIGID_BANDWIDTH,
    Preprocessing,
    Samples,
    Smoothed,
    prepare,
)
from identification.text import percentage
from identification.validation.finding import Thresholds
from planner.arrays import numbers

from .estimators import OF_PRIOR
from .notes import (
    CompensatedDelay,
    DelayNotApplied,
    EstimatedDelay,
    FittedRows,
    MergedSamples,
    NoOtherDelay,
    Note,
    PositionNoise,
    TimesUsed,
    UnevenClock,
    WhyNotApplied,
)
from .options import Options
from .sources import Source, Sources


def stated_delay(cell: Cell) -> float:
    """Return the delay of the torque that `[controller]` states [s]."""
    controller = cell.file.controller
    return controller.current_delay_cycles * cell.period if controller else 0.0


def stated_settings(cell: Cell, options: Options) -> Settings:
    """Return the settings that cell and options state, before any automatic choice."""
    delay = options.delay
    bandwidth = options.torque_bandwidth
    delay = delay if isinstance(delay, float) else stated_delay(cell)
    return Settings(
        Preprocessing(
            rigid_bandwidth=RIGID_BANDWIDTH if options.bandwidth == "auto" else options.bandwidth,
            velocity="position" if options.velocity == "auto" else options.velocity,
            exclude_rows=None if options.exclude_rows == "auto" else options.exclude_rows,
            smooth_torque=options.method == "paper",
            torque_delay=delay,
            torque_bandwidth=bandwidth if isinstance(bandwidth, float) else None,
        ),
        friction={} if options.friction == "auto" else dict(options.friction),
        stated_delay=delay,
    )


def samples_of(
    source: Source,
    cell: Cell,
    settings: Settings,
    model: RobotModel | None = None,
    motions: dict[Preprocessing, Smoothed] | None = None,
) -> Samples:
    """Return the samples of a source, for a fit.

    Args:
        source: a recording.
        cell: with the friction law.
        settings: of the preparation.
        model: replaces the cell's.
        motions: keeps smoothed motions of the source for several calls.

    Raises:
        RecordingError: the recording cannot be prepared.
    """
    start = source.context[1] if source.context else 0
    driven = cell.file.drive_train is not None
    samples = prepare(
        source.whole,
        model or cell.model,
        noise_variance=_array(settings.noise_variance),
        torque_variance=_array(settings.torque_variance),
        options=settings.preprocessing,
        origin=source.origin,
        current_limit=np.array(cell.drive_table.current_limit) if driven else None,
        motions=motions,
    )
    if source.context is None:
        return samples
    return samples.between(start, start + source.recording.n_samples)


def versions_of(
    source: Source,
    cell: Cell,
    settings: Settings,
    motions: dict[Preprocessing, Smoothed] | None = None,
    *,
    for_fit: bool = True,
) -> tuple[Samples, ...]:
    """Return the samples of a source for each bandwidth over which the fit is averaged.

    Args:
        source: a recording.
        cell: with the friction law.
        settings: of the preparation, with the load of the gears.
        motions: keeps smoothed motions of the source for several calls.
        for_fit: otherwise :func:`validation_samples`.

    Raises:
        RecordingError: the recording cannot be prepared.
    """
    if for_fit:
        every = tuple(samples_of(source, cell, each, motions=motions) for each in settings.versions)
    else:
        every = (validation_samples(source, cell, settings, motions),)
    if settings.loading is None:
        return every
    loading = np.array(settings.loading)
    return tuple(samples.with_load(cell.model, loading) for samples in every)


def reduction_of(
    cell: Cell, settings: Settings, versions: Sequence[Samples], *, unmodelled: bool
) -> Reduction:
    """Reduce a recording.

    Args:
        cell: with the model and the parameters that are known.
        settings: of the preparation.
        versions: samples for each bandwidth, by :func:`versions_of`.
        unmodelled: whether what the model lacks is estimated, as of the reduction.
    """
    return reduce(
        cell.model,
        versions,
        settings.shares if len(versions) > 1 else (1.0,),
        uncertain_delay=settings.delay_variance > 0.0,
        known=known_parameters(cell),
        unmodelled=unmodelled,
        elastic=cell.file.drive_train is not None,
    )


def validation_samples(
    source: Source,
    cell: Cell,
    settings: Settings,
    motions: dict[Preprocessing, Smoothed] | None = None,
) -> Samples:
    """Return the samples of a source for a verdict: rows in motion, torque as recorded.

    Args:
        source: a recording.
        cell: with the friction law.
        settings: of the preparation.
        motions: keeps smoothed motions of the source for several calls.

    Raises:
        RecordingError: the recording cannot be prepared.
    """
    unsmoothed = settings.preprocessed(smooth_torque=False)
    return samples_of(source, cell, unsmoothed, motions=motions).moving()


def _array(figures: tuple[float, ...] | None) -> Array | None:
    return None if figures is None else np.array(figures)


MAX_RECORDINGS: Final = 32
"""Recordings that settings are chosen from."""
# cycles, by which a delay in use may differ from the stated one unsaid
_DELAY_TOLERANCE_CYCLES: Final = 0.05
_STEP_TOLERANCE: Final = 0.1  # of sampling intervals of recordings that are estimated together
DELAY_SEARCH_SECONDS: Final = 64.0  # s of recordings, without an explicit request
RIPPLE_ORDERS: Final = ((1,), (2,), (1, 2))
"""Periods of a torque ripple per motor turn: rotor eccentricity, wave generator, both."""


FRICTION_UNCERTAINTY: Final = 0.5
"""Relative standard deviation of nominal friction, which varies by tens of per cent with
temperature, lubricant and wear (Bittencourt and Gunnarsson 2012)."""


class Decided(NamedTuple):
    """Chosen settings."""

    settings: Settings
    delays: DelayEstimate | None  #: None if it cannot be determined
    notes: tuple[Note, ...]  #: about delays


def decide(sources: Sources, options: Options, reporter: Reporter) -> Decided:
    """Choose the settings that the options leave open, from sources with torques and noise.

    Raises:
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was requested and no row is usable.
    """
    sources, stated = _as_stated(sources, options)
    delay = _DelayChoice.of(_delays(sources, stated, options, reporter), sources, stated, options)
    started = stated.preprocessed(torque_delay=delay.assumed)
    chosen = _chosen(sources, started, delay.suggested, options, reporter)
    if _adds_load(sources.cell, chosen) and chosen.preprocessing.torque_bandwidth is None:
        # Without friction that grows with load its absence was estimated as a delay.
        loaded = replace(sources, cell=sources.cell.with_friction(**chosen.friction))
        delay = _DelayChoice.of(_delays(loaded, stated, options, reporter), loaded, stated, options)
        chosen = delay.applied_to(chosen)
    estimate, notes = delay.confirmed_by(chosen.preprocessing)
    error = delay.errors.get(chosen.preprocessing.torque_delay, 0.0)
    if estimate is None and (sources.cell.file.controller is None or options.delay == "auto"):
        error = 0.0  # the estimate may be the lag of a low-pass: its error is unknown
    return Decided(replace(chosen, delay_variance=error), estimate, notes)


def renewed_delay(sources: Sources, settings: Settings, options: Options) -> CombinedDelay:
    """Return the delay in chosen settings of a controller's torque by other sources [s].

    The settings' delay if it is known, or if these sources cannot estimate one. A stated delay in
    the settings stays in use, with its error by the other sources; an estimated one returns to the
    stated delay if these sources do not exclude that.
    """
    used = settings.preprocessing.torque_delay
    unchanged = CombinedDelay(used, settings.delay_variance)
    if not settings.delay_variance:
        return unchanged
    sources, stated = _as_stated(sources, options)
    if _adds_load(sources.cell, settings):
        sources = replace(sources, cell=sources.cell.with_friction(**settings.friction))
    estimate = _delays(sources, stated, options, Silent())
    if estimate is None:
        return unchanged
    stated_value = settings.stated_delay
    combined = with_stated_delay(estimate, stated_value)
    if used == stated_value or not estimate.excludes(stated_value):
        return CombinedDelay(stated_value, combined.mean_square_error(stated_value))
    return combined


def with_stated_delay(estimate: DelayEstimate, stated: float) -> CombinedDelay:
    """Return the delay from an estimate and the controller's stated delay [s]."""
    return estimate.combined(stated, Thresholds().delay * estimate.cycle, CLOSED_LOOP_BIAS)


def _as_stated(sources: Sources, options: Options) -> tuple[Sources, Settings]:
    """Return at most `MAX_RECORDINGS` sources with the stated friction, and stated settings."""
    sources = replace(sources, training=sources.training[:MAX_RECORDINGS])
    stated = _with_noise_of(stated_settings(sources.cell, options), sources)
    return replace(sources, cell=sources.cell.with_friction(**stated.friction)), stated


def _adds_load(cell: Cell, chosen: Settings) -> bool:
    """Return whether the chosen friction grows with load and the stated one does not."""
    return not cell.model.friction.has_load and (
        cell.with_friction(**chosen.friction).model.friction.has_load
    )


@dataclass(frozen=True, eq=False)
class _DelayChoice:
    """Use of an estimated delay in the choice of the other settings."""

    estimate: DelayEstimate | None
    assumed: float  # that the choice begins with [s]
    suggested: tuple[SuggestedDelay, ...]  # that it may choose as well
    notes: tuple[Note, ...]
    #: mean square error of a delay that is used, by its value [s²]
    errors: Mapping[float, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, estimate: DelayEstimate | None, sources: Sources, stated: Settings, options: Options
    ) -> _DelayChoice:
        """Compensate a significant estimate if that was requested, else let the data decide."""
        unused = cls(estimate, stated.preprocessing.torque_delay, (), ())
        if estimate is None:
            return unused
        described = EstimatedDelay(estimate)
        unapplied = (described, *_unless_applied(estimate))
        if options.delay == "auto":
            if not estimate.significant:
                return replace(unused, notes=unapplied, errors={unused.assumed: estimate.variance})
            notes = (described, CompensatedDelay(estimate.delay))
            errors = {estimate.delay: estimate.variance}
            return replace(unused, assumed=estimate.delay, notes=notes, errors=errors)
        if options.delay is not None:
            return unused
        if sources.cell.file.controller is not None:
            filtered = stated.preprocessing.torque_bandwidth is not None
            return unused._beside_stated(
                estimate, unapplied, filtered=filtered or _asks_low_pass(sources, options)
            )
        delay = SuggestedDelay(estimate.delay, estimate.determined and estimate.significant)
        doubtful = estimate.determined and estimate.unconfirmed
        return replace(
            unused,
            suggested=(delay,) if estimate.significant or doubtful else (),
            notes=(described,) if doubtful else unapplied,
            errors=dict.fromkeys((estimate.applied, estimate.delay), estimate.variance),
        )

    def _beside_stated(
        self, estimate: DelayEstimate, described: tuple[Note, ...], *, filtered: bool
    ) -> _DelayChoice:
        """Use the stated delay of a controller, or both together if the estimate excludes it.

        Inner prediction decides on a significant, determined one that is far from it. Beside a
        low-pass of the torque the stated one is used, as the estimate may include the delay of the
        filter.
        """
        stated = self.assumed
        combined = with_stated_delay(estimate, stated)
        errors = {stated: combined.mean_square_error(stated), combined.mean: combined.variance}
        choice = replace(self, notes=described, errors=errors)
        far = abs(estimate.delay - stated) > Thresholds().delay * estimate.cycle
        if far and estimate.determined and estimate.significant:
            return replace(choice, suggested=(SuggestedDelay(combined.mean, determined=True),))
        if filtered or not estimate.excludes(stated):
            return choice
        if abs(combined.mean - stated) >= _DELAY_TOLERANCE_CYCLES * estimate.cycle:
            choice = replace(choice, notes=(described[0], CompensatedDelay(combined.mean, stated)))
        return replace(choice, assumed=combined.mean)

    def applied_to(self, chosen: Settings) -> Settings:
        """Return settings with the determined delay, whatever they were chosen with."""
        values = [delay.value for delay in self.suggested if delay.determined]
        choices = tuple(choice for choice in chosen.choices if choice.name != DELAY)
        return replace(chosen, choices=choices).preprocessed(
            torque_delay=values[0] if values else self.assumed
        )

    def confirmed_by(self, how: Preprocessing) -> tuple[DelayEstimate | None, tuple[Note, ...]]:
        """Return the estimate if the chosen preprocessing agrees with it, and the notes on it.

        Also one that is significant and was not applied because its interval is wide.
        """
        if (
            self.estimate is not None
            and how.torque_bandwidth is not None
            and how.torque_shape.causal
        ):
            # It was estimated without the low-pass, and may be the lag of that.
            return None, (NoOtherDelay(self.assumed, beside_low_pass=True),)
        if how.torque_delay in [delay.value for delay in self.suggested]:
            assert self.estimate is not None
            confirmed = replace(self.estimate, significant=True)
            return confirmed, (*self.notes, CompensatedDelay(how.torque_delay))
        if how.torque_delay != self.assumed:
            return None, (CompensatedDelay(how.torque_delay),)
        if self.suggested and self.estimate is not None:
            determined = all(delay.determined for delay in self.suggested)
            reason = WhyNotApplied.PREDICTS_WORSE if determined else WhyNotApplied.UNDETERMINED
            if self.estimate.unconfirmed:
                reason = WhyNotApplied.PREDICTS_NO_BETTER
            # It was estimated without a low-pass of the torque.
            suspected = not determined and how.torque_bandwidth is None
            estimate = self.estimate if suspected else None
            return estimate, (DelayNotApplied(self.estimate, reason),)
        return self.estimate, self.notes


def _unless_applied(estimate: DelayEstimate) -> tuple[NoOtherDelay, ...]:
    return () if estimate.significant else (NoOtherDelay(estimate.assumed),)


def carried_over(settings: Settings, sources: Sources, options: Options) -> Settings:
    """Return the settings for another campaign of the arm: with its noise and stated delay."""
    settings = _with_noise_of(settings, sources)
    if isinstance(options.delay, float):
        return settings
    stated = stated_delay(sources.cell)
    delay = settings.preprocessing.torque_delay + (stated - settings.stated_delay)
    return replace(settings, stated_delay=stated).preprocessed(torque_delay=delay)


def _with_noise_of(settings: Settings, sources: Sources) -> Settings:
    position, torque = (
        None if values is None else tuple(values.tolist())
        for values in (sources.noise_variance, sources.torque_variance)
    )
    return replace(settings, noise_variance=position, torque_variance=torque)


def _asks_low_pass(sources: Sources, options: Options) -> bool:
    """Return whether a low-pass of the torque may be chosen; currents of a controller have none."""
    first = sources.training[0].recording
    return (
        options.torque_bandwidth == "auto"
        and options.method == "default"
        and first.motor_current is None
    )


def _questions(
    sources: Sources, options: Options, suggested: Sequence[SuggestedDelay]
) -> set[Question]:
    """Return the questions that inner prediction decides."""
    recorded = [source.recording for source in sources.training]
    questions: dict[Question, bool] = {
        "delay": bool(suggested),
        "bandwidth": options.bandwidth == "auto",
        "velocity": options.velocity == "auto"
        and all(recording.velocity is not None for recording in recorded),
        "presliding": options.friction == "auto",
        "excluded rows": options.exclude_rows == "auto",
        # A cell file with a drive train states the friction terms.
        "friction": options.friction == "auto" and sources.cell.file.drive_train is None,
        "ripple": options.friction == "auto" and bool(_ripples(sources.cell)),
        "springs": options.friction == "auto" and bool(_spring_joints(sources.cell)),
        "position torque": options.friction == "auto" and bool(_turning_joints(sources.cell)),
        "low-pass": _asks_low_pass(sources, options),
        "estimator": options.estimator == "auto",
    }
    return {question for question, wanted in questions.items() if wanted}


def averaged_source(source: Source, rate: float) -> Source:
    """Return a source whose recording is averaged to about a rate [Hz]."""
    if source.context is None:
        return replace(source, recording=source.recording.averaged(rate))
    whole, start = source.context
    mean = whole.averaged(rate)
    part = source.recording
    first, last = np.searchsorted(mean.time, [whole.time[start], part.time[-1]])
    return replace(
        source, recording=mean.between(int(first), int(last)), context=(mean, int(first))
    )


def averaged_noise(settings: Settings, source: Source, mean: Source) -> Settings:
    """Return settings with the noise of a source's average."""
    step, longer = (
        float(np.median(np.diff(recording.time)))
        for recording in (source.recording, mean.recording)
    )
    position, torque = (
        None if variance is None else tuple(value * step / longer for value in variance)
        for variance in (settings.noise_variance, settings.torque_variance)
    )
    return replace(settings, noise_variance=position, torque_variance=torque)


def known_parameters(cell: Cell) -> Known:
    """Return mean and standard deviation of the parameters that `[nominal]` states."""
    table = cell.file.nominal
    if table is None:
        return {}
    model = cell.model
    share = table.uncertainty or FRICTION_UNCERTAINTY
    parameters = {
        f"I{j}m": (value, share * value) for j, value in enumerate(table.rotor_inertia, 1)
    }
    for term in model.friction.terms:
        values = getattr(table, term.term.option, None)
        if values and not term.motor:
            value = values[term.owner]
            parameters[term.name] = value, FRICTION_UNCERTAINTY * abs(value)
    names = {*model.layout.names, *model.friction.names}
    return {name: pair for name, pair in parameters.items() if pair[0] != 0.0 and name in names}


def _chosen(
    sources: Sources,
    stated: Settings,
    suggested: Sequence[SuggestedDelay],
    options: Options,
    reporter: Reporter,
) -> Settings:
    """Choose the automatic settings by inner prediction; `suggested` delays are candidates."""
    cell = sources.cell
    questions = _questions(sources, options, suggested)
    if not questions:
        return stated
    # One repetition of a motion is enough.
    some = sources.training[:1] if sources.same_motion else sources.training
    read = [averaged_source(source, SELECTION_RATE) for source in some]
    averaged = averaged_noise(stated, some[0], read[0])
    motions: list[dict[Preprocessing, Smoothed]] = [{} for _ in read]

    def ready(model: RobotModel, how: Preprocessing) -> list[Samples]:
        trial = replace(averaged, preprocessing=how)
        return [
            samples_of(source, cell, trial, model, smoothed)
            for source, smoothed in zip(read, motions, strict=True)
        ]

    def low_passes(model: RobotModel, how: Preprocessing) -> tuple[Preprocessing, ...]:
        return possible_low_passes(
            read[0].recording,
            model,
            noise_variance=_array(averaged.noise_variance),
            options=how,
            undelayed=stated.preprocessing.torque_delay,
        )

    with reporter.task("choosing settings by inner prediction", 1) as task:
        chosen = choose_settings(
            cell.model,
            ready,
            stated,
            questions,
            low_passes,
            suggested,
            _ripples(cell),
            _spring_joints(cell),
            _turning_joints(cell),
            known_parameters(cell),
        )
        task.advance(1)
    # Estimators without prior read samples, of one bandwidth.
    return chosen if options.estimator in OF_PRIOR else replace(chosen, hedge=None)


def _ripples(cell: Cell) -> list[list[TorqueRipple]]:
    """Candidates of torque ripple; none if the cell states some, or no gear ratios."""
    if cell.file.drive_train is None or cell.file.robot.friction.ripple:
        return []
    motors = cell.drive_train.motor_from_joint
    return [ripples(cell.joint_names, motors, orders) for orders in RIPPLE_ORDERS]


def _spring_joints(cell: Cell) -> tuple[str, ...]:
    """Candidates of joints with a torsion spring: with an offset of the torque, and no element.

    None if the cell states some, or the drive train, with which it states the friction terms.
    """
    if cell.file.drive_train is not None or cell.file.robot.friction.springs:
        return ()
    stated = {element.joint for element in cell.file.robot.elements}
    laws = cell.model.friction.laws
    joints = zip(cell.joint_names, cell.model.chain.revolute, laws, strict=False)
    return tuple(name for name, turns, law in joints if turns and law.offset and name not in stated)


def _turning_joints(cell: Cell) -> tuple[str, ...]:
    """Candidates of joints with a torque of their position; none as of `_spring_joints`."""
    if cell.file.drive_train is not None or cell.file.robot.friction.position_torque:
        return ()
    joints = zip(cell.joint_names, cell.model.chain.revolute, strict=True)
    return tuple(name for name, turns in joints if turns)


def _delays(
    sources: Sources, stated: Settings, options: Options, reporter: Reporter
) -> DelayEstimate | None:
    """Estimate the delay in all fitted recordings, or in some time of them if not requested."""
    if options.delay == "stated":
        return None
    wanted = options.delay == "auto"
    in_order = sorted(sources.training, key=lambda source: -source.recording.n_samples)
    averages = _averaged_for(np.inf if wanted else DELAY_SEARCH_SECONDS, in_order)
    longest = in_order[0]
    mean = replace(longest, recording=averages[0], context=None)
    with reporter.task("estimating the delay", 1) as task:
        try:
            estimate = estimate_delay(
                in_succession(averages),
                sources.cell.model,
                noise_variance=_array(averaged_noise(stated, longest, mean).noise_variance),
                options=replace(stated.preprocessing, smooth_torque=False),
            )
        except IdentificationError:
            if wanted:
                raise
            return None
        task.advance(1)
    return replace(estimate, cycle=_step(longest.recording))


def _averaged_for(duration: float, sources: Sequence[Source]) -> list[Recording]:
    """Return averages of recordings of one sampling rate, the first one's, for a time [s]."""
    averages: list[Recording] = []
    for recording in (source.recording for source in sources):
        if averages and (duration <= 0.0 or recording.n_samples < MIN_STRETCH_SAMPLES):
            break
        if duration < np.inf:
            recording = recording.between(0, max(2, math.ceil(duration / _step(recording))))
            duration -= recording.n_samples * _step(recording)
        average = recording.averaged(RIGID_RATE)
        if not averages or np.isclose(_step(average), _step(averages[0]), rtol=_STEP_TOLERANCE):
            averages.append(average)
    return averages


def _step(recording: Recording) -> float:
    return float(np.median(np.diff(recording.time)))


@dataclass(frozen=True, eq=False)
class Prepared:
    """Samples of all sources, and the settings that made them."""

    sources: Sources  #: with the chosen friction law, and warnings of the preparation
    fitted: tuple[Samples, ...]  #: for the fit
    #: the same recordings with the bandwidth that the chosen one is averaged with; empty: with none
    hedged: tuple[Samples, ...]
    training: tuple[Samples, ...]  #: the same recordings for the verdict: torques as recorded
    held_out: tuple[Samples, ...]  #: for the verdict; `training` if nothing was held out
    settings: Settings  #: of `fitted`
    #: delay of the torque in the fitted recordings; None if it cannot be determined
    delays: DelayEstimate | None
    masked: Mapping[RowReason, NDArray[np.intp]]  #: excluded rows of each joint (n,), by reason
    rows: int  #: time samples of `fitted`
    notes: tuple[Note, ...]  #: decisions

    @property
    def assumed_delay(self) -> float:
        """Delay of the torque that the fit used [s]."""
        return self.settings.preprocessing.torque_delay

    @cached_property
    def reductions(self) -> tuple[Reduction, ...]:
        """Sums of each fitted recording."""
        same = self.sources.same_motion
        sides = (self.fitted, self.hedged) if self.hedged else (self.fitted,)
        return tuple(
            reduction_of(
                self.sources.cell,
                self.settings,
                versions,
                unmodelled=not same or k < MAX_UNMODELLED_REPETITIONS,
            )
            for k, versions in enumerate(zip(*sides, strict=True))
        )

    @property
    def total(self) -> Reduction:
        """Their sum."""
        return Reduction.total(self.sources.cell.model, self.reductions)

    def unhedged(self) -> Prepared:
        """Return the same with the chosen bandwidth alone."""
        return replace(self, hedged=(), settings=replace(self.settings, hedge=None))

    def warned(self, *warnings: Note) -> Prepared:
        """Return the same with warnings of later steps."""
        sources = replace(self.sources, warnings=(*self.sources.warnings, *warnings))
        return replace(self, sources=sources)

    def with_load(self, values: Array) -> Prepared:
        """Return samples that carry the torque that the gears transmit by parameters (p,).

        Unchanged without friction that grows with it.
        """
        model = self.sources.cell.model
        if not model.friction.has_load:
            return self
        unseen = () if self.sources.in_sample else self.held_out
        fitted, hedged, training, held_out = (
            tuple(samples.with_load(model, values) for samples in group)
            for group in (self.fitted, self.hedged, self.training, unseen)
        )
        return replace(
            self,
            fitted=fitted,
            hedged=hedged,
            training=training,
            held_out=held_out or training,
        )


def prepare_sources(sources: Sources, options: Options, reporter: Reporter) -> Prepared:
    """Determine time base, noise, delay and settings, then smooth every recording.

    Settings depend on the fitted recordings only.

    Raises:
        ArchiveError: there are currents only, and no way to convert them to torques.
        InputError: too few fitted rows are slow enough for a stated Stribeck term.
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was requested and no row is usable.
    """
    notes: list[Note] = []
    stated = stated_settings(sources.cell, options)
    for source in (*sources.training, *sources.held_out):
        if source.merged:
            notes.append(MergedSamples(source.merged, source.name))
        if source.times is not None:
            notes.append(TimesUsed(source.name, source.times))
        base = time_base(source.recording.time, source.recording.gap_before)
        if not base.uniform or base.gaps:
            notes.append(UnevenClock(source.name, base))
    _require_torques(sources)
    noise = PositionNoise(at_standstill=sources.noise_variance is not None)
    decided = decide(sources, options, reporter)
    prepared = prepared_with(sources, decided.settings, reporter)
    _require_slow_rows(sources.cell.with_friction(**stated.friction).model, prepared.fitted)
    notes += [noise, *decided.notes, *prepared.notes]
    return replace(prepared, delays=decided.delays, notes=tuple(notes))


def prepared_with(sources: Sources, settings: Settings, reporter: Reporter) -> Prepared:
    """Smooth every recording by settings that are decided.

    Raises:
        RecordingError: a recording cannot be prepared.
    """
    cell = sources.cell.with_friction(**settings.friction)
    sources = replace(sources, cell=cell)
    unseen = () if sources.in_sample else sources.held_out
    # Parts of one recording share its arrays, and have its motion.
    motions: defaultdict[int, dict[Preprocessing, Smoothed]] = defaultdict(dict)
    with reporter.task("smoothing recordings", len(sources.training) + len(unseen)) as task:
        versions = []
        held_out = []
        for source in sources.training:
            versions.append(versions_of(source, cell, settings, motions[source.motion_key]))
            task.advance(1, source.name)
        for source in unseen:
            held_out.append(validation_samples(source, cell, settings, motions[source.motion_key]))
            task.advance(1, source.name)
    fitted, *others = zip(*versions, strict=True)
    if settings.preprocessing.smooth_torque:
        training = [validation_samples(source, cell, settings) for source in sources.training]
    else:
        training = [samples.moving() for samples in fitted]
    masked: dict[RowReason, NDArray[np.intp]] = {}
    for mask in (samples.mask for samples in fitted if samples.mask is not None):
        for reason, counts in mask.counts.items():
            masked[reason] = masked.get(reason, 0) + counts
    rows = sum(len(samples.torque) for samples in fitted)
    return Prepared(
        sources=sources,
        fitted=fitted,
        hedged=others[0] if others else (),
        training=tuple(training),
        held_out=tuple(training if sources.in_sample else held_out),
        settings=settings,
        delays=None,
        masked=masked,
        rows=rows,
        notes=_excluded(sources, masked, rows),
    )


def _excluded(
    sources: Sources, masked: Mapping[RowReason, NDArray[np.intp]], rows: int
) -> tuple[FittedRows, ...]:
    total = rows * len(sources.cell.joint_names)
    shares = {
        reason: int(counts.sum()) / total for reason, counts in masked.items() if counts.any()
    }
    return (FittedRows(total, shares),) if shares else ()


def motor_from_joint(recording: Recording) -> Array:
    """Motor angles per joint angle (n, n) as imported; default: the identity."""
    stored = recording.provenance.get("motor_from_joint")
    return np.eye(recording.n_joints) if stored is None else numbers(json.loads(stored), 2)


def _require_torques(sources: Sources) -> None:
    """Raise ArchiveError if a recording has currents only."""
    if any(source.recording.torque is None for source in (*sources.training, *sources.held_out)):
        raise ArchiveError(
            None,
            "the recordings contain no torques",
            field="torque",
            remedy="give drive.torque_constant in the column map, or identify it by "
            "`hil torque-constants`",
        )


def _require_slow_rows(stated: RobotModel, fitted: Sequence[Samples]) -> None:
    """Raise InputError if the fitted rows are too fast for a stated Stribeck term.

    Its coefficient would be arbitrary. At twice its speed the term has fallen to 2 %. A joint that
    stands while another moves has none.
    """
    sliding = [samples.moving() for samples in fitted]
    for joint, law in enumerate(stated.friction.laws):
        speeds = [
            np.abs(samples.motion.velocity[samples.usable[:, joint], joint]) for samples in sliding
        ]
        slow = np.concatenate(speeds) < 2.0 * (law.stribeck or math.inf)
        if slow.size and slow.mean() < 0.01:
            problem = (
                f"{percentage(slow.mean(), 2)} of the fitted rows of {stated.joint_names[joint]} "
                "are slower "
                f"than twice {law.stribeck:g} rad/s, too few to determine the Stribeck term"
            )
            remedy = "state a larger speed, or leave the term out: --friction coulomb,viscous"
            raise InputError(None, problem, field="robot.friction.stribeck", remedy=remedy)


def executed_rows(source: Source, samples: Samples) -> slice:
    """Return the samples from the first to the last changing set-point, or moving joint."""
    commanded = source.recording.commanded_position
    time = source.recording.time
    if commanded is None:
        return moving_rows(samples)
    steps = np.flatnonzero((np.abs(np.diff(commanded, axis=0)) > 0.0).any(axis=1))
    if not steps.size:
        return slice(0, 0)
    first, last = np.searchsorted(samples.motion.time, time[[steps[0], steps[-1] + 1]])
    return slice(int(first), int(last) + 1)


def moving_rows(samples: Samples) -> slice:
    """Return the samples from the first to the last in which a joint moves."""
    moving = np.flatnonzero(samples.usable.any(axis=1))
    return slice(int(moving[0]), int(moving[-1]) + 1) if moving.size else slice(0, 0)
