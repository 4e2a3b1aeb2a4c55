"""What a campaign needs of a link, in virtual or in real time, and what is known of its far end."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.drive_train import DriveTrain
from drivers.events import InitReceived, MotionEnded, Refused
from drivers.exchange.event_log import ExchangeEvent
from drivers.guard import Guard
from drivers.init_check import InitCheck, compare, float32_text, is_narrower
from drivers.motion_source import MotionSource
from drivers.packets import InitPacket
from drivers.states import State
from hil.archive import ArchiveSpec
from hil.archive.recorder import Recorder, describe
from hil.archive.supervised import Closed
from hil.cell import Cell
from hil.errors import ControllerFault
from hil.motion_checks import MotionChecks

from .operator import MotionWatch, Stop, unwatched_motion

Array = NDArray[np.float64]

BEGIN_TIMEOUT: Final = 60.0
"""s within which a motion that was accepted must have begun."""
OFF_TIMEOUT: Final = 2.0
"""s with the drive off after which a motion that was accepted does not begin any more."""
END_TIMEOUT: Final = 30.0
"""s within which a session has to end after that was asked for."""
_WITHOUT_DRIVE: Final = (State.SYNC, State.INIT, State.DRIVE_OFF, State.FAULTED, State.ENDED)


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
        if now - self._driven > OFF_TIMEOUT:
            came = "a refusal came" if state is State.FAULTED else "the drive went off"
            return f"{came} before the motion began"
        if now - self._asked > BEGIN_TIMEOUT:
            return f"the motion did not begin within {BEGIN_TIMEOUT:g} s ({state.name})"
        return None


@dataclass(frozen=True)
class Recorded:
    """How a recording of the controller's own motion ended.

    Attributes:
        outcome: "completed", "stopped", "lost" or "refused".
        reason: in a sentence.
        seconds: of the controller's time since its init packet.
        records, records_lost: cycles archived, and overwritten before they could be.
        events_lost: events overwritten likewise.
        missed: packets that never arrived.
        late: packets whose answer was late, or left out for a newer one.
        not_accepted: answers that the controller did not take.
    """

    outcome: str
    reason: str
    seconds: float
    records: int
    records_lost: int
    events_lost: int
    missed: int
    late: int
    not_accepted: int

    @classmethod
    def of(cls, outcome: str, reason: str, seconds: float, counts: Recorder | Closed) -> Recorded:
        """With the counts of its archive."""
        return cls(
            outcome,
            reason,
            seconds,
            records=counts.records,
            records_lost=counts.records_lost,
            events_lost=counts.events_lost,
            missed=counts.missed,
            late=counts.late,
            not_accepted=counts.not_accepted,
        )


@dataclass(frozen=True, eq=False)
class Progress:
    """What a recording shows while it goes on.

    Attributes:
        cycles: archived so far.
        missed: packets that never arrived.
        state: of the session.
        position: (n,) rad, measured last; None before the first record.
        late: packets whose answer was late, or left out for a newer one.
        not_accepted: answers that the controller did not take.
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
    not_accepted: int = 0
    foreign: int = 0
    heard: bool = True
    not_understood: str = ""
    over: str = ""


Watch = Callable[[Progress], None]


