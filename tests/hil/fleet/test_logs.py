"""Batches of logs and bags: found, read by one column map, cached; none stops the others."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.fleet import Fault, Fleet, FleetPlan, urdf, write_fleet
from hil.base.errors import InputError
from hil.base.progress import Silent
from hil.batch.cache import CacheLocation
from hil.batch.graph import reidentify
from hil.batch.recording_search import find_recordings
from hil.cli import app
from hil.fleet import logs as fleet_logs
from hil.fleet.logs import LogReading, LogsOfBatch
from hil.identified.identified_arm import arm_from
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.pipeline.options import FIXED
from tests.hil.batch_work import NOTHING_OPEN, Here

pytestmark = pytest.mark.long

FIRST = "2024-01-15.csv"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two robots with two logs each, of which one has more friction in its shoulder."""
    root = tmp_path_factory.mktemp("logs")
    plan = FleetPlan(
        robots=2,
        months=2,
        duration=12.0,
        spread=0.0,
        faults=(Fault(1, "lubricant", 1, 0.0, 0.3),),
    )
    write_fleet(root, Fleet(plan))
    return root


@pytest.fixture
def folder(logs, tmp_path):
    """A copy that may be damaged."""
    copy = tmp_path / "logs"
    shutil.copytree(logs, copy, ignore=shutil.ignore_patterns(".hil-cache"))
    return copy


def robot_of(_):
    return Robot.from_urdf(urdf())


def batch(*places, cache=None, options=FIXED, **reading):
    """Return the result of a batch, and the import of its logs."""
    how = LogReading.of(robot_of, ImportOptions(**reading), "")
    location = CacheLocation(None if cache is None else str(cache))
    importing = LogsOfBatch(how, location, Here(), Silent())
    names = [str(place) for place in places]
    result = reidentify(names, options, Here(), Silent(), cache=location, importing=importing)
    return result, importing


def broken(result):
    return {Path(unused.path).name: unused.message for unused in result.broken}


class TestFound:
    """Which files are logs."""

    def found(self, *places, others=()):
        importing = LogsOfBatch(None, CacheLocation(), None, Silent(), frozenset(others))
        return [
            str(Path(each).relative_to(self.root))
            for each in find_recordings([str(place) for place in places], importing).logs
        ]

    @pytest.fixture(autouse=True)
    def _tree(self, tmp_path, monkeypatch):
        """Logs of robots, and files that are none."""
        self.root = tmp_path.resolve()
        monkeypatch.chdir(tmp_path)
        for name in (
            *("a/one.csv", "a/two.npz", "b/deep/three.txt", "b/picture.png", ".hil-cache/x.csv"),
            *("result/results.json", "result/errors.csv", "tables/parameters.parquet"),
            *("tables/parameters.csv", "bag/metadata.yaml", "bag/bag_0.mcap"),
            *("quantities/q.txt", "quantities/tau.txt", "quantities/dq.txt"),
        ):
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()

    def test_below_a_folder(self):
        """Bags and folders with a file for each quantity are one recording each."""
        assert self.found(".") == [
            "a/one.csv",
            "a/two.npz",
            "b/deep/three.txt",
            "bag",
            "quantities",
        ]

    @pytest.mark.parametrize(
        ("pattern", "names"),
        [
            ("a/*.csv", ["a/one.csv"]),
            ("**/*.txt", ["b/deep/three.txt", "quantities/dq.txt", "quantities/q.txt",
                          "quantities/tau.txt"]),
            ("b*", ["b/deep/three.txt", "bag"]),
        ],
    )  # fmt: skip
    def test_by_a_pattern(self, pattern, names):
        assert self.found(pattern) == names

    @pytest.mark.parametrize("places", [["a"], ["a/*.csv", "a/*.npz"]])
    def test_conditions_and_tables_of_quantities_are_none(self, places):
        """Also of a pattern that matches them."""
        (self.root / "a" / "hall.csv").write_text("when,ambient\n2026-03-15,21.5\n")
        (self.root / "a" / "trend.csv").write_text("robot,joint,quantity,when,value\n")
        found = self.found(*places, others=[self.root / "a" / "hall.csv"])
        assert found == ["a/one.csv", "a/two.npz"]

    def test_a_pattern_that_matches_nothing_is_refused(self):
        with pytest.raises(InputError, match=r"c\*\.csv: matches no file"):
            self.found("a", "c*.csv")

    def test_a_log_named_without_its_arm_is_refused(self):
        with pytest.raises(InputError, match=r"one.csv: is not an archive.*add --urdf"):
            find_recordings(["a/one.csv"])


