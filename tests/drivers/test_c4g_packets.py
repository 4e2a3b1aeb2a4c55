from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import CyclicPacket, InitPacket, Mode, PacketError
from drivers.c4g_packets import (
    AXIS_DTYPE,
    INIT_DTYPE,
    INIT_LENGTH,
    LAST_NUMBER,
    MAX_AXES,
    NO_SLOT,
    cyclic_length,
    echo,
    is_init,
    next_number,
    packet_number,
)


@pytest.mark.parametrize(("number", "answer"), [(1, 2), (0x7FFE, 0x7FFF), (0x7FFF, 1)])
def test_an_answer_has_the_next_number(number, answer):
    assert next_number(number) == answer
    packet = struct.pack("<i", number) + bytes(range(200))
    assert echo(packet) == struct.pack("<i", answer) + bytes(range(200))


@pytest.mark.parametrize("number", [0, -1, 0x8000, -(2**31)])
def test_numbers_outside_the_range_are_refused(number):
    with pytest.raises(PacketError) as caught:
        packet_number(struct.pack("<i", number) + bytes(44))
    assert caught.value.value == number


INIT = struct.pack("<iiii", 10, 3, 9, 6) + bytes(1184)
MAP_OF_ONE = np.where(np.arange(40).reshape(4, 10) == 0, 0, NO_SLOT)


@pytest.mark.parametrize(
    ("decode", "field", "value", "expected"),
    [
        (lambda: packet_number(bytes(11)), "length", 11, "12 bytes of a header"),
        (lambda: packet_number(bytes(12)), "number", 0, "1..32767"),
        (lambda: CyclicPacket.decode(bytes(227), 6), "length", 227, "228 bytes for 6 axes"),
        (lambda: CyclicPacket.decode(bytes(228), 6), "number", 0, "1..32767"),
        (lambda: InitPacket.decode(INIT[:-1]), "length", 1199, "1200 bytes"),
        (lambda: InitPacket.decode(b"\13" + INIT[1:]), "number", 11, "10 (init)"),
        (lambda: InitPacket.decode(INIT[:12] + bytes(1188)), "n_axes", 0, "1..20"),
        (
            lambda: InitPacket.build(2, 2, {}, open_axes_map=MAP_OF_ONE).open_axes(),
            *("open_axes_map", [0], "each slot 0..1 for exactly one axis"),
        ),
    ],
)
def test_an_error_names_field_value_and_what_is_right(decode, field, value, expected):
    with pytest.raises(PacketError) as caught:
        decode()
    assert (caught.value.field, caught.value.value) == (field, value)
    assert f"{field} is {value!r}" in str(caught.value)
    assert expected in str(caught.value)


class TestCyclicPacket:
    def test_layout_is_that_of_the_worked_example(self):
        # 6 axes, arm 1 drive on, number 291; axis 1: target 0.5, actual 0.4995, current 0.5 A
        head = bytes.fromhex("23010000 05000000 00000000")
        axis_1 = bytes.fromhex(
            "00000000 0000003f 00000000 77beff3e 6f1283b9 0000003f 0000803e 0000003e 00000000"
        )
        packet = CyclicPacket.decode(head + axis_1 + bytes(5 * 36), 6)
        assert packet.number == 291
        assert packet.status == bytes([5, 0, 0, 0])
        assert packet.axes["mode"][0] == Mode.CLOSED
        np.testing.assert_array_equal(
            packet.axes["d"][0], np.float32([0.5, 0.0, 0.4995, -0.00025, 0.5])
        )
        np.testing.assert_array_equal(packet.axes["extra"][0], np.float32([0.25, 0.125, 0.0]))

    def test_answer_is_encoded_as_in_the_worked_example(self):
        packet = CyclicPacket.zeros(293, 6)
        packet.axes["mode"] = Mode.POSITION
        packet.axes["d"][:, 0] = 1.5125
        packet.axes["d"][:, 1] = 0.0125
        block = bytes.fromhex("04000000 9a99c13f cdcc4c3c") + bytes(24)
        assert packet.encode() == bytes.fromhex("25010000 00000000 00000000") + 6 * block

    @given(data=st.data(), n=st.integers(1, MAX_AXES))
    def test_any_bytes_decode_and_encode_unchanged(self, data, n):
        number = data.draw(st.integers(1, LAST_NUMBER))
        payload = data.draw(st.binary(min_size=cyclic_length(n) - 4, max_size=cyclic_length(n) - 4))
        packet = struct.pack("<i", number) + payload
        assert CyclicPacket.decode(packet, n).encode() == packet

    @pytest.mark.parametrize("length", [0, 3, 12, 227, 733, INIT_LENGTH])
    def test_other_lengths_are_refused(self, length):
        packet = (struct.pack("<i", 5) + bytes(INIT_LENGTH))[:length]
        with pytest.raises(PacketError) as caught:
            CyclicPacket.decode(packet, 6)
        assert caught.value.field == "length"


