"""Laws of the CAN frames under lost, doubled and delayed frames; segments; bus load."""

from __future__ import annotations

import re
from collections import Counter

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import CycleRing, CyclicPacket, Guard, Session, exchange
from drivers.packets import LAST_NUMBER, next_number
from drivers.transports.can.codecs import NEVER, words_of
from drivers.transports.can.ends import LONGEST, SegmentAssembler, Segmenter
from drivers.transports.can.layout import (
    LOAD_LIMIT,
    SEGMENT_DOWN,
    SEGMENT_UP,
    BusRates,
    CanBusLoadError,
    Frame,
    classic_bits,
)
from tests.drivers.can_bench import (
    NS16,
    PROFILES,
    Cycles,
    N,
    PacedByPackets,
    Wire,
    ns16_controller,
    random_packet,
    virtual_ends,
    wide_limits,
)

FRESH = (0, 1, 3, 5)
"""Mode, D1, D3 and D5 among the nine words of an axis."""
D4 = 4
SLOW = (2, 6, 7, 8)

fates = st.sampled_from(["pass"] * 12 + ["lose"] * 2 + ["double", "delay"])


@st.composite
def disturbances(draw, most=400):
    """Fate of each frame, and by how many frames it is delayed."""
    return [(draw(fates), draw(st.integers(1, 12))) for _ in range(draw(st.integers(20, most)))]


def disturbed(frames, fate_of):
    """Yield the frames delivered by the bus: (time, frame) in the order of arrival."""
    arrivals = []
    for index, (time, frame) in enumerate(frames):
        fate, by = fate_of[index % len(fate_of)]
        if fate == "lose":
            continue
        arrivals.append((index + (by if fate == "delay" else 0), time, frame))
        if fate == "double":
            arrivals.append((index + by, time, frame))
    arrivals.sort(key=lambda arrival: arrival[0])
    newest = 0.0
    for _, time, frame in arrivals:
        newest = max(newest, time)
        yield newest, frame


def numbers(first, count):
    for _ in range(count):
        yield first
        first = next_number(first)


def sent_cycles(profile, seed, first, cycles):
    wire = Wire(profile)
    rng = np.random.default_rng(seed)
    packets = {number: random_packet(rng, number) for number in numbers(first, cycles)}
    frames = []
    for packet in packets.values():
        wire.time += 0.002
        frames += [(wire.time, frame) for frame in wire.far.packet(packet)]
    return wire, packets, frames


def assert_sent(packet, ages, packets, classic):
    """Check that every field received was sent, as many cycles ago as its age."""
    number = int.from_bytes(packet[:4], "little")
    original = packets[number]
    assert packet[4:8] == original[4:8]
    got, wanted = words_of(packet, N), words_of(original, N)
    np.testing.assert_array_equal(got[:, FRESH], wanted[:, FRESH])
    assert (ages[:, [0, 2, 4]] == 0).all()
    order = list(packets)
    for column in SLOW:
        for axis in range(N):
            age = int(ages[axis, column - 1])
            if age == NEVER:
                assert np.isnan(got[axis].view(np.float32)[column])
                continue
            source = order[order.index(number) - age]
            assert got[axis, column] == words_of(packets[source], N)[axis, column]
    if not classic:
        np.testing.assert_array_equal(got[:, D4], wanted[:, D4])


@pytest.mark.parametrize("profile", PROFILES)
@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    first=st.sampled_from([11, 5000, LAST_NUMBER - 10]),
    fate_of=disturbances(),
)
def test_packets_are_not_mixed(profile, seed, first, fate_of):
    wire, packets, frames = sent_cycles(profile, seed, first, 40)
    for time, frame in disturbed(frames, fate_of):
        packet = wire.near.receive(frame, time)
        if packet is not None:
            assert_sent(packet, wire.near.ages, packets, profile == "classic")


@pytest.mark.parametrize("profile", PROFILES)
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    first=st.sampled_from([11, LAST_NUMBER - 10]),
    fate_of=disturbances(),
)
def test_replies_are_not_mixed(profile, seed, first, fate_of):
    wire = Wire(profile)
    rng = np.random.default_rng(seed)
    replies, frames = {}, []
    for number in numbers(first, 12):
        wire.up(random_packet(rng, number))
        number = next_number(number)
        reply = CyclicPacket.zeros(number, N)
        reply.axes["mode"] = rng.choice([4, 505, 508], size=N, p=[0.8, 0.1, 0.1])
        reply.axes["d"][:, 0] = rng.integers(-(2**20), 2**20, N) / 2**16
        replies[number] = reply
        frames += [(wire.time, frame) for frame in wire.near.reply(reply.encode())]
    for time, frame in disturbed(frames, fate_of):
        packet = wire.far.receive(frame, time)
        if packet is None:
            continue
        got = CyclicPacket.decode(packet, N)
        wanted = replies[got.number].axes
        np.testing.assert_array_equal(got.axes["mode"], wanted["mode"])
        moved = wanted["mode"] == 4
        np.testing.assert_array_equal(got.axes["d"][moved, 0], wanted["d"][moved, 0])


