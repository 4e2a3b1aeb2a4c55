"""Layouts of loggers that nobody wrote a map for: what is read, and from what it is concluded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hil.base.errors import SourceError
from hil.importers.channels import kind_of
from hil.importers.conclusions import ChannelMeaning, JointOrder, UnusedChannels
from hil.importers.imported_robot import Robot
from hil.importers.messages import sentence
from hil.importers.name_words import kind_by_words
from hil.importers.recording_import import ImportedRecording, ImportOptions, import_recording
from hil.look import look_at
from hil.look.messages import row_text
from tests.hil.importers.moving_log import JOINTS, POSITION, SLOPE, TIME, TORQUE, URDF, Floats

EPOCH = 1_700_000_000


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "three.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path)


def table(path: Path, names: Sequence[str], *columns: Floats, mark: str = ",") -> Path:
    """Write a table; a name with {} is that of a column for each joint, from 1."""
    header = []
    for name, values in zip(names, columns, strict=True):
        count = 1 if values.ndim == 1 else values.shape[1]
        header += [name.replace("{}", str(number)) for number in range(1, count + 1)]
    rows = [mark.join(f"{value:.15g}" for value in row) for row in np.column_stack(columns)]
    path.write_text("\n".join([mark.join(header), *rows]) + "\n")
    return path


def sunrise(path: Path) -> Path:
    """The recorder of an iiwa: a time in two columns, and the robot's name in all others."""
    nanoseconds = np.rint(1e9 * TIME)
    parts = [EPOCH + nanoseconds // 10**9, nanoseconds % 10**9]
    names = ["axisQMsr_LBR_iiwa_7_R800_1[{}]", "axisQCmd_LBR_iiwa_7_R800_1[{}]"]
    names += ["axisTauMsr_LBR_iiwa_7_R800_1[{}]", "axisTauExtMsr_LBR_iiwa_7_R800_1[{}]"]
    values = (POSITION, SLOPE, TORQUE, SLOPE)
    return table(path, ["ZeitInSec", "ZeitInNanoSec", *names], *parts, *values, mark=" ")


def kortex(path: Path) -> Path:
    """A Gen3: joint after joint, degrees from 0 to 360 without a unit, and currents."""
    names = ["time"]
    columns = [TIME]
    for joint in range(3):
        degrees = np.mod(np.degrees(POSITION[:, joint]), 360.0)
        for name, values in (("position", degrees), ("torque", TORQUE[:, joint])):
            names.append(f"actuators[{joint}].{name}")
            columns.append(values)
        names.append(f"actuators[{joint}].current_motor")
        columns.append(SLOPE[:, joint])
    return table(path, names, *columns)


def fast_research(path: Path) -> Path:
    names = ["Time", "MeasuredJointPosition_{}", "CommandedJointPosition_{}", "MeasuredTorque_{}"]
    return table(path, [*names, "ExternalTorque_{}"], TIME, POSITION, SLOPE, TORQUE, SLOPE)


def prefixed(path: Path) -> Path:
    return table(path, ["time", "fr3_q{}", "fr3_dq{}", "fr3_tau{}"], TIME, POSITION, SLOPE, TORQUE)


def servo_names(path: Path) -> Path:
    """Joints by names that the URDF does not have, in its order."""
    names = [f"{joint}.{kind}" for kind in ("pos", "trq") for joint in ("base1", "arm", "wrist")]
    return table(path, ["timestamp", *names], TIME, *POSITION.T, *TORQUE.T)


def desired_beside(path: Path) -> Path:
    names = ["sim_time", "Achse{}_Ist [Grad]", "Achse{}_Soll [Grad]", "Achse{} [Nm]"]
    return table(path, names, TIME, np.degrees(POSITION), np.degrees(SLOPE), TORQUE)


def plot_juggler(path: Path) -> Path:
    names = ["__time", "/joint_states/header/stamp"]
    names += [
        f"/joint_states/{joint}/{kind}" for joint in JOINTS for kind in ("effort", "position")
    ]
    columns = [values[:, joint] for joint in range(3) for values in (TORQUE, POSITION)]
    return table(path, names, 0.3 + EPOCH + TIME, EPOCH + TIME, *columns)


def dates_without_name(path: Path) -> Path:
    text = table(path, ["", "q_{}", "tau_{}"], TIME, POSITION, TORQUE).read_text().splitlines()
    rows = [
        f"2026-11-27 10:00:{float(row.partition(',')[0]):09.6f},{row.partition(',')[2]}"
        for row in text[1:]
    ]
    path.write_text("\n".join([text[0], *rows]) + "\n")
    return path


def lists(bracket: Callable[[Floats], str]) -> Callable[[Path], Path]:
    """`DataFrame.to_csv` of columns whose cells are lists, tuples or arrays."""

    def write(path: Path) -> Path:
        rows = zip(TIME, POSITION, TORQUE, strict=True)
        lines = [f'{time:.15g},"{bracket(q)}","{bracket(tau)}"' for time, q, tau in rows]
        path.write_text("\n".join(["t,q,tau", *lines]) + "\n")
        return path

    return write


def of(time: str, *names: str) -> Callable[[Path], Path]:
    """Names of position, velocity and torque, then of others; {} is a joint from 0.

    JOINT is its name, `Joint` with a capital letter.
    """

    def write(path: Path) -> Path:
        factor = 180.0 / np.pi if any("deg" in name or "°" in name for name in names) else 1.0
        columns = [factor * POSITION, factor * SLOPE, TORQUE, 0.01 * TORQUE, 0.01 * TORQUE]
        header = [time]
        values = [TIME]
        for name, part in zip(names, columns, strict=False):
            numbered = [name.replace("{}", str(joint)) for joint in range(3)]
            for column, joint in zip(numbered, JOINTS, strict=True):
                written = column.replace("JOINT", joint)
                header.append(written.replace("Joint ", f"{joint} ".title()))
            values += [*part.T]
        return table(path, header, *values, mark=";")

    return write


# As these loggers name them: DynamicJointState, Doosan's state, MuJoCo's data, Isaac Gym, a
# Unitree's low state, PyBullet's joint states, the traces of FANUC, KUKA and TwinCAT.
NAMES = {
    "doosan": of(
        "time_stamp", "actual_joint_position[{}]", "actual_joint_velocity[{}]",
        "actual_joint_torque[{}]", "raw_joint_torque[{}]", "external_joint_torque[{}]",
    ),
    "mujoco": of("sim_time", "qpos_{}", "qvel_{}", "qfrc_actuator_{}", "qfrc_bias_{}"),
    "isaac": of("step_time", "dof_pos_{}", "dof_vel_{}", "dof_torque_{}"),
    "unitree": of(
        "tick", "motor_state[{}].q", "motor_state[{}].dq", "motor_state[{}].tau_est",
        "motor_state[{}].temperature",
    ),
    "pybullet": of(
        "t", "JOINT_jointPosition", "JOINT_jointVelocity", "JOINT_appliedJointMotorTorque"
    ),
    "unitree_sdk": of("t", "q{}", "dq{}", "tauEst{}", "tau_ff{}"),
    "gait": of("Time (s)", "Joint angle [deg]", "Joint velocity [deg/s]", "Joint torque [Nm]"),
    "fanuc": of("Tick", "J{} Angle(deg)", "J{} Speed(deg/s)", "J{} Torque(Nm)", "J{} Current(A)"),
    "kuka": of(
        "Zeit [s]", "A{} Istposition [°]", "A{} Istgeschw. [°/s]", "A{} Drehmoment [Nm]"
    ),
    "twincat": of(
        "Time", "GVL.Axis[{}].NcToPlc.ActPos", "GVL.Axis[{}].NcToPlc.ActVelo",
        "GVL.Axis[{}].NcToPlc.ActTorque",
    ),
}  # fmt: skip

ORDER = (2, 0, 1)


def message_rows(joints: Sequence[int]) -> list[str]:
    """Seconds, nanoseconds, frame, then names and values of joints in an order."""
    order = list(joints)
    rows = []
    for time, *values in zip(TIME, POSITION, SLOPE, TORQUE, strict=True):
        nanoseconds = round(1e9 * time)
        stamp = [str(EPOCH + nanoseconds // 10**9), str(nanoseconds % 10**9), "base"]
        numbers = [f"{value:.15g}" for row in values for value in row[order]]
        rows.append(",".join([*stamp, *(JOINTS[joint] for joint in order), *numbers]))
    return rows


def forces_beside_torques(path: Path) -> Path:
    """A sliding joint has a force where the others have a torque."""
    names = [f"{joint} pos" for joint in JOINTS]
    kinds = ("torque [Nm]", "force [N]", "torque [Nm]")
    efforts = [f"{joint} {kind}" for joint, kind in zip(JOINTS, kinds, strict=True)]
    return table(path, ["t", *names, *efforts], TIME, *POSITION.T, *TORQUE.T)


def echo_without_header(path: Path) -> Path:
    """`ros2 topic echo --csv /joint_states`."""
    path.write_text("\n".join(message_rows(ORDER)) + "\n")
    return path


def echo_in_order(path: Path) -> Path:
    path.write_text("\n".join(message_rows((0, 1, 2))) + "\n")
    return path


def echo_with_header(path: Path) -> Path:
    """`rostopic echo -p`, whose joints are in the order of the alphabet."""
    names = ["%time", "field.header.stamp", "field.header.frame_id"]
    fields = ("name", "position", "velocity", "effort")
    names += [f"field.{field}{number}" for field in fields for number in range(3)]
    rows = [row.split(",") for row in message_rows(ORDER)]
    lines = [",".join([f"{row[0]}{int(row[1]):09d}"] * 2 + row[2:]) for row in rows]
    path.write_text("\n".join([",".join(names), *lines]) + "\n")
    return path


LAYOUTS: Mapping[str, Callable[[Path], Path]] = {
    "sunrise": sunrise,
    "kortex": kortex,
    "fast research interface": fast_research,
    "a robot's name before the quantity": prefixed,
    "joints of other names": servo_names,
    "desired beside measured": desired_beside,
    "plotjuggler": plot_juggler,
    "an index of dates": dates_without_name,
    "a force beside torques": forces_beside_torques,
    "ros2 topic echo": echo_without_header,
    "ros2 topic echo in the order of the URDF": echo_in_order,
    "rostopic echo": echo_with_header,
    **NAMES,
    "cells that are lists": lists(lambda row: str(row.tolist())),
    "cells that are tuples": lists(lambda row: str(tuple(row.tolist()))),
    "cells that are arrays": lists(lambda row: str(row).replace(" ", "  ")),
}


def imported(path: Path, robot: Robot) -> ImportedRecording:
    return import_recording(path, path.with_suffix(".mcap"), lambda _: robot)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_read(tmp_path: Path, robot: Robot, layout: str) -> None:
    recording = imported(LAYOUTS[layout](tmp_path / "log.csv"), robot)
    columns = recording.archive.columns
    turns = np.rint((columns["position"] - POSITION) / (2.0 * np.pi))
    assert np.allclose(columns["position"], POSITION + 2.0 * np.pi * turns, rtol=0.0, atol=1e-6)
    assert np.allclose(columns["torque"], TORQUE, rtol=0.0, atol=1e-6)
    elapsed = 1e-9 * (columns["stamp"] - columns["stamp"][0])
    assert np.allclose(elapsed, TIME, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("layout", ["sunrise", "ros2 topic echo", "rostopic echo"])
def test_its_map_reads_it_again(tmp_path: Path, robot: Robot, layout: str) -> None:
    path = LAYOUTS[layout](tmp_path / "log.csv")
    first = imported(path, robot)
    (tmp_path / "map.toml").write_text(first.text or "")
    options = ImportOptions(tmp_path / "map.toml")
    again = import_recording(path, tmp_path / "b.mcap", lambda _: robot, options)
    columns = [recording.archive.columns for recording in (first, again)]
    assert all(np.array_equal(columns[0][name], columns[1][name]) for name in columns[1])


def test_wanted_and_measured_in_german(tmp_path: Path, robot: Robot) -> None:
    path = of("Zeit [s]", "A{} Istwinkel [rad]", "A{} Sollwinkel [rad]", "A{} Moment [Nm]")
    concluded = imported(path(tmp_path / "log.csv"), robot).concluded
    channels = {each.kind: each.channels for each in concluded if isinstance(each, ChannelMeaning)}
    assert channels["position"] == "A0 Istwinkel .. A2 Istwinkel"
    (unused,) = [each for each in concluded if isinstance(each, UnusedChannels)]
    assert unused.channels[0].startswith("A0 Sollwinkel")


def test_a_row_for_each_joint(tmp_path: Path, robot: Robot) -> None:
    rows = [
        {"time": time, "joint": name, "position": q, "effort": tau}
        for time, *values in zip(TIME, POSITION, TORQUE, strict=True)
        for name, q, tau in zip(JOINTS, *values, strict=True)
    ]
    frame = pd.DataFrame(rows)
    frame.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(SourceError, match="row for each joint, named in column joint") as refused:
        imported(tmp_path / "log.csv", robot)
    assert "df.pivot(index='time', columns='joint')" in str(refused.value)
    wide = frame.pivot(index="time", columns="joint")
    wide.columns = pd.Index(["_".join(name) for name in wide.columns])
    wide.to_csv(tmp_path / "wide.csv")
    columns = imported(tmp_path / "wide.csv", robot).archive.columns
    assert np.allclose(columns["position"], POSITION, rtol=0.0, atol=1e-6)


def test_a_missing_torque_is_offered_by_its_words(tmp_path: Path, robot: Robot) -> None:
    path = of("time", "q{}", "omega_x{}", "target_torque{}")(tmp_path / "log.csv")
    with pytest.raises(SourceError, match=r"--columns 'torque=target_torque\{\}'"):
        imported(path, robot)


class TestListsOfAnotherLength:
    def test_of_text_are_named_and_left_out(self, tmp_path: Path, robot: Robot) -> None:
        path = lists(lambda row: str(row.tolist()))(tmp_path / "log.csv")
        lines = path.read_text().splitlines()
        lines[20] = f'{TIME[19]},"[0.1, 0.2]","[1.0, 2.0, 3.0]"'
        path.write_text("\n".join(lines) + "\n")
        with pytest.raises(SourceError, match=r"q: line 21 has a list of 2 numbers.*--drop-miss"):
            imported(path, robot)
        without = ImportOptions(drop_missing=True)
        archive = import_recording(path, tmp_path / "b.mcap", lambda _: robot, without).archive
        assert len(archive.columns["stamp"]) == len(TIME) - 1

    def test_of_a_parquet_are_named(self, tmp_path: Path, robot: Robot) -> None:
        path = tmp_path / "log.parquet"
        frame = pd.DataFrame({"t": TIME, "q": POSITION.tolist(), "tau": TORQUE.tolist()})
        frame.at[7, "q"] = [0.1]
        frame.to_parquet(path)
        with pytest.raises(SourceError, match="q: row 7 has a list of 1 numbers") as refused:
            imported(path, robot)
        assert str(refused.value).endswith("df[df['q'].str.len() == 3]")
        frame[frame["q"].str.len() == 3].to_parquet(path)
        imported(path, robot)


def test_names_in_rows_are_said(tmp_path: Path, robot: Robot) -> None:
    recording = imported(echo_with_header(tmp_path / "log.csv"), robot)
    order = JointOrder(("ankle", "hip", "knee"))
    assert order in recording.concluded
    assert sentence(order) == "joints in the order of the names in the rows: ankle, hip, knee"


def test_a_look_names_them(tmp_path: Path, robot: Robot) -> None:
    looked = look_at(echo_with_header(tmp_path / "log.csv"), lambda _: robot, ImportOptions())
    (row,) = [row for row in looked.rows if row.aspect == "joints"]
    assert row_text(row)[:2] == ("ankle, hip, knee", "in the order of the names in the rows")


def test_a_ready_map_leaves_the_order_to_the_names(tmp_path: Path, robot: Robot) -> None:
    path = echo_with_header(tmp_path / "log.csv")
    options = ImportOptions(Path("ros_joint_states"))
    recording = import_recording(path, tmp_path / "a.mcap", lambda _: robot, options)
    archive = recording.archive
    assert np.allclose(archive.columns["position"], POSITION, rtol=0.0, atol=1e-6)
    assert np.allclose(archive.columns["torque"], TORQUE, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"t": 0.0, "q": [1.0]}\n{"t": 0.1, "q": [1.0]}\n', "is JSON, not a table of numbers"),
        ("header:\n  seq: 1\nposition: [0.0]\n---\n", "is YAML of messages, not a table"),
    ],
)
def test_text_that_is_no_table(tmp_path: Path, robot: Robot, text: str, sentence: str) -> None:
    (tmp_path / "log.txt").write_text(text)
    with pytest.raises(SourceError, match=sentence):
        imported(tmp_path / "log.txt", robot)


NOT_MEASURED = (
    "q_d[0]", "target_moment_1", "ExternalTorque_2", "actual_motor_torque[1]", "dtau_J_1",
    "axisQCmd_LBR[3]", "tcp_position_1", "gripper_pos", "position_error_1", "tau_ext_hat_1",
)  # fmt: skip


@pytest.mark.parametrize("name", NOT_MEASURED)
def test_words_deny_a_measured_quantity(name: str) -> None:
    assert kind_of(name)[0] is None
    assert kind_by_words(name) is None


def test_a_channel_without_numbers_of_joints_is_no_quantity(tmp_path: Path, robot: Robot) -> None:
    """One temperature-like channel with a word of a quantity in its name is left alone."""
    names = ["t", "q{}", "tau{}", "belt_speed", "valve_position"]
    path = table(tmp_path / "log.csv", names, TIME, POSITION, TORQUE, TIME, TIME)
    recording = imported(path, robot)
    assert UnusedChannels(("belt_speed", "valve_position")) in recording.concluded
