"""`hil trend`: logs of a fleet to a ranking of its robots, a page, a table and an exit status."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.fleet import Fault, Fleet, FleetPlan, urdf, write_fleet
from hil.base.errors import InputError
from hil.batch.cluster import Cluster
from hil.cli import app
from hil.fleet.trend_limits import TrendLimit
from tests.hil.batch_work import NOTHING_OPEN
from tests.hil.report.pages import Page, assert_inert, assert_stands_alone

pytestmark = pytest.mark.long

OPTIONS = ("--robot", "{robot}/{date}.csv", "--urdf", str(urdf()), "--torque-bandwidth", "none")
WORN = Fault(2, "wear", 1, 0.5, 0.09)
CARRYING = Fault(0, "tool", 0, 2.5, 6.0)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Five robots, six months: one wears 9 % a month, one gets a tool that nobody was told of."""
    root = tmp_path_factory.mktemp("fleet")
    plan = FleetPlan(robots=5, months=6, duration=10.0, day=0.005, faults=(WORN, CARRYING))
    write_fleet(root, Fleet(plan))
    return root


def run(logs, *more):
    places = [str(logs), *OPTIONS, *NOTHING_OPEN[:-2]]
    return CliRunner().invoke(app, ["trend", *places, *more])


@pytest.fixture(scope="module")
def done(logs):
    """The command with every output, and its JSON."""
    out = logs.parent / "out"
    files = ("-o", str(out / "trend.html"), "--table", str(out / "trend.csv"))
    ran = run(logs, *files, "--limit", "friction+60%", "--fail-on-change", "--json")
    assert ran.exit_code == 5, ran.output
    return json.loads(ran.stdout), out


def test_the_robots_that_change_are_first(done):
    """With joint and quantity; the tool shows in the load of the joints that carry it."""
    printed, _ = done
    changed = {robot["robot"]: robot for robot in printed["robots"] if robot["changed"]}
    assert changed.keys() == {"robot02", "robot00"}
    assert {robot["robot"] for robot in printed["robots"][:2]} == changed.keys()
    worn = [each for each in changed["robot02"]["trends"] if each["changed"]]
    assert {each["joint"] for each in worn} == {"shoulder_lift_joint"}
    assert "friction" in {each["quantity"] for each in worn}
    carried = [each for each in changed["robot00"]["trends"] if each["changed"]]
    assert "gravity load" in {each["quantity"] for each in carried}
    assert not {"coulomb", "viscous", "friction"} & {each["quantity"] for each in carried}


def test_rate_begin_and_limit_are_those_planted(done):
    printed, _ = done
    worn = next(robot for robot in printed["robots"] if robot["robot"] == "robot02")
    friction = next(
        each
        for each in worn["trends"]
        if each["quantity"] == "friction" and each["joint"] == "shoulder_lift_joint"
    )
    assert friction["rate"] == pytest.approx(WORN.size, abs=max(0.02, friction["rate_half"]))
    assert friction["changes"][0]["earliest"] < "2024-03-01"
    (limit,) = friction["limits"]
    assert limit["earliest"] <= limit["date"]
    assert "2024-07" < limit["date"] < "2024-11"  # 60 % at month 7.2


def test_page_and_table_have_every_robot(done):
    printed, out = done
    html = (out / "trend.html").read_text("utf-8")
    assert_stands_alone(html)
    page = Page(html)
    assert_inert(page, charts=False)
    text = page.text
    assert text.index("robot02, shoulder_lift_joint: friction +") < text.index("robot01,")
    with (out / "trend.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["robot"] for row in rows} == {f"robot{k:02d}" for k in range(5)}
    friction = [row for row in rows if (row["robot"], row["quantity"]) == ("robot02", "friction")]
    assert len(friction) == 6 * 6
    assert np.isfinite([float(row["value"]) for row in friction]).all()
    assert printed["covariates"] == ["temperature"]


def test_the_first_screen_has_a_sentence_for_each_robot(done, logs):
    ran = run(logs)
    assert ran.exit_code == 0, ran.output
    lines = ran.stdout.splitlines()
    assert lines[0].startswith("Changed: ")
    assert "since January 2024" in ran.stdout or "since February 2024" in ran.stdout
    assert "a month" in ran.stdout
    assert len(lines) <= 24


def test_a_new_month_starts_no_cluster(done, logs, monkeypatch):
    """Recordings whose estimates are cached are not read, and count as none."""
    counts = []
    client = Cluster.client

    def counted(self, archives):
        counts.append(archives)
        return client(self, archives)

    monkeypatch.setattr(Cluster, "client", counted)
    assert run(logs).exit_code == 0
    assert counts and max(counts) == 0


def test_a_table_of_a_batch_gives_the_same_robots(done, logs, tmp_path):
    """What `hil batch` writes is read by `hil trend`, without robot, logs or cache."""
    places = [str(logs), *OPTIONS, *NOTHING_OPEN]
    ran = CliRunner().invoke(app, ["batch", *places, "-o", str(tmp_path / "tables")])
    assert ran.exit_code == 0, ran.output
    table = str(tmp_path / "tables" / "quantities.csv")
    ran = CliRunner().invoke(app, ["trend", table, "--fail-on-change", "--json"])
    assert ran.exit_code == 5, ran.output
    printed = json.loads(ran.stdout)
    changed = {robot["robot"] for robot in printed["robots"] if robot["changed"]}
    assert changed == {"robot02", "robot00"}
    assert printed["covariates"] == ["temperature"]


def test_a_covariate_that_no_recording_has_is_named(done, logs):
    ran = run(logs, "--covariate", "payload")
    assert ran.exit_code == 0, ran.output
    assert "no recording has a column 'payload'" in ran.stdout


def test_logs_without_their_arm_are_refused_with_the_option(logs):
    ran = CliRunner().invoke(app, ["trend", str(logs)])
    assert isinstance(ran.exception, InputError)
    assert "--urdf" in str(ran.exception)


class TestLimit:
    def test_is_a_quantity_and_a_change(self):
        assert TrendLimit.parse("friction+50%") == ("friction", 0.5)
        assert TrendLimit.parse("gravity load -10 %") == ("gravity load", -0.1)

    @pytest.mark.parametrize("text", ["friction", "friction+0%", "heat+5%", "friction+x%", "+5%"])
    def test_is_refused_otherwise(self, text):
        with pytest.raises(InputError, match="--limit"):
            TrendLimit.parse(text)
