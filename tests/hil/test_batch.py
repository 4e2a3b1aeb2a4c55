"""Batches: discovery and selection of archives, equality with `hil identify`, cache."""

from __future__ import annotations

import csv
import json
import os
import shutil
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import archive_files
from hil.archive import ArchiveWriter, Samples, write_samples
from hil.archive.repair import repair, repaired_name
from hil.batch import discovery, factors
from hil.batch.cache import CacheLocation
from hil.batch.discovery import Discovery, discover
from hil.batch.factors import cached_bundle, open_ref, reduce_bundle
from hil.batch.run import reidentify
from hil.batch.types import ArchiveRef, BatchEstimator, BatchResult
from hil.batch.workers import LocalWorkers
from hil.campaign import Campaign
from hil.cell import Cell
from hil.cli import app
from hil.errors import ArchiveError, InputError
from hil.identify import Options, identify_campaign
from hil.identify.estimating import estimate_with
from hil.identify.options import FIXED
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.settings import Decided, Settings, decide
from hil.identify.sources import Sources, gather_sources
from hil.progress import Reporter, Silent
from identification.estimators.consistent import Shrinkage
from identification.signals.samples import Preprocessing

from .batch_work import NOTHING_OPEN, Here
from .conftest import small
from .mcap_bytes import with_attachment

EXACT = {"rtol": 1e-9, "atol": 0.0}
UNCACHED = CacheLocation(keep=False)
SETTINGS = Settings(Preprocessing())
PAYLOAD = "[robot.payload]\nmass = 3.0\ncentre = [0.02, 0.0, 0.08]\n\n[robot.friction]"


def batch(
    *places: Path | str,
    options: Options = FIXED,
    cache: CacheLocation = UNCACHED,
    workers: Any = None,
    **changed: Any,
) -> BatchResult:
    names, options = [str(place) for place in places], replace(options, **changed)
    return reidentify(names, options, workers or Here(), Silent(), cache=cache)


def found_in(*roots: Path | str, cache: CacheLocation = UNCACHED) -> Discovery:
    return discover([str(root) for root in roots], cache, Here(), Silent())


def reasons_of(ones: Any) -> dict[str, str]:
    """Return the reasons of unused archives by file name."""
    return {Path(one.path).name: one.reason for one in ones}


def excitations(folder: Path) -> list[Path]:
    return sorted((folder / "archives").glob("excitation*.mcap"))


def completed(campaign: Campaign) -> list[Path]:
    kinds = ("excitation", "validation", "standstill")
    return [path for kind in kinds for path in campaign.folder.completed(kind)]