# Offsets as documented for the wire.
OFFSETS = {
    "number": 0,
    "fields_per_packet": 4,
    "fields_per_axis": 8,
    "n_axes": 12,
    "open_mode": 16,
    "header_types": 176,
    "axis_types": 188,
    "sample_time": 224,
    "open_axes_map": 228,
    "calibration": 388,
    "current_limit": 548,
    "version": 708,
    "kinematic_influence": 720,
    "gear_ratio": 880,
    "following_error": 1040,
}


class TestInitPacket:
    def test_layout(self):
        assert (AXIS_DTYPE.itemsize, INIT_DTYPE.itemsize) == (36, INIT_LENGTH)
        assert {name: INIT_DTYPE.fields[name][1] for name in INIT_DTYPE.names} == OFFSETS

    def test_worked_example(self):
        raw = bytearray(INIT_LENGTH)
        raw[0:16] = bytes.fromhex("0a000000 03000000 09000000 06000000")
        raw[40:176] = b"\xff" * 136
        raw[224:228] = bytes.fromhex("02000000")
        raw[228:388] = struct.pack("<40i", *range(6), *[NO_SLOT] * 34)
        raw[708:720] = bytes.fromhex("03000000 14000000 31010000")
        raw[732:744] = bytes.fromhex("0ad7233c 6f12033b 8fc2f53c")
        raw[880:904] = bytes.fromhex("0000f0c2 00001643 0000dcc2 0000b442 0000a042 000070c2")
        raw[1040:1064] = bytes.fromhex("00000040") * 6
        init = InitPacket.decode(bytes(raw))
        assert init.n_axes == 6
        assert init.sample_time == 2
        assert init.period == 0.002
        assert init.version == (3, 20, 305)
        assert init.wrist_coupling() == pytest.approx((0.01, 0.002, 0.03))
        np.testing.assert_array_equal(init.gear_ratio[0, :6], [-120, 150, -110, 90, 80, -60])
        np.testing.assert_array_equal(init.following_error[0, :6], 2.0)
        assert [axis.slot for axis in init.open_axes()] == list(range(6))
        assert init.encode() == bytes(raw)

    def test_what_is_built_is_laid_out_as_the_worked_example(self):
        """3 fields per packet and 9 per axis; open axes are closed in slots from 0, others -1."""
        init = InitPacket.build(6, 2, {})
        assert init.encode()[:16] == bytes.fromhex("0a000000 03000000 09000000 06000000")
        assert init.encode()[16:176] == bytes(24) + b"\xff" * 136
        assert init.encode()[224:388] == struct.pack("<41i", 2, *range(6), *[NO_SLOT] * 34)

    @given(st.binary(min_size=INIT_LENGTH - 16, max_size=INIT_LENGTH - 16))
    def test_any_bytes_decode_and_encode_unchanged(self, payload):
        packet = struct.pack("<iiii", 10, 3, 9, 6) + payload
        assert InitPacket.decode(packet).encode() == packet

    def test_number_10_alone_is_not_init(self):
        assert not is_init(CyclicPacket.zeros(10, 6).encode())
        assert not is_init(struct.pack("<i", 11) + bytes(1196))
        assert is_init(struct.pack("<i", 10) + bytes(1196))

    @pytest.mark.parametrize("n_axes", [0, -1, 21, 2**30])
    def test_an_impossible_number_of_axes_is_refused(self, n_axes):
        packet = struct.pack("<iiii", 10, 3, 9, n_axes) + bytes(1184)
        with pytest.raises(PacketError) as caught:
            InitPacket.decode(packet)
        assert caught.value.field == "n_axes"

    @pytest.mark.parametrize("n_axes", [1, 20])
    def test_one_axis_or_twenty_may_be_open(self, n_axes):
        packet = struct.pack("<iiii", 10, 3, 9, n_axes) + bytes(1184)
        assert InitPacket.decode(packet).n_axes == n_axes

    def test_limits_of_an_arm(self):
        limits = {"current_limit": 1.0, "following_error": 2.0}
        rows = {name: k * np.arange(40.0).reshape(4, 10) for name, k in limits.items()}
        init = InitPacket.build(3, 2, {}, **rows)
        for name, k in limits.items():
            stated = init.stated(name, 2, 3)
            np.testing.assert_array_equal(stated, k * np.array([10.0, 11.0, 12.0]))
            assert stated.dtype == np.float64

    @pytest.mark.parametrize("not_open", [NO_SLOT, -1])
    def test_axes_of_two_arms_in_any_slot(self, not_open):
        axes_map = np.full((4, 10), not_open)
        axes_map[0, [0, 2]] = [2, 0]
        axes_map[1, 5] = 1
        init = InitPacket.build(3, 1, {}, open_axes_map=axes_map)
        assert list(init.open_axes()) == [(1, 2, 0), (2, 5, 1), (1, 0, 2)]

    @pytest.mark.parametrize("slots", [[1, 1], [0, 2], [0]])
    def test_a_map_that_is_no_map_is_refused(self, slots):
        axes_map = np.full((4, 10), NO_SLOT)
        axes_map[0, : len(slots)] = slots
        with pytest.raises(PacketError) as caught:
            InitPacket.build(2, 2, {}, open_axes_map=axes_map).open_axes()
        assert caught.value.field == "open_axes_map"
