"""`hil reidentify`: which archives it finds and uses, and the numbers of `hil identify`."""

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

import fsspec
import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import archive_files
from hil.archive import ArchiveWriter, Samples, write_samples
from hil.archive.repair import repair, repaired_name
from hil.batch import discovery, factors
from hil.batch.cache import CacheLocation
from hil.batch.discovery import Discovery, discover
from hil.batch.estimates import warning_lines
from hil.batch.factors import cached_bundle, open_ref, reduce_bundle
from hil.batch.run import reidentify
from hil.batch.types import ArchiveRef, BatchEstimator, BatchResult, ChangedError
from hil.batch.workers import LocalWorkers
from hil.campaign import Campaign
from hil.cell import Cell
from hil.cli import app
from hil.cli.reidentify import alarm_lines
from hil.compare.trend import Trends
from hil.errors import InputError
from hil.identify import Options, identify_campaign
from hil.identify.estimating import estimate_with
from hil.identify.options import FIXED
from hil.identify.prepared import Prepared, prepare_sources
from hil.identify.settings import Decided, Settings, decide
from hil.identify.sources import Sources, gather_sources
from hil.progress import Reporter, Silent
from identification.estimators.consistent import Shrinkage
from identification.signals.samples import Preprocessing

from .arm_histories import Load, steady, trend_of
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
    return discover([str(root) for root in roots], cache, Here())


def names_of(ones: Any) -> list[str]:
    """File names of what is broken or skipped."""
    return sorted(Path(one.path).name for one in ones)


def reasons_of(ones: Any) -> dict[str, str]:
    return {Path(one.path).name: one.reason for one in ones}


def excitations(folder: Path) -> list[Path]:
    return sorted((folder / "archives").glob("excitation*.mcap"))


def completed(campaign: Campaign) -> list[Path]:
    kinds = ("excitation", "validation", "standstill")
    return [path for kind in kinds for path in campaign.folder.completed(kind)]