def unwatched(_progress: Progress) -> None:
    """Nobody looks."""


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
    say: Callable[[str], object] = str

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

        Raises:
            ControllerFault: the arm cannot be moved.
        """
        if self.unusable is None:
            return
        remedy = ""
        if self.differences and not self.adopted:
            remedy = "; correct the cell file, or the controller"
            # Another cycle or a closed axis cannot be accepted.
            if cell is not None and self.init is not None and _accepted(cell, self.init).adopted:
                remedy += (
                    "; only `hil record` and `hil move` can use the controller's figures instead "
                    "(--accept-init)"
                )
        raise ControllerFault(f"the controller cannot be used: {self.unusable}{remedy}")


def not_ready(state: State, waited: float) -> ControllerFault:
    """What is reported of a controller that was `waited` s for, and not ready for a motion."""
    after, drive = f"within {waited:.3g} s", "switch the drive on and try again"
    anew = "start the program on the controller anew and try again"
    if state is State.SYNC:
        what = (
            f"did not begin a session {after} (state SYNC): it is silent, or still in one that "
            f"began before this program; {anew}"
        )
    elif state is State.ENDED:
        what = f"ended the session {after} before its drive was on; {anew}"
    else:
        what = f"did not reach drive-on {after} (state {state.name}); {drive}"
    return ControllerFault(f"the controller {what}")


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

    def record(
        self,
        spec: ArchiveSpec,
        stop: Stop,
        *,
        duration: float | None = None,
        wait: float | None = None,
        watch: Watch = unwatched,
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
        """End the connection; nothing moves any more.

        Raises:
            ControllerFault: it did not end as it should.
        """
        ...


def described(spec: ArchiveSpec, connection: Connection, drives: DriveTrain) -> ArchiveSpec:
    """The archive with the controller's init packet, and with the drive train in force.

    Its `drive_train.json`, the cell's, gets the ratios, calibration and coupling of `drives`.
    """
    if connection.init is None:
        return spec
    attachments, metadata = {"init_packet.bin": connection.init.encode()}, {}
    if connection.adopted:
        table = json.loads(spec.attachments["drive_train.json"]) | {
            "gear_ratio": drives.gear_ratio.tolist(),
            "calibration": drives.calibration.tolist(),
            **{name: getattr(drives, name) for name in ("k54", "k64", "k65")},
        }
        attachments["drive_train.json"] = json.dumps(table).encode()
        metadata = {
            "accepted_init": "yes",
            "accepted_init.differences": "; ".join(connection.differences),
        }
    return spec.with_more(metadata, attachments)


def drives_in_force(cell: Cell, connection: Connection) -> DriveTrain:
    """The cell's drive train, or that of a controller whose figures were accepted."""
    if connection.init is None or not connection.adopted:
        return cell.drive_train
    return _accepted(cell, connection.init).drive_train


def guard_in_force(cell: Cell, drives: DriveTrain, init: InitPacket | None) -> Guard:
    """A guard with the limits in force: the narrower of the cell's and the controller's."""
    guard = Guard(cell.guard_limits, cell.period)
    if init is not None:
        current = np.fmin(_stated(cell, init, "current_limit"), drives.current_limit)
        guard.narrow(_stated(cell, init, "following_error"), current)
    return guard


def checks_in_force(
    cell: Cell, connection: Connection, checks: MotionChecks | None = None
) -> MotionChecks:
    """What a motion to a connected controller is checked against.

    The narrower of the cell's and the controller's current limits count, and gears that were
    accepted from the controller; the very `checks` where both are the cell's.
    """
    checks = MotionChecks.of(cell) if checks is None else checks
    if connection.adopted:
        gears = drives_in_force(cell, connection).motor_from_joint
        checks = replace(checks, currents=replace(checks.currents, motor_from_joint=gears))
    if connection.init is None:
        return checks
    return checks.within(_stated(cell, connection.init, "current_limit"))


Limit = Literal["current_limit", "following_error"]


def narrower_limits(cell: Cell, connection: Connection, limit: Limit) -> tuple[str, ...]:
    """Limits of the controller below the cell's, in words joint by joint.

    No model tells how far a servo lags behind, so that no motion can be checked against thresholds
    of the following error.
    """
    if connection.init is None:
        return ()
    theirs, ours = _stated(cell, connection.init, limit), getattr(cell.drive_table, limit)
    unit = "A" if limit == "current_limit" else "motor revolutions"
    return tuple(
        f"{cell.joint_names[joint]}: {float32_text(theirs[joint])} {unit} in the controller, "
        f"{ours[joint]:.9g} in the cell file"
        for joint in np.flatnonzero(is_narrower(theirs, np.array(ours)))
    )


def _accepted(cell: Cell, init: InitPacket) -> InitCheck:
    """The init packet held against the cell, its figures accepted where they can be."""
    table = cell.controller
    others = frozenset(table.other_axes)
    return compare(cell.drive_train, cell.period, init, table.arm, True, others)


def _stated(cell: Cell, init: InitPacket, limit: Limit) -> Array:
    """A limit of the cell's arm in an init packet (n,), NaN where it has none."""
    values = getattr(init, limit)[cell.controller.arm - 1, : len(cell.joint_names)]
    return np.asarray(values, dtype=np.float64)
