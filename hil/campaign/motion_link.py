"""What a campaign needs of a link, in virtual or in real time."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.events import InitReceived, MotionEnded, Refused
from drivers.exchange.event_log import ExchangeEvent
from drivers.init_check import compare
from drivers.motion_source import MotionSource
from drivers.packets import InitPacket
from drivers.states import State
from hil.archive import ArchiveSpec
from hil.archive.recorder import describe
from hil.cell import Cell
from hil.errors import ControllerFault

from .operator import MotionWatch, Stop, unwatched_motion

BEGIN_TIMEOUT: Final = 60.0
"""s within which a motion that was accepted must have begun."""
OFF_TIMEOUT: Final = 2.0
"""s with the drive off after which a motion that was accepted does not begin any more."""
_WITHOUT_DRIVE: Final = frozenset(
    (State.SYNC, State.INIT, State.DRIVE_OFF, State.FAULTED, State.ENDED)
)


class Beginning:
    """Whether a motion that was accepted may still begin.

    Args:
        now: when it was asked for [s of any monotonic clock].
    """

    def __init__(self, now: float) -> None:
        self._asked = self._driven = now

    def hopeless(self, state: State, now: float) -> str | None:
        """Why a motion that has not begun will not begin any more, in words; None while it may."""
        if state not in _WITHOUT_DRIVE:
            self._driven = now
        if now - self._driven > OFF_TIMEOUT and state is State.FAULTED:
            return "a refusal came before the motion began"
        if now - self._driven > OFF_TIMEOUT:
            return "the drive went off before the motion began"
        if now - self._asked > BEGIN_TIMEOUT:
            return f"the motion did not begin within {BEGIN_TIMEOUT:g} s ({state.name})"
        return None


Array = NDArray[np.float64]

END_TIMEOUT = 30.0
"""s within which a session has to end after that was asked for."""


@dataclass(frozen=True)
class Recorded:
    """How a recording of the controller's own motion ended.

    Attributes:
        outcome: "completed", "stopped" or "lost".
        reason: in a sentence.
        records: cycles archived.
        records_lost: cycles overwritten before they could be archived.
        seconds: of the controller's time since its init packet.
        events_lost: events overwritten likewise.
        missed: packets that never arrived.
        late: packets whose answer was late, or left out for a newer one.
        untaken: answers that the controller did not take.
    """

    outcome: str
    reason: str
    records: int
    records_lost: int
    seconds: float = 0.0
    events_lost: int = 0
    missed: int = 0
    late: int = 0
    untaken: int = 0


@dataclass(frozen=True, eq=False)
class Progress:
    """What a recording shows while it goes on.

    Attributes:
        cycles: archived so far.
        missed: packets that never arrived.
        state: of the session.
        position: (n,) rad, measured last; None before the first record.
        late: packets whose answer was late, or left out for a newer one.
        untaken: answers that the controller did not take.
        foreign: packets from elsewhere; they got no answer.
        heard: whether any packet of the controller was answered yet.
        not_understood: of packets that got no answer, how many came and why; "" without any.
        over: why nothing is recorded any more though answers go on; "" while it is recorded.
    """

    cycles: int
    missed: int
    state: State
    position: Array | None = None
    late: int = 0
    untaken: int = 0
    foreign: int = 0
    heard: bool = True
    not_understood: str = ""
    over: str = ""


Watch = Callable[[Progress], None]


def unwatched(_progress: Progress) -> None:
    """Nobody looks."""


def _unsaid(_text: str) -> None:
    """Nobody listens."""


@dataclass(eq=False)
class Connection:
    """What has become known of the controller since the link was opened.

    Attributes:
        init: its init packet.
        unusable: why the arm cannot be moved, None if it can.
        differences: what it says otherwise than the cell.
        adopted: whether its figures are used instead of the cell's.
        refused: the last refusal of the session.
        say: tells a person at once of each refusal.
    """

    init: InitPacket | None = None
    unusable: str | None = None
    differences: tuple[str, ...] = ()
    adopted: bool = False
    refused: Refused | None = None
    say: Callable[[str], None] = _unsaid

    def note(self, event: ExchangeEvent) -> None:
        """Take in an event."""
        if isinstance(event, InitReceived):
            self.init, self.unusable = event.init, event.unusable
            self.differences, self.adopted = event.differences, event.adopted
        elif isinstance(event, Refused):
            self.refused = event
            self.say(f"REFUSED: {describe(event)}")

    def require_usable(self, cell: Cell | None) -> None:
        """Refuse a controller that is not the cell's.

        Args:
            cell: whose controller it should be, where that is known.

        Raises:
            ControllerFault: the arm cannot be moved.
        """
        if self.unusable is None:
            return
        remedy = ""
        if self.differences and not self.adopted:
            remedy = "; correct the cell file, or the controller"
            if cell is not None and self.init is not None and _may_accept(cell, self.init):
                remedy += (
                    "; only `hil record` and `hil move` can use the controller's figures instead "
                    "(--accept-init)"
                )
        raise ControllerFault(f"the controller cannot be used: {self.unusable}{remedy}")


def not_ready(state: State, waited: float) -> ControllerFault:
    """What is reported where a controller did not come so far that a motion may be asked for.

    Args:
        state: of the session.
        waited: for how long [s].
    """
    after = f"within {waited:.3g} s (state {state.name})"
    if state is State.SYNC:
        return ControllerFault(
            f"the controller did not begin a session {after}: it is silent, or still in one that "
            "began before this program; start the program on the controller anew and try again"
        )
    if state is State.ENDED:
        return ControllerFault(
            f"the controller ended the session {after} before its drive was on; start the program "
            "on the controller anew and try again"
        )
    return ControllerFault(
        f"the controller did not reach drive-on {after}; switch the drive on and try again"
    )


class MotionLink(Protocol):
    """One connection to a controller: motions are run on it and archived."""

    @property
    def cycles(self) -> int:
        """Records archived so far."""
        ...

    @property
    def connection(self) -> Connection:
        """What is known of the controller."""
        ...

    @property
    def only_simulated(self) -> bool:
        """Whether nothing but a simulated controller can be at the far end."""
        ...

    def connect(self, stop: Stop, timeout: float = 60.0) -> Array:
        """Exchange until the drive is on and the axes are closed; the target position then (n,).

        Raises:
            ControllerFault: the controller did not get there within `timeout` s, cannot be used,
                or a stop was asked for.
        """
        ...

    def run(
        self,
        source: MotionSource,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        override: float = 1.0,
        watch: MotionWatch = unwatched_motion,
    ) -> MotionEnded:
        """Run one motion, archive every cycle of it, and say how it ended.

        Should archiving fail, the arm is brought to rest on its path before the error is raised.

        Args:
            source: the motion.
            spec: its archive.
            stop: asks for a stop on the path.
            override: the largest fraction of the planned speed. The motion runs at the smaller of
                this and the request's, from its very first cycle.
            watch: sees the motion, and may slow, hold and release it. Nothing begins while its
                request is a hold.

        Raises:
            ControllerFault: the motion was not accepted (nothing moved), or the link broke; or it
                is to be slower and knows no override.
            ArchiveWriteError: the archive cannot be written; the motion was stopped.
        """
        ...

    def close(self) -> None:
        """End the connection; nothing moves any more.

        Raises:
            ControllerFault: it did not end as it should.
        """
        ...


class Recording(Protocol):
    """A connection on which the controller's own motion is recorded."""

    def record(
        self,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        duration: float | None,
        wait: float | None,
        watch: Watch,
    ) -> Recorded:
        """Answer safely and archive every cycle from the controller's first on.

        Where the far end goes by real time, answers go on after the recording until the arm rests.

        Raises:
            ControllerFault: the controller cannot be read, or did not come within `wait` s.
            OperatorStopError: a stop was asked for before it came.
            ArchiveWriteError: the archive cannot be written.
        """
        ...

    def close(self) -> None:
        """End the connection.

        Raises:
            ControllerFault: it did not end as it should.
        """
        ...