def damage(path: Path) -> None:
    """Zeros in the middle of an archive."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = bytes(2000)
    path.write_bytes(data)


def same_bits(first: BatchResult, second: BatchResult) -> bool:
    def bits(result: BatchResult) -> list[bytes]:
        levels = (*result.repetitions, *result.campaigns, *result.pooled)
        return [one.values.tobytes() + one.std.tobytes() for one in levels]

    return bits(first) == bits(second)


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
    """Those of `hil identify`, whoever computes them and in whatever order."""

    def test_are_those_of_hil_identify(self, campaign: Campaign) -> None:
        """With the options that either has by default, which choose the settings."""
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
        for mine, own in zip(found.repetitions, one.repetitions, strict=True):
            np.testing.assert_allclose(mine.values, own.values, **EXACT)
            np.testing.assert_allclose(mine.std, own.std, **EXACT)

    def test_shrunk_are_those_of_hil_identify(
        self, campaign: Campaign, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Repetitions too, towards the machine of all; of their intervals only the words."""

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
    def test_of_every_estimator_are_those_with_samples(
        self, name: BatchEstimator, campaign: Campaign, prepared: Prepared
    ) -> None:
        one = estimate_with(prepared, replace(FIXED, estimator=name), Silent()).result
        (level,) = batch(campaign.folder.root, estimator=name).campaigns
        # The program of the consistent estimate stops at its own tolerance.
        close = (
            {"rtol": 1e-4, "atol": 1e-4} if name == "consistent" else {"rtol": 1e-8, "atol": 1e-12}
        )
        np.testing.assert_allclose(level.values, one.pooled.values, **close)
        np.testing.assert_allclose(level.std, one.pooled.std, rtol=1e-8)

    def test_errors_on_unseen_motion_are_those_of_the_samples(
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
        """In two folders, each with the standstill: pooled they are what they were in one."""
        for name, wanted in (("first", "excitation_000"), ("second", "excitation_00[12]")):
            (tmp_path / name).mkdir()
            for pattern in (wanted, "standstill"):
                for path in campaign.folder.archives.glob(f"{pattern}*.mcap"):
                    shutil.copy(path, tmp_path / name / path.name)
        result = batch(tmp_path)
        assert [one.repetitions for one in result.campaigns] == [1, 2]
        assert [one.repetitions for one in result.pooled] == [3]
        # Other sums of the same terms: rounding, in parameters that are hardly known.
        apart = result.pooled[0].values - found.pooled[0].values
        assert np.abs(apart / found.pooled[0].std).max() < 1e-6
        np.testing.assert_allclose(result.pooled[0].std, found.pooled[0].std, rtol=1e-6)

    def test_settings_are_decided_once_for_each_arm(
        self, campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """On the first campaign that can be read; the noise of the positions is each one's own."""
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
        assert same_bits(alone, batch(*files))
        assert same_bits(alone, batch(folder, workers=Here(local=False)))
        place = CacheLocation(str(tmp_path / "cache"))
        assert same_bits(alone, batch(folder, cache=place))
        assert same_bits(alone, batch(folder, cache=place))


class TestCache:
    def test_opens_no_archive_for_another_estimator(
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

    def test_of_a_longer_campaign_lacks_what_is_new(self, folder: Path) -> None:
        archive = sorted((folder / "archives").glob("excitation_002*"))[0]
        away = folder.parent / archive.name
        archive.rename(away)
        assert batch(folder, cache=CacheLocation()).read == 4
        away.rename(archive)
        longer = batch(folder, cache=CacheLocation())
        assert longer.read == 1
        assert same_bits(longer, batch(folder))

    def test_of_other_settings_is_another(self, folder: Path) -> None:
        batch(folder, cache=CacheLocation())
        assert batch(folder, cache=CacheLocation(), delay=0.002).read == 5

    def test_of_a_read_only_folder_lies_elsewhere(
        self, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
        monkeypatch.setattr("os.access", lambda *_: False)
        assert batch(folder, cache=CacheLocation()).read == 5
        assert batch(folder, cache=CacheLocation()).read == 0
        assert not (folder / "archives" / ".hil-cache").exists()
        assert list((tmp_path / "xdg" / "hil").iterdir())

    def test_is_not_made_if_none_is_wanted(self, folder: Path) -> None:
        before = sorted(folder.rglob("*"))
        batch(folder)
        assert sorted(folder.rglob("*")) == before


class TestBroken:
    """What cannot be used costs itself and nothing else."""

    def test_archives_cost_only_themselves(self, loose: Path) -> None:
        """The first excitation and others, whatever is cached."""
        whole, (torn, damaged, left) = batch(loose), excitations(loose)
        torn.write_bytes(torn.read_bytes()[:-5000])
        (loose / "nothing.mcap").write_bytes(b"")
        (loose / "other.mcap").write_bytes(b"not an archive at all")
        damage(damaged)
        for cache in (CacheLocation(), CacheLocation(), UNCACHED):
            result = batch(loose, cache=cache)
            reasons = reasons_of(result.broken)
            assert set(reasons) == {torn.name, damaged.name, "nothing.mcap", "other.mcap"}
            assert "repair" in reasons[torn.name]
            assert [Path(one.archive).name for one in result.repetitions] == [left.name]
        np.testing.assert_allclose(
            result.repetitions[0].values, whole.repetitions[2].values, **EXACT
        )

    def test_a_repaired_copy_is_not_fitted_beside_its_original(self, loose: Path) -> None:
        """One wrong bit in an index, which we do not need, makes the two files differ."""
        whole = excitations(loose)
        data = bytearray(whole[0].read_bytes())
        at = 8
        while data[at] != 0x07:  # MessageIndex
            at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        data[at + 20] ^= 1
        whole[0].write_bytes(data)
        repair(whole[0])
        assert repaired_name(whole[0]).read_bytes() != bytes(data)
        result = batch(loose)
        assert not result.broken
        assert len(result.repetitions) == len(whole)

    def test_a_file_that_is_not_what_was_recorded_is_not_used(self, folder: Path) -> None:
        victim, other = excitations(folder)[:2]
        shutil.copy(other, victim)
        result = batch(folder)
        assert names_of(result.broken) == [victim.name]
        assert "manifest" in result.broken[0].reason

    def test_an_archive_that_ends_its_process_costs_itself(self, folder: Path) -> None:
        names = [path.name for path in excitations(folder)]
        result = batch(folder, workers=Here(names[1]))
        assert names_of(result.broken) == [names[1]]
        assert [Path(one.archive).name for one in result.repetitions] == [names[0], names[2]]
        left = [path for path in (folder / "archives").glob("*.mcap") if path.name != names[1]]
        assert same_bits(result, batch(*left))

    def test_a_standstill_that_ends_its_process_costs_itself(self, folder: Path) -> None:
        (name,) = [path.name for path in (folder / "archives").glob("standstill*")]
        result = batch(folder, workers=Here(name))
        assert name in names_of(result.broken)
        assert len(result.repetitions) == 3

    def test_an_estimator_that_is_none_is_refused(self, tmp_path: Path) -> None:
        """A name that nothing knows would be weighted least squares under that name."""
        with pytest.raises(InputError, match="unknown estimator 'lms'; use auto, wls"):
            Options(estimator="lms")  # type: ignore[arg-type]
        with pytest.raises(InputError, match="'huber' reads samples; use auto, wls, consistent"):
            batch(tmp_path, estimator="huber")

    def test_nothing_to_fit_is_an_error(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="no archive"):
            batch(tmp_path)
        (tmp_path / "bad.mcap").write_bytes(b"")
        with pytest.raises(InputError) as caught:
            batch(tmp_path)
        assert str(caught.value).count("bad.mcap") == 1
        (tmp_path / "worse.mcap").write_bytes(b"x")
        with pytest.raises(InputError, match=r"2 could not be used, the first of them \S+bad"):
            batch(tmp_path)

    @pytest.mark.parametrize("kinds", [["validation"], ["validation", "standstill"]])
    def test_a_campaign_without_excitation_costs_only_itself(
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
    def test_lists_what_is_broken_and_ends_with_status_5(
        self, folder: Path, tmp_path: Path
    ) -> None:
        command = ["reidentify", str(folder), "--workers", "1", "-o", str(tmp_path / "out")]
        command += NOTHING_OPEN
        ran = CliRunner().invoke(app, command)
        assert ran.exit_code == 0, ran.output
        assert "3 repetitions in 1 campaign of 1 arm; 5 archives read" in ran.output
        (folder / "archives" / "bad.mcap").write_bytes(b"")
        ran = CliRunner().invoke(app, [*command, "--json"])
        assert ran.exit_code == 5, ran.output
        listed = json.loads(ran.stdout)
        assert [Path(one["path"]).name for one in listed["broken"]] == ["bad.mcap"]
        assert (listed["read"], listed["cached"]) == (0, 5)
        assert all(Path(path).is_file() for path in listed["written"])

    def test_needs_a_place_with_archives(self, tmp_path: Path) -> None:
        for place in (tmp_path, tmp_path / "missing"):
            ran = CliRunner().invoke(app, ["reidentify", str(place)])
            assert isinstance(ran.exception, InputError)
            assert ran.exception.exit_code == 2

    def test_prints_alarms_even_quietly(self) -> None:
        arm = trend_of(lambda k, random: replace(steady(k, random), load=Load(2.0 * k)), 2)
        calm = trend_of(steady, 2)
        (line,) = alarm_lines(Trends((calm, arm), (), "wls", 4))
        assert line.startswith("arm: The payload has changed")


# What is said of archives: warnings, and what their cells state

SLIP = "the clock falls back 2 times; cut the log where it does"
ASSUMED = "the torque constants are assumed"
LADEN = "\n[robot.payload]\nmass = 3.0\ncentre = [0.0, 0.0, 0.1]\n"

Record = Callable[..., list[Path]]


@pytest.fixture
def record(monkeypatch: pytest.MonkeyPatch) -> Record:
    """Four seconds of motion per archive, of a real arm for all that the archive says."""

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
    def test_of_import_and_constants_stand_with_estimates(
        self, record: Record, tmp_path: Path
    ) -> None:
        record(tmp_path / "bare", 2, first=0)
        findings = json.dumps({"lines": [], "doubts": [SLIP]})
        record(tmp_path / "slipped", 2, first=2, metadata={"findings": findings})
        command = ["reidentify", str(tmp_path), "--workers", "1", "-o", str(tmp_path / "out")]
        ran = CliRunner().invoke(app, [*command, "--cache", "none", *NOTHING_OPEN])
        assert ran.exit_code == 0, ran.output
        assert f"note: {ASSUMED}" in ran.output
        line = f"2 of 4 archives, such as slipped/excitation_000_a1.mcap: {SLIP}"
        assert f"note: {line}" in ran.output
        with (tmp_path / "out" / "parameters.csv").open(newline="") as file:
            warnings = {
                (row["level"], Path(row["campaign"]).name): row["warnings"]
                for row in csv.DictReader(file)
            }
        assert all(ASSUMED in text for text in warnings.values())
        assert [SLIP in warnings[level, "slipped"] for level in ("repetition", "campaign")] == [
            True
        ] * 2
        assert [SLIP in warnings[level, "bare"] for level in ("repetition", "campaign")] == [
            False
        ] * 2
        assert line in warnings["pooled", ""]
        page = (tmp_path / "out" / "trend.html").read_text()
        assert SLIP in page

    def test_name_payloads_that_cells_state_differently(
        self, record: Record, tmp_path: Path
    ) -> None:
        record(tmp_path / "line" / "a", 1, first=0)
        (laden,) = record(tmp_path / "line" / "b", 1, first=1, cell=LADEN, metadata={"index": "1"})
        laden.rename(tmp_path / "line" / "a" / "excitation_001_a1.mcap")
        found = batch(tmp_path)
        assert len(found.campaigns) == 2
        stated = {None if one.payload is None else one.payload.mass for one in found.campaigns}
        assert stated == {None, 3.0}
        (pooled,) = found.pooled
        assert (pooled.repetitions, pooled.setup, pooled.payload) == (2, "", None)
        assert "cells state different payloads" in pooled.warnings[0]
        command = ["reidentify", str(tmp_path), "--cache", "none", "--json", *NOTHING_OPEN]
        ran = CliRunner().invoke(app, command)
        (arm,) = json.loads(ran.stdout)["arms"].values()
        assert len(arm["campaigns"]) == 2
        assert sum("carries 3 kg" in one["setup"] for one in arm["campaigns"].values()) == 1

    def test_are_given_once_with_what_they_concern(self) -> None:
        def warned(name: str, *warnings: str) -> tuple[ArchiveRef, tuple[str, ...]]:
            path = f"/line/c1/archives/{name}"
            return ArchiveRef(path, "", "excitation", "", "/line/c1", 0, "", ""), warnings

        found = [warned(name, "of all") for name in ("a", "b", "c")]
        assert warning_lines(found) == ("of all",)
        found += [warned("d", "of all", "of one"), warned("e", "of all", "of two")]
        found += [warned("f", "of all", "of two")]
        assert warning_lines(found) == (
            "of all",
            "2 of 6 archives, such as c1/e: of two",
            "c1/d: of one",
        )
        many = warning_lines(
            [warned(f"{k}", f"the clock falls back {k} times") for k in range(100)]
        )
        assert len(many) < 20
        assert "more warnings are listed with the repetitions" in many[-1]


# Which archives there are


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


class TestPlaces:
    """Where archives lie."""

    def test_behind_links_are_found_once_and_loops_end(self, tmp_path: Path, arm: Cell) -> None:
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

    def test_a_folder_that_cannot_be_looked_into_is_one(
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

    def test_that_are_no_files_are_reported(self, tmp_path: Path, arm: Cell) -> None:
        recording(tmp_path / "a.mcap", arm)
        (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere.mcap")
        (tmp_path / "line 4").symlink_to(tmp_path / "not mounted")
        os.mkfifo(tmp_path / "pipe.mcap")
        result = found_in(tmp_path)
        assert len(result.refs) == 1
        assert names_of(result.broken) == ["gone.mcap", "pipe.mcap"]
        assert names_of(result.skipped) == ["line 4"]


class TestGroups:
    """What archives belong together, and which are meant to be fitted."""

    @pytest.mark.parametrize(
        ("old", "new", "words"),
        [
            ("[robot.friction]", PAYLOAD, "carries 3 kg at (0.02, 0, 0.08) m"),
            ("current_delay_cycles = 0.2", "current_delay_cycles = 3", "torque lags by 3 ms"),
        ],
    )
    def test_a_stated_delay_or_payload_is_another_campaign(
        self, old: str, new: str, words: str, tmp_path: Path, arm: Cell
    ) -> None:
        recording(tmp_path / "a.mcap", arm)
        recording(tmp_path / "b.mcap", renamed(arm, old, new))
        result = found_in(tmp_path)
        assert len({ref.arm for ref in result.refs}) == 1
        assert len({ref.campaign for ref in result.refs}) == 1
        assert len({ref.key for ref in result.refs}) == 2
        setups = {Path(ref.location).name: ref.setup for ref in result.refs}
        assert words in setups["b.mcap"]
        assert words not in setups["a.mcap"]

    def test_what_was_simulated_is_not_the_arm_itself(self, tmp_path: Path, arm: Cell) -> None:
        recording(tmp_path / "real.mcap", arm)
        recording(tmp_path / "model.mcap", arm, {"simulated": "yes"})
        recording(tmp_path / "rehearsal" / "archives" / "x.mcap", arm, {"simulated": "yes"})
        result = found_in(tmp_path)
        assert len({ref.arm for ref in result.refs}) == len(result.refs) == 2
        assert [one.reason for one in result.skipped] == ["belongs to a rehearsal"]

    def test_a_copy_counts_once(self, tmp_path: Path, arm: Cell) -> None:
        (tmp_path / "copy").mkdir()
        shutil.copy(recording(tmp_path / "a.mcap", arm), tmp_path / "copy" / "b.mcap")
        result = found_in(tmp_path)
        assert [Path(ref.location).name for ref in result.refs] == ["a.mcap"]
        assert "is a copy of" in reasons_of(result.skipped)["b.mcap"]

    def test_what_is_made_beside_a_campaign_is_left_alone(self, tmp_path: Path, arm: Cell) -> None:
        """Runs with a payload that no cell states, and copies for viewers."""
        recording(tmp_path / "real.mcap", arm)
        recording(tmp_path / "payload" / "gripper" / "bare" / "archives" / "x.mcap", arm)
        recording(tmp_path / "payload" / "gripper" / "loaded" / "archives" / "y.mcap", arm)
        (tmp_path / "annotated").mkdir()
        (tmp_path / "annotated" / "real.mcap").write_bytes(b"for viewers")
        result = found_in(tmp_path)
        assert {Path(ref.location).name for ref in result.refs} <= {"real.mcap", "x.mcap"}
        assert not result.broken
        reasons = {Path(one.path).parent.name: one.reason for one in result.skipped}
        assert reasons["annotated"] == "is a copy for viewers"
        assert any("recorded with a payload" in one.reason for one in result.skipped)

    def test_delays_of_one_folder_are_each_applied(
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

    def test_the_newest_whole_accepted_attempt_counts(self, tmp_path: Path, arm: Cell) -> None:
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
        result = found_in(tmp_path)
        assert [ref.name for ref in result.refs] == [accepted.name, newest.name]
        assert names_of(result.broken) == sorted([torn.name, torn_too.name])
        reasons = {Path(one.path).name: one.reason for one in result.skipped}
        assert reasons == {
            rejected.name: "ended rejected",
            earlier.name: "was replaced by attempt 2",
        }

    def test_a_torn_attempt_counts_only_without_a_later_one(
        self, tmp_path: Path, arm: Cell
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
        assert [ref.name for ref in found.refs] == [
            paths[key].name for key in ((0, 2), (1, 1), (2, 2))
        ]
        assert names_of(found.broken) == [paths[1, 2].name]
        reasons = {Path(one.path).name: one.reason for one in found.skipped}
        assert reasons == {
            paths[0, 1].name: "was replaced by attempt 2",
            paths[2, 1].name: "was replaced by attempt 2",
            move.name: "is a move",
        }

    def test_a_damaged_manifest_is_one_and_does_not_stop_the_batch(self, folder: Path) -> None:
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
    """One that nobody has touched for long."""
    path = recording(tmp_path / "data" / "a.mcap", arm)
    monkeypatch.setattr(discovery, "_UNTOUCHED", 0)
    time.sleep(0.01)
    return path


def opening(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """How many archives were opened since."""
    calls: list[Path] = []
    whole = discovery.open_archive

    def counting(path: Path, **how: object):
        calls.append(path)
        return whole(path, **how)

    monkeypatch.setattr(discovery, "open_archive", counting)
    return lambda: len(calls)


class TestNotes:
    """What is known of an archive without opening it."""

    def test_are_believed_until_the_programs_change(
        self, old_archive: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        opened_so_far = opening(monkeypatch)
        first = found_in(old_archive, cache=CacheLocation())
        assert found_in(old_archive, cache=CacheLocation()) == first
        assert opened_so_far() == 1
        monkeypatch.setattr(discovery, "code_digest", lambda: "other programs")
        monkeypatch.setattr(discovery, "arm_digest", lambda *_, **__: "another idea of an arm")
        (ref,) = found_in(old_archive, cache=CacheLocation()).refs
        assert ref.arm == "another idea of an arm"
        assert opened_so_far() == 2

    def test_spare_workers_what_is_known(self, tmp_path: Path, arm: Cell) -> None:
        for name in ("a", "b", "c"):
            recording(tmp_path / f"{name}.mcap", arm)
        cache = CacheLocation(str(tmp_path / "cache"))
        with LocalWorkers(2) as workers:
            found = discover([str(tmp_path)], cache, workers)
        assert [ref.name for ref in found.refs] == ["a.mcap", "b.mcap", "c.mcap"]
        far = Here(local=False)
        assert discover([str(tmp_path)], cache, far) == found
        assert [task.path for task in far.tasks] == [ref.location for ref in found.refs]


@pytest.fixture
def remote(arm: Cell, tmp_path: Path) -> tuple[str, bytes]:
    """An archive in a store, and what somebody puts in its place."""
    store = fsspec.filesystem("memory")
    address = f"memory://{tmp_path.name}/a.mcap"
    store.pipe(address, recording(tmp_path / "a.mcap", arm).read_bytes())
    return address, recording(tmp_path / "b.mcap", arm).read_bytes()


class TestChanges:
    """Files that change, and stores that fail."""

    def test_of_a_remote_archive_after_hashing_are_noticed(
        self, remote: tuple[str, bytes], tmp_path: Path
    ) -> None:
        address, other = remote
        cache = CacheLocation(str(tmp_path / "cache"))
        (ref,) = discover([address], cache, Here()).refs
        with open_ref(ref):
            pass
        fsspec.filesystem("memory").pipe(address, other)
        with pytest.raises(ChangedError), open_ref(ref):
            pass
        assert "changed" in reduce_bundle((ref,), SETTINGS, cache).broken[0].reason
        assert cached_bundle((ref,), SETTINGS, cache) is None

    def test_while_it_is_read_are_no_fault_of_the_archive(
        self, tmp_path: Path, arm: Cell, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = recording(tmp_path / "a.mcap", arm)
        (ref,) = found_in(path).refs
        read = factors.open_archive

        def written_to(cache: Path, **how: object):
            path.write_bytes(path.read_bytes()[:-500])
            return read(cache, **how)

        monkeypatch.setattr(factors, "open_archive", written_to)
        with pytest.raises(ChangedError), open_ref(ref):
            pass
        cache = CacheLocation(str(tmp_path / "cache"))
        assert reduce_bundle((ref,), SETTINGS, cache).broken
        assert cached_bundle((ref,), SETTINGS, cache) is None

    def test_of_a_store_that_fails_are_not_cached(
        self, remote: tuple[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        address, _ = remote
        cache = CacheLocation(str(tmp_path / "cache"))
        (ref,) = discover([address], cache, Here()).refs

        def busy(*_: object) -> None:
            raise RuntimeError("503, Service Unavailable")

        with monkeypatch.context() as patch:
            patch.setattr(fsspec.get_filesystem_class("memory"), "get_file", busy)
            with pytest.raises(InputError, match="503"), open_ref(ref):
                pass
            failed = reduce_bundle((ref,), SETTINGS, cache)
            assert "503" in failed.broken[0].reason
        again = reduce_bundle((ref,), SETTINGS, cache)
        assert again.read == 1
        assert "503" not in str(again.broken)

    def test_of_the_bytes_are_cached(self, tmp_path: Path, arm: Cell) -> None:
        path = recording(tmp_path / "a.mcap", arm)
        (ref,) = found_in(path).refs
        data = bytearray(path.read_bytes())
        data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
        path.write_bytes(data)
        now = replace(ref, stamp=factors.stamp_of(path))
        cache = CacheLocation(str(tmp_path / "cache"))
        found, again = (
            reduce_bundle((now,), SETTINGS, cache),
            cached_bundle((now,), SETTINGS, cache),
        )
        assert again is not None and again.broken == found.broken

    def test_of_nothing_read_a_store_from_the_cache(self, folder: Path, tmp_path: Path) -> None:
        store = fsspec.filesystem("memory")
        for path in sorted((folder / "archives").glob("*.mcap")):
            store.pipe(f"memory://{tmp_path.name}/archives/{path.name}", path.read_bytes())
        cache = CacheLocation(str(tmp_path / "cache"))
        far, near = (batch(at, cache=cache) for at in (f"memory://{tmp_path.name}", folder))
        assert not far.broken
        assert far.campaigns[0].values.tobytes() == near.campaigns[0].values.tobytes()
        again = batch(f"memory://{tmp_path.name}", cache=cache)
        assert (again.read, again.cached) == (0, 5)
