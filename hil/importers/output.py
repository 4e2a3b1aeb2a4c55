"""The last step of every importer: samples are checked and become an archive."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Final, Literal

import numpy as np

from hil.archive import Samples, write_samples
from hil.errors import SourceError
from hil.importers.findings import clock_fault, examine
from hil.importers.robot import Robot
from hil.io import file_digest

Use = Literal["excitation", "validation", "standstill"]

_MOST: Final = 1e12
"""Of any quantity: no arm has more, in whatever unit, and sums of squares of it do not overflow."""


def write_imported(
    output: str | PathLike[str],
    samples: Samples,
    *,
    source: Sequence[Path],
    robot: Robot,
    metadata: Mapping[str, str],
    held_joints: Sequence[str] = (),
    period: float | None = None,
    use: Use = "excitation",
    clock: Path | None = None,
) -> Path:
    """Write the samples of a recording, joints in the order of the robot's, as an archive.

    What they look like (:mod:`hil.importers.findings`) goes into its metadata.

    Args:
        output: the archive.
        samples: joint side, SI units.
        source: the files they come from.
        robot: whose they are.
        metadata: what else is to be stored of them.
        held_joints: joints known to have been held still.
        period: step [s] of a recording at a fixed rate.
        use: what identification may do with them: fit, only predict, or take the noise from.
        clock: the file that the stamps come from; None for the first.

    Raises:
        SourceError: no sample, a value that is not finite or beyond 1e12, or a clock that stands
            still, runs backwards or steps too seldom for a motion.
        ArchiveWriteError: the archive cannot be written.
    """
    _check(samples, source[0], robot.joint_names)
    if (fault := clock_fault(samples.stamp)) is not None:
        raise SourceError(clock or source[0], fault.problem, field="time", remedy=fault.remedy)
    unknown = [name for name in held_joints if name not in robot.joint_names]
    if unknown:
        raise SourceError(
            source[0],
            f"no joint is called {unknown[0]!r}",
            field="held joints",
            remedy=f"the robot's joints are {', '.join(robot.joint_names)}",
        )
    findings = examine(samples, robot.joint_names, robot.urdf, locked=robot.locked)
    entries = {
        **metadata,
        "source": json.dumps([path.name for path in source]),
        "source_sha256": json.dumps([file_digest(path) for path in source]),
        "held_joints": json.dumps(list(held_joints)),
        "use": use,
        "findings": json.dumps(findings.model_dump()),
    }
    return write_samples(
        output,
        samples,
        joint_names=robot.joint_names,
        metadata=entries,
        attachments=robot.attachments(),
        period=period,
    )


def _check(samples: Samples, source: Path, joints: Sequence[str]) -> None:
    if not len(samples.stamp):
        raise SourceError(source, "holds no sample")
    quantities = {
        "position": samples.position,
        "velocity": samples.velocity,
        "torque": samples.torque,
        "motor current": samples.motor_current,
    }
    elapsed = (samples.stamp - samples.stamp[0]) * 1e-9
    for name, values in quantities.items():
        if values is None:
            continue
        rows, columns = np.nonzero(~(np.abs(values) <= _MOST))
        if rows.size:
            raise SourceError(
                source,
                f"{name} of joint {joints[columns[0]]} is {values[rows[0], columns[0]]} in sample "
                f"{rows[0]} ({elapsed[rows[0]]:.6g} s; {rows.size} such values)",
                remedy="cut the recording there, or leave the quantity out (numbers up to "
                f"{_MOST:g} can be used)",
            )
