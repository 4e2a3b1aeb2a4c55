"""`hil move`: a checked straight way, confirmed, archived, and stopped on its path."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.base.errors import ExecutionError, InputError, UnsafeError
from hil.campaign import Campaign, CampaignFolderError, MotionRefusedError
from hil.cell import Cell
from hil.cli import app
from hil.control.move import plan_move, posture, turned
from hil.testing import UdpController
from sim_fixtures.ns16 import CELL_PATH
from tests.docs.typed import ROOT, commands
from tests.hil.fast_cell import set_points
from tests.hil.screen_rig import on_terminal
from tests.messages import FASTER_THAN_APPROACH

pytestmark = pytest.mark.safety


@pytest.fixture(scope="module")
def ns16() -> Cell:
    return Cell.load(CELL_PATH)


def ran(*arguments: str) -> dict[str, object]:
    result = CliRunner().invoke(app, ["move", *arguments, "--json"], catch_exceptions=False)
    assert result.exit_code == 0
    summary: dict[str, object] = json.loads(result.stdout.splitlines()[-1])
    return summary


def test_the_arm_goes_home_and_every_cycle_is_archived(ns16: Cell, tmp_path: Path) -> None:
    summary = ran(str(CELL_PATH), "--to", "start", "-o", str(tmp_path))
    archive = open_archive(str(summary["archive"]))
    assert archive.complete
    assert archive.kind == "move"
    assert archive.header.entries["simulated"] == "yes"
    position = archive.columns["position"]
    np.testing.assert_allclose(position[0], ns16.initial, atol=1e-3)
    assert np.all(np.diff(archive.columns["cycle"]) == 1)
    # Straight in joint space: each joint is the same share of its way on.
    sent = set_points(archive)
    np.testing.assert_allclose(sent[-1], ns16.home, atol=1e-12)
    share = (sent - ns16.initial) / (ns16.home - ns16.initial)
    assert np.ptp(share, axis=1).max() < 1e-3
    speed = np.abs(archive.columns["velocity"]).max(axis=0)
    assert np.all(speed <= 1.1 * ns16.campaign.approach_speed * ns16.joint_limits.velocity)


def test_one_joint_turns_by_so_many_degrees_of_the_teach_pendant(
    ns16: Cell, tmp_path: Path
) -> None:
    out = str(tmp_path / "one.mcap")
    summary = ran(str(CELL_PATH), "--joint", "joint_3", "--by", "5", "--speed", "5", "-o", out)
    archive = open_archive(out)
    pendant = np.degrees(ns16.controller_angles(archive.columns["position"][[0, -1]]))
    np.testing.assert_allclose(pendant[1] - pendant[0], [0, 0, 5, 0, 0, 0], atol=0.05)
    assert summary["outcome"] == "completed"


def test_one_axis_alone_moves_over_a_real_link(ns16: Cell, tmp_path: Path) -> None:
    """As `docs/connect.md` types it; the others stay in mode 0 and where they are."""
    out = str(tmp_path / "one.mcap")
    page = ROOT / "docs" / "connect.md"
    simulate, moved = (command for command in commands(page) if "--only-axis" in command)
    options = simulate[simulate.index("--only-axis") :]
    with UdpController.started(ns16, tmp_path, options=options) as controller:
        way = [str(controller.cell_path), *moved[3:], "-o", out]
        assert ran(*way)["outcome"] == "completed"
    columns = open_archive(out).columns
    in_interval = columns["interval"] == 0
    opened = columns["mode"][in_interval] == ns16.controller.mode
    assert opened[:, 2].any()
    assert not np.delete(opened, 2, axis=1).any()
    target = np.degrees(ns16.controller_angles(columns["target_position"][in_interval]))
    np.testing.assert_allclose(target[-1] - target[0], [0, 0, 2, 0, 0, 0], atol=1e-3)


def test_one_axis_alone_is_refused_where_others_open_or_turn(ns16: Cell, tmp_path: Path) -> None:
    def refused(cell: Path, joint: str) -> BaseException | None:
        way = ["--joint", joint, "--by", "2", "--only-axis", "-o", str(tmp_path), "--json"]
        return CliRunner().invoke(app, ["move", str(cell), *way]).exception

    with UdpController.started(ns16, tmp_path) as controller:
        error = refused(controller.cell_path, "3")
    assert isinstance(error, ExecutionError)
    assert "joint_1 is in mode 4; the motion needs 0" in str(error)
    error = refused(CELL_PATH, "4")
    assert isinstance(error, InputError)
    assert "joint_4 is moved by the motors of axes 4, 5, 6" in str(error)


def test_an_unknown_joint_is_refused_before_connecting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.cli.move.cell_link", lambda *_, **__: pytest.fail("connected"))
    way = ["move", str(CELL_PATH), "--joint", "knee", "--by", "2", "-o", str(tmp_path)]
    error = CliRunner().invoke(app, way).exception
    assert isinstance(error, InputError)
    assert "'knee' is not a joint" in str(error)


def test_a_campaign_keeps_its_moves_and_knows_its_start(campaign: Campaign, tmp_path: Path) -> None:
    root = tmp_path / "campaign"
    shutil.copytree(campaign.folder.root, root)
    before = Campaign.open(root)
    names = {entry.name for entry in before.folder.manifest()}
    ran(str(root), "--to", "start")
    after = Campaign.open(root)
    (new,) = {entry.name for entry in after.folder.manifest()} - names
    archive = open_archive(after.folder.archives / new)
    start = after.plan.excitation.trajectory.sample(np.array([0.0]))[0][0]
    np.testing.assert_allclose(set_points(archive)[-1], start, atol=1e-12)
    after.folder.require_unchanged()


def test_where_the_arm_is_already_nothing_is_sent(tmp_path: Path) -> None:
    there = "10,-15,-100,20,60,-30"  # initial_deg of the cell
    assert ran(str(CELL_PATH), "--to", there, "-o", str(tmp_path))["outcome"] == "there"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("0,0,-90,0,130,0", r"joint_5 would go to 130°, its limits are -120° and 120°"),
        ("0,95,-170,0,60,0", r"collision of link_1 and link_6"),
    ],
)
def test_an_infeasible_move_is_refused(target: str, reason: str, ns16: Cell) -> None:
    with pytest.raises(MotionRefusedError, match=reason):
        plan_move(ns16, ns16.initial, posture(ns16, target))


def test_a_refused_move_says_its_reason_once(tmp_path: Path) -> None:
    cell = tmp_path / "cell.toml"
    text = CELL_PATH.read_text().replace('urdf = "', f'urdf = "{CELL_PATH.parent}/')
    bound = next(line for line in text.splitlines() if line.startswith("following_error"))
    cell.write_text(text.replace(bound, f"following_error = {[1e-4] * 6}"))
    words = ["move", str(cell), "--joint", "1", "--by", "5", "-o", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert isinstance(result.exception, ExecutionError)
    assert str(result.exception) == "the motion ended refused."
    reason = open_archive(str(tmp_path / "move_000_a1.mcap")).outcome.entries["reason"]
    said = f"{result.output}\nerror: {result.exception}"
    assert said.count("allowed is 1e-05 motor revolutions") == said.count("allowed is") == 1
    assert "allowed is" in reason
    assert said.count("move_000_a1.mcap") == 1


def test_the_path_is_checked_and_not_only_its_ends(ns16: Cell) -> None:
    """A wall between two free postures."""
    text = ns16.text.replace(
        "walls = []", "walls = [{ lower = [0.9, -0.1, 0.0], upper = [1.6, 0.1, 1.8] }]"
    )
    walled = Cell.from_texts(text, ns16.urdf, ns16.path)
    left = posture(walled, "60,20,-80,0,30,0")
    right = posture(walled, "-60,20,-80,0,30,0")
    plan_move(ns16, left, right)  # free without the wall
    for end in (left, right):
        plan_move(walled, end, turned(walled, end, "6", 10.0))
    with pytest.raises(MotionRefusedError, match="and box 0"):
        plan_move(walled, left, right)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "one target is needed"),
        (["--to", "home", "--joint", "1"], "one target is needed"),
        (["--joint", "1"], ""),
        (["--to", "home", "--only-axis"], ""),
        (["--to", "there"], "6 angles in degrees"),
        (["--to", "1,2,3"], "6 angles in degrees"),
        (["--to", "1,2,3,4,5,nan"], "6 angles in degrees"),
    ],
)
def test_one_target_of_six_angles_is_asked_for(arguments: list[str], problem: str) -> None:
    result = CliRunner().invoke(app, ["move", str(CELL_PATH), *arguments])
    assert isinstance(result.exception, InputError)
    assert problem in str(result.exception)


def test_a_real_controller_is_not_driven_without_confirmation(
    ns16: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link is declared real; the controller is still simulated."""
    with UdpController.started(ns16, tmp_path) as controller:
        monkeypatch.setattr("drivers.transports.udp.UdpSpec.is_local", False)
        arguments = ["move", str(controller.cell_path), "--to", "home", "-o", str(tmp_path / "m")]
        result = CliRunner().invoke(app, arguments)
        assert isinstance(result.exception, UnsafeError)
        assert "the path needs confirmation" in str(result.exception)
        result = CliRunner().invoke(app, [*arguments, "--yes", "--speed", "100"])
        assert isinstance(result.exception, UnsafeError)
        assert FASTER_THAN_APPROACH in str(result.exception)
    assert not (tmp_path / "m").exists()  # nothing moves without an archive


