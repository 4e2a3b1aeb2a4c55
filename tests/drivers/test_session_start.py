"""Start of a session, rejected packets, silence, and comparison of init packets with the cell."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from drivers import (
    CyclicPacket,
    InitPacket,
    InitReceived,
    LinkLost,
    Mode,
    MotionEnded,
    PacketRejected,
    RequestError,
    State,
)
from drivers.c4g_packets import DRIVE_ON, INIT_LENGTH, NO_SLOT
from drivers.c4g_wire import D1, PacketClassifier, safe_reply
from drivers.init_check import float32_text, is_narrower, verify_controller
from tests.drivers.rig import (
    PERIOD,
    START,
    N,
    Rig,
    all_drive_off,
    closed,
    drive_train,
    init_packet,
    opened,
    running,
    started,
    still,
)
from tests.messages import AXIS_NOT_OPEN, NOTHING_RECEIVED


class TestHandShake:
    def test_cold_start_echoes_nine_sync_init_and_two_sync(self):
        rig = Rig()
        rig.start(cold=True)
        assert len(rig.transcript) == 12
        for packet, reply in rig.transcript:
            number = struct.unpack_from("<i", packet)[0]
            assert reply == struct.pack("<i", number + 1) + packet[4:]
        rig.cycle(status=0)
        assert (rig.number, rig.records["cycle"].tolist()) == (13, [3])
        assert rig.path == [State.INIT, State.DRIVE_OFF]

    @pytest.mark.parametrize("length", [12, 228, 732, 1199])
    def test_sync_of_any_length_below_init_gets_its_own_length_back(self, length):
        rig = Rig()
        assert rig.sync(1, INIT_LENGTH) is None
        assert (rig.session.counters.malformed, rig.state) == (1, State.SYNC)
        assert len(rig.sync(1, length)) == length
        assert rig.send(struct.pack("<3i", 2, 0, DRIVE_ON)), "only four bytes are its status"

    def test_duplicates_get_the_same_reply(self):
        rig = started()
        for _ in range(2):
            assert rig.send(rig.init.encode()) == rig.transcript[0][1]
        assert len(rig.seen(InitReceived)) == 1
        rig.close()
        packet, reply = rig.transcript[-1]
        for _ in range(3):
            assert rig.send(packet) == reply
        counters = rig.session.counters
        assert (counters.duplicates, counters.replied, len(rig.records)) == (5, 2, 1)
        rig.now += 2.0
        assert rig.send(packet) == reply, "after a silence it is a new packet"
        assert (counters.duplicates, counters.replied, len(rig.records)) == (5, 3, 2)

    @pytest.mark.parametrize("mode", [Mode.CLOSED, Mode.POSITION, Mode.DELTA_POSITION])
    @pytest.mark.parametrize("arm", range(4))
    def test_a_packet_with_a_drive_on_is_no_sync_packet(self, mode, arm):
        rig = Rig()
        rig.number = 5000
        rig.modes = mode
        for count in range(1, 4):
            packet = bytearray(rig.packet())
            packet[4:8] = bytes(4)
            packet[4 + arm] = DRIVE_ON
            assert rig.send(bytes(packet)) is None
            assert rig.session.counters.malformed == count
        assert rig.state is State.SYNC
        rig.start()
        assert rig.cycle() is not None

    @pytest.mark.parametrize(
        ("numbers", "retained"),
        [
            ((), True),
            (range(1, 10), True),
            (range(1, 8), True),
            (range(1, 7), False),
            ((1,), False),
        ],
    )
    def test_request_before_the_init_packet(self, numbers, retained):
        """It is dropped if sync packets before the init packet are missing."""
        rig = Rig()
        rig.session.tick(0.0)
        rig.session.request(still(3))
        for number in numbers:
            rig.sync(number)
        rig.send(rig.init.encode())
        assert rig.session.requested is retained
        if not retained:
            reason = "the controller restarted: sync packets are missing"
            assert (rig.ended.outcome, rig.ended.reason) == ("lost", reason)


class TestReplies:
    @pytest.mark.parametrize("status", [0, DRIVE_ON])
    def test_mode_504_is_the_last_to_get_a_reply(self, status):
        """Zeros; everything is echoed if the drive is off."""
        rig = started()
        rig.axes["d"] = np.random.default_rng(3).uniform(-1, 1, (N, 5))
        answer = rig.cycle(mode=Mode.END_OF_SESSION, status=status)
        last_packet = rig.transcript[-1][0]
        received = CyclicPacket.decode(last_packet, N).axes.tobytes()
        assert answer.axes.tobytes() == (bytes(36 * N) if status else received)
        assert rig.state is State.ENDED
        assert rig.cycle() is None
        assert rig.send(last_packet) is None
        assert rig.send(rig.init.encode()) is None
        assert rig.session.counters.ended == 3
        assert rig.seen(PacketRejected) == [PacketRejected("ended", 1)] * 3
        assert rig.session.deadline == np.inf

    def test_reply_to_a_longer_packet(self):
        rig = started()
        packet = rig.packet()
        reply = rig.send(packet + b"\xa5" * (732 - len(packet)))
        assert len(reply) == 228
        assert b"\xa5\xa5\xa5\xa5" not in reply

    def test_number_too_far_ahead_is_stale(self):
        rig = closed()
        answered = rig.number
        old = rig.transcript[-1][0]
        rig.number = answered + 500
        assert rig.cycle() is None, "1 s is 500 cycles; this one is 501 ahead"
        rig.number = answered + 499
        assert rig.cycle() is not None
        assert rig.session.counters.missed == 499
        assert rig.send(old) is None
        assert rig.session.counters.stale == 2
        assert rig.seen(PacketRejected) == [PacketRejected("stale", 1)] * 2
        assert rig.seen(PacketRejected)[-1].reason.endswith("does not follow 511")

    @pytest.mark.parametrize(
        ("packet", "reason"),
        [
            *((packet, "expected at least the 12") for packet in (b"", b"\x0b", bytes(11))),
            (struct.pack("<i", 11) + bytes(223), "227 bytes: packet length"),
            (bytes(228), "228 bytes: packet number is 0; expected 1..32767"),
        ],
    )
    def test_malformed_packets(self, packet, reason):
        rig = started()
        assert rig.send(packet) is None
        assert rig.state is State.INIT
        assert rig.session.counters.malformed == 1
        (event,) = rig.seen(PacketRejected)
        assert reason in event.reason

    @pytest.mark.parametrize(
        ("status", "length", "reason"),
        [
            (DRIVE_ON, 732, "status is '05000000'; expected no drive on before init"),
            (0, INIT_LENGTH, f"length is {INIT_LENGTH}; expected less than {INIT_LENGTH} bytes"),
        ],
    )
    def test_malformed_packets_before_init(self, status, length, reason):
        rig = Rig()
        rig.sync(1)
        assert rig.send(struct.pack("<2i", 2, status) + bytes(length - 8)) is None
        (event,) = rig.seen(PacketRejected)
        assert event.reason == f"{length} bytes: packet {reason}"


class TestSilence:
    def test_deadline(self):
        """Of 300 s before the init packet and in a pause, 1 s otherwise."""
        rig = Rig()
        assert rig.session.deadline == np.inf
        rig.session.tick(5.0)
        assert rig.session.deadline == 305.0
        rig.now = 6.0
        rig.close()
        deadline = rig.session.deadline
        assert deadline == pytest.approx(rig.now + 1.0)
        rig.send(rig.transcript[-1][0])
        rig.send(b"nonsense")
        assert rig.session.deadline == deadline, "rejected packets do not move it"
        for pause in (Mode.PAUSE_BY_PC, Mode.PAUSE_BY_CONTROLLER):
            rig.cycle(mode=pause)
            assert rig.state is State.FREEZING
            assert rig.session.deadline == pytest.approx(rig.now + 300.0)

    def test_silence_before_init_drops_requests(self):
        rig = Rig()
        rig.session.tick(0.0)
        rig.session.request(still(3))
        rig.session.tick(301.0)
        assert not rig.session.requested
        ended = [event for event in rig.session.events() if isinstance(event, MotionEnded)]
        assert [(event.outcome, event.reason) for event in ended] == [("lost", NOTHING_RECEIVED)]
        rig.session.request(still(3))  # a later request waits
        rig.now = 500.0
        rig.close()
        assert rig.session.requested

    def test_silence_is_a_fault_reported_once(self):
        rig = closed()
        rig.session.tick(rig.now + 0.999)
        assert rig.state is State.CLOSED
        rig.session.tick(rig.now + 1.0)
        rig.session.tick(rig.now + 9.0)
        rig.events += rig.session.events()
        assert rig.state is State.FAULTED
        assert rig.seen(LinkLost) == [LinkLost(pytest.approx(1.0), State.CLOSED)]

    def test_after_silence_any_number_or_a_cold_start_gets_a_reply(self):
        """And silence is detected without a tick."""
        rig = closed()
        rig.now += 5.0
        rig.number += 9000
        assert rig.cycle() is not None
        assert rig.path[-2:] == [State.FAULTED, State.CLOSED]
        # How long it was, numbers that wrap around cannot show.
        assert rig.records["gap"][-1] == 0
        assert np.diff(rig.records["cycle"][-2:]) == 1
        rig.now += 60.0
        rig.start(cold=True)
        rig.cycle()
        assert rig.path[-4:] == [State.FAULTED, State.SYNC, State.INIT, State.CLOSED]

    def test_stale_packets_are_not_silence(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.close()
        for _ in range(30):
            rig.number = 3
            assert rig.cycle() is None
        rig.session.tick(rig.now + 2.0)
        rig.events += rig.session.events()
        assert [event.stale for event in rig.seen(LinkLost)] == [30]
        assert rig.ended.reason == "only packets that do not follow the last one came (30)"


def test_a_new_session_has_no_controller_and_no_motion():
    session = Rig().session
    assert (session.state, session.cycle, session.entered_at) == (State.SYNC, 0, 0)
    assert (session.interval, session.in_interval) == (-1, False)
    assert (session.execution, session.stop_reason) == (None, None)
    assert (session.init, session.deadline) == (None, np.inf)
    assert session.losses.instead_of_packets == ""


class TestConstruction:
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            *(({"max_gap": gap}, rf"gap of {gap} .* not one of 0\.\.100") for gap in (-1, 101)),
            *(({"arm": arm}, rf"arm {arm} is not one of 1\.\.4") for arm in (0, 5)),
            *(
                ({"mode": mode}, f"mode {mode} is not served; modes 4, 5 are")
                for mode in (0, 1, 2, 3, 6, 7, 8, 9, 10, 11, 12, 14, 15, 17, 501)
            ),
            *(
                ({"only_axis": axis}, rf"only axis {axis} is not one of 1\.\.6")
                for axis in (0, N + 1)
            ),
        ],
    )
    def test_invalid_options(self, options, message):
        with pytest.raises(ValueError, match=message):
            Rig(**options)

    @pytest.mark.parametrize(
        "options", [{"max_gap": 0}, {"max_gap": 100}, {"arm": 4}, {"only_axis": N}]
    )
    def test_options_at_their_ends(self, options):
        assert Rig(**options).state is State.SYNC

    def test_parts_for_different_numbers_of_joints_are_refused(self):
        rig = Rig()
        with pytest.raises(ValueError, match=r"^drive train, guard and ring differ"):
            type(rig.session)(rig.train, rig.guard, type(rig.ring)(5))


def test_discarded_packets_are_reported_once():
    session = Rig().session
    for kind, count in (("foreign", 0), ("foreign", -1)):
        session.discarded(kind, count)
    assert (session.counters.discarded, session.events()) == ({}, [])
    for kind, count in (("foreign", 3), ("torn", 1), ("foreign", 2), ("malformed", 3)):
        session.discarded(kind, count)
    session.reply(b"short", 3.0)
    assert session.deadline == 303.0, "from the first packet on, whatever it is"
    assert session.counters.discarded == {"foreign": 5, "torn": 1, "malformed": 3}
    assert session.counters.malformed == 1, "which the link discarded is not the session's"
    counts = {event.kind: event.count for event in session.events()}
    assert counts == {"foreign": 5, "torn": 1, "malformed": 4}
    assert session.events() == []
    session.discarded("foreign", 1)
    (event,) = session.events()
    assert event == PacketRejected("foreign", 1)
    assert event.reason == "", "the link did not say why"
    assert session.counters.discarded["foreign"] == 6
    assert Rig().session.counters.discarded == {}


def test_drive_off_has_zeros_for_values_not_finite():
    rig = opened()
    rig.axes["d"][2, :] = np.nan
    rig.axes["d"][4, 2] = np.inf
    answer = rig.cycle()
    assert all_drive_off(answer)
    expected = rig.train.motor_revolutions(START)
    expected[2] = 0.0
    np.testing.assert_allclose(answer.axes["d"][:, 0], expected, rtol=1e-6)
    np.testing.assert_array_equal(answer.axes["d"][:, 1:], 0.0)


def test_packets_with_the_same_modes_are_classified_once():
    classifier = PacketClassifier(np.arange(2), (1, 1), 1, 4)
    modes = np.array([4, 4], np.int32)
    first = classifier.classify(bytes(4), modes)
    assert classifier.classify(bytes(4), modes.copy()) is first
    modes[1] = 0
    assert classifier.classify(bytes(4), modes) is not first


@pytest.mark.parametrize(
    ("arms", "status", "powered", "back"),
    [
        (None, [3, 4, 7, 9], False, [3, 0, 0, 0]),
        (None, [3, 7, DRIVE_ON, 9], True, [0, 0, 0, 0]),
        ((1, 1), [3, 7, DRIVE_ON, 9], False, [3, 0, 0, 0]),
        ((1, 1), [DRIVE_ON, 7, 0, 9], True, [0, 0, 0, 0]),
        ((1, 4), [3, 7, DRIVE_ON, 9], False, [3, 0, 0, 9]),
    ],
)
def test_unknown_arms_are_on_if_any_drive_is(arms, status, powered, back):
    """Then nothing is echoed; four status bytes go back, none of which is drive on."""
    answer = safe_reply(bytes(status), np.full(2, Mode.CLOSED, np.int32), arms)
    assert answer.status == bytes(back)
    assert answer.mask[:, D1:].all() == (not powered)
    opened = np.full(2, Mode.POSITION, np.int32)
    reading = PacketClassifier(np.arange(2), arms, 1, Mode.POSITION).classify(bytes(status), opened)
    assert reading.powered == powered


def described(*changes, **build) -> InitPacket:
    """An init packet with changes (field, axis, value) of arm 1."""
    init = init_packet(**build)
    for name, axis, value in changes:
        init.record[name][0, 0, axis] = value
    return init


def received(init: InitPacket, **options) -> tuple[Rig, InitReceived]:
    rig = started(init=init, **options)
    return rig, rig.seen(InitReceived)[0]


def beside(arm: int, axis: int) -> InitPacket:
    """One with a seventh open axis, of this arm or of another."""
    table = np.full((4, 10), NO_SLOT)
    table[0, :N] = range(N)
    table[arm - 1, axis - 1] = N
    return init_packet(n_axes=N + 1, open_axes_map=table)


NOWHERE = np.full((4, 10), 1)
FOUR_OPEN = np.full((4, 10), NO_SLOT)
FOUR_OPEN[0, :N] = [0, NO_SLOT, 1, 2, NO_SLOT, 3]
CYCLE = "cycle is 1 ms in the controller, 2 ms in the cell"
ANOTHER_ARM = [
    *(("gear_ratio", 2, value, "gear ratio of axis 3") for value in
      (np.nan, 0.0, 110.0, -110.01, -110.0 * (1 + 4e-6), np.inf)),
    *(("calibration", 2, value, "calibration of axis 3") for value in
      (np.nan, 0.0, 2.00001, -2.0)),
    *(("kinematic_influence", entry, value, name) for value in (np.nan, 0.0, 0.0101) for
      entry, name in ((3, "k54 of axis 5"), (4, "k64 of axis 6"), (5, "k65 of axis 6"))),
]  # fmt: skip


def test_axes_of_another_arm_do_not_open_an_unusable_one():
    init = beside(2, 1)
    init.record["gear_ratio"][0, 0, 2] = 1.0
    rig, event = received(init, other_axes={(2, 1)})
    assert event.unusable
    rig.close()
    rig.modes[N] = rig.mode
    rig.cycle()
    assert rig.state is State.CLOSED


class TestInit:
    """Differences are named with the axis and both values; with one of them nothing moves."""

    @pytest.mark.parametrize(
        ("init", "difference"),
        [
            *((described(change[:3]), f"{change[3]} is ") for change in ANOTHER_ARM),
            (init_packet(sample_time=1), CYCLE),
            (init_packet(sample_time=1500), "cycle is 1500 ms"),
            (init_packet(n_axes=5), "axis 6 of arm 1 is not open"),
            (init_packet(open_axes_map=NOWHERE), "packet open_axes_map"),
            (beside(1, 7), "axis 7 of arm 1 is open in the controller; the cell does not know it"),
            (beside(2, 1), "axis 1 of arm 2 is open in the controller; the cell does not know it"),
            (beside(4, 10), "axis 10 of arm 4 is open"),
        ],
    )
    def test_arm_with_a_difference_is_not_moved(self, init, difference):
        rig = Rig(init=init)
        rig.session.request(still(3))
        rig.start()
        (event,) = rig.seen(InitReceived)
        assert event.differences == (event.unusable,)
        assert event.unusable.startswith(difference)
        assert rig.cycle() is not None
        for _ in range(2):
            assert all_drive_off(rig.cycle(mode=Mode.POSITION))
        assert event.unusable in str(rig.refusal)
        rig.cycle(mode=Mode.CLOSED)
        with pytest.raises(RequestError, match=difference):
            rig.session.request(still(3))

    def test_rounding_of_float32_is_no_difference(self):
        init = init_packet(arm_1={"calibration": np.array([0.5, -1.25, 2, 1e-8, 0.25, -0.75])})
        up = np.float32(np.inf)
        for name in ("gear_ratio", "calibration", "kinematic_influence"):
            row = init.record[name][0, 0]
            row[:N] = np.where(row[:N] != 0, np.nextafter(row[:N], up), row[:N])
        for packet in (init, init_packet(), described(("gear_ratio", 6, np.nan))):
            _, event = received(packet)
            assert (event.differences, event.unusable) == ((), None)

    def test_a_wrist_without_coupling_is_no_difference(self):
        train = replace(drive_train(), k54=0.0, k64=0.0, k65=0.0)
        init = init_packet(arm_1={"kinematic_influence": np.zeros(N)})
        assert verify_controller(train, PERIOD, init, 1).differences == ()

    def test_every_difference_is_named(self):
        changes = (("gear_ratio", 0, 119.5), ("kinematic_influence", 5, 0.04))
        _, event = received(described(*changes, sample_time=4, open_axes_map=NOWHERE))
        assert event.unusable == "; ".join(event.differences)
        assert event.differences[2] == (
            "gear ratio of axis 1 is 119.5 in the controller, -120 in the cell"
        )
        names = ("cycle", "packet open_axes_map", "gear ratio of axis 1", "k65 of axis 6")
        for difference, name in zip(event.differences, names, strict=True):
            assert difference.startswith(name)
        _, event = received(init_packet(n_axes=4, open_axes_map=FOUR_OPEN))
        assert event.differences == tuple(
            f"axis {axis} of arm 1 {AXIS_NOT_OPEN}, joint {axis} in the cell" for axis in (2, 5)
        )

    @pytest.mark.parametrize(("arm", "axis"), [(1, 7), (2, 1)])
    def test_other_axis_is_held(self, arm, axis):
        rig = running(still(3), init=beside(arm, axis), other_axes={(arm, axis)})
        (event,) = rig.seen(InitReceived)
        assert (event.unusable, event.differences) == (None, ())
        rig.run_to("completed")
        _, event = received(beside(arm, axis), other_axes={(arm, 8), (3, axis)})
        assert f"axis {axis} of arm {arm}" in event.unusable


class TestNextInit:
    def test_is_compared_with_the_cell(self):
        rig, event = received(described(("gear_ratio", 2, np.nan)))
        assert "gear ratio of axis 3" in event.unusable
        rig.init = init_packet()
        rig.start()
        assert rig.seen(InitReceived)[-1].unusable is None
        assert rig.state is State.INIT


@pytest.mark.parametrize(
    ("theirs", "ours", "below"),
    [
        (np.float32(1.23456514), 1.23457, False),  # rounded to six digits
        (np.float32(1.2345), 1.2346, True),
        (np.float32(0.1), 0.1, False),
        (np.float32(np.nan), 1.0, False),
    ],
)
def test_limit_rounded_to_six_digits_is_not_narrower(theirs, ours, below):
    assert is_narrower(np.array([theirs], dtype=np.float64), np.array([ours])).tolist() == [below]


@pytest.mark.parametrize(("value", "text"), [(18.4, "18.4"), (20.0, "20"), (0.1, "0.1")])
def test_a_float32_is_written_with_the_digits_it_was_given(value, text):
    assert float32_text(np.float32(value)) == text
