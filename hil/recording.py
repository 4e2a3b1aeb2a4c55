"""Recording a motion that the controller's own program makes: answered safely, archived whole."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.archive import CONTROLLER_PROGRAM, ArchiveName, ArchiveSpec
from hil.cell import Cell
from hil.errors import InputError
from hil.files import make_folder
from hil.version import software

if TYPE_CHECKING:
    from hil.campaign.motion_link import MotionLink, Recorded, Watch
    from hil.campaign.operator import Stop

KINDS = ("excitation", "validation", "standstill")
"""What a recording can be used for."""


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
    """Record what the controller does, from its first cycle on. No motion is ever requested.

    The cell travels in the archive, which must not exist and is of a kind of `KINDS`. It lasts for
    a `duration` of the controller's time [s], or until `stop` or the session's end; the controller
    is waited for as long as `wait` says [s]. If `durable`, each flush waits for the disk.

    Raises:
        ControllerFault: the controller did not come in time, or is not the cell's.
        OperatorStopError: stopped before it came.
        ArchiveWriteError: the archive cannot be written.
    """
    metadata = {"motion": CONTROLLER_PROGRAM, **kind_entry(path, kind), **origin_of(cell)}
    spec = archive_spec(cell, path, metadata, durable=durable)
    return link.record(spec, stop, duration=duration, wait=wait, watch=watch)


def archive_spec(
    cell: Cell,
    path: Path,
    metadata: Mapping[str, str],
    plan: Mapping[str, Any] | None = None,
    *,
    durable: bool,
) -> ArchiveSpec:
    """An archive of a cell's arm, which needs nothing else to be identified from.

    The cell travels in it with URDF and drive train, and the plan, None for a motion of the
    controller's own; metadata stand beside the cell's name. If `durable`, each flush waits for the
    disk.
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
    )


def archive_path(output: Path, kind: str) -> Path:
    """Where to record: `output` itself if it is called *.mcap, else the next name in that folder.

    Raises:
        InputError: the file exists, or the folder cannot be made.
    """
    if output.suffix == ".mcap":
        if output.exists():
            raise InputError(output, "exists already", remedy="archives are never overwritten")
        name = ArchiveName.parse(output)
        if name is not None and name.kind != kind:
            raise InputError(
                output, f"is the name of a {name.kind}", remedy=f"add --kind {name.kind}"
            )
        make_folder(output.parent)
        return output
    make_folder(output)
    index = 0
    while list(output.glob(f"{kind}_{index:03d}_a*.mcap")):
        index += 1
    return output / ArchiveName(kind, index)


def kind_entry(path: Path, kind: str) -> dict[str, str]:
    """The kind as metadata, where the file's name does not say it."""
    return {} if ArchiveName.parse(path) is not None else {"kind": kind}


def origin_of(
    cell: Cell, *, only_simulated: bool | None = None, virtual: bool | None = None
) -> dict[str, str]:
    """As metadata: where, when and with what it was recorded; virtual time has no date.

    Of the link that is really used: whether only a simulated arm can move, and whether time is
    virtual; what is left out is as the cell's own link says.
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
    """The same, for an archive that begins now; what has no date gets none."""
    return {**metadata, **({"recorded_at": _now()} if "recorded_at" in metadata else {})}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
