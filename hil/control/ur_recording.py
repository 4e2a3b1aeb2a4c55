"""Recording of a Universal Robots arm: all its outputs, whatever moves it meanwhile.

Nothing is sent to the arm but the request for its outputs, and questions to its dashboard.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from drivers.cycle_records import ARM_STATE
from drivers.errors import DriverError
from drivers.events import ControllerRemark
from drivers.states import State
from drivers.ur.cycles import CycleCounter
from drivers.ur.description import UrDescription, identity_document
from drivers.ur.identity import ArmIdentity, ask_identity
from drivers.ur.outputs import (
    FREEDRIVE_BIT,
    N_JOINTS,
    ROBOT_MODES,
    RUNTIME_STATES,
    SAFETY_MODES,
    SAFETY_NORMAL,
)
from drivers.ur.reader import OutputFrames, RtdeReader
from drivers.ur.torque_constants import RELATIVE_UNCERTAINTY, by_size, stated_constants
from drivers.ur.transport import RtdeSpec
from hil.archive import CONTROLLER_PROGRAM, open_archive
from hil.archive.recorder import Recorded
from hil.archive.schema import Level
from hil.archive.writer import ArchiveWriter
from hil.base.arrays import Array
from hil.base.errors import ControllerError, OperatorStopError
from hil.cell import Cell
from hil.control.link import Progress, Watch, recording_end
from hil.control.motion_watch import Stop
from hil.control.record import archive_spec, kind_entry, origin_of

_LOOK_PERIOD: Final = 0.1
"""Time between two looks at what arrived, s."""
_FIRST_FRAME_TIMEOUT: Final = 5.0
"""Longest wait for the first frame, s."""
_RETRY_PERIOD: Final = 0.5
"""Time between two attempts to connect, s."""
_RELATIVE_TOLERANCE: Final = 0.01
"""Relative difference of torque constants that is not reported."""


@dataclass(frozen=True, eq=False)
class ArmListener:
    """A connection that reads the outputs of an arm.

    Attributes:
        reader: of its outputs.
        identity: who it is.
        notes: what a person should know before it is recorded, a sentence each.
    """

    reader: RtdeReader
    identity: ArmIdentity
    notes: tuple[str, ...]


@contextmanager
def listening(
    cell: Cell,
    *,
    stop: Stop,
    wait: float | None = None,
    report: Callable[[str], object] = lambda _: None,
) -> Iterator[ArmListener]:
    """Connect to the arm of a cell, and check its identity.

    Args:
        cell: with transport "rtde".
        stop: ends the wait.
        wait: time for the controller to accept the connection [s]; None for one attempt.
        report: receives what is waited for.

    Raises:
        CellError: the cell is not one of such an arm.
        ControllerError: there is no controller, or it belongs to another arm.
        OperatorStopError: stopped before it was connected.
    """
    spec = _spec_of(cell)
    table = cell.controller.rtde
    with _connected(spec, stop, wait, report) as reader:
        identity = ask_identity(
            spec.host, primary=table.primary_port, dashboard=table.dashboard_port
        )
        _require_same_arm(cell, reader, identity)
        notes = [f"not asked: {text}" for text in identity.unreachable]
        notes += _unchecked(cell, identity)
        if reader.absent:
            notes.append(f"this version does not send {', '.join(reader.absent)}")
        yield ArmListener(reader, identity, tuple(notes))


def record_arm(
    arm: ArmListener,
    cell: Cell,
    path: Path,
    *,
    kind: str,
    stop: Stop,
    duration: float | None = None,
    watch: Watch = lambda _: None,
    report: Callable[[str], object] = lambda _: None,
    durable: bool = True,
) -> Recorded:
    """Record all outputs of an arm from the first frame on, whoever moves it.

    Args:
        arm: whose outputs are read.
        cell: of the arm.
        path: of the archive.
        kind: one of `hil.control.record.KINDS`.
        stop: ends the recording.
        duration: time to record [s]; None until a stop.
        watch: is shown the progress.
        report: receives what changes at the controller.
        durable: whether each flush waits for the disk.

    Raises:
        ControllerError: no frame came; nothing was recorded.
        ArchiveWriteError: the archive cannot be written; it is readable up to its last part.
    """
    try:
        arm.reader.start()
        first = arm.reader.fetch(_FIRST_FRAME_TIMEOUT)
    except (DriverError, OSError) as error:
        raise ControllerError(f"{error}: nothing was recorded") from error
    metadata = {
        "motion": CONTROLLER_PROGRAM,
        **kind_entry(path, kind),
        **origin_of(cell),
        **_statements(arm),
    }
    spec = archive_spec(cell, path, metadata, durable=durable)
    identity = json.dumps(identity_document(arm.identity)).encode()
    spec = replace(spec, attachments={**spec.attachments, UrDescription.attachment: identity})
    with spec.open() as writer:
        recording = _Recording(cell, writer, report)
        return recording.run(arm.reader, first, stop, duration, watch)


class _Recording:
    """Fills one archive with frames until an end is found."""

    def __init__(self, cell: Cell, writer: ArchiveWriter, report: Callable[[str], object]) -> None:
        self._cell = cell
        self._writer = writer
        self._report = report
        self._counter = CycleCounter(cell.drive_train, cell.period)
        self._last: np.void | None = None
        self._progress = Progress(0, 0, State.DRIVE_OFF)

    def run(
        self,
        reader: RtdeReader,
        frames: OutputFrames,
        stop: Stop,
        duration: float | None,
        watch: Watch,
    ) -> Recorded:
        limit = None if duration is None else max(1, round(duration / self._cell.period))
        some = round(_LOOK_PERIOD / self._cell.period)
        ending: tuple[str, str] | None = None
        try:
            while ending is None:
                self._add(frames, limit)
                watch(self._progress)
                ending = recording_end(
                    restarted=False,
                    complete=limit is not None and self._writer.newest + 1 >= limit,
                    ended=False,
                    lost="",
                    stopped=stop.requested,
                    limited=duration is not None,
                    refused=None,
                )
                frames = reader.fetch(2.0 * _LOOK_PERIOD, some) if ending is None else frames
        except DriverError as error:  # all frames before it are archived
            ending = "lost", str(error)
        return self._closed(*ending)

    def _add(self, frames: OutputFrames, limit: int | None) -> None:
        """Archive frames up to the limit of cycles."""
        records = self._counter.records(frames)
        for text in frames.texts:
            self._event(ControllerRemark.__name__, f"{text.source}: {text.message}", Level.INFO)
        if limit is not None:
            records = records[records["cycle"] < limit]
        if not len(records):
            return
        torque = self._cell.drive_train.joint_torque(records["target_current"])
        self._writer.write(records, torque)
        self._note_changes(records)
        self._progress = Progress(
            cycles=self._progress.cycles + len(records),
            missed=self._writer.missed,
            state=State(int(records["state"][-1])),
            position=records["position"][-1],
        )

    def _note_changes(self, records: NDArray[np.void]) -> None:
        """Archive and report the changes of modes, and of the payload."""
        for record in records:
            state = record[ARM_STATE]
            for name, text, level in _changes(self._last, state):
                self._event(name, text, level, int(record["cycle"]))
            if self._last is None and (text := _payload_difference(self._cell, state)):
                self._event("Payload", text, Level.WARN, int(record["cycle"]))
            self._last = state

    def _event(self, name: str, text: str, level: Level, cycle: int | None = None) -> None:
        self._writer.event(cycle, name, text, level=level)
        if level is not Level.INFO:
            self._report(text)

    def _closed(self, outcome: str, reason: str) -> Recorded:
        writer = self._writer
        writer.close(outcome, reason=reason, details={"records_lost": "0", "events_lost": "0"})
        return Recorded(
            outcome=outcome,
            reason=reason,
            interval=-1,
            seconds=(writer.newest + 1) * writer.period,
            records=self._progress.cycles,
            records_lost=0,
            events_lost=0,
            missed=writer.missed,
            late=0,
            not_accepted=0,
            disk_waited=writer.file.slowest_flush,
        )


@dataclass(frozen=True, eq=False)
class ConstantsFound:
    """Torque constants that the arm of a recording states at rest, and the cell's.

    Attributes:
        stated: joint torque by current (6,) [N·m/A], gears included; NaN where nothing says it.
        in_cell: constants of the cell (6,), likewise.
        uncertainty: of the cell's, the largest relative standard deviation.
    """

    stated: Array
    in_cell: Array
    uncertainty: float

    @classmethod
    def of(cls, path: Path, cell: Cell) -> Self:
        """Return the constants of an archive; joints of equal largest torque share one.

        Raises:
            ArchiveError: the archive cannot be read.
        """
        names = ("target_moment", "model_current", "target_velocity")
        columns = open_archive(path, fields=names).recorded(*names)
        stated = stated_constants(*(columns[name] for name in names))
        limit = cell.torque_limit
        drives = cell.drive_train
        uncertainty = cell.drive_table.torque_uncertainty
        return cls(
            stated if limit is None else by_size(stated, limit.tolist()),
            drives.torque_constant * np.abs(np.diag(drives.motor_from_joint)),
            float(np.max(RELATIVE_UNCERTAINTY if uncertainty is None else uncertainty)),
        )

    @property
    def differ(self) -> bool:
        """Whether the cell's constants differ from what the arm states."""
        off = np.abs(self.stated - self.in_cell) > _RELATIVE_TOLERANCE * self.in_cell
        return bool((np.isfinite(self.stated) & off).any())

    @property
    def are_doubtful(self) -> bool:
        """Whether nothing better than the arm's own statement is known of them."""
        return self.uncertainty >= RELATIVE_UNCERTAINTY


