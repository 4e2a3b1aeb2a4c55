"""Memory shared by the exchange, and its work between two packets."""

from __future__ import annotations

import fcntl
import math
import os
import pickle
import socket
import struct
import time
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import GapSeen, MotionEnded, State, StateChanged
from drivers.cycle_records import CycleRing
from drivers.errors import RequestError
from drivers.events import Counters, Outcome, PacketRejected, RepliesLost
from drivers.exchange import control, event_log, motion_transfer
from drivers.exchange.control import (
    FIRST_BIN_SECONDS,
    HEARTBEAT_TIMEOUT,
    IDLE_HEARTBEAT_TIMEOUT,
    LATENCY_BINS,
    MAX_CALL_INTERVAL,
    OUTCOMES,
    ArchiveState,
    HeartbeatMonitor,
    SharedState,
    bin_of,
    quantile,
    upper_edge,
)
from drivers.exchange.event_log import (
    NO_SUPERVISOR,
    NO_SUPERVISOR_AT_REST,
    EventReader,
    EventsLost,
    EventWriter,
    Leaving,
)
from drivers.exchange.loop import POLL_PERIOD
from drivers.exchange.serving import DETACHED_LINGER, MAX_LINGER, CommandHandler, EventLimiter
from tests.drivers.rig import Cruise, N, still
from tests.messages import MISSED_IN_A_ROW

pytestmark = pytest.mark.safety


def gaps(numbers):
    return [GapSeen(1, number) for number in numbers]


class TestEventLog:
    @staticmethod
    def log(capacity=4096, events=()):
        """A log with these events: memory, writer, reader."""
        fd = event_log.create(capacity)
        writer = EventWriter(fd)
        reader = EventReader(fd)
        for event in events:
            writer.write(event)
        return fd, writer, reader

    def test_each_reader_gets_all_events_in_order(self):
        events = [GapSeen(2, 7), StateChanged(State.OPEN, State.EXITING, 9)]
        fd, _, reader = self.log(events=events)
        for each in (reader, EventReader(fd)):
            assert (each.drain(), each.drain(), each.lost) == (events, [], 0)

    @given(st.lists(st.integers(0, 12), max_size=40), st.integers(300, 1100))
    def test_each_event_is_read_in_order_or_counted(self, steps, capacity):
        fd, writer, reader = self.log(capacity)
        written = 0
        seen = []
        reported = 0
        for count in steps:
            for cycle in range(written, written + count):
                writer.write(PacketRejected("x" * (cycle % 30), cycle))
            written += count
            events = reader.drain()
            seen += [event.count for event in events if isinstance(event, PacketRejected)]
            reported += sum(event.count for event in events if isinstance(event, EventsLost))
        assert seen == sorted(set(seen))
        assert len(seen) + reader.lost == written
        assert reported == reader.lost
        os.close(fd)

    def test_corrupt_frame_counts_as_lost(self):
        fd, _, reader = self.log(events=gaps([1, 2, 3]))
        length = struct.unpack("<I", os.pread(fd, 4, 256))[0]
        os.pwrite(fd, b"\xff", 256 + 16 + length // 2)
        assert reader.drain() == [EventsLost(1), *gaps([2, 3])]
        assert reader.lost == 1

    def test_frames_overwritten_during_the_copy_are_dropped(self):
        _, writer, reader = self.log(400, gaps([1, 2, 3]))
        copy = reader._get

        def overtaken(position, count):
            for event in gaps([4, 5]):
                writer.write(event)
            reader._get = copy
            return copy(position, count)

        reader._get = overtaken
        lost, *seen = reader.drain() + reader.drain()
        assert lost == EventsLost(reader.lost)
        assert seen == gaps(range(6 - len(seen), 6))
        assert 0 < len(seen) < 5
        assert len(seen) + reader.lost == 5

    def test_event_longer_than_the_log_is_refused(self):
        with pytest.raises(ValueError, match="an event of"):
            self.log(100, [PacketRejected("x" * 200, 1)])


class TestEventLimiter:
    @given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), max_size=200))
    def test_sums_are_exact_and_events_few(self, steps):
        limiter = EventLimiter()
        reported = []
        now = 0.0
        rejected = 0
        missed = 0
        for count, kind in steps:
            events = [PacketRejected(f"kind {kind}", count), GapSeen(count, round(now * 1000))]
            rejected += count
            missed += count
            reported += [(now, event) for event in limiter.filter(events, now)]
            now += 0.001
        reported += [(now, event) for event in limiter.flush()]
        assert sum(e.count for _, e in reported if isinstance(e, PacketRejected)) == rejected
        assert sum(e.missed for _, e in reported if isinstance(e, GapSeen)) == missed
        assert len(reported) <= 5 * (now / 0.1 + 2)

    def test_first_passes_at_once_and_the_sums_after_the_period(self):
        limiter = EventLimiter()
        assert limiter.filter([GapSeen(1, 7)], 0.0) == [GapSeen(1, 7)]
        assert limiter.filter([GapSeen(2, 9), RepliesLost(1, 9)], 0.01) == []
        assert limiter.filter([GapSeen(1, 12), RepliesLost(2, 12)], 0.05) == []
        assert limiter.filter([], 0.099) == []
        assert limiter.filter([], 0.1) == [GapSeen(3, 12), RepliesLost(3, 12)]
        assert limiter.filter([], 1.0) == limiter.flush() == []

    def test_sums_precede_the_end_of_a_motion(self):
        limiter = EventLimiter()
        limiter.filter([GapSeen(1, 7)], 0.0)
        ended = MotionEnded("stopped", f"5 {MISSED_IN_A_ROW}", 0, 9)
        assert limiter.filter([GapSeen(5, 9), ended], 0.01) == [GapSeen(5, 9), ended]


