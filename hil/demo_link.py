"""Simulated controller in another process, with a real link to it over the loopback device."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket
from typing import IO, Any

LOOPBACK = "127.0.0.1"
SIMULATE = (sys.executable, "-m", "hil", "simulate")
END_TIMEOUT = 20.0
"""Time limit for a simulated controller to end its session, s."""


@dataclass(eq=False)
class SimulatorProcess:
    """A child process that runs `hil simulate`."""

    process: subprocess.Popen[bytes]
    _stderr: IO[bytes] = field(repr=False)
    _stdout: IO[bytes] = field(repr=False)

    @classmethod
    def start(cls, cell: Path, *options: str) -> SimulatorProcess:
        """Start a controller for a cell file."""
        stderr, stdout = (tempfile.TemporaryFile() for _ in range(2))  # noqa: SIM115 - closed in end
        process = subprocess.Popen(
            [*SIMULATE, str(cell), "--json", *options],
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
        )
        return cls(process, stderr, stdout)

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    def finish(self) -> None:
        """Request the end of the session: arm at rest, drive off, then mode 504."""
        if self.running:
            self.process.send_signal(signal.SIGTERM)

    def failure(self) -> str | None:
        """Return its last error message; None while it runs, or if it succeeded."""
        if not self.process.poll():
            return None
        lines = [line for line in _lines(self._stderr) if any(letter.isalpha() for letter in line)]
        errors = [line for line in lines if line.startswith("error:")]
        return (errors or lines or [f"exit status {self.process.returncode}"])[-1]

    def end(self) -> dict[str, Any]:
        """Wait for the end, or kill it; return its summary (`docs/simulate.md`), {} if killed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(END_TIMEOUT)
        if self.running:
            self.process.kill()
            self.process.wait()
        lines = _lines(self._stdout)
        self._stderr.close()
        self._stdout.close()
        return json.loads(lines[-1]) if lines else {}


def _lines(file: IO[bytes]) -> list[str]:
    file.seek(0)
    return [line.strip() for line in file.read().decode(errors="replace").splitlines()]


def free_port() -> int:
    """Return a free UDP port of the loopback device."""
    with socket(AF_INET, SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
    return port
