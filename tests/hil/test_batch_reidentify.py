"""`hil reidentify`: the numbers of `hil identify`, whoever computes them and in whatever order."""

from __future__ import annotations

import csv
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import archive_files
from hil.archive import ArchiveWriter
from hil.archive.repair import repair, repaired_name
from hil.batch import factors
from hil.batch.cache import Store
from hil.batch.estimates import warning_lines
from hil.batch.run import Plan, reidentify
from hil.batch.types import (
    ESTIMATORS,
    ArchiveRef,
    BatchEstimator,
    BatchResult,
    Broken,
    NothingToFitError,
)
from hil.batch.workers import LocalWorkers
from hil.campaign import Campaign
from hil.cell import Cell
from hil.cli import app
from hil.cli.reidentify import alarm_lines, skipped_line
from hil.compare.trend import Trends
from hil.errors import InputError
from hil.identify import Options, identify_campaign
from hil.identify.deciding import Decided, decide
from hil.identify.estimating import estimate_with
from hil.identify.options import FIXED
from hil.identify.prepared import prepare_sources
from hil.identify.sources import Sources, gather_sources
from hil.progress import Reporter, Silent
from identification.estimators.shrinkage import Shrinkage

from .arm_histories import Load, steady, trend_of
from .batch_workers import NOTHING_OPEN, Here

EXACT = {"rtol": 1e-9, "atol": 0.0}


def batch(
    *places: Path, plan: Plan | None = None, workers: Here | LocalWorkers | None = None
) -> BatchResult:
    return reidentify(
        [str(place) for place in places], plan or Plan(FIXED), workers or Here(), Silent()
    )


def archives(campaign: Campaign) -> list[Path]:
    kinds = ("excitation", "validation", "standstill")
    return [path for kind in kinds for path in campaign.folder.completed(kind)]


@pytest.fixture
def folder(campaign: Campaign, tmp_path: Path) -> Path:
    """A copy of the campaign, to be damaged."""
    copy = tmp_path / "campaign"
    shutil.copytree(campaign.folder.root, copy, ignore=shutil.ignore_patterns(".hil-cache"))
    return copy


@pytest.fixture(scope="module")
def found(campaign: Campaign, tmp_path_factory: pytest.TempPathFactory) -> BatchResult:
    return batch(campaign.folder.root, plan=Plan(FIXED, cache=tmp_path_factory.mktemp("cache")))


def same_bits(first: BatchResult, second: BatchResult) -> bool:
    def bits(result: BatchResult) -> list[bytes]:
        levels = (*result.repetitions, *result.campaigns, *result.pooled)
        return [one.values.tobytes() + one.std.tobytes() for one in levels]

    return bits(first) == bits(second)


# The numbers


def test_campaign_and_repetitions_are_those_of_hil_identify(campaign: Campaign) -> None:
    """With the options that either has by default, which choose the settings."""
    one = identify_campaign(campaign.folder.root, Silent()).estimate
    found = batch(campaign.folder.root, plan=Plan(keep=False))
    (level,) = found.campaigns
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


