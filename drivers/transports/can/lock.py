"""One program to a CAN bus: two that answer one controller would both be believed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import tempfile
from pathlib import Path
from typing import Final

from drivers.transports.base import TransportError

_WITHIN_THIS_PROCESS: Final = "virtual"
"""python-can's bus that no other program can open."""


class BusLock:
    """Keeps other programs of ours off a bus; whoever dies lets go of it.

    Advisory, as that of a campaign's folder: programs that do not ask for it are not excluded.

    Raises:
        TransportError: another program has the bus, or the lock cannot be made.
    """

    def __init__(self, interface: str, channel: str) -> None:
        self._fd = -1
        if interface == _WITHIN_THIS_PROCESS:
            return
        link = f"CAN bus {interface}:{channel}"
        path = _path(interface, channel)
        try:
            self._fd = _opened(path)
        except OSError as error:
            remedy = f"remove {path}, or make it writable"
            reason = f"its lock {path} cannot be opened ({error.strerror})"
            raise TransportError(link, reason, remedy) from error
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.pread(self._fd, 20, 0).decode("ascii", "replace").strip()
            self.release()
            raise TransportError(
                link,
                f"another program has it (process {holder or 'unknown'})",
                "wait for its end, or stop it",
            ) from error
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Let go of the bus. Twice changes nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _path(interface: str, channel: str) -> Path:
    """Of the lock; the same for each name of one serial port."""
    if channel.startswith("/"):
        channel = str(Path(channel).resolve())
    name = re.sub(r"[^0-9A-Za-z.]+", "_", f"{interface}_{channel}")
    return Path(tempfile.gettempdir()) / f"hil-can-{name}.lock"


def _opened(path: Path) -> int:
    """The file, for every user of this computer.

    The file stays: removing it would let two programs hold locks on two files of one name. In a
    folder that all may write to, one that lies there may not be opened as if it were to be made.
    """
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    with contextlib.suppress(FileExistsError):
        made = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
        os.fchmod(made, 0o666)
        return made
    return os.open(path, flags)
