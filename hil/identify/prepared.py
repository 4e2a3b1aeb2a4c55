"""From sources to samples: settings decided, and applied to all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hil.progress import Reporter
from identification.estimators.delay import DelayEstimate
from identification.signals.clock import time_base
from identification.signals.samples import Samples

from .currents import with_torques
from .deciding import Decided, decide, with_noise
from .options import Options
from .settings import Settings, judged_samples, samples_of, signals_of
from .sources import Source, Sources

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prepared:
    """Sources as samples, and what was done to them.

    Attributes:
        sources: with the friction law that was decided on, and the warnings that preparing raised.
        fitted: what the fit reads.
        training: the same recordings as a verdict reads them: torques never smoothed.
        held_out: what is predicted, likewise; `training` where nothing was held out.
        settings: of `fitted`.
        delays: of the torque behind the position, as the longest of the fitted recordings has
            them; None where that cannot be determined.
        masked: rows of `fitted` that do not count, per joint (n,), by the first reason against
            them, in words.
        rows: time samples of `fitted`.
        notes: what was found and done, in sentences.
    """

    sources: Sources
    fitted: tuple[Samples, ...]
    training: tuple[Samples, ...]
    held_out: tuple[Samples, ...]
    settings: Settings
    delays: DelayEstimate | None
    masked: Mapping[str, NDArray[np.intp]]
    rows: int
    notes: tuple[str, ...]

    @property
    def assumed_delay(self) -> Array:
        """What the fit took the delay of each axis to be (n,) [s]."""
        return self.settings.delays(len(self.sources.cell.joint_names))

    @property
    def commanded(self) -> tuple[Array | None, ...]:
        """Commanded positions (m, n) in the rows of each of `fitted`, NaN where there are none."""
        return tuple(source.recording.commanded_position for source in self.sources.training)


def prepare_sources(sources: Sources, options: Options, reporter: Reporter) -> Prepared:
    """Smooth every recording, after its time base, noise, delay and settings are decided.

    Only what is fitted is looked at to decide them.

    Args:
        sources: the recordings.
        options: how they are turned into samples.
        reporter: of progress.

    Raises:
        ArchiveError: there are currents only, and nothing that could make torques of them.
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was asked for and there is not one usable row.
    """
    notes = _time_bases(sources)
    sources, noise = with_noise(sources)
    sources = with_torques(sources)
    return _applied(sources, decide(sources, options, reporter), (*notes, noise), reporter)


def _applied(
    sources: Sources, decided: Decided, notes: Sequence[str], reporter: Reporter
) -> Prepared:
    settings, cell = decided.settings, decided.settings.law(sources.cell)

    def signals(some: Sequence[Source]) -> tuple[Source, ...]:
        return tuple(signals_of(source, settings) for source in some)

    sources = replace(
        sources, cell=cell, training=signals(sources.training), held_out=signals(sources.held_out)
    )
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
    masked, rows = _masked(fitted), sum(len(one.torque) for one in fitted)
    return Prepared(
        sources=sources,
        fitted=tuple(fitted),
        training=tuple(training),
        held_out=tuple(training if sources.in_sample else held_out),
        settings=settings,
        delays=decided.delays,
        masked=masked,
        rows=rows,
        notes=(*notes, *decided.notes, *_left_out(sources, masked, rows)),
    )


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
