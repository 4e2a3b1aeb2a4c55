"""Cyclic frames, segments, bus load and DBC files of both CAN profiles."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.packets import LAST_NUMBER, CyclicPacket, Mode, next_number
from drivers.transports.can import profile as can_profile
from drivers.transports.can.profile import (
    CLASSIC_MODE_CODES,
    FD_MODE_CODES,
    LOAD_LIMIT,
    NEVER,
    BusRates,
    CanBusLoadError,
    CanModeError,
    CanValueError,
    ControllerEnd,
    SegmentAssembler,
    classic_bits,
    segments,
    words_of,
)
from tests.drivers.can_bench import (
    PROFILES,
    N,
    Wire,
    decoded,
    init_packet,
    random_packet,
)

CODES = {"fd": FD_MODE_CODES, "classic": CLASSIC_MODE_CODES}
STEP = 2.0**-16
SLOW = (2, 6, 7, 8)
"""D2 and extras among the nine words of an axis: mode, D1..D5, extra1..3."""


@pytest.fixture(params=PROFILES)
def profile(request):
    return request.param


@pytest.fixture
def wire(profile):
    return Wire(profile)


def packet(number, *, mode=4, status=5, d=0.0, n_axes=N):
    made = CyclicPacket.zeros(number, n_axes)
    made.axes["mode"] = mode
    made.axes["d"] = d
    return CyclicPacket(number, bytes((status, 0, 0, 0)), bytes(4), made.axes).encode()


def answer(number, *, mode=4, status=0, d=0.0, n_axes=N):
    return packet(next_number(number), mode=mode, status=status, d=d, n_axes=n_axes)


def numbers_in(*columns):
    """D1..D5 (N, 5) with these columns, {index: values}."""
    d = np.zeros((N, 5))
    for column, values in columns:
        d[:, column] = values
    return d


def random_packets(first, count, seed=3):
    rng, number = np.random.default_rng(seed), first
    for _ in range(count):
        yield number, random_packet(rng, number)
        number = next_number(number)


class TestUp:
    @pytest.mark.parametrize("n_axes", range(1, 7))
    def test_one_to_six_axes_in_both_directions(self, profile, n_axes):
        wire = Wire(profile, n_axes=n_axes)
        rng = np.random.default_rng(n_axes)
        sent = random_packet(rng, 11, n_axes)
        got, wanted = decoded(wire.up(sent), n_axes), decoded(sent, n_axes)
        fresh = [0, 2, 4]
        np.testing.assert_array_equal(got.axes["d"][:, fresh], wanted.axes["d"][:, fresh])
        assert wire.near.ages.shape == (n_axes, 8)
        back = np.zeros((n_axes, 5))
        back[:, 0] = rng.integers(-(2**20), 2**20, n_axes) * STEP
        reply = decoded(wire.down(answer(11, d=back, n_axes=n_axes)), n_axes)
        np.testing.assert_array_equal(reply.axes["d"][:, 0], back[:, 0])

    def test_modes_and_status(self, profile, wire):
        modes = [[mode] * N for mode in CODES[profile]]
        for number, each in enumerate([*modes, [0, 4, 5, 7, 501, 4]], start=11):
            got = decoded(wire.up(packet(number, mode=each, status=3)))
            assert got.axes["mode"].tolist() == each
            assert got.status == bytes((3, 0, 0, 0))
            assert not wire.far.segmented

    @pytest.mark.parametrize(
        "raw",
        [
            *(packet(11, mode=mode) for mode in (18, 499, 509, -1, 2**31 - 1)),
            *(packet(11)[:length].ljust(length, b"\x55") for length in (12, 48, 227, 229, 732)),
        ],
        ids=lambda raw: f"{raw[12:16].hex()}, {len(raw)} bytes",
    )
    def test_other_packets_are_sent_as_segments(self, wire, raw):
        assert wire.up(raw) == raw
        assert wire.far.segmented
        assert wire.near.ages is None
        if len(raw) == 228:
            back = answer(11, mode=0)
            assert wire.down(back) == back

    def test_slow_values_and_ages_after_25_cycles(self, wire):
        sent = dict(random_packets(11, 25))
        received = [wire.up(each) for each in sent.values()]
        ages = wire.near.ages
        assert sorted(ages[:, [1, 5, 6, 7]].ravel()) == list(range(1, 25))
        assert_slow_values(received[-1], ages, sent)
        assert [each[8:12] for each in received[-2:]] == [bytes(4), sent[35][8:12]]

    @pytest.mark.parametrize("again", [False, True], ids=["silence", "init packet"])
    def test_slow_values_are_unknown_after_a_restart(self, wire, again):
        for number in range(11, 40):
            wire.up(packet(number))
        if again:
            assert wire.up(init_packet()) == init_packet()
        else:
            wire.near.forget()
        got = decoded(wire.up(packet(11 if again else 2000)))
        assert np.isnan(got.axes["extra"][:, 1:]).all()
        assert (wire.near.ages == NEVER).sum() >= 23


def assert_slow_values(received, ages, packets):
    """Every slow value was sent as many cycles ago as its age; without an age it is NaN."""
    order = list(packets)
    at = order.index(int.from_bytes(received[:4], "little"))
    words = words_of(received, N)
    for column in SLOW:
        for axis in range(N):
            age = int(ages[axis, column - 1])
            if age == NEVER:
                assert np.isnan(words[axis].view(np.float32)[column])
            else:
                source = words_of(packets[order[at - age]], N)
                assert words[axis, column] == source[axis, column]


class TestClassicNumbers:
    """Rounding of positions, and the speeds that are computed from them."""

    @pytest.fixture
    def wire(self):
        return Wire("classic")

    def test_positions_are_rounded_to_16_bit_increments(self, wire):
        """D1 is sent as a difference to D3, yet comes out the same whatever D3 is."""
        rng = np.random.default_rng(5)
        for number in range(11, 61):
            actual = rng.uniform(-255, 255, N)
            target, current = actual + rng.uniform(-0.9, 0.9, N), rng.uniform(-31, 31, N)
            d = numbers_in((0, target), (2, actual), (4, current)).astype(np.float32)
            got = decoded(wire.up(packet(number, d=d))).axes["d"]
            rounded = np.rint(d.astype(float) / STEP) * STEP
            np.testing.assert_array_equal(got[:, [0, 2]], rounded[:, [0, 2]])
            np.testing.assert_allclose(got[:, 4], d[:, 4], rtol=0, atol=0.51 / 64)

    @pytest.mark.parametrize(
        ("column", "values", "lost"),
        [
            (2, (1024.0, -1024.0, 1025.5, -3000.0, np.nan, -np.inf), (0, 2, 3)),
            (0, (1.0, -1.0, 2.25, -1.5, np.inf), (0,)),
            (4, (32.0, -32.0, 65.0, np.nan), (4,)),
        ],
    )
    def test_number_outside_its_field_is_nan(self, column, values, lost):
        for value in values:
            wire = Wire("classic")
            wire.up(packet(11))
            d = np.zeros((N, 5))
            d[3, column] = value
            got = decoded(wire.up(packet(12, d=d))).axes["d"]
            expected = np.zeros((N, 5), bool)
            expected[3, list(lost)] = True
            np.testing.assert_array_equal(np.isnan(got[:, [0, 2, 3, 4]]), expected[:, [0, 2, 3, 4]])

    def test_largest_numbers(self, wire):
        actual = np.array([255.0, -255.0, 1023.0, -1023.0, 0.5, 0.0])
        target = actual + np.array([1 - STEP, STEP - 1, 0.5, -0.5, 0.0, 0.0])
        d = numbers_in((0, target), (2, actual), (4, [31.984375, -31.984375, 0, 0, 0, 0]))
        got = decoded(wire.up(packet(11, d=d))).axes["d"]
        np.testing.assert_array_equal(got[:, [0, 2, 4]], d[:, [0, 2, 4]].astype(np.float32))

    def test_velocity_and_step_are_differences_of_positions(self, wire):
        """Over missed cycles a mean; the age of a velocity is the number of those."""
        velocity, ages, steps = [], [], []
        for number, position in ((11, 1.0), (12, 1.25), (13, 1.75), (16, 2.5)):
            wire.time += 0.006
            d = numbers_in((0, position), (2, position))
            velocity.append(decoded(wire.up(packet(number, d=d))).axes["d"][0, 3])
            ages.append(int(wire.near.ages[0, 3]))
            reply = wire.down(answer(number, d=numbers_in((0, position))))
            steps.append(decoded(reply).axes["d"][0, 1])
        assert np.isnan(velocity[0])
        assert velocity[1:] == [0.25, 0.5, 0.25]
        assert ages == [NEVER, 0, 0, 2]
        assert steps == [0.0, 0.25, 0.5, 0.25]

    @pytest.mark.parametrize(("ahead", "step"), [(16, 0.25), (17, 0.0)])
    def test_step_is_zero_after_a_long_gap(self, wire, ahead, step):
        for number, target in ((11, 1.0), (11 + ahead, 5.0)):
            wire.time += 0.1
            wire.up(packet(number))
            got = decoded(wire.down(answer(number, d=numbers_in((0, target))))).axes["d"]
        assert (got[:, 1] == step).all()

    def test_step_is_zero_after_another_reply(self, wire):
        for number, mode in ((11, 4), (12, 505), (13, 4)):
            wire.up(packet(number))
            d = numbers_in((0, number if mode == 4 else 0.0))
            got = decoded(wire.down(answer(number, mode=mode, d=d)))
            assert (got.axes["d"][:, 1] == 0.0).all()


class TestReplies:
    @pytest.mark.parametrize("status", [0, 1, 7])
    def test_echo_with_the_drive_off_is_the_packet_sent(self, wire, status):
        """Bit for bit, though the PC knows some of it only rounded or aged."""
        for number in range(11, 15):
            sent = random_packet(np.random.default_rng(number), number, mode=0, status=status)
            seen = wire.up(sent)
            head = next_number(number).to_bytes(4, "little") + sent[4:8] + bytes(4)
            assert wire.down(head + seen[12:]) == head + sent[12:]

    @pytest.mark.parametrize(("mode", "returned"), [(0, 2), (501, 2), (10, 5)])
    def test_words_returned_by_closed_axes_are_those_sent(self, wire, mode, returned):
        def reply(packet):
            axes = decoded(packet).axes.copy()
            axes["d"][:, returned:] = axes["extra"] = 0.0
            return CyclicPacket(12, bytes(4), bytes(4), axes).encode()

        sent = random_packet(np.random.default_rng(7), 11, mode=mode)
        assert wire.down(reply(wire.up(sent))) == reply(sent)

    @pytest.mark.parametrize("mode", [505, 508])
    def test_drive_off_and_following_error_per_axis(self, wire, mode):
        wire.up(packet(11))
        modes = np.array([4, 4, mode, 4, mode, 4])
        got = decoded(wire.down(answer(11, mode=modes, d=numbers_in((0, 0.5)))))
        assert got.axes["mode"].tolist() == modes.tolist()
        assert (got.axes["d"][modes == 4, 0] == 0.5).all()

    @pytest.mark.parametrize("mode", [500, 502, 504, 506, 508])
    def test_zeros_in_reply_to_other_modes(self, wire, mode):
        wire.up(packet(11, mode=mode, d=1.0))
        got = decoded(wire.down(answer(11, mode=0)))
        assert not got.axes["mode"].any()
        assert not got.axes["d"].any()

    @pytest.mark.parametrize("modes", [[4] * 6, [0] * 6, [0, 4, 0, 4, 4, 0], [7, 8, 9, 2, 1, 5]])
    def test_exit_request_passes_in_any_modes(self, wire, modes):
        for number, status in ((11, 1), (12, 0)):
            wire.up(packet(number, mode=modes))
            got = decoded(wire.down(answer(number, mode=modes, status=status)))
            assert got.status == bytes((status, 0, 0, 0))
            assert got.axes["mode"].tolist() == modes

    def test_increments_of_position_have_no_step(self, wire):
        for number in (11, 12, 13):
            wire.up(packet(number, mode=7))
            d = numbers_in((0, 0.0625 * (number - 10)))
            got = decoded(wire.down(answer(number, mode=7, d=d))).axes["d"]
            np.testing.assert_array_equal(got, d)

    @pytest.mark.parametrize("mode", [1, 2, 8, 9, 10])
    @pytest.mark.parametrize("column", [2, 3, 4])
    def test_reply_with_more_than_two_numbers_is_refused(self, wire, mode, column):
        wire.up(packet(11, mode=mode))
        d = np.zeros((N, 5))
        d[4, column] = 0.25
        with pytest.raises(CanModeError, match=rf"mode {mode} \(slot 4\)"):
            wire.near.reply(answer(11, mode=mode, d=d))
        got = decoded([wire.far.receive(each, wire.time) for each in wire.near.drive_off()][-1])
        assert (got.axes["mode"] == 505).all()

    @pytest.mark.parametrize(
        ("profile", "changes", "error", "words"),
        [
            *(
                ("classic", {"mode": mode, "d": np.eye(N, 5)}, CanModeError, f"mode {mode}")
                for mode in (0, 3, 600)
            ),
            ("classic", {"status": 9}, CanModeError, "status 9"),
            *(
                (profile, {"d": np.where(np.eye(N, 5), np.nan, 0)}, CanValueError, "D1 of slot 0")
                for profile in PROFILES
            ),
            *(
                (profile, {"d": np.where(np.eye(N, 5, 1), np.nan, 0)}, CanValueError, "D2 of sl")
                for profile in PROFILES
            ),
        ],
    )
    def test_reply_without_code_or_finite_number_is_refused(self, profile, changes, error, words):
        wire = Wire(profile)
        wire.up(packet(11))
        if error is CanValueError:
            changes["d"][:, 2:] = 0.0
        with pytest.raises(error, match=words):
            wire.near.reply(answer(11, **changes))

    def test_late_reply_has_its_own_packet_until_it_is_stale(self, wire):
        seen = wire.up(packet(11, mode=0, status=0, d=1.0))
        reply = next_number(11).to_bytes(4, "little") + seen[4:]
        wire.up(packet(12))
        got = decoded(wire.down(reply))
        assert got.number == 12
        assert (got.axes["d"] == 1.0).all()
        frames = wire.near.reply(answer(12))
        for number in range(13, 30):
            wire.up(packet(number))
        assert [wire.far.receive(frame, wire.time) for frame in frames] == [None] * len(frames)
        assert wire.far.discarded["stale"] == 1


class TestDisturbances:
    """Frames lost, doubled and delayed are never mixed into one packet."""

    fates = st.lists(
        st.tuples(st.sampled_from(["pass"] * 12 + ["lose"] * 2 + ["double", "delay"]),
                  st.integers(1, 12)),
        min_size=20, max_size=400,
    )  # fmt: skip
    """Fate of each frame, and by how many frames it is delayed."""
    firsts = st.sampled_from([11, 5000, LAST_NUMBER - 10])
    seeds = st.integers(0, 2**32 - 1)

    @staticmethod
    def disturbed(frames, fates):
        """Yield the frames delivered by the bus: (time, frame) in the order of arrival."""
        arrivals = []
        for index, (time, frame) in enumerate(frames):
            fate, by = fates[index % len(fates)]
            if fate != "lose":
                arrivals.append((index + (by if fate == "delay" else 0), time, frame))
            if fate == "double":
                arrivals.append((index + by, time, frame))
        arrivals.sort(key=lambda arrival: arrival[0])
        newest = 0.0
        for _, time, frame in arrivals:
            newest = max(newest, time)
            yield newest, frame

    @staticmethod
    def sent_cycles(profile, first, cycles, seed=3):
        wire, frames = Wire(profile), []
        packets = dict(random_packets(first, cycles, seed))
        for each in packets.values():
            wire.time += 0.002
            frames += [(wire.time, frame) for frame in wire.far.packet(each)]
        return wire, packets, frames

    @pytest.mark.parametrize("profile", PROFILES)
    @settings(max_examples=40, deadline=None)
    @given(seed=seeds, first=firsts, fates=fates)
    def test_packets_are_not_mixed(self, profile, seed, first, fates):
        wire, packets, frames = self.sent_cycles(profile, first, 40, seed)
        fresh = [0, 1, 3, 5, *([4] if profile == "fd" else [])]
        for time, frame in self.disturbed(frames, fates):
            got = wire.near.receive(frame, time)
            if got is None:
                continue
            original = packets[int.from_bytes(got[:4], "little")]
            assert got[4:8] == original[4:8]
            np.testing.assert_array_equal(
                words_of(got, N)[:, fresh], words_of(original, N)[:, fresh]
            )
            ages = wire.near.ages
            assert (ages[:, [0, 2, 4]] == 0).all()
            assert_slow_values(got, ages, packets)

    @pytest.mark.parametrize("profile", PROFILES)
    @settings(max_examples=25, deadline=None)
    @given(seed=seeds, first=firsts, fates=fates)
    def test_replies_are_not_mixed(self, profile, seed, first, fates):
        wire, rng = Wire(profile), np.random.default_rng(seed)
        replies, frames = {}, []
        for number, each in random_packets(first, 12, seed):
            wire.up(each)
            modes = rng.choice([4, 505, 508], size=N, p=[0.8, 0.1, 0.1])
            d = numbers_in((0, rng.integers(-(2**20), 2**20, N) / 2**16))
            reply = answer(number, mode=modes, d=d)
            replies[next_number(number)] = decoded(reply).axes
            frames += [(wire.time, frame) for frame in wire.near.reply(reply)]
        for time, frame in self.disturbed(frames, fates):
            reply = wire.far.receive(frame, time)
            if reply is None:
                continue
            got = decoded(reply)
            wanted = replies[got.number]
            np.testing.assert_array_equal(got.axes["mode"], wanted["mode"])
            moved = wanted["mode"] == 4
            np.testing.assert_array_equal(got.axes["d"][moved, 0], wanted["d"][moved, 0])

    @pytest.mark.parametrize("profile", PROFILES)
    @settings(max_examples=25, deadline=None)
    @given(data=st.data())
    def test_lost_frame_loses_one_cycle(self, profile, data):
        wire, packets, frames = self.sent_cycles(profile, 11, 6)
        per_cycle = len(frames) // 6
        lost = data.draw(st.integers(0, len(frames) - per_cycle - 1))
        out = [wire.near.receive(frame, time) for time, frame in frames[:lost] + frames[lost + 1 :]]
        numbers = [int.from_bytes(got[:4], "little") for got in out if got is not None]
        assert numbers == [number for number in packets if number != 11 + lost // per_cycle]
        assert wire.near.discarded == {"torn": 1}

    def test_equal_counters_of_other_cycles_are_not_mixed(self):
        """Classic frames carry four bits of the number: sixteen cycles later they are the same."""
        wire, _, frames = self.sent_cycles("classic", 11, 17)
        mixed = [*frames[:4], *frames[-3:]]
        assert [wire.near.receive(frame, time) for time, frame in mixed] == [None] * 7
        assert wire.near.discarded == {"torn": 1}

    def test_of_overlapping_sets_the_newer_is_received(self):
        wire, _, frames = self.sent_cycles("fd", 11, 2)
        (t0, a0), (_, b0), (t1, a1), (_, b1) = frames
        arrivals = [(t0, a0), (t1, a1), (t1, b0), (t1, b1)]
        out = [wire.near.receive(frame, time) for time, frame in arrivals]
        assert out[:3] == [None] * 3
        assert int.from_bytes(out[3][:4], "little") == 12
        assert wire.near.discarded == {"torn": 1}

    @settings(max_examples=60, deadline=None)
    @given(
        size=st.sampled_from([8, 64]),
        lengths=st.lists(st.integers(1, 600), min_size=1, max_size=6),
        seed=seeds,
        fates=fates,
    )
    def test_segments_give_complete_packets_or_none(self, size, lengths, seed, fates):
        """Of more segments than any is late by: shorter packets may overtake one another."""
        rng, joined = np.random.default_rng(seed), SegmentAssembler(size, Counter())
        packets = [rng.bytes(12 * (size - 2) + length) for length in lengths]
        parts = [part for i, each in enumerate(packets) for part in segments(each, size, i)]
        arrivals = self.disturbed([(float(i), part) for i, part in enumerate(parts)], fates)
        out = [joined.add(part, 1e-3 * time) for time, part in arrivals]
        remaining = iter(packets)
        assert all(each in remaining for each in out if each), "each at most once, in order"


class TestSegments:
    @settings(max_examples=60, deadline=None)
    @given(
        size=st.sampled_from([8, 64]),
        packet=st.binary(min_size=1, max_size=300),
        data=st.data(),
    )
    def test_changed_bit_is_detected(self, size, packet, data):
        discarded = Counter()
        joined = SegmentAssembler(size, discarded)
        payloads = segments(packet, size, 0)
        which = data.draw(st.integers(0, len(payloads) - 1))
        # Padding means nothing; only the bytes that do are changed.
        room = size - 2
        used = 8 if which == 0 else 2 + min(room, len(packet) - (which - 1) * room)
        at = data.draw(st.integers(0, 8 * used - 1))
        changed = bytearray(payloads[which])
        changed[at // 8] ^= 1 << at % 8
        payloads[which] = bytes(changed)
        assert [joined.add(payload, 0.0) for payload in payloads] == [None] * len(payloads)
        joined.add(b"\x00\x01next", 10.0)
        assert discarded["corrupt"] + discarded["torn"] + discarded["malformed"] >= 1

    def test_repeated_transfer_is_delivered_once(self):
        joined = SegmentAssembler(8, Counter())
        first, second = segments(b"first", 8, 0), segments(b"second", 8, 1)
        out = [joined.add(part, 0.001) for part in (*first, *second, *first, *second)]
        assert [packet for packet in out if packet is not None] == [b"first", b"second"]
        again = [joined.add(part, 1.0) for part in segments(b"sync", 8, 0)]
        assert again == [None, b"sync"], "after a restart, transfers are counted from zero"

    @pytest.mark.parametrize(
        ("payload", "kind"),
        [
            *((part, "malformed") for part in (b"", b"\x00\x01", b"\x00\x00abc", bytes(64))),
            (b"\x00\x00\xff\xff\x00\x00\x00\x00", "corrupt"),  # a length of 65535
        ],
    )
    def test_invalid_segment_is_counted(self, payload, kind):
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
        assert 111 + stuff_bits(bits) <= classic_bits(8)
        worst = [0, 0, 0, 0, 0, *([1, 1, 1, 1, 0, 0, 0, 0] * 12)][:98]
        assert 111 + stuff_bits(worst) == classic_bits(8)

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

    @pytest.mark.parametrize("n_axes", range(1, 7))
    def test_payloads_of_a_cycle_are_those_sent(self, profile, n_axes):
        wire = Wire(profile, n_axes=n_axes)
        packet = random_packet(np.random.default_rng(n_axes), 11, n_axes)
        wire.up(packet)
        frames = wire.far.packet(packet) + wire.near.drive_off()
        sizes = sorted(len(frame.data) for frame in frames)
        assert sizes == sorted(BusRates(profile).cycle_payloads(n_axes))


AXES = range(1, N + 1)
FOLDER = Path(can_profile.__file__).parent


class TestDbc:
    @pytest.fixture
    def database(self, profile):
        return cantools.database.load_file(FOLDER / f"c4g_open_{profile}.dbc", strict=True)

    @staticmethod
    def signals(database, frames):
        """Signals by name, that of the axis added in frames of one axis."""
        found = {}
        for frame in frames:
            message = database.get_message_by_frame_id(frame.id)
            assert len(frame.data) == message.length
            axis = f"_axis{message.name[-1]}" if message.name.startswith("UP_AXIS") else ""
            for name, value in message.decode(frame.data, decode_choices=False).items():
                assert found.setdefault(name + axis, value) == value
        return found

    def test_cantools_reads_packets(self, profile, database):
        end = ControllerEnd(BusRates(profile))
        end.packet(init_packet())
        seen = set()
        for number, packet in random_packets(11, 25):
            wanted = decoded(packet)
            signals = self.signals(database, end.packet(packet))
            expected = {"number": number, "status": wanted.status[0]}
            for k, axis in enumerate(wanted.axes, start=1):
                expected[f"mode_axis{k}"] = CODES[profile][axis["mode"]]
                expected |= {f"D{column}_axis{k}": axis["d"][column - 1] for column in (1, 3, 5)}
                if profile == "fd":
                    expected[f"D4_axis{k}"] = axis["d"][3]
                else:
                    expected[f"counter_axis{k}"] = number % 16
                    difference = signals.pop(f"D1_minus_D3_axis{k}")
                    signals[f"D1_axis{k}"] = signals[f"D3_axis{k}"] + difference
            (slow,) = signals.keys() - expected.keys() - {"slow"}
            seen.add(slow)
            if slow == "functionality":
                assert signals[slow].to_bytes(4, "little") == wanted.functionality
            else:
                field, k = slow.split("_axis")
                row = wanted.axes[int(k) - 1]
                expected[slow] = row["d"][1] if field == "D2" else row["extra"][int(field[-1]) - 1]
            for name, value in expected.items():
                assert np.float32(signals[name]) == np.float32(value), name
        assert len(seen) == 25, "each slow value had its turn"

    def test_mode_codes_have_the_names_of_the_modes(self, profile, database):
        name, field = ("UP_A", "mode_axis1") if profile == "fd" else ("UP_AXIS_1", "mode")
        choices = database.get_message_by_name(name).get_signal_by_name(field).choices
        assert {message.is_fd for message in database.messages} == {profile == "fd"}
        known = {int(mode): mode.name.lower() for mode in Mode}
        assert {code: str(choice) for code, choice in choices.items()} == {
            code: known.get(mode, f"mode_{mode}") for mode, code in CODES[profile].items()
        }

    def test_cantools_reads_replies(self, profile, database, wire):
        modes = np.array([4, 0, 4, 4, 0, 4])
        received = words_of(wire.up(random_packet(np.random.default_rng(9), 11, mode=modes)), N)
        reply = CyclicPacket.zeros(12, N)
        reply.axes["mode"] = modes
        closed = modes == 0
        reply.axes["d"][~closed, 0] = (np.arange(N) / 8)[~closed]
        reply.axes.view(np.int32).reshape(N, 9)[closed, 1:3] = received[closed, 1:3]
        signals = self.signals(database, wire.near.reply(reply.encode()))
        for k, mode in enumerate(modes.tolist(), start=1):
            if profile == "fd":
                assert signals["number"] == 12
                assert signals[f"mode_axis{k}"] == mode
                assert signals[f"mirrored_axis{k}"] == (mode == 0)
            else:
                assert signals["counter"] == 12
                assert signals[f"action_axis{k}"] == (mode == 4)
            if mode == 4:
                assert signals[f"D1_axis{k}"] == (k - 1) / 8
