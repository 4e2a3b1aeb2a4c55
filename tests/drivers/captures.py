"""Reads UDP payloads out of classic pcap files (Ethernet, IPv4)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

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
ETHERNET = 1


@dataclass(frozen=True)
class Datagram:
    time: float
    from_controller: bool
    payload: bytes


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
