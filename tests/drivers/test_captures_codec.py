"""Third-party packets decode to the right numbers and encode to the same bytes."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from drivers import CyclicPacket, InitPacket
from drivers.packets import INIT_LENGTH, MAX_AXES, cyclic_length, echo, is_init
from tests.drivers import oracle
from tests.drivers.captures import CAPTURES, capture_path, conversation, read_datagrams

SEVEN_AXES = "s_TestMode4_movement_7ax_stagger"


def open_axes(pairs: list[tuple[bytes, bytes | None]], name: str) -> int:
    inits = [packet for packet, _ in pairs if len(packet) == INIT_LENGTH]
    # One capture begins after the init packet; the name tells the number of axes.
    return 7 if name == SEVEN_AXES else struct.unpack_from("<i", inits[0], 12)[0]


@pytest.mark.parametrize("name", CAPTURES)
def test_every_packet_of_either_end_decodes_field_by_field_and_encodes_bit_for_bit(
    shared_data: Path, name: str
):
    datagrams = read_datagrams(capture_path(shared_data, name))
    n = open_axes(conversation(shared_data, name), name)
    kinds = dict.fromkeys(("init", "whole", "long"), 0)
    for datagram in datagrams:
        data = datagram.payload
        if len(data) == INIT_LENGTH:
            kinds["init"] += 1
            if datagram.from_controller:
                assert is_init(data)
                assert InitPacket.decode(data).encode() == data
            continue
        packet = CyclicPacket.decode(data, n)
        length = cyclic_length(n)
        assert packet.encode() == data[:length]
        kinds["whole" if len(data) == length else "long"] += 1
        if len(data) == cyclic_length(MAX_AXES):
            # Sync packets, and a controller that always sends room for all axes.
            assert CyclicPacket.decode(data, MAX_AXES).encode() == data
        expected = oracle.parse(data, n)
        assert (packet.number, packet.status, packet.functionality) == expected[:3]
        for axis, their in zip(packet.axes, expected.axes, strict=True):
            assert axis["mode"] == their.mode
            assert axis["d"].tobytes() + axis["extra"].tobytes() == b"".join(their.d)
    assert kinds["whole"] > 0, kinds
    assert kinds["init"] == (0 if name == SEVEN_AXES else 2), kinds
    assert (kinds["long"] > 0) == (name not in (SEVEN_AXES, "a_restart506")), kinds


@pytest.mark.parametrize("name", [name for name in CAPTURES if name != SEVEN_AXES])
def test_the_init_packet_s_fields_stand_where_the_facts_say(shared_data: Path, name: str):
    data = next(p for p, _ in conversation(shared_data, name) if len(p) == INIT_LENGTH)
    init = InitPacket.decode(data)

    def per_arm(offset: int, letter: str) -> np.ndarray:
        return np.array(struct.unpack_from(f"<40{letter}", data, offset)).reshape(4, 10)

    assert (init.number, init.n_axes) == (10, struct.unpack_from("<i", data, 12)[0])
    assert init.sample_time == struct.unpack_from("<i", data, 224)[0]
    assert init.version == struct.unpack_from("<3i", data, 708)
    for found, offset, letter in (
        (init.open_mode, 16, "i"),
        (init.open_axes_map, 228, "i"),
        (init.calibration, 388, "f"),
        (init.current_limit, 548, "f"),
        (init.kinematic_influence, 720, "f"),
        (init.gear_ratio, 880, "f"),
        (init.following_error, 1040, "f"),
    ):
        np.testing.assert_array_equal(found, per_arm(offset, letter))


@pytest.mark.parametrize("name", CAPTURES)
def test_sync_and_init_answers_of_the_foreign_program_are_echoes(shared_data: Path, name: str):
    for packet, reply in conversation(shared_data, name):
        number = struct.unpack_from("<i", packet)[0]
        if len(packet) == INIT_LENGTH or (name[0] == "a" and len(packet) == 732):
            assert echo(packet) == reply == oracle.echo(packet)
        elif reply is not None:
            assert struct.unpack_from("<i", reply)[0] == oracle.answer_number(number)
