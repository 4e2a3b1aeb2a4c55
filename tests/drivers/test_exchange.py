"""Session and link together, in virtual time."""

from __future__ import annotations

import numpy as np
import pytest
from rig import PERIOD, START, Cruise, N, Rig, smooth_move

from drivers import (
    Corrupt,
    CyclicPacket,
    Duplicate,
    LinkLost,
    Lose,
    Mode,
    MotionEnded,
    SimulatedTransport,
    State,
    StateChanged,
    TransportClosed,
    exchange,
)

MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])


class Controller:
    """Cold start, drive on, axes open one after the other, leaves on request, ends the session.

    Its arm follows the last answer that arrived; numbers and cycles go on whatever is missed.
    """

    period = PERIOD

    def __init__(self, rig: Rig, *, stays: int | None = None):
        stays = 2000 if stays is None else stays
        self.rig = rig
        self.cycle = 0
        self.open_from = 30
        self.closing = None
        self.replies = []
        self.stays = stays

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
        return np.where(np.arange(N) * 2 + self.open_from <= self.cycle, Mode.POSITION, Mode.CLOSED)

    def accept(self, reply):
        self.replies.append(reply)
        if reply is None or self.cycle <= 12:
            return
        answer = CyclicPacket.decode(reply, N)
        self.rig._obey(answer)
        if answer.status[0] == 1 and self.closing is None:
            self.closing = self.cycle


def run(faults=(), *, stays=None, source=None):
    rig = Rig()
    controller = Controller(rig, stays=stays)
    transport = SimulatedTransport(controller, faults)
    rig.session.request(source or smooth_move(MOVE, 300))
    exchange(transport, rig.session, until=lambda: False)
    rig.events += rig.session.events()
    return rig, controller, transport


def test_a_session_from_cold_start_to_its_end():
    rig, controller, _ = run()
    assert rig.path == [
        State.INIT,
        State.DRIVE_OFF,
        State.DRIVING_ON,
        State.CLOSED,
        State.OPENING,
        State.OPEN,
        State.EXITING,
        State.CLOSED,
        State.ENDED,
    ]
    assert rig.ended.outcome == "completed"
    assert None not in controller.replies
    np.testing.assert_allclose(
        rig.train.joint_position(rig.axes["d"][:, 0].astype(float)), START + MOVE, atol=1e-6
    )


def test_two_runs_are_the_same_bytes():
    def replies():
        return run([Lose(60), Lose(80, "to_controller"), Duplicate(90), Corrupt(100, 60)])[
            1
        ].replies

    assert replies() == replies()


@pytest.mark.parametrize(
    "faults",
    [
        [Lose(cycle) for cycle in range(50, 300, 7)],
        [Lose(cycle, "to_controller") for cycle in range(50, 300, 7)],
        [Lose(cycle, count=2) for cycle in range(50, 300, 11)],
        [Duplicate(cycle) for cycle in range(13, 300)],
        [Corrupt(cycle, 3, 0xFF) for cycle in range(50, 300, 7)],
        [Corrupt(cycle, 2, 0x01) for cycle in range(50, 300, 7)],
    ],
    ids=["lost", "answers lost", "lost in pairs", "doubled", "number negative", "number far off"],
)
def test_a_motion_completes_on_a_poor_link(faults):
    rig, _, transport = run(faults)
    assert rig.ended.outcome == "completed"
    for surplus in transport.surplus_replies:
        assert surplus in [reply for _, reply in rig.transcript] or len(surplus) == 228


def test_doubled_packets_change_nothing_the_controller_sees():
    clean = run()[1].replies
    doubled = run([Duplicate(cycle) for cycle in range(400)])[1].replies
    assert doubled == clean


def test_three_packets_lost_in_a_row_stop_the_motion():
    rig, _, _ = run([Lose(300, count=3)], source=Cruise())
    assert rig.ended.outcome == "stopped"
    assert rig.path[-2:] == [State.CLOSED, State.ENDED]


def test_a_controller_that_falls_silent_ends_the_motion():
    rig, _, _ = run([Lose(150, count=10_000)], stays=1000)
    assert rig.ended.outcome == "lost"
    lost = rig.seen(LinkLost)
    assert [event.state for event in lost] == [State.OPEN]
    assert lost[0].silence == pytest.approx(1.0, abs=PERIOD)


