"""A log with commanded and measured positions and no torque, from the command line."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive.recording_of_archive import open_recording
from hil.base.errors import InputError
from hil.cli import app
from hil.results.provenance import RESULTS
from hil.results.rollout_result import ROLLOUT, RolloutResult
from hil.results.servo_result import ServoResults
from tests import messages
from tests.identification.servo_arm import DELAY, KP, TRUE, an_arm, on_its_servo
from tests.identification.two_link import URDF
from tests.near import near

pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

COMMAND = "commanded_position=command{}"


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    """The positions of a simulated arm at 250 Hz, with the noise of an encoder."""
    folder = tmp_path_factory.mktemp("servo")
    time, position, _, command = on_its_servo(an_arm(), disturbance=0.3, duration=24.0)
    noise = 1e-5 * np.random.default_rng(1).standard_normal(position.shape)
    columns = np.column_stack([time, position + noise, command])[::4]
    header = "t,q1,q2,command1,command2"
    np.savetxt(folder / "log.csv", columns, delimiter=",", header=header, comments="")
    (folder / "robot.urdf").write_text(URDF)
    return folder / "log.csv"


@pytest.fixture(scope="module")
def archive(log: Path) -> Path:
    path = log.with_suffix(".mcap")
    done = run("import", "log", log, "--urdf", log.with_name("robot.urdf"), "--columns", COMMAND,
               "-o", path)  # fmt: skip
    assert done.exit_code == 0, done.output
    return path


def run(*arguments: object):
    return CliRunner().invoke(app, [*map(str, arguments)])


def test_commanded_positions_are_imported(log: Path, archive: Path) -> None:
    recording = open_recording(archive)
    columns = np.loadtxt(log, delimiter=",", skiprows=1)
    assert recording.torque is None
    assert recording.position == near(columns[:, 1:3])
    assert recording.commanded_position == near(columns[:, 3:])


@pytest.mark.long
def test_the_servo_is_identified_as_far_as_determined(archive: Path, tmp_path: Path) -> None:
    done = run("rollout", archive, "--polish", "-o", tmp_path)
    assert done.exit_code == 0, done.exception
    result = RolloutResult.load(tmp_path / ROLLOUT)
    assert result.servo is not None
    rows = {parameter.name: parameter for parameter in result.servo.parameters}
    for joint in range(2):
        gain = rows[f"kp_{joint + 1}"]
        assert gain.determined
        assert gain.value == pytest.approx(KP[joint], rel=0.05)
        assert rows[f"f0_{joint + 1}"].value == pytest.approx(TRUE[joint, 3], rel=0.15)
    assert result.servo.delay == pytest.approx(DELAY, abs=0.003)
    assert not rows["f1_1"].determined
    assert messages.BY_MASSES_OF_URDF in done.output
    assert "Not determined: f1_1, f1_2." in done.output
    for number, joint in enumerate(result.joint_names, 1):
        assert re.search(rf"^{number} {joint} +[\d.]+ ± ", done.output, re.M), done.output
    assert result.identified.overall(2) < result.nominal.overall(2)  # at 0.5 s
    assert result.identified.unstable == 0
    assert "nan" not in (tmp_path / ROLLOUT).read_text().lower()


@pytest.fixture(scope="module")
def identified(archive: Path) -> Path:
    """The folder of an archive with what `hil identify` writes."""
    folder = archive.with_name("out")
    folder.mkdir()
    shutil.copy(archive, folder)
    done = run("identify", folder / archive.name, "-o", folder)
    assert done.exit_code in (0, 5), done.exception
    return folder


@pytest.mark.long
def test_an_identification_finds_the_servo(identified: Path) -> None:
    results = ServoResults.load(identified / RESULTS)
    gains = {row.joint: row for row in results.servo if row.name == "kp"}
    for joint, planted in zip(results.joint_names, KP, strict=True):
        assert gains[joint].lower < planted < gains[joint].upper


@pytest.mark.long
def test_the_servo_of_an_identification_is_simulated(identified: Path) -> None:
    """Its values and its verdict hold, and windows are closer than the whole motion."""
    done = run("rollout", identified)
    results = ServoResults.load(identified / RESULTS)
    assert done.exit_code == (0 if results.verdict.good else 5), done.exception
    rolled_out = RolloutResult.load(identified / ROLLOUT)
    stored = results.simulators["mujoco"]
    values = {(row.name, row.joint): row.value for row in stored.servo}
    assert rolled_out.servo is not None
    rows = {parameter.name: parameter.value for parameter in rolled_out.servo.parameters}
    terms = {"kp": "kp", "Im": "armature", "f0": "coulomb", "f1": "viscous"}
    for number, joint in enumerate(results.joint_names, 1):
        for name, term in terms.items():
            assert rows[f"{name}_{number}"] == values[term, joint]
    (played,) = stored.validation
    # Windows start as the arm moved; from the first sample on, it starts at rest.
    assert 1e3 * rolled_out.identified.overall(3) < played.position_error_mrad
    assert "nan" not in (identified / ROLLOUT).read_text().lower()


@pytest.mark.long
def test_the_servo_of_an_identification_is_found_anew_on_demand(identified: Path) -> None:
    done = run("rollout", identified, "--again", "-o", identified.with_name("again"))
    assert done.exit_code == 0, done.exception
    again = RolloutResult.load(identified.with_name("again") / ROLLOUT)
    assert again.servo is not None
    assert "kd_1" in {parameter.name for parameter in again.servo.parameters}


def test_an_identification_of_a_log_asks_for_the_commands(log: Path, tmp_path: Path) -> None:
    unnamed = tmp_path / "log.csv"
    head, rows = log.read_text().split("\n", 1)
    unnamed.write_text(
        "\n".join([head.replace("command", "channel").replace("target", "channel"), rows])
    )
    refused = run("identify", unnamed, "--urdf", log.with_name("robot.urdf"))
    assert "commanded positions (--columns 'commanded_position=NAME{}')" in str(refused.exception)


def test_its_servo_cannot_be_stated(archive: Path) -> None:
    refused = run("rollout", archive, "--polish", "--servo", "1000,10,0")
    assert isinstance(refused.exception, InputError)
    assert "from which it is identified" in str(refused.exception)


def test_without_masses_there_is_no_torque_to_compare_with(log: Path, tmp_path: Path) -> None:
    urdf = tmp_path / "massless.urdf"
    parts = URDF.split("<inertial>")
    urdf.write_text("".join([parts[0], *(part.split("</inertial>")[1] for part in parts[1:])]))
    archive = tmp_path / "massless.mcap"
    run("import", "log", log, "--urdf", urdf, "--columns", COMMAND, "-o", archive)
    refused = run("rollout", archive, "--polish")
    assert isinstance(refused.exception, InputError)
    assert "has no torque, and the URDF no masses" in str(refused.exception)


def test_without_commands_neither(log: Path, tmp_path: Path) -> None:
    text = tmp_path / "map.toml"
    text.write_text('[time]\ncolumn = "t"\n[position]\ncolumns = "q{}"\n')
    archive = tmp_path / "positions.mcap"
    run("import", "log", log, "--urdf", log.with_name("robot.urdf"), "--map", text, "-o", archive)
    refused = run("rollout", archive, "--polish")
    assert isinstance(refused.exception, InputError)
    assert "the recordings have no commanded positions" in str(refused.exception)


def test_a_folder_without_torque_needs_no_option(log: Path, tmp_path: Path) -> None:
    """As `hil identify` leaves it: archives that have no torque, and no commands either here."""
    text = tmp_path / "map.toml"
    text.write_text('[time]\ncolumn = "t"\n[position]\ncolumns = "q{}"\n')
    archive = tmp_path / "identified" / "positions.mcap"
    archive.parent.mkdir()
    run("import", "log", log, "--urdf", log.with_name("robot.urdf"), "--map", text, "-o", archive)
    refused = run("rollout", archive.parent)
    assert isinstance(refused.exception, InputError)
    assert "the recordings have no commanded positions" in str(refused.exception)
