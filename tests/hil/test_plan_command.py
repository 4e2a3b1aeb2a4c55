from __future__ import annotations

import json
import os
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from hil.cell import AngleFrame, Cell
from hil.cli.plan import plan, read_plan_file
from hil.errors import InputError
from hil.plots import draw_plan
from hil.plots.plan_picture import corner_times
from planner.moves import Move, plan_moves
from sim_fixtures.ns16 import CELL_PATH

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


@pytest.fixture(scope="module")
def app() -> typer.Typer:
    app = typer.Typer()
    app.command()(plan)
    return app


@pytest.fixture
def run(app):
    def run(*arguments: object) -> str:
        result = CliRunner().invoke(
            app, [str(CELL_PATH), *map(str, arguments)], catch_exceptions=False
        )
        assert result.exit_code == 0, result.output
        return result.output

    return run


@pytest.fixture
def via(tmp_path):
    path = tmp_path / "via.csv"
    path.write_text(VIA)
    return path


def test_each_via_point_is_reported(run, via):
    lines = run("--via", via, "--fly", 50).splitlines()
    assert lines[0].split()[:3] == ["target", "joint_1", "joint_2"]
    rows = [line.split() for line in lines[2:6]]
    assert [row[0] for row in rows] == ["0", "1", "2", "3"]
    assert rows[1][1:7] == ["40.00", "30.00", "-60.00", "50.00", "40.00", "10.00"]
    assert [row[9].rstrip(",") for row in rows] == ["start", "flown", "flown", "stopped"]
    times = [float(row[7]) for row in rows]
    assert times == sorted(times) and times[0] == 0.0


def test_targets_are_in_the_angles_of_the_controller(run, via):
    out = json.loads(run("--via", via, "--json"))
    assert out["angles"] == "controller"
    np.testing.assert_allclose(out["targets"][0]["target_deg"], [40, 30, -60, 50, 40, 10])


def test_slower_moves(run, via):
    out = json.loads(run("--via", via, "--json"))
    slow = json.loads(run("--via", via, "--json", "--speed", 20))
    assert slow["duration"] > 2.0 * out["duration"]


def test_random_via_points_are_within_limits_and_repeatable(run):
    first, second, other = (
        json.loads(run("--random", 5, "--seed", seed, "--json")) for seed in (1, 1, 2)
    )
    assert first == second != other
    assert len(first["targets"]) == 5


def test_a_plan_file_is_planned_again_and_agrees(run, via, tmp_path, cell):
    path = tmp_path / "plan.json"
    out = run("--via", via, "--fly", 75, "--output", path)
    assert run("--via", path) == out
    file = read_plan_file(path)
    assert file.moves[0].fly_percent == 75.0
    assert file.plan().trajectory.duration == pytest.approx(
        float(out.splitlines()[-2].split()[0]), abs=1e-3
    )


def test_draws_a_picture_that_is_not_blank(run, via, tmp_path):
    path = tmp_path / "plan.png"
    run("--via", via, "--picture", path)
    pixels = matplotlib.image.imread(path)
    assert pixels.shape[0] > 800 and pixels.shape[1] > 800
    assert 0.02 < np.mean(np.any(pixels[..., :3] < 0.8, axis=2)) < 0.5
    for suffix in (".svg", ".pdf"):
        run("--via", via, "--picture", path.with_suffix(suffix))
        assert path.with_suffix(suffix).stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "--via or --random: one of them is required"),
        (["--random", "3", "--via", "VIA"], "--via and --random: exclude each other"),
        (["--via", "missing.csv"], "cannot be read"),
        (["--via", "VIA", "--picture", "plan.bmp"], "not a picture format"),
        (["--via", "VIA", "--picture", "nowhere/plan.png"], "cannot be written"),
        (["--via", "VIA", "--output", "nowhere/plan.json"], "cannot be written"),
        (["--via", "VIA", "--output", "plan.yaml"], "not a plan file"),
    ],
)
def test_names_what_is_wrong(app, via, arguments, problem):
    arguments = [str(via) if argument == "VIA" else argument for argument in arguments]
    with pytest.raises(InputError, match=problem):
        CliRunner().invoke(app, [str(CELL_PATH), *arguments], catch_exceptions=False)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("0 0 0\n1 1 1\n", "line 1: '0 0 0' is not a posture"),
        ("0 0 -90 0 90 0\n", "1 via points"),
        ("", "0 via points"),
        ("a,b,c,d,e,f\nA,B,C,D,E,F\n0,0,-90,0,90,0\n", "line 2: 'A B C D E F' is no"),
        ("nan nan nan nan nan nan\n0 0 -90 0 90 0\n9 9 -90 0 90 0\n", "line 1: 'nan nan"),
    ],
)
def test_invalid_via_points_are_reported(app, tmp_path, text, problem):
    path = tmp_path / "via.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=problem):
        CliRunner().invoke(app, [str(CELL_PATH), "--via", str(path)], catch_exceptions=False)