def test_control_block():
    with pytest.raises(ValueError, match="no shared state"):
        SharedState(CycleRing.shared(N, 10).fd)
    assert sorted(OUTCOMES) == sorted(get_args(Outcome)), "each outcome has a number"


class TestMotionTransfer:
    def test_a_copy_equals_the_original_with_read_only_arrays(self):
        here = still(5000)
        there = motion_transfer.unpack(motion_transfer.pack(here))
        assert not there.positions.flags.writeable
        there.begin(there.start)
        here.begin(here.start)
        for _ in range(3):
            np.testing.assert_array_equal(there.advance(), here.advance())
        small = motion_transfer.unpack(motion_transfer.pack(Cruise()))
        small.start += 1.0

    def test_memory_is_sealed(self):
        fd = motion_transfer.pack(still(10))
        with pytest.raises(OSError, match="not permitted"):
            os.pwrite(fd, b"x", 0)
        assert fcntl.fcntl(fd, fcntl.F_GET_SEALS) & fcntl.F_SEAL_WRITE
        with pytest.raises((ValueError, OSError)):
            motion_transfer.unpack(control.create())

    def test_source_that_cannot_be_pickled_is_refused(self):
        source = still(10)
        source.callback = lambda: None
        with pytest.raises((pickle.PicklingError, AttributeError)):
            motion_transfer.pack(source)


class TestLatencyBins:
    LONGEST = upper_edge(LATENCY_BINS - 2)

    @given(
        st.lists(st.floats(FIRST_BIN_SECONDS, LONGEST), min_size=1),
        st.floats(0.0, 1.0, exclude_min=True),
    )
    def test_quantile_is_at_most_one_bin_too_long(self, latencies, share):
        counts = [0] * LATENCY_BINS
        for seconds in latencies:
            counts[bin_of(seconds)] += 1
        estimated = quantile(counts, share)
        assert estimated is not None
        needed = sorted(latencies)[max(0, math.ceil(share * len(latencies) - 1e-9) - 1)]
        assert needed <= estimated * (1.0 + 1e-12)
        assert estimated <= needed * 2.0**0.25 * (1.0 + 1e-12)

    @pytest.mark.parametrize(
        ("latencies", "place"),
        [
            ((0.0, -1e-3, math.nan, FIRST_BIN_SECONDS), 0),
            ((100.0, 1e300, math.inf), LATENCY_BINS - 1),
        ],
    )
    def test_first_and_last_bin_are_unbounded(self, latencies, place):
        assert {bin_of(seconds) for seconds in latencies} == {place}
        assert upper_edge(LATENCY_BINS - 1) == math.inf
        assert 20.0 < self.LONGEST < 25.0, "longer than any reply that is waited for"


class Clock:
    """Time, and another process's heartbeat."""

    time = 1000.0
    beat = 1.0

    def monotonic(self):
        return self.time


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    return clock


class TestHeartbeatMonitor:
    def test_silence_ends_with_the_next_heartbeat(self, clock):
        monitor = HeartbeatMonitor(lambda: clock.beat)

        def watch(seconds, *, beating=False):
            """Poll each 0.1 s; return the last silence, s."""
            for _ in range(round(seconds / 0.1)):
                clock.time += 0.1
                clock.beat += beating
                quiet = monitor.silence()
            return quiet

        assert watch(10.0, beating=True) == 0.0
        assert watch(6.0) == pytest.approx(6.0)
        assert watch(0.1, beating=True) == 0.0
        clock.beat = 0.0  # before the first
        assert watch(10.0) == 0.0

    @pytest.mark.parametrize("longest", [MAX_CALL_INTERVAL, 0.1])
    def test_suspension_of_the_computer_is_not_silence(self, clock, longest):
        monitor = HeartbeatMonitor(lambda: clock.beat, max_interval=longest)
        clock.time += 3600.0
        assert monitor.silence() == longest


