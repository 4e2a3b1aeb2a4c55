"""Archives reduced and added up on the workers of a Dask cluster."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from hil.archive import container
from hil.batch import cluster as dask_cluster
from hil.batch import run
from hil.batch.cache import code_digest
from hil.batch.cluster import (
    ClusterError,
    DaskWorkers,
    WorkerSoftwareError,
    release_children,
    software,
    sum_archives,
)
from hil.batch.run import reduced
from hil.batch.types import BatchResult, Broken
from hil.batch.workers import (
    LocalWorkers,
    Summed,
    Workers,
    sum_tree,
)
from hil.campaign import Campaign
from hil.errors import InputError
from hil.identify.options import FIXED
from hil.progress import Silent
from hil.version import install_command
from tests.hil import batch_work as work
from tests.hil.dask_cluster import Cluster, running
from tests.hil.mcap_bytes import metadata
from tests.hil.web_folder import served

PATIENCE = 60.0  # s; the machine may be busy


def alone(seeds: Sequence[int]) -> bytes:
    """The sum of the work on `seeds`, computed here, to the bit."""
    total = sum_tree([work.numbers(seed).total for seed in seeds], work.add)
    assert total is not None
    return total.tobytes()


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
    """The cluster with two workers that live, the first of which may be killed."""
    cluster.forget_the_dead()
    while len(cluster.workers) < 2:
        cluster.add_worker()
    return cluster


def connected(cluster: Cluster, timeout: float = PATIENCE, patience: float = PATIENCE):
    return DaskWorkers(cluster.address, identity=work.identity, timeout=timeout, patience=patience)


# What a cluster computes


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 65, 200])
def test_the_sum_has_the_bits_of_one_process(workers: DaskWorkers, count: int) -> None:
    (found,) = workers.sums([[work.task(work.numbers, k) for k in range(count)]], work.add)
    assert found.notes == tuple(range(count))
    if count:
        assert found.total.tobytes() == alone(range(count))
    else:
        assert found.total is None


def test_groups_are_added_up_apart(workers: DaskWorkers) -> None:
    groups = [range(10), range(0), range(20, 21), range(30, 47)]
    found = workers.sums(
        [[work.task(work.numbers, k) for k in group] for group in groups], work.add
    )
    for group, sums in zip(groups, found, strict=True):
        assert sums.notes == tuple(group)
        assert (sums.total is None) if not group else sums.total.tobytes() == alone(group)


def test_sums_come_in_turn_while_later_ones_are_worked_on(workers: DaskWorkers) -> None:
    finished: list[int] = []
    groups = [[work.task(work.slow_numbers, 10 * g + k) for k in range(3)] for g in range(24)]
    seen = [
        (sums.notes, sum(finished))
        for sums in workers.sums_in_turn(groups, work.add, done=finished.append)
    ]
    assert [notes for notes, _ in seen] == [(10 * g, 10 * g + 1, 10 * g + 2) for g in range(24)]
    assert seen[0][1] < 72  # the first did not wait for the last


def test_sums_that_nobody_waits_for_any_more_are_dropped(
    tmp_path: Path, workers: DaskWorkers
) -> None:
    groups = [[work.task(work.marked, str(tmp_path / f"{k}"))] for k in range(100)]
    sums = workers.sums_in_turn(groups, work.add)
    next(sums)
    sums.close()
    (found,) = workers.sums([[work.task(work.numbers, 3)]], work.add)
    assert found.notes == (3,)
    assert len([*tmp_path.iterdir()]) < 50


def test_every_archive_is_reported_once(workers: DaskWorkers) -> None:
    seen: list[int] = []
    workers.sums([[work.task(work.numbers, k) for k in range(100)]], work.add, done=seen.append)
    assert sum(seen) == 100


def test_an_archive_that_fails_crashes_or_hangs_costs_itself_only(cluster: Cluster) -> None:
    tasks = [work.task(work.numbers, k) for k in range(20)]
    tasks[3] = work.task(work.from_file, "/nowhere/three.mcap")
    tasks[8] = work.task(work.crash, 8)
    tasks[9] = work.task(work.faulty, 9)
    tasks[15] = work.task(work.hang, 15)
    with connected(cluster, timeout=2.0) as workers:
        (found,) = workers.sums([tasks], work.add)
    expected = [None if k in (3, 8, 9, 15) else work.numbers(k).total for k in range(20)]
    assert found.total.tobytes() == sum_tree(expected, work.add).tobytes()
    broken = {note.path: note.reason for note in found.notes if isinstance(note, Broken)}
    assert set(broken) == {tasks[k].path for k in (3, 8, 9, 15)}
    assert "No such file" in broken[tasks[3].path]
    assert "signal 11" in broken[tasks[8].path]
    assert "IndexError" in broken[tasks[9].path]
    assert "longer than 2 s" in broken[tasks[15].path]
    assert all(worker.poll() is None for worker in cluster.workers)


def test_a_folder_that_workers_do_not_see_is_refused(workers: DaskWorkers, tmp_path: Path) -> None:
    workers.require_folders([tmp_path])
    with pytest.raises(ClusterError, match=r"does not see .*absent"):
        workers.require_folders([tmp_path, tmp_path / "absent"])


# Workers that die, join and differ


@pytest.mark.slow
def test_a_worker_killed_in_mid_run_changes_no_bit(pair: Cluster) -> None:
    killed: list[int] = []

    with connected(pair) as workers:
        both(workers)

        def done(count: int) -> None:
            killed.append(count)
            if sum(killed) >= 20 and pair.workers[0].poll() is None:
                pair.workers[0].kill()

        groups = [[work.task(work.slow_numbers, k) for k in range(80)]]
        (found,) = workers.sums(groups, work.add, done=done)
        assert pair.workers[0].wait(1.0) == -9
        assert pair.workers[1].poll() is None
    assert found.notes == tuple(range(80))
    assert found.total.tobytes() == alone(range(80))


@pytest.mark.slow
def test_an_archive_that_ends_every_worker_is_named(tmp_path: Path) -> None:
    eager = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}
    with running(tmp_path, **eager) as cluster:
        for _ in range(2):
            cluster.add_worker("--nanny", "--worker-port", "0")
        with connected(cluster) as workers:
            tasks = [work.task(work.numbers, k) for k in range(12)]
            tasks[5] = work.task(work.kill_worker, 5)
            (found,) = workers.sums([tasks], work.add)
    assert [note for note in found.notes if isinstance(note, Broken)] == [
        Broken(tasks[5].path, "ended every worker that read it")
    ]
    expected = [None if k == 5 else work.numbers(k).total for k in range(12)]
    assert found.total.tobytes() == sum_tree(expected, work.add).tobytes()


def test_a_worker_with_other_code_is_refused(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TEST_IDENTITY", "other code")  # here, and not on the workers
    with pytest.raises(
        ClusterError, match=r"worker tcp://.* \(hil the code of .* instead of other"
    ):
        connected(cluster)


def test_a_worker_with_other_code_that_joins_later_computes_nothing() -> None:
    expected = software(work.identity) | {"hil": "other code"}
    with pytest.raises(WorkerSoftwareError, match=r"hil the code of .* instead of other code"):
        sum_archives(
            [work.task(work.numbers, 0)],
            work.add,
            timeout=PATIENCE,
            identity=work.identity,
            expected=expected,
        )
    release_children()


@pytest.mark.slow
def test_a_cluster_that_goes_away_is_an_error_and_no_wait(tmp_path: Path) -> None:
    with running(tmp_path, workers=1) as cluster:
        workers = connected(cluster, patience=5.0)

        def done(_: int) -> None:
            cluster.workers[0].kill()

        with workers, pytest.raises(ClusterError, match=r"all workers .* went away"):
            workers.sums(
                [[work.task(work.slow_numbers, k) for k in range(50)]], work.add, done=done
            )


def test_nobody_at_the_address_is_an_error_with_the_address() -> None:
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9"):
        DaskWorkers("tcp://127.0.0.1:9", identity=work.identity, patience=1.0)


def test_a_scheduler_without_workers_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # To be connected at all takes a second on a busy machine.
    connect = dask_cluster._connected
    monkeypatch.setattr(dask_cluster, "_connected", lambda at, _: connect(at, PATIENCE))
    with running(tmp_path) as cluster, pytest.raises(ClusterError, match="has no worker after"):
        connected(cluster, patience=1.0)


# Real archives


@pytest.mark.slow
def test_a_batch_has_the_bits_of_one_machine_though_a_worker_dies(
    tmp_path: Path, campaign: Campaign, pair: Cluster
) -> None:
    """Two campaigns, told apart by a record that no estimate reads."""
    for number in range(2):
        _copy_with_mark(campaign.folder.root, tmp_path / "data" / f"{number}", f"copy {number}")
    plan, roots = run.Plan(FIXED, keep=False), [str(tmp_path / "data")]
    hands = DaskWorkers(pair.address, identity=code_digest, patience=PATIENCE)
    with _KillsOne(hands, pair.workers[0]) as workers:
        found = run.reidentify(roots, plan, workers, Silent())
    assert pair.workers[0].wait(1.0) == -9
    assert pair.workers[1].poll() is None
    with LocalWorkers(1) as workers:
        expected = run.reidentify(roots, plan, workers, Silent())
    assert not found.broken
    assert len(found.campaigns) == 2
    assert _figures(found) == _figures(expected)


@pytest.mark.slow
def test_archives_behind_a_web_server_are_read_by_the_workers(
    campaign: Campaign, cluster: Cluster
) -> None:
    plan = run.Plan(FIXED, keep=False)
    with (
        served(campaign.folder.root) as address,
        DaskWorkers(cluster.address, identity=code_digest, patience=PATIENCE) as workers,
    ):
        found = run.reidentify([address], plan, workers, Silent())
    with LocalWorkers(1) as local:
        expected = run.reidentify([str(campaign.folder.root)], plan, local, Silent())
    assert not found.broken
    assert [values for _, values in _figures(found)] == [values for _, values in _figures(expected)]


class _KillsOne(Workers):
    """Workers of which one is killed as soon as the first archives were reduced."""

    near = False

    def __init__(self, hands: DaskWorkers, victim: subprocess.Popen[bytes]) -> None:
        self._hands, self._victim = hands, victim

    def __enter__(self) -> _KillsOne:
        both(self._hands)
        return self

    def __exit__(self, *_: object) -> None:
        self._hands.close()

    def sums_in_turn(self, groups, add, *, done=None):
        """The work on archives."""
        begun = any(task.function is reduced for group in groups for task in group)

        def killing(count: int) -> None:
            if begun:
                self._victim.kill()
            if done is not None:
                done(count)

        return self._hands.sums_in_turn(groups, add, done=killing)


def _copy_with_mark(source: Path, target: Path, mark: str) -> None:
    """Copy archives, each with one more metadata record: the same samples, another file."""
    for path in sorted(source.rglob("*.mcap")):
        copy = target / path.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        data, head = path.read_bytes(), len(container.MAGIC)
        copy.write_bytes(data[:head] + metadata("mark", {mark: ""}) + data[head:])


def _figures(result: BatchResult) -> list[tuple[str, tuple[bytes, ...]]]:
    """All numbers, to the bit."""
    levels = [*result.repetitions, *result.campaigns, *result.pooled]
    return [
        (
            f"{one.level} {one.campaign} {one.archive}",
            tuple(
                part.tobytes()
                for part in (one.values, one.std, one.covariance, one.noise_std, one.unseen_rms)
                if part is not None
            ),
        )
        for one in levels
    ]


# The package


def test_nothing_of_dask_is_imported_before_it_is_asked_for() -> None:
    program = (
        "import sys, hil.batch.cluster, hil.batch.remote\n"
        "print([name for name in ('dask', 'distributed', 'fsspec') if name in sys.modules])"
    )
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == "[]"


def test_without_dask_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_cluster, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=re.escape(install_command("cluster"))):
        DaskWorkers("tcp://127.0.0.1:9", identity=work.identity)


def both(workers: DaskWorkers) -> None:
    """Wait until both workers have joined and have done something."""
    assert isinstance(workers.sums([[work.task(work.numbers, 0)]], work.add)[0], Summed)
    deadline = time.monotonic() + PATIENCE
    while workers.n_workers < 2:
        assert time.monotonic() < deadline
        time.sleep(0.05)
