"""The exchange in a process of its own, against a controller on the loopback device."""

from __future__ import annotations

import gc
import json
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from drivers import CyclicPacket, Mode, MotionEnded, MotionStarted, RequestError, State
from drivers.c4g_packets import DRIVE_ON, next_number
from drivers.cycle_records import RingReader
from drivers.exchange import process_handle, realtime
from drivers.exchange.control import ArchiveState, SharedState
from drivers.exchange.event_log import (
    ExchangeEnded,
    ExchangeFailed,
    ExchangeStarted,
    Leaving,
)
from drivers.exchange.process_handle import (
    ExchangeError,
    ExchangeProcess,
    ExchangeSettings,
    WithdrawnError,
)
from drivers.exchange.realtime import RealTimeReport, RealTimeSettings
from drivers.transports.base import TransportError
from drivers.transports.udp import UdpSpec, UdpTransport
from hil.control.simulator_process import free_port
from tests.drivers.rig import (
    MOVE,
    PERIOD,
    START,
    Cruise,
    N,
    drive_train,
    init_packet,
    limits,
    smooth_move,
    still,
)
from tests.messages import ARCHIVE_SILENT, END_REQUESTED, EXCHANGE_SILENT, LEFT_TOO_LATE

pytestmark = pytest.mark.safety

HOST = "127.0.0.1"


class UdpController:
    """Sends a packet, waits for the reply and follows it; a cycle takes at least `cycle_time` s.

    Axes open when `open` is set; a request for the end of open mode closes them, a request for
    drive-off switches the drive off.
    """

    def __init__(self, port: int, beat=lambda: None):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((HOST, port))
        self.socket.settimeout(0.5)
        self.beat = beat
        self.train = drive_train()
        self.init = init_packet()
        self.number = 10
        self.open = False
        self.drive = True
        self.axes = CyclicPacket.zeros(1, N).axes
        self.axes["d"][:, 0] = self.axes["d"][:, 2] = self.train.motor_revolutions(START)
        self.targets: list[np.ndarray] = []
        self.exits = 0
        self.drive_offs = 0
        self.unanswered = 0
        self.cycle_time = 0.0
        self.close = self.socket.close

    def start(self) -> None:
        """The init packet, and one closed cycle."""
        end = time.monotonic() + 30.0
        self.number = 10
        while True:
            try:
                self.socket.send(self.init.encode())
                assert len(self.socket.recv(2048)) == 1200
                break
            except (TimeoutError, ConnectionError):
                assert time.monotonic() < end, EXCHANGE_SILENT
        while not self.silent(0.0):
            self.socket.recv(2048)  # to an init packet that was sent again
        self.cycle()

    def cycle(self, count: int = 1) -> None:
        for _ in range(count):
            begin = time.monotonic()
            try:
                self.post()
                self.receive()
            except (TimeoutError, ConnectionError):
                self.unanswered += 1
            if self.cycle_time:
                time.sleep(max(0.0, begin + self.cycle_time - time.monotonic()))

    def post(self) -> None:
        """Begin the next cycle."""
        self.beat()
        self.number = next_number(self.number)
        self.axes["mode"] = Mode.POSITION if self.open else Mode.CLOSED
        status = bytes([DRIVE_ON * self.drive, 0, 0, 0])
        self.socket.send(CyclicPacket(self.number, status, bytes(4), self.axes).encode())

    def receive(self) -> None:
        """Wait for the answer to the cycle begun last, and follow it."""
        expected = next_number(self.number)
        reply = self.socket.recv(2048)
        while self.unanswered and CyclicPacket.decode(reply, N).number < expected:
            reply = self.socket.recv(2048)  # late reply to an earlier packet
        assert CyclicPacket.decode(reply, N).number == expected
        self._follow(reply)

    def silent(self, seconds: float) -> bool:
        """Whether no answer comes within that time."""
        return not select.select([self.socket], [], [], seconds)[0]

    def _follow(self, reply: bytes) -> None:
        answer = CyclicPacket.decode(reply, N)
        if (answer.axes["mode"] == Mode.DRIVE_OFF_REQUEST).any():
            self.drive_offs += 1
            self.drive = self.open = False
            return
        if not self.open:
            return
        commanded = answer.axes["d"]
        self.axes["d"][:, 0] = self.axes["d"][:, 2] = commanded[:, 0]
        self.axes["d"][:, 1] = self.axes["d"][:, 3] = commanded[:, 1]
        self.targets.append(commanded[:, 0].astype(float))
        if answer.status[0] == 1:
            self.exits += 1
            self.open = False

    def until(self, condition, seconds: float = 30.0) -> None:
        """Cycle until something is so."""
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, "it did not come to that"
            self.cycle()

    @property
    def path(self) -> np.ndarray:
        """Joint positions (m, n) the arm was commanded to."""
        return self.train.joint_position(np.array(self.targets))

    @property
    def moved(self) -> float:
        """Way of joint 1 so far, rad."""
        return abs(float(self.path[-1, 0] - self.path[0, 0])) if self.targets else 0.0

    def assert_stopped_on_its_path(self) -> None:
        """The arm came to rest without a jerk, then open mode was left as it should be."""
        path = self.path
        assert (self.exits, self.drive_offs) == (1, 0), f"{self.unanswered} cycles unanswered"
        speed = np.abs(np.diff(path[:, 0])) / PERIOD
        assert speed.max() > 0.25, "it was moving"
        assert speed[-1] < 1e-3, "it is at rest"
        # The wire rounds motor revolutions to float32; differences blow that up.
        motor = np.abs(np.array(self.targets)[:, 0]).max()
        step = float(np.spacing(np.float32(motor))) * 2 * np.pi / abs(self.train.gear_ratio[0])
        for order, bound in ((2, 2.0 * 8.0), (3, 3.0 * 100.0)):
            rate = np.abs(np.diff(path[:, 0], order)) / PERIOD**order
            assert rate.max() < bound + 2 ** (order - 1) * step / PERIOD**order
        np.testing.assert_allclose(
            path[:, 1:], np.broadcast_to(START[1:], path[:, 1:].shape), atol=1e-5
        )


