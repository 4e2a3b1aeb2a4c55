"""The content of an imported recording, examined and written: the last step of every importer."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from hil.archive import Archive, ImportedSamples, imported_archive, write_archive
from hil.base.errors import ArchiveWriteError, SourceError
from hil.base.files import file_digest, make_folder, replace_file
from hil.base.safe_input import path_exists
from hil.importers.conclusions import Conclusion, Examined, Excerpt, RecordedClock
from hil.importers.excerpt import excerpt_of
from hil.importers.imported_robot import Robot
from hil.importers.messages import as_findings
from hil.importers.plausibility import (
    check_positions,
    examine,
)
from hil.importers.stamps import check_clock

Use = Literal["excitation", "validation", "standstill"]

_MAX_MAGNITUDE: Final = 1e12
"""Largest value of any quantity, in any unit; sums of its squares do not overflow."""


def require_writable(output: Path, source: Sequence[Path], *, force: bool) -> None:
    """Raise ArchiveWriteError for an output that is a recording, or exists without `force`."""
    if any(output.resolve() == path.resolve() for path in source):
        problem = "is the recording itself"
        remedy = "choose another name (-o)"
        raise ArchiveWriteError(output, problem, remedy=remedy)
    if not force and path_exists(output):
        remedy = "choose another name (-o), or replace it with --force"
        raise ArchiveWriteError(output, "exists already", remedy=remedy)


def _require_joints(held_joints: Sequence[str], robot: Robot, source: Path) -> None:
    """Raise SourceError for held joints that the robot does not have."""
    unknown = [name for name in held_joints if name not in robot.joint_names]
    if unknown:
        problem = f"no joint is called {unknown[0]!r}"
        remedy = f"the robot's joints are {', '.join(robot.joint_names)}"
        raise SourceError(source, problem, field="held joints", remedy=remedy)


@dataclass(frozen=True, eq=False)
class RecordingContent:
    """A recording of another program, read and not yet written as an archive.

    Attributes:
        samples: of the joint side in SI units, joints in the robot's order.
        source: the files that it was read from.
        metadata: further entries of the archive.
        concluded: what was concluded and left out.
        period: sampling step [s] of a recording at a fixed rate.
        clock: the file that the stamps come from, by default the first `source`.
        clock_remedy: in place of the remedies for an invalid clock of a log.
    """

    samples: ImportedSamples
    robot: Robot
    source: tuple[Path, ...]
    metadata: Mapping[str, str]
    concluded: tuple[Conclusion, ...] = ()
    period: float | None = None
    clock: Path | None = None
    clock_remedy: str | None = None

    def write(
        self,
        output: str | PathLike[str],
        *,
        held_joints: Sequence[str] = (),
        use: Use = "excitation",
        force: bool = False,
        outside_limits: bool = False,
    ) -> Examined:
        """Write the recording as an archive, and return what was found in it.

        Args:
            output: path of the archive.
            held_joints: joints that were clamped.
            use: of the recording.
            force: replace an existing archive once the new one is complete.
            outside_limits: as of :meth:`archive`.

        Raises:
            SourceError: as of :meth:`archive`.
            ArchiveWriteError: the archive exists or cannot be written.
        """
        require_writable(Path(output), self.source, force=force)
        archive, found = self.archive(
            Path(output), held_joints=held_joints, use=use, outside_limits=outside_limits
        )
        write_to(Path(output), archive, force=force)
        return found

    def archive(
        self,
        path: Path,
        *,
        held_joints: Sequence[str] = (),
        use: Use = "excitation",
        outside_limits: bool = False,
    ) -> tuple[Archive, Examined]:
        """Return the recording as an archive in memory, and what was found in it.

        The archive has the same in words.

        Args:
            path: of the file that may be written.
            held_joints: joints that were clamped.
            use: of the recording.
            outside_limits: accept positions of which no row is within the limits of the URDF.

        Raises:
            SourceError: no sample, a value that is not finite or above 1e12, an invalid clock, or
                no row within the limits of the URDF.
        """
        samples = self.samples
        source = self.source
        robot = self.robot
        _check(samples, source[0], robot.joint_names)
        check_clock(samples.stamp, self.clock or source[0], self.clock_remedy)
        if not outside_limits:
            check_positions(samples.position, robot.joint_names, robot.urdf, source[0])
        _require_joints(held_joints, robot, source[0])
        found = self._examined(held_joints)
        entries = {
            **self.metadata,
            "source": json.dumps([path.name for path in source]),
            "source_sha256": json.dumps([file_digest(path) for path in source]),
            "held_joints": json.dumps(list(held_joints)),
            "use": use,
            "findings": json.dumps(as_findings(found).model_dump()),
        }
        archive = imported_archive(
            path,
            samples,
            joint_names=robot.joint_names,
            metadata=entries,
            attachments=robot.attachments(),
            period=self.period,
        )
        return archive, found

    def excerpt(self, longest: int) -> RecordingContent:
        """Return stretches of a long recording; see :func:`hil.importers.excerpt.excerpt_of`."""
        samples = self.samples
        chosen = excerpt_of(samples.stamp, samples.position, longest)
        if chosen is None:
            return self
        arrays = {each.name: getattr(samples, each.name) for each in fields(samples)}
        excerpt: dict[str, Any] = {
            name: None if values is None else values[chosen.rows] for name, values in arrays.items()
        }
        read = [each.total for each in self.concluded if isinstance(each, Excerpt)]
        others = (each for each in self.concluded if not isinstance(each, Excerpt))
        total = max([len(samples.stamp), *read])
        said = Excerpt(len(chosen.rows), total, chosen.stretches)
        return replace(self, samples=ImportedSamples(**excerpt), concluded=(*others, said))

    def _examined(self, held_joints: Sequence[str]) -> Examined:
        """Return the findings of an import, what was concluded first."""
        found = examine(
            self.samples,
            self.robot.joint_names,
            self.robot.urdf,
            locked=self.robot.locked,
            nominal=self.robot.nominal_torque(),
            held_joints=held_joints,
        )
        findings = found.found
        if any(isinstance(each, Excerpt) for each in self.concluded):
            findings = tuple(map(_without_gaps, findings))
        return Examined((*self.concluded, *findings), found.warnings)


def _without_gaps(found: Conclusion) -> Conclusion:
    """Return a finding of an excerpt; parts that were not read are no gaps of the recording."""
    if not isinstance(found, RecordedClock):
        return found
    return replace(found, base=replace(found.base, gaps=0, pauses=0))


def write_to(output: Path, archive: Archive, *, force: bool) -> None:
    """Write an archive in memory to a file; with `force` it replaces another once it is complete.

    Raises:
        ArchiveWriteError: the archive exists or cannot be written.
    """
    make_folder(output.parent)
    with _replaced(output) if force else nullcontext(output) as path:
        write_archive(archive, path)


@contextmanager
def _replaced(output: Path) -> Iterator[Path]:
    """Replace an archive by the yielded one; errors then name the archive."""
    try:
        with replace_file(output) as temporary:
            yield temporary
    except OSError as error:
        problem = f"cannot be replaced ({error.strerror})"
        raise ArchiveWriteError(output, problem, remedy="choose another name (-o)") from error


def _check(samples: ImportedSamples, source: Path, joints: Sequence[str]) -> None:
    if not len(samples.stamp):
        raise SourceError(source, "has no sample")
    quantities = {
        "position": samples.position,
        "velocity": samples.velocity,
        "torque": samples.torque,
        "motor current": samples.motor_current,
        "commanded position": samples.commanded_position,
    }
    for name, values in quantities.items():
        if values is None:
            continue
        wrong = ~(np.abs(values) <= _MAX_MAGNITUDE)
        if values is samples.commanded_position:
            wrong &= ~np.isnan(values)  # where nothing was commanded
        rows, columns = np.nonzero(wrong)
        if rows.size:
            row = rows[0]
            column = columns[0]
            elapsed = (samples.stamp[row] - samples.stamp[0]) * 1e-9
            problem = (
                f"{name} of joint {joints[column]} is {values[row, column]} in sample {row} "
                f"({elapsed:.6g} s; {rows.size} such values)"
            )
            remedy = (
                f"cut the recording there, or leave out the quantity (largest: {_MAX_MAGNITUDE:g})"
            )
            if not np.isfinite(values[row, column]):
                remedy += ', or of a log such rows: --drop-missing, or [format] missing = "drop"'
            raise SourceError(source, problem, remedy=remedy)