def test_a_link_that_closes_is_silence_for_good():
    rig, _, _ = run(stays=150)
    assert rig.ended.outcome == "lost"
    assert rig.state is State.FAULTED


def test_the_exchange_ends_when_it_is_told_to():
    rig = Rig()
    controller = Controller(rig)
    transport = SimulatedTransport(controller)
    exchange(transport, rig.session, until=lambda: rig.session.state is State.CLOSED)
    assert controller.cycle == 21
    assert len(controller.replies) == 21, "the last packet was answered too"


def test_one_event_of_the_end_per_motion():
    rig, _, _ = run([Lose(150, count=10_000)], stays=1000)
    assert len(rig.seen(MotionEnded)) == 1


class Piled:
    """A link whose packets pile up now and then: each is there when the test says so."""

    ages = None

    def __init__(self, batches):
        self.batches = [list(batch) for batch in batches]
        self.now = 0.0
        self.sent = []
        self.waiting = []

    def receive(self, timeout):
        if not self.waiting and timeout > 0.0:
            if not self.batches:
                raise TransportClosed("the script is at its end")
            self.waiting = self.batches.pop(0)
            self.now += PERIOD * len(self.waiting)
        return self.waiting.pop(0) if self.waiting else None

    def send(self, packet):
        self.sent.append(packet)

    def rejected(self):
        return {}

    def forget_peer(self):
        pass

    def close(self):
        pass


class TestHeldUp:
    """What the exchange does with packets that piled up while it was not running."""

    def moving(self):
        rig = Rig()
        source = Cruise()
        rig.session.request(source)
        rig.open()
        rig.cycle(300)
        return rig, source

    def serve(self, rig, on_time, late):
        """One packet when it is due, so that the exchange knows what that is; then a pile."""
        link = Piled([[on_time], late])
        link.now = rig.now
        exchange(link, rig.session, until=lambda: False)
        return link.sent

    def test_what_was_left_unanswered_is_counted_and_seen_as_a_gap(self):
        rig, source = self.moving()
        on_time = rig.packet()
        late = [rig.packet() for _ in range(3)]
        advances = source.advances
        sent = self.serve(rig, on_time, late)
        assert len(sent) == 2
        assert source.advances == advances + 2
        assert rig.session.counters.discarded == {"late": 2}
        assert rig.session.counters.missed == 2
        assert sent[1][:4] == (rig.number + 1).to_bytes(4, "little")

    def test_more_than_the_session_bears_stop_the_motion(self):
        rig, source = self.moving()
        on_time = rig.packet()
        self.serve(rig, on_time, [rig.packet() for _ in range(6)])
        assert rig.session.counters.discarded == {"late": 5}
        assert source.stops == 1 or rig.session.state is State.FAULTED

    def test_with_closed_axes_every_packet_is_answered(self):
        rig = Rig()
        rig.close()
        on_time = rig.packet()
        late = [rig.packet() for _ in range(4)]
        assert len(self.serve(rig, on_time, late)) == 5

    def test_an_init_packet_among_them_is_never_left_out(self):
        rig, _ = self.moving()
        on_time, late = rig.packet(), rig.packet()
        assert len(self.serve(rig, on_time, [late, rig.init.encode()])) == 3
        assert State.INIT in [
            event.after for event in rig.session.events() if isinstance(event, StateChanged)
        ]

    def test_each_packet_keeps_the_ages_it_came_with(self):
        rig, _ = self.moving()
        on_time, late = rig.packet(), rig.packet()
        link = Piled([[on_time], [late, rig.init.encode(), b"short"]])
        link.now = rig.now
        ages = []
        link.ages = np.zeros((N, 8), dtype=np.uint16)
        receive, reply = link.receive, rig.session.reply

        def aging(timeout):
            link.ages += 1
            return receive(timeout)

        link.receive = aging
        rig.session.reply = lambda packet, now, age: ages.append(age[0, 0]) or reply(packet, now)
        exchange(link, rig.session, until=lambda: False)
        assert ages == [1, 2, 3, 4]

    def test_a_duplicate_is_answered_as_one(self):
        rig, _ = self.moving()
        on_time, late = rig.packet(), rig.packet()
        sent = self.serve(rig, on_time, [late, late])
        assert sent[1] == sent[2]
        assert rig.session.counters.discarded == {}
