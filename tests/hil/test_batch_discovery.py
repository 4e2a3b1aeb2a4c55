"""Which archives a batch finds, what it takes them for, and what it refuses to take for granted."""

from __future__ import annotations

import json
import os
import shutil
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import fsspec
import numpy as np
import pytest

from hil.archive import Samples, write_samples
from hil.batch import discovery, factors
from hil.batch.cache import Where
from hil.batch.discovery import Discovery, discover
from hil.batch.factors import cached, opened, reduced
from hil.batch.run import Plan, reidentify
from hil.batch.types import ArchiveRef, ChangedError, NothingToFitError, UnavailableError
from hil.batch.workers import LocalWorkers
from hil.campaign import Campaign
from hil.cell import Cell
from hil.errors import InputError
from hil.identify.options import FIXED
from hil.identify.settings import Settings
from hil.progress import Silent
from identification.signals.samples import Preprocessing

from .batch_workers import Here
from .conftest import small
from .mcap_bytes import with_attachment

SETTINGS = Settings(Preprocessing())
PAYLOAD = "[robot.payload]\nmass = 3.0\ncentre = [0.02, 0.0, 0.08]\n\n[robot.friction]"


def found_in(*roots: Path | str, cache: Path | None = None) -> Discovery:
    where = Where(None if cache is None else str(cache))
    return discover([str(root) for root in roots], where, Here())