@pytest.mark.parametrize("profile", PROFILES)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_lost_frame_loses_one_cycle(profile, data):
    wire, packets, frames = sent_cycles(profile, 1, 11, 6)
    per_cycle = len(frames) // 6
    lost = data.draw(st.integers(0, len(frames) - per_cycle - 1))
    out = []
    for index, (time, frame) in enumerate(frames):
        packet = wire.near.receive(frame, time) if index != lost else None
        if packet is not None:
            out.append(int.from_bytes(packet[:4], "little"))
    assert out == [number for number in packets if number != 11 + lost // per_cycle]
    assert wire.near.discarded == {"torn": 1}


def test_equal_counters_of_other_cycles_are_not_mixed():
    """Classic frames carry four bits of the number: sixteen cycles later they are the same."""
    wire, _, frames = sent_cycles("classic", 3, 11, 17)
    first, last = frames[:7], frames[-7:]
    mixed = [*first[:4], *last[4:]]
    assert [wire.near.receive(frame, time) for time, frame in mixed] == [None] * 7
    assert wire.near.discarded == {"torn": 1}


def test_of_overlapping_sets_the_newer_is_received():
    wire, _, frames = sent_cycles("fd", 4, 11, 2)
    (t0, a0), (_, b0), (t1, a1), (_, b1) = frames
    arrivals = [(t0, a0), (t1, a1), (t1, b0), (t1, b1)]
    out = [wire.near.receive(frame, time) for time, frame in arrivals]
    assert out[:3] == [None] * 3
    assert int.from_bytes(out[3][:4], "little") == 12
    assert wire.near.discarded == {"torn": 1}


# Segments.


@settings(max_examples=60, deadline=None)
@given(
    size=st.sampled_from([8, 64]),
    packets=st.lists(st.binary(min_size=1, max_size=1500), min_size=1, max_size=6),
    fate_of=disturbances(most=60),
)
def test_segments_give_complete_packets_or_none(size, packets, fate_of):
    cut, joined = Segmenter(size), SegmentAssembler(size, Counter())
    frames = [
        (float(i), Frame(SEGMENT_UP, payload))
        for i, packet in enumerate(packets)
        for payload in cut.split(packet)
    ]
    out = [joined.add(frame.data, 1e-3 * time) for time, frame in disturbed(frames, fate_of)]
    out = [packet for packet in out if packet is not None]
    remaining = iter(packets)
    assert all(packet in remaining for packet in out), "each at most once, in order"


@settings(max_examples=60, deadline=None)
@given(
    size=st.sampled_from([8, 64]),
    packet=st.binary(min_size=1, max_size=300),
    data=st.data(),
)
def test_changed_bit_is_detected(size, packet, data):
    discarded = Counter()
    joined = SegmentAssembler(size, discarded)
    payloads = Segmenter(size).split(packet)
    which = data.draw(st.integers(0, len(payloads) - 1))
    # Padding means nothing; only the bytes that do are changed.
    room = size - 2
    used = 8 if which == 0 else 2 + min(room, len(packet) - (which - 1) * room)
    at = data.draw(st.integers(0, 8 * used - 1))
    changed = bytearray(payloads[which])
    changed[at // 8] ^= 1 << at % 8
    payloads[which] = bytes(changed)
    assert [joined.add(payload, 0.0) for payload in payloads] == [None] * len(payloads)
    joined.add(Segmenter(size).split(b"next")[0][:1] + b"\x01next", 10.0)
    assert discarded["corrupt"] + discarded["torn"] + discarded["malformed"] >= 1


@pytest.mark.parametrize("size", [8, 64])
@pytest.mark.parametrize("length", [1, 12, 62, 63, 732, 1200, LONGEST])
def test_packets_of_every_length_are_assembled(size, length):
    packet = np.random.default_rng(length).bytes(length)
    joined = SegmentAssembler(size, Counter())
    *early, last = [joined.add(p, 0.0) for p in Segmenter(size).split(packet)]
    assert early == [None] * len(early)
    assert last == packet


@pytest.mark.parametrize("length", [0, LONGEST + 1])
def test_invalid_packet_length_is_refused(length):
    with pytest.raises(ValueError, match=f"not {length}"):
        Segmenter(64).split(bytes(length))


@pytest.mark.parametrize("size", [8, 64])
def test_lost_segment_loses_the_packet(size):
    discarded = Counter()
    cut, joined = Segmenter(size), SegmentAssembler(size, discarded)
    truncated, complete = cut.split(bytes(732)), cut.split(b"whole" * 20)
    del truncated[3]
    out = [joined.add(payload, 0.0) for payload in (*truncated, *complete)]
    assert [packet for packet in out if packet is not None] == [b"whole" * 20]
    assert discarded == {"torn": 1}


def test_repeated_transfer_is_delivered_once():
    cut, joined = Segmenter(8), SegmentAssembler(8, Counter())
    first, second = cut.split(b"first"), cut.split(b"second")
    out = [joined.add(payload, 0.001) for payload in (*first, *second, *first, *second)]
    assert [packet for packet in out if packet is not None] == [b"first", b"second"]


def test_transfers_are_counted_from_zero_after_a_restart():
    joined = SegmentAssembler(8, Counter())
    for time in (0.0, 1.0):
        assert [joined.add(part, time) for part in Segmenter(8).split(b"sync")] == [None, b"sync"]


@pytest.mark.parametrize(
    ("payload", "kind"),
    [
        *((payload, "malformed") for payload in (b"", b"\x00\x01", b"\x00\x00abc", bytes(64))),
        (b"\x00\x00\xff\xff\x00\x00\x00\x00", "corrupt"),  # a length of 65535
    ],
)
def test_invalid_segment_is_counted(payload, kind):
    discarded = Counter()
    assert SegmentAssembler(8, discarded).add(payload, 0.0) is None
    assert discarded == {kind: 1}


def stuff_bits(bits):
    """Number of stuff bits that a transmitter inserts, by the standard."""
    count, run, last = 0, 0, None
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            count, run, last = count + 1, 1, 1 - bit
    return count


class TestBusLoad:
    @pytest.mark.parametrize(
        ("profile", "size", "microseconds"),
        [("fd", 64, 169.6), ("fd", 48, 137.6), ("classic", 8, 135.0), ("classic", 0, 55.0)],
    )
    def test_duration_of_frames(self, profile, size, microseconds):
        assert BusRates(profile).duration(size) == pytest.approx(1e-6 * microseconds)

    @given(data=st.binary(min_size=8, max_size=8), seed=st.integers(0, 2**34 - 1))
    def test_no_frame_has_more_stuff_bits_than_the_worst_case(self, data, seed):
        """98 bits of an eight-byte frame are stuffed."""
        bits = [int(bit) for byte in data for bit in f"{byte:08b}"]
        bits += [seed >> i & 1 for i in range(34)]
        assert 111 + stuff_bits(bits) <= classic_bits(8).nominal

    def test_worst_case_exists(self):
        bits = [0] * 5
        while len(bits) < 98:
            bits += [1 - bits[-1]] * 4
        assert 111 + stuff_bits(bits[:98]) == classic_bits(8).nominal

    @pytest.mark.parametrize(
        ("profile", "n_axes", "period", "load"),
        [
            ("fd", 6, 0.001, 0.4768),
            ("classic", 6, 0.002, 0.675),
            ("classic", 6, 0.001, 1.350),
            ("classic", 3, 0.001, 0.810),
            ("classic", 2, 0.001, 0.540),
        ],
    )
    def test_load_of_a_cycle_and_its_limit(self, profile, n_axes, period, load):
        rates = BusRates(profile)
        assert rates.load(n_axes, period) == pytest.approx(load, abs=1e-4)
        if load <= LOAD_LIMIT:
            rates.require_load(n_axes, period)
            return
        percent = f"{100.0 * load:.1f} % of a cycle of 1 ms; allowed is 70 %"
        with pytest.raises(CanBusLoadError, match=re.escape(percent)):
            rates.require_load(n_axes, period)

    @pytest.mark.parametrize("profile", PROFILES)
    @pytest.mark.parametrize("n_axes", range(1, 7))
    def test_payloads_of_a_cycle_are_those_sent(self, profile, n_axes):
        wire = Wire(profile, n_axes=n_axes)
        packet = random_packet(np.random.default_rng(n_axes), 11, n_axes)
        wire.up(packet)
        frames = wire.far.packet(packet) + wire.near.drive_off()
        sizes = sorted(len(frame.data) for frame in frames)
        assert sizes == sorted(BusRates(profile).cycle_payloads(n_axes))

    @pytest.mark.parametrize(("profile", "period"), [("fd", 0.001), ("classic", 0.002)])
    def test_load_of_a_recorded_bus_is_the_computed_one(self, profile, period):
        """A third node records 100 cycles after the init packet."""
        clock = Cycles()
        near, far = virtual_ends(profile, clock)
        session = Session(NS16.drive_train, Guard(wide_limits(), period), CycleRing(N, 64))
        link = PacedByPackets(near, far, ns16_controller(period=period), clock=clock)
        with can.Bus(near._port._bus.channel_id, "virtual") as logger:
            exchange(link, session, until=lambda: link.cycle == 112)
            frames = list(iter(lambda: logger.recv(0.0), None))
        link.close()
        rates = BusRates(profile)
        segments = (SEGMENT_UP, SEGMENT_DOWN)
        busy = sum(
            rates.duration(len(frame.data))
            for frame in frames
            if frame.arbitration_id not in segments
        )
        assert busy / (100 * period) == pytest.approx(rates.load(N, period))
