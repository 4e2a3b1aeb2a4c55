"""Time, memory and disk of a batch: from archives to estimates, and from cached factors.

Run with ``python -m benchmarks.batch FOLDER... [--workers N] [--json]`` on folders of archives, or
with ``python -m benchmarks.batch --archives 1000 [--seconds 12] [--json]`` on archives made for it:
campaigns of 25 repetitions at 1 kHz with 6 joints, each with a noise of its own, so that no two
hold the same. They lie in a temporary folder (0.45 MB per second of motion) and are deleted, unless
``--folder`` names a folder for them, where those that are there are used. A hundred, four hundred,
a thousand and all of them are run, each in a process of its own, whose memory is then that of so
many. ``--archives 4000 --seconds 2`` shows how memory and time grow.

The first run begins with an empty cache, the second estimates from the cache of the first. Wall
times are those of the machine as it is; the processor time, of this process and its children, does
not depend on what else runs.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from benchmarks import parser_of, show
from benchmarks.archive_files import PERIOD, repetitions
from hil.base.progress import Silent
from hil.batch.cache import CacheLocation
from hil.batch.cluster import Cluster
from hil.batch.graph import BatchResult, reidentify
from hil.pipeline.options import FIXED

_CAMPAIGN = 25  # repetitions


class InThisProcess(Cluster):
    """A thread of this process, however many archives there are: what the work itself takes."""

    def client(self, archives: int) -> Any:
        """Return the client for few archives."""
        del archives
        return super().client(1)


def archives_to_estimate(paths: Sequence[Path]) -> float:
    """Processor time from archives to an estimate with covariance, one thread [s].

    With finding, hashing, decoding, smoothing, factors, the estimates of each repetition and of
    all, and writing the cache.
    """
    with tempfile.TemporaryDirectory() as cache:
        start = time.process_time()
        with InThisProcess() as cluster:
            result = _run([str(path) for path in paths], Path(cache), "wls", cluster)
        end = time.process_time()
    if result.broken or result.pooled[0].repetitions != len(paths):
        raise SystemExit(f"the archives were not all fitted: {result.broken}")
    return end - start


def measure(places: Sequence[str], workers: int | None) -> dict[str, Any]:
    """A first and a second run on some folders."""
    with tempfile.TemporaryDirectory() as cache:
        with Cluster(workers) as cluster:
            first, first_wall, first_own = _timed(places, Path(cache), "wls", cluster)
        first_cpu = first_own + _children()
        with Cluster() as cluster:  # nothing is read, so that it starts no process
            second, second_wall, second_own = _timed(places, Path(cache), "wls", cluster)
        second_cpu = first_own + second_own + _children() - first_cpu
        cached = sum(path.stat().st_size for path in Path(cache).rglob("*") if path.is_file())
    count = first.read
    if not count or second.read or first.broken:
        raise SystemExit(
            f"read {first.read} archives, then {second.read} again; broken: {first.broken[:3]}"
        )
    return {
        "archives": count,
        "campaigns": len(first.campaigns),
        "workers": workers or len(os.sched_getaffinity(0)),
        "first_wall_s": round(first_wall, 2),
        "first_wall_ms_per_archive": round(first_wall / count * 1e3, 2),
        "first_processor_ms_per_archive": round(first_cpu / count * 1e3, 2),
        "first_parent_ms_per_archive": round(first_own / count * 1e3, 3),
        "second_wall_s": round(second_wall, 2),
        "second_wall_ms_per_archive": round(second_wall / count * 1e3, 3),
        "second_processor_ms_per_archive": round(second_cpu / count * 1e3, 3),
        "cached_ratio_wall": round(first_wall / second_wall, 1),
        "cached_ratio_processor": round(first_cpu / second_cpu, 1),
        "kept_kB_per_archive": round(cached / count / 1e3, 1),
        "largest_parent_MB": round(_largest_own(), 1),
        "largest_child_MB": round(_largest(resource.RUSAGE_CHILDREN), 1),
        "load": round(os.getloadavg()[0], 1),
    }


def measure_made(
    archives: int, seconds: float, workers: int | None, folder: Path | None
) -> dict[str, Any]:
    """Make archives, and measure on a hundred, four hundred and all of them."""
    with tempfile.TemporaryDirectory(prefix="hil-benchmark-") as temporary:
        root = folder or Path(temporary)
        campaigns = _make(root, archives, seconds)
        size = sum(
            path.stat().st_size for campaign in campaigns for path in campaign.glob("*.mcap")
        )
        counts = sorted({count for count in (100, 400, 1000, archives) if count <= archives})
        steps = [_measured(campaigns[: -(-count // _CAMPAIGN)], workers) for count in counts]
    return steps[-1] | {
        "seconds_per_archive": seconds,
        "archive_MB": round(size / archives / 1e6, 2),
        "parent_MB": {str(step["archives"]): step["largest_parent_MB"] for step in steps},
        "steps": steps,
    }


def _make(root: Path, archives: int, seconds: float) -> list[Path]:
    """Folders of campaigns, a week apart."""
    begin = datetime(2026, 1, 5, 8, tzinfo=UTC)
    folders = []
    for number, first in enumerate(range(0, archives, _CAMPAIGN)):
        folders.append(root / f"campaign_{number:03d}" / "archives")
        repetitions(
            folders[-1],
            min(_CAMPAIGN, archives - first),
            first=first,
            cycles=round(seconds / PERIOD),
            recorded_at=(begin + number * timedelta(weeks=1)).isoformat(),
        )
    return folders


def _measured(campaigns: Sequence[Path], workers: int | None) -> dict[str, Any]:
    """`measure` in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.batch", "--json", *map(str, campaigns)]
    command += [] if workers is None else ["--workers", str(workers)]
    ran = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    figures: dict[str, Any] = json.loads(ran.stdout)
    return figures


def _run(places: Sequence[str], cache: Path, estimator: Any, cluster: Cluster) -> BatchResult:
    options = replace(FIXED, estimator=estimator)
    location = CacheLocation(str(cache))
    return reidentify(places, options, cluster, Silent(), cache=location)


def _timed(
    places: Sequence[str], cache: Path, estimator: Any, cluster: Cluster
) -> tuple[BatchResult, float, float]:
    wall = time.perf_counter()
    cpu = time.process_time()
    result = _run(places, cache, estimator, cluster)
    return result, time.perf_counter() - wall, time.process_time() - cpu


def _children() -> float:
    """Processor time of all children that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _largest(who: int) -> float:
    return resource.getrusage(who).ru_maxrss / 1024


def _largest_own() -> float:
    """Largest memory of this process [MB]; `getrusage` would count that of its parent as well."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def main() -> None:
    """Measure, and print the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("places", nargs="*", help="folders with archives anywhere below")
    parser.add_argument("--archives", type=int, default=0, help="make so many instead")
    parser.add_argument("--seconds", type=float, default=12.0, help="duration of each, at most 16")
    parser.add_argument("--folder", type=Path, default=None, help="to keep those made")
    parser.add_argument("--workers", type=int, default=None, help="child processes")
    arguments = parser.parse_args()
    if bool(arguments.places) == bool(arguments.archives):
        parser.error("name folders, or give --archives")
    if arguments.archives:
        result = measure_made(
            arguments.archives, arguments.seconds, arguments.workers, arguments.folder
        )
    else:
        result = measure(arguments.places, arguments.workers)
    show(result, only_json=arguments.json)


if __name__ == "__main__":
    main()