def test_what_is_drawn_towards_a_machine_is_that_of_hil_identify(
    campaign: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Repetitions too, towards the machine of all; of their intervals only the words."""

    def drawn(sources: Sources, options: Options, reporter: Reporter) -> Decided:
        found = decide(sources, FIXED, reporter)
        return found._replace(settings=replace(found.settings, shrinkage=Shrinkage(0.1)))

    monkeypatch.setattr("hil.identify.prepared.decide", drawn)
    monkeypatch.setattr("hil.batch.run.decide", drawn)
    options = replace(FIXED, estimator="auto")
    prepared = prepare_sources(gather_sources(archives(campaign), 0.7), options, Silent())
    one = estimate_with(prepared, options, Silent()).result
    found = batch(campaign.folder.root, plan=Plan(options, keep=False))
    np.testing.assert_allclose(found.campaigns[0].values, one.pooled.values, **EXACT)
    np.testing.assert_allclose(found.campaigns[0].std, one.pooled.std, **EXACT)
    for mine, own in zip(found.repetitions, one.repetitions, strict=True):
        np.testing.assert_allclose(mine.values, own.values, **EXACT)
        assert mine.method == own.method


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_gives_what_it_gives_with_samples(
    name: BatchEstimator, campaign: Campaign, tmp_path: Path
) -> None:
    prepared = prepare_sources(gather_sources(archives(campaign), 0.7), FIXED, Silent())
    one = estimate_with(prepared, replace(FIXED, estimator=name), Silent()).result
    (level,) = batch(
        campaign.folder.root, plan=Plan(replace(FIXED, estimator=name), cache=tmp_path)
    ).campaigns
    # The program of the consistent estimate stops at its own tolerance.
    close = {"rtol": 1e-4, "atol": 1e-4} if name == "consistent" else {"rtol": 1e-8, "atol": 1e-12}
    np.testing.assert_allclose(level.values, one.pooled.values, **close)
    np.testing.assert_allclose(level.std, one.pooled.std, rtol=1e-8)


def test_the_error_on_unseen_motion_is_that_of_the_samples(
    campaign: Campaign, found: BatchResult
) -> None:
    prepared = prepare_sources(gather_sources(archives(campaign), 0.7), FIXED, Silent())
    (level,) = found.campaigns
    model = prepared.sources.cell.model
    squares, rows = np.zeros(6), np.zeros(6)
    for samples in prepared.held_out:
        error = samples.torque - samples.predicted_torque(model, level.values)
        squares += np.where(samples.usable, error**2, 0.0).sum(axis=0)
        rows += samples.usable.sum(axis=0)
    np.testing.assert_allclose(level.unseen_rms, np.sqrt(squares / rows), rtol=1e-6)


def test_pooled_over_one_campaign_is_that_campaign(found: BatchResult) -> None:
    assert found.pooled[0].values.tobytes() == found.campaigns[0].values.tobytes()
    assert (found.pooled[0].level, found.pooled[0].campaign) == ("pooled", "")


def test_campaigns_of_an_arm_are_pooled(
    campaign: Campaign, found: BatchResult, tmp_path: Path
) -> None:
    """In two folders, each with the standstill: pooled they are what they were in one."""
    for name, wanted in (("first", "excitation_000"), ("second", "excitation_00[12]")):
        (tmp_path / name).mkdir()
        for pattern in (wanted, "standstill"):
            for path in campaign.folder.archives.glob(f"{pattern}*.mcap"):
                shutil.copy(path, tmp_path / name / path.name)
    result = batch(tmp_path, plan=Plan(FIXED, keep=False))
    assert [one.repetitions for one in result.campaigns] == [1, 2]
    assert [one.repetitions for one in result.pooled] == [3]
    # Other sums of the same terms: rounding, in parameters that are hardly known.
    apart = result.pooled[0].values - found.pooled[0].values
    assert np.abs(apart / found.pooled[0].std).max() < 1e-6
    np.testing.assert_allclose(result.pooled[0].std, found.pooled[0].std, rtol=1e-6)


def test_settings_are_decided_once_for_each_arm(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the first campaign that can be read; the noise of the positions is each one's own."""
    names = ("excitation_000", "excitation_001", "excitation_002", "standstill")
    for folder, wanted in (("a", names[:1]), ("b", names[1:2]), ("c", names[2:])):
        (tmp_path / folder).mkdir()
        for name in wanted:
            (path,) = campaign.folder.archives.glob(f"{name}*.mcap")
            shutil.copy(path, tmp_path / folder / path.name)
    damaged = bytearray((tmp_path / "a" / "excitation_000_a1.mcap").read_bytes())
    middle = len(damaged) // 2
    damaged[middle : middle + 2000] = bytes(2000)
    (tmp_path / "a" / "excitation_000_a1.mcap").write_bytes(damaged)
    read: list[list[str]] = []

    def spied(sources: Sources, options: Options, reporter: Reporter) -> Decided:
        read.append([source.name for source in sources.training])
        return decide(sources, options, reporter)

    monkeypatch.setattr("hil.batch.run.decide", spied)
    found = batch(tmp_path, plan=Plan(replace(FIXED, friction="auto"), keep=False))
    assert read == [["excitation_001_a1.mcap"]]
    assert [Path(one.campaign).name for one in found.campaigns] == ["b", "c"]
    assert found.campaigns[0].settings != found.campaigns[1].settings
    assert found.pooled[0].repetitions == 2


def test_a_copy_counts_once(campaign: Campaign, tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        for path in campaign.folder.completed("excitation"):
            shutil.copy(path, tmp_path / name / path.name)
    result = batch(tmp_path, plan=Plan(FIXED, keep=False))
    assert result.pooled[0].repetitions == 3
    assert len([one for one in result.skipped if "holds the same" in one.reason]) == 3


@pytest.mark.slow
def test_workers_order_and_cache_make_no_difference_to_the_last_bit(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor whether bundles are added up here, or runs of them far away."""
    monkeypatch.setattr(factors, "BUNDLE", 1)
    with LocalWorkers(2) as workers:
        alone = batch(folder, plan=Plan(FIXED, keep=False), workers=workers)
    files = sorted((folder / "archives").glob("*.mcap"), reverse=True)
    assert same_bits(alone, batch(*files, plan=Plan(FIXED, keep=False)))
    monkeypatch.setattr("hil.batch.run._MANY", 0)
    far = Here(near=False)
    assert same_bits(alone, batch(folder, plan=Plan(FIXED, keep=False), workers=far))
    assert max(task.size for task in far.tasks) == 5
    cached = Plan(FIXED, cache=tmp_path / "cache")
    assert same_bits(alone, batch(folder, plan=cached))
    assert same_bits(alone, batch(folder, plan=cached))


# What is told of it meanwhile


class Listening(Silent):
    """Keeps how far each task came; one at a time, as bars are."""

    def __init__(self) -> None:
        self.done: dict[str, float] = {}
        self.totals: dict[str, float] = {}
        self._open = ""

    @contextmanager
    def task(self, title: str, total: float) -> Iterator[Listening]:
        assert not self._open
        self._open, self.totals[title] = title, total
        yield self
        self._open = ""

    def advance(self, units: float, note: str = "") -> None:
        self.done[self._open] = self.done.get(self._open, 0.0) + units


@pytest.mark.parametrize("near", [True, False])
def test_all_work_on_archives_is_reported_to_its_end(near: bool, folder: Path) -> None:
    told = Listening()
    reidentify([str(folder)], Plan(FIXED, keep=False), Here(near=near), told)
    assert told.done == pytest.approx(told.totals)
    assert told.totals["looking into archives"] == len(list(folder.rglob("*.mcap")))
    assert told.totals["reading archives and estimating"] == 5  # all but the standstill


def test_a_crash_far_away_is_told_below_the_one_bar(folder: Path) -> None:
    names = [path.name for path in sorted((folder / "archives").glob("excitation*"))]
    told = Listening()
    workers = Here(names[1], near=False)
    assert reidentify([str(folder)], Plan(FIXED, keep=False), workers, told).broken


# What is kept


def test_a_second_run_with_another_estimator_opens_no_archive(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long_ago = time.time() - 100.0
    for path in (folder / "archives").glob("*.mcap"):
        os.utime(path, (long_ago, long_ago))
    monkeypatch.setattr("hil.batch.discovery._UNTOUCHED", 0)
    first = batch(folder)
    assert (first.read, first.cached) == (5, 0)

    def never(*_: object, **__: object) -> None:
        raise AssertionError("an archive was opened")

    monkeypatch.setattr(factors, "open_archive", never)
    monkeypatch.setattr("hil.batch.discovery.open_archive", never)
    workers = Here()
    second = batch(folder, plan=Plan(replace(FIXED, estimator="ols")), workers=workers)
    assert (second.read, second.cached, workers.tasks) == (0, 5, [])
    assert "ordinary" in second.campaigns[0].method


def test_a_longer_campaign_reads_only_what_is_new(folder: Path) -> None:
    archive = sorted((folder / "archives").glob("excitation_002*"))[0]
    away = folder.parent / archive.name
    archive.rename(away)
    assert batch(folder).read == 4
    away.rename(archive)
    longer = batch(folder)
    assert longer.read == 1
    assert same_bits(longer, batch(folder, plan=Plan(FIXED, keep=False)))


def test_other_settings_are_other_factors(folder: Path) -> None:
    batch(folder)
    assert batch(folder, plan=Plan(replace(FIXED, delay=0.002))).read == 5


def test_damaged_entries_are_made_anew_and_never_believed(folder: Path) -> None:
    whole = batch(folder)
    kept = [path for path in (folder / "archives" / ".hil-cache").rglob("*") if path.is_file()]
    random = np.random.default_rng(1)
    for path in kept:
        data = bytearray(path.read_bytes())
        data[random.integers(len(data))] ^= 1 << random.integers(8)
        path.write_bytes(data)
    again = batch(folder)
    assert again.read == 5
    assert same_bits(whole, again)
    for path in kept:
        if path.exists():
            path.write_bytes(path.read_bytes()[:-1])
    assert same_bits(whole, batch(folder))


def test_entries_that_are_whole_and_hold_something_else_count_as_absent(folder: Path) -> None:
    whole = batch(folder)
    store = Store(folder / "archives" / ".hil-cache")
    keys = [path.name for path in (folder / "archives" / ".hil-cache").rglob("*") if path.is_file()]
    assert len(keys) > 5
    for content in ({}, {"sum": [], "total": 3, "facts": None}):
        for key in keys:
            store.put(key, content)
        assert same_bits(whole, batch(folder))


def test_a_read_only_folder_is_kept_elsewhere(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setattr("os.access", lambda *_: False)
    assert batch(folder).read == 5
    assert batch(folder).read == 0
    assert not (folder / "archives" / ".hil-cache").exists()
    assert list((tmp_path / "xdg" / "hil").iterdir())


def test_nothing_is_left_behind_without_a_cache(folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    batch(folder, plan=Plan(FIXED, keep=False))
    assert sorted(folder.rglob("*")) == before


# What is broken


def test_broken_archives_are_listed_and_cost_only_themselves(folder: Path) -> None:
    whole = batch(folder, plan=Plan(FIXED, keep=False))
    names = [path.name for path in sorted((folder / "archives").glob("excitation*"))]
    loose = folder / "loose"
    loose.mkdir()
    for path in (folder / "archives").glob("*.mcap"):
        shutil.copy(path, loose / path.name)
    shutil.rmtree(folder / "archives")
    (folder / "manifest.json").unlink()
    torn = loose / names[1]
    torn.write_bytes(torn.read_bytes()[:-5000])
    (loose / "nothing.mcap").write_bytes(b"")
    (loose / "other.mcap").write_bytes(b"not an archive at all")
    flipped = bytearray((loose / names[2]).read_bytes())
    middle = len(flipped) // 2
    flipped[middle : middle + 2000] = bytes(2000)
    (loose / names[2]).write_bytes(flipped)
    for plan in (Plan(FIXED), Plan(FIXED), Plan(FIXED, keep=False)):
        result = batch(folder, plan=plan)
        reasons = {Path(one.path).name: one.reason for one in result.broken}
        assert set(reasons) == {names[1], names[2], "nothing.mcap", "other.mcap"}
        assert "repair" in reasons[names[1]]
        assert len(result.repetitions) == 1
    np.testing.assert_allclose(result.repetitions[0].values, whole.repetitions[0].values, **EXACT)


def test_a_broken_first_excitation_costs_only_itself(folder: Path) -> None:
    (folder / "manifest.json").unlink()
    first, *others = sorted((folder / "archives").glob("excitation*"))
    damaged = bytearray(first.read_bytes())
    middle = len(damaged) // 2
    damaged[middle : middle + 2000] = bytes(2000)
    first.write_bytes(damaged)

    result = batch(folder, plan=Plan(FIXED, keep=False))

    assert [Path(one.path).name for one in result.broken] == [first.name]
    assert len(result.repetitions) == len(others)


def test_a_repaired_copy_is_not_fitted_beside_its_original(folder: Path) -> None:
    """One wrong bit in an index, which we do not need, makes the two files differ."""
    (folder / "manifest.json").unlink()
    whole = sorted((folder / "archives").glob("excitation*"))
    data = bytearray(whole[0].read_bytes())
    at = 8
    while data[at] != 0x07:  # MessageIndex
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    data[at + 20] ^= 1
    whole[0].write_bytes(data)
    repair(whole[0])
    assert repaired_name(whole[0]).read_bytes() != bytes(data)

    result = batch(folder, plan=Plan(FIXED, keep=False))

    assert not result.broken
    assert len(result.repetitions) == len(whole)


def test_a_file_that_is_not_what_was_recorded_is_not_used(folder: Path) -> None:
    victim, other = sorted((folder / "archives").glob("excitation*"))[:2]
    shutil.copy(other, victim)
    result = batch(folder, plan=Plan(FIXED, keep=False))
    assert [Path(one.path).name for one in result.broken] == [victim.name]
    assert "manifest" in result.broken[0].reason


@pytest.mark.parametrize("near", [True, False])
def test_an_archive_that_ends_its_process_costs_itself(
    near: bool, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not near:  # in a run of bundles
        monkeypatch.setattr(factors, "BUNDLE", 2)
        monkeypatch.setattr("hil.batch.run._MANY", 0)
    names = [path.name for path in sorted((folder / "archives").glob("excitation*"))]
    result = batch(
        folder, plan=Plan(FIXED, cache=tmp_path / "cache"), workers=Here(names[1], near=near)
    )
    assert [Path(one.path).name for one in result.broken] == [names[1]]
    assert [Path(one.archive).name for one in result.repetitions] == [names[0], names[2]]
    left = [path for path in (folder / "archives").glob("*.mcap") if path.name != names[1]]
    assert same_bits(result, batch(*left, plan=Plan(FIXED, keep=False)))


def test_a_standstill_that_ends_its_process_costs_itself(folder: Path, tmp_path: Path) -> None:
    (name,) = [path.name for path in (folder / "archives").glob("standstill*")]
    result = batch(folder, plan=Plan(FIXED, cache=tmp_path), workers=Here(name))
    assert name in [Path(one.path).name for one in result.broken]
    assert len(result.repetitions) == 3


def test_nothing_to_fit_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(NothingToFitError, match="no archive"):
        batch(tmp_path)
    (tmp_path / "bad.mcap").write_bytes(b"")
    with pytest.raises(NothingToFitError) as caught:
        batch(tmp_path)
    assert str(caught.value).count("bad.mcap") == 1
    (tmp_path / "worse.mcap").write_bytes(b"x")
    with pytest.raises(NothingToFitError, match=r"2 could not be used, the first of them \S+bad"):
        batch(tmp_path)


def test_a_campaign_of_validation_alone_costs_only_itself(folder: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    shutil.copy(folder / "archives" / "validation_000_a1.mcap", alone)
    with pytest.raises(NothingToFitError, match="alone could not be used: it holds no excitation"):
        batch(alone)
    found = batch(alone, folder)
    assert len(found.campaigns) == 1
    assert [(broken.path, broken.reason) for broken in found.broken] == [
        (str(alone), "it holds no excitation")
    ]


# The command


def test_the_command_lists_what_is_broken_and_says_so_in_its_status(
    folder: Path, tmp_path: Path
) -> None:
    command = ["reidentify", str(folder), "--workers", "1", "-o", str(tmp_path / "out")]
    command += NOTHING_OPEN
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0, ran.output
    assert "3 repetitions in 1 campaign of 1 arm; 5 archives read" in ran.output
    (folder / "archives" / "bad.mcap").write_bytes(b"")
    ran = CliRunner().invoke(app, [*command, "--json"])
    assert ran.exit_code == 5, ran.output
    told = json.loads(ran.stdout)
    assert [Path(one["path"]).name for one in told["broken"]] == ["bad.mcap"]
    assert (told["read"], told["cached"]) == (0, 5)
    assert all(Path(path).is_file() for path in told["written"])


def test_the_command_runs_with_the_options_it_has_by_default(folder: Path) -> None:
    """What is left out is decided by the data, the friction law too."""
    ran = CliRunner().invoke(app, ["reidentify", str(folder), "--workers", "1", "--cache", "none"])
    assert ran.exit_code == 0, ran.output
    assert "3 repetitions in 1 campaign of 1 arm" in ran.output


def test_the_command_needs_a_place_with_archives(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "missing"):
        ran = CliRunner().invoke(app, ["reidentify", str(place)])
        assert isinstance(ran.exception, InputError)
        assert ran.exception.exit_code == 2


# What is said of archives: warnings, what their cells state, and what was left alone

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
        metadata: Mapping[str, str] = MappingProxyType({}),
    ) -> list[Path]:
        plain = Cell.load(archive_files.CELL_PATH)

        def writer(path: Path, **facts: Any) -> ArchiveWriter:
            facts["metadata"] = {**facts["metadata"], **metadata}
            text = facts["attachments"]["cell.toml"] + cell.encode()
            facts["attachments"] = facts["attachments"] | {"cell.toml": text}
            return ArchiveWriter(path, **facts)

        assert plain.file.robot.payload is None
        monkeypatch.setattr(archive_files, "ArchiveWriter", writer)
        return archive_files.repetitions(folder, count, first=first, cycles=4000)

    return make


def test_doubts_of_import_and_of_torque_constants_stand_with_every_estimate(
    record: Record, tmp_path: Path
) -> None:
    record(tmp_path / "plain", 2, first=0)
    findings = json.dumps({"lines": [], "doubts": [SLIP]})
    record(tmp_path / "slipped", 2, first=2, metadata={"findings": findings})
    command = ["reidentify", str(tmp_path), "--workers", "1", "-o", str(tmp_path / "out")]
    ran = CliRunner().invoke(app, [*command, "--cache", "none", *NOTHING_OPEN])
    assert ran.exit_code == 0, ran.output
    assert f"note: {ASSUMED}" in ran.output
    told = f"2 of 4 archives, such as slipped/excitation_000_a1.mcap: {SLIP}"
    assert f"note: {told}" in ran.output
    with (tmp_path / "out" / "parameters.csv").open(newline="") as file:
        doubts = {
            (row["level"], Path(row["campaign"]).name): row["warnings"]
            for row in csv.DictReader(file)
        }
    assert all(ASSUMED in text for text in doubts.values())
    assert [SLIP in doubts[level, "slipped"] for level in ("repetition", "campaign")] == [True] * 2
    assert [SLIP in doubts[level, "plain"] for level in ("repetition", "campaign")] == [False] * 2
    assert told in doubts["pooled", ""]
    page = (tmp_path / "out" / "trend.html").read_text()
    assert SLIP in page


def test_one_folder_in_which_a_payload_is_stated_halfway_is_two_campaigns(
    record: Record, tmp_path: Path
) -> None:
    record(tmp_path / "line" / "a", 1, first=0)
    (laden,) = record(tmp_path / "line" / "b", 1, first=1, cell=LADEN, metadata={"index": "1"})
    laden.rename(tmp_path / "line" / "a" / "excitation_001_a1.mcap")
    found = batch(tmp_path, plan=Plan(FIXED, keep=False))
    assert len(found.campaigns) == 2
    stated = {None if one.payload is None else one.payload.mass for one in found.campaigns}
    assert stated == {None, 3.0}
    (pooled,) = found.pooled
    assert (pooled.repetitions, pooled.setup, pooled.payload) == (2, "", None)
    assert "cells state different things" in pooled.warnings[0]
    command = ["reidentify", str(tmp_path), "--cache", "none", "--json", *NOTHING_OPEN]
    ran = CliRunner().invoke(app, command)
    (arm,) = json.loads(ran.stdout)["arms"].values()
    assert len(arm["campaigns"]) == 2
    assert sum("carries 3 kg" in one["setup"] for one in arm["campaigns"].values()) == 1


def test_what_is_to_be_looked_into_is_told_even_quietly() -> None:
    arm = trend_of(lambda k, random: replace(steady(k, random), load=Load(2.0 * k)), 2)
    calm = trend_of(steady, 2)
    (line,) = alarm_lines(Trends((calm, arm), (), "wls", 4))
    assert line.startswith("arm: The payload has changed")


def test_a_warning_is_given_once_with_what_it_concerns() -> None:
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
    many = warning_lines([warned(f"{k}", f"the clock falls back {k} times") for k in range(100)])
    assert len(many) < 20
    assert "more warnings stand with the repetitions" in many[-1]


def test_what_is_left_alone_is_counted_by_reason() -> None:
    reasons = [
        "is a move",
        "is a move",
        "ended aborted",
        "attempt 2 took its place",
        "attempt 3 took its place",
        "holds the same as /data/line/excitation_000_a1.mcap",
    ]
    line = skipped_line([Broken(f"{k}.mcap", one) for k, one in enumerate(reasons)])
    assert line == (
        "left alone, as not meant to be fitted: 2 moves; 2: a later attempt took its place;"
        " 1: ended aborted; 1: holds the same as another"
    )
    assert skipped_line([]) == ""
