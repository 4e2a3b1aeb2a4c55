"""Records and events of a link to one archive, in virtual and in real time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.errors import GuardError
from drivers.events import (
    ControllerRemark,
    GapSeen,
    HoldChanged,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    OverrideChanged,
    PacketRejected,
    Refused,
    RepliesLost,
    StateChanged,
)
from drivers.exchange.event_log import (
    CommandRefused,
    EventsLost,
    ExchangeEnded,
    ExchangeEvent,
    ExchangeFailed,
    ExchangeStarted,
    Leaving,
)
from drivers.punctuality import LATE_PACKETS, LATE_REPLIES
from drivers.states import Outcome
from hil.archive.header import REPLIES_LOST
from hil.archive.schema import Level
from hil.archive.writer import ArchiveWriter

_EVENT_TEXTS: Final[Mapping[type, tuple[Level, str]]] = {
    InitReceived: (Level.INFO, "the controller started a session{details}"),
    StateChanged: (Level.INFO, "{0.before.name} -> {0.after.name} in cycle {0.cycle}"),
    GapSeen: (Level.WARN, "packets missed before cycle {0.cycle}: {0.missed}"),
    RepliesLost: (
        Level.WARN,
        "replies not accepted by the controller until cycle {0.cycle}: {0.count}",
    ),
    PacketRejected: (Level.WARN, "packets {0.kind}: {0.count}{details}"),
    MotionStarted: (Level.INFO, "first set-point in cycle {0.cycle}"),
    OverrideChanged: (Level.INFO, "override {0.fraction:g} in cycle {0.cycle}"),
    HoldChanged: (Level.INFO, "{details} at cycle {0.cycle}"),
    MotionEnded: (Level.INFO, "{0.outcome} in cycle {0.cycle}: {0.reason}"),
    ControllerRemark: (Level.INFO, "{0.text}"),
    Refused: (Level.ERROR, "{0.error}; {0.error.remedy}"),
    LinkLost: (
        Level.ERROR,
        "no valid packet for {0.silence:.3f} s in state {0.state.name}; stale packets: {0.stale}",
    ),
    ExchangeStarted: (Level.INFO, "the exchange is running{details}"),
    Leaving: (Level.INFO, "the exchange is ending: {0.reason}"),
    ExchangeEnded: (Level.INFO, "the exchange ended: {0.reason}"),
    ExchangeFailed: (Level.ERROR, "the exchange failed: {details}"),
    EventsLost: (
        Level.ERROR,
        "events that were overwritten before they could be archived: {0.count}",
    ),
    CommandRefused: (Level.WARN, "{0.command} refused: {0.reason}"),
}


def describe(event: ExchangeEvent) -> str:
    """Return the event as one line of text."""
    details = ""
    match event:
        case InitReceived() if event.unusable:
            return event.unusable
        case PacketRejected() if event.reason:
            details = f" ({event.reason})"
        case HoldChanged():
            details = "held" if event.held else "resumed"
        case ExchangeStarted():
            details = "".join(f"; {note}" for note in (*event.realtime.refused, *event.notes))
        case ExchangeFailed():
            details = event.trace.strip().splitlines()[-1]
    return _EVENT_TEXTS[type(event)][1].format(event, details=details)


def level_of(event: ExchangeEvent) -> Level:
    """Return the severity of an event."""
    return _EVENT_TEXTS[type(event)][0]


Records = NDArray[np.void]

AFTERMATH_SECONDS = 0.5  # Time recorded after a motion was refused or lost, s


@dataclass(frozen=True, eq=False)
class ArchiveSpec:
    """Arguments of an `ArchiveWriter`; pickles."""

    path: Path
    joint_names: tuple[str, ...]
    period: float
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    durable: bool = True
    states: tuple[str, ...] = ()

    def open(self) -> ArchiveWriter:
        """Create the file; ArchiveWriteError if it exists or cannot be written."""
        return ArchiveWriter(**{field.name: getattr(self, field.name) for field in fields(self)})


@dataclass(frozen=True)
class Recorded:
    """How an archive ended, and what it contains.

    Attributes:
        outcome, reason: as in the file.
        interval: of the motion, -1 without one.
        seconds: of the controller's time since its init packet.
        records, records_lost: cycles archived, and overwritten before they could be.
        events_lost: events overwritten before they could be archived.
        missed: packets that never arrived.
        late_packets: packets that came late themselves (`drivers.punctuality`).
        late: packets whose reply was late, or left out for a newer one.
        not_accepted: replies that the controller did not accept.
        disk_waited: longest write [s].
    """

    outcome: str
    reason: str
    interval: int
    seconds: float
    records: int
    records_lost: int
    events_lost: int
    missed: int
    late: int
    not_accepted: int
    disk_waited: float
    late_packets: int = 0


class Recorder:
    """Fills one archive from records and events, and closes it with the true outcome.

    It adds the joint torque that the drive train makes of the target current.

    It contains cycles of one session with the controller; later sessions are left out.

    Attributes:
        ended: end of the motion, None before.
        restarted: whether the controller began a new session meanwhile.
        link_lost: whether the link was lost meanwhile.
        refused: the last refusal of the session meanwhile, None without one.
        records: number of archived records.
    """

    def __init__(self, writer: ArchiveWriter, drive_train: DriveTrain) -> None:
        self.writer = writer
        self.ended: MotionEnded | None = None
        self.restarted = False
        self.link_lost = False
        self.refused: Refused | None = None
        self.records = 0
        self._records_lost = 0
        self._events_lost = 0
        self._late_packets = 0
        self._late = 0
        self._not_accepted = 0
        self._drive_train = drive_train
        self._cut = False

    def record(self, records: Records, events: Sequence[ExchangeEvent], lost: int = 0) -> None:
        """Archive records and events; `lost` records were overwritten before.

        The records must include those up to the newest event. Events are archived up to the init
        packet that begins another session, that one included.
        """
        restarts = [k for k, event in enumerate(events) if isinstance(event, InitReceived)]
        archive_events = () if self.restarted else events[: restarts[0] + 1] if restarts else events
        self.update(events)
        self._write(records)
        for event in archive_events:
            if isinstance(event, EventsLost):
                self._events_lost += event.count
            elif isinstance(event, RepliesLost):
                self._not_accepted += event.count
            elif isinstance(event, PacketRejected) and event.kind in LATE_REPLIES:
                self._late += event.count
            elif isinstance(event, PacketRejected) and event.kind in LATE_PACKETS:
                self._late_packets += event.count
            self._archive(event)
        if lost:
            self._records_lost += lost
            self.writer.event(None, "RecordsLost", f"{lost} records overwritten", level=Level.ERROR)

    def motion_ended(self, outcome: Outcome, interval: int) -> None:
        """Record that the motion ended when its event was lost."""
        ended = MotionEnded(
            outcome, "the event with the reason was lost", interval, self.writer.newest
        )
        self.update([ended])
        self._archive(ended)

    def warn(self, name: str, text: str) -> None:
        """Archive a warning."""
        self.writer.event(None, name, text, level=Level.WARN)

    @property
    def complete(self) -> bool:
        """Whether the interval has ended and is archived, aftermath included."""
        if self.ended is None:
            return False
        if _at_rest(self.ended) or self._cut or self.restarted:
            return True
        return self.writer.newest >= self._last_cycle

    def close(self, outcome: str, reason: str = "") -> Recorded:
        """Complete the archive, and return what it contains."""
        counts = {
            "records_lost": self._records_lost,
            "events_lost": self._events_lost,
            "late_answers": self._late,
            "answers_not_taken": self._not_accepted,
        }
        if self._late_packets:
            counts["late_packets"] = self._late_packets
        details = {key: str(value) for key, value in counts.items()}
        self.writer.close(outcome, reason=reason, details=details)
        return Recorded(
            outcome=outcome,
            reason=reason,
            interval=-1 if self.ended is None else self.ended.interval,
            seconds=(self.writer.newest + 1) * self.writer.period,
            records=self.records,
            records_lost=self._records_lost,
            events_lost=self._events_lost,
            missed=self.writer.missed,
            late=self._late,
            not_accepted=self._not_accepted,
            disk_waited=self.writer.file.slowest_flush,
            late_packets=self._late_packets,
        )

    def update(self, events: Sequence[ExchangeEvent]) -> None:
        """Update the state of the interval by events, without archiving them."""
        for event in events:
            if isinstance(event, MotionEnded):
                self.ended = event
            elif isinstance(event, Refused):
                self.refused = event
            self.restarted |= isinstance(event, InitReceived)
            self.link_lost |= isinstance(event, LinkLost)

    def _archive(self, event: ExchangeEvent) -> None:
        data = {name: getattr(event, name) for name in _EVENT_FIELDS.get(type(event), ())}
        if isinstance(event, Refused) and isinstance(event.error, GuardError):
            data = {name: getattr(event.error, name) for name in _REFUSAL_DATA}
            data["check"] = event.error.check.quantity
        cycle = getattr(event, "cycle", None)
        name = type(event).__name__
        name = REPLIES_LOST if isinstance(event, RepliesLost) else name
        self.writer.event(cycle, name, describe(event), level=level_of(event), data=data)

    @property
    def _last_cycle(self) -> int:
        """The last cycle that belongs to the archive."""
        if self.ended is None or _at_rest(self.ended):
            return int(np.iinfo(np.int64).max)
        return self.ended.cycle + round(AFTERMATH_SECONDS / self.writer.period)

    def _write(self, records: Records) -> None:
        """Archive the records up to the end of the session and of the aftermath."""
        if self._cut or not len(records):
            return
        cycles = records["cycle"]
        beyond = (np.diff(cycles, prepend=self.writer.newest) < 1) | (cycles > self._last_cycle)
        if beyond.any():
            records = records[: int(np.argmax(beyond))]
            self._cut = True
        if len(records):
            self.writer.write(records, self._drive_train.joint_torque(records["target_current"]))
            self.records += len(records)


_EVENT_FIELDS: Final[Mapping[type, Sequence[str]]] = {
    RepliesLost: ("count",),
    OverrideChanged: ("fraction",),
    HoldChanged: ("held",),
}
"""Data of an event in addition to its cycle."""
_REFUSAL_DATA: Final = ("joint", "value", "bound", "unit")


def _at_rest(ended: MotionEnded) -> bool:
    return ended.outcome in ("completed", "stopped")
