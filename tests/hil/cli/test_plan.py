"""`hil plan`: targets as planned, and the picture of a plan."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.cell import AngleFrame, Cell
from hil.cli import app
from hil.plots import draw_plan
from planner.moves import Move, plan_moves
from sim_fixtures.ns16 import CELL_PATH

pytestmark = pytest.mark.long

VIA = """\
# as on the teach pendant
joint_1, joint_2, joint_3, joint_4, joint_5, joint_6
0, 0, -90, 0, 90, 0
40, 30, -60, 50, 40, 10   # reach
-20; 10; -100; 0; 60; 90
0 0 -90 0 90 0
"""


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(CELL_PATH)


def run(*arguments: object) -> str:
    command_line = ["plan", str(CELL_PATH), *map(str, arguments)]
    result = CliRunner().invoke(app, command_line, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def via(tmp_path):
    path = tmp_path / "via.csv"
    path.write_text(VIA)
    return path


def test_via_points_are_reported_in_controller_angles(via, tmp_path):
    out = run("--via", via, "--fly", 50)
    lines = out.splitlines()
    assert lines[0].split()[:3] == ["target", "joint_1", "joint_2"]
    rows = [line.split() for line in lines[2:6]]
    assert [row[0] for row in rows] == ["0", "1", "2", "3"]
    assert rows[1][1:7] == ["40.00", "30.00", "-60.00", "50.00", "40.00", "10.00"]
    assert [row[9].rstrip(",") for row in rows] == ["start", "flown", "flown", "stopped"]
    times = [float(row[7]) for row in rows]
    assert times == sorted(times) and times[0] == 0.0
    (nearest,) = re.findall(r"closest to its limit: .* ([\d.]+) % of it", " ".join(lines))
    assert 50.0 < float(nearest) <= 100.0
    fast, slow = (json.loads(run("--via", via, "--json", "--speed", speed)) for speed in (100, 20))
    assert fast["angles"] == "controller"
    np.testing.assert_allclose(fast["targets"][0]["target_deg"], [40, 30, -60, 50, 40, 10])
    assert slow["duration"] > 2.0 * fast["duration"]
    # A byte order mark and the lines of a header are ignored.
    marked = tmp_path / "marked.csv"
    marked.write_bytes(b"\xef\xbb\xbf" + VIA.split("\n", 2)[2].encode())
    assert run("--via", marked, "--fly", 50) == out


def test_random_via_points_are_within_limits_and_repeatable():
    first, second, other = (
        json.loads(run("--random", 5, "--seed", seed, "--json")) for seed in (1, 1, 2)
    )
    assert first == second != other
    assert len(first["targets"]) == 5


def test_draws_a_picture_that_is_not_blank(via, tmp_path):
    path = tmp_path / "plan.png"
    run("--via", via, "--picture", path)
    pixels = matplotlib.image.imread(path)
    assert pixels.shape[0] > 800 and pixels.shape[1] > 800
    assert 0.02 < np.mean(np.any(pixels[..., :3] < 0.8, axis=2)) < 0.5
    for suffix in (".svg", ".pdf"):
        run("--via", via, "--picture", path.with_suffix(suffix))
        assert path.with_suffix(suffix).stat().st_size > 10_000


HOME = "0 0 -90 0 90 0\n"


@pytest.mark.parametrize(
    ("text", "arguments", "problem"),
    [
        (VIA, [], "there are no via points; add --via FILE"),
        (VIA, ["--random", "3", "--via", "VIA"], "--via and --random: exclude each other"),
        (VIA, ["--via", "missing.csv"], "cannot be read"),
        (VIA, ["--via", "VIA", "--picture", "plan.bmp"], "not a picture format"),
        (VIA, ["--via", "VIA", "--picture", "nowhere/plan.png"], "cannot be written"),
        ("0 0 0\n1 1 1\n", ["--via", "VIA"], "line 1: '0 0 0' is not a posture"),
        (
            HOME + "0 99 -90 0 90 0\n",
            ["--via", "VIA"],
            "line 2: joint_2 = 99° is outside .* write an angle from -50° to 95°",
        ),
        (HOME, ["--via", "VIA"], "1 via points"),
        ("", ["--via", "VIA"], "0 via points"),
        ("a,b,c,d,e,f\nA,B,C,D,E,F\n" + HOME, ["--via", "VIA"], "line 2: 'A B C D E F' is no"),
        ("nan nan nan nan nan nan\n" + HOME, ["--via", "VIA"], "line 1: 'nan nan"),
    ],
)
def test_names_what_is_wrong(via, text, arguments, problem):
    via.write_text(text)
    with pytest.raises(InputError, match=problem):
        run(*(via if argument == "VIA" else argument for argument in arguments))


CRASH = """\
import os, signal
import ruckig
class Crashing:
    def __init__(self, *_): pass
    def calculate(self, *_): os.kill(os.getpid(), signal.SIGSEGV)
ruckig.Ruckig = Crashing
"""


def test_a_crash_of_the_solver_is_reported(via, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(CRASH)
    ended = subprocess.run(
        [sys.executable, "-m", "hil", "plan", str(CELL_PATH), "--via", str(via)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode == 2, ended
    (sentence,) = ended.stderr.splitlines()
    assert sentence.startswith("error:") and "killed by signal 11" in sentence


def planned(cell: Cell, count: int, fly: float = 50.0):
    limits = cell.joint_limits
    random = np.random.default_rng(4)
    points = limits.lower + random.random((count, 6)) * (limits.upper - limits.lower)
    return plan_moves(points[0], [Move(p, fly_percent=fly) for p in points[1:]], limits)


def test_a_plan_without_corners_has_a_picture(cell):
    limits = cell.joint_limits
    middle = (limits.lower + limits.upper) / 2.0
    still = plan_moves(middle, [Move(middle), Move(middle)], limits)
    for without in (planned(cell, 2), planned(cell, 3, fly=0.0), still):
        assert len(draw_plan(without, cell.joint_names, AngleFrame.of(cell)).axes) == 18
