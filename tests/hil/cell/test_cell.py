"""A cell file is checked once; every error names file, field, value and remedy."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pinocchio as pin
import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from drivers.transports.udp import UdpSpec
from hil.campaign.folder import MESH, MISSING, checksums
from hil.cell import AngleFrame, Cell, CellError
from hil.cell.errors import models_of
from hil.cell.schema import CanTable, CellFile
from hil.design import preset, problem_of
from identification.model.joint_ranges import urdf_limits
from identification.model.motion import Motion
from sim_fixtures.ns16 import CELL_PATH, URDF_PATH
from sim_fixtures.plant import build_model
from tests.hil.new_cells import TWO_JOINTS
from tests.hil.simulated_logs import urdf_path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "ns16.urdf").write_bytes(URDF_PATH.read_bytes())
    (tmp_path / "cell.toml").write_bytes(CELL_PATH.read_bytes())
    return tmp_path


@pytest.fixture(scope="module")
def ns16() -> Cell:
    return Cell.load(CELL_PATH)


def edited(folder: Path, *edits: tuple[str, str]) -> Path:
    """The cell file with the first match of each regex replaced; "$" appends."""
    path = folder / "cell.toml"
    text = path.read_text("utf-8")
    for old, new in edits:
        if old == "$":
            text += f"\n{new}\n"
            continue
        text, count = re.subn(old, new.replace("\\", r"\\"), text, count=1, flags=re.M)
        assert count == 1, old
    path.write_text(text, "utf-8")
    return path


def error_of(folder: Path, *edits: tuple[str, str]) -> str:
    """What a cell file gets in which the first match of each regex was replaced."""
    path = edited(folder, *edits)
    with pytest.raises(CellError) as caught:
        Cell.load(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


def loaded(folder: Path, *edits: tuple[str, str]) -> Cell:
    return Cell.load(edited(folder, *edits))


def test_the_ns16_cell_describes_six_joints_and_58_parameters(ns16: Cell) -> None:
    """Limits of the teach pendant become angles of the URDF, and back."""
    assert ns16.joint_names == tuple(f"joint_{i}" for i in range(1, 7))
    assert ns16.model.n_parameters == 58
    limits = ns16.joint_limits
    assert np.degrees(limits.lower) == pytest.approx([-180, -140, -20, -360, -120, -360])
    assert np.degrees(limits.upper) == pytest.approx([180, 5, 260, 360, 120, 360])
    shown = np.array(ns16.campaign.home_deg)
    frame = AngleFrame.pendant(ns16)
    assert np.degrees(ns16.controller_angles(ns16.home)) == pytest.approx(shown)
    assert frame.shown(frame.urdf(shown)) == pytest.approx(shown)


SPRING = """[[robot.elements]]
kind = "torsion_spring"
joint = "joint_2"
rest_deg = 5.0
identified = true
"""
BALANCER = """[[robot.elements]]
kind = "hydraulic_balancer"
joint = "joint_2"
base_distance = 0.8
link_distance = 0.2
angle_deg = 5.0
length = 0.6
area = 1.67e-3
pressure = 16.3e6
volume = 1e-3
"""


FAULTS = [
    # One value.
    (r"^cycle_ms = 1", "cycle_ms = 3", "controller.cycle_ms = 3", "1, 2 or 4 ms"),
    (r"^name = .*", "", "cell.name", "add it"),
    (r"^fly = 0.5", "flyby = 0.5", "campaign.flyby", "valid fields"),
    (r"^k54 = 0.03", "k54 = nan", "drive_train.k54 = nan", "axis 4 into motor 5"),
    (r"^gear_ratio = \[-116.0", "gear_ratio = [0.0", "gear_ratio of joint 1 is 0",
     "motor revolutions per joint"),
    (r"^upper_deg = \[180.0", "upper_deg = [-200.0", "not below upper_deg", "correct one of them"),
    (r'^transport = "simulated"', 'transport = "can"', "needs a table [controller.can]", "add it"),
    (r"^velocity_deg = \[155.0, ", "velocity_deg = [", "limits.velocity_deg", "6 joints"),
    (r"^urdf = .*", 'urdf = "other.urdf"', "cell.urdf", "put a URDF at"),
    (r"^port = 1000", "port = ", "is not TOML", "correct that line"),
    (r"^lower_deg = \[-180.0", "lower_deg = [-190.0", "limits.upper_deg", "exceeds the"),
    (r"^velocity_deg = \[155.0", "velocity_deg = [156.0", "velocity_deg", "exceeds the"),
    (r"^stop = .*", "stop = { acceleration = 9, jerk = 3 }", "bounds.stop", "at most 5"),
    (r"^stop = .*", "stop = { acceleration = 1.1, jerk = 3 }", "bounds", "correct that table"),
    (r"^home_deg = \[0.0, 0.0", "home_deg = [0.0, 99.0", "campaign.home_deg", "posture"),
    (r"^elasticity = .*", "elasticity = [1e-6]", "simulation.elasticity", "or none"),
    (r'"limits.jerk_deg"', '"limits.jrk_deg"', "cell.assumed", "table.field"),
    (r"^walls = .*", "walls = [{ lower = [1, 0, 0], upper = [0, 1, 1] }]", "workspace",
     "correct that table"),
    # Text is no number and no truth value.
    (r"^rotor_inertia = true", 'rotor_inertia = "yes"', "robot.rotor_inertia = 'yes'"),
    (r"^repetitions = 30", 'repetitions = "30"', "campaign.repetitions = '30'"),
    (r"^\[controller\]$", "[controller]\nother_axes = [[1, 0]]", "controller.other_axes"),
    # Whole tables.
    (r"^\[limits\]\n(?:[^\[].*\n|\n)*", "", "limits: is missing", "add a table [limits]"),
    (r"^\[robot\]$", "[robot]\nlocked = { joint_6 = 0.1 }", "robot.locked", "[limits]"),
    ("$", '[robot.friction.joints.joint_9]\nthird = "none"', "robot.friction.joints", "joint_9"),
    (r"^\[robot.friction\]", '[robot.friction]\nsprings = ["joint_9"]', "robot.friction.springs",
     "joint_9"),
    ("$", '[robot.friction.joints.joint_5]\nthirds = "none"', "robot.friction.joints.joint_5",
     "third"),
    ("$", '[robot.friction.joints.joint_5]\nstandstill = 0.0\nzone = "linear"',
     "robot.friction.joints.joint_5", "standstill"),
    ("$", "[robot.coupling]\nmotor_from_joint = [[1.0]]", "robot.coupling.motor_from_joint",
     "6 rows"),
    ("$", "[robot.coupling]\nmotor_from_joint = 3", "robot.coupling.motor_from_joint",
     "row per motor"),
    ("$", '[robot.payload]\nmass = 1.0\ncentre = [0.0, 0.0, 0.0]\nframe = "hand"',
     "robot.payload", "link_6"),
    ("$", SPRING.replace("torsion_", "leaf_"), "robot.elements[0].kind = 'leaf_spring'", "torsion"),
    ("$", SPRING.replace("kind", "sort"), "robot.elements[0].kind: is missing", "torsion_spring"),
    ("$", SPRING.replace("joint_2", "joint_9"), "robot.elements[0].joint", "joint_6"),
    ("$", SPRING + "free_length = 1.0", "elements[0].free_length", "valid fields", "rest_deg"),
    ("$", SPRING.replace("true", "false"), "robot.elements[0]", "neither a stiffness nor"),
    ("$", SPRING + SPRING, "robot.elements", "spring_2b", "distinguished", "state its values"),
    ("$", BALANCER.replace("volume = 1e-3", "volume = 1e-4"), "robot.elements[0]", "the gas has",
     "m³"),
]  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault[2])
def test_a_bad_field_gets_a_sentence(folder: Path, fault: tuple[str, ...]) -> None:
    old, new, *phrases = fault
    sentence = error_of(folder, (old, new))
    for word in phrases:
        assert word in sentence


def test_a_missing_file_and_a_missing_table_are_named(folder: Path) -> None:
    with pytest.raises(CellError, match=r"nothing\.toml.*cannot be read"):
        Cell.load(folder / "nothing.toml")
    (folder / "cell.toml").write_text('[cell]\nname = "x"\nurdf = "ns16.urdf"\n')
    bare = Cell.load(folder / "cell.toml")
    with pytest.raises(CellError, match=r"drive_train: is missing"):
        _ = bare.drive_train


def test_settings_of_earlier_versions_are_ignored(folder: Path) -> None:
    """Archives contain the cell files of their time."""
    removed = "\n[simulation.payload]\nmass = 2.0\ncentre = [0.0, 0.0, 0.1]\n"
    cell = loaded(folder, (r"\[controller\]", "[controller]\npackets = true"), ("$", removed))
    assert cell.joint_names == Cell.load(CELL_PATH).joint_names


def test_a_second_transmission_does_not_widen_the_limits(folder: Path) -> None:
    urdf = folder / "ns16.urdf"
    again = '<transmission name="t"><joint name="joint_2"/></transmission></robot>'
    urdf.write_text(urdf.read_text("utf-8").replace("</robot>", again), "utf-8")
    assert "exceeds the" in error_of(
        folder, (r"^upper_deg = \[180.0, 95.0", "upper_deg = [180.0, 165.0")
    )


def test_a_cell_is_moved_and_changed_in_its_text_too(folder: Path, ns16: Cell) -> None:
    path = edited(folder, (r'^urdf = "', 'urdf = "models/'))
    (folder / "models").mkdir()
    (folder / "ns16.urdf").rename(folder / "models" / "ns16.urdf")
    moved = Cell.load(path).with_urdf(folder / "models" / "cell.toml", "robot.urdf")
    assert (moved.file.cell.urdf, moved.urdf) == ("robot.urdf", URDF_PATH.read_text("utf-8"))
    cell = ns16.with_campaign(repetitions=7, simulation_seed=5)
    again = Cell.from_texts(cell.text, cell.urdf, cell.path)
    assert (again.campaign.repetitions, again.simulation.seed, again.campaign.seed) == (7, 5, 1)


def test_link_and_session_are_as_the_cell_describes_them(ns16: Cell) -> None:
    """What a bus cannot carry is refused with the bus named."""
    with pytest.raises(CellError, match=r"has no link.*write one of \"udp\", "):
        ns16.transport_spec()
    local = ns16.with_link(transport="udp", host="127.0.0.1", port=2001, bind="127.0.0.1")
    assert local.transport_spec() == UdpSpec("127.0.0.1", 2001, "127.0.0.1")
    linked = ns16.with_link(arm=2, other_axes=[[1, 7], [2, 1]])
    assert linked.session_settings() == {
        "mode": 4,
        "arm": 2,
        "max_gap": 2,
        "other_axes": frozenset({(1, 7), (2, 1)}),
        "settle_cycles": round(ns16.campaign.settle_s / ns16.period),
    }
    adapter = CanTable(interface="virtual", channel="arm", profile="fd")
    on_bus = ns16.with_link(transport="can", can=adapter)
    again = on_bus.with_link(can=adapter.model_copy(update={"channel": "other"}))
    assert (on_bus.controller.can, again.controller.can.channel) == (adapter, "other")
    assert again.text.count("[controller.can]") == 1
    with pytest.raises(CellError, match=r"controller\.can: CAN: 8 frames .* use a longer cycle"):
        ns16.with_link(transport="can", cycle_ms=1, can=adapter).transport_spec()
    for host in ("127.0.0.1", "127.1.2.3", "10.2.12.150", "controller"):
        reached = ns16.with_link(transport="udp", host=host)
        assert reached.only_simulated is host.startswith("127.")


@pytest.mark.parametrize("profile", ["", 'profile = "fd"', 'profile = "classic"'])
def test_classic_can_is_refused_with_what_to_write(folder: Path, profile: str) -> None:
    """Cell files of earlier versions may name it."""
    adapter = f'[controller.can]\ninterface = "slcan"\nchannel = "/dev/ttyACM0"\n{profile}\n'
    table = (r"^\[drive_train\]$", f"{adapter}\n[drive_train]")
    file = edited(folder, (r"^transport = .*$", 'transport = "can"'), table)
    if "classic" not in profile:
        assert Cell.load(file).controller.can.profile == "fd"
        return
    with pytest.raises(CellError) as refused:
        Cell.load(file)
    assert refused.value.field == "controller.can.profile"
    assert 'write profile = "fd"' in refused.value.remedy
    assert 'transport = "udp"' in refused.value.remedy


def test_the_third_nominal_coefficient_may_be_left_out(folder: Path, ns16: Cell) -> None:
    """And a whole number is a number."""
    cell = loaded(folder, (r"^third = \[0.*\n", ""), ("margin = 0.05", "margin = 1"))
    assert cell.nominal.third == []
    assert cell.workspace.margin == 1.0
    np.testing.assert_array_equal(cell.nominal_values(), ns16.nominal_values())


def test_limits_without_a_drive_train_are_checked_by_the_urdf(ns16: Cell) -> None:
    limits = ns16.text[ns16.text.index("[limits]") : ns16.text.index("[drive_train]")]
    for old, new in (('"controller"', '"urdf"'), ("upper_deg = [180.0", "upper_deg = [999")):
        limits = limits.replace(old, new)
    with pytest.raises(CellError, match="exceeds the"):
        Cell.from_texts(f'[cell]\nname = "x"\nurdf = "u"\n{limits}', ns16.urdf, Path("cell.toml"))


def test_a_sliding_joint_in_degrees_is_refused_by_name(folder: Path) -> None:
    text = (folder / "ns16.urdf").read_text("utf-8")
    sliding = re.sub(r'(name="joint_3"\s+type=)"revolute"', r'\1"prismatic"', text)
    (folder / "ns16.urdf").write_text(sliding, "utf-8")
    sentence = error_of(folder, ("^margin = 0.05", "margin = 0.04"))
    for phrase in ("cell.toml: limits: is in degrees", "joint_3 is prismatic", 'type = "fixed"'):
        assert phrase in sentence
    (folder / "cell.toml").write_text('[cell]\nname = "x"\nurdf = "ns16.urdf"\n', "utf-8")
    assert Cell.load(folder / "cell.toml").model.n_joints == 6  # recordings of it can be used


def test_a_joint_may_have_friction_of_its_own(folder: Path) -> None:
    joint_table = '[robot.friction.joints.joint_5]\nthird = "none"\nstribeck = 0.1\nzone = "linear"'
    laws = loaded(folder, ("$", joint_table)).model.friction.laws
    assert (laws[4].symbols, laws[4].stribeck) == (("f0", "f1", "fs"), 0.1)
    # Other fields are those of all joints.
    assert laws[4].standstill == laws[0].standstill
    assert laws[0].symbols == ("f0", "f1", "f2")


def test_the_coupled_wrist_is_a_parameter_when_asked_for(folder: Path, ns16: Cell) -> None:
    assert ns16.model.base.rank == 40
    cell = loaded(folder, ("$", '[robot.coupling]\nmotor_from_joint = "drive_train"'))
    assert cell.model.base.rank == 43
    assert cell.model.parameter_names[40:43] == ("I45", "I46", "I56")
    values = dict(zip(cell.model.parameter_names, cell.nominal_values(), strict=True))
    assert values["I45"] == values["f0_m6"] == 0.0


class TestElements:
    def test_identified_ones_are_parameters(self, folder: Path) -> None:
        cell = loaded(folder, ("$", f"{SPRING}stiffness = 30.0\n{BALANCER}identified = true"))
        assert cell.model.parameter_names[-2:] == ("spring_2", "balancer_2")
        np.testing.assert_array_equal(cell.nominal_values()[-2:], [30.0, 1.0])

    def test_known_ones_are_known_torque(self, folder: Path, ns16: Cell) -> None:
        """At a right angle between the anchors the lever is D k / l, the force p A."""
        cell = loaded(folder, ("$", BALANCER))
        assert cell.model.parameter_names == ns16.model.parameter_names
        q = np.zeros((1, 6))
        q[0, 1] = np.radians(85.0)
        length = np.hypot(0.8, 0.2)
        force = 1.67e-3 * 16.3e6 * 1e-3 / (1e-3 - (length - 0.6) * 1.67e-3)
        torque = cell.model.load_torque(Motion.at_rest(q))
        np.testing.assert_allclose(torque[0, 1], 0.16 / length * force)

    def test_ripple_is_of_every_joint_with_a_gear(self, ns16: Cell) -> None:
        rippled = ns16.with_friction(ripple=[2]).model
        assert rippled.n_parameters == ns16.model.n_parameters + 2 * 6
        wrist = rippled.elements.elements[5]
        assert [*wrist.turns.values()] == ns16.drive_train.motor_from_joint[5].tolist()


def test_a_cell_of_recordings_locks_joints(folder: Path) -> None:
    path = folder / "small.toml"
    text = '[cell]\nname = "six"\nurdf = "ns16.urdf"\n[robot]\nlocked = { joint_6 = 0.1 }\n'
    path.write_text(text, "utf-8")
    assert Cell.load(path).joint_names == tuple(f"joint_{i}" for i in range(1, 6))
    path.write_text(text.replace("joint_6 =", "joint_7 ="), "utf-8")
    with pytest.raises(CellError, match=r"robot\.locked.*joint_7.*joint_6"):
        Cell.load(path)


# --- The tables of docs/cell-file.md are those of the schema, and its example works

DOCUMENT = Path(__file__).parents[3] / "docs" / "cell-file.md"


def tables(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Every table that a cell file may have, by its dotted name."""
    for name, info in model.model_fields.items():
        for part in models_of(info.annotation):
            kind = part.model_fields.get("kind")
            for suffix in (
                [""]
                if kind is None
                else [f".{kind_name}" for kind_name in get_args(kind.annotation)]
            ):
                full = f"{prefix}{name}{suffix}"
                yield full, part
                yield from tables(part, f"{full}.")


