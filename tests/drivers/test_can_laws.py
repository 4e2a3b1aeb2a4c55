"""Laws of the CAN profile: whatever the bus does to frames, a packet is one that was sent."""

from __future__ import annotations

from collections import Counter

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import CycleRing, CyclicPacket, Guard, Session, exchange
from drivers.packets import LAST_NUMBER, next_number
from drivers.transports.can.bus_load import (
    LOAD_LIMIT,
    BusRates,
    CanBusLoadError,
    classic_bits,
    fd_bits,
)
from drivers.transports.can.codecs import NEVER, words_of
from drivers.transports.can.ends import LONGEST, SegmentAssembler, Segmenter
from drivers.transports.can.layout import SEGMENT_DOWN, SEGMENT_UP, Frame
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

fates = st.sampled_from(["pass"] * 12 + ["lose"] * 2 + ["double", "hold back"])


@st.composite
def disturbances(draw, most=400):
    """What happens to each frame: its fate, and by how many frames it is held back."""
    return [(draw(fates), draw(st.integers(1, 12))) for _ in range(draw(st.integers(20, most)))]


def disturbed(frames, fate_of):
    """Frames as the bus delivers them: (time, frame) in the order of arrival."""
    arrivals = []
    for index, (time, frame) in enumerate(frames):
        fate, by = fate_of[index % len(fate_of)]
        if fate == "lose":
            continue
        arrivals.append((index + (by if fate == "hold back" else 0), time, frame))
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
    """Every field of a packet that came out is one that went in, as old as is said."""
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
def test_no_packet_is_a_mixture_of_two(profile, seed, first, fate_of):
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
def test_no_answer_is_a_mixture_of_two(profile, seed, first, fate_of):
    wire = Wire(profile)
    rng = np.random.default_rng(seed)
    answers, frames = {}, []
    for number in numbers(first, 12):
        wire.up(random_packet(rng, number))
        answer = next_number(number)
        reply = CyclicPacket.zeros(answer, N)
        reply.axes["mode"] = rng.choice([4, 505, 508], size=N, p=[0.8, 0.1, 0.1])
        reply.axes["d"][:, 0] = rng.integers(-(2**20), 2**20, N) / 2**16
        answers[answer] = reply
        frames += [(wire.time, frame) for frame in wire.near.reply(reply.encode())]
    for time, frame in disturbed(frames, fate_of):
        packet = wire.far.receive(frame, time)
        if packet is None:
            continue
        got = CyclicPacket.decode(packet, N)
        wanted = answers[got.number].axes
        np.testing.assert_array_equal(got.axes["mode"], wanted["mode"])
        moved = wanted["mode"] == 4
        np.testing.assert_array_equal(got.axes["d"][moved, 0], wanted["d"][moved, 0])


@pytest.mark.parametrize("profile", PROFILES)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_one_lost_frame_costs_one_cycle_and_is_counted(profile, data):
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


def test_a_counter_that_has_come_round_is_not_taken_for_the_same_cycle():
    """Classic frames carry four bits of the number: sixteen cycles later they are the same."""
    wire, _, frames = sent_cycles("classic", 3, 11, 17)
    first, last = frames[:7], frames[-7:]
    mixed = [*first[:4], *last[4:]]
    assert [wire.near.receive(frame, time) for time, frame in mixed] == [None] * 7
    assert wire.near.discarded == {"torn": 1}


def test_sets_that_overlap_cost_the_older_one_only():
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
def test_segments_give_back_whole_packets_or_none(size, packets, fate_of):
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
def test_a_changed_bit_is_found(size, packet, data):
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
def test_packets_of_every_length_come_back(size, length):
    packet = np.random.default_rng(length).bytes(length)
    joined = SegmentAssembler(size, Counter())
    *early, last = [joined.add(p, 0.0) for p in Segmenter(size).split(packet)]
    assert early == [None] * len(early)
    assert last == packet


@pytest.mark.parametrize("length", [0, LONGEST + 1])
def test_packets_that_segments_cannot_carry_are_refused(length):
    with pytest.raises(ValueError, match=f"not {length}"):
        Segmenter(64).split(bytes(length))


@pytest.mark.parametrize("size", [8, 64])
def test_a_lost_segment_costs_the_packet_and_is_counted(size):
    discarded = Counter()
    cut, joined = Segmenter(size), SegmentAssembler(size, discarded)
    torn, whole = cut.split(bytes(732)), cut.split(b"whole" * 20)
    del torn[3]
    out = [joined.add(payload, 0.0) for payload in (*torn, *whole)]
    assert [packet for packet in out if packet is not None] == [b"whole" * 20]
    assert discarded == {"torn": 1}


def test_a_transfer_whose_frames_all_come_again_is_not_delivered_twice():
    cut, joined = Segmenter(8), SegmentAssembler(8, Counter())
    first, second = cut.split(b"first"), cut.split(b"second")
    out = [joined.add(payload, 0.001) for payload in (*first, *second, *first, *second)]
    assert [packet for packet in out if packet is not None] == [b"first", b"second"]


def test_a_program_started_anew_counts_its_transfers_from_zero_again():
    joined = SegmentAssembler(8, Counter())
    for time in (0.0, 1.0):
        assert joined.add(Segmenter(8).split(b"sync")[0], time) is None
        assert joined.add(Segmenter(8).split(b"sync")[1], time) == b"sync"


