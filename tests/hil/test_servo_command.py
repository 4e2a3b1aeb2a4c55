"""Arms without torque from the command line: a folder of states and commands to a verdict."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.base.one_screen import one_screen
from hil.cli import app
from hil.results.servo_result import ServoResults, is_servo_result
from hil.servo.maker_file import maker_parameters
from hil.servo.messages import screen
from identification.servo.parameters import PLACE
from tests import servo_arm as arm

SO101 = Path(__file__).resolve().parents[3] / "shared" / "data" / "so101"
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
        assert "torque: left out, it is never negative" in lines
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

    def test_the_screen_is_short(self, identified: tuple[Path, str, int]) -> None:
        folder, _, _ = identified
        lines = one_screen(screen(ServoResults.load(folder / "results.json")))
        assert len(lines) <= 24
        assert max(map(len, lines)) <= 100
        assert any(line.startswith("slow.mcap") for line in lines)


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
            ("no xml", "is no XML"),
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
