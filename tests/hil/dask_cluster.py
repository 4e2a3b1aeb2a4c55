"""A Dask cluster of processes: a scheduler and workers, as a person would start them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
_LOCAL = ("--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", "scheduler.json")
_PATIENCE = 60.0  # s


class Cluster:
    """Processes of one cluster; they end with the `running` that made them."""

    def __init__(self, folder: Path, **environment: str) -> None:
        self._folder = folder
        self._environment = environment
        self.scheduler = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
        self.workers: list[subprocess.Popen[bytes]] = []
        description = folder / "scheduler.json"
        _wait_for(lambda: description.exists() and description.read_text().endswith("}"))
        self.address: str = json.loads(description.read_text())["address"]

    def add_worker(self, *options: str, **environment: str) -> subprocess.Popen[bytes]:
        arguments = (
            "--host",
            "127.0.0.1",
            "--nthreads",
            "1",
            "--no-dashboard",
            *(options or ("--no-nanny",)),
        )
        worker = self._start("worker", *arguments, **environment)
        self.workers.append(worker)
        return worker

    def forget_the_dead(self) -> None:
        """Keep the workers that run, in the order in which they were started."""
        self.workers = [worker for worker in self.workers if worker.poll() is None]

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


def _wait_for(condition) -> None:
    begun = time.monotonic()
    while not condition():
        if time.monotonic() - begun > _PATIENCE:
            raise TimeoutError
        time.sleep(0.05)
