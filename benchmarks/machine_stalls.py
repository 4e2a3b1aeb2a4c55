"""Stalls of the machine itself: what a process sees that does nothing but wake on time.

One process per processor, with a real-time priority above all others, sleeps to deadlines and notes
when it wakes late. Nothing of a measured program can delay it, so that what delays it is the kernel
or, below it, the host of a virtual machine.

    python -m benchmarks.machine_stalls [--minutes N] [--json]

Alone, it measures how often this machine stalls with nothing to do. A stall counts from
`LEAST_STALL` on; `stalls_of_all` are those at the same time on every processor.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show
from drivers.exchange.realtime import RealTimeSettings, enter

Array = NDArray[np.float64]
Stalls = Mapping[int, Array]
"""Of each processor, (k, 2) s on CLOCK_MONOTONIC: the deadline, and the end of the sleep to it."""

PRIORITY: Final = 80
DEADLINE_PERIOD: Final = 5e-4
"""Between two deadlines, s: the beginning of a stall is missed by at most so much."""
LEAST_STALL: Final = 3e-4
"""Of a late wake-up that is noted, s."""
_spawn = multiprocessing.get_context("spawn")


def watch(supervisor: int, processor: int, file: str) -> None:
    """Note stalls of a processor in `file`, until there is one of that name ending in `.end`."""
    enter(RealTimeSettings(priority=PRIORITY, cpu=processor))
    done = Path(file).with_suffix(".end")
    Path(file).with_suffix(".begun").touch()
    stalls = []
    deadline = time.monotonic()
    look = deadline
    while True:
        deadline += DEADLINE_PERIOD
        now = time.monotonic()
        if now < deadline:
            time.sleep(deadline - now)
            now = time.monotonic()
        if now - deadline > LEAST_STALL:
            stalls.append((deadline, now))
            deadline = now
        if now > look:
            look = now + 0.5
            if done.exists() or os.getppid() != supervisor:
                break
    np.save(file, np.array(stalls).reshape(-1, 2))


@contextmanager
def watched(folder: Path) -> Iterator[dict[int, Array]]:
    """Watch every processor in this block, from its beginning; the stalls are there after it."""
    found: dict[int, Array] = {}
    files = {cpu: folder / f"stalls_{cpu}.npy" for cpu in os.sched_getaffinity(0)}
    watches = [
        _spawn.Process(target=watch, args=(os.getpid(), cpu, str(file)), daemon=True)
        for cpu, file in files.items()
    ]
    for process in watches:
        process.start()
    try:
        begun = [file.with_suffix(".begun") for file in files.values()]
        while not all(each.exists() for each in begun):
            if not all(process.is_alive() for process in watches):
                raise RuntimeError("a process that watches a processor did not begin")
            time.sleep(0.05)
        yield found
        for file in files.values():
            file.with_suffix(".end").touch()
        for process in watches:
            process.join()
        found |= {cpu: np.load(file) for cpu, file in files.items()}
    finally:
        for process in watches:
            process.kill()


def merged(stalls: Stalls) -> Array:
    """Return the stalls (k, 2) of any processor, in order, overlapping ones as one."""
    intervals = np.concatenate([np.empty((0, 2)), *stalls.values()])
    union: list[list[float]] = []
    for begin, end in intervals[np.argsort(intervals[:, 0])]:
        if union and begin <= union[-1][1]:
            union[-1][1] = max(union[-1][1], end)
        else:
            union.append([begin, end])
    return np.array(union).reshape(-1, 2)


def stalled_within(union: Array, begins: Array, ends: Array) -> Array:
    """Return the seconds (n,) of intervals, from `begins` (n,) to `ends` (n,), that were stalls.

    `union` are the stalls (k, 2), by `merged`.
    """
    overlap = np.minimum(ends[:, None], union[:, 1]) - np.maximum(begins[:, None], union[:, 0])
    seconds: Array = np.clip(overlap, 0.0, None).sum(axis=1)
    return seconds


def figures(stalls: Stalls, period: float) -> dict[str, Any]:
    """Return counts of stalls, and of those that last more than a period, by processor."""
    lengths = {cpu: found[:, 1] - found[:, 0] for cpu, found in stalls.items()}
    result: dict[str, Any] = {}
    for cpu, seconds in sorted(lengths.items()):
        result[f"stalls_of_{cpu}"] = len(seconds)
        result[f"stalls_of_{cpu}_above_a_cycle"] = int((seconds > period).sum())
        result[f"stalls_of_{cpu}_longest_ms"] = round(1e3 * float(seconds.max(initial=0.0)), 2)
    result["stalls_of_all"] = int(_at_once(stalls))
    return result


def _at_once(stalls: Stalls) -> int:
    """Return the number of stalls of one processor that every other shares."""
    first, *others = stalls.values()
    shared = np.ones(len(first), bool)
    for other in others:
        shared &= stalled_within(merged({0: other}), first[:, 0], first[:, 1]) > 0.0
    return int(shared.sum())


def main() -> None:
    """Watch, and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, watched(Path(folder)) as stalls:
        time.sleep(60.0 * options.minutes)
    show(figures(stalls, 0.002), only_json=options.json)


if __name__ == "__main__":
    main()
