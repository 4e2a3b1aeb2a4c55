"""From the link's records and events to one archive.

Shared by the two places that archive: the thread that runs a link in virtual time, and the archive
process of a real one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.events import (
    AnswersLost,
    GapSeen,
    HoldChanged,
    InitReceived,
    LinkLost,
    MotionEnded,
    MotionStarted,
    Outcome,
    OverrideChanged,
    PacketRejected,
    Refused,
    StateChanged,
)
from drivers.exchange.event_log import (
    EventsLost,
    ExchangeEnded,
    ExchangeEvent,
    ExchangeFailed,
    ExchangeStarted,
    HoldRefused,
    Leaving,
    OverrideRefused,
    ResumeRefused,
)
from hil.archive.events import Level
from hil.archive.writer import ArchiveWriter
from hil.terminal_text import plural


def describe(event: ExchangeEvent) -> str:
    """One line for a person."""
    match event:
        case StateChanged():
            return f"{event.before.name} -> {event.after.name} in cycle {event.cycle}"
        case GapSeen():
            return f"{plural(event.missed, 'packet')} missed before cycle {event.cycle}"
        case AnswersLost():
            were = f"{plural(event.count, 'answer')} {'was' if event.count == 1 else 'were'}"
            return f"{were} not accepted by the controller, until cycle {event.cycle}"
        case MotionStarted():
            return f"first set-point in cycle {event.cycle}"
        case OverrideChanged():
            return f"override {100.0 * event.fraction:.4g} % in cycle {event.cycle}"
        case HoldChanged():
            return f"{'held' if event.held else 'resumed'} at cycle {event.cycle}"
        case MotionEnded():
            return f"{event.outcome} in cycle {event.cycle}: {event.reason}"
        case PacketRejected(kind="answered late"):
            return f"{plural(event.count, 'answer')} left more than a cycle after their packet"
        case PacketRejected():
            why = f" ({event.why})" if event.why else ""
            return f"{plural(event.count, f'{event.kind} packet')} got no answer{why}"
        case Refused():
            return f"{event.error}; {event.error.remedy}"
        case LinkLost(stale=stale) if stale:
            packets = f"{plural(stale, 'packet')} that cannot follow the last one"
            return f"only {packets} for {event.silence:.3f} s in state {event.state.name}"
        case LinkLost():
            return f"nothing heard for {event.silence:.3f} s in state {event.state.name}"
        case InitReceived():
            return event.unusable or "; ".join(
                ["the controller started a session", *event.differences]
            )
        case Leaving():
            return f"the exchange comes to its end: {event.reason}"
        case ExchangeEnded():
            return f"the exchange ended: {event.reason}"
        case ExchangeFailed():
            return f"the exchange failed: {event.trace.strip().splitlines()[-1]}"
        case ExchangeStarted():
            return "; ".join(["the exchange is running", *event.realtime.refused, *event.notes])
        case OverrideRefused():
            return f"no override of {event.fraction:g}: {event.reason}"
        case HoldRefused():
            return f"nothing is held: {event.reason}"
        case ResumeRefused():
            return f"the motion cannot be resumed: {event.reason}"
        case EventsLost():
            return f"{event.count} events were overwritten before they could be archived"


def level_of(event: ExchangeEvent) -> Level:
    """How serious an event is."""
    if isinstance(event, Refused | LinkLost | ExchangeFailed | EventsLost):
        return Level.ERROR
    if isinstance(
        event,
        GapSeen | AnswersLost | PacketRejected | OverrideRefused | ResumeRefused | HoldRefused,
    ):
        return Level.WARN
    return Level.INFO


Records = NDArray[np.void]

LATE_KINDS = frozenset({"late", "answered late"})
"""Of `PacketRejected`: the answer left out for a newer packet's, or sent after its cycle."""
AFTERMATH = 0.5
"""s of the controller's time that are recorded after a motion was refused or lost."""


