"""Tasks and archives on the workers of a Dask cluster."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from hil.batch import cluster as dask_cluster
from hil.batch import run
from hil.batch.cache import CacheLocation
from hil.batch.cluster import (
    ClusterError,
    DaskWorkers,
    WorkerSoftwareError,
)
from hil.batch.types import Unused
from hil.batch.workers import LocalWorkers, Workers
from hil.campaign import Campaign
from hil.errors import InputError
from hil.identify.options import FIXED
from hil.progress import Silent
from hil.version import install_command
from tests.hil import batch_work as work

_ROOT = Path(__file__).resolve().parents[2]
_LOCAL = ("--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", "scheduler.json")
PATIENCE = 60.0  # s; the machine may be busy


class Cluster:
    """Processes of one cluster."""

    def __init__(self, folder: Path, **environment: str) -> None:
        self._folder = folder
        self._environment = environment
        self.scheduler = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
        self.workers: list[subprocess.Popen[bytes]] = []
        description = folder / "scheduler.json"
        wait_for(lambda: description.exists() and description.read_text().endswith("}"))
        self.address: str = json.loads(description.read_text())["address"]

    def add_worker(self, *options: str, **environment: str) -> subprocess.Popen[bytes]:
        here = ("--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard")
        worker = self._start("worker", *here, *(options or ("--no-nanny",)), **environment)
        self.workers.append(worker)
        return worker

    def _start(self, kind: str, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        log = (self._folder / f"{kind}-{time.monotonic_ns()}.log").open("wb")
        with log:
            return subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{kind}", *_LOCAL, *arguments],
                cwd=self._folder,
                env={
                    **os.environ,
                    "PYTHONPATH": str(_ROOT),
                    "DASK_DISTRIBUTED__DIAGNOSTICS__NVML": "false",
                    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false",
                    **self._environment,
                    **environment,
                },
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def close(self) -> None:
        for process in [*self.workers, self.scheduler]:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # a nanny with its worker
            process.wait()


@contextmanager
def running(folder: Path, *, workers: int = 0, **environment: str) -> Iterator[Cluster]:
    cluster = Cluster(folder, **environment)
    try:
        for _ in range(workers):
            cluster.add_worker()
        yield cluster
    finally:
        cluster.close()


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with running(tmp_path_factory.mktemp("dask"), workers=2) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def workers(cluster: Cluster) -> Iterator[DaskWorkers]:
    with connected(cluster, timeout=20.0) as workers:
        yield workers


@pytest.fixture
def pair(cluster: Cluster) -> Cluster:
    """The cluster with two running workers, the first of which may be killed."""
    cluster.workers = [worker for worker in cluster.workers if worker.poll() is None]
    while len(cluster.workers) < 2:
        cluster.add_worker()
    return cluster


def connected(cluster: Cluster, timeout: float = PATIENCE, patience: float = PATIENCE):
    return DaskWorkers(cluster.address, timeout=timeout, patience=patience)


def tasks_of(function: Any, count: int) -> list[Any]:
    return [work.task(function, k) for k in range(count)]


class TestResults:
    @pytest.mark.parametrize("count", [0, 1, 65])
    def test_come_in_order_and_are_reported_once(self, workers: DaskWorkers, count: int) -> None:
        finished: list[int] = []
        found = workers.results(tasks_of(work.number, count), finished.append)
        assert list(found) == list(range(count))
        assert sum(finished) == count

    def test_come_while_later_tasks_are_computed(self, workers: DaskWorkers) -> None:
        finished: list[int] = []
        found = workers.results(tasks_of(work.slow_number, 72), finished.append)
        assert next(found) == 0
        assert sum(finished) < 72
        assert list(found) == list(range(1, 72))

    def test_are_cancelled_on_close(self, tmp_path: Path, workers: DaskWorkers) -> None:
        found = workers.results([work.task(work.marked, str(tmp_path / f"{k}")) for k in range(99)])
        next(found)
        found.close()
        assert list(workers.results(tasks_of(work.number, 1))) == [0]
        assert len([*tmp_path.iterdir()]) < 50

    def test_of_failed_crashed_and_hung_tasks(self, cluster: Cluster) -> None:
        tasks = tasks_of(work.number, 20)
        errors = {
            3: (work.absent, "No such file"), 8: (work.crash, "signal 11"),
            9: (work.faulty, "IndexError"), 15: (work.hang, "longer than 2 s"),
        }  # fmt: skip
        for k, (function, _) in errors.items():
            tasks[k] = work.task(function, k)
        with connected(cluster, timeout=2.0) as workers:
            found = list(workers.results(tasks))
        for k, one in enumerate(found):
            if k in errors:
                assert one.path == tasks[k].path
                assert errors[k][1] in one.reason
            else:
                assert one == k
        assert all(worker.poll() is None for worker in cluster.workers)


def test_folders_must_exist_on_the_workers(workers: DaskWorkers, tmp_path: Path) -> None:
    workers.require_folders([tmp_path])
    with pytest.raises(ClusterError, match=r"does not see .*absent"):
        workers.require_folders([tmp_path, tmp_path / "absent"])


class TestWorkers:
    @pytest.mark.slow
    def test_killed_ones_are_replaced(self, pair: Cluster) -> None:
        finished: list[int] = []

        with connected(pair) as workers:
            assert list(workers.results(tasks_of(work.number, 1))) == [0]
            workers._client.wait_for_workers(2, timeout=PATIENCE)

            def done(count: int) -> None:
                finished.append(count)
                if len(finished) >= 20 and pair.workers[0].poll() is None:
                    pair.workers[0].kill()

            assert list(workers.results(tasks_of(work.slow_number, 80), done)) == list(range(80))
        assert pair.workers[0].wait(1.0) == -9
        assert pair.workers[1].poll() is None

    @pytest.mark.slow
    def test_killed_by_an_archive(self, tmp_path: Path) -> None:
        eager = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
        with running(tmp_path, **eager) as cluster:
            for _ in range(2):
                cluster.add_worker("--nanny", "--worker-port", "0")
            with connected(cluster) as workers:
                tasks = tasks_of(work.number, 12)
                tasks[5] = work.task(work.kill_worker, 5)
                found = list(workers.results(tasks))
        assert found[5] == Unused(tasks[5].path, "ended every worker that read it")
        assert found[:5] + found[6:] == [k for k in range(12) if k != 5]

    def test_with_other_code_are_refused(
        self, cluster: Cluster, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Whenever they join: their software is checked with each task."""
        monkeypatch.setattr(dask_cluster, "code_digest", lambda: "other code")
        message = r"other software .*hil \w+ instead of other code"
        with connected(cluster) as workers, pytest.raises(WorkerSoftwareError, match=message):
            list(workers.results(tasks_of(work.number, 1)))

    @pytest.mark.slow
    def test_loss_of_all_is_an_error(self, tmp_path: Path) -> None:
        with running(tmp_path, workers=1) as cluster:
            workers = connected(cluster, patience=5.0)
            with workers, pytest.raises(ClusterError, match=r"all workers .* disappeared"):
                for _ in workers.results(tasks_of(work.slow_number, 50)):
                    cluster.workers[0].kill()


