"""rosbag2 recordings become archives: joints by name, stamps to the nanosecond, clear refusals."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from hil.archive import open_archive
from hil.cell import Cell
from hil.errors import InputError, SourceError
from hil.importers import Robot, import_rosbag2, recorded_joints
from hil.recordings import open_recording
from identification import FrictionLaw
from identification.signals.recording import RecordingError

STATE = "sensor_msgs/msg/JointState"
STORE = get_typestore(Stores.ROS2_HUMBLE)
URDF = """<robot name="two"><link name="base"/>
<link name="upper"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<joint name="ankle" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
<origin xyz="0 0 0.4"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>"""


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    path = tmp_path / "two.urdf"
    path.write_text(URDF)
    return Robot.from_urdf(path, friction=FrictionLaw(third=None, offset=True))


def state(
    stamp: int,
    position: Sequence[float],
    *,
    names: Sequence[str] = ("ankle", "hip"),
    velocity: Sequence[float] = (),
    effort: Sequence[float] = (),
) -> tuple[int, bytes]:
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    message = types[STATE](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=""),
        name=list(names),
        position=np.array(position, float),
        velocity=np.array(velocity, float),
        effort=np.array(effort, float),
    )
    return stamp + 77, bytes(STORE.serialize_cdr(message, STATE))


def bag(path: Path, topics: dict[str, tuple[str, list[tuple[int, bytes]]]]) -> Path:
    with closing(sqlite3.connect(path)) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
            " timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        for number, (name, (kind, messages)) in enumerate(topics.items(), 1):
            database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (number, name, kind))
            database.executemany(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
                [(number, time, data) for time, data in messages],
            )
        database.commit()
    return path


def states(count: int = 5, **changes: Any) -> list[tuple[int, bytes]]:
    start = 1_700_000_000 * 10**9 + 123
    return [
        state(start + 8_000_001 * i, [0.1 * i, -i], effort=[10.0 + i, 20.0 + i], **changes)
        for i in range(count)
    ]


class TestRobot:
    def test_its_cell_file_gives_the_model_that_was_asked_for(self, robot):
        cell = Cell.from_texts(robot.cell, robot.urdf, Path("cell.toml"))
        assert set(cell.model.friction.laws) == {FrictionLaw(third=None, offset=True)}
        assert cell.joint_names == robot.joint_names == ("hip", "ankle")

    def test_without_a_law_it_has_offset_coulomb_and_viscous_friction(self, tmp_path):
        """A term in v² makes the prediction of other motions worse on average."""
        (tmp_path / "two.urdf").write_text(URDF)
        robot = Robot.from_urdf(tmp_path / "two.urdf")
        cell = Cell.from_texts(robot.cell, robot.urdf, Path("cell.toml"))
        assert set(cell.model.friction.laws) == {FrictionLaw(third=None, offset=True)}

    def test_gravity_and_rotor_inertia_are_kept(self, tmp_path):
        (tmp_path / "two.urdf").write_text(URDF)
        robot = Robot.from_urdf(tmp_path / "two.urdf", gravity=(0, 9.81, 0), rotor_inertia=False)
        model = Cell.from_texts(robot.cell, robot.urdf, Path("cell.toml")).model
        assert model.gravity.tolist() == [0, 9.81, 0]
        assert not model.rotor_inertia

    def test_gravity_replaces_that_of_a_cell(self, tmp_path, robot):
        (tmp_path / "robot.urdf").write_text(robot.urdf)
        (tmp_path / "cell.toml").write_text(robot.cell)
        turned = Robot.from_cell(tmp_path / "cell.toml", gravity=(0, 0, 1.62))
        model = Cell.from_texts(turned.cell, turned.urdf, Path("cell.toml")).model
        assert model.gravity.tolist() == [0, 0, 1.62]

    def test_joints_that_were_not_recorded_are_locked(self, tmp_path):
        """At zero, or in the middle of a range without it; what is locked by name stays there."""
        more = "".join(
            f"<link name='{name}'/><joint name='{name}' type='{kind}'><parent link='lower'/>"
            f"<child link='{name}'/><axis xyz='0 0 1'/>"
            f"<limit lower='{low}' upper='{high}' effort='1' velocity='1'/></joint>"
            for name, kind, low, high in [
                ("turns", "revolute", -1, 2), ("slides", "prismatic", 0.1, 0.3),
                ("bends", "revolute", -3, -1), ("rolls", "continuous", 0, 0),
            ]
        )  # fmt: skip
        path = tmp_path / "more.urdf"
        path.write_text(URDF.replace("</robot>", more + "</robot>"))
        robot = Robot.from_urdf(path, locked={"turns": 0.5}, recorded=["hip", "ankle", "unknown"])
        assert robot.joint_names == ("hip", "ankle")
        assert robot.locked == {
            "turns": 0.5, "slides": pytest.approx(0.2), "bends": -2.0, "rolls": 0.0
        }  # fmt: skip
        (tmp_path / "robot.urdf").write_text(robot.urdf)
        (tmp_path / "cell.toml").write_text(robot.cell)
        less = Robot.from_cell(tmp_path / "cell.toml", recorded=["hip"])
        assert less.locked == {**robot.locked, "ankle": 0.0}
        with pytest.raises(InputError, match=r"none of its joints hip.* recorded are a, b"):
            Robot.from_urdf(path, recorded=["a", "b"])

    def test_a_transmission_of_the_same_name_does_not_hide_a_fixed_joint(self, tmp_path):
        again = '<transmission name="t"><joint name="ankle"/></transmission></robot>'
        (tmp_path / "two.urdf").write_text(URDF.replace("</robot>", again))
        held = Robot.from_urdf(tmp_path / "two.urdf", locked={"ankle": 0.0})
        assert held.joint_names == ("hip",)

    def test_a_fixed_joint_is_no_joint_any_more(self, tmp_path):
        (tmp_path / "two.urdf").write_text(URDF)
        held = Robot.from_urdf(tmp_path / "two.urdf", locked={"ankle": 0.0})
        assert held.joint_names == ("hip",)
        with pytest.raises(InputError, match=r"'knee'.*hip, ankle"):
            Robot.from_urdf(tmp_path / "two.urdf", locked={"knee": 0.0})

    def test_a_file_that_is_no_urdf_is_refused(self, tmp_path):
        (tmp_path / "bad.urdf").write_text("<robot")
        with pytest.raises(InputError, match=r"bad\.urdf: the robot description .* is no XML"):
            Robot.from_urdf(tmp_path / "bad.urdf")
        with pytest.raises(InputError, match=r"none\.urdf.*cannot be read"):
            Robot.from_urdf(tmp_path / "none.urdf")

    def test_a_cell_file_serves_as_well(self, tmp_path, robot):
        (tmp_path / "robot.urdf").write_text(robot.urdf)
        (tmp_path / "cell.toml").write_text(robot.cell)
        again = Robot.from_cell(tmp_path / "cell.toml")
        assert (again.cell, again.urdf) == (robot.cell, robot.urdf)


class TestImport:
    def test_joints_come_in_the_order_of_the_urdf(self, tmp_path, robot):
        file = bag(tmp_path / "b.db3", {"/joint_states": (STATE, states())})
        archive = open_archive(import_rosbag2(file, tmp_path / "a.mcap", robot=robot))
        assert archive.complete
        assert archive.joint_names == ("hip", "ankle")
        assert archive.columns["position"].tolist() == [[-i, 0.1 * i] for i in range(5)]
        assert archive.columns["torque"].tolist() == [[20.0 + i, 10.0 + i] for i in range(5)]

    def test_stamps_are_those_of_the_headers_to_the_nanosecond(self, tmp_path, robot):
        file = bag(tmp_path / "b.db3", {"/joint_states": (STATE, states())})
        path = import_rosbag2(file, tmp_path / "a.mcap", robot=robot)
        archive = open_archive(path)
        start = 1_700_000_000 * 10**9 + 123
        assert archive.columns["stamp"].tolist() == [start + 8_000_001 * i for i in range(5)]
        assert archive.header.entries["clock"] == "header"
        assert open_recording(path).time.tolist() == pytest.approx(
            [8.000001e-3 * i for i in range(5)], abs=1e-15
        )

    def test_empty_headers_leave_the_bags_stamps(self, tmp_path, robot):
        messages = [(5 + 8 * i, state(0, [i, i])[1]) for i in range(3)]
        file = bag(tmp_path / "b.db3", {"/joint_states": (STATE, messages)})
        archive = open_archive(import_rosbag2(file, tmp_path / "a.mcap", robot=robot))
        assert archive.columns["stamp"].tolist() == [5, 13, 21]
        assert archive.header.entries["clock"] == "bag"

    def test_what_was_not_recorded_is_not_invented(self, tmp_path, robot):
        file = bag(tmp_path / "b.db3", {"/js": (STATE, [state(9, [1, 2]), state(10, [1, 3])])})
        path = import_rosbag2(file, tmp_path / "a.mcap", robot=robot)
        assert set(open_archive(path).columns) == {"stamp", "position"}
        assert open_recording(path).torque is None

    def test_velocity_reaches_the_archive(self, tmp_path, robot):
        messages = [state(8_000_000 * i, [1, 2], velocity=[0.5, -i]) for i in range(3)]
        file = bag(tmp_path / "b.db3", {"/js": (STATE, messages)})
        path = import_rosbag2(file, tmp_path / "a.mcap", robot=robot)
        assert open_archive(path).columns["velocity"].tolist() == [[-i, 0.5] for i in range(3)]

    def test_nan_throughout_is_no_quantity(self, tmp_path, robot):
        """ros2_control publishes it for what the hardware does not measure."""
        nothing = [np.nan, np.nan]
        messages = [state(8_000_000 * i, [1, i], velocity=nothing) for i in range(3)]
        file = bag(tmp_path / "b.db3", {"/js": (STATE, messages)})
        path = import_rosbag2(file, tmp_path / "a.mcap", robot=robot)
        assert set(open_archive(path).columns) == {"stamp", "position"}

    def test_recorded_joints_are_those_of_the_fullest_message(self, tmp_path):
        messages = [state(5, [0.01], names=["finger"]), *states(2)]
        file = bag(tmp_path / "b.db3", {"/js": (STATE, messages)})
        assert recorded_joints(file) == ("ankle", "hip")
        assert recorded_joints(file, joint_names={"hip": "h"}) == ("ankle", "h")
        empty = bag(tmp_path / "e.db3", {"/js": (STATE, [])})
        with pytest.raises(SourceError, match="has no message with joints"):
            recorded_joints(empty)

    def test_effort_can_be_declared_a_motor_current(self, tmp_path, robot):
        file = bag(tmp_path / "b.db3", {"/js": (STATE, states())})
        path = import_rosbag2(file, tmp_path / "a.mcap", robot=robot, effort="motor_current")
        recording = open_recording(path)
        assert recording.torque is None
        assert recording.motor_current is not None
        assert recording.motor_current[0].tolist() == [20.0, 10.0]

    def test_messages_of_a_gripper_on_the_same_topic_are_passed_over(self, tmp_path, robot):
        mixed = [*states(3), state(5, [0.01], names=["finger"])]
        file = bag(tmp_path / "b.db3", {"/js": (STATE, mixed)})
        archive = open_archive(import_rosbag2(file, tmp_path / "a.mcap", robot=robot))
        assert archive.n_samples == 3

    def test_names_may_differ_from_the_urdfs(self, tmp_path, robot):
        file = bag(tmp_path / "b.db3", {"/js": (STATE, states(names=["j2", "j1"]))})
        path = import_rosbag2(
            file, tmp_path / "a.mcap", robot=robot, joint_names={"j1": "hip", "j2": "ankle"}
        )
        assert open_archive(path).columns["position"][3].tolist() == [-3, pytest.approx(0.3)]

    def test_a_folder_of_split_files_is_one_recording(self, tmp_path, robot):
        folder = tmp_path / "bag"
        folder.mkdir()
        messages = states(6)
        bag(folder / "bag_0.db3", {"/js": (STATE, messages[:4])})
        bag(folder / "bag_1.db3", {"/js": (STATE, messages[4:])})
        archive = open_archive(import_rosbag2(folder, tmp_path / "a.mcap", robot=robot))
        assert archive.n_samples == 6
        assert archive.header.entries["source"] == '["bag_0.db3", "bag_1.db3"]'

    def test_the_archive_says_where_it_comes_from(self, tmp_path, robot):
        file = bag(tmp_path / "b.db3", {"/js": (STATE, states())})
        path = import_rosbag2(file, tmp_path / "a.mcap", robot=robot, held_joints=["hip"])
        recording = open_recording(path)
        assert recording.held_joints == ("hip",)
        expected = {"kind": "imported", "importer": "rosbag2", "topic": "/js", "archive": "a.mcap"}
        assert expected.items() <= recording.provenance.items()

    def test_the_bag_is_left_alone(self, tmp_path, robot):
        folder = tmp_path / "bag"
        folder.mkdir()
        file = bag(folder / "b.db3", {"/js": (STATE, states())})
        before = file.read_bytes()
        import_rosbag2(file, tmp_path / "a.mcap", robot=robot)
        assert file.read_bytes() == before
        assert list(folder.iterdir()) == [file]


class TestBadInput:
    @pytest.mark.parametrize(
        ("topics", "asked", "sentence"),
        [
            (
                {"/a": (STATE, []), "/b": (STATE, [])},
                None,
                r"2 topics carry .*/a \(sensor_msgs.*/b",
            ),
            (
                {"/plan": ("x/msg/Plan", [])},
                None,
                r"no topics carry .*name one.*/plan \(x/msg/Plan",
            ),
            (
                {"/a": (STATE, [])},
                "/joints",
                r"topic: there is no topic /joints; its topics are: /a",
            ),
            ({"/plan": ("x/msg/Plan", []), "/a": (STATE, [])}, "/plan", "/plan carries x/msg/Plan"),
            ({"/a": (STATE, [])}, None, "none of the joints hip, ankle was recorded; it is empty"),
        ],
    )
    def test_a_topic_that_does_not_fit_gets_the_list(
        self, tmp_path, robot, topics, asked, sentence
    ):
        file = bag(tmp_path / "b.db3", topics)
        with pytest.raises(SourceError, match=sentence):
            import_rosbag2(file, tmp_path / "a.mcap", robot=robot, topic=asked)
        assert not (tmp_path / "a.mcap").exists()

    @pytest.mark.parametrize(
        ("messages", "sentence"),
        [
            (
                [state(1, [1.0], names=["hip"])],
                "ankle was not recorded; recorded are hip.*--lock-others",
            ),
            ([state(1, [1.0], names=["x"])], "none of the joints hip, ankle .* recorded are x"),
            ([state(1, [1.0])], "position: message 0 has 1 values for 2 joints"),
            ([*states(2), state(9, [1, 2])], "effort: only 2 of 3 messages have it"),
            ([*states(2), state(9, [np.nan, 2], effort=[1, 1])], "ankle is nan in sample"),
            (
                [state(9 * 10**9, [1, 2]), (10**10, state(1, [1, 3])[1])],
                "time: sample 1 is 9 s older than",
            ),
            ([(3, b"\x00\x01\x00\x00rubbish")], "message 0 cannot be decoded"),
        ],
    )
    def test_messages_that_cannot_be_used_are_named(self, tmp_path, robot, messages, sentence):
        file = bag(tmp_path / "b.db3", {"/js": (STATE, messages)})
        with pytest.raises(SourceError, match=sentence):
            import_rosbag2(file, tmp_path / "a.mcap", robot=robot)

    def test_files_that_are_no_bag_are_named(self, tmp_path, robot):
        (tmp_path / "x.db3").write_text("time,q1")
        with pytest.raises(SourceError, match=r"x\.db3: is not a rosbag2 in sqlite3 storage"):
            import_rosbag2(tmp_path / "x.db3", tmp_path / "a.mcap", robot=robot)
        with pytest.raises(SourceError, match="does not exist"):
            import_rosbag2(tmp_path / "y.db3", tmp_path / "a.mcap", robot=robot)
        (tmp_path / "empty").mkdir()
        with pytest.raises(SourceError, match=r"has no \.db3 and no \.mcap file"):
            import_rosbag2(tmp_path / "empty", tmp_path / "a.mcap", robot=robot)

    def test_a_repeated_clock_is_kept_and_refused_by_the_recording(self, tmp_path, robot):
        messages = [state(8, [1, 2]), state(16, [1, 3]), state(16, [1, 4])]
        file = bag(tmp_path / "b.db3", {"/js": (STATE, messages)})
        recording = open_recording(import_rosbag2(file, tmp_path / "a.mcap", robot=robot))
        with pytest.raises(RecordingError, match="the clock repeats at sample 2"):
            recording.checked()

    def test_unknown_held_joints_are_named(self, tmp_path, robot):
        file = bag(tmp_path / "b.db3", {"/js": (STATE, states())})
        with pytest.raises(SourceError, match="no joint is called 'knee'"):
            import_rosbag2(file, tmp_path / "a.mcap", robot=robot, held_joints=["knee"])


class TestRealRecordings:
    def description(self, name: str) -> Path:
        return Path(np.__file__).parents[1] / "cmeel.prefix/share/example-robot-data/robots" / name

    def test_ur10(self, tmp_path, shared_data):
        robot = Robot.from_urdf(self.description("ur_description/urdf/ur10_robot.urdf"))
        source = shared_data / "ur10_unisa" / "ur10_exciting_trajectory.db3"
        recording = open_recording(import_rosbag2(source, tmp_path / "ur10.mcap", robot=robot))
        assert recording.checked(robot.joint_names) is recording
        assert recording.position.shape == (3441, 6)
        assert recording.time[-1] == pytest.approx(27.52)
        with closing(sqlite3.connect(f"{source.as_uri()}?immutable=1", uri=True)) as database:
            rows = [
                STORE.deserialize_cdr(d, STATE)
                for (d,) in database.execute("SELECT data FROM messages ORDER BY timestamp")
            ]
        assert list(rows[0].name) == list(robot.joint_names)
        assert recording.torque is not None
        assert np.array_equal(recording.position, [row.position for row in rows])
        assert np.array_equal(recording.torque, [row.effort for row in rows])

    def test_franka_with_other_names_and_a_gripper_that_was_not_recorded(
        self, tmp_path, shared_data
    ):
        robot = Robot.from_urdf(
            self.description("panda_description/urdf/panda.urdf"),
            locked={"panda_finger_joint1": 0.0, "panda_finger_joint2": 0.0},
        )
        source = shared_data / "ur10_unisa" / "fer_exciting_trajectory.db3"
        names = {f"fer_joint{i}": f"panda_joint{i}" for i in range(1, 8)}
        path = import_rosbag2(source, tmp_path / "fer.mcap", robot=robot, joint_names=names)
        recording = open_recording(path).checked(robot.joint_names)
        assert recording.position.shape == (727, 7)
        assert recording.time[1] == pytest.approx(0.033382177, abs=1e-12)

    def test_a_planned_trajectory_is_no_measurement(self, tmp_path, shared_data):
        robot = Robot.from_urdf(self.description("ur_description/urdf/ur10_robot.urdf"))
        source = shared_data / "ur10_unisa" / "validation_trajectory.db3"
        with pytest.raises(SourceError, match="trajectory_msgs/msg/JointTrajectory"):
            import_rosbag2(source, tmp_path / "x.mcap", robot=robot)
