"""Tables of quantities and stated conditions: what a trend is computed from without recordings."""

from __future__ import annotations

import csv
from datetime import UTC, datetime

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.cli import app
from hil.fleet.conditions import Conditions
from hil.fleet.table import is_table, read_table, write_trend
from hil.fleet.trend import fleet_trend

MONTHS = 14
HEADER = ("robot", "joint", "quantity", "unit", "speed", "when", "value", "std")


def month(number):
    return f"{2024 + number // 12}-{number % 12 + 1:02d}-15"


def rows(*, robots=6, months=MONTHS, heat=0.0, shared=0.0):
    """Friction of the elbow of some robots: the first gains a fifth in the eighth month.

    With `heat` it falls with a temperature that differs from log to log, which is not logged; all
    gain the share `shared` in the ninth month.
    """
    random = np.random.default_rng(5)
    for robot in range(robots):
        for k in range(months):
            share = 1.0 + 0.01 * random.standard_normal() + 0.2 * (robot == 0 and k >= 8)
            share *= (1.0 + shared * (k >= 9)) * (1.0 - heat * temperature(robot, k))
            value = 10.0 * share
            yield (f"r{robot}", "elbow", "friction", "N·m", 0.5, month(k), value, 0.05)


def temperature(robot, number):
    return float(np.random.default_rng([robot, number]).uniform(-10.0, 10.0))


@pytest.fixture
def table(tmp_path):
    def written(**how):
        path = tmp_path / "quantities.csv"
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([HEADER, *rows(**how)])
        return path

    return written


def trend_of(path, conditions=Conditions()):  # noqa: B008 - frozen
    return fleet_trend(read_table(path, conditions), covariates=conditions.names)


class TestTable:
    def test_is_told_from_a_log_by_its_columns(self, table, tmp_path):
        assert is_table(table())
        log = tmp_path / "log.csv"
        log.write_text("time,q1,tau1\n0,0,0\n")
        assert not is_table(log)
        assert not is_table(tmp_path / "missing.csv")

    def test_the_robot_that_changed_is_found_with_its_date(self, table):
        fleet = trend_of(table())
        assert [robot.robot for robot in fleet.changed] == ["r0"]
        (trend,) = fleet.changed[0].trends
        assert trend.change == pytest.approx(0.2, abs=0.03)
        (change,) = trend.changes
        assert change.earliest <= "2024-09-01" <= change.latest

    def test_what_a_trend_wrote_gives_the_same_trend(self, table, tmp_path):
        fleet = trend_of(table())
        again = tmp_path / "again.csv"
        write_trend(again, fleet)
        repeated = trend_of(again)
        for robot, same in zip(fleet.robots, repeated.robots, strict=True):
            assert robot.robot == same.robot
            assert robot.trends[0].change == pytest.approx(same.trends[0].change, rel=1e-9)
            assert robot.trends[0].p_value == pytest.approx(same.trends[0].p_value, rel=1e-6)

    def test_as_parquet_with_dates(self, table, tmp_path):
        pandas = pytest.importorskip("pandas")
        frame = pandas.read_csv(table(), parse_dates=["when"])
        frame.to_parquet(tmp_path / "quantities.parquet")
        assert [each.robot for each in trend_of(tmp_path / "quantities.parquet").changed] == ["r0"]

    def test_two_recordings_of_one_day_are_two(self, tmp_path):
        path = tmp_path / "twice.csv"
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([HEADER, *rows(robots=2), *rows(robots=2)])
        (series,) = read_table(path)
        assert len(series.recordings["r0"]) == 2 * MONTHS

    @pytest.mark.parametrize(
        ("column", "value", "problem"),
        [("quantity", "heat", "'heat' is none of"), ("when", "soon", "'soon' is not a date")],
    )
    def test_a_row_that_cannot_be_read_is_named(self, tmp_path, column, value, problem):
        path = tmp_path / "wrong.csv"
        row = dict(zip(HEADER, next(rows()), strict=True)) | {column: value}
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([HEADER, row.values()])
        with pytest.raises(InputError, match=f"row 2: {problem}"):
            read_table(path)

    def test_the_command_needs_no_robot_for_it(self, table):
        ran = CliRunner().invoke(app, ["trend", str(table()), "--fail-on-change"])
        assert ran.exit_code == 5, ran.output
        assert ran.stdout.startswith("Changed: r0 (1 of 6 robots).")