class TestRead:
    """One map for all, and a reason for each that cannot be read."""

    def test_estimates_are_those_of_an_identification(self, logs, tmp_path):
        """Every log by one map; numbers of `hil identify` on the same logs."""
        places = sorted((logs / "robot01").glob("*.csv"))
        result, importing = batch(*places, cache=tmp_path, options=FIXED)
        (log_map,) = importing.maps
        assert (log_map.first, importing.maps[log_map]) == (str(places[0]), 2)
        options = replace(FIXED, in_sample=True)
        arm = arm_from(places, urdf(), None, (), None, options, None)
        (campaign,) = result.campaigns
        np.testing.assert_allclose(
            campaign.estimate.values, arm.identification.estimate.pooled.values, rtol=1e-6
        )

    def test_campaigns_are_folders_with_the_dates_of_clocks(self, logs, tmp_path):
        result, _ = batch(logs, cache=tmp_path)
        assert [(Path(each.campaign).name, each.when[:10]) for each in result.campaigns] == [
            ("robot00", "2024-01-15"),
            ("robot01", "2024-01-15"),
        ]
        by_date = sorted(path.name for path in (logs / "robot00").glob("*.csv"))
        assert [Path(each.archive).name for each in result.repetitions[:2]] == by_date

    def test_none_stops_the_others(self, folder):
        """Unreadable, short, still, of other channels, without torque: each has its reason."""
        first = (folder / "robot00" / FIRST).read_text()
        lines = first.splitlines()
        (folder / "robot00" / "cut.csv").write_text("\n".join(lines[:20]))
        (folder / "robot01" / "empty.csv").write_text(lines[0] + "\n")
        (folder / "notes.txt").write_text("nothing measured\n")
        (folder / "other.csv").write_text(first.replace("tau", "current"))
        (folder / "broken.npz").write_bytes(b"PK\3\4 is no archive of numpy")
        result, _ = batch(folder)
        reasons = broken(result)
        assert len(result.repetitions) == 4
        assert reasons.keys() == {"cut.csv", "empty.csv", "notes.txt", "other.csv", "broken.npz"}
        assert "too few to identify from" in reasons["cut.csv"]
        assert "no row of numbers" in reasons["empty.csv"]
        assert "torque" in reasons["other.csv"]
        assert "cannot be read" in reasons["broken.npz"]

    def test_the_first_may_be_the_unreadable_one(self, folder):
        (folder / "a.csv").write_text("t,q1\n")
        result, importing = batch(folder)
        assert (len(result.repetitions), [*broken(result)]) == (4, ["a.csv"])
        (log_map,) = importing.maps
        assert Path(log_map.first).name == FIRST

    def test_a_copy_counts_once(self, folder):
        """Under another name, and of another robot."""
        first = folder / "robot00" / FIRST
        shutil.copy(first, folder / "robot00" / "latest.csv")
        shutil.copy(first, folder / "robot01" / "2024-07-01.csv")
        result, _ = batch(folder)
        assert len(result.repetitions) == 4
        names = ("latest.csv", "2024-07-01.csv")
        reasons = {Path(each.path).name: each.message for each in result.skipped}
        assert reasons == dict.fromkeys(names, f"is a copy of {first}")

    def test_logs_with_other_channels_have_a_map_of_their_own(self, folder):
        for path in (folder / "robot01").glob("*.csv"):
            text = path.read_text()
            path.write_text(text.replace("qd", "velocity").replace("tau", "torque_"))
        result, importing = batch(folder)
        assert (len(result.repetitions), len(importing.maps)) == (4, 2)

    def test_a_stated_map_is_for_all(self, folder, tmp_path):
        joints = '[position]\ncolumns = "q{}"\n[torque]\ncolumns = "tau{}"\n'
        text = f'[time]\ncolumn = "timestamp"\n{joints}'
        column_map = tmp_path / "map.toml"
        column_map.write_text(text)
        other = folder / "robot01" / FIRST
        other.write_text(other.read_text().replace("tau", "torque_"))
        result, importing = batch(folder, columns=column_map)
        assert [each.text for each in importing.maps] == [text]
        assert "tau" in broken(result)[FIRST]
        column_map.write_text("[time]\ncolumn = 3.5\n")
        with pytest.raises(InputError, match=r"map\.toml"):
            batch(folder, columns=column_map)

    def test_logs_and_archives_together(self, folder, campaign, tmp_path):
        result, _ = batch(folder, campaign.folder.root, cache=tmp_path / "cache")
        assert {Path(each.archive).suffix for each in result.repetitions} == {".csv", ".mcap"}
        assert len(result.arms) == 2


