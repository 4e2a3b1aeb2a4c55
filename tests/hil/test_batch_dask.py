"""Tasks and archives on the workers of a Dask cluster."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

import pytest

from hil.batch import run
from hil.batch import workers as batch_workers
from hil.batch.cache import CacheLocation
from hil.batch.workers import (
    ClusterError,
    DaskWorkers,
    LocalWorkers,
    WorkerSoftwareError,
)
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

    def __init__(self, folder, **environment):
        self._folder, self._environment = folder, environment
        self.processes: list[subprocess.Popen[bytes]] = []
        self.start("scheduler", "--port", "0")
        description = folder / "scheduler.json"
        wait_for(lambda: description.exists() and description.read_text().endswith("}"))
        self.address: str = json.loads(description.read_text())["address"]

    def start(self, kind, *arguments):
        with (self._folder / f"{kind}-{time.monotonic_ns()}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{kind}", *_LOCAL, *arguments],
                cwd=self._folder,
                env={
                    **os.environ,
                    "PYTHONPATH": str(_ROOT),
                    "DASK_DISTRIBUTED__DIAGNOSTICS__NVML": "false",
                    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false",
                    "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0",
                    **self._environment,
                },
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self.processes.append(process)

    def close(self):
        for process in reversed(self.processes):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # a nanny with its worker
            process.wait()


@contextmanager
def running(folder, *, workers=0, **environment):
    cluster = Cluster(folder, **environment)
    try:
        for _ in range(workers):
            cluster.start("worker", "--nthreads", "1", "--nanny", "--worker-port", "0")
        yield cluster
    finally:
        cluster.close()


def wait_for(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with running(tmp_path_factory.mktemp("dask"), workers=2) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def workers(cluster):
    with DaskWorkers(cluster.address, patience=PATIENCE) as workers:
        yield workers


def tasks_of(function, count):
    return [work.task(function, k) for k in range(count)]


class TestResults:
    @pytest.mark.parametrize("count", [0, 1, 65])
    def test_come_in_order_and_are_reported_once(self, workers, count):
        finished: list[int] = []
        found = workers.results(tasks_of(work.number, count), finished.append)
        assert list(found) == list(range(count))
        assert sum(finished) == count

    def test_are_cancelled_on_close(self, tmp_path, workers):
        found = workers.results([work.task(work.marked, str(tmp_path / f"{k}")) for k in range(99)])
        next(found)
        found.close()
        assert list(workers.results(tasks_of(work.number, 1))) == [0]
        assert len([*tmp_path.iterdir()]) < 50

    @pytest.mark.slow
    def test_of_failed_tasks_and_of_those_that_kill_their_worker(self, workers):
        tasks, failing = work.tasks_with_failures(20)
        work.check_failures(tasks, workers.results(tasks), failing)

    def test_with_other_code_are_refused(self, workers, monkeypatch):
        """Whenever a worker joins: its software is checked with each task."""
        monkeypatch.setattr(workers, "software", "hil 0123")
        with pytest.raises(WorkerSoftwareError, match=r"other software .* instead of hil 0123"):
            list(workers.results(tasks_of(work.number, 1)))

    @pytest.mark.slow
    def test_loss_of_the_scheduler_is_an_error(self, tmp_path):
        with running(tmp_path, workers=1, DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT="2s") as own:
            workers = DaskWorkers(own.address, patience=10.0)
            found = workers.results(
                [work.task(work.marked, str(tmp_path / f"{k}")) for k in (1, 2)]
            )
            next(found)
            own.close()
            with pytest.raises(ClusterError, match="in the cache"):
                list(found)
                list(workers.results(tasks_of(work.number, 1)))


def test_folders_must_exist_on_the_workers(workers, tmp_path):
    workers.require_folders([tmp_path])
    with pytest.raises(ClusterError, match=r"does not see .*absent"):
        workers.require_folders([tmp_path, tmp_path / "absent"])


@pytest.mark.slow
def test_estimates_equal_those_of_local_workers(campaign, workers):
    def figures(workers):
        cache = CacheLocation(keep=False)
        found = run.reidentify([str(campaign.folder.root)], FIXED, workers, Silent(), cache=cache)
        assert not found.broken
        levels = [*found.repetitions, *found.campaigns, *found.pooled]
        return [one.values.tobytes() + one.std.tobytes() for one in levels]

    with LocalWorkers(1) as local:
        assert figures(workers) == figures(local)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("workers", "message"),
    [(None, "no Dask scheduler answers at tcp://127.0.0.1:9"), (0, "has no worker after")],
)
def test_a_cluster_that_cannot_be_used_is_an_error(tmp_path, workers, message):
    with nullcontext() if workers is None else running(tmp_path) as own:
        address = "tcp://127.0.0.1:9" if own is None else own.address
        with pytest.raises((InputError, ClusterError), match=message):
            DaskWorkers(address, patience=1.0 if own is None else 5.0)


def test_without_dask_the_error_has_the_install_command(monkeypatch):
    monkeypatch.setattr(batch_workers, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=re.escape(install_command("cluster"))):
        DaskWorkers("tcp://127.0.0.1:9")