def _changes(before: np.void | None, now: np.void) -> Iterator[tuple[str, str, Level]]:
    """Yield name, text and level of what differs from the cycle before; all at the first."""
    for field, words, noun in (
        ("robot_mode", ROBOT_MODES, "the robot mode"),
        ("safety_mode", SAFETY_MODES, "the safety mode"),
        ("runtime_state", RUNTIME_STATES, "the program"),
    ):
        value = int(now[field])
        if before is None or value != before[field]:
            warns = field == "safety_mode" and value != SAFETY_NORMAL
            text = f"{noun} is {words.get(value, value)}"
            yield field, text, Level.WARN if warns else Level.INFO
    freedrive = bool(now["robot_status"] >> FREEDRIVE_BIT & 1)
    if freedrive != bool(before is not None and before["robot_status"] >> FREEDRIVE_BIT & 1):
        text = "a person moves the arm (freedrive)" if freedrive else "freedrive has ended"
        yield "freedrive", text, Level.WARN


def _payload_difference(cell: Cell, state: np.void) -> str:
    """Return how the payloads of controller and cell differ, or ""."""
    difference = cell.expected_arm.payload_difference(
        float(state["payload_mass"]), tuple(state["payload_centre"])
    )
    consequence = "what is identified is the arm with all that it carries beyond the cell's"
    return f"{difference}; {consequence}" if difference else ""