def settle():
    """Let files become old enough for their time stamps to show the next change."""
    time.sleep(2.1)


class TestCached:
    """Only what is new is read."""

    def test_only_a_new_log_is_read(self, folder, tmp_path, monkeypatch):
        cache = tmp_path / "cache"
        settle()
        batch(folder, cache=cache)
        time.sleep(0.01)
        shutil.copy(folder / "robot00" / FIRST, folder / "robot00" / "new.csv")
        text = (folder / "robot00" / "new.csv").read_text()
        (folder / "robot00" / "new.csv").write_text(text.rsplit("\n", 100)[0] + "\n")
        read = []
        by_map = fleet_logs.read_by_map
        monkeypatch.setattr(
            fleet_logs,
            "read_by_map",
            lambda *a, **k: read.append(a[0].source.name) or by_map(*a, **k),
        )
        monkeypatch.setattr(fleet_logs, "read_recording", None)  # no map is concluded again
        result, importing = batch(folder, cache=cache)
        assert read == ["new.csv"]
        assert (result.read, result.cached, [*importing.maps.values()]) == (1, 4, [5])

    def test_a_changed_log_is_read_again(self, folder, tmp_path):
        cache = tmp_path / "cache"
        settle()
        before, _ = batch(folder / "robot00", cache=cache)
        changed = folder / "robot00" / FIRST
        shutil.copy(folder / "robot01" / FIRST, changed)
        after, _ = batch(folder / "robot00", cache=cache)
        pairs = zip(before.repetitions, after.repetitions, strict=True)
        same = [bool(np.array_equal(a.estimate.values, b.estimate.values)) for a, b in pairs]
        assert same[0] is False
        assert (after.read, after.cached) == (1, 1)


class TestCommand:
    """`hil batch LOGS... --urdf ARM.urdf`."""

    def test_tables_map_and_reasons(self, folder, tmp_path):
        (folder / "notes.csv").write_text("nothing measured\n")
        out = tmp_path / "tables"
        arguments = ["--urdf", str(urdf()), "-o", str(out), "--cache", "none"]
        arguments += ["--torque-bandwidth", "none"]
        pattern = str(folder / "**" / "*.csv")
        done = CliRunner().invoke(app, ["batch", pattern, *arguments, *NOTHING_OPEN])
        assert done.exit_code == 5, done.output
        assert "4 logs read by the column map inferred from" in done.stdout
        assert "notes.csv could not be used: " in done.stderr
        assert "1 failed" in done.stdout
        assert 'columns = "tau{}"' in (out / "map.toml").read_text()
        assert not list(folder.rglob(".hil-cache"))

    def test_a_folder_of_logs_alone_names_the_option_that_reads_it(self, folder, tmp_path):
        words = ["batch", str(folder), "--cache", "none", "-o", str(tmp_path / "tables")]
        refused = CliRunner().invoke(app, words)
        assert "--urdf ARM.urdf" in str(refused.exception)
        done = CliRunner().invoke(app, [*words, "--urdf", str(urdf()), *NOTHING_OPEN])
        assert "4 logs read by the column map inferred from" in done.stdout

    def test_options_of_logs_need_the_arm(self, folder):
        done = CliRunner().invoke(app, ["batch", str(folder), "--drop-missing", "--json"])
        refusal = json.loads(done.stdout)
        assert (refusal["exit_code"], refusal["field"]) == (2, "--drop-missing")