@dataclass(frozen=True, eq=False)
class ArchiveSpec:
    """An archive that is to be written; pickles.

    Attributes:
        path: the file, which must not exist.
        joint_names: joints in the order of the records' columns.
        period: cycle of the controller [s].
        metadata: entries of the ``hil`` record.
        attachments: content by file name.
        durable: wait at each flush until the disk has the data.
        packets: whether the raw packets of the link are kept as well.
    """

    path: Path
    joint_names: tuple[str, ...]
    period: float
    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    durable: bool = True
    packets: bool = False

    def with_more(self, metadata: Mapping[str, str], attachments: Mapping[str, bytes]) -> Self:
        """The same archive with further metadata and attachments, which win over earlier ones."""
        return replace(
            self,
            metadata={**self.metadata, **metadata},
            attachments={**self.attachments, **attachments},
        )

    def open(self) -> ArchiveWriter:
        """Create the file.

        Raises:
            ArchiveWriteError: it exists, the disk refuses, or the metadata cannot stand.
        """
        return ArchiveWriter(**{one.name: getattr(self, one.name) for one in fields(self)})


class Recorder:
    """Fills one archive from records and events, and closes it with the true outcome.

    Only cycles of one session with the controller belong into a file: a controller that starts
    anew counts from zero again, and what follows is left out.

    Args:
        writer: the archive.
        drive_train: in force on the link; makes joint torques of target currents.

    Attributes:
        ended: how the motion ended, None as long as it goes on.
        restarted: whether the controller began a new session meanwhile.
        link_lost: whether the link fell silent meanwhile.
        refused: the last refusal of the session meanwhile, None without one.
        records: how many were archived.
        records_lost: how many were overwritten before they could be archived.
        events_lost: likewise of the events.
        packets_lost: likewise of the raw packets, where they are stored.
        missed: packets that never arrived.
        late: packets whose answer was late or left out for a newer one.
        untaken: answers that the controller did not take.
        newest_packet: cycle of the newest raw packet archived, -1 before the first.
    """

    def __init__(self, writer: ArchiveWriter, drive_train: DriveTrain) -> None:
        self.writer = writer
        self.ended: MotionEnded | None = None
        self.restarted = False
        self.link_lost = False
        self.refused: Refused | None = None
        self.records = 0
        self.records_lost = 0
        self.events_lost = 0
        self.packets_lost = 0
        self.missed = 0
        self.late = 0
        self.untaken = 0
        self._drive_train = drive_train
        self._newest = -1
        self._cut = False
        self.newest_packet = -1
        self._packets_cut = False

    def take_packets(self, packets: Records, lost: int = 0) -> None:
        """Archive raw packets; `lost` of them before these were overwritten unread.

        To be called before `take` of what came with them. Where the archive is one without
        packets, they are dropped.
        """
        if not self.writer.with_packets:
            return
        self.packets_lost += lost
        if self._packets_cut or not len(packets):
            return
        cycles = packets["cycle"]
        beyond = (np.diff(cycles, prepend=self.newest_packet) < 0) | (cycles > self._last_cycle)
        if beyond.any():
            self._packets_cut = True
            packets = packets[: int(np.argmax(beyond))]
        if len(packets):
            self.writer.add_packets(packets)
            self.newest_packet = int(packets["cycle"][-1])

    def take(self, records: Records, events: Sequence[ExchangeEvent], lost: int = 0) -> None:
        """Archive what has come; `lost` records before these were overwritten unread.

        The records must be those up to the newest of the events, or more.

        Raises:
            ArchiveWriteError: the disk refuses.
        """
        ours = self._of_this_session(events)
        self.note(events)
        self._write(records)
        for event in ours:
            self._count(event)
            self._tell(event)
        if lost:
            self.records_lost += lost
            self.writer.event(None, "RecordsLost", f"{lost} records overwritten", level=Level.ERROR)

    def witness(self, outcome: Outcome, interval: int) -> None:
        """Take it from elsewhere that the motion has ended: the event that says so was lost."""
        ended = MotionEnded(outcome, "the event that said why was lost", interval, self._newest)
        self.note([ended])
        self._tell(ended)

    def remark(self, name: str, text: str) -> None:
        """Archive a warning of our own."""
        self.writer.event(None, name, text, level=Level.WARN)

    def note(self, events: Sequence[ExchangeEvent]) -> None:
        """Take in what events say of the interval, without archiving them."""
        for event in events:
            if isinstance(event, MotionEnded):
                self.ended = event
            self.restarted = self.restarted or isinstance(event, InitReceived)
            self.link_lost = self.link_lost or isinstance(event, LinkLost)
            if isinstance(event, Refused):
                self.refused = event

    def _tell(self, event: ExchangeEvent) -> None:
        self.writer.event(
            getattr(event, "cycle", None),
            type(event).__name__,
            describe(event),
            level=level_of(event),
            data=_data(event),
        )

    def _count(self, event: ExchangeEvent) -> None:
        if isinstance(event, EventsLost):
            self.events_lost += event.count
        elif isinstance(event, AnswersLost):
            self.untaken += event.count
        elif isinstance(event, PacketRejected) and event.kind in LATE_KINDS:
            self.late += event.count

    @property
    def newest(self) -> int:
        """Cycle of the newest record archived, -1 before the first."""
        return self._newest

    @property
    def lacks_packets(self) -> bool:
        """Whether raw packets of the newest record archived are still to come, if any are."""
        packets_wanted = self.writer.with_packets and not self._packets_cut
        return packets_wanted and self.newest_packet < self._newest

    @property
    def over(self) -> bool:
        """Whether the interval is over and all of it archived, aftermath included."""
        if self.ended is None:
            return False
        if _at_rest(self.ended) or self._cut or self.restarted:
            return True
        aftermath = round(AFTERMATH / self.writer.period)
        return self._newest - self.ended.cycle >= aftermath

    def close(self, outcome: str, reason: str = "") -> None:
        """Complete the archive."""
        counts = {
            "records_lost": self.records_lost,
            "events_lost": self.events_lost,
            "late_answers": self.late,
            "answers_not_taken": self.untaken,
        }
        if self.writer.with_packets:
            counts["packets_lost"] = self.packets_lost
        details = {key: str(value) for key, value in counts.items()}
        self.writer.close(outcome, reason=reason, details=details)

    def _of_this_session(self, events: Sequence[ExchangeEvent]) -> Sequence[ExchangeEvent]:
        """Events up to the init packet that begins another session, that one included."""
        if self.restarted:
            return ()
        for index, event in enumerate(events):
            if isinstance(event, InitReceived):
                return events[: index + 1]
        return events

    @property
    def _last_cycle(self) -> int:
        """The last cycle that may still belong to the archive, as far as is known."""
        if self.ended is None or _at_rest(self.ended):
            return int(np.iinfo(np.int64).max)
        return self.ended.cycle + round(AFTERMATH / self.writer.period)

    def _write(self, records: Records) -> None:
        """Archive the records up to the end of the session and of the aftermath."""
        if self._cut or not len(records):
            return
        cycles = records["cycle"]
        beyond = (np.diff(cycles, prepend=self._newest) <= 0) | (cycles > self._last_cycle)
        if beyond.any():
            self._cut = True
            records = records[: int(np.argmax(beyond))]
        if not len(records):
            return
        self.writer.write(records, self._drive_train.joint_torque(records["target_current"]))
        self.records += len(records)
        self.missed += int(records["gap"].sum())
        self._newest = int(records["cycle"][-1])


def _data(event: ExchangeEvent) -> dict[str, float | bool] | None:
    """What a program may want to know of an event beside its cycle."""
    match event:
        case AnswersLost():
            return {"count": event.count}
        case OverrideChanged():
            return {"fraction": event.fraction}
        case HoldChanged():
            return {"held": event.held}
    return None


def _at_rest(ended: MotionEnded) -> bool:
    return ended.outcome in ("completed", "stopped")
