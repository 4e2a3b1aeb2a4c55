"""An attacker on the network of the controller, who sends packets to the PC.

``python -m tests.untrusted.attacker --to 10.0.0.1:1000 --as 10.0.0.2:4000 init`` sends init packets
from a forged address (raw sockets: root). Only for test networks.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

Address = tuple[str, int]
LENGTH = struct.Struct("<I")
_UDP = 17
_EVERYTHING = 0x0003  # outgoing packets are shown to this protocol only


def checksum(data: bytes) -> int:
    """Return the checksum of RFC 1071."""
    if len(data) % 2:
        data += b"\0"
    total: int = sum(struct.unpack(f"!{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return 0xFFFF - total & 0xFFFF


def datagram(source: Address, target: Address, body: bytes) -> bytes:
    """Return an IPv4 datagram with a UDP packet in it."""
    udp = struct.pack("!4H", source[1], target[1], 8 + len(body), 0) + body
    addresses = socket.inet_aton(source[0]) + socket.inet_aton(target[0])
    head = struct.pack("!BBHHHBBH", 0x45, 0, 20 + len(udp), 7, 0, 64, _UDP, 0) + addresses
    return head[:10] + struct.pack("!H", checksum(head)) + head[12:] + udp


def recorded(path: Path) -> list[bytes]:
    """Return the packets of a recorded session, each stored after its length."""
    data, found, at = path.read_bytes(), [], 0
    while at < len(data):
        (size,) = LENGTH.unpack_from(data, at)
        found.append(data[at + 4 : at + 4 + size])
        at += 4 + size
    return found


def record(port: int, seconds: float, path: Path) -> int:
    """Record the packets to a port that pass this host's network devices."""
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    end = time.monotonic() + seconds
    count = 0
    with (
        socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_EVERYTHING)) as wire,
        path.open("wb") as file,
    ):
        wire.settimeout(0.2)
        while time.monotonic() < end and not over.is_set():
            try:
                data = wire.recv(65535)
            except TimeoutError:
                continue
            head = 4 * (data[0] & 15)
            if (
                data[0] >> 4 == 4
                and data[9] == _UDP
                and struct.unpack_from("!H", data, head + 2)[0] == port
            ):
                body = data[head + 8 :]
                file.write(LENGTH.pack(len(body)) + body)
                file.flush()
                count += 1
    return count


def random_lengths(rng: random.Random) -> Iterator[bytes]:
    """Datagrams of every length, the longest ones in fragments."""
    for size in itertools.cycle((0, 1, 11, 12, 48, 1200, 1471, 1472, 1500, 1501, 9000, 65507)):
        yield rng.randbytes(size)


def bodies(what: str, session: list[bytes], rng: random.Random) -> Iterator[bytes]:
    if what == "odd":
        return random_lengths(rng)
    if what == "init":
        return itertools.cycle([next(body for body in session if len(body) == 1200)])
    if what == "sync":
        return itertools.cycle([session[0]])
    if what == "cyclic":
        return itertools.cycle([body for body in session[20:] if len(body) != 1200])
    if what == "later":  # numbers that a new session has not reached
        return itertools.cycle(session[-1000:])
    return itertools.cycle(session)  # "replay": the whole session


class Sender:
    """Sends from this host's address, or from a forged one."""

    def __init__(self, target: Address, source: Address | None) -> None:
        self._target, self._source = target, source
        self.sent = self.answered = 0
        if source is None:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        else:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)
        self._socket.setblocking(False)

    def send(self, body: bytes) -> None:
        """Send one packet; it is lost if the system does not accept it."""
        with suppress(OSError):
            if self._source is None:
                self._socket.sendto(body, self._target)
            else:
                packet = datagram(self._source, self._target, body[:1472])
                self._socket.sendto(packet, (self._target[0], 0))
            self.sent += 1

    def listen(self) -> None:
        """Count replies, if they can reach this host."""
        if self._source is None:
            with suppress(OSError):
                while self._socket.recv(2048):
                    self.answered += 1


def attack(
    sender: Sender, packets: Iterator[bytes], rate: float, seconds: float
) -> dict[str, float]:
    """Send at a rate [1/s] for some seconds, or until SIGTERM."""
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    begin = time.monotonic()
    tried = 0
    while (elapsed := time.monotonic() - begin) < seconds and not over.is_set():
        for _ in range(max(0, min(200, int(rate * elapsed) - tried))):
            sender.send(next(packets))
            tried += 1
        sender.listen()
        if tried >= int(rate * elapsed):
            time.sleep(min(0.001, 1.0 / rate))
    return {"sent": sender.sent, "answered": sender.answered}


def address(text: str) -> Address:
    host, _, port = text.rpartition(":")
    return host, int(port)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "what", choices=("record", "init", "sync", "cyclic", "later", "replay", "odd")
    )
    parser.add_argument("--to", type=address, required=True, help="HOST:PORT of the PC")
    parser.add_argument("--as", dest="source", type=address, help="HOST:PORT to send from")
    parser.add_argument("--port", action="store_true", help="read that port from stdin")
    parser.add_argument("--session", type=Path, help="a recorded session (made by `record`)")
    parser.add_argument("--rate", type=float, default=500.0, help="packets per second")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    if asked.what == "record":
        result: dict[str, float] = {"recorded": record(asked.to[1], asked.seconds, asked.session)}
    else:
        session = recorded(asked.session) if asked.session is not None else []
        packets = bodies(asked.what, session, random.Random(asked.seed))
        line = sys.stdin.readline()  # wait for the start
        source = (asked.source[0], int(line)) if asked.port else asked.source
        result = attack(Sender(asked.to, source), packets, asked.rate, asked.seconds)
    sys.stdout.write(json.dumps(result) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
