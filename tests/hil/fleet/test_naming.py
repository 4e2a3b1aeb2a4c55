"""Of which robot a recording is, and when it was made."""

from __future__ import annotations

import os
from datetime import UTC, datetime

import numpy as np
import pytest

from benchmarks.fleet import Fleet, FleetPlan, urdf, write_fleet
from hil.base.errors import InputError
from hil.base.progress import Silent
from hil.batch.archive_discovery import ArchiveRef
from hil.batch.cache import CacheLocation
from hil.batch.graph import reidentify
from hil.fleet.extra_channels import ExtraChannels, facts_of
from hil.fleet.logs import LogReading, LogsOfBatch
from hil.fleet.naming import RobotNaming, date_in
from hil.importers.imported_robot import Robot
from hil.importers.log_files import LogFiles
from hil.importers.recording_import import ImportOptions
from hil.pipeline.options import FIXED
from tests.hil.batch_work import Here


def ref(origin, **known):
    values = {"when": "", "arm": "type", "campaign": origin.rsplit("/", 1)[0], **known}
    return ArchiveRef(
        location="cached.recording", sha256="", use="excitation", index=0, cell="", motion="",
        source=origin, **values,
    )  # fmt: skip


def placed(spec, origin, **known):
    return RobotNaming.parse(spec).place(ref(origin, **known))


class TestRobot:
    @pytest.mark.parametrize(
        ("spec", "origin", "robot"),
        [
            ("{robot}/{date}.csv", "/data/line/r04/2026-03-15.csv", "r04"),
            ("data/{robot}/**/*.csv", "/data/r04/a/b/log.csv", "r04"),
            ("data/{robot}/**/*.csv", "/data/r04/log.csv", "r04"),
            ("log_{robot}_*.csv", "/data/2026-01-01/log_SN-12_x.csv", "SN-12"),
            ("{robot}/{robot}/{date}.csv", "/data/line1/r04/2026-03-15.csv", "line1/r04"),
            ("{robot}_{date}.csv", "/2026-01-01/cell.7_2026-02-01.csv", "cell.7"),
            ("folder", "/data/r04/2026-03-15.csv", "r04"),
        ],
    )
    def test_is_named_by_the_path(self, spec, origin, robot):
        assert placed(spec, origin, when="2026-03-15T07:00:00+00:00").robot == robot

    def test_is_named_by_a_column(self):
        assert placed("column=serial", "/a.csv", facts={"serial": 4711.0}, when="x").robot == "4711"
        assert placed("column=serial", "/a.csv", facts={"serial": "K2"}, when="x").robot == "K2"

    def test_of_one_type_is_an_arm_of_its_own(self):
        first, second, again = (
            placed("folder", f"/{name}/log.csv", when="x") for name in ("a", "b", "a")
        )
        assert first.arm_type == second.arm_type == "type"
        assert first.arm == again.arm != second.arm

    @pytest.mark.parametrize("spec", ["{robot}/x.csv", "column=serial", "metadata=serial"])
    def test_that_is_not_named_is_refused(self, spec):
        with pytest.raises(InputError, match="--robot"):
            placed(spec, "/data/y.csv", when="x")

    @pytest.mark.parametrize(
        "spec", ["robot", "column=", "{robot}{serial}", "{robot}/{date}/{date}"]
    )
    def test_that_nothing_names_is_refused(self, spec):
        with pytest.raises(InputError, match="--robot"):
            RobotNaming.parse(spec)


class TestSeveralPlaces:
    """One name in several folders: of several robots, or of one with a folder for each month."""

    @staticmethod
    def of(spec, *recordings):
        naming = RobotNaming.parse(spec)
        return naming.in_several_places(
            [naming.place(ref(origin, when=when)) for origin, when in recordings]
        )

    def test_at_the_same_time_are_shown(self):
        recordings = [
            (f"/{line}/r04/{month}.csv", month)
            for line in ("line1", "line2")
            for month in ("2026-01-15", "2026-02-15")
        ]
        assert self.of("{robot}/*.csv", *recordings) == {"r04": ["/line1/r04", "/line2/r04"]}
        assert self.of("folder", *recordings) == {"r04": ["/line1/r04", "/line2/r04"]}
        assert self.of("{robot}/{robot}/*.csv", *recordings) == {}

    def test_one_after_the_other_are_one_robot(self):
        recordings = [(f"/{month}/r04/log.csv", month) for month in ("2026-01-15", "2026-02-15")]
        assert self.of("{robot}/*.csv", *recordings) == {}