def recording(path: Path, cell: Cell, metadata: Mapping[str, str] | None = None) -> Path:
    """An archive of a tenth of a second, different for each path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    seed = zlib.crc32(path.as_posix().encode())
    rows = np.random.default_rng(seed).normal(size=(100, len(cell.joint_names)))
    return write_samples(
        path,
        Samples(np.arange(100) * 1_000_000, rows, torque=rows),
        joint_names=cell.joint_names,
        metadata=metadata or {},
        attachments={"cell.toml": cell.text.encode(), "robot.urdf": cell.urdf.encode()},
        period=0.001,
        durable=False,
    )


def renamed(cell: Cell, old: str, new: str) -> Cell:
    assert old in cell.text
    return Cell.from_texts(cell.text.replace(old, new), cell.urdf, cell.path)


@pytest.fixture(scope="module")
def arm() -> Cell:
    return small()


@pytest.fixture
def folder(campaign: Campaign, tmp_path: Path) -> Path:
    copy = tmp_path / "campaign"
    shutil.copytree(campaign.folder.root, copy, ignore=shutil.ignore_patterns(".hil-cache"))
    return copy


def excitations(folder: Path) -> list[Path]:
    return sorted((folder / "archives").glob("excitation*.mcap"))


# Where archives lie


def test_archives_behind_links_are_found_once_and_loops_end(tmp_path: Path, arm: Cell) -> None:
    real = recording(tmp_path / "store" / "one" / "a.mcap", arm)
    root = tmp_path / "root"
    root.mkdir()
    (root / "first").symlink_to(tmp_path / "store")
    (root / "second").symlink_to(real.parent)
    (real.parent / "up").symlink_to(root)
    result = found_in(root, cache=tmp_path / "cache")
    assert [ref.location for ref in result.refs] == [real.as_posix()]
    assert not result.broken
    assert not result.skipped


def test_a_folder_that_cannot_be_looked_into_is_told(
    tmp_path: Path, arm: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording(tmp_path / "open" / "a.mcap", arm)
    closed = tmp_path / "closed"
    closed.mkdir()
    scan = os.scandir

    def refusing(path: str | os.PathLike[str]):
        if Path(path) == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", refusing)
    result = found_in(tmp_path, cache=tmp_path / "cache")
    assert len(result.refs) == 1
    (told,) = result.broken
    assert told.path == closed.as_posix()
    assert "Permission denied" in told.reason
    with pytest.raises(NothingToFitError, match="closed cannot be looked into: Permission denied"):
        found_in(closed, cache=tmp_path / "cache")


def test_links_to_nothing_and_what_is_no_file_are_told(tmp_path: Path, arm: Cell) -> None:
    recording(tmp_path / "a.mcap", arm)
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere.mcap")
    (tmp_path / "line 4").symlink_to(tmp_path / "not mounted")
    os.mkfifo(tmp_path / "pipe.mcap")
    result = found_in(tmp_path, cache=tmp_path / "cache")
    assert len(result.refs) == 1
    assert sorted(Path(one.path).name for one in result.broken) == ["gone.mcap", "pipe.mcap"]
    assert [Path(one.path).name for one in result.skipped] == ["line 4"]


# What archives belong together


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[robot.friction]", PAYLOAD, "carries 3 kg at (0.02, 0, 0.08) m"),
        ("current_delay_cycles = 0.2", "current_delay_cycles = 3", "torque lags by 3 ms"),
    ],
)
def test_archives_that_state_other_delays_or_payloads_are_of_one_arm_and_two_campaigns(
    old: str, new: str, words: str, tmp_path: Path, arm: Cell
) -> None:
    recording(tmp_path / "a.mcap", arm)
    recording(tmp_path / "b.mcap", renamed(arm, old, new))
    result = found_in(tmp_path, cache=tmp_path / "cache")
    assert len({ref.arm for ref in result.refs}) == 1
    assert len({ref.campaign for ref in result.refs}) == 1
    assert len({ref.key for ref in result.refs}) == 2
    setups = {Path(ref.location).name: ref.setup for ref in result.refs}
    assert words in setups["b.mcap"]
    assert words not in setups["a.mcap"]


def test_what_was_simulated_is_not_the_arm_itself(tmp_path: Path, arm: Cell) -> None:
    recording(tmp_path / "real.mcap", arm)
    recording(tmp_path / "model.mcap", arm, {"simulated": "yes"})
    recording(tmp_path / "rehearsal" / "archives" / "x.mcap", arm, {"simulated": "yes"})
    result = found_in(tmp_path, cache=tmp_path / "cache")
    assert len({ref.arm for ref in result.refs}) == len(result.refs) == 2
    assert [one.reason for one in result.skipped] == ["belongs to a rehearsal"]


def test_what_is_made_beside_a_campaign_is_left_alone(tmp_path: Path, arm: Cell) -> None:
    """Runs with a payload that no cell states, and copies for viewers."""
    recording(tmp_path / "real.mcap", arm)
    recording(tmp_path / "payload" / "gripper" / "bare" / "archives" / "x.mcap", arm)
    recording(tmp_path / "payload" / "gripper" / "loaded" / "archives" / "y.mcap", arm)
    (tmp_path / "annotated").mkdir()
    (tmp_path / "annotated" / "real.mcap").write_bytes(b"for viewers")
    result = found_in(tmp_path, cache=tmp_path / "cache")
    assert {Path(ref.location).name for ref in result.refs} <= {"real.mcap", "x.mcap"}
    assert not result.broken
    reasons = {Path(one.path).parent.name: one.reason for one in result.skipped}
    assert reasons["annotated"] == "is a copy for viewers"
    assert any("carries a payload" in one.reason for one in result.skipped)


def test_delays_of_one_folder_are_each_taken_for_their_own(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "manifest.json").unlink()
    victim = excitations(folder)[2]
    other = with_attachment(
        victim, tmp_path / victim.name, "delay_cycles = 0.2", "delay_cycles = 4.2"
    )
    other.replace(victim)
    used: dict[str, float] = {}
    reduce_one = factors.archive_factor

    def spied(ref: ArchiveRef, settings: Settings):
        used[ref.name] = settings.preprocessing.torque_delay
        return reduce_one(ref, settings)

    monkeypatch.setattr(factors, "archive_factor", spied)
    result = reidentify([str(folder)], Plan(FIXED, keep=False), Here(), Silent())
    assert not result.broken
    assert [one.repetitions for one in result.campaigns] == [2, 1]
    assert used.pop(victim.name) == pytest.approx(0.0042)
    assert set(used.values()) == {0.0002}


def test_a_prior_that_the_archives_of_an_arm_state_differently_is_refused(
    folder: Path, tmp_path: Path
) -> None:
    (folder / "manifest.json").unlink()
    victim = excitations(folder)[2]
    other = with_attachment(
        victim, tmp_path / victim.name, "uncertainty = 0.2", "uncertainty = 0.3"
    )
    other.replace(victim)
    with pytest.raises(InputError, match=rf"{victim.name}.*another \[nominal\]"):
        reidentify(
            [str(folder)], Plan(replace(FIXED, estimator="prior"), keep=False), Here(), Silent()
        )
    (level,) = reidentify([str(folder)], Plan(FIXED, keep=False), Here(), Silent()).campaigns
    assert level.repetitions == 3  # a belief is nothing to least squares


# Attempts, outcomes, manifests


def test_the_newest_whole_accepted_attempt_counts(tmp_path: Path, arm: Cell) -> None:
    def attempt(index: int, number: int) -> Path:
        name = f"motion {index}, attempt {number}.mcap"
        numbers = {"index": str(index), "attempt": str(number)}
        return recording(tmp_path / "c" / "archives" / name, arm, numbers)

    rejected, torn = attempt(0, 1), attempt(0, 2)
    accepted, torn_too = attempt(1, 1), attempt(1, 2)
    earlier, newest = attempt(2, 1), attempt(2, 2)
    for path in (torn, torn_too):
        path.write_bytes(path.read_bytes()[:-200])
    entries = [
        {"name": rejected.name, "outcome": "rejected"},
        {"name": accepted.name, "outcome": "completed"},
        {"name": earlier.name, "outcome": "completed"},
        {"name": newest.name, "outcome": "completed"},
    ]
    for entry in entries:
        entry["sha256"] = factors.digest_of(tmp_path / "c" / "archives" / entry["name"])
    manifest = {"inputs": {}, "archives": entries}
    (tmp_path / "c" / "manifest.json").write_text(json.dumps(manifest))
    result = found_in(tmp_path, cache=tmp_path / "cache")
    assert [ref.name for ref in result.refs] == [accepted.name, newest.name]
    assert {Path(one.path).name for one in result.broken} == {torn.name, torn_too.name}
    reasons = {Path(one.path).name: one.reason for one in result.skipped}
    assert reasons == {rejected.name: "ended rejected", earlier.name: "attempt 2 took its place"}


def test_a_torn_attempt_is_missed_only_where_no_later_one_took_its_place(
    tmp_path: Path, arm: Cell
) -> None:
    # As a full disk leaves them; the last one says nothing but its name.
    folder = tmp_path / "c" / "archives"
    paths = {}
    for index, number in ((0, 1), (0, 2), (1, 1), (1, 2), (2, 1), (2, 2)):
        name = f"imported_{index:03d}_a{number}.mcap"
        numbers = {"index": str(index), "attempt": str(number)}
        paths[index, number] = recording(folder / name, arm, numbers)
    for key in ((0, 1), (1, 2)):
        paths[key].write_bytes(paths[key].read_bytes()[:-200])
    paths[2, 1].write_bytes(b"")
    move = folder / "move_003_a1.mcap"
    move.write_bytes(b"")
    found = found_in(tmp_path)
    assert [ref.name for ref in found.refs] == [paths[key].name for key in ((0, 2), (1, 1), (2, 2))]
    assert {Path(one.path).name for one in found.broken} == {paths[1, 2].name}
    reasons = {Path(one.path).name: one.reason for one in found.skipped}
    assert reasons == {
        paths[0, 1].name: "attempt 2 took the place of this unusable one",
        paths[2, 1].name: "attempt 2 took the place of this unusable one",
        move.name: "is a move",
    }


def test_a_damaged_manifest_is_told_and_does_not_stop_the_batch(folder: Path) -> None:
    manifest = folder / "manifest.json"
    manifest.write_text(manifest.read_text()[:-40])
    result = found_in(folder, cache=folder.parent / "cache")
    assert len(result.refs) == 6
    (told,) = result.broken
    assert told.path == manifest.as_posix()
    assert "damaged" in told.reason
    assert "without being checked" in told.reason


# What is noted


@pytest.fixture
def old_archive(tmp_path: Path, arm: Cell, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One that nobody has touched for long."""
    path = recording(tmp_path / "data" / "a.mcap", arm)
    monkeypatch.setattr(discovery, "_UNTOUCHED", 0)
    time.sleep(0.01)
    return path


