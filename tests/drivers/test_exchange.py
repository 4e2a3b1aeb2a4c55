"""Session and link together, in virtual time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers import (
    Corrupt,
    CyclicPacket,
    Duplicate,
    LinkLost,
    Lose,
    Mode,
    SimulatedTransport,
    State,
    StateChanged,
    TransportClosed,
    exchange,
)
from drivers.c4g_wire import C4gProtocol
from drivers.exchange.loop import MAX_REPLIED_PACKETS
from drivers.wire import ArmSettings
from tests.drivers.rig import (
    MOVE,
    PERIOD,
    START,
    Cruise,
    N,
    Rig,
    closed,
    drive_train,
    moving,
    smooth_move,
)
from tests.messages import LEFT_TOO_LATE

pytestmark = pytest.mark.safety


class Controller:
    """Cold start, drive on, axes open one after the other, leaves on request, ends the session.

    Its arm follows the last answer that arrived; numbers and cycles continue without replies.
    """

    period = PERIOD

    def __init__(self, rig: Rig, stays: int = 2000):
        self.rig = rig
        self.stays = stays
        self.cycle = 0
        self.closing = None
        self.replies = []

    def next_packet(self):
        self.cycle += 1
        if self.cycle > self.stays:
            return None
        if self.cycle == 10:
            self.rig.number = 10
            return self.rig.init.encode()
        if self.cycle <= 12:
            return self.cycle.to_bytes(4, "little") + bytes(728)
        self.rig.number = max(self.rig.number, 12)
        self.rig.status = 5 if self.cycle > 16 else 0
        self.rig.modes = self._modes()
        return self.rig.packet()

    def _modes(self):
        if self.closing is not None:
            done = self.cycle - self.closing
            return Mode.END_OF_SESSION if done > 20 else Mode.CLOSED if done > 3 else Mode.POSITION
        if self.cycle <= 20:
            return Mode.DRIVING_ON if self.cycle > 16 else Mode.CLOSED
        return np.where(np.arange(N) * 2 + 30 <= self.cycle, Mode.POSITION, Mode.CLOSED)

    def accept(self, reply):
        self.replies.append(reply)
        if reply is None or self.cycle <= 12:
            return
        answer = CyclicPacket.decode(reply, N)
        self.rig._follow(answer)
        if answer.status[0] == 1 and self.closing is None:
            self.closing = self.cycle


def run(faults=(), *, stays=2000, source=None):
    rig = Rig()
    controller = Controller(rig, stays)
    transport = SimulatedTransport(controller, faults)
    rig.session.request(source or smooth_move(MOVE, 300))
    exchange(transport, rig.session, ends_when=lambda: False)
    rig.events += rig.session.events()
    return rig, controller, transport


class TestExchange:
    def test_session_from_cold_start_to_its_end(self):
        rig, controller, _ = run()
        names = "INIT DRIVE_OFF DRIVING_ON CLOSED OPENING OPEN EXITING CLOSED ENDED"
        assert [state.name for state in rig.path] == names.split()
        assert rig.ended.outcome == "completed"
        assert None not in controller.replies
        np.testing.assert_allclose(
            rig.train.joint_position(rig.axes["d"][:, 0].astype(float)), START + MOVE, atol=1e-6
        )

    @pytest.mark.parametrize(
        "fault",
        [
            lambda cycle: Lose(7 * cycle),
            lambda cycle: Lose(50 * cycle, "to_controller"),
            lambda cycle: Lose(11 * cycle, count=2),
            Duplicate,
            lambda cycle: Corrupt(7 * cycle, offset=3, mask=0xFF),
            lambda cycle: Corrupt(7 * cycle, offset=2, mask=0x01),
        ],
        ids=["lost", "answers lost", "pairs lost", "doubled", "number negative", "number far off"],
    )
    def test_motion_completes_on_a_poor_link(self, fault):
        faults = [fault(cycle) for cycle in range(1, 300)]
        rig, _, transport = run([fault for fault in faults if 50 <= fault.cycle < 300])
        assert rig.ended.outcome == "completed"
        for surplus in transport.surplus_replies:
            assert surplus in [reply for _, reply in rig.transcript] or len(surplus) == 228

    def test_three_consecutive_losses_stop_the_motion(self):
        rig, _, _ = run([Lose(300, count=3)], source=Cruise())
        assert rig.ended.outcome == "stopped"
        assert rig.path[-2:] == [State.CLOSED, State.ENDED]

    def test_silent_controller_or_closed_link_ends_the_motion(self):
        rig, _, _ = run([Lose(150, count=10_000)], stays=1000)
        assert rig.ended.outcome == "lost"
        (lost,) = rig.seen(LinkLost)
        assert lost.state is State.OPEN
        assert lost.silence == pytest.approx(1.0, abs=PERIOD)
        rig, _, _ = run(stays=150)
        assert (rig.ended.outcome, rig.state) == ("lost", State.FAULTED)

    def test_exchange_ends_by_its_condition(self):
        rig = Rig()
        controller = Controller(rig)
        transport = SimulatedTransport(controller)
        exchange(transport, rig.session, ends_when=lambda: rig.session.state is State.CLOSED)
        assert controller.cycle == 21
        assert len(controller.replies) == 21, "the last packet was answered too"


class Link:
    """A link with packets of a script; `forgotten` has the replies sent at each `forget_peer`."""

    def __init__(self, now=0.0):
        self.now = now
        self.sent = []
        self.forgotten = []

    def send(self, packet):
        self.sent.append(packet)

    def rejected(self):
        return {}

    def forget_peer(self):
        self.forgotten.append(len(self.sent))

    def close(self):
        pass


class Backlogged(Link):
    """Packets arrive in batches, without time stamps; then silence for some time, s."""

    def __init__(self, batches, now=0.0, silence=0.0):
        super().__init__(now)
        self.batches = [list(batch) for batch in batches]
        self.waiting = []
        self.silence = silence

    def receive(self, timeout):
        if not self.waiting and timeout > 0.0:
            if self.batches:
                self.waiting = self.batches.pop(0)
                self.now += PERIOD * len(self.waiting)
            elif self.silence <= 0.0:
                raise TransportClosed("the script is at its end")
            else:
                self.silence -= timeout
                self.now += timeout
        return self.waiting.pop(0) if self.waiting else None


class Bunched(Link):
    """Packets arrive at the times of a script, with time stamps."""

    arrived = None

    def __init__(self, script, now=0.0):
        super().__init__(now)
        self.script = list(script)

    def receive(self, timeout):
        if not self.script and timeout > 0.0:
            raise TransportClosed("the script is at its end")
        if not self.script or (timeout <= 0.0 and self.script[0][0] > self.now + 0.1 * PERIOD):
            return None
        self.arrived, packet = self.script.pop(0)
        self.now = max(self.now, self.arrived)
        return packet

    def wake_up(self, now):
        """This process does not run until `now`."""
        self.now = max(self.now, now)
        return False


class TestBacklog:
    """Replies to packets that arrived while the exchange was not running."""

    def on_time(self, rig):
        """The next packet; those after it report the set-point that answers it."""
        packet = rig.packet()
        rig.axes["d"][0, [0, 2]] += rig.axes["d"][0, 1]
        return packet

    def serve(self, rig, on_time, late):
        """Deliver one packet in time, then a batch."""
        link = Backlogged([[on_time], late], rig.now)
        exchange(link, rig.session, ends_when=lambda: False)
        return link.sent

    @staticmethod
    def number_after(rig):
        return (rig.number + 1).to_bytes(4, "little")

    @staticmethod
    def states(rig):
        return [e.after for e in rig.session.events() if isinstance(e, StateChanged)]

    @pytest.mark.parametrize("waiting", [2, 30, 65, 200, 1000])
    @pytest.mark.parametrize("length", [228, 732])
    def test_only_the_newest_of_a_backlog_is_answered(self, waiting, length):
        """Some controllers send 732 bytes whatever the number of axes; the rest is garbage."""
        chance = np.random.default_rng(5178)
        rig, source = moving()
        packets = []
        for _ in range(waiting + 1):
            rig.axes["d"][:, 4] = chance.uniform(-1.0, 1.0, N)
            packet = rig.packet()
            functionality = chance.bytes(4)
            packets.append(packet[:8] + functionality + packet[12:] + chance.bytes(length - 228))
        advances = source.advances
        sent = self.serve(rig, packets[0], packets[1:])
        assert len(sent) == 2
        assert sent[1][:4] == self.number_after(rig)
        assert source.advances <= advances + 2
        assert rig.session.counters.discarded == {"late": waiting - 1}
        assert waiting < 4 or source.stops == 1 or rig.session.state is State.FAULTED

    @pytest.mark.parametrize("after", [0.0, 0.2])
    def test_bunched_packets_do_not_advance_the_motion(self, after):
        """Seven of them at once with the first, or soon after it."""
        rig, source = moving()
        packets = [rig.packet() for _ in range(9)]
        # One on time, eight together that were held up on their way.
        bunch = [9.0, *(9.0 + after + 0.01 * k for k in range(1, 8))]
        times = rig.now + PERIOD * np.array([1.0, *bunch])
        link = Bunched(zip(times, packets, strict=True))
        advances = source.advances
        exchange(link, rig.session, ends_when=lambda: False)
        assert source.advances <= advances + 3
        assert len(link.sent) == (3 if after else 2)
        assert link.sent[-1][:4] == self.number_after(rig)

    def test_packets_that_are_read_in_time_get_their_replies(self):
        """In each cycle a second follows closely; the first is read a third of a cycle later."""
        rig, _ = moving()
        times = rig.now + PERIOD * np.array([1.0, 1.05, 2.0, 2.05])
        packets = [self.on_time(rig) for _ in times]
        link = Bunched(zip(times, packets, strict=True), rig.now + 1.3 * PERIOD)
        exchange(link, rig.session, ends_when=lambda: False)
        assert len(link.sent) == 4
        assert rig.session.counters.discarded == {}
        np.testing.assert_array_equal(rig.records["arrival"][-4:], times)

    def test_axes_that_open_within_a_backlog_do_not_run_ahead(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.close()
        on_time = rig.packet()
        late = [rig.packet() for _ in range(3)]
        rig.modes = Mode.POSITION
        late += [rig.packet() for _ in range(100)]
        assert len(self.serve(rig, on_time, late)) == 3
        assert source.advances <= 1

    @pytest.mark.parametrize(
        ("axes", "state"), [(slice(N), State.CLOSED), (slice(N - 1, N), State.FAULTED)]
    )
    def test_axes_that_closed_within_a_backlog_are_detected(self, axes, state):
        rig, source = moving()
        on_time = rig.packet()
        late = []
        for mode in (Mode.POSITION, Mode.CLOSED, Mode.POSITION):
            rig.modes[axes] = mode
            late += [rig.packet() for _ in range(5)]
        advances = source.advances
        assert len(self.serve(rig, on_time, late)) == 3
        assert source.advances <= advances + 1
        assert state in self.states(rig)

    @pytest.mark.parametrize(
        ("apart", "counts"),
        [
            (0.01, {"late": 1, "bunched": 3}),
            (0.49, {"late": 1, "bunched": 3}),
            (0.51, {"late": 4}),
            (1.0, {"late": 4}),
        ],
    )
    def test_packets_left_out_are_late_or_bunched(self, apart, counts):
        """It reads one, and four that came from a cycle later on, after the last of them."""
        rig, _ = moving()
        packets = [rig.packet() for _ in range(5)]
        times = rig.now + PERIOD * np.array([1.0, *(2.0 + apart * np.arange(4))])
        link = Bunched(zip(times, packets, strict=True))
        exchange(link, rig.session, ends_when=lambda: link.wake_up(times[-1]))
        assert rig.session.counters.discarded == counts

    def test_overtaken_packets_of_a_backlog_are_dropped(self):
        rig, source = moving()
        on_time, *overtaken = self.on_time(rig), rig.packet(), rig.packet()
        advances = source.advances
        sent = self.serve(rig, on_time, [rig.packet(), *overtaken])
        assert [reply[:4] for reply in sent][1:] == [self.number_after(rig)]
        assert source.advances == advances + 2
        counters = rig.session.counters
        assert (counters.discarded, counters.missed, counters.stale) == ({"late": 2}, 2, 0)

    def test_packet_after_an_init_packet_is_not_one_before_it(self):
        """Its number, which is low, would make it look overtaken."""
        rig, _ = moving()
        on_time = self.on_time(rig)
        late = rig.packet()
        init = rig.init.encode()
        rig.number = 10
        again = [init, rig.packet(), rig.packet()]
        sent = self.serve(rig, on_time, [late, *again, init, again[1]])
        assert [int.from_bytes(reply[:4], "little") for reply in sent[2:]] == [11, 13, 11, 12]

    def test_each_packet_gets_a_reply_while_any_peer_may_start(self):
        """They may be of several peers."""
        sync = [number.to_bytes(4, "little") + bytes(728) for number in (1, 2, 3)]
        assert len(self.serve(Rig(), sync[0], sync[1:])) == 3

    @pytest.mark.parametrize("place", [None, *range(4)])
    @pytest.mark.parametrize("garbled", [0x10, 0x20, 0x40])
    def test_dropped_packets_are_a_gap_also_with_a_corrupt_number(self, place, garbled):
        """Once a corrupt number replaced the newest packet and got no reply."""
        rig, source = moving()
        on_time = self.on_time(rig)
        late = [rig.packet() for _ in range(3)]
        advances = source.advances
        if place is not None:
            wrong = bytearray(late[min(place, 2)])
            wrong[1] ^= garbled
            late.insert(place, bytes(wrong))
        sent = self.serve(rig, on_time, late)
        assert len(sent) == 2
        assert sent[1][:4] == self.number_after(rig)
        assert source.advances == advances + 2
        assert rig.session.counters.discarded == {"late": 2}
        assert rig.session.counters.missed == 2
        assert rig.session.counters.stale == (place is not None)

    @pytest.mark.parametrize(("apart", "dropped"), [(1000, 1), (1001, 0)])
    @pytest.mark.parametrize("turned", [False, True])
    def test_numbers_far_apart_are_of_two_sessions(self, apart, dropped, turned):
        rig, _ = moving()
        on_time = self.on_time(rig)
        first = rig.packet()
        second = (rig.number + apart).to_bytes(4, "little") + first[4:]
        self.serve(rig, on_time, [second, first] if turned else [first, second])
        assert rig.session.counters.discarded.get("late", 0) == dropped

    @given(st.lists(st.integers(0, 255), max_size=400))
    @example([*range(200)])
    def test_newest_of_the_kinds_seen_last_are_answered(self, statuses):
        packets = [
            number.to_bytes(4, "little") + bytes([status, 0, 0, 0]) + bytes(220)
            for number, status in enumerate(statuses)
        ]
        session = EchoSession()
        link = Backlogged([packets])
        exchange(link, session, ends_when=lambda: False)
        # The first one came alone.
        newest = sorted({status: number for number, status in enumerate(statuses[1:], 1)}.values())
        expected = [*packets[:1], *(packets[number] for number in newest[-MAX_REPLIED_PACKETS:])]
        assert link.sent == expected
        assert len(link.sent) + session.discards.get("late", 0) == len(packets)

    def test_init_packet_in_a_backlog_is_answered(self):
        rig, _ = moving()
        on_time = rig.packet()
        late = rig.packet()
        assert len(self.serve(rig, on_time, [late, rig.init.encode()])) == 3
        assert State.INIT in self.states(rig)

    def test_packet_and_duplicate_get_one_reply(self):
        rig, _ = moving()
        on_time = rig.packet()
        late = rig.packet()
        assert len(self.serve(rig, on_time, [late, late])) == 2
        assert rig.session.counters.discarded == {}


class EchoSession:
    """A session that answers everything with itself, a cycle of 2 ms."""

    state = State.OPEN
    period = PERIOD
    init = None
    wire = C4gProtocol().wire(ArmSettings(drive_train(), PERIOD, Mode.POSITION, 1, (), None, 1.0))
    deadline = 1e9

    def __init__(self):
        self.cycle = 0
        self.discards = {}
        self.stops = []

    def reply(self, packet, now):
        return packet

    def discarded(self, kind, count):
        self.discards[kind] = self.discards.get(kind, 0) + count

    def tick(self, now):
        pass

    def stop(self, reason):
        self.stops.append(reason)


class Paced(Link):
    """A link whose packets arrive each period; each reply takes some time.

    With `patient`, the controller does not begin a cycle before it has the answer to the last.
    """

    def __init__(self, costs, *, patient=False, stamped=True, slower=0.0):
        super().__init__()
        self.due = PERIOD
        self.costs = list(costs)
        self.number = 0
        self.patient = patient
        self.period = PERIOD * (1.0 + slower)
        self.answered = []
        if stamped:
            self.arrived = None

    def receive(self, timeout):
        if not self.costs:
            raise TransportClosed("the script is at its end")
        if self.due > self.now + timeout:
            self.now += timeout
            return None
        if hasattr(self, "arrived"):
            self.arrived = self.due
        self.now = max(self.now, self.due)
        self.due += self.period
        self.number += 1
        return self.number.to_bytes(4, "little") + bytes(224)

    def reply(self, packet, now):
        self.now += self.costs.pop(0) * PERIOD
        return packet

    def send(self, packet):
        self.answered.append(int.from_bytes(packet[:4], "little"))
        if self.patient:
            self.due = max(self.due, self.now + 0.2 * PERIOD)


@pytest.mark.parametrize("end", ["asked for", "closed link"])
def test_last_rejections_of_the_link_are_counted(end):
    link = Paced([0.1] * 7)
    session = EchoSession()
    link.rejected = lambda: {"foreign": 1}
    session.reply = link.reply
    exchange(link, session, ends_when=lambda: end == "asked for" and not link.costs)
    assert len(link.answered) == 7
    assert session.discards["foreign"] == 1  # at the end: fewer packets than between two readings


def test_rejections_are_counted_every_hundred_packets():
    link = Paced([0.1] * 250)
    session = EchoSession()
    readings = []
    link.rejected = lambda: readings.append(link.number) or {}
    session.reply = link.reply
    exchange(link, session, ends_when=lambda: not link.costs)
    assert readings == [100, 200, 250]


@pytest.mark.parametrize("stamped", [True, False], ids=["stamped", "unstamped"])
class TestLateness:
    def run(self, costs, *, state=State.OPEN, stamped=True, patient=False, max_late=2):
        link = Paced(costs, patient=patient, stamped=stamped)
        session = EchoSession()
        session.state = state
        session.reply = link.reply
        exchange(link, session, ends_when=lambda: False, max_late=max_late)
        return link, session

    @pytest.mark.parametrize("cost", [0.1, 0.9, 0.99])
    def test_replies_within_their_cycle_are_not_late(self, cost, stamped):
        link, session = self.run([cost] * 50, stamped=stamped)
        assert session.discards.get("replied to late", 0) == 0
        assert link.answered == list(range(1, 51))
        assert session.stops == []

    @pytest.mark.parametrize("cost", [1.05, 1.1, 1.3, 1.49, 1.6, 3.5])
    def test_slight_overload_stops_the_motion(self, cost, stamped):
        link, session = self.run([cost] * 50, stamped=stamped)
        assert session.discards["replied to late"] >= 49
        if stamped:
            assert session.stops[0] == f"3 {LEFT_TOO_LATE}"
        else:
            assert session.stops == [], "when a packet arrived was only guessed"
        # And the answers do not fall behind: each is to what came within the last cycle.
        assert link.answered[-1] >= 49 * cost - 1

    @pytest.mark.parametrize("state", [State.CLOSED, State.DRIVING_ON, State.EXITING])
    def test_late_replies_are_counted_in_every_state(self, state, stamped):
        _, session = self.run([1.2] * 50, state=state, stamped=stamped)
        assert session.discards["replied to late"] >= 49
        assert session.stops == []

    def test_packets_without_a_reply_are_not_replied_to_late(self, stamped):
        link = Paced([1.2] + [0.1] * 10, stamped=stamped)
        session = EchoSession()
        session.state = State.OPEN

        def reply(packet, now):
            echo = link.reply(packet, now)
            return echo if link.number == 1 else None

        session.reply = reply
        exchange(link, session, ends_when=lambda: False)
        assert session.discards["replied to late"] == 1
        assert session.stops == []

    def test_controller_that_waits_for_replies_is_not_stopped(self, stamped):
        _, session = self.run([1.2, 1.2, 0.1, 0.1] * 10, stamped=stamped)
        assert session.discards["replied to late"] >= 20
        assert session.stops == []  # at most two late replies are consecutive
        _, session = self.run([1.5] * 50, patient=True, stamped=stamped)
        assert session.stops == []


@pytest.mark.parametrize("slower", [0.0, 0.0001, 0.005])
def test_estimated_arrivals_count_no_reply_as_late(slower):
    """Nor where the cycle of the controller is slightly longer than stated."""
    link = Paced([0.95] * 20_000, stamped=False, slower=slower)
    session = EchoSession()
    arrivals = []
    session.reply = lambda packet, now: arrivals.append(now) or link.reply(packet, now)
    exchange(link, session, ends_when=lambda: False)
    assert session.discards.get("replied to late", 0) == 0
    assert session.stops == []
    assert np.diff(arrivals).min() > 0.9 * PERIOD, "they are recorded as they were received"


class TestPacketsThatComeLate:
    """A rig's controller sends in its cycle, and the link delays what it sends."""

    def serve(self, delays, *, skipped=0, away=0.0):
        """Packets arrive a number of cycles late; `skipped` packets before the last are lost."""
        rig = closed()
        times, packets = [], []
        for cycle, delay in enumerate(delays, 1):
            packet = rig.packet()
            if not len(delays) - skipped <= cycle < len(delays):
                times.append(rig.now + (cycle + delay) * PERIOD)
                packets.append(packet)
        link = Bunched(zip(times, packets, strict=True))
        exchange(link, rig.session, ends_when=lambda: link.wake_up(link.now + away * PERIOD))
        return rig.session.counters

    @pytest.mark.parametrize(
        ("delays", "counts"),
        [
            ([0.0] * 20, {}),
            ([0.0, 0.4] * 10, {}),
            ([0.0] * 10 + [1.2, 0.25] + [0.0] * 10, {"bunched": 1}),
            ([0.0] * 10 + [1.01] * 10, {"came late": 1}),
            ([0.0] * 10 + [0.0, 5.0] + [5.0] * 10, {"came late": 1}),
        ],
    )
    def test_they_are_counted_as_packets_and_not_as_replies(self, delays, counts):
        """By their number: a controller whose cycles are shifted was late once."""
        assert self.serve(delays).discarded == counts

    def test_packets_lost_before_one_do_not_make_it_late(self):
        counters = self.serve([0.0] * 20, skipped=6)
        assert (counters.missed, counters.discarded) == (6, {})

    def test_a_computer_that_reads_late_is_to_blame_itself(self):
        assert self.serve([0.0] * 20, away=1.2).discarded.keys() == {"late"}

    def test_without_times_of_arrival_no_packet_is_called_late(self):
        rig = closed()
        first, second = rig.packet(), rig.packet()
        link = Backlogged([[first], [second]], rig.now, silence=0.0)
        exchange(link, rig.session, ends_when=lambda: bool(setattr(link, "now", link.now + 0.1)))
        assert rig.session.counters.discarded == {}


