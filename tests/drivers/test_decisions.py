"""What an input does to a session is decided without changing anything; losses have four words."""

from __future__ import annotations

import itertools
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.exchange.loop import exchange
from drivers.packet_losses import LOSS_WINDOW_CYCLES, LossTracker
from drivers.session import Session
from drivers.states import (
    STATES_WITH_SET_POINTS,
    TRANSITIONS,
    Decision,
    Input,
    State,
    decide,
    keeps_request,
)
from drivers.transports.udp import UdpSpec
from drivers.ur.description import UrDescription
from drivers.ur.rtde import FrameSplitter
from drivers.ur.transport import UrTransport
from tests.drivers.rig import PERIOD, Cruise, Rig, moving
from tests.drivers.ur.ur_bench import MIDST, UrBench
from tests.messages import MISSED_IN_A_ROW, RESTARTED_WITH_SYNC

pytestmark = pytest.mark.safety

GAP = 2


@dataclass(frozen=True)
class Motion:
    """A requested motion; frozen, so that a decision cannot change it."""

    started: bool = True
    leaving: bool = False
    outcome: str = "completed"
    reason: str = "the motion is complete"


@dataclass(frozen=True)
class Axes:
    """Modes of a packet: the joint that is in another mode, before and during a motion."""

    waiting: int | None = None
    moving: int | None = None

    def misplaced(self, in_motion: bool) -> int | None:
        return self.moving if in_motion else self.waiting


def losses(missed: int = 0, stale: int = 0, elapsed: float = PERIOD) -> LossTracker:
    tracker = LossTracker(GAP, PERIOD)
    tracker.stale = stale
    tracker.receive(missed, elapsed)
    return tracker


ENTRIES = [(state, cause) for state, row in TRANSITIONS.items() for cause in row]
MOTIONS = [None, Motion(started=False), Motion(), Motion(leaving=True)]


class TestDecision:
    @pytest.mark.parametrize("motion", MOTIONS)
    def test_the_state_is_that_of_the_table(self, motion):
        for state, cause in ENTRIES:
            assert decide(state, cause, losses(), motion).state is TRANSITIONS[state][cause]

    def test_the_same_arguments_give_the_same_decision(self):
        for (state, cause), motion in itertools.product(ENTRIES, MOTIONS):
            tracker = losses(missed=GAP + 1)
            before = vars(tracker).copy()
            first = decide(state, cause, tracker, motion, Axes())
            assert decide(state, cause, tracker, motion, Axes()) == first
            assert vars(tracker) == before

    def test_a_motion_goes_on_only_where_set_points_are_sent(self):
        for state, cause in ENTRIES:
            decision = decide(state, cause, losses(), Motion())
            lost = decision.state not in STATES_WITH_SET_POINTS and cause is not Input.REFUSAL
            assert (decision.ending is not None) == lost, (state, cause)
            if decision.ending is not None:
                assert decision.ending[0] == "lost"

    def test_a_motion_that_came_to_rest_ends_as_it_was_meant_to(self):
        decision = decide(State.EXITING, Input.CLOSED, losses(), Motion(leaving=True))
        assert decision == Decision(State.CLOSED, None, ("completed", "the motion is complete"))

    def test_a_request_waits_as_the_table_of_requests_says(self):
        for state, cause in ENTRIES:
            if cause in (Input.REFUSAL, Input.EXIT):
                continue
            decision = decide(state, cause, losses(), Motion(started=False))
            waits = keeps_request(state, decision.state) and cause is not Input.SILENCE
            assert (decision.ending is None) == waits, (state, cause)

    @pytest.mark.parametrize(("missed", "stale"), [(GAP + 1, 0), (0, GAP + 1), (GAP, 1)])
    def test_missed_and_stale_packets_stop_a_motion_together(self, missed, stale):
        tracker = losses(missed, stale)
        decision = decide(State.OPEN, Input.OPEN, tracker, Motion(), Axes())
        assert decision.stop == f"{GAP + 1} {MISSED_IN_A_ROW}"
        assert decide(State.OPEN, Input.OPEN, losses(GAP), Motion(), Axes()).stop is None
        assert decide(State.OPENING, Input.OPEN, tracker, Motion(), Axes()).stop is None
        assert decide(State.OPEN, Input.OPEN, tracker, None, Axes()).stop is None

    @pytest.mark.parametrize(
        ("state", "motion", "joint"),
        [
            (State.OPEN, Motion(), 5),
            (State.OPEN, Motion(started=False), 1),
            (State.CLOSED, Motion(started=False), 1),
            (State.OPENING, Motion(), 1),
        ],
    )
    def test_a_joint_in_another_mode_refuses_the_motion(self, state, motion, joint):
        decision = decide(state, Input.OPEN, losses(), motion, Axes(waiting=1, moving=5))
        assert decision == Decision(State.FAULTED, misplaced=joint)

    def test_a_motion_dropped_for_its_losses_needs_no_axes(self):
        waiting = Motion(started=False)
        axes = Axes(waiting=1)
        decision = decide(State.OPEN, Input.PARTLY_OPEN, losses(GAP + 1), waiting, axes)
        assert (decision.state, decision.misplaced) == (State.EXITING, None)
        assert decision.stop is not None