def test_a_byte_order_mark_is_ignored(run, via, tmp_path):
    points_only, marked = tmp_path / "points.csv", tmp_path / "marked.csv"
    points_only.write_text(VIA.split("\n", 2)[2])
    marked.write_bytes(b"\xef\xbb\xbf" + points_only.read_bytes())
    assert run("--via", marked) == run("--via", points_only) == run("--via", via)


def test_a_motion_that_is_not_that_of_its_moves_is_refused(app, run, via, tmp_path):
    """Limits of the cell and the planned motion may be left out."""
    path, edited = tmp_path / "plan.json", tmp_path / "edited.json"
    out = run("--via", via, "--output", path)
    data = json.loads(path.read_text())
    data["moves"][1]["target"][0] += 0.1
    edited.write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"edited\.json: .*motion"):
        CliRunner().invoke(app, [str(CELL_PATH), "--via", str(edited)], catch_exceptions=False)
    data["moves"][1]["target"][0] -= 0.1
    del data["motion"], data["limits"]
    path.write_text(json.dumps(data))
    assert run("--via", path) == out


CRASH = """\
import os, signal
import ruckig
class Crashing:
    def __init__(self, *_): pass
    def calculate(self, *_): os.kill(os.getpid(), signal.SIGSEGV)
ruckig.Ruckig = Crashing
"""


@pytest.mark.parametrize("how", ["via", "file"])
def test_a_crash_of_the_solver_is_reported(run, via, tmp_path, how):
    (tmp_path / "sitecustomize.py").write_text(CRASH)
    arguments = ["--via", str(via)]
    if how == "file":
        run("--via", via, "--output", tmp_path / "plan.json")
        arguments = ["--via", str(tmp_path / "plan.json")]
    ended = subprocess.run(
        [sys.executable, "-m", "hil", "plan", str(CELL_PATH), *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode == 2, ended
    (sentence,) = ended.stderr.splitlines()
    assert sentence.startswith("error:") and "killed by signal 11" in sentence


def test_a_plan_file_of_another_arm_is_refused(app, run, via, tmp_path):
    path = tmp_path / "plan.json"
    run("--via", via, "--output", path)
    path.write_text(path.read_text().replace('"joint_6"', '"tail"'))
    with pytest.raises(InputError, match="tail"):
        CliRunner().invoke(app, [str(CELL_PATH), "--via", str(path)], catch_exceptions=False)
    path.write_text("not = [a plan")
    with pytest.raises(InputError, match="name a plan file"):
        CliRunner().invoke(app, [str(CELL_PATH), "--via", str(path)], catch_exceptions=False)


def planned(cell: Cell, count: int, fly: float = 50.0):
    limits = cell.joint_limits
    random = np.random.default_rng(4)
    points = limits.lower + random.random((count, 6)) * (limits.upper - limits.lower)
    return plan_moves(points[0], [Move(p, fly_percent=fly) for p in points[1:]], limits)


def test_shaded_corners_are_where_the_motion_is_curved(cell):
    plan = planned(cell, 6)
    points = np.array([plan.start, *(move.target for move in plan.moves)])
    time = np.linspace(0.0, plan.trajectory.duration, 20_001)
    q = plan.trajectory.sample(time)[0]
    moves = np.diff(points, axis=0)
    off = np.full(len(time), np.inf)
    for start, move in zip(points, moves, strict=False):
        along = np.clip((q - start) @ move / (move @ move), 0.0, 1.0)
        off = np.minimum(off, np.linalg.norm(q - start - along[:, None] * move, axis=1))
    straight = off < 1e-7
    inside = np.zeros(len(time), dtype=bool)
    for (begin, end), target in zip(corner_times(plan), plan.targets, strict=False):
        assert begin <= target.time <= end
        inside |= (time >= begin) & (time <= end)
    assert np.all(straight[~inside])
    assert np.mean(straight[inside]) < 0.2


def test_a_plan_without_corners_has_a_picture(cell):
    limits = cell.joint_limits
    middle = (limits.lower + limits.upper) / 2.0
    still = plan_moves(middle, [Move(middle), Move(middle)], limits)
    for without in (planned(cell, 2), planned(cell, 3, fly=0.0), still):
        assert len(draw_plan(without, cell.joint_names, AngleFrame.of(cell)).axes) == 18