class TestFullQueue:
    def serve(self, rig, packets, since):
        """The queue had no room for what came in the last `since` cycles."""
        times = rig.now + PERIOD * np.arange(1, len(packets) + 1)
        link = Bunched(zip(times, packets, strict=True), times[-1] + since * PERIOD)
        exchange(link, rig.session, ends_when=lambda: False)
        return link

    @pytest.mark.parametrize(
        ("is_open", "count", "since", "replies"),
        [
            (True, 20, 4.0, 0),
            (True, 20, 100.0, 0),
            (True, 20, 434.0, 0),
            (True, 20, 1.0, 1),
            (True, 1, 100.0, 1),
            (False, 20, 100.0, 1),
        ],
    )
    def test_newest_of_an_old_backlog_gets_no_reply(self, is_open, count, since, replies):
        """While axes are open: a single packet or a recent one gets its reply."""
        rig, source = moving() if is_open else (closed(), None)
        advances = getattr(source, "advances", 0)
        cycle = rig.session.cycle
        link = self.serve(rig, [rig.packet() for _ in range(count)], since)
        assert len(link.sent) == replies
        assert rig.session.counters.discarded.get("late", 0) == count - replies
        if not replies:
            assert (source.advances, rig.session.cycle) == (advances, cycle)

    def test_init_packet_of_an_old_backlog_is_answered(self):
        rig, _ = moving()
        packets = [rig.packet() for _ in range(5)]
        self.serve(rig, [*packets, rig.init.encode()], 100.0)
        assert State.INIT in TestBacklog.states(rig)


