"""Laws that hold for every motion source and every packet."""

from __future__ import annotations

import struct

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import CyclicPacket, Mode, MotionEnded, State
from drivers.packets import INIT_LENGTH, LAST_NUMBER, cyclic_length, next_number
from tests.drivers.rig import (
    NOT_SET_POINTS,
    PERIOD,
    START,
    GoesOn,
    N,
    Rig,
    Table,
    drive_train,
    limits,
)

TOLERANCE = 1e-5
BOUNDS = limits()

wild = st.floats(allow_nan=True, allow_infinity=True)
ordinary = st.floats(-1.2, 1.2)


@st.composite
def sources(draw):
    """From near-legal motions (jerk up to 1.2 times the bound) with, sometimes, a wild row."""
    cycles = draw(st.integers(1, 60))
    share = np.array(draw(st.lists(ordinary, min_size=cycles, max_size=cycles)))
    joints = np.array(draw(st.lists(st.sampled_from([-1, 0, 1]), min_size=N, max_size=N)))
    hold = draw(st.integers(1, 30))
    jerk = 100.0 * np.repeat(share, hold)[:, None] * joints
    acceleration = np.cumsum(jerk, axis=0) * PERIOD
    velocity = np.cumsum(acceleration, axis=0) * PERIOD
    rows = START + np.cumsum(velocity, axis=0) * PERIOD
    rows = np.vstack([START, rows])
    velocities = np.vstack([np.zeros(N), velocity])
    if draw(st.booleans()):
        where = draw(st.integers(0, len(rows) - 1)), draw(st.integers(0, N - 1))
        (rows if draw(st.booleans()) else velocities)[where] = draw(wild)
    return GoesOn(rows, velocities), draw(st.sampled_from(["plan", "stop"]))


@settings(max_examples=150)
@given(sources(), st.data())
def test_no_set_point_outside_the_bounds_ever_leaves(source, data):
    """What was sent is judged from records and bytes alone, by differences of its own."""
    motion, bounds = source
    factors = {"plan": (1.0, 1.0), "stop": (2.0, 3.0)}
    factor_a, factor_j = factors[bounds]
    rig = Rig(ring_capacity=4096)
    rig.session.request(motion)
    rig.close()
    rig.modes = Mode.POSITION
    wire = []
    for _ in range(len(motion.positions) + 10):
        if data.draw(st.integers(0, 60)) == 0:
            rig.miss(data.draw(st.integers(1, 2)))
        answer = rig.cycle()
        if np.isin(answer.axes["mode"], NOT_SET_POINTS).any():
            break
        wire.append(answer.axes["d"].astype(np.float64))
        if bounds == "stop":
            rig.session.stop()
    sent = rig.records["commanded_position"]
    sent = sent[np.isfinite(sent).all(axis=1)]
    assert len(sent) == len(wire)
    at_rest = np.vstack([sent[:1], sent[:1], sent[:1], sent])
    slack = 1.0 + TOLERANCE
    assert (sent >= BOUNDS.lower * slack).all()
    assert (sent <= BOUNDS.upper * slack).all()
    for order, bound in ((1, BOUNDS.velocity), (2, BOUNDS.acceleration), (3, BOUNDS.jerk)):
        factor = (None, 1.0, factor_a, factor_j)[order]
        rate = np.abs(np.diff(at_rest, order, axis=0)) / PERIOD**order
        assert (rate <= bound * factor * slack).all()
    # And the bytes say the same as the records.
    wire = np.array(wire)
    motor = drive_train().motor_revolutions(sent)
    np.testing.assert_array_equal(wire[:, :, 0], motor.astype(np.float32))
    steps = np.diff(motor, axis=0, prepend=motor[:1])
    np.testing.assert_allclose(wire[:, :, 1], steps, atol=1e-7)
    assert not wire[:, :, 2:].any()


modes = st.sampled_from([0, 4, 4, 4, 4, 5, 10, 500, 501, 502, 504, 505, 506, 508, -1])
status = st.sampled_from([5, 5, 5, 5, 5, 0, 1])


class NeverEnding:
    """Counts how often it was asked."""

    bounds = "plan"
    finished = False
    start = START

    def __init__(self):
        self.asked = 0

    def begin(self, position):
        self.position = position

    def advance(self):
        self.asked += 1
        return self.position, np.zeros(N)

    def stop(self):
        pass


