"""Information of earlier archives, added to that of the motion in a sequential design."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.cell import Cell
from hil.errors import InputError
from hil.files import file_digest
from hil.identify.estimating import estimate_with
from hil.identify.options import FIXED
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.settings import samples_of
from hil.identify.sources import archives_in, cell_of, gather_sources
from hil.progress import Reporter
from identification.excitation import SAMPLE_PERIOD
from identification.factor.factor import Factor

from .problem import EarlierEstimate
from .result import fingerprint

Array = NDArray[np.float64]

_MOTIONS: Final = ("excitation", "imported", "validation")


def estimate_earlier(paths: Sequence[Path], cell: Cell, reporter: Reporter) -> EarlierEstimate:
    """Identify the parameters of a cell from archives, folders of them, or campaigns.

    Raises:
        InputError: archives that cannot be identified from, or of another robot.
    """
    archives = list(archives_in(paths))
    recorded = cell_of(open_archive(archives[0]))
    recorded_parts, parts = fingerprint(recorded), fingerprint(cell)
    for part in ("urdf", "robot"):  # these determine the parameters
        if recorded_parts[part] != parts[part]:
            problem = f"is of the cell {recorded.name!r}, whose {part} is not that of {cell.name!r}"
            remedy = "name archives of this robot with the same URDF and [robot]"
            raise InputError(archives[0], problem, field="--earlier", remedy=remedy)
    sources = gather_sources(archives, FIXED.split, in_sample=True)
    prepared = prepare_sources(sources, FIXED, reporter)
    pooled = estimate_with(prepared, FIXED, reporter).result.pooled
    weights = _weights(pooled.noise_std, cell, reporter)
    gram, samples = _information(prepared, weights, reporter)
    return EarlierEstimate(
        names=pooled.names,
        values=pooled.values,
        std=pooled.std,
        joint_weights=weights,
        gram=gram,
        samples=samples,
        repetitions=cell.campaign.repetitions,
        archives=tuple(
            (path.name, file_digest(path))
            for path in archives
            if open_archive(path).kind in _MOTIONS
        ),
    )


def _information(prepared: Prepared, weights: Array, reporter: Reporter) -> tuple[Array, int]:
    """Return the weighted Gram (p, p) of all motions at one sample per SAMPLE_PERIOD, and their N.

    As for a planned motion without delay and low-pass of the torque.
    """
    cell = prepared.sources.cell
    model, motions = cell.model, prepared.sources.training
    settings = prepared.settings.preprocessed(torque_delay=0.0, torque_bandwidth=None)
    gram, samples = np.zeros((model.n_parameters, model.n_parameters)), 0.0
    with reporter.task("adding earlier information", len(motions)) as task:
        for source in motions:
            share = float(np.median(np.diff(source.recording.time))) / SAMPLE_PERIOD
            factor = Factor.of(model, samples_of(source, cell, settings))
            gram += share * factor.weighted(weights).A
            samples += share * float(factor.samples.max())
            task.advance(1, source.name)
    return gram, max(1, round(samples))


def _weights(noise_std: Array, cell: Cell, reporter: Reporter) -> Array:
    """Return 1 / variance of each joint's torque residual (n,).

    A joint that was at rest in all archives gets the median of the others, relative to the torque
    of their motors, if that is known.
    """
    noise = noise_std.copy()
    known = np.isfinite(noise) & (noise > 0.0)
    if not known.all():
        strength = np.ones(len(noise))
        if cell.file.drive_train is not None:
            drives = cell.drive_train
            motors = drives.torque_constant * drives.current_limit
            strength = np.abs(drives.motor_from_joint.T) @ motors
        noise[~known] = strength[~known] * np.median(noise[known] / strength[known])
        names = ", ".join(cell.joint_names[j] for j in np.flatnonzero(~known))
        reporter.say(
            f"warning: {names} never moved in the earlier archives; its torque noise is assumed "
            "to be that of the others, in proportion to the torque of its motors"
        )
    return np.asarray(noise**-2.0)
