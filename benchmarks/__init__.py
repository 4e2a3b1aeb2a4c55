"""Benchmarks: `python -m benchmarks.NAME [--json]`; each ends with one line of JSON.

BLAS gets one thread; this module is loaded before numpy, which reads the setting.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
from collections.abc import Callable, Mapping
from time import process_time
from typing import Any

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """Options of a benchmark, described by the first line of its module, with `--json`."""
    parser = argparse.ArgumentParser(description=(doc or "").split("\n", 1)[0])
    parser.add_argument("--json", action="store_true", help="print the line of JSON only")
    return parser


def show(result: Mapping[str, Any], *, only_json: bool) -> None:
    """Print figures, one a line, and the line of JSON."""
    if not only_json:
        for name, value in result.items():
            print(f"  {name:32} {value}")
    print(json.dumps(result))


def timed(function: Callable[[], object]) -> float:
    """Processor time of a call [s]: on a busy machine a wall clock times other programs, too."""
    start = process_time()
    function()
    return process_time() - start


def processor_time() -> float:
    """Return the processor time [s] of this process and of its children that have ended."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