class TestLosses:
    def test_at_first_nothing_is_lost(self):
        tracker = LossTracker(GAP, PERIOD)
        assert (tracker.missed, tracker.stale, tracker.late) == (0, 0, 0.0)
        assert (tracker.rejected, tracker.gap, tracker.restarting) == (0, 0, False)

    def test_stale_packets_count_once(self):
        tracker = losses(missed=1, stale=2)
        assert (tracker.missed, tracker.gap, tracker.stale) == (1, 3, 0)
        tracker.receive(0, PERIOD)
        assert (tracker.missed, tracker.gap) == (0, 0)

    @pytest.mark.parametrize("missed", [0, GAP, GAP + 3])
    def test_late_is_two_cycles_beyond_the_number(self, missed):
        accounted = max(missed, GAP)
        assert not losses(missed, elapsed=(accounted + 1.99) * PERIOD).is_late
        assert losses(missed, elapsed=(accounted + 2.01) * PERIOD).is_late

    def test_rejected_replies_add_up_over_a_window(self):
        tracker = losses()
        tracker.reject(GAP, 1)
        assert tracker.reason_to_stop_after_rejection is None
        tracker.reject(1, LOSS_WINDOW_CYCLES)
        assert tracker.reason_to_stop_after_rejection == "3 replies were lost in 100 cycles"
        tracker.reject(1, LOSS_WINDOW_CYCLES + 1)
        assert (tracker.rejected, tracker.reason_to_stop_after_rejection) == (2, None)
        tracker.forget_rejected()
        assert tracker.rejected == 0

    def test_a_silence_says_what_came_instead_of_packets(self):
        tracker = losses()
        assert tracker.instead_of_packets == ""
        tracker.stale = 3
        assert tracker.instead_of_packets == "only packets that do not follow the last one came (3)"
        tracker.restarting = True
        assert tracker.instead_of_packets == RESTARTED_WITH_SYNC


class TestOwner:
    @pytest.fixture
    def setters(self, monkeypatch: pytest.MonkeyPatch) -> dict[str, set[str]]:
        """Files that set a value of a session, by its name."""
        setters: dict[str, set[str]] = {}

        def note(session: Session, name: str, value: object) -> None:
            caller = Path(sys._getframe(1).f_code.co_filename)
            setters.setdefault(name, set()).add(caller.name)
            object.__setattr__(session, name, value)

        monkeypatch.setattr(Session, "__setattr__", note, raising=False)
        return setters

    def test_only_the_session_changes_its_state(self, setters: dict[str, set[str]]) -> None:
        """To the end of a motion, after a long gap, a refusal, a silence and a restart."""
        rig = moving(20)[0]
        rig.session.stop("over")
        rig.run()
        assert rig.ended.outcome == "stopped"
        rig = moving()[0]
        rig.miss(2 * GAP)
        rig.run()
        rig = moving()[0]
        rig.put_arm_at(rig.records["position"][-1] + 1.0)
        rig.cycle()
        assert rig.state is State.FAULTED
        rig = moving()[0]
        rig.session.tick(rig.now + 60.0)
        rig.start()
        assert rig.state is State.INIT
        changed = {"state", "stop_reason", "execution", "interval", "in_interval", "entered_at"}
        assert changed <= set(setters)
        assert set().union(*setters.values()) == {"session.py"}


