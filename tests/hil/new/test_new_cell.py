"""`hil new`: a cell file in which every figure is known, or named as missing."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from drivers.c4g_packets import InitPacket
from drivers.init_check import verify_controller
from drivers.transports.udp import UdpSpec
from hil.archive import ImportedSamples, write_samples
from hil.base.errors import ArchiveError, ControllerError, InputError
from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignPlan, Stop, design
from hil.cell import Cell
from hil.cell.arms import Links
from hil.cell.errors import UnknownFieldsError
from hil.cli import app
from hil.control.motion_checks import collision_checker
from hil.control.simulated_cell import simulated_link
from hil.control.simulator_process import SIMULATE_COMMAND, free_port
from hil.importers.imported_robot import Robot
from hil.new import cell_of_urdf, from_archive
from hil.new.cell_text import with_fixed
from hil.new.cell_values import _nothing_moves
from hil.new.notes import FixedOutside, GripperJoints, SeveralBranches
from hil.testing import shortened
from identification.excitation.collision_messages import unchecked_text
from identification.model.joint_ranges import urdf_limits
from sim_fixtures.ns16 import CELL_PATH, URDF_PATH
from tests.hil.new_cells import TWO_JOINTS, described_robot, filled_in
from tests.hil.simulated_logs import urdf_path

pytestmark = pytest.mark.long

UR10 = "ur_description/urdf/ur10_robot.urdf"
PANDA = "panda_description/urdf/panda.urdf"
TALOS_ARM = "talos_data/robots/talos_left_arm.urdf"
ON_THE_WIRE = (
    "gear_ratio", "calibration", "k54", "k64", "k65", "current_limit", "following_error"
)  # fmt: skip


def new(urdf: Path, output: Path, *options: str) -> dict[str, list[str]]:
    """Summary that `hil new --json` prints."""
    arguments = ["new", "--urdf", str(urdf), "-o", str(output), "--json", *options]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    summary: dict[str, list[str]] = json.loads(result.stdout.splitlines()[-1])
    return summary


@pytest.fixture
def two_joints(tmp_path: Path) -> Path:
    path = tmp_path / "two.urdf"
    path.write_text(TWO_JOINTS)
    return path


def test_values_missing_in_a_urdf_are_unknown_and_listed(two_joints: Path, tmp_path: Path) -> None:
    summary = new(two_joints, tmp_path / "cell.toml")
    limits = tomllib.loads((tmp_path / "cell.toml").read_text())["limits"]
    assert limits["frame"] == "urdf"
    assert limits["lower_deg"] == [pytest.approx(-np.degrees(2.0), abs=1e-3), "?"]
    assert limits["velocity_deg"] == [pytest.approx(np.degrees(2.5), abs=1e-3), "?"]
    assert limits["torque"] == [150.0, 60.0]
    assert limits["acceleration_deg"] == limits["jerk_deg"] == ["?", "?"]
    assert {"limits.lower_deg", "limits.jerk_deg", "workspace.walls"} <= set(summary["unknown"])
    with pytest.raises(UnknownFieldsError) as refused:
        Cell.load(tmp_path / "cell.toml")
    named = [field.partition(" ")[0] for field in refused.value.fields]
    assert sorted(named) == sorted(summary["unknown"])
    text = str(refused.value)
    assert "limits.lower_deg (entry 2): lower position limits in degrees" in text
    assert "jog each joint" in text
    assert "init packet" in text


def test_one_question_mark_in_any_list_is_found(tmp_path: Path) -> None:
    cell = Cell.load(CELL_PATH)
    text = cell.text.replace("jerk_deg = [5166.67, 5166.67", 'jerk_deg = [5166.67, "?"')
    with pytest.raises(UnknownFieldsError, match=r"one field unknown.*\n.*\(entry 2\)"):
        Cell.from_texts(text, cell.urdf, tmp_path / "cell.toml")


@pytest.mark.parametrize(
    ("robot", "home"),
    [
        ("two", [10.0, 20.0]),
        (UR10, [0.0, -90.0, 90.0, -90.0, -90.0, 0.0]),
        (PANDA, [0.0, -30.0, 0.0, -120.0, 0.0, 90.0, 0.0]),
    ],
)
def test_a_filled_in_cell_runs_a_campaign(
    robot: str, home: list[float], two_joints: Path, tmp_path: Path
) -> None:
    """Of arms with two, six and seven joints; every motion of it passes its checks."""
    urdf = two_joints if robot == "two" else described_robot(robot)
    path = tmp_path / "cell" / "cell.toml"
    summary = new(urdf, path)
    fixed = ["panda_finger_joint1", "panda_finger_joint2"] if robot == PANDA else []
    assert [note.split()[0] for note in summary["notes"]] == fixed  # as they are prismatic
    near = {
        "limits__lower_deg": [angle - 50.0 for angle in home],
        "limits__upper_deg": [angle + 40.0 for angle in home],
    }
    text = filled_in(
        path, len(home), campaign__home_deg=home, workspace__margin=0.002, limits__torque=[], **near
    )
    path.write_text(text)
    cell = shortened(Cell.load(path))
    assert list(cell.joint_names) == summary["joints"]
    allowed = urdf_limits(cell.urdf, cell.joint_names)
    assert np.all(cell.joint_limits.velocity <= allowed.velocity * (1.0 + 1e-5))
    plan = design(cell, Silent())
    plan = CampaignPlan(plan.excitation, validation=plan.validation[:1])
    campaign = Campaign.create(tmp_path / "campaign", cell, plan)
    campaign.run(simulated_link(cell), Stop(), Silent(), durable=False, unrehearsed=True)
    assert len(campaign.folder.completed("excitation")) == 2


@pytest.mark.parametrize(
    ("robot", "home", "floor"),
    [
        (UR10, [0.0, -90.0, 0.0, 0.0, 0.0, 0.0], 0.0),
        (PANDA, [0.0, 0.0, 0.0, -90.0, 0.0, 90.0, 0.0], 0.0),
        (TALOS_ARM, [82.5, 0.0, -67.5, 0.0, 0.0, 0.0, -30.0], "none"),
    ],
)
def test_a_design_begins_where_the_arm_is_clear(
    robot: str, home: list[float], floor: float | str, tmp_path: Path
) -> None:
    """Joints are turned by 90° where zero is a contact; an arm that hangs has no floor at zero."""
    summary = new(described_robot(robot), tmp_path / "cell.toml", "--design-only")
    cell = Cell.load(tmp_path / "cell.toml")
    assert (cell.campaign.home_deg, cell.file.workspace.floor) == (home, floor)
    checker = collision_checker(cell)
    assert checker.clear(cell.home[None]).tolist() == [True]
    assert unchecked_text(checker.exceptions) in summary["notes"]
    comments = " ".join(line.lstrip("# ") for line in cell.text.splitlines())
    assert all(f"Note: {note}" in comments for note in summary["notes"])


@pytest.mark.parametrize(
    ("robot", "home"),
    [(UR10, [0.0, -90.0, 0.0, 0.0, 0.0, 0.0]), (PANDA, [0.0, 0.0, 0.0, -90.0, 0.0, 0.0, 0.0])],
)
def test_an_arm_without_its_meshes_begins_above_the_floor(
    robot: str, home: list[float], tmp_path: Path
) -> None:
    """And what could not be checked is said: at zero the arm of UR lies on the floor."""
    urdf = tmp_path / "alone.urdf"
    urdf.write_bytes(described_robot(robot).read_bytes())
    summary = new(urdf, tmp_path / "cell.toml", "--design-only")
    written = tomllib.loads((tmp_path / "cell.toml").read_text())
    assert written["campaign"]["home_deg"] == home
    assert summary["unknown"] == ["cell.mesh_folders"]
    (note,) = [note for note in summary["notes"] if "collision shapes" in note]
    assert "5 cm off the floor" in note
    links = ("forearm_link", "wrist_3_link") if robot == UR10 else ("panda_link4", "panda_hand")
    assert all(link in note for link in links)


def test_shapes_that_are_there_are_checked_where_others_are_not(tmp_path: Path) -> None:
    urdf = tmp_path / "two.urdf"
    mesh = '<mesh filename="package://gone/lower.stl"/>'
    urdf.write_text(
        TWO_JOINTS.replace('<box size="0.06 0.06 0.2"/>', mesh).replace('0 0 1"', '0 0 0.3"')
    )
    summary = new(urdf, tmp_path / "cell.toml", "--design-only")
    written = tomllib.loads((tmp_path / "cell.toml").read_text())
    (note,) = [note for note in summary["notes"] if "collision shapes" in note]
    assert "shapes of lower were not found" in note
    assert written["workspace"]["floor"] == 0.0
    # Upright the arm is clear; turned by 90° its box would reach below the floor.
    assert written["campaign"]["home_deg"] == [0.0, 0.0]


@pytest.mark.parametrize("joint", ["panda_finger_joint1", "panda_joint4"])
def test_a_fixed_joint_has_the_dynamics_of_a_locked_one(joint: str) -> None:
    """Against pinocchio's own reduction of the whole model."""
    urdf = described_robot(PANDA).read_text()
    held = 0.021
    model = pin.buildModelFromXML(urdf)
    posture = pin.neutral(model)
    posture[model.joints[model.getJointId(joint)].idx_q] = held
    reduced = pin.buildReducedModel(model, [model.getJointId(joint)], posture)
    fixed = pin.buildModelFromXML(with_fixed(urdf, {joint: held}))
    rng = np.random.default_rng(3)
    q, qd, qdd = rng.uniform(-0.5, 0.5, (3, fixed.nq))
    ours = pin.rnea(fixed, fixed.createData(), q, qd, qdd)
    theirs = pin.rnea(reduced, reduced.createData(), q, qd, qdd)
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_an_archive_gives_its_cell_and_init_packet(campaign: Campaign, tmp_path: Path) -> None:
    archive = campaign.folder.completed("excitation")[0]
    summary = new(URDF_PATH, tmp_path / "cell.toml", "--from-archive", str(archive))
    assert summary["unknown"] == []
    assert any("simulated" in note for note in summary["notes"])
    written = Cell.load(tmp_path / "cell.toml")
    original = campaign.cell
    assert written.file.drive_train == original.file.drive_train
    assert written.file.limits == original.file.limits
    assert written.file.simulation == original.file.simulation
    np.testing.assert_array_equal(written.home, original.home)