def test_nothing_is_connected_during_a_run_of_the_campaign(
    campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "campaign"
    shutil.copytree(campaign.folder.root, root)
    connected: list[object] = []
    monkeypatch.setattr("hil.cli.move.cell_link", lambda *a, **_: connected.append(a))
    with Campaign.open(root).folder.locked():
        result = CliRunner().invoke(app, ["move", str(root), "--to", "start", "--json"])
    assert isinstance(result.exception, CampaignFolderError)
    assert not connected


@pytest.mark.parametrize("answer", ["n\n", "\x03"], ids=["no", "Ctrl-C"])
def test_on_a_terminal_a_move_is_shown_and_can_be_declined(tmp_path: Path, answer: str) -> None:
    with on_terminal("-m", "hil", "move", CELL_PATH, "--to", "home", "-o", tmp_path) as end:
        end.await_seen(b"[y/N]")
        # Pressed in the moment between question and reading, Python forgets it: pressed again.
        while end.process.poll() is None:
            end.press(answer)
            until = time.monotonic() + 2.0
            while end.process.poll() is None and time.monotonic() < until:
                end.look()
        assert end.end() == 130
        for phrase in (b"joint_5", b"peak speed", b"nothing was sent"):
            assert phrase in end.seen
    assert not list(tmp_path.iterdir())