IN_THE_SESSION = {
    "session", "c4g_packets", "c4g_wire", "open_mode", "guard", "drive_train", "execution",
}  # fmt: skip
BESIDE = {"states", "packet_losses", "cycle_records"}
"""The session's table, what it counts as lost, and the ring that receives the record."""
CLOCK = {"arrival"}
"""By which a socket's times of arrival are read; no packet passes it."""


BEFORE = {"udp", "loop"}
"""Transport and exchange: the nine files from packet to reply begin with them."""


@contextmanager
def files_passed() -> Iterator[set[str]]:
    """Files of `drivers` whose functions are called."""
    folder = str(Path(__file__).parents[2] / "drivers")
    passed: set[str] = set()

    def note(frame, event, _argument):
        if event == "call" and frame.f_code.co_filename.startswith(folder):
            passed.add(Path(frame.f_code.co_filename).stem)

    sys.setprofile(note)
    try:
        yield passed
    finally:
        sys.setprofile(None)


def test_a_packet_in_motion_passes_these_files_only():
    rig, _ = moving()
    packet = rig.packet()
    with files_passed() as passed:
        reply = rig.session.reply(packet, rig.now)
    assert reply is not None
    assert rig.session.execution is not None
    assert passed == IN_THE_SESSION | BESIDE


def test_a_packet_from_the_network_passes_nine_files():
    """From the socket to the socket, in motion, at this moment, however busy the computer is."""
    rig = Rig(silence_timeout=60.0)
    rig.now = time.monotonic() - 300 * PERIOD
    rig.session.request(Cruise())
    rig.open()
    rig.cycle(200)
    transport = UdpSpec("127.0.0.1", 0, "127.0.0.1").open()
    controller = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with closing(transport), controller:
        controller.settimeout(10.0)
        controller.sendto(rig.packet(), transport.address)
        replied = rig.session.counters.replied
        with files_passed() as passed:
            exchange(
                transport,
                rig.session,
                ends_when=lambda: rig.session.counters.replied > replied,
            )
        assert len(controller.recv(2048)) == len(rig.packet())
    assert rig.state is State.OPEN
    assert rig.session.execution is not None
    assert passed == BEFORE | IN_THE_SESSION | BESIDE | CLOCK
    assert len(BEFORE | IN_THE_SESSION) == 9


FROM_RTDE = {"transport", "rtde", "loop", "session", "wire", "open_mode", "guard", "drive_train",
             "execution"}  # fmt: skip
"""The nine files from frame to reply at a UR controller."""


def connection() -> tuple[socket.socket, socket.socket]:
    """Both ends of a connection by TCP."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        ours = socket.create_connection(server.getsockname())
        return ours, server.accept()[0]


def test_a_frame_from_a_ur_controller_passes_nine_files():
    """From the stream of RTDE to the frame of inputs, in motion."""
    bench = UrBench()
    bench.run(3)
    bench.session.request(bench.player())
    bench.run(MIDST)
    assert bench.state is State.OPEN
    ours, theirs = connection()
    primary, spare = connection()
    description = bench.session.init
    assert isinstance(description, UrDescription)
    agreed = SimpleNamespace(splitter=FrameSplitter(), frames=())

    class InVirtualTime(UrTransport):
        """Without the kernel's times of arrival, which are of another clock."""

        now = bench.transport.now + bench.cell.period
        arrived = property(lambda _: None, lambda _, value: None)  # type: ignore[assignment]

    transport = InVirtualTime(ours, primary, agreed, description)  # type: ignore[arg-type]
    with closing(transport), theirs, spare:
        assert transport.receive(1.0) == description.encode()
        theirs.settimeout(10.0)
        theirs.sendall(bench.peer.next_packet() or b"")
        replied = bench.session.counters.replied
        with files_passed() as passed:
            exchange(
                transport,
                bench.session,
                ends_when=lambda: bench.session.counters.replied > replied,
            )
        assert theirs.recv(2048)[2:3] == b"U"
    assert bench.state is State.OPEN
    assert bench.session.execution is not None
    assert passed == FROM_RTDE | BESIDE | CLOCK
    assert len(FROM_RTDE) == 9