def refused(*arguments: object) -> Exception:
    """The error of `hil new`."""
    error = CliRunner().invoke(app, ["new", *map(str, arguments)]).exception
    assert isinstance(error, Exception)
    return error


def test_an_archive_of_another_arm_is_refused(
    campaign: Campaign, two_joints: Path, tmp_path: Path
) -> None:
    archive = campaign.folder.completed("excitation")[0]
    arguments = ("--urdf", two_joints, "-o", tmp_path / "c.toml", "--from-archive", archive)
    error = refused(*arguments)
    assert isinstance(error, ArchiveError)
    assert "the URDF has hip, knee" in str(error)
    assert not (tmp_path / "c.toml").exists()


def test_the_init_packet_is_read_over_udp(tmp_path: Path) -> None:
    port = free_port()
    simulator = subprocess.Popen(
        [*SIMULATE_COMMAND, str(CELL_PATH), "--udp", f"127.0.0.1:{port}", "--json",
         "--duration", "60"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    try:
        summary = new(
            URDF_PATH, tmp_path / "cell.toml",
            "--from-controller", f"127.0.0.1:{port}", "--bind", "127.0.0.1", "--wait", "60",
        )  # fmt: skip
    finally:
        simulator.terminate()
        output = simulator.communicate(timeout=60)[0]
    written = tomllib.loads((tmp_path / "cell.toml").read_text())
    truth = tomllib.loads(CELL_PATH.read_text())
    for name in ON_THE_WIRE:
        assert written["drive_train"][name] == truth["drive_train"][name], name
    assert written["controller"]["cycle_ms"] == truth["controller"]["cycle_ms"]
    assert (written["controller"]["host"], written["controller"]["port"]) == ("127.0.0.1", port)
    assert "drive_train.joint_sign" in summary["unknown"]  # which no packet contains
    assert json.loads(output.splitlines()[-1])["rejected"] == 0  # every answer was a good one


def test_reading_the_init_packet_cannot_move_the_arm() -> None:
    """Any drive train but the placeholder makes the session unusable, and no archive is there."""
    settings = _nothing_moves(UdpSpec("127.0.0.1", 1, "127.0.0.1"), 6, 1)
    drives = Cell.load(CELL_PATH).drive_train
    init = InitPacket.build(
        6, 2, {"gear_ratio": drives.gear_ratio, "calibration": drives.calibration}
    )
    assert verify_controller(settings.drive_train, settings.period, init, 1)
    assert settings.needs_archive


def test_without_a_controller_no_file_is_written(tmp_path: Path) -> None:
    error = refused(
        "--urdf", URDF_PATH, "-o", tmp_path / "c.toml", "--wait", "0.2",
        "--from-controller", f"127.0.0.1:{free_port()}", "--bind", "127.0.0.1",
    )  # fmt: skip
    assert isinstance(error, ControllerError)
    assert "start this command first" in str(error)
    assert not (tmp_path / "c.toml").exists()


def test_files_are_replaced_only_with_force(two_joints: Path, tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text("mine")
    assert isinstance(refused("--urdf", two_joints, "-o", path), InputError)
    assert path.read_text() == "mine"
    new(two_joints, path, "--force")
    assert path.read_text() != "mine"


def test_mimic_joints_are_fixed_with_a_note(two_joints: Path, tmp_path: Path) -> None:
    """In a copy with a name of its own, should the cell file be called like the URDF."""
    follows = '<mimic joint="hip" multiplier="-1" offset="0.3"/><limit effort="60" velocity="0"/>'
    text = TWO_JOINTS.replace('<limit effort="60" velocity="0"/>', follows)
    two_joints.write_text(text)
    summary = new(two_joints, two_joints.with_suffix(".toml"))
    assert summary["joints"] == ["hip"]
    (note,) = summary["notes"]
    assert note.startswith("knee follows hip (<mimic>)") and "fixed at 0.3 rad" in note
    assert two_joints.read_text() == text
    cell = tomllib.loads(two_joints.with_suffix(".toml").read_text())["cell"]
    assert cell["urdf"] == "two_fixed.urdf"
    model = pin.buildModelFromXML((tmp_path / "two_fixed.urdf").read_text())
    assert [*model.names][1:] == ["hip"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--fix", "elbow"], "has no moving joint elbow; it has hip, knee"),
        (["--fix", "hip=high"], "'hip=high' is not NAME=NUMBER"),
        (["--from-controller", "a:b"], "is not HOST or HOST:PORT"),
        (["--from-controller", "a:70000"], "is not HOST or HOST:PORT"),
        (["--from-controller", "a:\N{SUPERSCRIPT TWO}"], "is not HOST or HOST:PORT"),
    ],
)
def test_invalid_options_are_refused(
    options: list[str], sentence: str, two_joints: Path, tmp_path: Path
) -> None:
    error = refused("--urdf", two_joints, "-o", tmp_path / "c.toml", *options)
    assert isinstance(error, InputError)
    assert sentence in str(error)


@pytest.mark.parametrize("arm", ["1.0", "7", "true", "nan", '"one"'])
def test_an_archive_without_a_valid_arm_is_of_arm_1(arm: str, tmp_path: Path) -> None:
    packet = InitPacket.build(2, 2, {"gear_ratio": [100.0, -80.0]}).encode()
    cell = f"[controller]\narm = {arm}\n".encode()
    path = write_samples(
        tmp_path / "a.mcap",
        ImportedSamples(
            np.arange(3) * 2_000_000, position=np.zeros((3, 2)), torque=np.ones((3, 2))
        ),
        joint_names=("shoulder", "elbow"),
        metadata={},
        attachments={"cell.toml": cell, "init_packet.bin": packet},
    )
    stated = from_archive(path, ("shoulder", "elbow"))
    assert list(stated.values["drive_train.gear_ratio"]) == [100.0, -80.0]


def test_prismatic_joints_are_fixed_with_a_note(tmp_path: Path) -> None:
    urdf = described_robot(PANDA)
    summary = new(urdf, tmp_path / "panda.toml", "--fix", "panda_finger_joint1=0.02")
    assert len(summary["joints"]) == 7
    (note,) = summary["notes"]
    assert "panda_finger_joint2 is prismatic, and fixed at 0 m" in note
    assert (tmp_path / "panda.urdf").exists()


def scara(folder: Path) -> Path:
    """A SCARA arm whose quill slides along gravity."""
    limit = '<limit lower="0" upper="0.2" velocity="1" effort="100"/>'
    links = "".join(
        f'<link name="{name}"><inertial><mass value="2"/><inertia ixx="0.1" iyy="0.1" izz="0.1" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name in ("base", "upper", "fore", "quill")
    )
    joints = "".join(
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.3 0 0" rpy="{roll} 0 0"/><axis xyz="0 0 1"/>{limit}</joint>'
        for name, kind, parent, child, roll in (
            ("shoulder", "revolute", "base", "upper", 0.0),
            ("elbow", "revolute", "upper", "fore", 0.0),
            ("lift", "prismatic", "fore", "quill", np.pi),
        )
    )
    path = folder / "scara.urdf"
    path.write_text(f'<robot name="scara">{links}{joints}</robot>')
    return path


def test_a_prismatic_joint_along_gravity_is_identified(tmp_path: Path) -> None:
    """Its cell is for recordings: it needs nothing else, and has no table for motion."""
    summary = new(scara(tmp_path), tmp_path / "cell.toml")
    assert summary["joints"] == ["shoulder", "elbow", "lift"] and summary["unknown"] == []
    assert "lift slides along gravity" in summary["notes"][0]
    assert "--fix lift" in summary["notes"][0]
    cell = Cell.load(tmp_path / "cell.toml")
    assert cell.joint_names == ("shoulder", "elbow", "lift") and cell.file.limits is None
    refused = CliRunner().invoke(app, ["design", str(tmp_path / "cell.toml"), "--quick"])
    command = re.search("`hil (new --urdf .* --fix lift)`", str(refused.exception))
    assert command is not None
    arguments = [*shlex.split(command[1]), "-o", str(tmp_path / "others.toml"), "--json"]
    written = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert json.loads(written.stdout)["joints"] == ["shoulder", "elbow"]
    assert "[campaign]" in (tmp_path / "others.toml").read_text()


@pytest.mark.parametrize("option", [("--fix", "lift=0.1"), ("--design-only",)])
def test_it_is_fixed_where_the_arm_is_to_be_moved(tmp_path: Path, option: tuple[str]) -> None:
    summary = new(scara(tmp_path), tmp_path / "cell.toml", *option)
    assert summary["joints"] == ["shoulder", "elbow"]
    assert "[campaign]" in (tmp_path / "cell.toml").read_text()


def test_pipes_and_other_encodings_are_refused(tmp_path: Path, two_joints: Path) -> None:
    """As `hil new --urdf <(xacro robot.xacro)` does."""
    reading, writing = os.pipe()
    os.write(writing, TWO_JOINTS.encode())
    os.close(writing)
    try:
        for read in (partial(cell_of_urdf, fixed={}), Robot.from_urdf):
            with pytest.raises(InputError, match="write it to a file first"):
                read(Path(f"/dev/fd/{reading}"))
    finally:
        os.close(reading)
    with pytest.raises(InputError, match="give a URDF"):
        cell_of_urdf(tmp_path, {})
    two_joints.write_bytes(TWO_JOINTS.replace("hip", "h\xfc").encode("latin-1"))
    with pytest.raises(InputError, match="save it as UTF-8"):
        cell_of_urdf(two_joints, {})


def test_a_file_that_is_not_a_urdf_gives_one_line(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text("<robot/>")
    done = subprocess.run(
        [sys.executable, "-m", "hil", "new", "--urdf", str(tmp_path / "arm.urdf"), "-o",
         str(tmp_path / "c.toml")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()  # and none of the library that read it
    assert line.startswith(f"error: {tmp_path / 'arm.urdf'}: ")
    assert "Traceback" not in done.stderr


HAND = """<robot name="hand">
<link name="base"/><link name="arm"/><link name="tool"/><link name="f"/>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="arm"/></joint>
<joint name="mount" type="fixed"><parent link="arm"/><child link="tool"/></joint>
<joint name="left_finger" type="continuous"><parent link="tool"/><child link="f"/></joint>
</robot>"""


class TestOneArmOfARobot:
    """--base and --tip, and the notes that lead to them."""

    def test_arm_between_two_links(self) -> None:
        baxter = urdf_path("baxter.urdf")
        assert len(cell_of_urdf(baxter, {}).joint_names) == 15
        made = cell_of_urdf(baxter, {}, base="torso", tip="left_wrist")
        assert made.joint_names == (
            "left_s0", "left_s1", "left_e0", "left_e1", "left_w0", "left_w1", "left_w2"
        )  # fmt: skip
        (fixed,) = (note for note in made.values.notes if isinstance(note, FixedOutside))
        assert fixed.links == Links(base="torso", tip="left_wrist")
        assert "right_w2" in fixed.joints
        assert not any(isinstance(note, SeveralBranches) for note in made.values.notes)

    def test_branches_are_named(self) -> None:
        notes = cell_of_urdf(urdf_path("baxter.urdf"), {}).values.notes
        assert SeveralBranches(("head", "left_wrist", "right_wrist")) in notes

    def test_joints_that_look_like_a_gripper_are_named(self, tmp_path: Path) -> None:
        path = tmp_path / "hand.urdf"
        path.write_text(HAND)
        made = cell_of_urdf(path, {})
        assert GripperJoints(("left_finger",), "arm") in made.values.notes
        made = cell_of_urdf(path, {}, tip="tool")
        assert made.joint_names == ("shoulder",)
        assert not any(isinstance(note, GripperJoints) for note in made.values.notes)

    def test_a_wrist_that_carries_a_gripper_is_of_the_arm(self) -> None:
        notes = cell_of_urdf(urdf_path("so101.urdf"), {}).values.notes
        (found,) = (note for note in notes if isinstance(note, GripperJoints))
        assert found.joints == ("gripper",)

    def test_arms_with_hands_are_branches_too(self) -> None:
        notes = cell_of_urdf(urdf_path("talos_reduced.urdf"), {}).values.notes
        (found,) = (note for note in notes if isinstance(note, SeveralBranches))
        assert len(found.ends) == 5 and "arm_left_7_link" in found.ends

    def test_one_arm_of_a_robot_with_too_many_joints(self) -> None:
        tiago = urdf_path("tiago_dual.urdf")
        with pytest.raises(InputError, match=r"101 moving joints.*--base LINK --tip LINK"):
            cell_of_urdf(tiago, {})
        made = cell_of_urdf(tiago, {}, base="torso_lift_link", tip="arm_left_7_link")
        assert made.joint_names == tuple(f"arm_left_{k}_joint" for k in range(1, 8))
        assert made.urdf is not None

    @pytest.mark.parametrize(
        ("links", "sentence"),
        [
            ({"tip": "tol"}, "--tip: has no link 'tol'; the nearest are tool"),
            ({"base": "arm", "tip": "base"}, "link 'base' is not a descendant of link 'arm'"),
            ({"base": "arm", "tip": "tool"}, "no joint moves between arm and tool"),
        ],
    )
    def test_links_that_bound_no_arm_are_refused(
        self, tmp_path: Path, links: dict[str, str], sentence: str
    ) -> None:
        path = tmp_path / "hand.urdf"
        path.write_text(HAND)
        with pytest.raises(InputError, match=sentence):
            cell_of_urdf(path, {}, **links)