class TestDeadline:
    def test_silence_is_counted_from_the_reply(self):
        rig = closed(silence_timeout=1.0)
        link = Bunched([(rig.now + PERIOD, rig.packet())], rig.now + PERIOD + 0.9)
        exchange(link, rig.session, ends_when=lambda: bool(link.sent))
        assert len(link.sent) == 1
        assert rig.session.deadline == pytest.approx(link.now + 1.0)
        assert rig.session._ring.last(1)["arrival"][0] == pytest.approx(rig.now + PERIOD)

    def test_duplicate_does_not_extend_the_deadline(self):
        rig = closed()
        packet = rig.packet()
        link = Bunched([(rig.now + PERIOD, packet), (rig.now + 0.5, packet)], rig.now)
        exchange(link, rig.session, ends_when=lambda: len(link.sent) == 2)
        assert rig.session.deadline == pytest.approx(rig.now + PERIOD + 1.0)


class TestPeerSelection:
    SYNC = (1).to_bytes(4, "little") + bytes(728)

    def test_sender_of_valid_start_packets_is_the_peer(self):
        rig = Rig()
        rig.number = 12
        link = Backlogged([[b"\xff" * 60], [self.SYNC], [rig.init.encode()], [rig.packet()]])
        exchange(link, rig.session, ends_when=lambda: False)
        assert link.forgotten == [0], "not the one whose sync packet was answered"
        assert len(link.sent) == 3

    @pytest.mark.parametrize(
        ("batches", "silence", "forgotten"),
        [
            ([[SYNC], [b"\xff" * 60], [SYNC]], 0.0, [1]),
            ([[SYNC]], 0.8, []),
            ([[SYNC]], 1.1, [1]),
        ],
        ids=["no reply", "short silence", "silence"],
    )
    def test_peer_is_forgotten_without_reply_or_after_a_silence(self, batches, silence, forgotten):
        days = 5e5  # of the computer's clock, s
        link = Backlogged(batches, days, silence)
        exchange(link, Rig().session, ends_when=lambda: False)
        assert link.forgotten[:1] == forgotten

    def test_lost_session_accepts_the_peer_that_gets_a_reply(self):
        rig = closed()
        rig.session.tick(rig.now + 2.0)
        link = Backlogged([[b"\xff" * 60], [rig.packet()], [rig.packet()]], rig.now + 2.0)
        exchange(link, rig.session, ends_when=lambda: False)
        assert link.forgotten == [0]
        assert len(link.sent) == 2
