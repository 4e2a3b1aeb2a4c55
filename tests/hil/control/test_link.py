"""Endings and time-outs of a motion, the same over every port: here one with a script of events."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.errors import AxisNotInMode, RequestError
from drivers.events import MotionEnded, MotionStarted, PacketRejected, Refused, StateChanged
from drivers.exchange.event_log import NO_ARCHIVE, EventsLost
from drivers.exchange.process_handle import ExchangeError, WithdrawnError
from drivers.states import State
from hil.archive import ArchiveSpec
from hil.archive.recorder import Recorded
from hil.base.errors import ArchiveWriteError, ControllerError
from hil.campaign import Stop
from hil.cell import Cell
from hil.control.connection import OFF_TIMEOUT, START_TIMEOUT
from hil.control.errors import MotionFailedError, stopped
from hil.control.link import REST_TIMEOUT, MotionLink
from hil.control.port import PortStatus
from tests.messages import DRIVE_IS_OFF, OPEN_MODE_BEING_LEFT, START_OPEN_PROGRAM

TURN = 0.02
Happens = Callable[["ScriptedPort"], None]


def recorded(outcome: str, reason: str, disk_waited: float = 0.0) -> Recorded:
    return Recorded(outcome, reason, 0, 1.0, 500, 0, 0, 0, 0, 0, disk_waited)


class ScriptedPort:
    """A port of which things happen at given times [s], with a diary of what was asked of it."""

    is_virtual = False
    only_simulated = True
    live = None

    def __init__(self, *script: tuple[float, Happens]) -> None:
        self.now = 0.0
        self.state = State.CLOSED
        self.ended_count = 0
        self.script = list(script)
        self.events: list[Any] = []
        self.diary: list[str] = []
        self.complete: Recorded | None = None
        self.broken: Exception | None = None
        self.archive_gone: str | None = None
        self.exchange_gone: str | None = None
        self.refuses: Exception | None = None

    def prepare(self, stop: Stop) -> None:
        pass

    def status(self) -> PortStatus:
        return PortStatus(self.state, 0, 1, 0, 0, 0, 0, self.ended_count, np.nan, np.nan)

    def failure(self) -> str | None:
        return self.exchange_gone

    def poll(self) -> Sequence[Any]:
        events = self.events
        self.events = []
        return events

    def new_records(self) -> np.ndarray:
        return np.zeros(0, np.dtype(np.void))

    def exchange_until(self, finished: Callable[[], bool]) -> bool:
        while not finished():
            if self.exchange_gone is not None:
                self.complete = self.complete or recorded("lost", "the exchange process ended")
                return False
            self.now += TURN
            while self.script and self.script[0][0] <= self.now:
                self.script.pop(0)[1](self)
        return True

    def due(self) -> bool:
        return True

    def submit(self, source: object, wanted: Callable[[], bool]) -> None:
        self.diary.append("submit")
        if self.refuses is not None:
            raise self.refuses
        if not wanted():
            raise WithdrawnError("closed", "withdrawn")

    @contextmanager
    def supervision(self) -> Iterator[None]:
        yield

    def stop(self, reason: str) -> None:
        if "stop" not in self.diary:
            self.diary.append("stop")

    @contextmanager
    def open_archive(self, spec: ArchiveSpec, *, own_motion: bool) -> Iterator[None]:
        self.diary.append("open")
        yield

    def archived(self) -> Recorded | None:
        if self.broken is not None:
            raise self.broken
        return self.complete

    def archive_failure(self) -> str | None:
        return self.archive_gone

    def close_archive(self, outcome: str, reason: str) -> Recorded:
        self.diary.append(outcome)
        return recorded(outcome, reason)


def started(port: ScriptedPort) -> None:
    port.state = State.OPEN
    port.events.append(MotionStarted(0, 10))


def ended(outcome: str = "completed", reason: str = "the motion is complete") -> Happens:
    def happens(port: ScriptedPort) -> None:
        port.state = State.CLOSED
        port.ended_count = port.ended_count + 1
        port.events.append(MotionEnded(outcome, reason, 0, 500))  # type: ignore[arg-type]

    return happens


def archived(outcome: str = "completed", reason: str = "", disk_waited: float = 0.0) -> Happens:
    return lambda port: setattr(port, "complete", recorded(outcome, reason, disk_waited))


def is_set(name: str, value: object) -> Happens:
    return lambda port: setattr(port, name, value)


def run(cell: Cell, port: ScriptedPort, stop: Stop | None = None) -> MotionEnded:
    spec = ArchiveSpec(Path("a.mcap"), cell.joint_names, cell.period, {}, durable=False)
    link = MotionLink(cell, port)  # type: ignore[arg-type]
    return link.run(object(), spec, stop or Stop())  # type: ignore[arg-type]


def said_until_ended(cell: Cell, port: ScriptedPort, stop: Stop) -> list[str]:
    """What is said of a connection that waits until the operator ends it."""
    port.state = State.SYNC
    link = MotionLink(cell, port)  # type: ignore[arg-type]
    lines: list[str] = []
    link.connection.report = lines.append
    with pytest.raises(ControllerError, match="ended by the operator"):
        link.connect(stop)
    return lines


def test_what_a_connection_waits_for_is_reported_once(cell: Cell) -> None:
    stop = Stop()
    port = ScriptedPort(
        (5.0, is_set("state", State.DRIVE_OFF)),
        (8.0, is_set("state", State.DRIVING_ON)),
        (9.0, lambda _: setattr(stop, "requested", True)),
    )
    lines = said_until_ended(cell, port, stop)
    nothing = "no packet from the controller (0 packets from other addresses)"
    start = "waiting up to 60 s for the controller: "
    assert lines == [
        f"{start}{nothing}; {START_OPEN_PROGRAM}",
        f"{start}{DRIVE_IS_OFF}",
    ]


def test_a_count_that_grows_is_no_other_reason(cell: Cell) -> None:
    """A controller still ends its last session, for tens of packets that get no reply."""
    stop = Stop()

    def came(count: int) -> Happens:
        event = PacketRejected("malformed", count, "228 bytes: no init")
        return lambda port: port.events.append(event)

    end = (5.0, lambda _: setattr(stop, "requested", True))
    port = ScriptedPort((1.0, came(290)), (3.0, came(1)), (4.0, came(11)), end)
    lines = said_until_ended(cell, port, stop)
    (line,) = lines
    assert "290 packets arrived" in line


def test_an_end_names_joints_as_the_cell_does(cell: Cell) -> None:
    port = ScriptedPort(
        (1.0, started),
        (2.0, ended("lost", "joint 2 is in mode 0; the motion needs 4")),
        (2.5, archived("lost")),
    )
    assert run(cell, port).reason == f"{cell.joint_names[1]} is in mode 0; the motion needs 4"


def test_a_motion_ends_with_its_archive(cell: Cell) -> None:
    port = ScriptedPort((0.1, started), (1.0, ended()), (1.2, archived()))
    assert run(cell, port).outcome == "completed"
    assert port.now == pytest.approx(1.2, abs=TURN)


@pytest.mark.parametrize("lost", [EventsLost(3), None])
def test_an_end_whose_event_was_lost_is_that_of_the_archive(cell: Cell, lost: Any) -> None:
    def ends(port: ScriptedPort) -> None:
        port.ended_count += 1
        port.events += [lost] if lost is not None else []

    port = ScriptedPort((0.1, started), (1.0, ends), (1.2, archived("stopped", "requested")))
    assert run(cell, port) == MotionEnded("stopped", "requested", 0, -1)


@pytest.mark.parametrize(
    ("state", "after", "message"),
    [
        (State.DRIVE_OFF, OFF_TIMEOUT, "the drive went off before the motion began"),
        (State.FAULTED, OFF_TIMEOUT, "a refusal came before the motion began"),
        (State.CLOSED, START_TIMEOUT, "did not begin within 60 s"),
    ],
)
def test_a_motion_that_does_not_begin_is_dropped(
    cell: Cell, state: State, after: float, message: str
) -> None:
    """First its archive is closed, without which nothing can begin any more; then it is stopped."""
    port = ScriptedPort((TURN, is_set("state", state)))
    with pytest.raises(ControllerError, match=f"{message}.*; nothing was sent"):
        run(cell, port)
    assert port.diary == ["open", "submit", "void", "stop"]
    assert port.now == pytest.approx(after, abs=3 * TURN)


def test_a_drive_off_requested_by_this_pc_is_named(cell: Cell) -> None:
    """A refusal at rest, before the motion was requested."""
    refusal = AxisNotInMode("joint 2 is in mode 0; the motion needs 4", 7)

    def refused_at_rest(port: ScriptedPort) -> None:
        port.state = State.DRIVE_OFF
        port.events.append(Refused(refusal, np.zeros(0)))

    port = ScriptedPort()
    refused_at_rest(port)
    why = rf"this PC asked the controller for drive-off \(505\): {cell.joint_names[1]} is in mode 0"
    with pytest.raises(ControllerError, match=f"{why}.*; nothing was sent"):
        run(cell, port)
    # After the drive was on again, the refusal is over.
    link = MotionLink(cell, port)  # type: ignore[arg-type]
    refused_at_rest(port)
    port.events.append(StateChanged(State.DRIVING_ON, State.CLOSED, 9))
    link._poll()
    assert link.connection.why_off == ""


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        (is_set("broken", ArchiveWriteError(Path("a.mcap"), "cannot be written", remedy="")),
         ArchiveWriteError, "cannot be written"),
        (is_set("archive_gone", "the archive process ended"),
         ControllerError, "the archive process ended; the arm was brought to rest"),
    ],
)  # fmt: skip
def test_without_an_archive_the_arm_rests_before_the_error(
    cell: Cell, fault: Happens, error: type[Exception], message: str
) -> None:
    rests = ended("stopped", "a stop was requested")
    port = ScriptedPort((0.1, started), (0.5, fault), (0.8, rests))
    with pytest.raises(error, match=message):
        run(cell, port)
    assert port.diary == ["open", "submit", "stop"]
    assert port.now >= 0.8


def test_an_arm_that_is_not_seen_at_rest_is_reported_so(cell: Cell) -> None:
    port = ScriptedPort((0.1, started), (0.5, is_set("archive_gone", "the archive process ended")))
    with pytest.raises(ControllerError, match=r"asked to stop, but was not seen at rest \(OPEN\)"):
        run(cell, port)
    assert port.now == pytest.approx(0.5 + REST_TIMEOUT, abs=0.1)


def test_an_exchange_that_ended_is_a_fault(cell: Cell) -> None:
    port = ScriptedPort((0.1, started), (0.5, is_set("exchange_gone", "the exchange ended")))
    with pytest.raises(ControllerError, match=r"acts by its own watchdog; the archive \(lost\)"):
        run(cell, port)


def test_an_archive_that_never_completes_is_reported(cell: Cell) -> None:
    port = ScriptedPort((0.1, started), (1.0, ended()))
    with pytest.raises(ControllerError, match=r"the motion has ended, but .* was not completed"):
        run(cell, port)
    assert port.now == pytest.approx(1.0 + REST_TIMEOUT, abs=0.1)


def test_a_stop_for_want_of_heartbeats_names_the_disk(cell: Cell) -> None:
    over = archived("stopped", NO_ARCHIVE, disk_waited=3.2)
    port = ScriptedPort((0.1, started), (0.5, ended("stopped", NO_ARCHIVE)), (0.6, over))
    assert "its disk for 3.2 s: check that disk" in run(cell, port).reason


@pytest.mark.parametrize(
    ("refuses", "message", "outcome"),
    [
        (RequestError("closed", OPEN_MODE_BEING_LEFT), "see the outcome of a.mcap", "refused"),
        (ExchangeError("it did not answer within 5 s"), "within 5 s; a.mcap is void", "void"),
    ],
)
def test_a_motion_that_is_not_accepted_moves_nothing(
    cell: Cell, refuses: Exception, message: str, outcome: str
) -> None:
    port = ScriptedPort()
    port.refuses = refuses
    with pytest.raises(ControllerError, match=message):
        run(cell, port)
    assert [entry for entry in port.diary if entry != "stop"] == ["open", "submit", outcome]


def test_a_stop_before_the_request_sends_nothing(cell: Cell) -> None:
    port = ScriptedPort()
    assert run(cell, port, Stop(requested=True)) == MotionEnded(
        "stopped", "it had not started", -1, -1
    )
    assert port.diary == ["open", "stopped"]


def test_a_stopped_run_names_one_way_to_continue() -> None:
    lost = MotionFailedError("repetition 2", "lost", "the drive went off", "a.mcap")
    assert "check the arm, then run the campaign again" in str(lost)
    by_operator = MotionFailedError("repetition 2", "stopped", "stopped by the operator", "a.mcap")
    text = str(stopped(by_operator, "resume with `hil run C`"))
    assert text.endswith("everything recorded is archived; resume with `hil run C`")
    assert "run the campaign again" not in text