def described(spec: ArchiveSpec, connection: Connection, drives: DriveTrain) -> ArchiveSpec:
    """The archive with the controller's init packet, and with the drive train in force.

    Its `drive_train.json`, the cell's, is brought to what the link uses.
    """
    if connection.init is None:
        return spec
    attachments = {"init_packet.bin": connection.init.encode()}
    metadata = {}
    if connection.adopted:
        attachments["drive_train.json"] = _in_force(spec.attachments["drive_train.json"], drives)
        metadata = {
            "accepted_init": "yes",
            "accepted_init.differences": "; ".join(connection.differences),
        }
    return spec.with_more(metadata, attachments)


def drives_in_force(cell: Cell, connection: Connection) -> DriveTrain:
    """The cell's drive train, or that of a controller whose figures were accepted."""
    drives, init, table = cell.drive_train, connection.init, cell.controller
    if init is None or not connection.adopted:
        return drives
    others = frozenset(table.other_axes)
    return compare(drives, cell.period, init, table.arm, True, others).drive_train


def _may_accept(cell: Cell, init: InitPacket) -> bool:
    """Whether the controller's figures can be accepted: not another cycle, nor a closed axis."""
    table = cell.controller
    others = frozenset(table.other_axes)
    return compare(cell.drive_train, cell.period, init, table.arm, True, others).adopted


def _in_force(text: bytes, drives: DriveTrain) -> bytes:
    """A drive train table with the ratios, calibration and coupling of `drives`."""
    table = json.loads(text)
    table["gear_ratio"] = drives.gear_ratio.tolist()
    table["calibration"] = drives.calibration.tolist()
    table |= {"k54": drives.k54, "k64": drives.k64, "k65": drives.k65}
    return json.dumps(table).encode()