def _spec_of(cell: Cell) -> RtdeSpec:
    spec = cell.link_spec
    if not isinstance(spec, RtdeSpec):
        problem = "is not a Universal Robots arm"
        remedy = 'write "rtde", or add --link rtde:HOST'
        raise cell.error("controller.transport", cell.controller.transport, problem, remedy)
    if len(cell.joint_names) != N_JOINTS:
        problem = f"has {len(cell.joint_names)} joints; an arm on RTDE has {N_JOINTS}"
        raise cell.error("cell.urdf", cell.file.cell.urdf, problem, "fix the others in the URDF")
    return spec


@contextmanager
def _connected(
    spec: RtdeSpec, stop: Stop, wait: float | None, report: Callable[[str], object]
) -> Iterator[RtdeReader]:
    """Connect, with attempts until `wait` s have passed."""
    deadline = time.monotonic() + (wait or 0.0)
    reader: RtdeReader | None = None
    reported = False
    while reader is None:
        try:
            reader = RtdeReader.connect(spec)
        except DriverError as error:
            if time.monotonic() >= deadline:
                raise ControllerError(f"{error}: nothing was recorded") from error
            if stop.requested:
                problem = "ended before the controller came: nothing was recorded"
                raise OperatorStopError(problem) from error
            if not reported:
                report(f"waiting for the controller: {error}")
            reported = True
            time.sleep(_RETRY_PERIOD)
    with reader:
        yield reader


def _require_same_arm(cell: Cell, reader: RtdeReader, identity: ArmIdentity) -> None:
    """Raise ControllerError unless the arm is the cell's."""
    cycle_ms = round(1000.0 / reader.frequency)
    if cycle_ms != cell.controller.cycle_ms:
        problem = f"the controller's cycle is {cycle_ms} ms, the cell states"
        remedy = f"write cycle_ms = {cycle_ms} in [controller]"
        raise ControllerError(f"{problem} {cell.controller.cycle_ms} ms; {remedy}")
    if different := cell.expected_arm.differences(identity, reader.version.major):
        problem = f"this is another arm: {different[0]}"
        raise ControllerError(f"{problem}; correct the cell file, or the address")


def _unchecked(cell: Cell, identity: ArmIdentity) -> Iterator[str]:
    """Yield a sentence if the cell states something that the arm could not be asked."""
    if missing := cell.expected_arm.unchecked(identity):
        yield f"the arm was not compared with the cell by {' and '.join(missing)}"


def _statements(arm: ArmListener) -> dict[str, str]:
    """Return what the arm states of itself, as metadata."""
    identity = arm.identity
    major = arm.reader.version.major
    texts = {
        "model": identity.named(major),
        "serial_number": identity.serial_number,
        "calibration": identity.calibration,
        "polyscope": identity.polyscope,
        "version": str(arm.reader.version),
        "not_sent": ", ".join(arm.reader.absent) or None,
    }
    return {f"ur.{name}": text for name, text in texts.items() if text is not None}
