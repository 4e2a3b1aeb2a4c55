"""What earlier archives say already, for a design that concentrates on what is still uncertain.

The paper designs one motion. Information adds up: the Gram matrix of what was recorded joins that
of the motion to be designed, each joint weighted by what its torque noise turned out to be.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.archive import open_archive
from hil.campaign.folder import CampaignFolder
from hil.cell import Cell
from hil.errors import InputError
from hil.identify import Identification, identify_archives, identify_campaign
from hil.identify.sources import cell_of
from hil.progress import Reporter
from hil.recordings import recording_of
from identification.excitation import SAMPLE_PERIOD

from .fingerprint import fingerprint
from .knowledge import Knowledge

Array = NDArray[np.float64]

_KINDS = ("excitation", "validation", "standstill")


def known_from(paths: Sequence[Path], cell: Cell, reporter: Reporter) -> Knowledge:
    """Identify from archives, and return what they say about each parameter.

    Args:
        paths: one campaign folder, or archives.
        cell: for which a motion is going to be designed.
        reporter: is told how far it is.

    Raises:
        InputError: archives that cannot be identified from, or of another robot.
    """
    archives = _archives(paths)
    _refuse_another_robot(archives, cell)
    if len(paths) == 1 and paths[0].is_dir() and CampaignFolder(paths[0]).manifest():
        found = identify_campaign(paths[0], reporter)
    else:
        found = identify_archives(archives, reporter)
    pooled, weights = found.estimate.pooled, _weights(found, archives[0])
    # A search samples its motions every SAMPLE_PERIOD; a second of either is to count alike.
    share = _period(archives[0]) / SAMPLE_PERIOD
    factor = found.estimate.factor
    return Knowledge(
        names=pooled.names,
        values=pooled.values,
        std=pooled.std,
        joint_weights=weights,
        gram=share * factor.weighted(weights).A,
        samples=max(1, round(share * float(factor.samples.max()))),
        repetitions=cell.campaign.repetitions,
        archives=tuple((path.name, _digest(path)) for path in archives),
    )


def _archives(paths: Sequence[Path]) -> list[Path]:
    """Return the archives of a folder, or those named."""
    if len(paths) == 1 and paths[0].is_dir():
        folder = CampaignFolder(paths[0])
        found = [path for kind in _KINDS for path in folder.completed(kind)]
        found = found or sorted(paths[0].glob("*.mcap"))
        if not found:
            raise InputError(
                paths[0], "holds no whole archive", remedy="name a campaign folder, or archives"
            )
        return found
    for path in paths:
        if path.is_dir():
            raise InputError(
                path, "is a folder among archives", remedy="name one campaign folder, or files"
            )
    return list(paths)


def _refuse_another_robot(archives: Sequence[Path], cell: Cell) -> None:
    """The parameters of archives and cell are the same ones."""
    recorded = cell_of(open_archive(archives[0]))
    theirs, ours = fingerprint(recorded), fingerprint(cell)
    for part in ("urdf", "robot"):
        if theirs[part] != ours[part]:
            raise InputError(
                archives[0],
                f"is of the cell {recorded.name!r}, whose {part} is not that of {cell.name!r}",
                field="--earlier",
                remedy="name archives of this robot, in the same description",
            )


def _weights(found: Identification, path: Path) -> Array:
    """Return 1 / variance of each joint's residual (n,)."""
    deviation = found.estimate.pooled.noise_std
    if not np.all(np.isfinite(deviation) & (deviation > 0.0)):
        raise InputError(
            path,
            "a joint never moves in the earlier archives, so that nothing is known of its noise",
            field="--earlier",
            remedy="name archives in which every joint moves",
        )
    return np.asarray(deviation**-2.0)


def _period(path: Path) -> float:
    """Return the time between the samples of an archive [s]."""
    return float(np.median(np.diff(recording_of(open_archive(path)).time)))


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
