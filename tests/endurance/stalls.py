"""Stalls of the cores of this computer: `python -m tests.endurance.stalls`.

A virtual machine may not run for some milliseconds, and all its processes miss what was due. A
process that only wakes each millisecond, at the highest real-time priority, measures that.
"""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

PERIOD: Final = 0.001  # s between two looks at the clock; what lasts longer than that is a stall
PRIORITY: Final = 90  # Real-time priority, above all that is measured
_COUNTS: Final = struct.Struct("<qd")  # how many, s in all
_NAME: Final = "stalls_"  # of a file, and the number of the core


def so_far(folder: Path) -> tuple[int, float]:
    """Return number and total duration [s] of the stalls that the watchers wrote into a folder."""
    found = [_COUNTS.unpack(path.read_bytes()) for path in folder.glob(f"{_NAME}*")]
    return sum(count for count, _ in found), sum(seconds for _, seconds in found)


@contextmanager
def watched(folder: Path) -> Iterator[None]:
    """Run a watcher for each core; without real-time priority it detects none."""
    paths = tuple(folder / f"{_NAME}{core}" for core in sorted(os.sched_getaffinity(0)))
    with ExitStack() as undo:
        for path in paths:
            path.write_bytes(_COUNTS.pack(0, 0.0))
            command = [sys.executable, "-m", "tests.endurance.stalls", str(path)]
            watcher = undo.enter_context(subprocess.Popen(command, cwd=Path(__file__).parents[2]))
            undo.callback(watcher.kill)
        yield


def watch(path: Path) -> None:
    """Watch the core that the name of the file ends with, until the parent ends."""
    os.sched_setaffinity(0, {int(path.name.rpartition("_")[2])})
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return  # it would wait for other processes, and take that for a stall
    parent, count, stood = os.getppid(), 0, 0.0
    with path.open("r+b", buffering=0) as file:
        due = time.monotonic()
        while os.getppid() == parent:
            due += PERIOD
            time.sleep(max(0.0, due - time.monotonic()))
            late = time.monotonic() - due
            if late > PERIOD:
                count, stood, due = count + 1, stood + late, due + late
                os.pwrite(file.fileno(), _COUNTS.pack(count, stood), 0)


if __name__ == "__main__":
    watch(Path(sys.argv[1]))
