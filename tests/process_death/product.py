"""The product's own processes, seen from outside: what /proc and their shared memory tell."""

from __future__ import annotations

import mmap
import os
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers import record
from drivers.exchange.control import ControlBlock
from drivers.record import RingReader

EXCHANGE: Final = "drivers.exchange"
ARCHIVE: Final = "hil.archive.process"
JOINTS: Final = 2
_RING, _CONTROL = 2, 4  # places in the exchange's command line, behind the module's name


def started_by(supervisor: int, module: str) -> int:
    """Process id of the child of a supervisor that runs a module, 0 if there is none."""
    with suppress(OSError):
        children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text()
        for pid in map(int, children.split()):
            if module in _words(pid):
                return pid
    return 0


def marked(name: str, value: str) -> list[int]:
    """Processes that were started with a variable in their environment, zombies left out."""
    mark, found = f"{name}={value}".encode(), []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(int(entry.name))
    return found


def listening(port: int) -> bool:
    """Whether a process of this computer has a UDP port."""
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        if line.split()[1].endswith(f":{port:04X}"):
            return True
    return False


def _words(pid: int) -> list[str]:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    return []


def _descriptor(exchange: int, place: int) -> int:
    """One of the exchange's descriptors, opened here; OSError if it is gone."""
    words = _words(exchange)
    if EXCHANGE not in words:
        raise ProcessLookupError(f"{exchange} is no exchange process any more")
    number = words[words.index(EXCHANGE) + 1 + place]
    return os.open(f"/proc/{exchange}/fd/{number}", os.O_RDWR)


class Memory:
    """The shared memory of an exchange, kept beyond its death.

    Raises:
        OSError: there is no such exchange any more.
    """

    def __init__(self, exchange: int) -> None:
        self._ring = _descriptor(exchange, _RING)
        descriptor = _descriptor(exchange, _CONTROL)
        self.control = ControlBlock(descriptor)
        os.close(descriptor)
        self._words = memoryview(mmap.mmap(self._ring, 4096)).cast("B").cast("q")

    @property
    def written(self) -> int:
        """Records written so far."""
        return int(self._words[record._WRITTEN])

    @property
    def behind(self) -> int:
        """Records written that the archive process has not taken; 0 before it has begun to."""
        read = int(self._words[record._READ])
        return self.written - read if read else 0

    def records(self) -> NDArray[np.void]:
        """All records of the session: the ring is larger than any of these."""
        return RingReader(self._ring, JOINTS, acknowledge=False).drain()

    def close(self) -> None:
        """Give it up."""
        os.close(self._ring)