class TestAllTogether:
    """A change of all robots at once is reported as such, and of no robot by itself."""

    def test_is_a_change_of_the_fleet(self, table):
        fleet = trend_of(table(months=24, shared=0.15))
        (together,) = fleet.together
        assert together.changed
        assert together.trends[0].changes[0].begin[:7] in ("2024-09", "2024-10")
        assert {robot.robot for robot in fleet.robots if robot.changed} == {"r0"}

    def test_the_command_says_so_and_fails(self, table):
        ran = CliRunner().invoke(
            app, ["trend", str(table(months=24, shared=0.15)), "--fail-on-change"]
        )
        assert ran.exit_code == 5, ran.output
        assert ran.stdout.startswith("Changed: all robots together, r0 (1 of 6 robots).")
        assert "all robots together, elbow: friction +1" in ran.stdout

    def test_is_none_of_a_fleet_without_one(self, table):
        (together,) = trend_of(table(months=24)).together
        assert not together.changed


class TestConditions:
    """A file with what the logs lack."""

    @pytest.fixture
    def file(self, tmp_path):
        def written(text):
            path = tmp_path / "conditions.csv"
            path.write_text(text)
            return path

        return written

    def test_of_all_robots_are_interpolated(self, file):
        stated = Conditions.load(file("when,ambient\n2024-01-01,10\n2024-01-11,20\n"))
        assert stated.of("r1", datetime(2024, 1, 6, tzinfo=UTC)) == {"ambient": 15.0}

    def test_of_a_robot_go_first(self, file):
        text = "date,robot,ambient,minutes\n2024-01-01,,10,\n2024-01-01,r1,30,5\n"
        stated = Conditions.load(file(text))
        when = datetime(2024, 1, 1, 9, tzinfo=UTC)
        assert stated.of("r1", when) == {"ambient": 30.0, "minutes": 5.0}
        assert stated.of("r2", when) == {"ambient": 10.0}

    def test_are_unknown_beyond_the_day_of_the_last_row(self, file):
        stated = Conditions.load(file("when,ambient\n2024-01-01,10\n2024-01-11,20\n"))
        assert stated.of("r1", datetime(2024, 1, 11, 20, tzinfo=UTC)) == {"ambient": 20.0}
        assert stated.of("r1", datetime(2024, 1, 13, tzinfo=UTC)) == {}

    @pytest.mark.parametrize(
        ("text", "problem"),
        [
            ("robot,ambient\nr1,20\n", "has the columns robot, ambient"),
            ("when,robot\n2024-01-01,r1\n", "has the columns when, robot"),
            ("when,ambient\nsoon,20\n", "row 2: 'soon' is not a date"),
            ("when,ambient\n2024-01-01,warm\n", "row 2: 'warm' of ambient is not a number"),
        ],
    )
    def test_that_cannot_be_read_are_refused(self, file, text, problem):
        with pytest.raises(InputError, match=problem):
            Conditions.load(file(text))

    def test_make_a_trend_see_through_the_heat(self, table, file):
        """Each robot has a temperature of its own in every log, which moves friction by 10 %."""
        lines = [
            f"{month(k)},r{robot},{temperature(robot, k)}"
            for robot in range(6)
            for k in range(MONTHS)
        ]
        stated = Conditions.load(file("\n".join(["when,robot,joint heat", *lines]) + "\n"))
        path = table(heat=0.01)
        (blind,) = trend_of(path).changed
        fleet = trend_of(path, stated)
        assert fleet.covariates == ("joint heat",)
        (seeing,) = fleet.changed
        assert seeing.trends[0].half < 0.5 * blind.trends[0].half
        assert seeing.trends[0].effects["joint heat"] == pytest.approx(-0.01, rel=0.1)