NO_REALTIME = RealTimeSettings(priority=0, lock_memory=False, hold_cpu_awake=False)


def settings(port: int, **changes) -> ExchangeSettings:
    # The controller here waits for its answers, however late they are, and so does the exchange:
    # a second without packets is nothing on a machine that stands still now and then.
    session = {"settle_cycles": 5, "silence_timeout": 20.0, **changes.pop("session", {})}
    chosen = {"needs_archive": False, "realtime": NO_REALTIME, "ring_capacity": 5000, **changes}
    link = chosen.pop("link", UdpSpec)(HOST, port, HOST)
    return ExchangeSettings(link, drive_train(), limits(), PERIOD, session, **chosen)


@contextmanager
def running(**changes):
    port = free_port()
    exchange = ExchangeProcess.start(settings(port, **changes))
    controller = UdpController(port, exchange.send_heartbeat)
    try:
        controller.start()
        yield exchange, controller
    finally:
        controller.close()
        if exchange.alive:
            exchange.kill()
        exchange.close()


def run_to_the_end(exchange: ExchangeProcess, controller: UdpController) -> list:
    """Cycle on until the process has ended; its events."""
    controller.until(lambda: not exchange.alive)
    return exchange.events()


def the(kind, events):
    matching = [event for event in events if isinstance(event, kind)]
    assert len(matching) == 1, events
    return matching[0]


def start_cruise(exchange: ExchangeProcess, controller: UdpController) -> None:
    exchange.submit(Cruise())
    controller.open = True
    controller.until(lambda: controller.moved > 0.2)


def test_motion_is_run_and_recorded():
    with running() as (exchange, controller):
        reader = RingReader(exchange.ring_fd, N)
        exchange.submit(smooth_move(MOVE, 300))
        controller.open = True
        controller.until(lambda: exchange.status().ended_count == 1)
        controller.cycle(3)
        events = exchange.events()
        assert the(MotionEnded, events).outcome == "completed"
        started = the(MotionStarted, events)
        assert the(ExchangeStarted, events).pid == exchange.pid
        np.testing.assert_allclose(controller.path[-1], START + MOVE, atol=1e-6)
        records = reader.drain()
        in_motion = records[records["interval"] == started.interval]
        commanded = in_motion["commanded_position"]
        # The record has what was sent, at the accuracy before the wire's float32.
        np.testing.assert_allclose(commanded[: len(controller.path)], controller.path, atol=1e-6)
        assert (np.diff(records["cycle"]) == 1).all()
        assert reader.missed == 0
        status = exchange.status()
        assert status.state == State.CLOSED
        assert (status.missed, status.refused, status.overflow) == (0, 0, 0)
        assert status.late == status.replied_late, "none was left out"
        assert (status.outcome, status.ended_interval) == ("completed", started.interval)
        assert time.monotonic() - status.exchange_heartbeat < 0.5
        assert exchange.realtime == RealTimeReport("ordinary", False, False)
        exchange.finish()
        events = run_to_the_end(exchange, controller)
        assert exchange.wait(30.0) == 0
        assert exchange.status().finished
        assert the(ExchangeEnded, events).reason == END_REQUESTED
        assert exchange.log == ""


