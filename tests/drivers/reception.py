"""Which packets get an answer at all, seen from outside, by nothing of the code under test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tests.drivers import oracle

LAST = 0x7FFF
SAMPLE_TIME = slice(224, 228)
"""Of an init packet, ms."""
Kind = Literal["nothing", "again", "echo", "init", "cyclic"]


def number_of(packet: bytes) -> int:
    return int.from_bytes(packet[:4], "little", signed=True)


@dataclass
class Reception:
    """Which packets get an answer, and which packets are the last one once more.

    Attributes:
        silence: s after which a packet is none of the same session any more.
        window: numbers ahead of the last one that are later packets of it; from the init packet on
            what comes within `silence`, of two readings of a number the nearer one.
    """

    silence: float
    window: int = LAST // 2
    last: int = 0
    n_axes: int | None = None
    silent: bool = False
    ended: bool = False
    cold: bool = False
    synced: bool = False
    at_init: bool = False
    last_packet: bytes = b""

    def expect(self, packet: bytes) -> Kind:
        """What kind of answer it gets; takes note of a packet that gets one."""
        kind = self._expect(packet)
        if kind in ("echo", "init", "cyclic"):
            self.last, self.last_packet, self.silent = number_of(packet), packet, False
            self.at_init = kind == "init" or (kind == "echo" and self.at_init)
        return kind

    def _expect(self, packet: bytes) -> Kind:
        if self.ended:
            return "nothing"
        if len(packet) == 1200 and number_of(packet) == 10:
            return self._init(packet)
        number = number_of(packet)
        if len(packet) < 12 or not 1 <= number <= LAST:
            return "nothing"
        on = oracle.DRIVE_ON in packet[4:8]
        if self.n_axes is None:
            if on or len(packet) >= 1200:
                return "nothing"
            self.synced = True
            return "echo"
        if self.at_init and self.cold and number in (11, 12) and not on:
            return "echo" if len(packet) < 1200 else "nothing"
        ahead = (number - self.last) % LAST
        if self.silent and not on and number < 10 and ahead != 1:
            if len(packet) < 1200:
                self.n_axes, self.at_init, self.synced = None, False, True
                return "echo"
            return "nothing"
        if not oracle.length(self.n_axes) <= len(packet) <= oracle.length(20):
            return "nothing"
        if self.silent:
            return "cyclic"
        if ahead == 0:
            # The same number on other bytes is another packet, of no known time.
            return "again" if packet == self.last_packet else "nothing"
        return "cyclic" if ahead <= self.window else "nothing"

    def _init(self, packet: bytes) -> Kind:
        n = int.from_bytes(packet[12:16], "little", signed=True)
        if not 1 <= n <= 20:
            return "nothing"
        if self.at_init and packet == self.last_packet:
            return "again"
        self.cold = self.n_axes is None and self.synced
        self.n_axes, self.synced = n, False
        cycle = max(1, int.from_bytes(packet[SAMPLE_TIME], "little", signed=True)) / 1000.0
        self.window = max(1, int(min(self.silence / cycle, LAST // 2)))
        return "init"
