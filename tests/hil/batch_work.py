"""Clusters for tests: in this process, with archives and tasks that end theirs, and run by hand."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from distributed import WorkerPlugin

from hil.base.errors import ArchiveError
from hil.batch import archive_discovery
from hil.batch.cluster import Cluster, ClusterTask, SkippedArchive

NOTHING_OPEN: Final = (
    *("--bandwidth", "40", "--velocity", "position", "--friction", "coulomb,viscous"),
    *("--exclude-rows", "slow", "--delay", "stated", "--estimator", "wls"),
)
"""Options of `hil batch` that leave nothing to be chosen of a controller's archives."""


@cache
def _shared():
    return Cluster()


class Here(Cluster):
    """The cluster of few archives: a thread of this process, shared by tests for speed."""

    def client(self, archives):
        return _shared().client(1)


class Deadly(WorkerPlugin):
    """Ends the processes of workers that open archives of these names, also restarted ones."""

    name = "deadly archives"

    def __init__(self, *names):
        self.names = names

    def setup(self, worker):
        read = archive_discovery.open_archive

        def deadly(path, **how):
            if path.name in self.names and how["fields"]:
                os.kill(os.getpid(), signal.SIGSEGV)
            return read(path, **how)

        archive_discovery.open_archive = deadly


class Held(WorkerPlugin):
    """Workers wait at the archive of a name until a file exists, so that a batch cannot end."""

    name = "held archive"

    def __init__(self, archive, until):
        self.archive = archive
        self.until = until

    def setup(self, worker):
        read = archive_discovery.open_archive

        def held(path, **how):
            while path.name == self.archive and how["fields"] and not self.until.exists():
                time.sleep(0.02)
            return read(path, **how)

        archive_discovery.open_archive = held


class Process:
    """A process of Dask's own command line, started until its log says that it is ready."""

    def __init__(self, *arguments, ready, environment=()):
        with TemporaryDirectory() as folder:
            log = Path(folder, "log")
            with log.open("w") as file:
                self.process = subprocess.Popen(
                    [sys.executable, "-P", "-m", f"distributed.cli.{arguments[0]}", *arguments[1:]],
                    stderr=file,
                    env={**os.environ, "OMP_NUM_THREADS": "1", **dict(environment)},
                    start_new_session=True,
                )
            deadline = time.monotonic() + 60.0
            while (match := re.search(ready, log.read_text())) is None:
                assert self.process.poll() is None and time.monotonic() < deadline, log.read_text()
                time.sleep(0.05)
            self.ready = match[1]

    def kill(self):
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


class HandMade:
    """A scheduler and workers, each a process of its own, as on several machines."""

    def __init__(self, workers=2):
        self.open = ExitStack()
        self.scheduler = self.run("dask_scheduler", *_QUIET, ready=r"Scheduler at: +(tcp://\S+)")
        self.address = self.scheduler.ready
        self.workers = [self.add_worker() for _ in range(workers)]

    def add_worker(self, **environment):
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "30")
        return self.run(
            "dask_worker", self.address, *options, ready=r"(Registered to)", environment=environment
        )

    def run(self, *arguments, **how):
        process = Process(*arguments, **how)
        self.open.callback(process.kill)
        return process

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.open.close()


_QUIET: Final = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard")


def number(k):
    return k


def absent(k):
    raise ArchiveError(f"{k}.mcap", "cannot be read: No such file or directory")


def faulty(_):
    return [][0]


def crash(_):
    os.kill(os.getpid(), signal.SIGSEGV)


def task(function, argument):
    return ClusterTask(f"{function.__name__}-{argument}.mcap", function, (argument,))


def check_unused(result, name, reason):
    assert isinstance(result, SkippedArchive)
    assert (result.path, reason in result.reason) == (name, True), result
