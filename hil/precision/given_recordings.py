"""Information of earlier recordings, which a designed motion adds to.

Not imported by the package: what reads archives also reads designs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hil.archive import open_archive
from hil.base.errors import InputError
from hil.cell import Cell
from hil.design.settings import SettingsError
from hil.pipeline.options import Options
from hil.pipeline.prepared import executed_rows, samples_of, stated_settings
from hil.pipeline.sources import Source, archives_in, arm_differences, gather_sources
from identification.excitation import Given, Objective
from identification.excitation.constraints import SAMPLE_PERIOD


def given_sources(cell: Cell, paths: Sequence[Path]) -> tuple[Source, ...]:
    """Return the recordings of archives or folders; of a campaign its excitations.

    Raises:
        InputError: the archives cannot be read, or are of another arm.
    """
    every = list(archives_in(paths))
    fitted = [path for path in every if open_archive(path).header.purpose != "validation"]
    sources = gather_sources(fitted or every, Options().split, in_sample=True)
    if differing := arm_differences(cell, sources.cell):
        raise SettingsError(
            paths[0],
            f"belongs to another arm than {cell.path}: {' and '.join(differing)} differ",
            field="--given",
            remedy="give recordings of this arm",
        )
    return sources.training


def given_of(cell: Cell, paths: Sequence[Path]) -> Given:
    """Return the information of archives, or of the archives in folders, on a cell's parameters.

    Of a campaign its excitations count: the validation runs are never fitted.

    Raises:
        InputError: the archives cannot be read, have no motion, or are of another arm.
    """
    options = Options()
    objective = Objective(cell.model)
    settings = stated_settings(cell, options)
    total = np.zeros((cell.model.n_parameters, cell.model.n_parameters))
    count = 0
    duration = 0.0
    for source in given_sources(cell, paths):
        samples = samples_of(source, cell, settings)
        motion = samples.motion.rows(executed_rows(source, samples))
        if motion.n_samples < 2:
            continue
        seconds = float(motion.time[-1] - motion.time[0])
        stride = max(1, int(SAMPLE_PERIOD * (motion.n_samples - 1) / seconds))
        # As the objective has it of the motion that is designed: all executed rows.
        part = motion.rows(slice(None, None, stride))
        total += objective.information(part)
        count += part.n_samples
        duration += seconds
    if count == 0:
        raise InputError(
            paths[0], "nothing moves in the recordings", field="--given", remedy="omit them"
        )
    return Given(total / count, duration)
