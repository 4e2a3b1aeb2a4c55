"""Batches: discovery and selection of archives, equality with `hil identify`, cache."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import time
import zlib
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, get_args

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import archive_files
from hil.archive import ArchiveWriter, ImportedSamples, write_samples
from hil.archive.repair import repair, repaired_name
from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Silent
from hil.batch import archive_discovery, archive_reduction, estimates
from hil.batch import graph as batch_run
from hil.batch.archive_discovery import discover, open_ref
from hil.batch.archive_reduction import (
    ToReduce,
    cached_reduction,
    reduce_archives,
    reduction_key,
)
from hil.batch.cache import CacheLocation
from hil.batch.cluster import Cluster
from hil.batch.estimates import BatchEstimator
from hil.batch.graph import reidentify
from hil.batch.messages import setup_words
from hil.batch.notes import DifferentSetups
from hil.batch.setup import Setup
from hil.campaign.identified_campaign import identify_campaign
from hil.cell import Cell
from hil.cli import app
from hil.pipeline.estimating import estimate_with, with_transmitted_load
from hil.pipeline.options import FIXED, Options
from hil.pipeline.prepared import decide, prepare_sources
from hil.pipeline.sources import gather_sources
from identification.factor import factor
from identification.factor.blocks import FINE_BLOCK
from identification.selection.settings import Settings, Strength
from identification.signals.samples import Preprocessing
from tests import messages
from tests.hil.batch_work import NOTHING_OPEN, Deadly, Here
from tests.hil.conftest import small
from tests.hil.mcap_bytes import with_attachment

pytestmark = pytest.mark.long

EXACT = {"rtol": 1e-9, "atol": 0.0}
UNCACHED = CacheLocation(keep=False)
SETTINGS = Settings(Preprocessing())
NAMES = ("excitation_000", "excitation_001", "excitation_002")


def batch(*places, options=FIXED, cache=UNCACHED, cluster=None, **changed):
    names = [str(place) for place in places]
    options = replace(options, **changed)
    return reidentify(names, options, cluster or Here(), Silent(), cache=cache)


def found_in(*roots, cache=UNCACHED):
    return discover([str(root) for root in roots], cache, Here(), Silent())


def reasons_of(ones):
    """Return the reasons of unused archives by file name."""
    return {Path(unused.path).name: unused.message for unused in ones}


def fitted(result):
    """Return the names of the archives of the repetitions."""
    return [Path(estimate.archive).name for estimate in result.repetitions]


def excitations(folder):
    return sorted((folder / "archives").glob("excitation*.mcap"))


def copied(campaign, folder, *names):
    """Copy archives of a campaign into a folder."""
    folder.mkdir(parents=True)
    for name in names:
        shutil.copy(campaign.folder.archives / f"{name}_a1.mcap", folder)
    return folder


def damage(path):
    """Zero 2000 bytes in the middle of an archive."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 2000] = bytes(2000)
    path.write_bytes(data)


def bits(result):
    levels = (*result.repetitions, *result.campaigns, *result.pooled)
    return [level.estimate.values.tobytes() + level.estimate.std.tobytes() for level in levels]


def assert_equal_repetitions(result, single_result):
    """Values of each alone; an identification has the intervals of all together only."""
    for mine, values in zip(result.repetitions, single_result.values, strict=True):
        # rounding of a value near zero is one of its standard deviation
        size = np.maximum(np.abs(values), mine.estimate.std)
        np.testing.assert_allclose(mine.estimate.values / size, values / size, atol=1e-9, rtol=0.0)


@pytest.fixture
def folder(campaign, tmp_path):
    """A copy of the campaign, to be damaged."""
    copy = tmp_path / "campaign"
    shutil.copytree(campaign.folder.root, copy, ignore=shutil.ignore_patterns(".hil-cache"))
    return copy


@pytest.fixture
def loose(folder):
    """The same without a manifest."""
    (folder / "manifest.json").unlink()
    return folder


