"""Transfers of whole packets, bus load and the DBC file of the CAN profile."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.c4g_packets import LAST_NUMBER, CyclicPacket, Mode, cyclic_length, next_number
from drivers.transports.can import frames
from drivers.transports.can.frames import (
    DOWN,
    MAX_BUS_LOAD,
    PACKED_IDS,
    PAYLOADS_FD,
    UP,
    BusRates,
    CanBusLoadError,
    CanEndpoint,
    Frame,
    TransferAssembler,
    payload_sizes,
    payloads,
)
from tests.drivers.can_bench import N, Wire, decoded, init_packet, random_packet

MODES = (*range(18), *range(500, 509))


def random_packets(first, count, seed=3):
    rng = np.random.default_rng(seed)
    number = first
    for _ in range(count):
        yield number, random_packet(rng, number)
        number = next_number(number)


class TestPackets:
    """A packet arrives as it was sent, in both directions."""

    @pytest.mark.parametrize("n_axes", range(1, 8))
    @pytest.mark.parametrize("sample_time", [4])
    def test_any_number_of_axes(self, n_axes, sample_time):
        wire = Wire(n_axes=n_axes, sample_time=sample_time)
        sent = random_packet(np.random.default_rng(n_axes), 11, n_axes)
        assert wire.up(sent) == sent
        assert wire.down(sent) == sent

    @pytest.mark.parametrize("mode", [*MODES, 18, -1, 2**31 - 1])
    def test_any_mode_and_numbers(self, mode):
        """Also targets that are no numbers: the guard refuses those, not the link."""
        packet = CyclicPacket.zeros(11, N)
        packet.axes["mode"] = mode
        packet.axes["d"] = [np.nan, np.inf, -0.0, 1e30, 1e-42]
        sent = CyclicPacket(11, bytes((9, 1, 0, 0)), b"abcd", packet.axes).encode()
        wire = Wire()
        assert (wire.up(sent), wire.down(sent)) == (sent, sent)

    @pytest.mark.parametrize("length", [1, 12, 48, 56, 57, 116, 117, 227, 228, 732, 1500])
    def test_any_length(self, length):
        sent = np.random.default_rng(length).bytes(length)
        assert Wire().up(sent) == sent

    @pytest.mark.parametrize("length", [0, 1501])
    def test_no_other_length(self, length):
        with pytest.raises(ValueError, match=r"1\.\.1500 bytes"):
            payloads(bytes(length), 0)

    def test_frames_of_other_identifiers_are_counted(self):
        """Those of the packed profiles of earlier versions as such."""
        end = Wire().near
        for identifier in (DOWN, 0x7FF, *PACKED_IDS):
            assert end.receive(Frame(identifier, bytes(64)), 0.0) is None
        assert end.discarded == {"foreign": 2, "packed": len(PACKED_IDS)}


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
    def sent_cycles(first, cycles, seed=3):
        wire = Wire()
        frames = []
        packets = dict(random_packets(first, cycles, seed))
        for each in packets.values():
            wire.time += 0.002
            frames += [(wire.time, frame) for frame in wire.far.frames(each)]
        return wire, packets, frames

    @pytest.mark.safety
    @settings(max_examples=60, deadline=None)
    @given(seed=seeds, first=firsts, fates=fates)
    def test_packets_are_not_mixed(self, seed, first, fates):
        """What arrives was sent, each packet at most once."""
        wire, packets, frames = self.sent_cycles(first, 40, seed)
        seen = Counter()
        for time, frame in self.disturbed(frames, fates):
            got = wire.near.receive(frame, time)
            if got is not None:
                number = int.from_bytes(got[:4], "little")
                assert got == packets[number]
                seen[number] += 1
        assert max(seen.values(), default=0) <= 1

    @settings(max_examples=25, deadline=None)
    @given(data=st.data())
    def test_lost_frame_loses_one_cycle(self, data):
        wire, packets, frames = self.sent_cycles(11, 6)
        per_cycle = len(frames) // 6
        lost = data.draw(st.integers(0, len(frames) - per_cycle - 1))
        out = [wire.near.receive(frame, time) for time, frame in frames[:lost] + frames[lost + 1 :]]
        numbers = [int.from_bytes(got[:4], "little") for got in out if got is not None]
        assert numbers == [number for number in packets if number != 11 + lost // per_cycle]
        assert wire.near.discarded == {"torn": 1}

    def test_equal_numbers_of_other_transfers_are_not_mixed(self):
        """Transfers are numbered modulo 256: the checksum is the packet's own."""
        wire, _, frames = self.sent_cycles(11, 257)
        mixed = [*frames[:2], *frames[-2:]]
        assert [wire.near.receive(frame, time) for time, frame in mixed] == [None] * 4
        assert wire.near.discarded == {"corrupt": 1}

    def test_of_overlapping_transfers_the_newer_is_received(self):
        """Frames of the older one that come later do not end it."""
        wire, packets, frames = self.sent_cycles(11, 2)
        first = frames[:4]
        second = frames[4:]
        arrivals = [*first[:2], second[0], first[2], *second[1:3], first[3], second[3]]
        out = [wire.near.receive(frame, second[0][0]) for _, frame in arrivals]
        assert out == [None] * 7 + [packets[12]]
        assert wire.near.discarded == {"torn": 1}

    @settings(max_examples=60, deadline=None)
    @given(packet=st.binary(min_size=1, max_size=300), data=st.data())
    def test_changed_bit_is_detected(self, packet, data):
        discarded = Counter()
        joined = TransferAssembler(discarded)
        parts = payloads(packet, 0)
        which = data.draw(st.integers(0, len(parts) - 1))
        # Padding means nothing, nor the number of a transfer in its only frame, nor the length
        # in frames behind the first one.
        used = 8 + len(packet) if which == 0 else 4 + len(packet) - 56 - 60 * (which - 1)
        unused = (2, 3) if which else (0,) if len(parts) == 1 else ()
        bits = [bit for bit in range(8 * min(used, 64)) if bit // 8 not in unused]
        at = data.draw(st.sampled_from(bits))
        changed = bytearray(parts[which])
        changed[at // 8] ^= 1 << at % 8
        parts[which] = bytes(changed)
        assert [joined.add(payload, 0.0) for payload in parts] == [None] * len(parts)
        joined.add(b"\x00\x01\x05\x00next", 10.0)
        assert discarded["corrupt"] + discarded["torn"] + discarded["malformed"] >= 1

    def test_repeated_transfer_is_delivered_once(self):
        joined = TransferAssembler(Counter())
        first = payloads(b"first" * 20, 0)
        second = payloads(b"second" * 20, 1)
        out = [joined.add(part, 0.001) for part in (*first, *second, *first, *second)]
        assert [packet for packet in out if packet] == [b"first" * 20, b"second" * 20]
        again = [joined.add(part, 1.0) for part in payloads(b"sync", 0)]
        assert again == [b"sync"], "after a restart, transfers are counted from zero"

    @pytest.mark.parametrize(
        ("payload", "kind"),
        [
            *((part, "malformed") for part in (b"", b"\x00\x01\x00\x00", b"\x00\x00abc", bytes(8))),
            (b"\x00\x00\xff\xff\x00\x00\x00\x00data", "corrupt"),  # a length of 65535
            (bytes(64), "corrupt"),  # a length of 0
        ],
    )
    def test_invalid_frame_is_counted(self, payload, kind):
        discarded = Counter()
        assert TransferAssembler(discarded).add(payload, 0.0) is None
        assert discarded == {kind: 1}


class TestBusLoad:
    @pytest.mark.parametrize(("size", "microseconds"), [(64, 169.6), (48, 137.6)])
    def test_duration_of_frames(self, size, microseconds):
        assert BusRates().duration(size) == pytest.approx(1e-6 * microseconds)

    @pytest.mark.parametrize(
        ("n_axes", "period", "percent"),
        [
            (6, 0.002, "67.8"), (6, 0.001, "135.7"), (2, 0.001, "55.0"), (3, 0.001, "79.2"),
            (7, 0.002, "78.4"), (7, 0.004, "39.2"),
        ],
    )  # fmt: skip
    def test_load_of_a_cycle_and_its_limit(self, n_axes, period, percent):
        """As `docs/connect.md` has them."""
        rates = BusRates()
        assert f"{100.0 * rates.load(n_axes, period):.1f}" == percent
        if float(percent) <= 100.0 * MAX_BUS_LOAD:
            rates.require_load(n_axes, period)
            return
        load = f"{percent} % of a cycle of {1e3 * period:g} ms; allowed is 70 %"
        with pytest.raises(CanBusLoadError, match=re.escape(load)):
            rates.require_load(n_axes, period)

    @pytest.mark.parametrize("n_bytes", [1, 48, 56, 57, 116, 117, 228, 732, 1500])
    def test_sizes_are_those_sent(self, n_bytes):
        sizes = [len(payload) for payload in payloads(bytes(n_bytes), 0)]
        assert sizes == payload_sizes(n_bytes)
        assert set(sizes) <= set(PAYLOADS_FD)


class TestDbc:
    """CAN tools decode cyclic packets with the DBC file of this profile."""

    @pytest.fixture
    def database(self):
        folder = Path(frames.__file__).parent
        return cantools.database.load_file(folder / "c4g_open_fd.dbc", strict=True)

    @pytest.mark.parametrize(("sends", "name"), [(UP, "UP"), (DOWN, "DOWN")])
    def test_cantools_reads_packets(self, database, sends, name):
        packet = random_packet(np.random.default_rng(2), 11)
        wanted = decoded(packet)
        signals = {}
        for index, frame in enumerate(CanEndpoint(BusRates(), sends).frames(packet)):
            message = database.get_message_by_frame_id(frame.id)
            assert (message.name, message.is_fd) == (name, True)
            frame_signals = message.decode(frame.data, decode_choices=False)
            assert (frame_signals.pop("index"), frame_signals.pop("length")) == (
                index,
                cyclic_length(N),
            )
            signals |= frame_signals
        assert signals["number"] == wanted.number
        assert [signals[f"status_arm{arm}"] for arm in range(1, 5)] == [*wanted.status]
        assert signals["functionality"].to_bytes(4, "little") == wanted.functionality
        for k, axis in enumerate(wanted.axes, start=1):
            values = [signals[f"{field}_axis{k}"] for field in ("D1", "D2", "D3", "D4", "D5")]
            extras = [signals[f"extra{field}_axis{k}"] for field in (1, 2, 3)]
            assert signals[f"mode_axis{k}"] == axis["mode"]
            np.testing.assert_array_equal(np.float32([*values, *extras]),
                                          np.float32([*axis["d"], *axis["extra"]]))  # fmt: skip

    def test_modes_have_their_names(self, database):
        name_of = {int(mode): mode.name.lower() for mode in Mode}
        for message in database.messages:
            choices = message.get_signal_by_name("mode_axis3").choices
            assert {code: str(choice) for code, choice in choices.items()} == {
                mode: name_of.get(mode, f"mode_{mode}") for mode in MODES
            }


def test_init_packet_is_passed_on_unless_its_cycle_is_too_short():
    end = CanEndpoint(BusRates(), UP)
    broken = init_packet(open_axes_map=np.full((4, 10), 3))
    for packet in (broken, init_packet(sample_time=0), init_packet(7, 4)):
        assert end.frames(packet)
    with pytest.raises(CanBusLoadError, match=r"8 frames for 6 axes fill 135\.7 %.* or UDP"):
        end.frames(init_packet(sample_time=1))
