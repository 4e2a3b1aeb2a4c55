"""One thing looked at and what follows from it; the machine as text, or a test's own."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path


class Status(StrEnum):
    """How a check came out: it works, costs latency or depends on chance, fails, is not known."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    UNKNOWN = "unknown"


_WHY = {
    "user": "nothing of hil needs root, and what root may do says nothing about other users",
    "real-time priority": "without it other programs may run before the packet is answered",
    "memory lock": "a page that has to be fetched from disk costs many cycles",
    "processor idle latency": "halves the usual wake-up time",
    "disk space": "a full disk ends the motion: the arm is stopped, what was archived is whole",
    "disk": "a motion is stopped if the disk keeps the archive waiting for seconds",
    "clock source": "the clock is read several times a cycle; a slow one costs µs each time",
    "frequency governor": "a processor that clocks down answers its first packet late",
    "idle states": "a sleeping processor has to wake before it can answer",
    "isolated processors": "other programs and interrupts stay off an isolated processor; worth it "
    "only if the latency measured below is not good enough",
    "kernel preemption": "how long the kernel finishes its own work before a waiting program runs",
    "virtual machine": "the host may stop it for milliseconds, and no program in it can tell",
    "stolen time while measuring": "time in which a virtual machine did not run",
    "other load": "real-time priority goes before other programs, not before interrupts and disk",
    "controller link": "routes, ports and buses are looked at for a cell with a real link",
    "wake-up latency": "without it nothing is known",
    "turnaround latency": "without it nothing is known",
    "CAN": "a node at another bit rate disturbs every frame on the bus",
    "UDP port": "the controller sends to this port and no other",
    "route to the controller": "a router or a wrong card in between adds delay, or loses all",
    "card": "packets of the controller come every millisecond; nothing else should share the card",
    "interrupt coalescing": "a card that gathers packets delays each",
    "ARP entry": "an entry that expires is asked for anew in mid-motion, and answers wait for it",
    "firewall": "a filtered controller looks exactly like one that is switched off",
}
"""What each check matters for, by the beginning of its name."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes:
        name: what was looked at.
        status: how it came out.
        found: what was found, in words.
        remedy: commands to type, one a line, each to be typed as it stands; empty if none.
    """

    name: str
    status: Status
    found: str
    remedy: tuple[str, ...] = ()

    @property
    def why(self) -> str:
        """What it matters for."""
        return next((why for name, why in _WHY.items() if self.name.startswith(name)), "")


def ok(name: str, found: str) -> Check:
    """It works."""
    return Check(name, Status.OK, found)


def warn(name: str, found: str, *remedy: str) -> Check:
    """It costs latency, or depends on chance."""
    return Check(name, Status.WARN, found, remedy)


def bad(name: str, found: str, *remedy: str) -> Check:
    """The link does not work so."""
    return Check(name, Status.BAD, found, remedy)


def unknown(name: str, found: str, *remedy: str) -> Check:
    """It cannot be found out from here."""
    return Check(name, Status.UNKNOWN, found, remedy)


COMMAND_TIMEOUT = 3.0
"""s that a command may take before its answer counts as not given."""
_LARGEST = 4_000_000


@dataclass(frozen=True)
class Answer:
    """What a command said: exit status and both streams."""

    status: int
    output: str
    errors: str = ""


Runner = Callable[[Sequence[str]], Answer | None]


def run_command(command: Sequence[str]) -> Answer | None:
    """Run a command without input; None if it is not installed or does not end in time."""
    path = shutil.which(command[0], path="/usr/sbin:/usr/bin:/sbin:/bin:/usr/local/bin")
    if path is None:
        return None
    try:
        done = subprocess.run(
            [path, *command[1:]],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=COMMAND_TIMEOUT,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return Answer(done.returncode, done.stdout, done.stderr)


@dataclass(frozen=True)
class System:
    """Where facts are read from.

    Attributes:
        root: prefix of every path.
        run: runs a command, see `run_command`.
    """

    root: Path = Path("/")
    run: Runner = run_command

    def path(self, name: str) -> Path:
        """The file called `name` (absolute) on this system."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str | None:
        """The stripped text of a file; None if it is not there or may not be read."""
        try:
            with self.path(name).open("rb") as file:
                return file.read(_LARGEST).decode("utf-8", errors="replace").strip()
        except OSError:
            return None

    def number(self, name: str) -> int | None:
        """The integer in a file; None if there is none."""
        text = self.text(name)
        try:
            return None if text is None else int(text)
        except ValueError:
            return None

    def names(self, folder: str) -> list[str]:
        """Names in a folder, sorted; none if it cannot be listed."""
        try:
            return sorted(path.name for path in self.path(folder).iterdir())
        except OSError:
            return []