def counted(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """How many archives were opened since."""
    calls: list[Path] = []
    whole = discovery.open_archive

    def counting(path: Path, **how: object):
        calls.append(path)
        return whole(path, **how)

    monkeypatch.setattr(discovery, "open_archive", counting)
    return lambda: len(calls)


def test_a_note_is_believed_until_the_programs_change(
    old_archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened_so_far = counted(monkeypatch)
    first = found_in(old_archive)
    assert found_in(old_archive) == first
    assert opened_so_far() == 1
    monkeypatch.setattr(discovery, "code_digest", lambda: "other programs")
    monkeypatch.setattr(discovery, "arm_digest", lambda *_, **__: "another idea of an arm")
    (ref,) = found_in(old_archive).refs
    assert ref.arm == "another idea of an arm"
    assert opened_so_far() == 2


def test_workers_look_into_what_is_not_noted_and_only_that(tmp_path: Path, arm: Cell) -> None:
    for name in ("a", "b", "c"):
        recording(tmp_path / f"{name}.mcap", arm)
    where = Where(str(tmp_path / "cache"))
    with LocalWorkers(2) as workers:
        found = discover([str(tmp_path)], where, workers)
    assert [ref.name for ref in found.refs] == ["a.mcap", "b.mcap", "c.mcap"]
    far = Here(near=False)
    assert discover([str(tmp_path)], where, far) == found
    assert [task.path for task in far.tasks] == [ref.location for ref in found.refs]


# Files that change, and stores that fail


@pytest.fixture
def remote(arm: Cell, tmp_path: Path) -> tuple[str, bytes]:
    """An archive in a store, and what somebody puts in its place."""
    store = fsspec.filesystem("memory")
    address = f"memory://{tmp_path.name}/a.mcap"
    store.pipe(address, recording(tmp_path / "a.mcap", arm).read_bytes())
    return address, recording(tmp_path / "b.mcap", arm).read_bytes()


def test_a_remote_archive_replaced_after_it_was_hashed_is_not_taken_for_it(
    remote: tuple[str, bytes], tmp_path: Path
) -> None:
    address, other = remote
    where = Where(str(tmp_path / "cache"))
    (ref,) = discover([address], where, Here()).refs
    with opened(ref):
        pass
    fsspec.filesystem("memory").pipe(address, other)
    with pytest.raises(ChangedError), opened(ref):
        pass
    assert "changed" in reduced((ref,), SETTINGS, where).broken[0].reason
    assert cached((ref,), SETTINGS, where) is None


def test_what_a_file_met_while_it_was_written_to_is_no_fault_of_it(
    tmp_path: Path, arm: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recording(tmp_path / "a.mcap", arm)
    (ref,) = found_in(path, cache=tmp_path / "cache").refs
    read = factors.open_archive

    def written_to(where: Path, **how: object):
        path.write_bytes(path.read_bytes()[:-500])
        return read(where, **how)

    monkeypatch.setattr(factors, "open_archive", written_to)
    with pytest.raises(ChangedError), opened(ref):
        pass
    assert not reduced((ref,), SETTINGS, Where(keep=False)).lasting


def test_a_store_that_fails_is_told_and_not_remembered(
    remote: tuple[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address, _ = remote
    where = Where(str(tmp_path / "cache"))
    (ref,) = discover([address], where, Here()).refs

    def busy(*_: object) -> None:
        raise RuntimeError("503, Service Unavailable")

    monkeypatch.setattr("hil.batch.remote._PAUSES", (0.0,))
    with monkeypatch.context() as patch:
        patch.setattr(fsspec.get_filesystem_class("memory"), "get_file", busy)
        with pytest.raises(UnavailableError, match="503"), opened(ref):
            pass
        failed = reduced((ref,), SETTINGS, where)
        assert "503" in failed.broken[0].reason
    again = reduced((ref,), SETTINGS, where)
    assert again.read == 1
    assert "503" not in str(again.broken)


def test_a_fault_of_the_bytes_is_remembered(tmp_path: Path, arm: Cell) -> None:
    path = recording(tmp_path / "a.mcap", arm)
    (ref,) = found_in(path, cache=tmp_path / "cache").refs
    data = bytearray(path.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    path.write_bytes(data)
    now = replace(ref, stamp=factors.stamp_of(path))
    found = reduced((now,), SETTINGS, Where(keep=False))
    assert found.lasting and found.broken


def test_a_whole_batch_reads_from_a_store(folder: Path, tmp_path: Path) -> None:
    store = fsspec.filesystem("memory")
    for path in sorted((folder / "archives").glob("*.mcap")):
        store.pipe(f"memory://{tmp_path.name}/archives/{path.name}", path.read_bytes())
    plan = Plan(FIXED, cache=tmp_path / "cache")
    far = reidentify([f"memory://{tmp_path.name}"], plan, Here(), Silent())
    near = reidentify([str(folder)], plan, Here(), Silent())
    assert not far.broken
    assert far.campaigns[0].values.tobytes() == near.campaigns[0].values.tobytes()
    again = reidentify([f"memory://{tmp_path.name}"], plan, Here(), Silent())
    assert (again.read, again.cached) == (0, 5)
