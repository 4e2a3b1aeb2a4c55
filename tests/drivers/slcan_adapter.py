"""A CAN adapter that speaks slcan, for tests: two serial ports on one bus.

The serial side is a pseudo-terminal; what one adapter is told to send, the other hands to its
host. Lines end with a carriage return: S, Y bit rates, O open, C closed, t and T classic frames,
d and b FD frames (b with bit rate switch). Answers are a bare carriage return, or the bell for
what it does not know.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import threading
import tty

_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_OK, _BELL = b"\r", b"\a"


class _Adapter:
    """One adapter: its end of the pseudo-terminal and what it was told."""

    def __init__(self) -> None:
        self.master, self._slave = pty.openpty()
        tty.setraw(self.master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.open = False
        self.rates: list[str] = []
        self.waiting = bytearray()
        self._line = bytearray()
        os.set_blocking(self.master, False)

    def hand_over(self) -> None:
        """Give the host as much of what waits for it as it takes."""
        with contextlib.suppress(BlockingIOError):
            del self.waiting[: os.write(self.master, self.waiting)]

    def lines(self) -> list[str]:
        """Commands that have come in whole."""
        self._line += os.read(self.master, 4096)
        *whole, rest = self._line.split(b"\r")
        self._line = bytearray(rest)
        return [line.decode("ascii") for line in whole]

    def close(self) -> None:
        os.close(self.master)
        os.close(self._slave)


def _is_frame(line: str) -> bool:
    """Whether a command is a well-formed data frame with a standard identifier."""
    if len(line) < 5 or line[0] not in "tdb":
        return False
    length = int(line[4], 16)
    if line[0] == "t" and length > 8:
        return False
    return len(line) == 5 + 2 * _LENGTHS[length] and int(line[1:4], 16) < 0x800


class SlcanBus:
    """Two adapters joined by a bus, served by a thread.

    Attributes:
        ports: the two serial devices.
        refused: commands that were answered with the bell.
    """

    def __init__(self) -> None:
        self._adapters = (_Adapter(), _Adapter())
        self.ports = tuple(adapter.port for adapter in self._adapters)
        self.refused: list[str] = []
        self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def rates(self) -> list[list[str]]:
        """The bit rate commands each adapter was given."""
        return [adapter.rates for adapter in self._adapters]

    def _serve(self) -> None:
        masters = {adapter.master: adapter for adapter in self._adapters}
        ending = False
        while True:
            # What was written before the end is still obeyed.
            sources = [*masters] if ending else [*masters, self._wake[0]]
            full = [adapter.master for adapter in self._adapters if adapter.waiting]
            ready, free, _ = select.select(sources, full, [], 0.0 if ending else None)
            if ending and not ready:
                return
            for master in free:
                masters[master].hand_over()
            ending = ending or self._wake[0] in ready
            for master in ready:
                if master not in masters:
                    continue
                adapter = masters[master]
                other = next(a for a in self._adapters if a is not adapter)
                for line in adapter.lines():
                    self._obey(adapter, other, line)

    def _obey(self, adapter: _Adapter, other: _Adapter, line: str) -> None:
        answer = _OK
        if line == "O":
            adapter.open = True
        elif line in ("C", ""):
            adapter.open = adapter.open and line == ""
        elif line[0] in "SY":
            adapter.rates.append(line)
        elif adapter.open and _is_frame(line):
            if other.open:
                other.waiting += line.encode() + b"\r"
            answer = b"z\r"
        else:
            self.refused.append(line)
            answer = _BELL
        adapter.waiting += answer

    def close(self) -> None:
        os.write(self._wake[1], b"x")
        self._thread.join()
        for adapter in self._adapters:
            adapter.close()
        for end in self._wake:
            os.close(end)