class TestDate:
    @pytest.mark.parametrize(
        ("name", "date"),
        [
            ("2026-03-15", "2026-03-15T00:00:00+00:00"),
            ("log_20260315_081500", "2026-03-15T08:15:00+00:00"),
            ("2026-03-15T08-15-30", "2026-03-15T08:15:30+00:00"),
            ("r4_15.03.2026", "2026-03-15T00:00:00+00:00"),
            ("2026-03", "2026-03-01T00:00:00+00:00"),
            ("2026_03", "2026-03-01T00:00:00+00:00"),
            ("2026-02-31", None),
            ("serial-120260315", None),
            ("run7", None),
        ],
    )
    def test_is_in_a_name(self, name, date):
        assert date_in(name) == date

    def test_of_the_clock_counts_unless_the_pattern_says_another(self):
        clock = "2026-03-15T07:30:00+00:00"
        same = placed("{robot}/{date}.csv", "/r/2026-03-15.csv", when=clock, dated_by="clock")
        other = placed("{robot}/{date}.csv", "/r/2026-04-01.csv", when=clock, dated_by="clock")
        assert (same.when, same.dated_by) == (clock, "clock")
        assert (other.when, other.dated_by) == ("2026-04-01T00:00:00+00:00", "name")

    def test_is_that_of_the_name_then_of_the_file(self, tmp_path):
        named = tmp_path / "2026-03-15" / "log.csv"
        unnamed = tmp_path / "a" / "b" / "c.csv"
        for path in (named, unnamed):
            path.parent.mkdir(parents=True)
            path.touch()
        os.utime(unnamed, (1_700_000_000, 1_700_000_000))
        naming = RobotNaming()
        assert naming.place(ref(str(named))).when == "2026-03-15T00:00:00+00:00"
        by_file = naming.place(ref(str(unnamed)))
        changed = datetime.fromtimestamp(1_700_000_000, UTC).isoformat()
        assert (by_file.when, by_file.dated_by) == (changed, "file")


class TestFacts:
    """What a log says beside its motion."""

    def test_temperatures_and_wanted_columns(self, tmp_path):
        path = tmp_path / "log.csv"
        rows = [f"{k},{0.1 * k},K2,{20 + k},7,1.5" for k in range(3)]
        path.write_text("\n".join(["t,q1,serial,joint_temp1,load,temporary", *rows]))
        extra = ExtraChannels(("serial", "load"))
        facts = facts_of(path, extra, LogFiles())
        assert facts == {"serial": "K2", "joint_temp1": 21.0, "load": 7.0}

    def test_of_arrays_each_column(self, tmp_path):
        path = tmp_path / "log.npz"
        np.savez(path, t=np.arange(3.0), temperature=np.array([[1.0, 2.0]] * 3))
        facts = facts_of(path, ExtraChannels(), LogFiles())
        assert facts == {"temperature1": 1.0, "temperature2": 2.0}


@pytest.mark.long
def test_robots_of_one_type_have_estimates_of_their_own(tmp_path):
    plan = FleetPlan(robots=3, months=2, duration=10.0, spread=0.3)
    write_fleet(tmp_path, Fleet(plan))
    (tmp_path / "spare.csv").write_text((tmp_path / "robot00" / "2024-01-15.csv").read_text())
    reading = LogReading.of(lambda _: Robot.from_urdf(urdf()), ImportOptions(), "")
    cache = CacheLocation(str(tmp_path / "cache"))
    logs = LogsOfBatch(reading, cache, Here(), Silent())
    naming = RobotNaming.parse("robot{robot}/{date}.csv")
    result = reidentify(
        [str(tmp_path)], FIXED, Here(), Silent(), cache=cache, importing=logs, place=naming.place
    )
    assert [arm.robot for arm in result.arms.values()] == ["00", "01", "02"]
    assert len({arm.arm_type for arm in result.arms.values()}) == 1
    assert [each.repetitions for each in result.pooled] == [2, 2, 2]
    assert [each.level for each in result.siblings] == ["siblings"] * 3
    for own, shared in zip(result.pooled, result.siblings, strict=True):
        determined = np.isfinite(own.estimate.std)
        assert (shared.estimate.std <= 1.01 * own.estimate.std)[determined].all()
    assert len({each.settings for each in result.campaigns}) == 1
    (unused,) = result.broken
    assert unused.path.endswith("spare.csv")
    assert "does not match" in unused.message
