"""From sources to samples: settings decided, and applied to all of them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hil.errors import ArchiveError
from hil.progress import Reporter
from identification.estimators.delay import DelayEstimate
from identification.estimators.gains import CurrentScale, scale_from_nominal
from identification.signals.clock import time_base
from identification.signals.recording import Recording
from identification.signals.samples import Samples, smooth
from planner.checked_data import numbers

from .options import Options
from .settings import Settings, decide, judged_samples, samples_of, signals_of, with_noise
from .sources import Sources

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prepared:
    """Sources as samples, and what was done to them."""

    #: with the friction law that was decided on, and the warnings that preparing raised
    sources: Sources
    fitted: tuple[Samples, ...]  #: what the fit reads
    #: the same recordings as a verdict reads them: torques never smoothed
    training: tuple[Samples, ...]
    #: what is predicted, likewise; `training` where nothing was held out
    held_out: tuple[Samples, ...]
    settings: Settings  #: of `fitted`
    #: of the torque behind the position, as the longest of the fitted recordings has them; None
    #: where that cannot be determined
    delays: DelayEstimate | None
    #: rows of `fitted` that do not count, per joint (n,), by the first reason against them, in
    #: words
    masked: Mapping[str, NDArray[np.intp]]
    rows: int  #: time samples of `fitted`
    notes: tuple[str, ...]  #: what was found and done, in sentences

    @property
    def assumed_delay(self) -> Array:
        """What the fit took the delay of each axis to be (n,) [s]."""
        return self.settings.delays(len(self.sources.cell.joint_names))


def prepare_sources(sources: Sources, options: Options, reporter: Reporter) -> Prepared:
    """Smooth every recording, after its time base, noise, delay and settings are decided.

    Only what is fitted is looked at to decide them.

    Raises:
        ArchiveError: there are currents only, and nothing that could make torques of them.
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was asked for and there is not one usable row.
    """
    notes = []
    for source in (*sources.training, *sources.held_out):
        notes += [f"{source.name}: {line}" for line in (source.merged, *source.clock) if line]
        base = time_base(source.recording.time, source.recording.gap_before)
        if not base.uniform or base.gaps:  # not as even as a filter would like it
            notes.append(f"{source.name}: {'; '.join(base.describe())}")
    sources, noise = with_noise(sources)
    sources = with_torques(sources)
    decided = decide(sources, options, reporter)
    settings, cell = decided.settings, decided.settings.law(sources.cell)
    read, held = (
        tuple(signals_of(source, settings) for source in some)
        for some in (sources.training, sources.held_out)
    )
    sources = replace(sources, cell=cell, training=read, held_out=held)
    unseen = () if sources.in_sample else sources.held_out
    with reporter.task("smoothing recordings", len(sources.training) + len(unseen)) as task:
        fitted, held_out = [], []
        for source in sources.training:
            fitted.append(samples_of(source, cell, settings))
            task.advance(1, source.name)
        for source in unseen:
            held_out.append(judged_samples(source, cell, settings))
            task.advance(1, source.name)
    if settings.preprocessing.smooth_torque:
        training = [judged_samples(source, cell, settings) for source in sources.training]
    else:
        training = [samples.moving() for samples in fitted]
    masked: dict[str, NDArray[np.intp]] = {}
    for mask in (samples.mask for samples in fitted if samples.mask is not None):
        for reason, counts in mask.counts.items():
            masked[reason] = masked.get(reason, 0) + counts
    rows = sum(len(one.torque) for one in fitted)
    return Prepared(
        sources=sources,
        fitted=tuple(fitted),
        training=tuple(training),
        held_out=tuple(training if sources.in_sample else held_out),
        settings=settings,
        delays=decided.delays,
        masked=masked,
        rows=rows,
        notes=(*notes, noise, *decided.notes, *_left_out(sources, masked, rows)),
    )


def _left_out(sources: Sources, masked: Mapping[str, NDArray[np.intp]], rows: int) -> list[str]:
    """What was left out in all, and why."""
    total = rows * len(sources.cell.joint_names)
    shares = {why: int(counts.sum()) / total for why, counts in masked.items() if counts.any()}
    if not shares:
        return []
    parts = ", ".join(f"{share:.2%} {reason}" for reason, share in shares.items())
    return [
        f"of {total} rows (one joint at one instant) {1.0 - sum(shares.values()):.1%} were fitted; "
        f"left out: {parts}"
    ]


# Torques of recordings that hold motor currents only


def motor_from_joint(recording: Recording) -> Array:
    """Motor angles per joint angle (n, n) as imported; the identity where none were given."""
    stored = recording.provenance.get("motor_from_joint")
    return np.eye(recording.n_joints) if stored is None else numbers(json.loads(stored), 2)


def with_torques(sources: Sources) -> Sources:
    """These sources with a torque in every recording.

    Where there are currents only, the gains are read from the nominal masses of the URDF, and a
    warning says so. Only what is fitted is looked at.

    Raises:
        ArchiveError: the URDF has no masses that the currents could be compared with.
    """
    everything = (*sources.training, *sources.held_out)
    if all(source.recording.torque is not None for source in everything):
        return sources
    model, recordings = sources.cell.model, [source.recording for source in sources.training]
    currents = [one.motor_current for one in recordings if one.motor_current is not None]
    why = "the URDF has no masses to compare currents with"
    if len(currents) == len(recordings) and np.any(model.nominal):
        turns = motor_from_joint(recordings[0])
        motions = [smooth(one, sources.noise_variance)[0] for one in recordings]
        scale = scale_from_nominal(model, motions, currents, turns)
        why = "their currents do not look like the weight and inertia of the URDF on any axis"
        why = "" if scale.determined.any() else why
    if why:
        problem = f"the recordings hold no torques, and {why}"
        remedy = "give drive.torque_constant in the column map, or find it by `hil gains`"
        raise ArchiveError(None, problem, field="torque", remedy=remedy)

    def with_torque(one: Recording) -> Recording:
        if one.torque is not None or one.motor_current is None:
            return one
        return replace(one, torque=(one.motor_current * scale.values) @ turns)

    training, held_out = (
        tuple(source.changed(with_torque) for source in some)
        for some in (sources.training, sources.held_out)
    )
    warnings = (*sources.warnings, *current_warnings(sources.cell.joint_names, scale))
    return replace(sources, training=training, held_out=held_out, warnings=warnings)


def current_warnings(names: tuple[str, ...], scale: CurrentScale) -> list[str]:
    """What a reader must know of torques that were made of currents."""
    rows = zip(names, scale.values, scale.std, strict=True)
    figures = ", ".join(
        f"{n} {value:.4g} ± {2.0 * s:.2g}" for n, value, s in rows if np.isfinite(s)
    )
    warnings = [
        "only currents were recorded and no torque constants given: they were found by comparing "
        f"the currents with the masses of the URDF ({figures} N·m/A), so every torque and "
        "parameter is as right as those masses; `hil gains` with a known payload does without them"
    ]
    for chosen, words in (
        (
            scale.turned,
            "the torque constant of {} comes out negative: the sign of the current or of the axis "
            "is turned in the recording, or the URDF's masses are wrong there; it was used as "
            "found. Check it before using the torques",
        ),
        (
            scale.inertial,
            "weight hardly loads {}: the torque constant there rests on inertia and takes the "
            "rotor's for that of the links",
        ),
        (
            ~scale.determined,
            "no torque constant could be found for {}: its torque is the current in A (times the "
            "gears), which predicts the current but no torque",
        ),
    ):
        if found := [name for name, one in zip(names, chosen, strict=True) if one]:
            warnings.append(words.format(", ".join(found)))
    return warnings
