"""What the exchange process does between two packets, in virtual time."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest

from drivers import CyclicPacket, Mode, State
from drivers.errors import RequestError
from drivers.events import Counters, GapSeen, MotionEnded, PacketRejected
from drivers.exchange import control, event_log
from drivers.exchange.__main__ import Rehearsal, rehearse
from drivers.exchange.control import PATIENCE, STALE, ControlBlock, Ended
from drivers.exchange.event_log import NO_SUPERVISOR, EventReader, EventWriter, HoldRefused, Leaving
from drivers.exchange.loop import POLL
from drivers.exchange.serving import LONGEST_LINGER, ORPHAN_LINGER, Serving
from drivers.record import CycleRing
from tests.drivers.rig import PERIOD, N, drive_train, limits

STEP = 0.01


class Told:
    """A session that is in the state it is told to be in, and hears a packet per step."""

    requested = False
    interval = -1
    init = None

    def __init__(self):
        self.state = State.CLOSED
        self.counters = Counters()
        self.pending = []
        self.asked = []
        self.hears = True

    def events(self):
        events, self.pending = self.pending, []
        return events

    def stop(self, reason):
        self.asked.append("stop")

    def request(self, source):
        self.requested = True
        self.asked.append(source)

    def hold(self):
        if not self.requested:
            raise RequestError("closed", "no motion was requested", "hold")
        self.asked.append("hold")

    def resume(self):
        self.asked.append("resume")


class Bench:
    """A serving with all it needs, but a link."""

    def __init__(self, clock):
        self.clock = clock
        self.session = Told()
        self.ring = CycleRing.shared(N, 16)
        event_fd = event_log.create()
        self.reader = EventReader(event_fd)
        self.control = ControlBlock(control.create())
        self.ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.theirs = theirs
        self.terminated = []
        self.serving = Serving(
            self.session,
            self,
            self.ring,
            EventWriter(event_fd),
            self.control,
            theirs,
            terminated=lambda: bool(self.terminated),
            needs_archive=False,
        )

    @property
    def now(self):
        return self.clock.time

    def step(self) -> bool:
        """One packet later; whether that is the end."""
        self.clock.time += STEP
        self.control.supervisor_heartbeat = self.clock.time
        self.session.counters.answered += self.session.hears
        return self.serving()

    def time_to_the_end(self, states) -> float:
        """Steps through the states until the end, s."""
        begin = self.clock.time
        for state in states:
            self.session.state = state
            if self.step():
                return self.clock.time - begin
        raise AssertionError("it does not end")


class Clock:
    time = 1000.0

    def monotonic(self):
        return self.time


@pytest.fixture
def bench(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    bench = Bench(clock)
    yield bench
    bench.ours.close()
    bench.theirs.close()


def states(*spans):
    """States for so many seconds each."""
    for state, seconds in spans:
        yield from [state] * round(seconds / STEP)


class TestLeaving:
    def test_packets_are_answered_for_two_seconds_after_the_axes_closed(self, bench):
        bench.terminated.append(True)
        taken = bench.time_to_the_end(states((State.EXITING, 3.0), (State.CLOSED, 5.0)))
        assert taken == pytest.approx(3.0 + ORPHAN_LINGER, abs=2.1 * STEP)

    def test_axes_that_open_once_more_begin_the_two_seconds_anew(self, bench):
        bench.terminated.append(True)
        path = states((State.CLOSED, 1.0), (State.OPEN, 1.0), (State.CLOSED, 5.0))
        assert bench.time_to_the_end(path) == pytest.approx(2.0 + ORPHAN_LINGER, abs=2.1 * STEP)

    def test_a_controller_that_opens_again_and_again_cannot_put_off_the_end(self, bench):
        bench.terminated.append(True)
        path = states(*[(State.CLOSED, 0.1), (State.OPEN, 0.1)] * 1000)
        assert bench.time_to_the_end(path) == pytest.approx(LONGEST_LINGER, abs=0.11)

    def test_it_does_not_end_while_the_axes_are_open(self, bench):
        bench.terminated.append(True)
        with pytest.raises(AssertionError, match="does not end"):
            bench.time_to_the_end(states((State.CLOSED, 0.1), (State.FAULTED, 30.0)))

    def test_a_pause_may_be_one_with_open_axes(self, bench):
        bench.terminated.append(True)
        path = states((State.OPEN, 0.5), (State.FREEZING, 5.0), (State.CLOSED, 5.0))
        assert bench.time_to_the_end(path) == pytest.approx(5.5 + ORPHAN_LINGER, abs=2.1 * STEP)

    def test_a_silent_controller_is_not_waited_for(self, bench):
        bench.terminated.append(True)
        bench.session.state = State.FREEZING
        bench.step()
        bench.session.hears = False
        taken = bench.time_to_the_end(states((State.FREEZING, 10.0)))
        assert taken == pytest.approx(1.0 + ORPHAN_LINGER, abs=2.1 * STEP)

    def test_it_is_told_once(self, bench):
        bench.terminated.append(True)
        for _ in range(5):
            bench.step()
        assert len([e for e in bench.reader.drain() if isinstance(e, Leaving)]) == 1


class TestASilentSupervisor:
    @pytest.mark.parametrize(("requested", "borne"), [(True, STALE), (False, PATIENCE)])
    def test_is_borne_for_longer_where_no_motion_was_requested(self, bench, requested, borne):
        bench.step()
        bench.session.requested = requested
        silent_from = bench.control.supervisor_heartbeat
        while not bench.serving.reason:
            bench.clock.time += STEP
            bench.serving()
        assert bench.clock.time - silent_from == pytest.approx(borne, abs=1.1 * STEP)
        assert bench.serving.reason == NO_SUPERVISOR
        assert "stop" in bench.session.asked

    def test_ends_a_motion_that_it_requests_after_its_silence(self, bench):
        bench.step()
        for _ in range(round(2.0 / STEP)):
            bench.clock.time += STEP
            assert not bench.serving()
        bench.session.requested = True
        bench.serving()
        assert bench.session.asked == ["stop"]

    def test_ends_with_the_beat_that_comes_with_its_consent(self, bench, monkeypatch):
        """Which may come between any two looks of one call."""
        offered, consent = object(), bench.serving._archive.quiet
        bench.step()
        bench.serving._offered = offered
        bench.serving._inbox.identity = bench.control.program_offered = 1
        monkeypatch.setattr(bench.serving._inbox, "answer", lambda refusal: None)
        for _ in range(round(2.0 * STALE / STEP)):
            bench.clock.time += STEP
            bench.serving()

        def consents():
            bench.control.supervisor_heartbeat = bench.clock.time
            bench.control.program_id = 1
            return consent()

        monkeypatch.setattr(bench.serving._archive, "quiet", consents)
        bench.clock.time += STEP
        bench.serving()
        assert bench.session.asked == [offered]
        assert not bench.serving.reason

    def test_is_not_concluded_from_time_in_which_this_process_stood_still_itself(self, bench):
        bench.session.requested = True
        bench.step()
        for _ in range(round(0.9 * STALE / POLL)):  # each as long as the machine liked
            bench.clock.time += 3600.0
            bench.serving()
        assert not bench.serving.reason
        bench.clock.time += 0.2 * STALE
        bench.serving()
        bench.clock.time += 0.2 * STALE
        bench.serving()
        assert bench.serving.reason == NO_SUPERVISOR


class TestHold:
    def test_each_change_is_passed_on_once(self, bench):
        bench.session.requested = True
        for held in (1, 0, 1):
            bench.control.held = held
            bench.control.hold_count += 1
            bench.step()
            bench.step()
        assert bench.session.asked == ["hold", "resume", "hold"]

    def test_where_there_is_no_motion_a_hold_is_refused_and_told(self, bench):
        bench.control.held = 1
        bench.control.hold_count += 1
        bench.step()
        assert bench.session.asked == []
        (notice,) = bench.reader.drain()
        assert isinstance(notice, HoldRefused)
        assert "no motion was requested" in notice.reason

    def test_of_two_that_come_together_the_last_counts(self, bench):
        for held in (1, 0):
            bench.control.held = held
            bench.control.hold_count += 1
        bench.step()
        assert bench.session.asked == ["resume"]


class TestWhatIsTold:
    def test_a_flood_of_rejections_fills_neither_log_nor_reader(self, bench):
        for _ in range(1000):
            bench.session.pending += [PacketRejected("malformed", 20), GapSeen(1, 5)]
            bench.step()
        bench.serving.conclude()
        events = bench.reader.drain()
        assert len(events) <= 2 * (1000 * STEP / 0.1 + 2)
        assert sum(e.count for e in events if isinstance(e, PacketRejected)) == 20_000
        assert sum(e.missed for e in events if isinstance(e, GapSeen)) == 1000
        assert bench.reader.lost == 0

    def test_the_end_of_a_motion_has_a_second_witness(self, bench):
        bench.session.pending.append(MotionEnded("refused", "too fast", 3, 77))
        bench.step()
        block = bench.control
        assert (block.ended_count, block.ended_outcome, block.ended_interval) == (
            1,
            Ended.REFUSED,
            3,
        )

    def test_late_answers_are_counted_whether_they_left_or_not(self, bench):
        bench.session.counters.discarded = {"late": 4, "answered late": 3}
        bench.serving.conclude()
        assert (bench.control.late, bench.control.answered_late) == (7, 3)


@pytest.mark.parametrize("period", [0.001, 0.002])
def test_it_goes_as_far_as_a_motion_in_open_mode(period):
    assert rehearse(drive_train(), limits(), period) is State.OPEN


def test_it_tells_the_arm_to_stay_in_the_middle_of_its_range():
    lower, upper = np.linspace(-3.0, -1.0, N), np.linspace(1.0, 2.5, N)
    rehearsal = Rehearsal(drive_train(), limits(lower=lower, upper=upper), PERIOD)
    for _ in range(5):
        answer = CyclicPacket.decode(rehearsal.cycle(), N)
    assert (answer.axes["mode"] == Mode.POSITION).all()
    reported = drive_train().joint_position(answer.axes["d"][:, 0].astype(float))
    np.testing.assert_allclose(reported, 0.5 * (lower + upper), atol=1e-6)