def test_motion_of_many_megabytes_is_handed_over():
    with running() as (exchange, controller):
        controller.cycle(5)
        exchange.submit(still(100_000))
        status = exchange.status()
        assert status.program_accepted == 1
        assert status.pickup_us > 0.0
        controller.open = True
        controller.cycle(20)
        assert the(MotionStarted, exchange.events()).interval == 0
        assert controller.unanswered == 0


def test_packets_are_answered_while_the_controller_moves_the_arm():
    with running() as (exchange, controller):
        exchange._channel.shutdown(socket.SHUT_RDWR)  # as by its death: noticed at once
        controller.beat = lambda: None
        controller.cycle_time = PERIOD
        end = time.monotonic() + 4.5
        while time.monotonic() < end:
            controller.axes["d"][:, 2] += 0.02  # the axes are closed
            controller.cycle()
            assert exchange.alive
        run_to_the_end(exchange, controller)
        assert exchange.wait(30.0) == 0


class TestRefusedMotions:
    def test_refusal_of_the_session_is_raised(self):
        with running() as (exchange, controller):
            with pytest.raises(RequestError, match="cannot be read"):
                exchange.submit(Trap())
            exchange.submit(still(10))
            with pytest.raises(RequestError, match="another motion was requested") as caught:
                exchange.submit(still(10))
            assert caught.value.state == "closed"
            status = exchange.status()
            assert (status.program_accepted, status.program_refused) == (2, 3)
            controller.cycle(5)
            assert exchange.alive

    def test_motion_without_archive_is_refused(self):
        with running(needs_archive=True) as (exchange, _):
            with pytest.raises(RequestError, match="archive cannot be written"):
                exchange.submit(still(10))
            control = SharedState(exchange.control_fd)
            control.archive_state = ArchiveState.READY
            with pytest.raises(RequestError, match=ARCHIVE_SILENT):
                exchange.submit(still(10))

            def confirm():
                control.archive_heartbeat = time.monotonic()
                return True

            exchange.submit(still(10), confirm)

    def test_motion_not_accepted_in_time_does_not_begin_later(self, monkeypatch):
        with running() as (exchange, controller):
            os.kill(exchange.pid, signal.SIGSTOP)
            with monkeypatch.context() as impatient:
                impatient.setattr(process_handle, "ANSWER_TIMEOUT", 0.3)
                with pytest.raises(ExchangeError, match=r"not answer within 0\.3 s"):
                    exchange.submit(smooth_move(MOVE, 300))
            os.kill(exchange.pid, signal.SIGCONT)
            assert_nothing_moves(controller)
            assert exchange.status().program_refused == 1
            controller.open = False
            controller.cycle(2)
            assert exchange.submit(still(10)) == 2

    def test_motion_can_be_withdrawn_after_it_was_read(self):
        with running(preload=(__name__,)) as (exchange, controller):
            begin = time.monotonic()
            controller.open = True
            for confirmed in (False, True):

                def confirm(confirmed=confirmed):
                    assert time.monotonic() - begin > Lengthy.READING  # it was read
                    return confirmed

                with nullcontext() if confirmed else pytest.raises(WithdrawnError):
                    exchange.submit(Lengthy(), confirm)
                controller.cycle(20)
                assert (controller.moved > 0.0) is confirmed


def assert_nothing_moves(controller: UdpController) -> None:
    controller.open = True
    controller.cycle(50)
    assert controller.moved == 0.0


