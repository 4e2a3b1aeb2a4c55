"""Preparation: from recordings to samples."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hil.errors import ArchiveError
from hil.progress import Reporter
from identification.estimators.delay import DelayEstimate
from identification.signals.clock import time_base
from identification.signals.recording import Recording
from identification.signals.samples import Samples
from planner.arrays import numbers

from .options import Options
from .settings import Settings, decide, samples_of, validation_samples
from .sources import Sources

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prepared:
    """Samples of all sources, and the settings that made them."""

    sources: Sources  #: with the chosen friction law, and warnings of the preparation
    fitted: tuple[Samples, ...]  #: for the fit
    training: tuple[Samples, ...]  #: the same recordings for the verdict: torques as recorded
    held_out: tuple[Samples, ...]  #: for the verdict; `training` if nothing was held out
    settings: Settings  #: of `fitted`
    #: delay of the torque in the longest fitted recording; None if it cannot be determined
    delays: DelayEstimate | None
    masked: Mapping[str, NDArray[np.intp]]  #: excluded rows of each joint (n,), by reason
    rows: int  #: time samples of `fitted`
    notes: tuple[str, ...]  #: decisions, one sentence each

    @property
    def assumed_delay(self) -> float:
        """Delay of the torque that the fit used [s]."""
        return self.settings.preprocessing.torque_delay


def prepare_sources(sources: Sources, options: Options, reporter: Reporter) -> Prepared:
    """Determine time base, noise, delay and settings, then smooth every recording.

    Settings depend on the fitted recordings only.

    Raises:
        ArchiveError: there are currents only, and no way to convert them to torques.
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was requested and no row is usable.
    """
    notes = []
    for source in (*sources.training, *sources.held_out):
        notes += [f"{source.name}: {line}" for line in (source.merged, *source.clock) if line]
        base = time_base(source.recording.time, source.recording.gap_before)
        if not base.uniform or base.gaps:
            notes.append(f"{source.name}: {'; '.join(base.describe())}")
    _require_torques(sources)
    noise = "the noise of the positions was estimated from their high-frequency part"
    if sources.noise_variance is not None:
        noise = "the noise of the positions was measured at standstill"
    decided = decide(sources, options, reporter)
    settings, cell = decided.settings, decided.settings.with_friction_law(sources.cell)
    sources = replace(sources, cell=cell)
    unseen = () if sources.in_sample else sources.held_out
    with reporter.task("smoothing recordings", len(sources.training) + len(unseen)) as task:
        fitted, held_out = [], []
        for source in sources.training:
            fitted.append(samples_of(source, cell, settings))
            task.advance(1, source.name)
        for source in unseen:
            held_out.append(validation_samples(source, cell, settings))
            task.advance(1, source.name)
    if settings.preprocessing.smooth_torque:
        training = [validation_samples(source, cell, settings) for source in sources.training]
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
        notes=(*notes, noise, *decided.notes, *_excluded(sources, masked, rows)),
    )


def _excluded(sources: Sources, masked: Mapping[str, NDArray[np.intp]], rows: int) -> list[str]:
    total = rows * len(sources.cell.joint_names)
    shares = {
        reason: int(counts.sum()) / total for reason, counts in masked.items() if counts.any()
    }
    if not shares:
        return []
    parts = ", ".join(f"{share:.2%} {reason}" for reason, share in shares.items())
    return [
        f"of {total} rows (one joint at one sample) {1.0 - sum(shares.values()):.1%} were fitted; "
        f"excluded: {parts}"
    ]


def motor_from_joint(recording: Recording) -> Array:
    """Motor angles per joint angle (n, n) as imported, by default the identity."""
    stored = recording.provenance.get("motor_from_joint")
    return np.eye(recording.n_joints) if stored is None else numbers(json.loads(stored), 2)


def _require_torques(sources: Sources) -> None:
    """Raise ArchiveError if a recording has currents only."""
    if any(one.recording.torque is None for one in (*sources.training, *sources.held_out)):
        raise ArchiveError(
            None,
            "the recordings contain no torques",
            field="torque",
            remedy="give drive.torque_constant in the column map, or identify it by `hil gains`",
        )
