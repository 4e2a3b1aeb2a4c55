"""Batches on Dask: processes that end, schedulers and workers by hand, archives at URLs."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from unittest.mock import Mock

import fsspec
import pytest
from typer.testing import CliRunner

import hil
from hil.base.errors import InputError
from hil.base.progress import Messages, Silent
from hil.batch import cluster as cluster_module
from hil.batch import graph as batch_run
from hil.batch import places
from hil.batch.cache import CacheLocation
from hil.batch.cluster import Cluster, ClusterError
from hil.batch.graph import reidentify
from hil.cli import app
from hil.pipeline.options import FIXED
from tests.hil import batch_work as work
from tests.hil.batch_work import NOTHING_OPEN, HandMade, Here

pytestmark = pytest.mark.long

UNCACHED = CacheLocation(keep=False)
HELD = "validation_001_a1.mcap"


def batch(*places, cluster=None, cache=UNCACHED):
    options = replace(FIXED, estimator="wls")
    return reidentify(list(map(str, places)), options, cluster or Here(), Silent(), cache=cache)


def bits(result):
    levels = (*result.repetitions, *result.campaigns, *result.pooled)
    return [level.estimate.values.tobytes() + level.estimate.std.tobytes() for level in levels]


@pytest.fixture(scope="module")
def folder(campaign, tmp_path_factory):
    """A copy of the campaign without caches."""
    copy = tmp_path_factory.mktemp("cluster") / "campaign"
    shutil.copytree(campaign.folder.root, copy, ignore=shutil.ignore_patterns(".hil-cache"))
    return copy


@pytest.fixture(scope="module")
def expected(folder):
    """The result of one process."""
    return batch(folder)


@pytest.mark.slow
def test_tasks_that_fail_or_end_their_process_affect_no_other():
    tasks = [work.task(work.number, k) for k in range(8)]
    tasks[2], tasks[4] = work.task(work.crash, 2), work.task(work.absent, 4)
    tasks[7] = work.task(work.faulty, 7)
    done = []
    with Cluster(2) as cluster:
        results = cluster.results(tasks, done.append)
    assert sum(done) == 8
    assert [results[k] for k in (0, 1, 3, 5, 6)] == [0, 1, 3, 5, 6]
    work.check_unused(results[2], "crash-2.mcap", "crashed the process that read it, twice")
    work.check_unused(results[4], "absent-4.mcap", "No such file")
    work.check_unused(results[7], "faulty-7.mcap", "IndexError")


def test_what_is_piped_is_the_result(capfd):
    """Workers and their dashboard are progress: on standard error, if they take a second."""
    with Cluster(1, reporter=Messages()) as cluster:
        assert cluster.results([work.task(work.number, 3)]) == [3]
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize(
    "error", [RuntimeError("ConnectionPool is closed"), OSError("closed"), CancelledError("key")]
)
def test_a_result_that_is_lost_with_its_scheduler_is_reported(error):
    """It is done, and not fetched yet."""
    future = Mock(result=Mock(side_effect=error))
    with pytest.raises(ClusterError, match=r"tcp://x:1 does not answer any more.*in the cache"):
        Cluster(scheduler="tcp://x:1").outcome_of(future)


class Background:
    """A batch in a thread; what it returns or raises."""

    def __init__(self, *arguments, **options):
        self.result = None
        self.error = None
        self.thread = threading.Thread(target=self.run, args=arguments, kwargs=options)
        self.thread.start()

    def run(self, *arguments, **options):
        try:
            self.result = batch(*arguments, **options)
        except Exception as error:
            self.error = error

    def join(self):
        self.thread.join(240.0)
        assert not self.thread.is_alive()
        if self.error is not None:
            raise self.error
        return self.result


def wait_for_factors(folder, count):
    """Wait until factors are cached: those with an array of samples."""
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline:
        if sum(path.stat().st_size > 100_000 for path in folder.rglob("*.npz")) >= count:
            return
        time.sleep(0.02)
    raise AssertionError("no factor was cached")


class TestSchedulersByHand:
    """A scheduler and two workers in processes of their own, as on other machines."""

    @pytest.mark.slow
    def test_killed_workers_change_no_bit(self, folder, expected, tmp_path, monkeypatch):
        """One while it works; then all of them, until another one starts."""
        monkeypatch.setattr(batch_run, "ARCHIVES_PER_TASK", 1)
        cache = CacheLocation(str(tmp_path))
        go = tmp_path / "go"
        with HandMade() as processes, Cluster(scheduler=processes.address) as cluster:
            cluster.client(5).register_plugin(work.Held(HELD, go))
            running = Background(folder, cluster=cluster, cache=cache)
            wait_for_factors(tmp_path, 1)
            for worker in processes.workers:
                worker.kill()
            go.touch()
            processes.add_worker()
            result = running.join()
        assert bits(result) == bits(expected)
        assert (result.broken, result.read + result.cached) == ((), 5)

    @pytest.mark.slow
    def test_a_killed_scheduler_is_reported_and_its_work_is_cached(
        self, folder, expected, tmp_path, monkeypatch
    ):
        monkeypatch.setattr(batch_run, "ARCHIVES_PER_TASK", 1)
        cache = CacheLocation(str(tmp_path))
        with HandMade() as processes, Cluster(scheduler=processes.address) as cluster:
            cluster.client(5).register_plugin(work.Held(HELD, tmp_path / "never"))
            running = Background(folder, cluster=cluster, cache=cache)
            wait_for_factors(tmp_path, 1)
            processes.scheduler.kill()
            with pytest.raises(ClusterError, match=r"does not answer any more.*in the cache"):
                running.join()
        again = batch(folder, cache=cache)
        assert bits(again) == bits(expected)
        assert again.cached > 0

    @pytest.mark.slow
    def test_without_workers_is_reported(self, folder, monkeypatch):
        monkeypatch.setattr(cluster_module, "WORKER_TIMEOUT", 1.0)
        with (
            HandMade(workers=0) as processes,
            pytest.raises(ClusterError, match=r"has no worker.*dask worker tcp://"),
            Cluster(scheduler=processes.address) as cluster,
        ):
            batch(folder, cluster=cluster)

    @pytest.mark.slow
    def test_with_workers_of_another_version_is_refused(self, folder, tmp_path):
        """Their numbers would differ."""
        source = Path(hil.__file__).parent
        shutil.copytree(source, tmp_path / "hil", ignore=shutil.ignore_patterns("__pycache__"))
        with (tmp_path / "hil" / "base" / "version.py").open("a") as file:
            file.write("\n# another version\n")
        path = os.pathsep.join([str(tmp_path), str(source.parent)])
        with HandMade(workers=1) as processes:
            processes.add_worker(PYTHONPATH=path)
            with (
                Cluster(scheduler=processes.address) as cluster,
                pytest.raises(ClusterError, match=r"has another version of hil.*install the same"),
            ):
                batch(folder, cluster=cluster)

    @pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "127.0.0.1:1", "nonsense://x"])
    def test_nobody_at_the_address_is_refused(self, address, folder, monkeypatch):
        monkeypatch.setattr(cluster_module, "CONNECT_TIMEOUT", 0.5)
        command = ["batch", str(folder), "--scheduler", address, *NOTHING_OPEN]
        ran = CliRunner().invoke(app, command)
        assert isinstance(ran.exception, InputError)
        text = str(ran.exception)
        assert f"--scheduler: no Dask scheduler answers at {address}" in text
        assert "dask scheduler" in text

    def test_has_its_own_number_of_workers(self, folder):
        command = ["batch", str(folder), "--scheduler", "tcp://x:1", "--workers", "2"]
        error = CliRunner().invoke(app, command).exception
        assert isinstance(error, InputError)
        assert "omit --workers, or --scheduler" in str(error)


@pytest.fixture
def server(folder):
    """The URL of the folder at a local HTTP server."""
    handler = partial(SilentHandler, directory=str(folder.parent))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as http:
        thread = threading.Thread(target=http.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{http.server_address[1]}"
        http.shutdown()


class SilentHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


class TestUrls:
    def test_of_a_server_give_the_numbers_of_files(self, folder, server, expected, tmp_path):
        cache = CacheLocation(str(tmp_path))
        result = batch(f"{server}/{folder.name}", cache=cache)
        assert result.broken == ()
        assert bits(result) == bits(expected)
        assert {campaign.campaign for campaign in result.campaigns} == {f"{server}/{folder.name}"}
        assert result.repetitions[0].archive.startswith(server)
        again = batch(f"{server}/{folder.name}", cache=cache)
        assert (again.read, again.cached) == (0, 5)

    def test_in_memory_give_the_numbers_of_files(self, folder, expected):
        memory = fsspec.filesystem("memory")
        memory.put(str(folder), "/line", recursive=True)
        try:
            result = batch("memory://line")
            assert bits(result) == bits(expected)
            single = batch("memory://line/archives/excitation_000_a1.mcap")
            assert len(single.repetitions) == 1
        finally:
            memory.rm("/line", recursive=True)

    def test_of_damaged_archives_name_the_url(self, folder, expected):
        memory = fsspec.filesystem("memory")
        memory.put(str(folder), "/line", recursive=True)
        name = "/line/archives/excitation_001_a1.mcap"
        memory.pipe(name, memory.cat(name)[:-3000])
        memory.rm("/line/manifest.json")
        try:
            (unused,) = batch("memory://line").broken
        finally:
            memory.rm("/line", recursive=True)
        assert unused.path == f"memory://{name}"
        assert "repair it where it is stored" in unused.reason
        assert "/tmp" not in unused.reason

    def test_of_a_listing_stay_below_its_address(self, monkeypatch):
        """Whatever a server lists: a chained protocol would read files of this PC."""
        inside = "memory:///line/a.mcap"
        hostile = ["memory:///line/zip::file:///etc/b.mcap", "memory:///line/../c.mcap"]
        listed = [inside, *hostile, "memory:///other/d.mcap", "memory:///line/e.txt"]
        memory = fsspec.filesystem("memory")
        monkeypatch.setattr(type(memory), "find", lambda *_, **__: listed)
        monkeypatch.setattr(type(memory), "unstrip_protocol", lambda _, place: place)
        monkeypatch.setattr(type(memory), "_strip_protocol", lambda place: place)
        assert places.archives_at("memory:///line") == [inside]

    @pytest.mark.parametrize(
        ("place", "why"),
        [
            ("{server}/nowhere", r"nowhere: the server answers 404"),
            ("{server}/nothing.mcap", r"nothing.mcap: the server answers 404"),
            ("http://127.0.0.1:1/line", r"127.0.0.1:1/line: cannot be read: .*[Cc]onnect"),
            ("memory://nowhere", "memory://nowhere: does not exist"),
            ("nonsense://line", r"cannot be opened .*give a folder, or a URL"),
            ("s3://line", r"s3://line: cannot be opened .*[Ii]nstall"),
        ],
    )
    def test_that_cannot_be_read_are_refused(self, place, why, server):
        with pytest.raises(InputError, match=why):
            batch(place.format(server=server))


def alive(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_interrupts_end_the_command_and_its_workers(folder, tmp_path):
    """By Ctrl-C, which all processes of the terminal receive, amid work for many seconds."""
    copies = [shutil.copytree(folder, tmp_path / f"campaign-{k}") for k in range(20)]
    cache = tmp_path / "cache"
    command = [sys.executable, "-m", "hil", "batch", *map(str, copies), "--workers", "2"]
    process = subprocess.Popen(
        [*command, "--cache", str(cache)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120.0
    while not [*cache.rglob("*.npz")] and time.monotonic() < deadline:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=120.0)
    assert process.returncode == 130
    assert errors.strip() == "stopped: interrupted"
    deadline = time.monotonic() + 60.0
    while alive(process.pid):
        assert time.monotonic() < deadline
        time.sleep(0.05)
