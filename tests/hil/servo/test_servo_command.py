"""Arms without torque from the command line: a folder of states and commands to a verdict."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import Mock
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import servo_arm as arm
from hil.archive import open_archive
from hil.base.errors import InputError, SourceError
from hil.base.one_screen import one_screen
from hil.cli import app
from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.look import look_at
from hil.look.readings import Fact, NextStep, NoJointTorque
from hil.look.result import Row
from hil.results.servo_result import (
    ServoContact,
    ServoFree,
    ServoPush,
    ServoResults,
    ServoSpan,
    is_servo_result,
)
from hil.servo.maker_file import maker_parameters
from hil.servo.messages import screen, verdict_of
from identification.servo.parameters import PLACE
from tests.near import near

SO101 = Path(__file__).resolve().parents[4] / "shared" / "data" / "so101"
MICROSECONDS = 1e6


def written(folder: Path, truth: arm.Planted, rng: np.random.Generator, duration: float) -> Path:
    """Write a recording as a servo's logger does: two files, lists in cells, microseconds, load."""
    folder.mkdir()
    time, command = arm.commands(rng, duration)
    position = arm.simulated(truth, time, command)
    load = np.round(np.abs(command - position) * 10.0 / 0.0228) * 0.0228
    velocity = np.gradient(position, time, axis=0)

    def cells(row: np.ndarray) -> str:
        return f'"{[float(number) for number in row]}"'

    state = ["type,timestamp,positions,velocities,torques"]
    control = ["type,timestamp,positions"]
    for k, stamp in enumerate(time * MICROSECONDS):
        parts = ",".join(map(cells, (position[k], velocity[k], load[k])))
        state.append(f"STATE_MOTOR,{stamp},{parts}")
        control.append(f"CONTROL,{stamp},{cells(command[k])}")
    (folder / "state_motor.csv").write_text("\n".join(state) + "\n")
    (folder / "control.csv").write_text("\n".join(control) + "\n")
    (folder / "event.csv").write_text("type,timestamp,event\nEVENT,0,START\n")
    return folder


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, int]:
    """Folder of results, output and exit status."""
    root = tmp_path_factory.mktemp("servo")
    rng = np.random.default_rng(5)
    truth = arm.Planted.drawn(rng)
    fitted = written(root / "fast", truth, rng, 30.0)
    unseen = written(root / "slow", truth, rng, 12.0)
    (root / "arm.urdf").write_text(arm.urdf())
    maker = '<default><joint armature="0.03"/><position kp="20" forcerange="-3 3"/></default>'
    (root / "maker.xml").write_text(maker)
    done = CliRunner().invoke(
        app,
        ["identify", str(fitted), "--predict", str(unseen), "--urdf", str(root / "arm.urdf"),
         "--compare", str(root / "maker.xml"), "-o", str(root / "out"), "-v"],
    )  # fmt: skip
    return root / "out", done.output, done.exit_code


