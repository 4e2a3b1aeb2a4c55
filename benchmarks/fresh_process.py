"""Processor time and memory of a command in a process of its own.

Run with ``python -m benchmarks.fresh_process COMMAND ...``: the command runs with its output stored
back, and a line of JSON has its status, what it wrote as errors, processor time and peak memory,
those of its children included.

`usage` measures by such a process, with all modules compiled, as they are where a package is
installed: compiling takes about a second, which a program spends once. On Linux the peak of a
process begins with that of the process that started it, so the one in between has to be small.
"""

from __future__ import annotations

import compileall
import json
import resource
import subprocess
import sys
from collections.abc import Collection, Sequence
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

ROOT: Final = Path(__file__).resolve().parents[1]
_PACKAGES: Final = ("benchmarks", "drivers", "hil", "identification", "planner", "sim_fixtures")


class Usage(NamedTuple):
    """What a command took: user and system time [s], largest resident memory [MB]."""

    seconds: float
    peak_mb: float


def usage(command: Sequence[str], *, accepted: Collection[int] = (0,)) -> Usage:
    """Run a command in the folder of the project; the largest of several processes is its memory.

    Raises:
        SystemExit: it ended with a status that is not `accepted`.
    """
    _compile()
    launcher = [sys.executable, "-m", "benchmarks.fresh_process", *command]
    done = subprocess.run(launcher, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    figures = json.loads(done.stdout)
    if figures["status"] not in accepted:
        shown = f"{' '.join(command)} ended with status {figures['status']}"
        raise SystemExit(f"{figures['errors']}{shown}")
    return Usage(figures["seconds"], figures["peak_mb"])


@cache
def _compile() -> None:
    """Compile what has changed in the packages of the project."""
    for package in _PACKAGES:
        compileall.compile_dir(ROOT / package, quiet=1)


def main() -> None:
    """Run the command of the command line, and print what it took."""
    done = subprocess.run(
        sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False
    )
    taken = resource.getrusage(resource.RUSAGE_CHILDREN)
    unit = 1.0 if sys.platform == "darwin" else 1024.0  # bytes of `ru_maxrss`
    figures = {
        "status": done.returncode,
        "errors": done.stderr,
        "seconds": taken.ru_utime + taken.ru_stime,
        "peak_mb": taken.ru_maxrss * unit / 1e6,
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