def test_a_missing_scheduler_is_an_error_with_the_address() -> None:
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9"):
        DaskWorkers("tcp://127.0.0.1:9", patience=1.0)


def test_a_scheduler_without_workers_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A connection takes a second on a busy machine.
    connect = dask_cluster._connected
    monkeypatch.setattr(dask_cluster, "_connected", lambda at, _: connect(at, PATIENCE))
    with running(tmp_path) as cluster, pytest.raises(ClusterError, match="has no worker after"):
        connected(cluster, patience=1.0)


# Real archives


@pytest.mark.slow
def test_estimates_equal_those_of_local_workers(campaign: Campaign, cluster: Cluster) -> None:
    def figures(workers: Workers) -> list[bytes]:
        cache = CacheLocation(keep=False)
        found = run.reidentify([str(campaign.folder.root)], FIXED, workers, Silent(), cache=cache)
        assert not found.broken
        levels = [*found.repetitions, *found.campaigns, *found.pooled]
        return [one.values.tobytes() + one.std.tobytes() for one in levels]

    with LocalWorkers(1) as local, connected(cluster) as workers:
        assert figures(workers) == figures(local)


# The package


def test_without_dask_the_error_has_the_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_cluster, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=re.escape(install_command("cluster"))):
        DaskWorkers("tcp://127.0.0.1:9")
