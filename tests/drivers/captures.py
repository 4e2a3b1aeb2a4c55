"""Reads UDP payloads out of classic pcap files (Ethernet, IPv4)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import pytest

CAPTURES = (
    "a_505",
    "a_508",
    "a_exit",
    "a_mode4",
    "a_mode5",
    "a_restart506",
    "a_stagger",
    "a_wrap",
    "b_ufmg_fast",
    "b_ufmg_literal",
    "b_ufmg_mode4",
    "s_TestMode4_movement_7ax_stagger",
)
"""The letter says who wrote the ends: `a_*` a model of the controller and one laboratory's PC
program, `b_*` one laboratory's controller and another's PC program, `s_*` the tail of a session."""
ETHERNET = 1


@dataclass(frozen=True)
class Datagram:
    time: float
    from_controller: bool
    payload: bytes


def capture_path(shared_data: Path, name: str) -> Path:
    """Where a capture lies; skips the test if that one is not there."""
    path = shared_data / "c4g_captures" / f"{name}.pcap"
    if not path.is_file():
        pytest.skip(f"the capture {name} is not in {path.parent.name} beside this checkout")
    return path


def read_datagrams(path: Path) -> list[Datagram]:
    """All datagrams in order; the end that sends first is the controller."""
    data = path.read_bytes()
    magic, _, _, _, _, _, link_type = struct.unpack_from("<IHHiIII", data)
    assert magic == 0xA1B2C3D4
    assert link_type == ETHERNET
    datagrams: list[Datagram] = []
    controller = None
    offset = 24
    while offset < len(data):
        seconds, fraction, captured, length = struct.unpack_from("<IIII", data, offset)
        assert captured == length
        frame = data[offset + 16 : offset + 16 + captured]
        offset += 16 + captured
        assert frame[12:14] == b"\x08\x00"
        ip = frame[14:]
        udp = ip[4 * (ip[0] & 0x0F) :]
        port, _, udp_length = struct.unpack_from(">HHH", udp)
        sender = (ip[12:16], port)
        controller = controller or sender
        payload = udp[8:udp_length]
        datagrams.append(Datagram(seconds + 1e-6 * fraction, sender == controller, payload))
    return datagrams


def conversation(shared_data: Path, name: str) -> list[tuple[bytes, bytes | None]]:
    """Each packet of the controller with the answer it got, if any."""
    pairs: list[tuple[bytes, bytes | None]] = []
    for datagram in read_datagrams(capture_path(shared_data, name)):
        if datagram.from_controller:
            pairs.append((datagram.payload, None))
        else:
            packet, earlier = pairs[-1]
            assert earlier is None, f"{name}: two answers to one packet"
            pairs[-1] = (packet, datagram.payload)
    return pairs
