"""What it costs to watch a fleet: processor time, memory, a new month, and a Dask scheduler.

Run with ``python -m benchmarks.fleet_logs [--robots N] [--months N] [--rate HZ]``: a log of 30 s of
each robot in every month, read by `hil trend` for the first time, again, and with one month more;
then the same logs by the workers of a scheduler, with a cache of their own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from benchmarks.fleet import Fleet, FleetPlan, urdf, write_fleet

_PORT: Final = 18786


_MAIN_PROCESS: Final = """
import sys
from pathlib import Path
from hil.__main__ import main
try:
    main()
finally:
    lines = Path("/proc/self/status").read_text().splitlines()
    sys.stderr.write(next(line for line in lines if line.startswith("VmHWM")).split()[1])
"""


@dataclass(frozen=True)
class Cost:
    """Of one command: seconds, of all its processes, and megabytes of the main process."""

    wall: float
    processor: float
    memory: float
    printed: dict[str, Any]


def asked(logs: Path, *options: str) -> Cost:
    """Run `hil trend` on logs in a process of its own, with the processes that it starts."""
    command = [sys.executable, "-c", _MAIN_PROCESS, "trend", str(logs), "--urdf", str(urdf())]
    command += ["--robot", "{robot}/{date}.csv", "--json", *options]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started = time.perf_counter()
    ran = subprocess.run(command, check=True, capture_output=True, text=True)
    wall = time.perf_counter() - started
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    peak = float(ran.stderr.split()[-1]) / 1024.0
    return Cost(wall, processor, peak, json.loads(ran.stdout))


@contextmanager
def scheduler() -> Iterator[str]:
    """Start a scheduler with two workers on this PC, and provide its address."""
    address = f"tcp://127.0.0.1:{_PORT}"
    dask = [sys.executable, "-m", "distributed.cli"]
    started = [
        [*dask[:-1], "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(_PORT)],
        [*dask[:-1], "distributed.cli.dask_worker", address, "--nworkers", "2", "--nthreads", "1"],
    ]
    processes = []
    try:
        for command in started:
            quiet = subprocess.DEVNULL
            processes.append(subprocess.Popen(command, stdout=quiet, stderr=quiet))
            time.sleep(8.0)
        yield address
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


def _shown(title: str, cost: Cost, logs: int) -> None:
    print(
        f"{title}: {cost.processor:.0f} s of processor time, {cost.processor / logs:.2f} s a log;"
        f" {cost.wall:.0f} s wall; main process {cost.memory:.0f} MB",
        flush=True,
    )


def main() -> None:
    """Print the costs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--months", type=int, default=5)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--rate", type=float, default=100.0, help="of the logs [Hz]")
    options = parser.parse_args()
    months, robots = options.months, options.robots
    fleet = Fleet(FleetPlan(robots=robots, months=months + 1, rate=options.rate))
    with TemporaryDirectory() as folder:
        logs = Path(folder) / "logs"
        write_fleet(logs, fleet, months=range(months))
        time.sleep(2.5)  # a log written a moment ago is read again
        count = robots * months
        _shown(f"{count} logs, first time", asked(logs), count)
        _shown(f"{count} logs, again", asked(logs), count)
        write_fleet(logs, fleet, months=[months])
        time.sleep(2.5)
        local = asked(logs)
        _shown(f"one month of {robots} robots more", local, robots)
        with scheduler() as address:
            cache = str(Path(folder) / "cache")
            remote = asked(logs, "--scheduler", address, "--cache", cache)
        same = remote.printed["robots"] == local.printed["robots"]
        print(f"by a scheduler's workers the same result to the bit: {same}")


if __name__ == "__main__":
    main()
