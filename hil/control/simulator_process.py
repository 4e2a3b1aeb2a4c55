"""Simulated controller in another process, with a real link to it over the loopback device."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any

from drivers.child_process import ChildProcess

LOOPBACK = "127.0.0.1"
_SIMULATE_ARGUMENTS = ("-m", "hil", "simulate")
SIMULATE_COMMAND = (sys.executable, *_SIMULATE_ARGUMENTS)
END_TIMEOUT = 20.0
"""Time limit for a simulated controller to end its session, s."""


@dataclass(eq=False)
class SimulatorProcess:
    """A child process that runs `hil simulate`."""

    process: ChildProcess

    @classmethod
    def start(cls, cell: Path, *options: str) -> SimulatorProcess:
        """Start a controller for a cell file."""
        return cls(ChildProcess((*_SIMULATE_ARGUMENTS, str(cell), "--json", *options)))

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self.process.alive

    def finish(self) -> None:
        """Request the end of the session: arm at rest, drive off, then mode 504."""
        self.process.terminate()

    def failure(self) -> str | None:
        """Return its last error message; None while it runs, or if it succeeded."""
        if not self.process.status:
            return None
        output = (line.strip() for line in self.process.errors.splitlines())
        lines = [line for line in output if any(letter.isalpha() for letter in line)]
        errors = [line for line in lines if line.startswith("error:")]
        return (errors or lines or [f"exit status {self.process.status}"])[-1]

    def end(self) -> dict[str, Any]:
        """Wait for the end, or kill it; return its summary (`docs/simulate.md`), {} if killed."""
        if self.process.wait(END_TIMEOUT) is None:
            self.process.kill()
        self.process.close()
        lines = self.process.output.splitlines()
        return json.loads(lines[-1]) if lines else {}


def free_port() -> int:
    """Return a free UDP port of the loopback device."""
    with socket(AF_INET, SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
    return port
