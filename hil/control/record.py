"""Recording of motions that the controller's own program executes."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.archive import CONTROLLER_PROGRAM, ArchiveName, ArchiveSpec, open_archive
from hil.archive.schema import UR_STATE
from hil.base.errors import InputError
from hil.base.files import make_folder
from hil.base.version import software
from hil.cell import Cell
from identification.signals.noise import STANDSTILL_WINDOW_SECONDS

if TYPE_CHECKING:
    from hil.archive.recorder import Recorded
    from hil.control.link import MotionLink, Watch
    from hil.control.motion_watch import Stop

KINDS = ("excitation", "validation", "standstill")


def record(
    link: MotionLink,
    cell: Cell,
    path: Path,
    *,
    kind: str,
    stop: Stop,
    duration: float | None = None,
    wait: float | None = None,
    watch: Watch = lambda _: None,
    durable: bool = True,
) -> Recorded:
    """Record the session of the controller from its first cycle, without requesting any motion.

    Args:
        link: to the controller.
        cell: of the arm.
        path: of the archive.
        kind: one of `KINDS`.
        stop: ends the recording, as does the end of the session.
        duration: of the controller's time, after which it ends [s].
        wait: longest time for the controller to start [s].
        watch: of the recording.
        durable: each flush waits for the disk.

    Raises:
        ControllerError: the controller did not start in time, or does not match the cell.
        OperatorStopError: stopped before it started.
        ArchiveWriteError: the archive cannot be written.
    """
    metadata = {"motion": CONTROLLER_PROGRAM, **kind_entry(path, kind), **origin_of(cell)}
    spec = archive_spec(cell, path, metadata, durable=durable)
    return link.record(spec, stop, duration=duration, wait=wait, watch=watch)


def moved_joints(path: Path, cell: Cell) -> tuple[str, ...]:
    """Return the joints that moved in an archive.

    Their mean position changed faster than the cell's standstill speed between two neighbouring
    windows of `STANDSTILL_WINDOW_SECONDS`.

    Raises:
        ArchiveError: the archive cannot be read.
    """
    position = open_archive(path, fields=("position",)).recorded("position")["position"]
    width = max(1, round(STANDSTILL_WINDOW_SECONDS / cell.period))
    windows = position[: len(position) // width * width].reshape(-1, width, position.shape[1])
    steps = np.abs(np.diff(windows.mean(axis=1), axis=0)).max(axis=0, initial=0.0)
    moved = steps > STANDSTILL_WINDOW_SECONDS * cell.model.friction.standstill
    return tuple(itertools.compress(cell.joint_names, moved))


def archive_spec(
    cell: Cell,
    path: Path,
    metadata: Mapping[str, str],
    plan: Mapping[str, Any] | None = None,
    *,
    durable: bool,
) -> ArchiveSpec:
    """Return the specification of an archive with cell, URDF, drive train and plan attached.

    Args:
        cell: of the arm, whose name is added to the metadata.
        path: of the archive.
        metadata: of the archive.
        plan: of the motion; a motion of the controller's own program has none.
        durable: each flush waits for the disk.
    """
    attachments = {
        "cell.toml": cell.text.encode(),
        "robot.urdf": cell.urdf.encode(),
        "drive_train.json": cell.drive_table.model_dump_json().encode(),
    }
    if plan is not None:
        attachments["plan.json"] = json.dumps(plan).encode()
    return ArchiveSpec(
        path,
        joint_names=cell.joint_names,
        period=cell.period,
        metadata={"cell": cell.name, **metadata},
        attachments=attachments,
        durable=durable,
        states=(UR_STATE,) if cell.is_ur else (),
    )


def archive_path(output: Path, kind: str) -> Path:
    """Return `output` if it ends in .mcap, else the next file name in that folder.

    Raises:
        InputError: the file exists, or the folder cannot be created.
    """
    if output.suffix == ".mcap":
        if output.exists():
            raise InputError(output, "exists already", remedy="archives are never overwritten")
        name = ArchiveName.parse(output)
        if name is not None and name.kind != kind:
            problem = f"is the name of a {name.kind}"
            raise InputError(output, problem, remedy=f"add --kind {name.kind}")
        make_folder(output.parent)
        return output
    make_folder(output)
    index = 0
    while list(output.glob(f"{kind}_{index:03d}_a*.mcap")):
        index += 1
    return output / ArchiveName(kind, index)


def kind_entry(path: Path, kind: str) -> dict[str, str]:
    """Return the kind as metadata, {} if the file name contains it."""
    return {} if ArchiveName.parse(path) is not None else {"kind": kind}


def origin_of(
    cell: Cell, *, only_simulated: bool | None = None, virtual: bool | None = None
) -> dict[str, str]:
    """Return origin, date (none in virtual time) and software of a recording as metadata.

    Whether only a simulated arm can move and whether time is virtual follow from the cell's link
    by default.
    """
    if only_simulated is None:
        only_simulated = cell.only_simulated
    if virtual is None:
        virtual = cell.controller.transport == "simulated"
    return {
        "simulated": "yes" if only_simulated else "no",
        **({} if virtual else {"recorded_at": _now()}),
        **{f"software.{name}": version for name, version in software().items()},
    }


def with_present_date(metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the metadata with the present date, if it has a date."""
    return {**metadata, **({"recorded_at": _now()} if "recorded_at" in metadata else {})}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