def damage(path: Path) -> None:
    """Zero 2000 bytes in the middle of an archive."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = bytes(2000)
    path.write_bytes(data)


def bits(result: BatchResult) -> list[bytes]:
    levels = (*result.repetitions, *result.campaigns, *result.pooled)
    return [one.values.tobytes() + one.std.tobytes() for one in levels]


@pytest.fixture
def folder(campaign: Campaign, tmp_path: Path) -> Path:
    """A copy of the campaign, to be damaged."""
    copy = tmp_path / "campaign"
    shutil.copytree(campaign.folder.root, copy, ignore=shutil.ignore_patterns(".hil-cache"))
    return copy


@pytest.fixture
def loose(folder: Path) -> Path:
    """The same without a manifest."""
    (folder / "manifest.json").unlink()
    return folder


@pytest.fixture(scope="module")
def prepared(campaign: Campaign) -> Prepared:
    return prepare_sources(gather_sources(completed(campaign), 0.7), FIXED, Silent())


@pytest.fixture(scope="module")
def found(campaign: Campaign) -> BatchResult:
    return batch(campaign.folder.root)


class TestNumbers:
    def test_equal_those_of_hil_identify(self, campaign: Campaign) -> None:
        """With the default options, which choose the settings."""
        one = identify_campaign(campaign.folder.root, Silent()).estimate
        found = batch(campaign.folder.root, options=Options())
        (level,), (pooled,) = found.campaigns, found.pooled
        assert pooled.values.tobytes() == level.values.tobytes()
        assert (pooled.level, pooled.campaign) == ("pooled", "")
        np.testing.assert_allclose(level.values, one.pooled.values, **EXACT)
        np.testing.assert_allclose(level.covariance, one.pooled.covariance, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(level.noise_std, one.pooled.noise_std, **EXACT)
        assert level.interval_factor == one.pooled.interval_factor
        assert level.method == one.pooled.method
        assert level.names == one.pooled.names
        assert list(level.samples) == list(one.pooled.samples)
        assert len(found.repetitions) == len(one.repetitions) == 3
        for mine, theirs in zip(found.repetitions, one.repetitions, strict=True):
            np.testing.assert_allclose(mine.values, theirs.values, **EXACT)
            np.testing.assert_allclose(mine.std, theirs.std, **EXACT)

    def test_equal_those_of_hil_identify_if_shrunk(
        self, campaign: Campaign, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Repetitions are shrunk to the common centre; of their intervals only the method."""

        def shrunk(sources: Sources, options: Options, reporter: Reporter) -> Decided:
            found = decide(sources, FIXED, reporter)
            return found._replace(settings=replace(found.settings, shrinkage=Shrinkage(0.1)))

        monkeypatch.setattr("hil.identify.prepared.decide", shrunk)
        monkeypatch.setattr("hil.batch.factors.decide", shrunk)
        options = replace(FIXED, estimator="auto")
        own = prepare_sources(gather_sources(completed(campaign), 0.7), options, Silent())
        one = estimate_with(own, options, Silent()).result
        found = batch(campaign.folder.root, options=options)
        np.testing.assert_allclose(found.campaigns[0].values, one.pooled.values, **EXACT)
        np.testing.assert_allclose(found.campaigns[0].std, one.pooled.std, **EXACT)
        for mine, theirs in zip(found.repetitions, one.repetitions, strict=True):
            np.testing.assert_allclose(mine.values, theirs.values, **EXACT)
            assert mine.method == theirs.method

    @pytest.mark.parametrize("name", get_args(BatchEstimator))
    def test_equal_those_with_samples_for_each_estimator(
        self, name: BatchEstimator, campaign: Campaign, prepared: Prepared
    ) -> None:
        one = estimate_with(prepared, replace(FIXED, estimator=name), Silent()).result
        (level,) = batch(campaign.folder.root, estimator=name).campaigns
        # The program of the consistent estimate stops at its own tolerance.
        rtol, atol = (1e-4, 1e-4) if name == "consistent" else (1e-8, 1e-12)
        np.testing.assert_allclose(level.values, one.pooled.values, rtol=rtol, atol=atol)
        np.testing.assert_allclose(level.std, one.pooled.std, rtol=1e-8)

    def test_held_out_errors_equal_those_of_samples(
        self, prepared: Prepared, found: BatchResult
    ) -> None:
        (level,) = found.campaigns
        model = prepared.sources.cell.model
        squares, rows = np.zeros(6), np.zeros(6)
        for samples in prepared.held_out:
            error = samples.torque - samples.predicted_torque(model, level.values)
            squares += np.where(samples.usable, error**2, 0.0).sum(axis=0)
            rows += samples.usable.sum(axis=0)
        np.testing.assert_allclose(level.unseen_rms, np.sqrt(squares / rows), rtol=1e-6)

    def test_campaigns_of_an_arm_are_pooled(
        self, campaign: Campaign, found: BatchResult, tmp_path: Path
    ) -> None:
        """In two folders, each with the standstill: pooled they equal those of one folder."""
        for name, wanted in (("first", "excitation_000"), ("second", "excitation_00[12]")):
            (tmp_path / name).mkdir()
            for pattern in (wanted, "standstill"):
                for path in campaign.folder.archives.glob(f"{pattern}*.mcap"):
                    shutil.copy(path, tmp_path / name / path.name)
        result = batch(tmp_path)
        assert [one.repetitions for one in result.campaigns] == [1, 2]
        assert [one.repetitions for one in result.pooled] == [3]
        # Sums in another order: rounding of poorly determined parameters.
        apart = result.pooled[0].values - found.pooled[0].values
        assert np.abs(apart / found.pooled[0].std).max() < 1e-6
        np.testing.assert_allclose(result.pooled[0].std, found.pooled[0].std, rtol=1e-6)

    def test_settings_are_decided_once_for_each_arm(
        self, campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """On the first readable campaign; the noise of the positions is that of each campaign."""
        names = ("excitation_000", "excitation_001", "excitation_002", "standstill")
        for folder, wanted in (("a", names[:1]), ("b", names[1:2]), ("c", names[2:])):
            (tmp_path / folder).mkdir()
            for name in wanted:
                (path,) = campaign.folder.archives.glob(f"{name}*.mcap")
                shutil.copy(path, tmp_path / folder / path.name)
        damage(tmp_path / "a" / "excitation_000_a1.mcap")
        read: list[list[str]] = []

        def spied(sources: Sources, options: Options, reporter: Reporter) -> Decided:
            read.append([source.name for source in sources.training])
            return decide(sources, options, reporter)

        monkeypatch.setattr("hil.batch.factors.decide", spied)
        found = batch(tmp_path, friction="auto")
        assert read == [["excitation_001_a1.mcap"]]
        assert [Path(one.campaign).name for one in found.campaigns] == ["b", "c"]
        assert found.campaigns[0].settings != found.campaigns[1].settings
        assert found.pooled[0].repetitions == 2

    @pytest.mark.slow
    def test_do_not_depend_on_workers_order_or_cache(
        self, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(factors, "BUNDLE", 1)
        with LocalWorkers(2) as workers:
            alone = batch(folder, workers=workers)
        files = sorted((folder / "archives").glob("*.mcap"), reverse=True)
        assert bits(batch(*files)) == bits(alone)
        assert bits(batch(folder, workers=Here(local=False))) == bits(alone)
        place = CacheLocation(str(tmp_path / "cache"))
        assert bits(batch(folder, cache=place)) == bits(alone)
        assert bits(batch(folder, cache=place)) == bits(alone)


class TestCache:
    def test_serves_another_estimator_without_archives(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        long_ago = time.time() - 100.0
        for path in (folder / "archives").glob("*.mcap"):
            os.utime(path, (long_ago, long_ago))
        monkeypatch.setattr("hil.batch.discovery._UNTOUCHED", 0)
        first = batch(folder, cache=CacheLocation())
        assert (first.read, first.cached) == (5, 0)

        def never(*_: object, **__: object) -> None:
            raise AssertionError("an archive was opened")

        monkeypatch.setattr(factors, "open_archive", never)
        monkeypatch.setattr("hil.batch.discovery.open_archive", never)
        workers = Here()
        second = batch(folder, cache=CacheLocation(), workers=workers, estimator="consistent")
        assert (second.read, second.cached, workers.tasks) == (0, 5, [])
        assert "consistent" in second.campaigns[0].method

    def test_depends_on_settings_and_is_optional(self, folder: Path) -> None:
        before = sorted(folder.rglob("*"))
        batch(folder)
        assert sorted(folder.rglob("*")) == before
        batch(folder, cache=CacheLocation())
        assert batch(folder, cache=CacheLocation(), delay=0.002).read == 5

    def test_of_a_read_only_folder_is_in_the_home(
        self, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
        monkeypatch.setattr("os.access", lambda *_: False)
        assert batch(folder, cache=CacheLocation()).read == 5
        assert batch(folder, cache=CacheLocation()).read == 0
        assert not (folder / "archives" / ".hil-cache").exists()
        assert list((tmp_path / "xdg" / "hil").iterdir())


class TestBroken:
    """Unusable archives do not affect the others."""

    def test_damaged_archives(self, loose: Path) -> None:
        """Also the first excitation, with and without cache."""
        intact, (truncated, damaged, left) = batch(loose), excitations(loose)
        truncated.write_bytes(truncated.read_bytes()[:-5000])
        (loose / "nothing.mcap").write_bytes(b"")
        (loose / "other.mcap").write_bytes(b"not an archive at all")
        damage(damaged)
        for cache in (CacheLocation(), CacheLocation(), UNCACHED):
            result = batch(loose, cache=cache)
            reasons = reasons_of(result.broken)
            assert set(reasons) == {truncated.name, damaged.name, "nothing.mcap", "other.mcap"}
            assert "repair" in reasons[truncated.name]
            assert [Path(one.archive).name for one in result.repetitions] == [left.name]
        found, expected = result.repetitions[0].values, intact.repetitions[2].values
        np.testing.assert_allclose(found, expected, **EXACT)

    def test_repaired_copies_are_not_fitted_with_their_originals(self, loose: Path) -> None:
        """One wrong bit in an index, which is not read, makes the two files differ."""
        files = excitations(loose)
        data = bytearray(files[0].read_bytes())
        at = 8
        while data[at] != 0x07:  # MessageIndex
            at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        data[at + 20] ^= 1
        files[0].write_bytes(data)
        repair(files[0])
        assert repaired_name(files[0]).read_bytes() != bytes(data)
        result = batch(loose)
        assert not result.broken
        assert len(result.repetitions) == len(files)

    def test_archives_that_differ_from_the_manifest(self, folder: Path) -> None:
        victim, other = excitations(folder)[:2]
        shutil.copy(other, victim)
        result = batch(folder)
        assert [*reasons_of(result.broken)] == [victim.name]
        assert "manifest" in result.broken[0].reason

    def test_archives_that_end_their_process(self, folder: Path) -> None:
        names = [path.name for path in excitations(folder)]
        result = batch(folder, workers=Here(names[1]))
        assert [*reasons_of(result.broken)] == [names[1]]
        assert [Path(one.archive).name for one in result.repetitions] == [names[0], names[2]]
        left = [path for path in (folder / "archives").glob("*.mcap") if path.name != names[1]]
        assert bits(batch(*left)) == bits(result)
        (standstill,) = [path.name for path in (folder / "archives").glob("standstill*")]
        result = batch(folder, workers=Here(standstill))
        assert standstill in reasons_of(result.broken)
        assert len(result.repetitions) == 3

    def test_estimators_that_read_samples_are_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="'huber' reads samples; use auto, wls, consistent"):
            batch(tmp_path, estimator="huber")

    def test_nothing_to_fit_is_an_error(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="no archive"):
            batch(tmp_path)
        (tmp_path / "bad.mcap").write_bytes(b"")
        with pytest.raises(InputError) as caught:
            batch(tmp_path)
        assert str(caught.value).count("bad.mcap") == 1

    @pytest.mark.parametrize("kinds", [["validation"], ["validation", "standstill"]])
    def test_campaigns_without_excitation(
        self, folder: Path, tmp_path: Path, kinds: list[str]
    ) -> None:
        alone = tmp_path / "alone"
        alone.mkdir()
        for kind in kinds:
            shutil.copy(folder / "archives" / f"{kind}_000_a1.mcap", alone)
        with pytest.raises(InputError, match="alone could not be used: it holds no excitation"):
            batch(alone)
        found = batch(alone, folder)
        assert len(found.campaigns) == 1
        assert [(broken.path, broken.reason) for broken in found.broken] == [
            (str(alone), "it holds no excitation")
        ]


class TestCommand:
    def test_broken_archives_give_exit_status_5(self, folder: Path, tmp_path: Path) -> None:
        command = ["reidentify", str(folder), "--workers", "1", "-o", str(tmp_path / "out")]
        command += NOTHING_OPEN
        ran = CliRunner().invoke(app, command)
        assert ran.exit_code == 0, ran.output
        assert "3 repetitions in 1 campaign of 1 arm; 5 archives read" in ran.output
        (folder / "archives" / "bad.mcap").write_bytes(b"")
        ran = CliRunner().invoke(app, [*command, "--json"])
        assert ran.exit_code == 5, ran.output
        found = json.loads(ran.stdout)
        assert [Path(one["path"]).name for one in found["broken"]] == ["bad.mcap"]
        assert (found["read"], found["cached"]) == (0, 5)
        assert all(Path(path).is_file() for path in found["written"])


# Warnings about archives, and payloads that their cells state

CLOCK = "the clock falls back 2 times; cut the log where it does"
ASSUMED = "the torque constants are assumed"
LADEN = "\n[robot.payload]\nmass = 3.0\ncentre = [0.0, 0.0, 0.1]\n"

Record = Callable[..., list[Path]]


@pytest.fixture
def record(monkeypatch: pytest.MonkeyPatch) -> Record:
    """Return a function that writes archives of four seconds of motion of a real arm."""

    def make(
        folder: Path,
        count: int,
        *,
        first: int,
        cell: str = "",
        metadata: Mapping[str, str] | None = None,
    ) -> list[Path]:
        bare = Cell.load(archive_files.CELL_PATH)

        def writer(path: Path, **facts: Any) -> ArchiveWriter:
            facts["metadata"] = {**facts["metadata"], **(metadata or {})}
            text = facts["attachments"]["cell.toml"] + cell.encode()
            facts["attachments"] = facts["attachments"] | {"cell.toml": text}
            return ArchiveWriter(path, **facts)

        assert bare.file.robot.payload is None
        monkeypatch.setattr(archive_files, "ArchiveWriter", writer)
        return archive_files.repetitions(folder, count, first=first, cycles=4000)

    return make


class TestWarnings:
    def test_are_printed_and_tabulated(self, record: Record, tmp_path: Path) -> None:
        record(tmp_path / "bare", 2, first=0)
        findings = json.dumps({"lines": [], "doubts": [CLOCK]})
        record(tmp_path / "warned", 2, first=2, metadata={"findings": findings})
        command = ["reidentify", str(tmp_path), "--workers", "1", "-o", str(tmp_path / "out")]
        ran = CliRunner().invoke(app, [*command, "--cache", "none", *NOTHING_OPEN])
        assert ran.exit_code == 0, ran.output
        assert f"note: {ASSUMED}" in ran.output
        line = f"2 of 4 archives, such as warned/excitation_000_a1.mcap: {CLOCK}"
        assert f"note: {line}" in ran.output
        with (tmp_path / "out" / "parameters.csv").open(newline="") as file:
            warnings = {
                (row["level"], Path(row["campaign"]).name): row["warnings"]
                for row in csv.DictReader(file)
            }
        assert all(ASSUMED in text for text in warnings.values())
        for level in ("repetition", "campaign"):
            assert CLOCK in warnings[level, "warned"]
            assert CLOCK not in warnings[level, "bare"]
        assert line in warnings["pooled", ""]

    def test_name_different_payloads(self, record: Record, tmp_path: Path) -> None:
        record(tmp_path / "line" / "a", 1, first=0)
        (laden,) = record(tmp_path / "line" / "b", 1, first=1, cell=LADEN, metadata={"index": "1"})
        laden.rename(tmp_path / "line" / "a" / "excitation_001_a1.mcap")
        found = batch(tmp_path)
        assert len(found.campaigns) == 2
        assert sum("carries 3 kg" in one.setup for one in found.campaigns) == 1
        (pooled,) = found.pooled
        assert (pooled.repetitions, pooled.setup) == (2, "")
        assert "cells state different payloads" in pooled.warnings[0]
        command = ["reidentify", str(tmp_path), "--cache", "none", "--json", *NOTHING_OPEN]
        ran = CliRunner().invoke(app, command)
        (arm,) = json.loads(ran.stdout)["arms"].values()
        assert len(arm["campaigns"]) == 2
        assert sum("carries 3 kg" in one["setup"] for one in arm["campaigns"].values()) == 1


# Discovery


def recording(path: Path, cell: Cell, metadata: Mapping[str, str] | None = None) -> Path:
    """Write an archive of a tenth of a second, different for each path."""
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


class TestPlaces:
    def test_links_are_followed_once_and_loops_end(self, tmp_path: Path, arm: Cell) -> None:
        real = recording(tmp_path / "store" / "one" / "a.mcap", arm)
        root = tmp_path / "root"
        root.mkdir()
        (root / "first").symlink_to(tmp_path / "store")
        (root / "second").symlink_to(real.parent)
        (real.parent / "up").symlink_to(root)
        result = found_in(root)
        assert [ref.location for ref in result.refs] == [real.as_posix()]
        assert not result.broken
        assert not result.skipped

    def test_unreadable_folders_are_reported(
        self, tmp_path: Path, arm: Cell, monkeypatch: pytest.MonkeyPatch
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
        result = found_in(tmp_path)
        assert len(result.refs) == 1
        (one,) = result.broken
        assert one.path == closed.as_posix()
        assert "Permission denied" in one.reason
        with pytest.raises(InputError, match="closed cannot be read: Permission denied"):
            found_in(closed)

    def test_broken_links_and_pipes_are_reported(self, tmp_path: Path, arm: Cell) -> None:
        recording(tmp_path / "a.mcap", arm)
        (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere.mcap")
        os.mkfifo(tmp_path / "pipe.mcap")
        result = found_in(tmp_path)
        assert len(result.refs) == 1
        assert {*reasons_of(result.broken)} == {"gone.mcap", "pipe.mcap"}


class TestGroups:
    """Which archives are fitted together, and which are skipped."""

    @pytest.mark.parametrize(
        ("old", "new", "setup"),
        [
            ("[robot.friction]", PAYLOAD, "carries 3 kg at (0.02, 0, 0.08) m"),
            ("current_delay_cycles = 0.2", "current_delay_cycles = 3", "torque lags by 3 ms"),
        ],
    )
    def test_stated_delay_or_payload_is_another_campaign(
        self, old: str, new: str, setup: str, tmp_path: Path, arm: Cell
    ) -> None:
        recording(tmp_path / "a.mcap", arm)
        recording(tmp_path / "b.mcap", renamed(arm, old, new))
        result = found_in(tmp_path)
        assert len({ref.arm for ref in result.refs}) == 1
        assert len({ref.campaign for ref in result.refs}) == 1
        assert len({ref.key for ref in result.refs}) == 2
        setups = {Path(ref.location).name: ref.setup for ref in result.refs}
        assert setup in setups["b.mcap"]
        assert setup not in setups["a.mcap"]

    def test_simulated_arms_are_others(self, tmp_path: Path, arm: Cell) -> None:
        recording(tmp_path / "real.mcap", arm)
        recording(tmp_path / "model.mcap", arm, {"simulated": "yes"})
        refs = found_in(tmp_path).refs
        assert len({ref.arm for ref in refs}) == len(refs) == 2

    def test_copies_rehearsals_and_weighing_runs_are_skipped(
        self, tmp_path: Path, arm: Cell
    ) -> None:
        original = recording(tmp_path / "a.mcap", arm)
        for folder in ("copy", "annotated"):
            (tmp_path / folder).mkdir()
        shutil.copy(original, tmp_path / "copy" / "b.mcap")
        (tmp_path / "annotated" / "a.mcap").write_bytes(b"for viewers")
        recording(tmp_path / "payload" / "gripper" / "bare" / "archives" / "x.mcap", arm)
        recording(tmp_path / "payload" / "gripper" / "loaded" / "archives" / "y.mcap", arm)
        recording(tmp_path / "rehearsal" / "archives" / "z.mcap", arm, {"simulated": "yes"})
        result = found_in(tmp_path)
        assert [ref.name for ref in result.refs] == ["a.mcap", "x.mcap"]
        assert not result.broken
        assert {one.path.removeprefix(f"{tmp_path}/"): one.reason for one in result.skipped} == {
            "annotated/a.mcap": "is a copy for viewers",
            "copy/b.mcap": f"is a copy of {original}",
            "payload/gripper/loaded/archives/y.mcap": (
                "was recorded with a payload that its cell does not state"
            ),
            "rehearsal/archives/z.mcap": "belongs to a rehearsal",
        }

    def test_each_stated_delay_of_a_folder_is_applied(
        self, loose: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        victim = excitations(loose)[2]
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
        result = batch(loose)
        assert not result.broken
        assert [one.repetitions for one in result.campaigns] == [2, 1]
        assert used.pop(victim.name) == pytest.approx(0.0042)
        assert set(used.values()) == {0.0002}

    def test_newest_intact_accepted_attempt_is_used(self, tmp_path: Path, arm: Cell) -> None:
        folder = tmp_path / "c" / "archives"

        def attempt(index: int, number: int) -> Path:
            name = f"motion {index}, attempt {number}.mcap"
            return recording(folder / name, arm, {"index": str(index), "attempt": str(number)})

        rejected, truncated = attempt(0, 1), attempt(0, 2)
        accepted, truncated_too = attempt(1, 1), attempt(1, 2)
        earlier, newest = attempt(2, 1), attempt(2, 2)
        for path in (truncated, truncated_too):
            path.write_bytes(path.read_bytes()[:-200])
        entries = [
            {
                "name": path.name,
                "outcome": "rejected" if path == rejected else "completed",
                "sha256": factors.digest_of(path),
            }
            for path in (rejected, accepted, earlier, newest)
        ]
        manifest = {"inputs": {}, "archives": entries}
        (tmp_path / "c" / "manifest.json").write_text(json.dumps(manifest))
        result = found_in(tmp_path)
        assert [ref.name for ref in result.refs] == [accepted.name, newest.name]
        assert {*reasons_of(result.broken)} == {truncated.name, truncated_too.name}
        assert reasons_of(result.skipped) == {
            rejected.name: "ended rejected",
            earlier.name: "was replaced by attempt 2",
        }

    def test_truncated_attempts_are_replaced_by_later_ones(self, tmp_path: Path, arm: Cell) -> None:
        """As a full disk leaves them; of empty ones only the name is known."""
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
        used = [paths[key].name for key in ((0, 2), (1, 1), (2, 2))]
        assert [ref.name for ref in found.refs] == used
        assert [*reasons_of(found.broken)] == [paths[1, 2].name]
        assert reasons_of(found.skipped) == {
            paths[0, 1].name: "was replaced by attempt 2",
            paths[2, 1].name: "was replaced by attempt 2",
            move.name: "is a move",
        }

    def test_damaged_manifests_are_reported(self, folder: Path) -> None:
        manifest = folder / "manifest.json"
        manifest.write_text(manifest.read_text()[:-40])
        result = found_in(folder)
        assert len(result.refs) == 6
        (one,) = result.broken
        assert one.path == manifest.as_posix()
        assert "damaged" in one.reason
        assert "without being checked" in one.reason


@pytest.fixture
def old_archive(tmp_path: Path, arm: Cell, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write an archive whose time stamps are old enough to be trusted."""
    path = recording(tmp_path / "data" / "a.mcap", arm)
    monkeypatch.setattr(discovery, "_UNTOUCHED", 0)
    time.sleep(0.01)
    return path


def opening(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Return a function that counts the archives opened since."""
    calls: list[Path] = []
    original = discovery.open_archive

    def counting(path: Path, **how: object):
        calls.append(path)
        return original(path, **how)

    monkeypatch.setattr(discovery, "open_archive", counting)
    return lambda: len(calls)


class TestCachedMetadata:
    def test_are_valid_until_the_programs_change(
        self, old_archive: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        opened_so_far = opening(monkeypatch)
        first = found_in(old_archive, cache=CacheLocation())
        assert found_in(old_archive, cache=CacheLocation()) == first
        assert opened_so_far() == 1
        monkeypatch.setattr(discovery, "code_digest", lambda: "other programs")
        monkeypatch.setattr(discovery, "arm_digest", lambda *_, **__: "another digest")
        (ref,) = found_in(old_archive, cache=CacheLocation()).refs
        assert ref.arm == "another digest"
        assert opened_so_far() == 2

    def test_on_other_machines_are_left_to_their_workers(self, tmp_path: Path, arm: Cell) -> None:
        for name in ("a", "b", "c"):
            recording(tmp_path / f"{name}.mcap", arm)
        cache = CacheLocation(str(tmp_path / "cache"))
        with LocalWorkers(2) as workers:
            found = discover([str(tmp_path)], cache, workers, Silent())
        assert [ref.name for ref in found.refs] == ["a.mcap", "b.mcap", "c.mcap"]
        far = Here(local=False)
        assert discover([str(tmp_path)], cache, far, Silent()) == found
        assert [task.path for task in far.tasks] == [ref.location for ref in found.refs]


def test_archive_changed_while_it_is_read_is_not_cached(
    tmp_path: Path, arm: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recording(tmp_path / "a.mcap", arm)
    (ref,) = found_in(path).refs
    read = factors.open_archive

    def written_to(cache: Path, **how: object):
        path.write_bytes(path.read_bytes()[:-500])
        return read(cache, **how)

    monkeypatch.setattr(factors, "open_archive", written_to)
    with pytest.raises(ArchiveError, match="was changed"):
        open_ref(ref)
    cache = CacheLocation(str(tmp_path / "cache"))
    assert reduce_bundle((ref,), SETTINGS, cache).broken
    assert cached_bundle((ref,), SETTINGS, cache) is None