class TestBetweenReadingAndBegin:
    """Whatever comes in between, a motion begins only as it was meant to."""

    @pytest.mark.parametrize(
        ("event", "reason"),
        [
            (lambda exchange, _: exchange.stop(), "a stop was requested"),
            (lambda _, controller: controller.start(), "new session since"),
        ],
        ids=["stop", "new session of the controller"],
    )
    def test_refused(self, event, reason):
        with running() as (exchange, controller):
            with pytest.raises(RequestError, match=reason):
                exchange.submit(Cruise(), lambda: event(exchange, controller) is None)
            assert_nothing_moves(controller)

    def test_withdrawal_while_the_exchange_is_stopped(self):
        with running() as (exchange, controller):
            signals = iter([signal.SIGSTOP, signal.SIGCONT])

            def confirm():
                number = next(signals)
                os.kill(exchange.pid, number)
                return number is signal.SIGSTOP

            with pytest.raises(WithdrawnError):
                exchange.submit(Cruise(), confirm)
            assert list(signals) == []
            assert_nothing_moves(controller)

    def test_interrupted_submission_leaves_no_motion(self, monkeypatch):
        hand_over = process_handle.hand_over

        def interrupted(*arguments):
            hand_over(*arguments)
            raise KeyboardInterrupt

        with running() as (exchange, controller):
            with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
                patch.setattr(process_handle, "hand_over", interrupted)
                exchange.submit(Cruise())
            exchange.submit(still(10))
            assert_nothing_moves(controller)


class Lengthy(Cruise):
    """Takes long to be read, as a program of many megabytes does."""

    READING = 0.05

    def __setstate__(self, state):
        time.sleep(self.READING)
        self.__dict__.update(state)


class Trap:
    """Pickles, and fails where it is unpickled."""

    def __reduce__(self):
        return _spring, ()


def _spring():
    raise OSError("sprung")