@pytest.mark.parametrize(
    "payload", [b"", b"\x00\x01", b"\x00\x00abc", bytes(64)], ids=["empty", "bare", "short", "long"]
)
def test_what_is_no_segment_is_counted(payload):
    discarded = Counter()
    assert SegmentAssembler(64, discarded).add(payload, 0.0) is None
    assert discarded == {"malformed": 1}


def test_a_length_that_cannot_be_is_corrupt():
    discarded = Counter()
    joined = SegmentAssembler(8, discarded)
    assert joined.add(b"\x00\x00\xff\xff\x00\x00\x00\x00", 0.0) is None
    assert discarded == {"corrupt": 1}


def test_a_classic_frame_of_eight_bytes_has_111_bits_and_135_at_worst():
    assert classic_bits(8, stuffed=False) == (111, 0)
    assert classic_bits(8) == (135, 0)
    assert classic_bits(0, stuffed=False) == (47, 0)


def test_an_fd_frame_of_64_bytes_takes_140_microseconds_and_170_at_worst():
    rates = BusRates("fd")
    assert rates.duration(64, stuffed=False) == pytest.approx(139.8e-6)
    assert rates.duration(64) == pytest.approx(169.6e-6)
    assert rates.duration(48, stuffed=False) == pytest.approx(114.2e-6)
    assert rates.duration(48) == pytest.approx(137.6e-6)


def stuff_bits(bits):
    """Stuff bits that a transmitter inserts, as the standard says it."""
    count, run, last = 0, 0, None
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            count, run, last = count + 1, 1, 1 - bit
    return count


@given(data=st.binary(min_size=8, max_size=8), seed=st.integers(0, 2**34 - 1))
def test_no_frame_is_stuffed_worse_than_the_worst_case(data, seed):
    """Whatever the 98 stuffable bits of an eight-byte frame are."""
    bits = [int(bit) for byte in data for bit in f"{byte:08b}"]
    bits += [seed >> i & 1 for i in range(34)]
    assert 111 + stuff_bits(bits) <= classic_bits(8).nominal


def test_the_worst_case_is_reached():
    bits = [0] * 5
    while len(bits) < 98:
        bits += [1 - bits[-1]] * 4
    assert 111 + stuff_bits(bits[:98]) == classic_bits(8).nominal


def test_six_axes_at_1_khz_take_less_than_half_of_an_fd_bus():
    assert BusRates("fd").load(6, 0.001) == pytest.approx(0.4768, abs=1e-4)
    assert BusRates("fd").load(6, 0.001) <= 0.50


def test_six_axes_fit_a_classic_bus_at_2_ms_and_not_at_1_ms():
    rates = BusRates("classic")
    assert rates.load(6, 0.002) == pytest.approx(0.675)
    rates.require_load(6, 0.002)
    with pytest.raises(CanBusLoadError, match=r"10 classic frames for 6 axes fill 135\.0 %") as e:
        rates.require_load(6, 0.001)
    assert "cycle of 1 ms; allowed is 70 %" in str(e.value)


@pytest.mark.parametrize(("n_axes", "fits"), [(1, True), (2, True), (3, False), (6, False)])
def test_at_1_ms_a_classic_bus_carries_two_axes(n_axes, fits):
    assert (BusRates("classic").load(n_axes, 0.001) <= LOAD_LIMIT) == fits


@given(
    n_axes=st.integers(1, 6),
    period=st.floats(5e-4, 1e-2),
    bitrate=st.sampled_from([125_000, 250_000, 500_000, 1_000_000]),
    profile=st.sampled_from(["fd", "classic"]),
)
def test_what_is_let_through_is_within_the_limit(n_axes, period, bitrate, profile):
    rates = BusRates(profile, bitrate)
    try:
        rates.require_load(n_axes, period)
    except CanBusLoadError:
        assert rates.load(n_axes, period) > LOAD_LIMIT
    else:
        assert rates.load(n_axes, period) <= LOAD_LIMIT


@pytest.mark.parametrize("size", [9, 65])
def test_frames_that_cannot_be_are_refused(size):
    with pytest.raises(ValueError, match=f"not {size}"):
        classic_bits(size)
    with pytest.raises(ValueError, match=f"not {size}"):
        fd_bits(size)


@pytest.mark.parametrize(("profile", "period"), [("fd", 0.001), ("classic", 0.002)])
def test_the_load_on_a_log_of_the_bus_is_the_computed_one(profile, period):
    """A third node logs a run; its frames, counted, take what was computed for a cycle."""
    clock = Cycles()
    near, far = virtual_ends(profile, clock)
    logger = can.Bus(near._port._bus.channel_id, "virtual")
    session = Session(NS16.drive_train, Guard(wide_limits(), period), CycleRing(6, 64))
    link = PacedByPackets(near, far, ns16_controller(period=period), clock=clock)
    exchange(link, session, until=lambda: link.cycle == 112)
    rates = BusRates(profile)
    busy = plain = 0.0
    while (message := logger.recv(0.0)) is not None:
        assert message.is_fd == (profile == "fd")
        if message.arbitration_id not in (SEGMENT_UP, SEGMENT_DOWN):
            busy += rates.duration(len(message.data))
            plain += rates.duration(len(message.data), stuffed=False)
    logger.shutdown()
    link.close()
    assert busy / (100 * period) == pytest.approx(rates.load(6, period))
    assert plain / (100 * period) == pytest.approx(rates.load(6, period, stuffed=False))
    assert busy / (100 * period) <= (0.50 if profile == "fd" else LOAD_LIMIT)