def default_text(info: FieldInfo) -> str:
    """A default as the document writes it."""
    if info.is_required():
        return "required"
    value = info.get_default(call_default_factory=True)
    if value is None:
        return "not set"
    if not isinstance(value, BaseModel):
        return f"`{json.dumps(value)}`"
    if all(not field.is_required() for field in type(value).model_fields.values()):
        return "its own"
    inline = ", ".join(f"{key} = {json.dumps(entry)}" for key, entry in value)
    return f"`{{ {inline} }}`"


def documented() -> dict[str, dict[str, str]]:
    """Of each table in a heading: its fields' defaults as the rows below say."""
    defaults: dict[str, dict[str, str]] = {}
    here: list[str] = []
    for line in DOCUMENT.read_text("utf-8").splitlines():
        if line.startswith("#"):
            here = re.findall(r"`\[+([a-z_.]+)\]+`", line)
            if kinds := re.findall(r"`kind = \"([a-z_]+)\"`", line):
                here = [f"{name}.{kind}" for name in here for kind in kinds]
            defaults |= {name: {} for name in here}
        row = re.fullmatch(r"\| `(\w+)` \| (.+?) \| (.+) \|", line)
        for name in here if row else ():
            assert row[1] not in defaults[name], f"{row[1]} stands twice in {name}"
            defaults[name][row[1]] = row[2]
    return defaults