STEP = 0.01


class FakeSession:
    """A session in a given state that receives a packet per step."""

    requested = False
    interval = -1
    init = None

    def __init__(self):
        self.state = State.CLOSED
        self.counters = Counters()
        self.pending = []
        self.calls = []
        self.receives_packets = True

    def events(self):
        events = self.pending
        self.pending = []
        return events

    def stop(self, reason):
        self.calls.append("stop")

    def request(self, source):
        self.requested = True
        self.calls.append(source)

    def hold(self):
        if not self.requested:
            raise RequestError("closed", "no motion was requested", "hold")
        self.calls.append("hold")

    def resume(self):
        self.calls.append("resume")

    def override(self, fraction):
        self.hold()


class Bench:
    """A control server without a link."""

    def __init__(self, clock):
        self.clock = clock
        self.session = FakeSession()
        event_fd = event_log.create()
        self.reader = EventReader(event_fd)
        self.control = SharedState(control.create())
        self.ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.terminated = False
        self.serving = CommandHandler(
            self.session,
            self,
            CycleRing.shared(N, 16),
            EventWriter(event_fd),
            self.control,
            self.theirs,
            terminated=lambda: self.terminated,
            needs_archive=False,
        )

    @property
    def now(self):
        return self.clock.time

    def later(self, seconds=STEP) -> bool:
        """Call the server then; whether that is the end."""
        self.clock.time += seconds
        return self.serving()

    def step(self) -> bool:
        """One packet and heartbeat later; whether that is the end."""
        self.control.supervisor_heartbeat = self.clock.time + STEP
        self.session.counters.replied += self.session.receives_packets
        return self.later()

    def time_to_the_end(self, states) -> float:
        """Steps through the states until the end, s."""
        begin = self.clock.time
        for state in states:
            self.session.state = state
            if self.step():
                return self.clock.time - begin
        raise AssertionError("it does not end")


@pytest.fixture
def bench(clock):
    bench = Bench(clock)
    yield bench
    bench.ours.close()
    bench.theirs.close()


def states(*spans):
    """States for so many seconds each."""
    for state, seconds in spans:
        yield from [state] * round(seconds / STEP)


class TestLeaving:
    @pytest.fixture
    def bench(self, bench):
        bench.terminated = True
        return bench

    @pytest.mark.parametrize(
        ("spans", "seconds"),
        [
            ([(State.EXITING, 3.0), (State.CLOSED, 5.0)], 3.0),
            ([(State.CLOSED, 1.0), (State.OPEN, 1.0), (State.CLOSED, 5.0)], 2.0),
            # A pause may be one with open axes.
            ([(State.OPEN, 0.5), (State.FREEZING, 5.0), (State.CLOSED, 5.0)], 5.5),
        ],
    )
    def test_packets_are_answered_two_seconds_after_closing(self, bench, spans, seconds):
        assert bench.time_to_the_end(states(*spans)) == pytest.approx(
            seconds + DETACHED_LINGER, abs=2.1 * STEP
        )
        assert len([e for e in bench.reader.drain() if isinstance(e, Leaving)]) == 1

    def test_axes_that_open_repeatedly_do_not_delay_the_end(self, bench):
        path = states(*[(State.CLOSED, 0.1), (State.OPEN, 0.1)] * 1000)
        assert bench.time_to_the_end(path) == pytest.approx(MAX_LINGER, abs=0.11)

    def test_no_end_while_axes_are_open(self, bench):
        with pytest.raises(AssertionError, match="does not end"):
            bench.time_to_the_end(states((State.CLOSED, 0.1), (State.FAULTED, 30.0)))

    def test_no_wait_for_a_silent_controller(self, bench):
        bench.session.state = State.FREEZING
        bench.step()
        bench.session.receives_packets = False
        assert bench.time_to_the_end(states((State.FREEZING, 10.0))) == pytest.approx(
            1.0 + DETACHED_LINGER, abs=2.1 * STEP
        )