def test_backlog_after_a_stall_is_dropped():
    with running(session={"max_gap": 100}) as (exchange, controller):
        start_cruise(exchange, controller)
        os.kill(exchange.pid, signal.SIGSTOP)
        while Path(f"/proc/{exchange.pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "T":
            time.sleep(0.001)
        for _ in range(90):
            controller.post()
            time.sleep(PERIOD)  # packets at once would be the fault of the link
        time.sleep(10 * PERIOD)
        os.kill(exchange.pid, signal.SIGCONT)
        assert controller.silent(0.1)
        before = controller.moved
        controller.cycle(1)
        assert controller.moved - before == pytest.approx(PERIOD * Cruise.SPEED, rel=0.01)
        controller.cycle(200)
        status = exchange.status()
        assert status.late - status.replied_late == 90
        assert status.missed == 90


class Slow(Cruise):
    """Takes five cycles for each step: the next packet overtakes every reply, even where a busy
    computer makes the controller of the test late."""

    COST = 5 * PERIOD

    def advance(self):
        end = time.monotonic() + self.COST
        while time.monotonic() < end:
            pass
        return super().advance()


def test_consecutive_late_replies_stop_the_motion():
    """The controller does not wait for them."""
    with running(session={"max_gap": 100}, max_late=2, preload=(__name__,)) as (
        exchange,
        controller,
    ):
        exchange.submit(Slow())
        controller.open = True
        controller.cycle(20)
        ended = []
        begin = time.monotonic()
        while not ended:
            assert time.monotonic() < begin + 30.0
            controller.post()
            time.sleep(PERIOD)
            while not controller.silent(0.0):
                controller._follow(controller.socket.recv(2048))
            ended = [event for event in exchange.events() if isinstance(event, MotionEnded)]
        assert ended[0].outcome == "stopped", ended[0].reason
        assert LEFT_TOO_LATE in ended[0].reason
        assert exchange.status().worst_turnaround_us > 1e6 * Slow.COST


class TestStops:
    """On the path, whoever asks for it or can no longer."""

    @staticmethod
    def stopped(exchange, controller, *, by: str, ends: bool) -> list:
        """The arm came to rest as it should, for this reason; events."""
        if ends:
            events = run_to_the_end(exchange, controller)
            assert exchange.wait(30.0) == 0
            reason = the(Leaving, events).reason
        else:
            controller.until(lambda: not controller.open)
            controller.cycle(3)
            events = exchange.events()
            assert exchange.alive
            reason = the(MotionEnded, events).reason
        controller.assert_stopped_on_its_path()
        assert the(MotionEnded, events).outcome == "stopped"
        assert by in reason
        return events

    @pytest.mark.parametrize(
        ("ask", "reason", "ends"),
        [
            (ExchangeProcess.stop, "a stop was requested", False),
            (ExchangeProcess.terminate, "asked to terminate", True),
            (ExchangeProcess.finish, END_REQUESTED, True),
        ],
    )
    def test_requested(self, ask, reason, ends):
        with running() as (exchange, controller):
            start_cruise(exchange, controller)
            ask(exchange)
            self.stopped(exchange, controller, by=reason, ends=ends)

    def test_silent_supervisor(self):
        with running() as (exchange, controller):
            start_cruise(exchange, controller)
            controller.cycle_time = PERIOD  # half a second must not be half the joint's range
            controller.beat = lambda: None
            silent_from = time.monotonic()
            controller.until(lambda: not controller.open)
            assert time.monotonic() - silent_from > 0.4
            self.stopped(exchange, controller, by="no heartbeat", ends=True)

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
    def test_interrupt_and_hang_up_do_not_stop(self, number):
        with running() as (exchange, controller):
            start_cruise(exchange, controller)
            os.kill(exchange.pid, number)
            moved = controller.moved
            controller.cycle(200)
            assert controller.open
            assert controller.moved == pytest.approx(moved + 200 * PERIOD * Cruise.SPEED, rel=0.01)
            assert not [event for event in exchange.events() if isinstance(event, MotionEnded)]


class FaultySpec(UdpSpec):
    """Opens a link with a fault in its program."""

    def open(self):
        return FaultyTransport(self.peer_host, self.port, self.bind)


class FaultyTransport(UdpTransport):
    packets = 0

    def send(self, packet):
        self.packets += 1
        super().send(packet if self.packets < 5 else None)


class WithoutLoopback(UdpSpec):
    """Opens a link on a computer whose loopback device is off."""

    def open(self):
        link = UdpTransport(self.peer_host, self.port, self.bind)
        link.loopback = self.refuse
        return link

    @staticmethod
    def refuse():
        raise TransportError("UDP port 0 on 127.0.0.1", "no such address", "switch it on")


class TestProcessEnd:
    def test_killed_process_is_detected(self):
        with running() as (exchange, controller):
            start_cruise(exchange, controller)
            os.kill(exchange.pid, signal.SIGKILL)
            assert exchange.wait(30.0) == -signal.SIGKILL
            assert not exchange.alive
            assert not exchange.status().finished
            controller.cycle(2)
            assert controller.unanswered == 2
            with pytest.raises(ExchangeError, match="gone"):
                exchange.submit(still(10))

    def test_internal_error_is_logged(self):
        with running(link=FaultySpec) as (exchange, controller):
            controller.cycle(4)
            assert exchange.wait(30.0) == 70
            assert "TypeError" in the(ExchangeFailed, exchange.events()).trace
            assert "TypeError" in exchange.log
            assert not exchange.status().finished


class TestStart:
    def test_the_link_to_itself_is_no_condition(self):
        with running(link=WithoutLoopback) as (exchange, controller):
            controller.cycle(4)
            assert exchange.alive
            assert controller.unanswered == 0

    def test_refusals_are_raised(self):
        with running() as (_, controller), pytest.raises(TransportError, match="another program"):
            ExchangeProcess.start(settings(controller.socket.getpeername()[1]))
        with pytest.raises(ModuleNotFoundError, match="no_such_module"):
            ExchangeProcess.start(settings(free_port(), preload=("no_such_module",)))

    def test_process_that_cannot_be_started_leaves_nothing_open(self, monkeypatch):
        def refuse(*_, **__):
            raise BlockingIOError(11, "no more processes")

        monkeypatch.setattr(subprocess, "Popen", refuse)
        gc.collect()  # what earlier tests left is closed now, not in between
        before = set(Path("/proc/self/fd").iterdir())
        with pytest.raises(ExchangeError, match="no more processes"):
            ExchangeProcess.start(settings(free_port()))
        assert set(Path("/proc/self/fd").iterdir()) == before


ENTER = """
import dataclasses, gc, json, mmap, os, resource, sys
from drivers.exchange.realtime import RealTimeSettings, enter
if {unprivileged}:
    resource.setrlimit(resource.RLIMIT_MEMLOCK, ({memlock}, {memlock}))
    os.setgroups([]); os.setgid(65534); os.setuid(65534)
report = enter(RealTimeSettings({arguments}))
mmap.mmap(-1, 64 << 20).close()
print(json.dumps([dataclasses.asdict(report), gc.isenabled(), sorted(os.sched_getaffinity(0))]))
"""


NO_OTHERS = "lock_memory=False, hold_cpu_awake=False"


def enter(arguments: str = "", *, unprivileged=False, memlock=8 << 20):
    """In a process of its own; report, whether the collector is on, processors."""
    script = ENTER.format(arguments=arguments, unprivileged=unprivileged, memlock=memlock)
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    report, collecting, cpus = json.loads(run.stdout)
    return RealTimeReport(**report), collecting, cpus


ALLOCATE = """
import json, resource
from drivers.exchange.realtime import RealTimeSettings, enter
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
report = enter(RealTimeSettings(priority=0, hold_cpu_awake=False))
before = faults()
small = [bytes(200) for _ in range(4 << 12)]  # 4 MiB, in arenas of CPython
small.clear()
large = [bytes(2000) for _ in range(4 << 9)]  # 4 MiB, on the heap of C
print(json.dumps([report.memory_locked, faults() - before]))
"""


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs the right to drop rights")


class TestRealTimeSettings:
    def test_each_setting_is_granted_or_refused(self):
        report, _, _ = enter("priority=37")
        granted = report.scheduling == "SCHED_FIFO 37", report.memory_locked, report.cpu_awake
        assert sum(granted) + len(report.refused) == 3
        cpu = max(os.sched_getaffinity(0))
        report, collecting, cpus = enter(f"priority=0, cpu={cpu}, {NO_OTHERS}")
        assert report == RealTimeReport("ordinary", False, False, [])
        assert (collecting, cpus) == (False, [cpu])

    @needs_root
    def test_refusals_of_an_unprivileged_user_have_remedies(self):
        report, collecting, _ = enter("", unprivileged=True, memlock=4 << 20)
        assert report.scheduling == "ordinary"
        assert not report.memory_locked
        assert not collecting
        text = "\n".join(report.refused)
        assert "rtprio 98" in text
        assert "memlock unlimited" in text
        assert "udev" in text or report.cpu_awake

    def test_allocations_in_a_cycle_cost_no_page_fault(self):
        command = [sys.executable, "-c", ALLOCATE]
        locked, faults = json.loads(subprocess.check_output(command, text=True))
        if not locked:
            pytest.skip("memory cannot be locked here")
        assert faults < 16

    @pytest.mark.parametrize(
        ("user", "limit", "flags", "locked"),
        [
            (1000, 8 << 30, 1, "in use"),
            (1000, resource.RLIM_INFINITY, 3, "all"),
            (0, 8 << 20, 3, "all"),
        ],
        ids=["a finite limit", "no limit", "root"],
    )
    def test_future_memory_is_locked_only_without_a_limit(
        self, monkeypatch, user, limit, flags, locked
    ):
        asked = []
        c = SimpleNamespace(
            mallopt=lambda *_: 1, mlockall=lambda flags: asked.append(flags) or 0
        )  # grants everything
        monkeypatch.setattr(realtime.ctypes, "CDLL", lambda *_, **__: c)
        monkeypatch.setattr(realtime.os, "geteuid", lambda: user)
        monkeypatch.setattr(realtime.resource, "getrlimit", lambda _: (limit, limit))
        refused = []
        assert realtime._lock_memory(refused) == locked
        assert asked == [flags]
        assert len(refused) == (locked != "all")

    @pytest.mark.parametrize(
        ("impossible", "remedy"),
        [("priority=0, cpu=4096", "choose one of"), ("priority=100", ""), ("priority=1000", "")],
    )
    def test_unknown_processor_or_priority_is_refused(self, impossible, remedy):
        report, _, _ = enter(f"{impossible}, {NO_OTHERS}")
        assert report.scheduling == "ordinary"
        assert len(report.refused) == 1
        assert remedy in report.refused[0]