@settings(max_examples=150)
@given(st.lists(st.tuples(status, st.lists(modes, min_size=N, max_size=N) | modes), max_size=40))
def test_motion_advances_only_while_every_axis_is_open_and_the_drive_is_on(story):
    rig = Rig()
    rig.close()
    asked = 0
    source = NeverEnding()
    for byte, mode in story:
        if rig.session._machine.execution is None and rig.state not in (
            State.FAULTED,
            State.ENDED,
            State.EXITING,
        ):
            rig.session.request(source)
        rig.status = byte
        rig.modes = mode
        answer = rig.cycle()
        if answer is None:
            break
        permitted = byte == 5 and (rig.modes == Mode.POSITION).all()
        if not permitted or rig.state is not State.OPEN:
            assert source.asked == asked, "asked for a set-point it must not send"
        assert source.asked <= asked + 1
        asked = source.asked


@settings(max_examples=60)
@given(st.lists(st.tuples(status, st.lists(modes, min_size=N, max_size=N) | modes), max_size=40))
def test_after_a_refusal_nothing_has_a_set_point_until_the_axes_closed(story):
    rig = Rig()
    rig.open()
    rig.axes["d"][0, 4] = 50.0
    rig.cycle()
    rig.axes["d"][0, 4] = 0.0
    assert rig.state is State.FAULTED
    for byte, mode in story:
        rig.status = byte
        rig.modes = mode
        answer = rig.cycle()
        if answer is None or rig.state is not State.FAULTED:
            break
        is_open = np.isin(rig.modes, [4, 5])
        if byte == 5 and is_open.any():
            assert np.isin(answer.axes["mode"], NOT_SET_POINTS).any()
        assert np.isnan(rig.records[-1]["commanded_position"]).all()


def packets(last: int):
    """Bytes of every kind, some of them near a real packet."""
    number = st.integers(-2, 40) | st.integers(last - 3, last + 5) | st.integers(0, 2**31 - 1)
    length = st.sampled_from([0, 3, 12, 228, 228, 228, 732, 731, 733, INIT_LENGTH])
    return st.builds(
        lambda n, size, fill: (struct.pack("<i", n) + fill * 1200)[:size],
        number,
        length,
        st.binary(min_size=1, max_size=40),
    )


@settings(max_examples=200)
@given(st.lists(packets(12), max_size=12), st.booleans())
def test_any_bytes_get_one_answer_of_the_right_number_and_length_or_none(stream, start):
    rig = Rig()
    if start:
        rig.session.request(NeverEnding())
        rig.close()
        rig.open()
    for packet in stream:
        before = rig.session.counters.answered + rig.session.counters.duplicates
        init = rig.session.init
        reply = rig.send(packet)
        after = rig.session.counters.answered + rig.session.counters.duplicates
        assert (reply is not None) == (after == before + 1)
        if reply is None:
            continue
        number = struct.unpack_from("<i", packet)[0]
        assert 1 <= number <= LAST_NUMBER
        assert struct.unpack_from("<i", reply)[0] == next_number(number)
        if len(packet) != INIT_LENGTH and init is not None and rig.session.init is init:
            assert len(reply) in (cyclic_length(init.n_axes), len(packet))


@given(st.integers(0, 400), st.integers(1, 5))
def test_a_duplicate_gets_the_same_bytes_at_any_moment(cycles, copies):
    rig = Rig()
    source = NeverEnding()
    rig.session.request(source)
    rig.open()
    rig.cycle(cycles)
    packet, reply = rig.transcript[-1]
    asked = source.asked
    for _ in range(copies):
        assert rig.send(packet) == reply
    assert source.asked == asked


@given(st.lists(st.integers(0, 5), min_size=1, max_size=40))
def test_cycles_and_gaps_always_add_up(gaps):
    rig = Rig()
    rig.close()
    first = rig.records["cycle"][-1]
    for gap in gaps:
        rig.miss(gap)
        rig.cycle()
    records = rig.records[1:]
    assert records["gap"].tolist() == gaps
    assert rig.records["cycle"][-1] == first + sum(gaps) + len(gaps)
    assert rig.session.counters.missed == sum(gaps)


def test_every_requested_motion_ends_exactly_once():
    rig = Rig()
    for _ in range(5):
        rig.session.request(Table(np.tile(START, (3, 1))))
        rig.open()
        rig.run()
    assert len(rig.seen(MotionEnded)) == 5
    assert isinstance(CyclicPacket.decode(rig.transcript[-1][1], N), CyclicPacket)