def test_document_and_schema_have_the_same_fields_and_defaults() -> None:
    schema: dict[str, Any] = {
        name: {field: default_text(info) for field, info in model.model_fields.items()}
        for name, model in tables(CellFile)
    }
    # Of one joint, only what is written counts.
    schema["robot.friction.joints"] = dict.fromkeys(schema["robot.friction.joints"], "not set")
    assert documented() == schema


def test_the_worked_example_can_be_designed_for_with_all_checks(tmp_path: Path) -> None:
    urdf = urdf_path("ur10_robot.urdf")
    (tmp_path / "ur10_robot.urdf").write_bytes(urdf.read_bytes())
    (tmp_path / "share").symlink_to(urdf.parents[4])  # with the meshes
    (example,) = re.findall(
        r"```toml\n(\[cell\]\nname = \"UR10\".*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL
    )
    (tmp_path / "cell.toml").write_text(example, "utf-8")
    problem = problem_of(Cell.load(tmp_path / "cell.toml"), preset("b"))
    assert problem.constraints.currents is not None
    assert ("base_link", "upper_arm_link") in problem.constraints.checker.pairs


DRAKES = TWO_JOINTS.replace('"1.0"', '"1.0" encoding="GB2312"').replace(
    "<robot ", '<robot xmlns="http://drake.mit.edu" xmlns:gazebo="x" gazebo:y="z" '
)


def test_a_default_namespace_changes_no_limit_inertia_or_mesh(tmp_path: Path) -> None:
    """A simulated joint that turns on and on has one angle."""
    limits = urdf_limits(DRAKES, ["hip", "knee"])
    np.testing.assert_array_equal(limits, urdf_limits(TWO_JOINTS, ["hip", "knee"]))
    assert limits.upper[0] == 2.0
    bare, drakes = (
        build_model(text, (0.0, 0.0, -9.81), np.zeros(2), (1.1, 0.9))
        for text in (TWO_JOINTS, DRAKES)
    )
    masses = [inertia.mass for inertia in drakes.inertias]
    assert masses == [inertia.mass for inertia in bare.inertias]
    assert masses[1] == 1.1 * pin.buildModelFromXML(TWO_JOINTS).inertias[1].mass
    assert drakes.nq == 2
    urdf = DRAKES.replace('<box size="0.08 0.08 0.3"/>', '<mesh filename="a.stl"/>')
    assert checksums({"robot.urdf": urdf.encode()}, tmp_path)[f"{MESH}a.stl"] == MISSING
