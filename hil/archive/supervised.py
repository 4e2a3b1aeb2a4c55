"""The supervisor's handle on the archive process."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from socket import AF_UNIX, SOCK_SEQPACKET, socketpair
from typing import IO, Protocol

from hil.archive.commands import Answer, Channel, Command, End

END_TIMEOUT = 30.0
"""s for the last flush of a slow disk."""


class SharedMemory(Protocol):
    """What the archive process attaches: the exchange process's descriptors."""

    ring_fd: int
    event_fd: int
    control_fd: int


def _import_paths() -> list[str]:
    return [path or str(Path.cwd()) for path in sys.path]


@dataclass(eq=False)
class ArchiveProcessHandle:
    """Starts, commands and ends the archive process.

    Attributes:
        process: the child, in a process session of its own.
        channel: our end of the command socket.
    """

    process: subprocess.Popen[bytes]
    channel: Channel
    _words: IO[bytes]

    @classmethod
    def start(cls, memory: SharedMemory, n_joints: int) -> ArchiveProcessHandle:
        """Start the process on the exchange's shared memory."""
        ours, theirs = socketpair(AF_UNIX, SOCK_SEQPACKET)
        passed = (memory.ring_fd, memory.event_fd, memory.control_fd, theirs.fileno())
        words: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", "hil.archive.process", *map(str, (*passed, n_joints))],
                pass_fds=passed,
                start_new_session=True,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=words,
                # What this process can import, that one can.
                env={**os.environ, "PYTHONPATH": os.pathsep.join(_import_paths())},
            )
        except BaseException:
            ours.close()
            words.close()
            raise
        finally:
            theirs.close()
        return cls(process, Channel(ours), words)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    def send(self, command: Command) -> None:
        """Send a command; one that cannot be delivered shows in `alive`."""
        try:
            self.channel.send(command)
        except OSError:
            return

    def answer(self, timeout: float) -> Answer | None:
        """The next answer, or None if none comes within `timeout` s (or none will ever)."""
        readable, _, _ = select.select([self.channel], [], [], timeout)
        if not readable:
            return None
        try:
            answer: Answer = self.channel.receive()
        except EOFError:
            return None
        return answer

    def last_words(self) -> str:
        """What a process that died wrote last, as the rest of a sentence; "" without any."""
        if self.alive:
            return ""
        size = os.fstat(self._words.fileno()).st_size
        text = os.pread(self._words.fileno(), 400, max(0, size - 400)).decode(errors="replace")
        lines = text.strip().splitlines()
        return f" ({lines[-1]})" if lines else f" (exit status {self.process.returncode})"

    def end(self) -> None:
        """Let it complete what is open and end; it is waited for, and not killed."""
        self.send(End())
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(END_TIMEOUT)
        self.channel.close()
        self._words.close()