@pytest.mark.long
class TestCommand:
    def test_a_folder_of_states_and_commands_gives_a_verdict(
        self, identified: tuple[Path, str, int]
    ) -> None:
        folder, output, status = identified
        assert status == 0, output
        results = ServoResults.load(folder / "results.json")
        (unseen,) = results.validation
        assert results.verdict.good
        assert unseen.position_error_mrad < 5.0
        assert unseen.position_error_mrad < 0.2 * unseen.command_error_mrad
        assert unseen.compared_error_mrad is not None
        assert unseen.position_error_mrad < unseen.compared_error_mrad

    def test_the_load_of_a_servo_is_left_out_and_said(
        self, identified: tuple[Path, str, int]
    ) -> None:
        _, output, _ = identified
        lines = " ".join(output.split())
        assert (
            "torque: ignored, as it looks like the load or duty cycle of a servo: it is never"
            " negative" in lines
        )
        assert "--columns 'torque=NAME'" in lines

    def test_files_are_written(self, identified: tuple[Path, str, int]) -> None:
        folder, _, _ = identified
        names = {path.name for path in folder.iterdir()}
        assert {"results.json", "report.html", "motion.png", "fast.mcap", "slow.mcap"} <= names
        page = (folder / "report.html").read_text()
        assert "maker.xml" in page
        assert "Servo report" in page

    def test_its_results_are_told_from_those_of_an_arm(
        self, identified: tuple[Path, str, int]
    ) -> None:
        folder, _, _ = identified
        assert is_servo_result(folder / "results.json")
        document = json.loads((folder / "results.json").read_text())
        assert {value["name"] for value in document["servo"]} == set(PLACE)

    def test_a_touched_arm_is_said(self, identified: tuple[Path, str, int]) -> None:
        folder, _, _ = identified
        results = ServoResults.load(folder / "results.json")
        (unseen,) = results.validation
        assert not unseen.pushed
        push = ServoPush(joint="lift", time=35.6, change_mrad=-60.0)
        touched = results.model_copy(
            update={"validation": [unseen.model_copy(update={"pushed": (push,)})]}
        )
        (warning,) = [w for w in verdict_of(touched).warnings if "something pushed" in w]
        assert "lift by -60 mrad at 35.6 s" in warning

    def test_errors_are_told_with_and_without_what_held_the_arm(
        self, identified: tuple[Path, str, int]
    ) -> None:
        """It is judged without, and neither figure is left out."""
        folder, _, _ = identified
        results = ServoResults.load(folder / "results.json")
        (unseen,) = results.validation
        assert not unseen.contacts
        assert unseen.free is None
        contacts = tuple(
            ServoContact(joint=joint, start=start, end=end, torque=-1.0)
            for joint, start, end in (("lift", 3.5, 6.5), ("elbow", 3.8, 7.0), ("lift", 9.0, 10.5))
        )
        free = ServoFree(
            share=0.6,
            position_error_mrad=7.98,
            joint_errors_mrad=[7.98] * 3,
            command_error_mrad=31.9,
        )
        held = unseen.model_copy(
            update={
                "contacts": contacts,
                "free": free,
                "position_error_mrad": 25.3,
                "command_error_mrad": 31.6,
            }
        )
        verdict = verdict_of(results.model_copy(update={"validation": [held]}))
        assert verdict.good
        assert "25.3, 7.98 where nothing held it" in verdict.line
        (warning,) = [text for text in verdict.warnings if "held the arm" in text]
        assert "3.5 to 7.0 s, 9.0 to 10.5 s" in warning
        mostly = held.model_copy(update={"free": free.model_copy(update={"share": 0.4})})
        assert not verdict_of(results.model_copy(update={"validation": [mostly]})).good

    def test_a_model_that_misses_much_of_the_motion_is_not_good(
        self, identified: tuple[Path, str, int]
    ) -> None:
        """However bad the commands: such as those of another joint, or late by a second."""
        folder, _, _ = identified
        results = ServoResults.load(folder / "results.json")
        (unseen,) = results.validation
        assert results.verdict.good
        update = {"position_error_mrad": 200.0, "command_error_mrad": 560.0, "motion_mrad": 350.0}
        missed = results.model_copy(update={"validation": [unseen.model_copy(update=update)]})
        assert not verdict_of(missed).good
        near = unseen.model_copy(update={**update, "position_error_mrad": 100.0})
        assert verdict_of(results.model_copy(update={"validation": [near]})).good

    def test_a_fitted_motion_that_something_held_is_said(
        self, identified: tuple[Path, str, int]
    ) -> None:
        folder, _, _ = identified
        results = ServoResults.load(folder / "results.json")
        assert results.fitted_contacts == {}
        contact = ServoContact(joint="lift", start=3.5, end=6.5, torque=-1.0)
        held = results.model_copy(update={"fitted_contacts": {"fast.mcap": [contact]}})
        assert any("fast.mcap, which was fitted" in text for text in verdict_of(held).warnings)
        span = ServoSpan(start=3.0, end=7.0)
        apart = verdict_of(held.model_copy(update={"left_out": {"fast.mcap": [span]}}))
        (told,) = [text for text in apart.warnings if "fast.mcap" in text]
        assert "from 3.0 to 7.0 s: this part was not fitted" in told

    def test_a_delay_between_two_clocks_is_not_known(
        self, identified: tuple[Path, str, int]
    ) -> None:
        folder, _, _ = identified
        results = ServoResults.load(folder / "results.json")
        assert results.delay_known
        apart = results.model_copy(update={"delay_known": False})
        assert "command delay unknown" in "\n".join(one_screen(screen(apart)))

    def test_results_and_report_say_what_was_read(self, identified: tuple[Path, str, int]) -> None:
        folder, _, _ = identified
        results = ServoResults.load(folder / "results.json")
        assert [(read.file, read.use) for read in results.recordings] == [
            ("fast", "fitted"),
            ("slow", "predicted"),
        ]
        for read in results.recordings:
            assert any(change.startswith("torque: ignored, as") for change in read.changes)
        assert "torque: ignored, as" in (folder / "report.html").read_text()

    def test_the_screen_is_short(self, identified: tuple[Path, str, int]) -> None:
        folder, _, _ = identified
        lines = one_screen(screen(ServoResults.load(folder / "results.json")))
        assert len(lines) <= 24
        assert max(map(len, lines)) <= 100
        assert any(line.startswith("slow.mcap") for line in lines)