def prepare(campaign, options=FIXED):
    kinds = ("excitation", "validation", "standstill")
    paths = [path for kind in kinds for path in campaign.folder.completed(kind)]
    return prepare_sources(gather_sources(paths, 0.7), options, Silent())


@pytest.fixture(scope="module")
def prepared(campaign):
    return prepare(campaign)


@pytest.fixture(scope="module")
def batch_result(campaign):
    return batch(campaign.folder.root)


class TestNumbers:
    def test_equal_those_of_hil_identify(self, campaign):
        """With the default options, which choose the settings."""
        identification = identify_campaign(campaign.folder.root, Silent())
        stated = identification.estimation.stated
        result = batch(campaign.folder.root, options=Options())
        (level,) = result.campaigns
        (pooled,) = result.pooled
        assert (pooled.level, pooled.campaign) == ("pooled", "")
        level = level.estimate
        pooled = pooled.estimate
        assert pooled.values.tobytes() == level.values.tobytes()
        np.testing.assert_allclose(level.values, stated.values, **EXACT)
        np.testing.assert_allclose(level.covariance, stated.covariance, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(level.noise_std, stated.noise_std, **EXACT)
        for name in ("interval_factor", "method", "names"):
            assert getattr(level, name) == getattr(stated, name)
        assert list(level.samples) == list(stated.samples)
        repeated = identification.estimate
        assert len(result.repetitions) == len(repeated.values) == 3
        assert_equal_repetitions(result, repeated)

    @pytest.mark.parametrize(
        "changes",
        [
            {"strength": Strength(10.0)},
            {"strength": Strength(1.0, consistent=True)},
            {"friction": {"load": True}},
        ],
        ids=["a strong prior", "possible bodies", "friction that grows with load"],
    )
    def test_equal_those_of_hil_identify_with_other_choices(self, campaign, monkeypatch, changes):
        """As inner prediction may decide, the prior counts, and the gears are loaded, alike."""

        def decided(sources, options, reporter):
            decisions = decide(sources, FIXED, reporter)
            return decisions._replace(settings=replace(decisions.settings, **changes))

        monkeypatch.setattr("hil.pipeline.prepared.decide", decided)
        monkeypatch.setattr(batch_run, "decide", decided)
        options = replace(FIXED, estimator="auto")
        ready = with_transmitted_load(prepare(campaign, options))
        estimation = estimate_with(ready, options, Silent())
        stated = estimation.stated
        result = batch(campaign.folder.root, options=options)
        level = result.campaigns[0].estimate
        np.testing.assert_allclose(level.values, stated.values, **EXACT)
        np.testing.assert_allclose(level.std, stated.std, **EXACT)
        assert level.method == stated.method
        assert_equal_repetitions(result, estimation.result)

    @pytest.mark.parametrize("name", get_args(BatchEstimator))
    def test_equal_those_with_samples_for_each_estimator(self, name, campaign):
        options = replace(FIXED, estimator=name)
        # The strength of its prior is chosen for "auto".
        stated = estimate_with(prepare(campaign, options), options, Silent()).stated
        level = batch(campaign.folder.root, estimator=name).campaigns[0].estimate
        # The program of the consistent estimate stops at its own tolerance.
        rtol, atol = (1e-4, 1e-4) if name == "consistent" else (1e-8, 1e-12)
        np.testing.assert_allclose(level.values, stated.values, rtol=rtol, atol=atol)
        np.testing.assert_allclose(level.std, stated.std, rtol=1e-8)

    def test_held_out_errors_equal_those_of_samples(self, prepared, batch_result):
        (level,) = batch_result.campaigns
        model = prepared.sources.cell.model
        squares = np.zeros(6)
        rows = np.zeros(6)
        for samples in prepared.held_out:
            error = samples.torque - samples.predicted_torque(model, level.estimate.values)
            squares += np.where(samples.usable, error**2, 0.0).sum(axis=0)
            rows += samples.usable.sum(axis=0)
        np.testing.assert_allclose(level.unseen_rms, np.sqrt(squares / rows), rtol=1e-6)

    def test_campaigns_of_an_arm_are_pooled(self, campaign, batch_result, tmp_path):
        """In two folders, each with the standstill: pooled they equal those of one folder."""
        copied(campaign, tmp_path / "first", NAMES[0], "standstill_000")
        copied(campaign, tmp_path / "second", *NAMES[1:], "standstill_000")
        result = batch(tmp_path)
        assert [level.repetitions for level in result.campaigns] == [1, 2]
        assert [level.repetitions for level in result.pooled] == [3]
        # Sums in another order: rounding of poorly determined parameters.
        mine = result.pooled[0].estimate
        theirs = batch_result.pooled[0].estimate
        assert np.abs((mine.values - theirs.values) / theirs.std).max() < 1e-6
        np.testing.assert_allclose(mine.std, theirs.std, rtol=1e-6)

    def test_settings_are_decided_once_for_each_arm(self, campaign, tmp_path, monkeypatch):
        """On the first readable campaign; the noise of the positions is that of each campaign."""
        for folder, names in (("a", NAMES[:1]), ("b", NAMES[1:2])):
            copied(campaign, tmp_path / folder, *names)
        copied(campaign, tmp_path / "c", NAMES[2], "standstill_000")
        damage(tmp_path / "a" / "excitation_000_a1.mcap")
        read = []

        def spied(sources, options, reporter):
            read.append([source.name for source in sources.training])
            return decide(sources, options, reporter)

        monkeypatch.setattr(batch_run, "decide", spied)
        result = batch(tmp_path, friction="auto")
        assert read == [["excitation_001_a1.mcap"]]
        assert [Path(level.campaign).name for level in result.campaigns] == ["b", "c"]
        assert result.campaigns[0].settings != result.campaigns[1].settings
        assert result.pooled[0].repetitions == 2

    @pytest.mark.slow
    def test_do_not_depend_on_workers_order_or_cache(self, folder, tmp_path, monkeypatch):
        monkeypatch.setattr(batch_run, "ARCHIVES_PER_TASK", 1)
        with Cluster(2) as cluster:
            alone = batch(folder, cluster=cluster)
        files = sorted((folder / "archives").glob("*.mcap"), reverse=True)
        assert bits(batch(*files)) == bits(alone)
        place = CacheLocation(str(tmp_path / "cache"))
        for _ in range(2):
            assert bits(batch(folder, cache=place)) == bits(alone)


class TestCache:
    def test_serves_another_estimator_without_archives(self, folder, monkeypatch):
        """Another delay reads them again, and the cache is optional."""
        before = sorted(folder.rglob("*"))
        batch(folder)
        assert sorted(folder.rglob("*")) == before
        long_ago = time.time() - 100.0
        for path in (folder / "archives").glob("*.mcap"):
            os.utime(path, (long_ago, long_ago))
        monkeypatch.setattr(archive_discovery, "_MIN_UNCHANGED_NS", 0)
        first = batch(folder, cache=CacheLocation())
        assert (first.read, first.cached) == (5, 0)
        with monkeypatch.context() as patch:
            patch.setattr(archive_discovery, "open_archive", pytest.fail)
            second = batch(folder, cache=CacheLocation(), estimator="consistent")
        assert (second.read, second.cached) == (0, 5)
        assert second.campaigns[0].estimate.method.is_consistent
        assert batch(folder, cache=CacheLocation(), delay=0.002).read == 5

    def test_of_a_campaign_is_read_by_the_task_that_estimates_it(self, folder, tmp_path):
        class Spied(Here):
            tasks: ClassVar[list[str]] = []

            def submit(self, task, *, archives):
                self.tasks.append(task.function.__name__)
                return super().submit(task, archives=archives)

        cache = CacheLocation(str(tmp_path / "cache"))
        first = batch(folder, cache=cache)
        second = batch(folder, cache=cache, cluster=Spied())
        assert bits(second) == bits(first)
        assert Spied.tasks[-2:] == ["estimate_cached", "result_of"]
        assert "reduce_archives" not in Spied.tasks

    @pytest.mark.long
    @pytest.mark.parametrize("estimator", ["auto", "wls", "consistent"])
    def test_of_estimates_serves_the_same_archives_only(
        self, folder, estimator, tmp_path, monkeypatch
    ):
        cache = CacheLocation(str(tmp_path / "cache"))
        first = batch(folder, cache=cache, estimator=estimator)
        with monkeypatch.context() as patch:
            patch.setattr(estimates.ArmEstimator, "of_each", pytest.fail)
            second = batch(folder, cache=cache, estimator=estimator)
        for level in ("repetitions", "campaigns", "pooled"):
            for one, other in zip(getattr(first, level), getattr(second, level), strict=True):
                assert one.warnings == other.warnings
                for name in ("values", "covariance", "noise_std", "samples"):
                    known = getattr(one.estimate, name)
                    assert known.tobytes() == getattr(other.estimate, name).tobytes()
                for name in ("names", "units", "method", "condition", "interval_factor"):
                    assert getattr(one.estimate, name) == getattr(other.estimate, name)
        fewer = batch(*excitations(folder)[1:], cache=cache, estimator=estimator)
        (before,), (after,) = first.campaigns, fewer.campaigns
        assert before.estimate.values.tobytes() != after.estimate.values.tobytes()

    def test_preserves_the_blocks_of_long_recordings(self, folder, tmp_path, monkeypatch):
        """Which are longer than those of short ones, and are merged before they are added."""
        monkeypatch.setattr(factor, "_MANY_BLOCKS", 4)
        (ref, *_) = found_in(excitations(folder)[0]).refs
        cache = CacheLocation(str(tmp_path / "cache"))
        computed = reduce_archives((ToReduce(ref),), SETTINGS, cache).total.factor
        cached = cached_reduction((ToReduce(ref),), SETTINGS, cache).total.factor
        assert cached.block == computed.block > FINE_BLOCK
        assert [matrix.tobytes() for matrix in cached.matrices] == [
            matrix.tobytes() for matrix in computed.matrices
        ]

    def test_an_entry_of_other_content_is_computed_again(self, folder, tmp_path):
        """As of a version whose estimates stated how they were made in words."""
        (ref, *_) = found_in(excitations(folder)[0]).refs
        archives = (ToReduce(ref),)
        cache = CacheLocation(str(tmp_path / "cache"))
        first = reduce_archives(archives, SETTINGS, cache)
        key = reduction_key(archives, SETTINGS)
        content, arrays = cache.read(ref.origin, key)
        content["archives"][0]["fit"]["method"] = "weighted least squares"
        cache.write(ref.origin, key, content, arrays)
        assert cached_reduction(archives, SETTINGS, cache) is None
        again = reduce_archives(archives, SETTINGS, cache)
        assert (again.read, again.cached) == (1, 0)
        assert again.summaries[0].fit.method == first.summaries[0].fit.method
        assert cached_reduction(archives, SETTINGS, cache).cached == 1

    def test_of_a_read_only_folder_is_in_the_home(self, folder, tmp_path, monkeypatch):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
        monkeypatch.setattr("os.access", lambda *_: False)
        assert [batch(folder, cache=CacheLocation()).read for _ in range(2)] == [5, 0]
        assert not (folder / "archives" / ".hil-cache").exists()
        assert list((tmp_path / "xdg" / "hil").iterdir())


class TestBroken:
    """Unusable archives do not affect the others."""

    def test_damaged_archives(self, loose):
        """Also the first excitation, with and without cache."""
        intact = batch(loose)
        (truncated, damaged, left) = excitations(loose)
        truncated.write_bytes(truncated.read_bytes()[:-5000])
        (loose / "nothing.mcap").write_bytes(b"")
        (loose / "other.mcap").write_bytes(b"not an archive at all")
        damage(damaged)
        for cache in (CacheLocation(), CacheLocation(), UNCACHED):
            result = batch(loose, cache=cache)
            reasons = reasons_of(result.broken)
            assert set(reasons) == {truncated.name, damaged.name, "nothing.mcap", "other.mcap"}
            assert "repair" in reasons[truncated.name]
            assert fitted(result) == [left.name]
        values = result.repetitions[0].estimate.values
        expected = intact.repetitions[2].estimate.values
        np.testing.assert_allclose(values, expected, **EXACT)

    def test_repaired_copies_are_not_fitted_with_their_originals(self, loose):
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

    @pytest.mark.slow
    def test_archives_that_end_their_process(self, folder):
        names = [path.name for path in excitations(folder)]
        (standstill,) = [path.name for path in (folder / "archives").glob("standstill*")]
        with Cluster(2) as cluster:
            cluster.client(1).register_plugin(Deadly(names[1], standstill))
            result = batch(folder, cluster=cluster)
        assert {*reasons_of(result.broken)} == {names[1], standstill}
        assert fitted(result) == [names[0], names[2]]
        intact = list((folder / "archives").glob("*.mcap"))
        left = [path for path in intact if path.name not in (names[1], standstill)]
        assert bits(batch(*left)) == bits(result)

    def test_nothing_to_fit_is_an_error(self, tmp_path):
        with pytest.raises(InputError, match="'huber' reads samples; use auto, wls, consistent"):
            batch(tmp_path, estimator="huber")
        with pytest.raises(InputError, match="no archive"):
            batch(tmp_path)
        (tmp_path / "bad.mcap").write_bytes(b"")
        with pytest.raises(InputError) as caught:
            batch(tmp_path)
        assert str(caught.value).count("bad.mcap") == 1

    @pytest.mark.parametrize("kinds", [["validation"], ["validation", "standstill"]])
    def test_campaigns_without_excitation(self, campaign, folder, tmp_path, kinds):
        alone = copied(campaign, tmp_path / "alone", *(f"{kind}_000" for kind in kinds))
        with pytest.raises(InputError, match=messages.HOLDS_NO_EXCITATION):
            batch(alone)
        result = batch(alone, folder)
        assert len(result.campaigns) == 1
        assert [(unused.path, unused.message) for unused in result.broken] == [
            (str(alone), "it holds no excitation")
        ]


def test_the_command_exits_with_5_if_archives_are_broken(folder, tmp_path):
    command = ["batch", str(folder), "--workers", "1", "-o", str(tmp_path / "out")]
    command += NOTHING_OPEN
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0, ran.output
    assert "3 repetitions in 1 campaign of 1 arm; 5 recordings read" in ran.output
    assert re.search(r"^\d+ recordings not fitted: .*\d moves", ran.output, re.MULTILINE)
    (folder / "archives" / "bad.mcap").write_bytes(b"")
    ran = CliRunner().invoke(app, [*command, "--json"])
    assert ran.exit_code == 5, ran.output
    printed = json.loads(ran.stdout)
    assert [Path(unused["path"]).name for unused in printed["broken"]] == ["bad.mcap"]
    assert (printed["read"], printed["cached"]) == (0, 5)
    assert all(Path(path).is_file() for path in printed["written"])


CLOCK = "the clock falls back 2 times; cut the log where it does"
ASSUMED = "the torque constants are assumed"
LADEN = "\n[robot.payload]\nmass = 3.0\ncentre = [0.0, 0.0, 0.1]\n"


@pytest.fixture
def record(monkeypatch):
    """Return a function that writes archives of four seconds of motion of a real arm."""

    def make(folder, count, *, first, cell="", **metadata):
        def writer(path, **facts):
            facts["metadata"] = {**facts["metadata"], **metadata}
            text = facts["attachments"]["cell.toml"] + cell.encode()
            facts["attachments"] = facts["attachments"] | {"cell.toml": text}
            return ArchiveWriter(path, **facts)

        monkeypatch.setattr(archive_files, "ArchiveWriter", writer)
        return archive_files.repetitions(folder, count, first=first, cycles=4000)

    return make


class TestWarnings:
    def test_are_printed_and_tabulated(self, record, tmp_path):
        record(tmp_path / "bare", 2, first=0)
        findings = json.dumps({"lines": [], "doubts": [CLOCK]})
        record(tmp_path / "warned", 2, first=2, findings=findings)
        command = ["batch", str(tmp_path), "-v", "--workers", "1", "-o", str(tmp_path / "out")]
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

    def test_name_different_payloads(self, record, tmp_path):
        record(tmp_path / "line" / "a", 1, first=0)
        (laden,) = record(tmp_path / "line" / "b", 1, first=1, cell=LADEN, index="1")
        laden.rename(tmp_path / "line" / "a" / "excitation_001_a1.mcap")
        result = batch(tmp_path)
        (pooled,) = result.pooled
        assert (pooled.repetitions, pooled.setup) == (2, Setup())
        (setups,) = (note for note in pooled.warnings if isinstance(note, DifferentSetups))
        assert sorted(setups.setups) == sorted(each.setup for each in result.campaigns)
        command = ["batch", str(tmp_path), "--cache", "none", "--json", *NOTHING_OPEN]
        (arm,) = json.loads(CliRunner().invoke(app, command).stdout)["arms"].values()
        for setups in (
            [setup_words(campaign.setup) for campaign in result.campaigns],
            [campaign["setup"] for campaign in arm["campaigns"].values()],
        ):
            assert sorted("carries 3 kg" in text for text in setups) == [False, True]


# Discovery


def recording(path, cell, **metadata):
    """Write an archive of a tenth of a second, different for each path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    seed = zlib.crc32(path.as_posix().encode())
    rows = np.random.default_rng(seed).normal(size=(100, len(cell.joint_names)))
    return write_samples(
        path,
        ImportedSamples(np.arange(100) * 1_000_000, rows, torque=rows),
        joint_names=cell.joint_names,
        metadata=metadata,
        attachments={"cell.toml": cell.text.encode(), "robot.urdf": cell.urdf.encode()},
        period=0.001,
        durable=False,
    )


@pytest.fixture(scope="module")
def arm():
    return small()


def test_the_clock_of_an_imported_recording_dates_it(tmp_path, arm):
    path = recording(
        tmp_path / "a.mcap", arm, kind="imported", clock_origin_ns="1773560000000000000"
    )
    (ref,) = found_in(path).refs
    assert ref.when == "2026-03-15T07:33:20+00:00"
    (undated,) = found_in(recording(tmp_path / "b.mcap", arm, kind="imported")).refs
    assert undated.when == ""


class TestPlaces:
    def test_links_are_followed_once_and_loops_end(self, tmp_path, arm):
        real = recording(tmp_path / "store" / "one" / "a.mcap", arm)
        root = tmp_path / "root"
        root.mkdir()
        (root / "first").symlink_to(tmp_path / "store")
        (root / "second").symlink_to(real.parent)
        (real.parent / "up").symlink_to(root)
        result = found_in(root)
        assert [ref.location for ref in result.refs] == [real.as_posix()]
        assert (result.broken, result.skipped) == ((), ())

    def test_what_cannot_be_read_is_reported(self, tmp_path, arm, monkeypatch):
        """Folders, broken links, pipes."""
        recording(tmp_path / "open" / "a.mcap", arm)
        (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere.mcap")
        os.mkfifo(tmp_path / "pipe.mcap")
        closed = tmp_path / "closed"
        closed.mkdir()
        scan = os.scandir

        def refusing(path):
            if Path(path) == closed:
                raise PermissionError(13, "Permission denied", str(path))
            return scan(path)

        monkeypatch.setattr(os, "scandir", refusing)
        result = found_in(tmp_path)
        assert len(result.refs) == 1
        assert {*reasons_of(result.broken)} == {"gone.mcap", "pipe.mcap", "closed"}
        with pytest.raises(InputError, match="closed cannot be read: Permission denied"):
            found_in(closed)


class TestGroups:
    """Which archives are fitted together, and which are skipped."""

    @pytest.mark.parametrize(
        ("old", "new", "setup"),
        [
            (
                "[robot.friction]",
                "[robot.payload]\nmass = 3.0\ncentre = [0.02, 0.0, 0.08]\n\n[robot.friction]",
                "carries 3 kg at (0.02, 0, 0.08) m",
            ),
            ("current_delay_cycles = 0.2", "current_delay_cycles = 3", "torque lags by 3 ms"),
        ],
    )
    def test_stated_delay_or_payload_is_another_campaign(self, old, new, setup, tmp_path, arm):
        assert old in arm.text
        recording(tmp_path / "a.mcap", arm)
        other = Cell.from_texts(arm.text.replace(old, new), arm.urdf, arm.path)
        recording(tmp_path / "b.mcap", other)
        first, second = found_in(tmp_path).refs
        assert (first.arm, first.campaign) == (second.arm, second.campaign)
        assert first.key != second.key
        setups = {ref.name: setup_words(ref.setup) for ref in (first, second)}
        assert setup in setups["b.mcap"]
        assert setup not in setups["a.mcap"]

    def test_copies_rehearsals_and_weighing_runs_are_skipped(self, tmp_path, arm):
        original = recording(tmp_path / "a.mcap", arm)
        (tmp_path / "copy").mkdir()
        shutil.copy(original, tmp_path / "copy" / "b.mcap")
        recording(tmp_path / "payload" / "gripper" / "bare" / "archives" / "x.mcap", arm)
        recording(tmp_path / "payload" / "gripper" / "loaded" / "archives" / "y.mcap", arm)
        recording(tmp_path / "rehearsal" / "archives" / "z.mcap", arm, simulated="yes")
        result = found_in(tmp_path)
        assert [ref.name for ref in result.refs] == ["a.mcap", "x.mcap"]
        assert not result.broken
        assert reasons_of(result.skipped) == {
            "b.mcap": f"is a copy of {original}",
            "y.mcap": messages.PAYLOAD_TO_BE_WEIGHED,
            "z.mcap": "belongs to a rehearsal",
        }

    def test_each_stated_delay_of_a_folder_is_applied(self, loose, tmp_path, monkeypatch):
        victim = excitations(loose)[2]
        other = with_attachment(
            victim, tmp_path / victim.name, "delay_cycles = 0.2", "delay_cycles = 4.2"
        )
        other.replace(victim)
        used = {}
        reduce_one = archive_reduction.reduced_archive

        def spied(wanted, settings):
            used[wanted.ref.name] = settings.preprocessing.torque_delay
            return reduce_one(wanted, settings)

        monkeypatch.setattr(archive_reduction, "reduced_archive", spied)
        result = batch(loose)
        assert not result.broken
        assert [campaign.repetitions for campaign in result.campaigns] == [2, 1]
        assert used.pop(victim.name) == pytest.approx(0.0042)
        assert set(used.values()) == {0.0002}

    def test_newest_intact_accepted_attempt_is_used(self, tmp_path, arm):
        """Truncated ones as a full disk leaves them; of empty ones only the name is known."""
        folder = tmp_path / "c" / "archives"
        paths = {}
        for index in range(6):
            for number in (1, 2):
                path = folder / f"imported_{index:03d}_a{number}.mcap"
                numbers = {"index": str(index), "attempt": str(number)}
                paths[index, number] = recording(path, arm, **numbers)
        for key in ((0, 1), (1, 2), (3, 2)):
            paths[key].write_bytes(paths[key].read_bytes()[:-200])
        paths[2, 1].write_bytes(b"")
        (folder / "move_003_a1.mcap").write_bytes(b"")
        listed = [(1, 1), (0, 2), (2, 2), (3, 1), (4, 1), (4, 2), (5, 1), (5, 2)]
        entries = [
            {
                "name": paths[key].name,
                "outcome": "rejected" if key == (3, 1) else "completed",
                "sha256": "other" if key == (5, 2) else archive_discovery.digest_of(paths[key]),
            }
            for key in listed
        ]
        manifest = json.dumps({"inputs": {}, "archives": entries})
        (tmp_path / "c" / "manifest.json").write_text(manifest)
        result = found_in(tmp_path)
        used = [paths[key].name for key in ((0, 2), (1, 1), (2, 2), (4, 2), (5, 1))]
        assert [ref.name for ref in result.refs] == used
        broken = reasons_of(result.broken)
        assert {*broken} == {paths[key].name for key in ((1, 2), (3, 2), (5, 2))}
        assert "manifest" in broken[paths[5, 2].name]
        assert reasons_of(result.skipped) == {
            paths[3, 1].name: "ended rejected",
            "move_003_a1.mcap": "is a move",
            **{paths[key].name: "was replaced by attempt 2" for key in ((0, 1), (2, 1), (4, 1))},
        }

    def test_damaged_manifests_are_reported(self, folder):
        manifest = folder / "manifest.json"
        manifest.write_text(manifest.read_text()[:-40])
        result = found_in(folder)
        assert len(result.refs) == 6
        (unused,) = result.broken
        assert unused.path == manifest.as_posix()
        assert "damaged" in unused.reason
        assert "without being checked" in unused.reason


class TestMetadata:
    def test_cached_ones_are_valid_until_the_programs_change(self, tmp_path, arm, monkeypatch):
        path = recording(tmp_path / "data" / "a.mcap", arm)
        monkeypatch.setattr(archive_discovery, "_MIN_UNCHANGED_NS", 0)
        time.sleep(0.01)  # then its time stamps are trusted
        opened = []
        read = archive_discovery.open_archive

        def counting(path, **how):
            opened.append(path)
            return read(path, **how)

        monkeypatch.setattr(archive_discovery, "open_archive", counting)
        first = found_in(path, cache=CacheLocation())
        count = len(opened)
        assert found_in(path, cache=CacheLocation()) == first
        assert len(opened) == count
        monkeypatch.setattr(archive_discovery, "code_digest", lambda: "other programs")
        monkeypatch.setattr(archive_discovery, "arm_digest", lambda *_, **__: "another digest")
        (ref,) = found_in(path, cache=CacheLocation()).refs
        assert ref.arm == "another digest"
        assert len(opened) == 2 * count

    def test_of_an_archive_that_changes_while_it_is_read(self, tmp_path, arm, monkeypatch):
        """It is not cached."""
        path = recording(tmp_path / "a.mcap", arm)
        (ref,) = found_in(path).refs
        read = archive_discovery.open_archive

        def written_to(archive, **how):
            path.write_bytes(path.read_bytes()[:-500])
            return read(archive, **how)

        monkeypatch.setattr(archive_discovery, "open_archive", written_to)
        with pytest.raises(ArchiveError, match="was changed"):
            open_ref(ref)
        cache = CacheLocation(str(tmp_path / "cache"))
        assert reduce_archives((ToReduce(ref),), SETTINGS, cache).broken
        assert cached_reduction((ToReduce(ref),), SETTINGS, cache) is None
