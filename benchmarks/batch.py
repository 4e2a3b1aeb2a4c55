"""Time, memory and disk of a batch: from archives to estimates, and from what was kept of them.

Run with ``python -m benchmarks.batch FOLDER [--workers N] [--json]`` on a folder of archives. Those
of `benchmarks.archive --folder FOLDER` are 30 repetitions of 16 s at 1 kHz with 6 joints.

The first run keeps nothing beforehand, the second one estimates otherwise from what the first has
kept. Wall times are those of the machine as it is; the processor time, of this process and its
children, does not depend on what else runs.
"""

# ruff: noqa: E402 - threads are pinned before numpy is imported, or BLAS does not see it

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from hil.batch.local import LocalWorkers
from hil.batch.on_workers import ArchiveTask, Summed, run_task
from hil.batch.run import Plan, reidentify
from hil.batch.types import BatchResult
from hil.batch.workers import Workers, summed
from hil.progress import Silent

T = TypeVar("T")
S = TypeVar("S")


class InThisProcess(Workers):
    """One core and no child: what the work itself takes."""

    near = True

    def sums(
        self,
        groups: Sequence[Sequence[ArchiveTask[T, S]]],
        add: Callable[[T, T], T],
        *,
        done: Callable[[int], None] | None = None,
    ) -> list[Summed[T, S]]:
        """See `hil.batch.workers.Workers`."""
        del done
        return [summed([run_task(task) for task in group], add) for group in groups]


def archives_to_estimate(paths: Sequence[Path]) -> float:
    """Processor time from archives to an estimate with covariance, one thread [s].

    With finding, hashing, decoding, smoothing, factors, the estimates of each repetition and of
    all, and writing what is kept of them.
    """
    with tempfile.TemporaryDirectory() as cache:
        start = time.process_time()
        found = _run([str(path) for path in paths], Path(cache), "wls", InThisProcess())
        end = time.process_time()
    if found.broken or found.pooled[0].repetitions != len(paths):
        raise SystemExit(f"the archives were not all fitted: {found.broken}")
    return end - start


def measure(folder: Path, workers: int | None) -> dict[str, Any]:
    """A first and a second run on a folder."""
    with tempfile.TemporaryDirectory() as cache, LocalWorkers(workers) as hands:
        first, first_wall, first_cpu = _timed([str(folder)], Path(cache), "wls", hands)
        hands.close()
        first_cpu += _children()
        second, second_wall, second_cpu = _timed([str(folder)], Path(cache), "ols", hands)
        kept = sum(path.stat().st_size for path in Path(cache).rglob("*") if path.is_file())
    count = first.read
    if not count or second.read:
        raise SystemExit(f"read {first.read} archives, and then {second.read} again")
    return {
        "archives": count,
        "workers": hands.count,
        "first_wall_ms_per_archive": round(first_wall / count * 1e3, 2),
        "first_processor_ms_per_archive": round(first_cpu / count * 1e3, 2),
        "second_wall_ms_per_archive": round(second_wall / count * 1e3, 3),
        "second_processor_ms_per_archive": round(second_cpu / count * 1e3, 3),
        "cached_ratio_wall": round(first_wall / second_wall, 1),
        "cached_ratio_processor": round(first_cpu / second_cpu, 1),
        "kept_kB_per_archive": round(kept / count / 1e3, 1),
        "largest_parent_MB": round(_largest(resource.RUSAGE_SELF), 1),
        "largest_child_MB": round(_largest(resource.RUSAGE_CHILDREN), 1),
        "load": round(os.getloadavg()[0], 1),
    }


def _run(places: Sequence[str], cache: Path, estimator: Any, workers: Workers) -> BatchResult:
    return reidentify(places, Plan(estimator, cache=cache), workers, Silent())


def _timed(
    places: Sequence[str], cache: Path, estimator: Any, workers: Workers
) -> tuple[BatchResult, float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    found = _run(places, cache, estimator, workers)
    return found, time.perf_counter() - wall, time.process_time() - cpu


def _children() -> float:
    """Processor time of all children that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _largest(who: int) -> float:
    return resource.getrusage(who).ru_maxrss / 1024


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, help="with archives anywhere below")
    parser.add_argument("--workers", type=int, default=None, help="child processes")
    parser.add_argument("--json", action="store_true", help="print one line of JSON only")
    arguments = parser.parse_args()
    result = measure(arguments.folder, arguments.workers)
    if not arguments.json:
        for name, value in result.items():
            print(f"  {name:32} {value}")
    print(json.dumps(result))


if __name__ == "__main__":
    main()