class TestSupervisorHeartbeat:
    @pytest.mark.parametrize(
        ("requested", "timeout"), [(True, HEARTBEAT_TIMEOUT), (False, IDLE_HEARTBEAT_TIMEOUT)]
    )
    def test_timeout_is_longer_without_a_motion(self, bench, requested, timeout):
        bench.step()
        bench.session.requested = requested
        silent_from = bench.control.supervisor_heartbeat
        while not bench.serving.reason:
            bench.later()
        assert bench.clock.time - silent_from == pytest.approx(timeout, abs=1.1 * STEP)
        reason = NO_SUPERVISOR if requested else NO_SUPERVISOR_AT_REST
        assert bench.serving.reason == reason
        assert "stop" in bench.session.calls

    def test_motion_requested_after_a_silence_is_stopped(self, bench):
        bench.step()
        assert not any(bench.later() for _ in range(round(2.0 / STEP)))
        bench.session.requested = True
        bench.serving()
        assert bench.session.calls == ["stop"]

    def test_heartbeat_with_the_permission_ends_the_silence(self, bench, monkeypatch):
        """It may arrive between any two readings of one call."""
        offered = object()
        consent = bench.serving._archive.silence
        bench.step()
        bench.serving._offered = offered
        bench.serving._inbox.identity = bench.control.program_offered = 1
        monkeypatch.setattr(bench.serving._inbox, "answer", lambda refusal: None)
        for _ in range(round(2.0 * HEARTBEAT_TIMEOUT / STEP)):
            bench.later()

        def consents():
            bench.control.supervisor_heartbeat = bench.clock.time
            bench.control.program_id = 1
            return consent()

        monkeypatch.setattr(bench.serving._archive, "silence", consents)
        bench.later()
        assert bench.session.calls == [offered]
        assert not bench.serving.reason

    def test_time_in_which_this_process_stood_still_is_no_silence(self, bench):
        bench.session.requested = True
        bench.step()
        for _ in range(round(0.9 * HEARTBEAT_TIMEOUT / POLL_PERIOD)):
            bench.later(3600.0)
        assert not bench.serving.reason
        for _ in range(2):
            bench.later(0.2 * HEARTBEAT_TIMEOUT)
        assert bench.serving.reason == NO_SUPERVISOR


@pytest.mark.parametrize("state", [ArchiveState.READY, ArchiveState.FAILED])
def test_motion_is_stopped_without_archive(bench, state):
    """That has failed, or whose process sends no heartbeat."""
    bench.serving._needs_archive = bench.session.requested = True
    bench.control.archive_state = ArchiveState.READY
    for _ in range(100):
        bench.control.archive_heartbeat = bench.clock.time
        bench.step()
    assert bench.session.calls == []
    bench.control.archive_state = state
    cycles = 1 if state is ArchiveState.FAILED else round(1.1 * HEARTBEAT_TIMEOUT / STEP)
    for _ in range(cycles):
        bench.step()
    assert "stop" in bench.session.calls
    assert not bench.serving.reason, "the exchange goes on"


class TestHold:
    @staticmethod
    def change(bench, *held):
        for each in held:
            bench.control.held = each
            bench.control.hold_count += 1
        bench.step()
        bench.step()

    def test_each_change_is_applied_once(self, bench):
        bench.session.requested = True
        for held in (1, 0, 1):
            self.change(bench, held)
        assert bench.session.calls == ["hold", "resume", "hold"]
        self.change(bench, 1, 0)  # of two changes between two packets the last is applied
        assert bench.session.calls[3:] == ["resume"]

    def test_impossible_commands_are_refused(self, bench):
        self.change(bench, 1)
        bench.control.override = float("nan")
        bench.control.override_count += 1
        bench.step()
        assert bench.session.calls == []
        notices = bench.reader.drain()
        assert [notice.command for notice in notices] == ["hold", "override of nan"]
        assert all("no motion was requested" in notice.reason for notice in notices)


class TestPublished:
    def test_flood_of_rejections_gives_few_events(self, bench):
        for _ in range(1000):
            bench.session.pending += [PacketRejected("malformed", 20), GapSeen(1, 5)]
            bench.step()
        bench.serving.conclude()
        events = bench.reader.drain()
        assert len(events) <= 2 * (1000 * STEP / 0.1 + 2)
        assert sum(e.count for e in events if isinstance(e, PacketRejected)) == 20_000
        assert sum(e.missed for e in events if isinstance(e, GapSeen)) == 1000
        assert bench.reader.lost == 0

    def test_end_of_a_motion_is_in_the_control_block(self, bench):
        bench.session.pending.append(MotionEnded("refused", "too fast", 3, 77))
        bench.step()
        block = bench.control
        assert (block.ended_count, block.outcome, block.ended_interval) == (1, "refused", 3)

    def test_late_replies_are_counted_sent_or_not(self, bench):
        bench.session.counters.discarded = {
            "late": 4, "replied to late": 3, "came late": 5, "bunched": 6,
        }  # fmt: skip
        bench.serving.conclude()
        assert (bench.control.late, bench.control.replied_late) == (7, 3)
        assert bench.control.late_packets == 11, "they are not this computer's"