def exported(folder: Path, *options: object) -> tuple[int, str]:
    """Return status of an export of results, and its output or why it was refused."""
    done = CliRunner().invoke(app, ["export", str(folder), *map(str, options)])
    return done.exit_code, f"{done.output}{done.exception or ''}"


def identified_values(folder: Path, engine: str, name: str) -> dict[str, float]:
    """Return a parameter with the terms of an engine by joint."""
    servo = ServoResults.load(folder / "results.json").simulators[engine].servo
    return {value.joint: value.value for value in servo if value.name == name}


def executed(path: Path) -> dict[str, Any]:
    """Return what a Python file defines."""
    space: dict[str, Any] = {}
    exec(compile(path.read_text(), str(path), "exec"), space)
    return space


@pytest.mark.long
class TestExports:
    def test_mujoco_plays_the_held_out_motion_back(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        folder, _, _ = identified
        path = tmp_path / "arm.xml"
        done = CliRunner().invoke(
            app, ["export", str(folder), "--to", "mjcf", "-o", str(path), "--json"]
        )
        assert done.exit_code == 0, done.output
        (played,) = json.loads(done.stdout)["played_back"]
        simple = ServoResults.load(folder / "results.json").simulators["mujoco"].validation[0]
        # MuJoCo is an integrator of its own, and moves all joints at once.
        assert played["error"] == pytest.approx(simple.position_error_mrad, rel=0.15)
        assert played["error"] < 0.2 * played["command"]

    def test_an_mjcf_has_position_actuators_with_delay(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        mujoco = pytest.importorskip("mujoco")
        folder, _, _ = identified
        path = tmp_path / "arm.xml"
        assert exported(folder, "--to", "mjcf", "-o", path)[0] == 0
        model = mujoco.MjModel.from_xml_path(str(path))
        for name in arm.NAMES:
            actuator = model.actuator(name).id
            dof = model.joint(name).dofadr[0]
            kp = identified_values(folder, "mujoco", "kp")[name]
            assert model.actuator_gainprm[actuator, 0] == pytest.approx(kp)
            assert model.actuator_biasprm[actuator, 1] == pytest.approx(-kp)
            delay = identified_values(folder, "mujoco", "delay")[name]
            assert model.actuator_delay[actuator] == pytest.approx(delay)
            for term, attribute in (
                ("coulomb", model.dof_frictionloss),
                ("viscous", model.dof_damping),
                ("armature", model.dof_armature),
            ):
                value = identified_values(folder, "mujoco", term)[name]
                assert attribute[dof] == pytest.approx(value, rel=1e-6)

    def test_isaac_lab_gets_drives_with_friction_and_delay_in_steps(
        self,
        identified: tuple[Path, str, int],
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        folder, _, _ = identified
        path = tmp_path / "arm.py"
        assert exported(folder, "--to", "isaaclab", "-o", path)[0] == 0
        isaaclab = ModuleType("isaaclab.actuators")
        isaaclab.DelayedPDActuatorCfg = SimpleNamespace  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "isaaclab", ModuleType("isaaclab"))
        monkeypatch.setitem(sys.modules, "isaaclab.actuators", isaaclab)
        drives = executed(path)["actuators"](physics_dt=0.005)
        assert list(drives) == list(arm.NAMES)
        for name, drive in drives.items():
            assert drive.joint_names_expr == [name]
            kp = identified_values(folder, "physx", "kp")[name]
            assert drive.stiffness == pytest.approx(kp, rel=1e-5)
            assert drive.dynamic_friction <= drive.friction
            delay = identified_values(folder, "physx", "delay")[name]
            assert drive.min_delay == drive.max_delay == round(delay / 0.005)

    def test_genesis_gets_the_values_of_each_dof(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        folder, _, _ = identified
        path = tmp_path / "arm.py"
        assert exported(folder, "--to", "genesis", "-o", path)[0] == 0
        entity = Mock()
        places = dict(zip(arm.NAMES, (2, 0, 1), strict=True))
        entity.get_joint = lambda name: SimpleNamespace(dofs_idx_local=[places[name]])
        executed(path)["apply"](entity)
        values, dofs = entity.set_dofs_kp.call_args.args
        kp = identified_values(folder, "mujoco", "kp")
        assert dofs == [2, 0, 1]
        assert values == pytest.approx([kp[name] for name in arm.NAMES], rel=1e-5)
        for setter in ("armature", "damping", "frictionloss", "force_range"):
            assert getattr(entity, f"set_dofs_{setter}").called

    def test_genesis_itself_reads_the_values_back(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        """genesis-world needs no GPU, but 3 GB: it is tried where it is installed."""
        genesis = pytest.importorskip("genesis", reason="genesis-world is not installed")
        folder, _, _ = identified
        path, urdf = tmp_path / "arm.py", tmp_path / "arm.urdf"
        assert exported(folder, "--to", "genesis", "-o", path)[0] == 0
        urdf.write_text(arm.urdf())
        genesis.init(backend=genesis.cpu, logging_level="error")
        scene = genesis.Scene(show_viewer=False)
        entity = scene.add_entity(genesis.morphs.URDF(file=str(urdf), fixed=True))
        scene.build()
        drives = executed(path)
        drives["apply"](entity)
        dofs = [entity.get_joint(name).dofs_idx_local[0] for name in arm.NAMES]
        for field in ("KP", "ARMATURE", "DAMPING", "FRICTIONLOSS"):
            found = getattr(entity, f"get_dofs_{field.lower()}")(dofs)
            stated = [drives[field][name] for name in arm.NAMES]
            assert np.asarray(found) == pytest.approx(stated, rel=1e-5)

    def test_ranges_contain_the_values_and_say_where_they_are_from(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        folder, _, _ = identified
        path = tmp_path / "arm.xml"
        assert exported(folder, "--to", "mjcf", "-o", path, "--ranges", "--ensemble", 4)[0] == 0
        document = json.loads((tmp_path / "arm.ranges.json").read_text())
        fields = document["ranges"]
        assert set(fields) == {
            "kp", "forcerange", "delay", "frictionloss", "damping", "armature", "offset"
        }  # fmt: skip
        for field in fields.values():
            for entry in field.values():
                low, value, high = (
                    np.inf if entry[end] is None else entry[end] for end in ("low", "value", "high")
                )
                assert low <= value <= high
                assert entry["from"] in ("data", "prior")
        assert {entry["from"] for entry in fields["kp"].values()} == {"data"}
        assert fields["kp"]["lift"]["unit"] == "N·m/rad"
        assert np.shape(document["draws"]["kp"]) == (4, 3)
        mujoco = pytest.importorskip("mujoco")
        for k in range(4):
            model = mujoco.MjModel.from_xml_path(str(tmp_path / f"arm_{k + 1}.xml"))
            kp = document["draws"]["kp"][k]
            assert model.actuator_gainprm[:, 0] == pytest.approx(kp, rel=1e-5)

    def test_draws_are_correlated_as_the_posterior_is(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        folder, _, _ = identified
        path = tmp_path / "arm.py"
        assert exported(folder, "--to", "genesis", "-o", path, "--ensemble", 2000)[0] == 0
        draws = json.loads((tmp_path / "arm.ranges.json").read_text())["draws"]
        results = ServoResults.load(folder / "results.json")
        posterior = results.simulators["mujoco"].posterior
        freedom = results.windows - 1
        of_student = freedom / (freedom - 2)
        for joint in range(3):
            # Coordinates are logarithms of 1 / kp and of friction over kp.
            first = joint * len(PLACE)
            logarithms = np.zeros((2, len(posterior.covariance)))
            logarithms[:, first + PLACE["kp"]] = -1.0
            logarithms[1, first + PLACE["viscous"]] = 1.0
            expected = logarithms @ np.array(posterior.covariance) @ logarithms.T
            found = np.cov([np.log(draws[name])[:, joint] for name in ("KP", "DAMPING")])
            expected = of_student * expected
            np.testing.assert_allclose(found, expected, atol=0.2 * expected.max())

    def test_an_own_mjcf_is_changed_in_place(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        folder, _, _ = identified
        path = tmp_path / "own.xml"
        path.write_text(OWN)
        status, output = exported(folder, "--to", "mjcf", "--into", path)
        assert status == 0, output
        text = path.read_text()
        assert "not read back" in output  # its mesh is not there
        assert "<!-- my arm -->" in text and 'mesh file="hand.stl"' in text
        root = ElementTree.fromstring(text)
        finger = root.find(".//joint[@name='finger']")
        assert finger is not None and finger.attrib == {"name": "finger", "damping": "9"}
        kp = identified_values(folder, "mujoco", "kp")
        by_joint = {node.get("joint"): node for node in root.iter("position")}
        assert set(by_joint) == set(arm.NAMES)
        for name, node in by_joint.items():
            assert float(node.attrib["kp"]) == pytest.approx(kp[name])
        assert by_joint["pan"].get("name") == "m1" and by_joint["pan"].get("ctrlrange") == "-1 1"
        assert "dampratio" not in by_joint["pan"].attrib

    def test_a_changed_copy_of_an_own_file_is_the_output(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        folder, _, _ = identified
        own, changed = tmp_path / "own.xml", tmp_path / "changed" / "arm.xml"
        own.write_text(OWN)
        status, output = exported(folder, "--to", "mjcf", "--into", own, "-o", changed)
        assert status == 0, output
        assert own.read_text() == OWN
        assert "<!-- my arm -->" in changed.read_text() and changed.read_text() != OWN

    def test_a_file_without_the_joints_is_left_as_it_is(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        folder, _, _ = identified
        path = tmp_path / "other.xml"
        path.write_text(OWN.replace('"elbow"', '"other"'))
        before = path.read_text()
        status, output = exported(folder, "--to", "mjcf", "--into", path)
        assert status != 0 and "there is no joint elbow" in output
        assert path.read_text() == before

    def test_an_own_urdf_gets_friction(
        self, identified: tuple[Path, str, int], tmp_path: Path
    ) -> None:
        folder, _, _ = identified
        path = tmp_path / "own.urdf"
        path.write_text(arm.urdf())
        assert exported(folder, "--to", "urdf", "--into", path)[0] == 0
        root = ElementTree.fromstring(path.read_text())
        coulomb = identified_values(folder, "mujoco", "coulomb")
        for joint in root.findall("joint"):
            dynamics = joint.find("dynamics")
            assert dynamics is not None
            friction = float(dynamics.attrib["friction"])
            assert friction == pytest.approx(coulomb[joint.attrib["name"]])

    def test_a_format_without_servos_is_refused(self, identified: tuple[Path, str, int]) -> None:
        folder, _, _ = identified
        status, output = exported(folder, "--to", "sdf")
        assert status != 0 and "which --to sdf does not express" in output


OWN = """<?xml version="1.0"?>
<!-- my arm -->
<mujoco><asset><mesh file="hand.stl"/></asset><worldbody>
  <body><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><joint name="pan"/>
  <body><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><joint name="lift" damping="7"/>
  <body><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><joint name="elbow"/>
  <body><joint name="finger" damping="9"/><geom type="mesh" mesh="hand"/>
  </body></body></body></body>
  </worldbody>
  <actuator><position name="m1" joint="pan" kp="3" dampratio="1" ctrlrange="-1 1"/>
  <motor name="m2" joint="lift" ctrlrange="-9 9"/></actuator></mujoco>
"""


class TestMakerFile:
    JOINTS = ("a", "b")

    def test_classes_are_inherited(self, tmp_path: Path) -> None:
        path = tmp_path / "arm.xml"
        path.write_text("""<mujoco>
          <default><joint damping="1"/>
            <default class="servo"><joint armature="0.02" frictionloss="0.1"/>
              <position kp="17" kv="0.5" forcerange="-3 3"/></default></default>
          <worldbody><body childclass="servo"><joint name="a"/>
            <body><joint name="b" damping="0.2"/></body></body></worldbody>
          <actuator><position class="servo" joint="a"/>
            <position class="servo" joint="b" kp="9"/></actuator></mujoco>""")
        values = maker_parameters(path, self.JOINTS)
        assert values[:, PLACE["kp"]].tolist() == [17.0, 9.0]
        assert values[:, PLACE["viscous"]] == pytest.approx([1.5, 0.7])
        assert values[:, PLACE["armature"]].tolist() == [0.02, 0.02]
        assert values[:, PLACE["limit"]].tolist() == [3.0, 3.0]

    @pytest.mark.parametrize(
        ("text", "problem"),
        [
            ("no xml", "is not XML"),
            ("<mujoco/>", "no position actuator of joint a"),
            ('<default><position kp="none"/></default>', "no number"),
            ('<default><position kp="-1"/></default>', "stiffness of -1"),
        ],
    )
    def test_what_cannot_be_compared_is_refused(
        self, tmp_path: Path, text: str, problem: str
    ) -> None:
        path = tmp_path / "arm.xml"
        path.write_text(text)
        with pytest.raises(InputError, match=problem) as caught:
            maker_parameters(path, self.JOINTS)
        assert caught.value.remedy


@pytest.mark.slow
@pytest.mark.skipif(not SO101.is_dir(), reason="the motions of the SO-101 are not here")
def test_a_real_arm_is_predicted_from_its_commands(tmp_path: Path) -> None:
    """The goals of the command: 8 and 6 mrad of motions whose commands are 16 and 33 off."""
    done = CliRunner().invoke(
        app,
        ["identify", str(SO101 / "chirp_sweep"), str(SO101 / "coupled_joints"),
         "--predict", str(SO101 / "circular_motion"), "--predict",
         str(SO101 / "backlash_detection"), "--urdf", str(SO101 / "robot.urdf"),
         "-o", str(tmp_path / "out")],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    circular, backlash = ServoResults.load(tmp_path / "out" / "results.json").validation
    assert circular.position_error_mrad < 8.0
    assert backlash.position_error_mrad < 6.0


@pytest.fixture(scope="module")
def lerobot_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log as LeRobot's robots name it: degrees, loads 340 times the torque of the motors."""
    folder = tmp_path_factory.mktemp("lerobot")
    rng = np.random.default_rng(7)
    truth = arm.Planted.drawn(rng)
    time, command = arm.commands(rng, 20.0)
    position = arm.simulated(truth, time, command)
    load = np.round(340.0 * truth.kp * (command - position))
    names = [
        "timestamp",
        *(f"{name}.pos" for name in arm.NAMES),
        *(f"{name}.load" for name in arm.NAMES),
        *(f"action.{name}.pos" for name in arm.NAMES),
    ]
    rows = np.column_stack([time, np.degrees(position), load, np.degrees(command)])
    text = "\n".join([",".join(names), *(",".join(map(str, row)) for row in rows.tolist())])
    (folder / "log.csv").write_text(text + "\n")
    (folder / "arm.urdf").write_text(arm.urdf())
    return folder / "log.csv"


def imported_torque(log: Path, *options: str) -> tuple[Any, str]:
    """Return the torque of a log as an identification reads it, None if none, and what it says."""
    output = log.with_name("out.mcap")
    line = ["import", "log", log, "--urdf", log.with_name("arm.urdf"), "--force", "-o", output]
    done = CliRunner().invoke(app, [*map(str, line), *options])
    assert done.exit_code == 0, done.output
    return open_archive(output).columns.get("torque"), " ".join(done.output.split())


def servo_log(
    folder: Path, position: np.ndarray, command: np.ndarray, name: str = "command_{}"
) -> Path:
    """Write a log of positions and commands at 50 Hz, and the description of the arm."""
    names = ["time", *(f"position_{joint}" for joint in arm.NAMES)]
    names += [name.replace("{}", joint) for joint in arm.NAMES]
    rows = np.column_stack([np.arange(len(position)) / arm.RATE, position, command])
    text = "\n".join([",".join(names), *(",".join(map(str, row)) for row in rows.tolist())])
    (folder / "log.csv").write_text(text.replace("nan", "") + "\n")
    (folder / "arm.urdf").write_text(arm.urdf())
    return folder / "log.csv"


@pytest.fixture(scope="module")
def motion() -> tuple[np.ndarray, np.ndarray]:
    """Positions and commands of an arm for 12 s."""
    rng = np.random.default_rng(8)
    time, command = arm.commands(rng, 12.0)
    return arm.simulated(arm.Planted.drawn(rng), time, command), command


def constant(command: np.ndarray) -> np.ndarray:
    return np.tile(command[:1], (len(command), 1))


class TestNonsense:
    """Each ends in one sentence that names the field and what to do."""

    @pytest.mark.parametrize(
        ("change", "field", "problem"),
        [
            (lambda q, c: (q, np.full_like(c, np.nan)), "commanded_position", "known"),
            (lambda q, c: (q, constant(c)), "commanded_position", "no command changes"),
            (lambda q, c: (c, c), "position", "bit for bit"),
            (lambda q, c: (q[:-1], q[1:]), "commanded_position", "of the next sample"),
            (lambda q, c: (q, 1000.0 * c), "commanded_position", "times as far"),
            (lambda q, c: (constant(q), c), "position", "no joint moves"),
            (lambda q, c: (1e6 * q, 1e6 * c), "position", "leaves the limits"),
        ],
        ids=["empty", "constant", "copied", "next state", "millimetres", "still", "no angles"],
    )
    def test_commands_that_are_none_are_refused(self, tmp_path, motion, change, field, problem):
        log = servo_log(tmp_path, *change(*motion))
        done = CliRunner().invoke(
            app,
            ["identify", str(log), "--urdf", str(tmp_path / "arm.urdf"), "-o", f"{tmp_path}/out"],
        )
        assert isinstance(done.exception, InputError | SourceError), done.output
        assert done.exception.field == field
        assert problem in done.exception.problem
        assert done.exception.remedy
        assert not (tmp_path / "out").exists()

    @pytest.mark.long
    def test_a_joint_that_never_moves_takes_only_itself_out(self, tmp_path, motion):
        position, command = motion
        position = position.copy()
        position[:, 1] = position[0, 1]
        log = servo_log(tmp_path, position, command)
        done = CliRunner().invoke(
            app,
            ["identify", str(log), "--urdf", str(tmp_path / "arm.urdf"), "-o", f"{tmp_path}/out"],
        )
        assert done.exit_code == 0, done.output
        results = ServoResults.load(tmp_path / "out" / "results.json")
        assert results.stuck == ["lift"]
        assert not any(value.determined for value in results.servo if value.joint == "lift")
        (rest,) = results.validation
        moving = np.array(rest.joint_errors_mrad)[[0, 2]]
        assert rest.position_error_mrad == near(np.sqrt(np.mean(moving**2)))
        assert any("lift never moved" in warning for warning in results.verdict.warnings)


class TestCommandNames:
    @pytest.mark.parametrize(
        "name",
        ["commanded_position_{}", "target_position_{}", "goal_pos_{}", "cmd_{}", "{}_setpoint"],
    )
    def test_a_word_says_commands_where_there_is_no_torque(self, tmp_path, motion, name):
        assert commanded_in(servo_log(tmp_path, *motion, name)) is not None

    @pytest.mark.parametrize("name", ["cmd_vel_{}", "position_error_{}", "target_effort_{}"])
    def test_other_quantities_are_no_commanded_positions(self, tmp_path, motion, name):
        assert commanded_in(servo_log(tmp_path, *motion, name)) is None

    def test_commands_in_degrees_are_read_as_the_positions_say(self, tmp_path, motion):
        position, command = motion
        np.testing.assert_allclose(
            commanded_in(servo_log(tmp_path, position, np.degrees(command))), command, atol=1e-9
        )


def commanded_in(log: Path) -> np.ndarray | None:
    """Return the commands of a log as an identification reads them; None if it has none."""
    output = log.with_name("out.mcap")
    line = ["import", "log", log, "--urdf", log.with_name("arm.urdf"), "--force", "-o", output]
    done = CliRunner().invoke(app, [*map(str, line)])
    if isinstance(done.exception, InputError | SourceError):
        return None
    assert done.exit_code == 0, done.output
    return open_archive(output).columns.get("commanded_position")


class TestLoad:
    def test_it_is_a_torque_beside_no_commands_only_if_it_is_stated(
        self, lerobot_log: Path
    ) -> None:
        """Nor where there is a torque."""
        rows = [line.split(",") for line in lerobot_log.read_text().splitlines()]
        torque = [name for name in rows[0] if name.endswith(".load")]
        without = [rows[0].index(name) for name in rows[0] if not name.startswith("action.")]
        text = "\n".join(",".join(row[k] for k in without) for row in rows)
        path = lerobot_log.with_name("other.csv")
        path.write_text(text)
        done = CliRunner().invoke(
            app, ["identify", str(path), "--urdf", str(path.with_name("arm.urdf"))]
        )
        assert isinstance(done.exception, InputError | SourceError)
        assert "--columns 'torque=" in str(done.exception)
        both = [name.replace(".load", ".torque") for name in torque]
        head = ",".join([rows[0][k] for k in without] + both)
        body = "\n".join(
            ",".join([row[k] for k in without] + ["1.0"] * len(both)) for row in rows[1:]
        )
        path.write_text(f"{head}\n{body}\n")
        found, _ = imported_torque(path)
        assert (found == 1.0).all()

    def test_a_load_in_a_unit_of_its_own_is_left_out_with_its_factor(
        self, lerobot_log: Path
    ) -> None:
        torque, output = imported_torque(lerobot_log)
        assert torque is None
        (ratio,) = re.findall(
            r"it is ([\d.e+]+) times the torque that the URDF's masses need", output
        )
        assert 250.0 < float(ratio) < 550.0  # 340, and what friction takes of it
        (factor,) = re.findall(r"--columns 'torque=NAME\*([\d.]+)'", output)
        assert float(factor) == pytest.approx(1.0 / float(ratio), rel=0.1)

    @pytest.mark.long
    def test_the_factor_makes_a_torque_of_it(self, lerobot_log: Path) -> None:
        torque, output = imported_torque(lerobot_log, "--columns", "torque={}.load*0.002941")
        assert torque is not None and "left out" not in output
        as_logged, _ = imported_torque(lerobot_log, "--columns", "torque={}.load")
        np.testing.assert_allclose(torque, 0.002941 * as_logged)

    def test_a_look_leaves_it_out_with_its_factor_as_well(self, lerobot_log: Path) -> None:
        _, output = imported_torque(lerobot_log)
        (ratio,) = re.findall(r"it is ([\d.e+]+) times the torque", output)
        (row,) = torque_rows(lerobot_log)
        assert row.reading is Fact.SERVO_LOAD
        assert row.certainty is not Certainty.CERTAIN
        (load,) = row.evidence
        assert isinstance(load, NoJointTorque)
        assert load.ratio == pytest.approx(float(ratio), rel=0.01)

    @pytest.mark.long
    def test_a_look_takes_as_a_torque_what_is_stated(self, lerobot_log: Path) -> None:
        rows = torque_rows(lerobot_log, torque="{}.load")
        assert rows and all(row.reading is not Fact.SERVO_LOAD for row in rows)

    @pytest.mark.parametrize("with_commands", [True, False])
    def test_a_look_leaves_out_a_load_without_sign(
        self, tmp_path: Path, with_commands: bool
    ) -> None:
        rng = np.random.default_rng(5)
        folder = written(tmp_path / "motion", arm.Planted.drawn(rng), rng, 6.0)
        (tmp_path / "arm.urdf").write_text(arm.urdf())
        if not with_commands:
            (folder / "control.csv").unlink()
        (row,) = torque_rows(folder)
        assert row.reading is Fact.SERVO_LOAD
        step = NextStep.IMPORT_COMMANDS if with_commands else NextStep.RECORD_COMMANDS
        assert row.decider is step


def torque_rows(log: Path, **chosen: str) -> list[Row]:
    """Return what a look says of the torque of a log, whose arm is next to it."""
    robot = Robot.from_urdf(log.with_name("arm.urdf"))
    look = look_at(log, lambda _: robot, ImportOptions(chosen=chosen))
    return [row for row in look.rows if row.aspect == "torque"]


@pytest.mark.long
@pytest.mark.skipif(not SO101.is_dir(), reason="the recordings of the SO-101 are absent")
def test_results_of_a_part_are_used_again(
    tmp_path: Path,
) -> None:
    """Its first part was fitted: the files are found again, and the report is the same."""
    folder = tmp_path / "out"
    urdf = str(SO101 / "robot.urdf")

    def run(*words: str) -> tuple[int, str]:
        done = CliRunner().invoke(app, [words[0], str(folder), *words[1:]])
        return getattr(done.exception, "exit_code", done.exit_code), done.output

    CliRunner().invoke(
        app, ["identify", str(SO101 / "chirp_sweep"), "--urdf", urdf, "-o", str(folder)]
    )
    page = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    assert run("report")[0] == 0
    assert (folder / "report.html").read_bytes() == page
    status, output = run("export", "--to", "mjcf")
    assert status == 5
    assert (folder / "identified.xml").is_file(), output
    assert run("rollout")[0] == 5
