"""A screen on a terminal, for a test at the other end: writes what it was asked for to a file.

`python screen_rig.py FILE ENDING`: shows a run until it is stopped, then ends in one of several
ways. A line of JSON in FILE for each request. `Terminal` controls the terminal of any program.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pty
import select
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from drivers.states import State
from hil.campaign import stop_on_interrupt
from hil.campaign.dry_run_record import DryRunRecord
from hil.campaign.operator import RunStatus
from hil.campaign.screen import Screen
from hil.control.motion_watch import MotionProgress, OperatorRequest

LONGEST = 60.0
"""s after which it ends with an error."""
NAMES = ("joint_1", "joint_2")


def status(request: OperatorRequest) -> RunStatus:
    """In the third repetition, with the requested override."""
    share = np.array([0.1, 0.9])
    zero = np.zeros(2)
    motion = MotionProgress(
        1.0, 4.0, 1000, 0, 0, 0, State.OPEN, zero, zero, share, zero, share,
        override=request.override, held=request.held,
    )  # fmt: skip
    return RunStatus("repetition", 3, 30, 65.0, motion)


class Terminal:
    """The controlling side of a pseudo-terminal on which a program runs in the foreground."""

    def __init__(self, *command: object, columns: int) -> None:
        self.near, self.far = pty.openpty()
        self.resize(columns, 24)
        self.before = termios.tcgetattr(self.far)
        self.seen = b""
        self.reads = True
        self.process = subprocess.Popen(
            [sys.executable, *map(str, command)],
            stdin=self.far, stdout=self.far, stderr=self.far,
            preexec_fn=self._take_terminal,
            env={**os.environ, "TERM": "xterm-256color", "PYTHONPATH": os.pathsep.join(sys.path)},
        )  # fmt: skip

    def _take_terminal(self) -> None:
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    def resize(self, columns: int, rows: int) -> None:
        fcntl.ioctl(self.near, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))

    def look(self, timeout: float = 0.05) -> None:
        """Take what was written, as a terminal does all the time."""
        if select.select([self.near], [], [], timeout)[0]:
            with contextlib.suppress(OSError):
                self.seen += os.read(self.near, 65536)

    def await_seen(self, shown: bytes, timeout: float = 120.0) -> None:
        until = time.monotonic() + timeout
        while shown not in self.seen:
            assert time.monotonic() < until and self.process.poll() is None, self.seen[-2000:]
            self.look()

    def clear(self) -> None:
        self.seen = b""

    def press(self, keys: str) -> None:
        os.write(self.near, keys.encode())

    def end(self, timeout: float = 10.0) -> int:
        until = time.monotonic() + timeout
        while self.process.poll() is None and time.monotonic() < until:
            if self.reads:
                self.look()
            else:
                time.sleep(0.05)
        assert self.process.returncode is not None, "it did not end"
        before: bytes | None = None
        while self.reads and before != self.seen:
            before = self.seen
            self.look(0.2)
        return self.process.returncode


@contextlib.contextmanager
def on_terminal(*command: object, columns: int = 80) -> Iterator[Terminal]:
    """A Python program on a terminal of its own, killed at the end."""
    end = Terminal(*command, columns=columns)
    try:
        yield end
    finally:
        if end.process.poll() is None:
            end.process.kill()
            end.process.wait()
        os.close(end.near)
        os.close(end.far)


def main() -> int:
    """Run it."""
    file = Path(sys.argv[1])
    ending = sys.argv[2]
    with stop_on_interrupt() as stop, Screen(NAMES, stop, title="rig") as screen:
        with file.open("w", buffering=1) as reported:
            last: OperatorRequest | None = None
            until = time.monotonic() + LONGEST
            if ending in ("question", "contradiction"):
                dry_run = DryRunRecord(
                    "0" * 64, 0.2, ("dryrun_000_a1.mcap",), 12.0, True, NAMES,
                    (0.2, 0.4), (0.001, 0.002), 0, 0,
                    against_gravity=NAMES[1:] if ending == "contradiction" else (),
                )  # fmt: skip
                for _ in range(3):
                    reported.write(json.dumps({"accepted": screen.accept_dry_run(dry_run)}) + "\n")
            while not stop.requested and time.monotonic() < until:
                request = screen.request()
                screen.show(status(request))
                if request != last:
                    last = request
                    state = {"override": round(request.override, 3), "held": request.held}
                    reported.write(json.dumps(state) + "\n")
                time.sleep(0.01)
            reported.write(json.dumps({"stop": stop.requested}) + "\n")
        screen.say("the last line")
        if ending == "error":
            raise RuntimeError("an error on the way")
        if ending == "exit":
            sys.exit(7)
    return 0


if __name__ == "__main__":
    sys.exit(main())
