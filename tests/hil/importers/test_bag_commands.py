"""Commanded positions in bags: read from every kind of topic that states them, or named."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.archive.recording_of_archive import open_recording
from hil.base.errors import InputError
from hil.cli import app
from hil.fleet.extra_channels import ExtraChannels, facts_of
from hil.importers.bag_map import BagMap
from hil.importers.log_files import LogFiles
from hil.importers.ros_messages import CONTROLLER_STATE, definitions_of
from hil.results.provenance import RESULTS
from hil.results.rollout_result import ROLLOUT, RolloutResult
from hil.results.servo_result import ServoResults
from tests.hil.importers.bags import bag
from tests.identification.servo_arm import DELAY, KD, KP, an_arm, on_its_servo
from tests.identification.two_link import MODEL, URDF, four_sines
from tests.near import near
from tests.tiers import quick_ones

STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
JOINTS = MODEL.joint_names
START = 1_700_000_000_000_000_000
PERIOD = 4_000_000
LATE = 300_000  # ns between stamp and receipt
RELEASES = dict(zip(("iron", "humble", "foxy"), definitions_of(CONTROLLER_STATE, ""), strict=True))


class Moved(NamedTuple):
    """A motion and its command, every 4 ms."""

    time: Any
    position: Any
    velocity: Any
    command: Any

    @property
    def stamps(self) -> list[int]:
        return [START + round(1e9 * at) for at in self.time.tolist()]


def a_motion(duration: float = 4.0) -> Moved:
    """Sines which the joints follow 20 ms late."""
    time = np.arange(0.0, duration, 1e-9 * PERIOD)
    motion = four_sines(time, 0.5)
    command = four_sines(time + 0.02, 0.5)
    return Moved(time, motion.position, motion.velocity, command.position)


class Messages:
    """Messages of a release of ROS."""

    def __init__(self, release: str = "iron") -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC if release == "ros1" else Stores.ROS2_HUMBLE)
        definition = RELEASES["foxy" if release == "ros1" else release]
        self.store.register(get_types_from_msg(definition, CONTROLLER_STATE))

    def of(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp: int) -> Any:
        time = self.of("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        names = {field[0] for field in self.store.fielddefs["std_msgs/msg/Header"][1]}
        first = {"seq": 0} if "seq" in names else {}
        return self.of("std_msgs/msg/Header", **first, stamp=time, frame_id="")

    def state(self, stamp: int, position, velocity=(), effort=(), names=JOINTS) -> Any:
        quantities = {"position": position, "velocity": velocity, "effort": effort}
        arrays = {name: np.array(values, np.float64) for name, values in quantities.items()}
        return self.of(STATE, header=self.header(stamp), name=list(names), **arrays)

    def point(self, positions=(), velocities=(), at: float = 0.0) -> Any:
        duration = self.of(
            "builtin_interfaces/msg/Duration", sec=int(at), nanosec=round(at % 1.0 * 1e9)
        )
        arrays = {"positions": positions, "velocities": velocities}
        return self.of(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            **{name: np.array(values, np.float64) for name, values in arrays.items()},
            accelerations=np.array([]),
            effort=np.array([]),
            time_from_start=duration,
        )

    def controller(self, stamp: int, command, position, velocity, names=JOINTS) -> Any:
        """The state of a trajectory controller, in the fields of its release."""
        duration = self.of("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
        nothing: Any = {"transforms": [], "velocities": [], "accelerations": []}
        several = "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint"
        fields = {"header": self.header(stamp), "joint_names": list(names)}
        for name, _ in self.store.fielddefs[CONTROLLER_STATE][1][2:]:
            if name == "multi_dof_joint_names":
                fields[name] = []
            elif name.startswith("multi_dof"):
                fields[name] = self.of(several, **nothing, time_from_start=duration)
            elif name in ("reference", "desired"):
                fields[name] = self.point(command)
            elif name in ("feedback", "actual"):
                fields[name] = self.point(position, velocity)
            else:
                fields[name] = self.point()
        return self.of(CONTROLLER_STATE, **fields)

    def trajectory(self, stamp: int, points: Sequence[Any]) -> Any:
        return self.of(
            TRAJECTORY, header=self.header(stamp), joint_names=list(JOINTS), points=list(points)
        )

    def array(self, values) -> Any:
        layout = self.of("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        return self.of(ARRAY, layout=layout, data=np.array(values, np.float64))


Topics = dict[str, tuple[str, list[tuple[int, Any]]]]


def written(path: Path, messages: Messages, topics: Topics, kind: str = "mcap") -> Path:
    """A bag: MCAP with definitions, sqlite3 without (as of Humble), or of ROS 1."""
    if kind == "db3":
        raw = {
            name: (of, [(at, bytes(messages.store.serialize_cdr(m, of))) for at, m in sent])
            for name, (of, sent) in topics.items()
        }
        return bag(path.with_suffix(".db3"), raw)
    if kind == "ros1":
        with Ros1Writer(path.with_suffix(".bag")) as writer:
            for name, (of, sent) in topics.items():
                connection = writer.add_connection(name, of, typestore=messages.store)
                for at, message in sent:
                    writer.write(connection, at, messages.store.serialize_ros1(message, of))
        return path.with_suffix(".bag")
    with BagWriter(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for name, (of, sent) in topics.items():
            connection = writer.add_connection(name, of, typestore=messages.store)
            for at, message in sent:
                writer.write(connection, at, messages.store.serialize_cdr(message, of))
    return path


def received(stamps: Iterable[int], messages: Iterable[Any]) -> list[tuple[int, Any]]:
    return [(stamp + LATE, message) for stamp, message in zip(stamps, messages, strict=True)]


def measured(messages: Messages, moved: Moved, torque=None) -> tuple[str, list[tuple[int, Any]]]:
    effort = [()] * len(moved.time) if torque is None else torque
    rows = zip(moved.stamps, moved.position, moved.velocity, effort, strict=True)
    return STATE, received(moved.stamps, [messages.state(*row) for row in rows])


def controller(messages: Messages, moved: Moved) -> tuple[str, list[tuple[int, Any]]]:
    """The elbow first, as a controller may name its joints."""
    rows = zip(moved.stamps, moved.command, moved.position, moved.velocity, strict=True)
    sent = [
        messages.controller(stamp, *(values[::-1] for values in row), names=JOINTS[::-1])
        for stamp, *row in rows
    ]
    return CONTROLLER_STATE, received(moved.stamps, sent)


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "robot.urdf"
    path.write_text(URDF)
    return path


class Imported:
    """What `hil import rosbag2` says of a bag and writes."""

    def __init__(self, source: Path, urdf: Path, *options: str) -> None:
        path = urdf.with_name("imported.mcap")
        done = CliRunner().invoke(
            app, ["import", "rosbag2", str(source), "--urdf", str(urdf), "--force", "-o", str(path),
                  *options]
        )  # fmt: skip
        assert done.exit_code == 0, done.exception
        self.text = " ".join(done.output.split())
        self.entries = open_archive(path, fields=()).header.entries
        self.recording = open_recording(path)

    @property
    def command(self) -> Any:
        return self.recording.commanded_position


MOVED = a_motion()


class TestStateOfAController:
    @pytest.mark.parametrize(
        ("release", "kind"),
        quick_ones(
            [("iron", "mcap"), ("ros1", "ros1")],
            [("iron", "mcap"), ("humble", "mcap"), ("foxy", "mcap"),
             ("iron", "db3"), ("humble", "db3"), ("foxy", "db3"), ("ros1", "ros1")],
        ),
    )  # fmt: skip
    def test_has_the_command_in_every_release(self, tmp_path, urdf, release, kind) -> None:
        messages = Messages(release)
        topics = {
            "/joint_states": measured(messages, MOVED),
            "/arm_controller/controller_state": controller(messages, MOVED),
        }
        imported = Imported(written(tmp_path / "bag", messages, topics, kind), urdf)
        assert imported.command == near(MOVED.command)
        assert imported.recording.position == near(MOVED.position)
        assert imported.entries["command_topic"] == "/arm_controller/controller_state"

    @pytest.mark.long
    def test_has_the_measured_state_too(self, tmp_path, urdf) -> None:
        """Where the bag has no joint states."""
        messages = Messages()
        topics = {"/arm_controller/controller_state": controller(messages, MOVED)}
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        assert imported.recording.position == near(MOVED.position)
        assert imported.recording.velocity == near(MOVED.velocity)
        assert imported.command == near(MOVED.command)

    def test_at_a_lower_rate_is_interpolated(self, tmp_path, urdf) -> None:
        messages = Messages()
        kind, sent = controller(messages, MOVED)
        topics = {"/joint_states": measured(messages, MOVED), "/arm/state": (kind, sent[100::5])}
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        assert np.isnan(imported.command[:100]).all()
        inside = slice(100, 996)
        assert imported.command[inside] == near(MOVED.command[inside], abs=2e-3)
        assert "commanded_position: known at 896 of 1000 samples" in imported.text
        assert imported.recording.n_samples == 1000  # nothing measured is lost

    def test_lost_messages_are_a_gap(self, tmp_path, urdf) -> None:
        messages = Messages()
        kind, sent = controller(messages, MOVED)
        topics = {
            "/joint_states": measured(messages, MOVED),
            "/arm/state": (kind, [*sent[:400], *sent[450:]]),
        }
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        unknown = np.flatnonzero(np.isnan(imported.command).any(axis=1))
        assert unknown.tolist() == [*range(400, 450)]


class TestOtherTopics:
    @pytest.mark.parametrize("topic", ["/joint_command", "/joint_states_desired", "/arm/target"])
    def test_joint_states_that_are_named_as_commands(self, tmp_path, urdf, topic) -> None:
        messages = Messages()
        rows = zip(MOVED.stamps, MOVED.command, strict=True)
        topics = {
            topic: (STATE, received(MOVED.stamps, [messages.state(*row) for row in rows])),
            "/joint_states": measured(messages, MOVED),
        }
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        assert imported.entries["topic"] == "/joint_states"
        assert imported.command == near(MOVED.command)

    def test_arrays_go_to_the_joints_that_follow_them(self, tmp_path, urdf) -> None:
        """Without names and stamps: by their numbers, and the time of receipt."""
        messages = Messages()
        sent = [messages.array(row[::-1]) for row in MOVED.command]
        topics = {
            "/joint_states": measured(messages, MOVED),
            "/forward_position_controller/commands": (ARRAY, received(MOVED.stamps, sent)),
        }
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        assert imported.command == near(MOVED.command, abs=1e-9)

    def test_arrays_of_velocities_are_no_positions(self, tmp_path, urdf) -> None:
        messages = Messages()
        sent = [messages.array(row + 3.0) for row in MOVED.velocity]
        topics = {
            "/joint_states": measured(messages, MOVED),
            "/velocity_controller/commands": (ARRAY, received(MOVED.stamps, sent)),
        }
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        assert imported.command is None
        assert "/velocity_controller/commands: it" in imported.text
        assert "not used as commanded positions" in imported.text

    @pytest.mark.long
    def test_a_trajectory_is_interpolated(self, tmp_path, urdf) -> None:
        """With velocities by cubics, from the measured position on, and held at its end."""
        messages = Messages()
        knots = np.arange(250, 800, 10)
        command = four_sines(MOVED.time + 0.02, 0.5)
        points = [
            messages.point(command.position[k], command.velocity[k], 0.004 * float(k - 200))
            for k in knots
        ]
        position = MOVED.position.copy()
        position[795:] = command.position[790]
        moved = MOVED._replace(position=position)
        stamp = MOVED.stamps[200]
        sent = [(stamp + LATE, messages.trajectory(stamp, points))]
        topics = {"/joint_states": measured(messages, moved),
                  "/arm_controller/joint_trajectory": (TRAJECTORY, sent)}  # fmt: skip
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        assert np.isnan(imported.command[:200]).all()
        assert imported.command[200] == near(MOVED.position[200], abs=1e-3)
        inside = slice(250, 791)
        assert imported.command[inside] == near(command.position[inside], abs=1e-4)
        held = np.tile(command.position[790], (200, 1))
        assert imported.command[800:] == near(held, abs=1e-6)

    def test_so_are_trajectories_of_one_point_each(self, tmp_path, urdf) -> None:
        """As of a servo node: each point is reached when the next one is sent."""
        messages = Messages()
        every = range(0, 999, 5)
        sent = [messages.trajectory(0, [messages.point(MOVED.command[k], at=0.02)]) for k in every]
        topics = {
            "/joint_states": measured(messages, MOVED),
            "/arm/joint_trajectory": (TRAJECTORY, received([MOVED.stamps[k] for k in every], sent)),
        }
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        assert imported.command[5:] == near(MOVED.command[:-5], abs=2e-3)


class TestStrangeMessages:
    """They cost the commands at most, never the measured positions."""

    def imported(self, tmp_path: Path, urdf: Path, messages: Messages, of: str, sent) -> Imported:
        topics = {"/joint_states": measured(messages, MOVED), "/arm/command": (of, sent)}
        imported = Imported(written(tmp_path / "bag", messages, topics), urdf)
        assert imported.recording.position == near(MOVED.position)
        return imported

    def test_a_controller_without_points(self, tmp_path, urdf) -> None:
        messages = Messages()
        store = get_typestore(Stores.ROS2_HUMBLE)
        text = "std_msgs/Header header\nstring[] joint_names\nfloat64 gain\n"
        store.register(get_types_from_msg(text, CONTROLLER_STATE))
        messages.store = store
        sent = received(MOVED.stamps, [
            messages.of(CONTROLLER_STATE, header=messages.header(stamp), joint_names=list(JOINTS),
                        gain=1.0)
            for stamp in MOVED.stamps
        ])  # fmt: skip
        imported = self.imported(tmp_path, urdf, messages, CONTROLLER_STATE, sent)
        assert imported.command is None
        assert "/arm/command: it has no positions of these joints" in imported.text

    def test_commands_that_are_not_finite_are_none(self, tmp_path, urdf) -> None:
        messages = Messages()
        command = MOVED.command.copy()
        command[:10, 0] = np.inf
        command[20, 1] = np.nan
        rows = zip(MOVED.stamps, command, strict=True)
        sent = received(MOVED.stamps, [messages.state(*row) for row in rows])
        imported = self.imported(tmp_path, urdf, messages, STATE, sent)
        unknown = np.flatnonzero(np.isnan(imported.command).all(axis=1))
        assert unknown.tolist() == [*range(10), 20]

    def test_trajectories_that_run_backwards(self, tmp_path, urdf) -> None:
        messages = Messages()
        points = [messages.point(MOVED.command[k], at=float(5 - k)) for k in range(4)]
        sent = [(MOVED.stamps[9], messages.trajectory(MOVED.stamps[9], points))]
        assert self.imported(tmp_path, urdf, messages, TRAJECTORY, sent).command is None


class TestSeveralTopics:
    def topics(self, messages: Messages) -> Topics:
        rows = zip(MOVED.stamps, MOVED.command + 0.1, strict=True)
        other = [messages.state(*row) for row in rows]
        last = zip(MOVED.stamps, MOVED.command, strict=True)
        return {
            "/joint_states": measured(messages, MOVED),
            "/a/command": (STATE, received(MOVED.stamps, other)),
            "/b/command": (STATE, received(MOVED.stamps, [messages.state(*row) for row in last])),
        }

    def test_that_contradict_each_other_are_named(self, tmp_path, urdf) -> None:
        messages = Messages()
        path = written(tmp_path / "bag", messages, self.topics(messages))
        imported = Imported(path, urdf)
        assert imported.command is None
        assert "/a/command and /b/command carry different commands" in imported.text
        assert "--command-topic /a/command" in imported.text
        chosen = Imported(path, urdf, "--command-topic", "/b/command")
        assert chosen.command == near(MOVED.command)
        assert Imported(path, urdf, "--command-topic", "none").command is None

    def test_one_that_is_missing_is_refused(self, tmp_path, urdf) -> None:
        messages = Messages()
        path = written(tmp_path / "bag", messages, self.topics(messages))
        done = CliRunner().invoke(
            app,
            [
                "import",
                "rosbag2",
                str(path),
                "--urdf",
                str(urdf),
                "-o",
                str(tmp_path / "a.mcap"),
                "--command-topic",
                "/c",
            ],
        )
        assert isinstance(done.exception, InputError)
        assert "there is no such topic in the bag" in str(done.exception)
        assert "/a/command, /b/command" in str(done.exception)


def test_a_look_shows_the_commands(tmp_path, urdf) -> None:
    messages = Messages("humble")
    torque = MODEL.torque(np.ones(MODEL.n_parameters), four_sines(MOVED.time, 0.5))
    topics = {
        "/joint_states": measured(messages, MOVED, torque),
        "/arm_controller/controller_state": controller(messages, MOVED),
    }
    path = written(tmp_path / "bag", messages, topics)
    done = CliRunner().invoke(app, ["look", "-v", str(path)])
    assert done.exit_code == 0, done.exception
    text = " ".join(done.output.split())
    assert "commanded position" in text
    assert "/arm_controller/controller_state" in text
    assert "the reference in the state of a controller" in text


def test_a_bag_is_read_again_with_the_same_commands(tmp_path, urdf) -> None:
    text = BagMap(topic="/joint_states", command_topic="/b/command").text
    (tmp_path / "map.toml").write_text(text)
    messages = Messages()
    path = written(tmp_path / "bag", messages, TestSeveralTopics().topics(messages))
    output = tmp_path / "again.mcap"
    done = CliRunner().invoke(
        app,
        [
            "import",
            "log",
            str(path),
            "--urdf",
            str(urdf),
            "--map",
            str(tmp_path / "map.toml"),
            "-o",
            str(output),
            "--json",
        ],
    )
    assert done.exit_code == 0, done.exception
    assert any(
        "/b/command: commanded_position" in line for line in json.loads(done.output)["found"]
    )
    assert open_recording(output).commanded_position == near(MOVED.command)


@pytest.fixture(scope="module")
def moved() -> Moved:
    time, position, velocity, command = on_its_servo(an_arm(), disturbance=0.3, duration=24.0)
    noise = 1e-5 * np.random.default_rng(1).standard_normal(position.shape)
    return Moved(*(part[::4] for part in (time, position + noise, velocity, command)))


class TestServo:
    """A bag of the simulated arm on its servo, of Humble: no definitions of messages in it."""

    def imported(self, folder: Path, moved: Moved, torque=None) -> Path:
        messages = Messages("humble")
        topics = {
            "/joint_states": measured(messages, moved, torque),
            "/arm_controller/controller_state": controller(messages, moved),
        }
        path = written(folder / "bag", messages, topics, "db3")
        (folder / "robot.urdf").write_text(URDF)
        output = folder / "imported.mcap"
        done = CliRunner().invoke(app, ["import", "log", str(path), "--urdf",
                                        str(folder / "robot.urdf"), "-o", str(output)])  # fmt: skip
        assert done.exit_code == 0, done.exception
        return output

    @pytest.mark.long
    def test_is_identified_without_torque(self, tmp_path, moved) -> None:
        archive = self.imported(tmp_path, moved)
        done = CliRunner().invoke(
            app, ["rollout", str(archive), "--polish", "-o", str(tmp_path / "out")]
        )
        assert done.exit_code == 0, done.exception
        servo = RolloutResult.load(tmp_path / "out" / ROLLOUT).servo
        assert servo is not None
        rows = {parameter.name: parameter for parameter in servo.parameters}
        for joint in range(2):
            assert rows[f"kp_{joint + 1}"].value == pytest.approx(KP[joint], rel=0.05)
            damping = rows[f"kd_{joint + 1}"]
            assert abs(damping.value - KD[joint]) < 3.0 * damping.deviation
        assert servo.delay == pytest.approx(DELAY, abs=0.003)

    @pytest.mark.long
    def test_is_identified_with_torque(self, tmp_path, moved) -> None:
        """The torque of the servo, as its drive reports it."""
        late = np.column_stack(
            [np.interp(moved.time - DELAY, moved.time, column) for column in moved.command.T]
        )
        rate = np.gradient(late, moved.time, axis=0) - moved.velocity
        torque = KP * (late - moved.position) + KD * rate
        archive = self.imported(tmp_path, moved, torque)
        done = CliRunner().invoke(
            app,
            [
                "rollout",
                str(archive),
                "--servo",
                "identified",
                "--samples",
                "3",
                "-o",
                str(tmp_path / "out"),
            ],
        )
        assert done.exit_code in (0, 5), done.exception
        result = RolloutResult.load(tmp_path / "out" / ROLLOUT)
        assert "a servo identified from the fitted motion" in result.drive
        gains = [float(gain) for gain in re.findall(r"(\S+) N·m/rad", result.drive)]
        assert gains == pytest.approx(KP, rel=0.1)
        delay = re.search(r"delay (\S+) ms", result.drive)
        assert delay is not None
        assert 1e-3 * float(delay[1]) == pytest.approx(DELAY, abs=0.003)
        assert result.identified.unstable == 0
        assert result.identified.overall(2) < 0.02

    @pytest.mark.long
    def test_a_bag_is_identified_in_one_command(self, tmp_path, moved) -> None:
        self.imported(tmp_path, moved)
        bag_path = tmp_path / "bag.db3"
        urdf = tmp_path / "robot.urdf"
        done = CliRunner().invoke(
            app, ["identify", str(bag_path), "--urdf", str(urdf), "-o", str(tmp_path / "out")]
        )
        assert done.exit_code in (0, 5), done.exception
        results = ServoResults.load(tmp_path / "out" / RESULTS)
        gains = [row.value for row in results.servo if row.name == "kp"]
        assert gains == pytest.approx(KP, rel=0.05)

    @pytest.mark.long
    def test_a_look_finds_no_torque(self, tmp_path, moved) -> None:
        self.imported(tmp_path, moved._replace(**{
            name: values[:500] for name, values in moved._asdict().items()
        }))  # fmt: skip
        look = CliRunner().invoke(
            app,
            ["look", str(tmp_path / "bag.db3"), "--urdf", str(tmp_path / "robot.urdf")],
        )
        assert look.exit_code == 0, look.exception
        assert "no torque and no motor current" in " ".join(look.output.split())


class TestTemperatures:
    """What a fleet reads of a bag in addition to the motion."""

    HEAT = "sensor_msgs/msg/Temperature"

    def heat(self, messages: Messages, value: float) -> Any:
        return messages.of(self.HEAT, header=messages.header(0), temperature=value, variance=0.0)

    @pytest.mark.parametrize("kind", ["mcap", "db3", "ros1"])
    def test_are_the_means_of_their_topics(self, tmp_path, kind) -> None:
        messages = Messages("ros1" if kind == "ros1" else "iron")
        moved = a_motion(0.1)
        warm = [(k, self.heat(messages, 30.0 + k)) for k in range(3)]
        topics = {"/joint_states": measured(messages, moved), "/gear": (self.HEAT, warm)}
        source = written(tmp_path / "bag", messages, topics, kind)
        assert facts_of(source, ExtraChannels(), LogFiles()) == {"/gear/temperature": 31.0}

    def test_of_joints_have_their_names_or_numbers(self, tmp_path) -> None:
        messages = Messages()
        states = [(k, messages.state(k, [40.0, 50.0 + k], names=JOINTS[::-1])) for k in (0, 2)]
        heats = [(k, messages.array([20.0, 21.0])) for k in (0, 1)]
        topics = {"/motor_temperatures": (STATE, states), "/temperature": (ARRAY, heats)}
        source = written(tmp_path / "bag", messages, topics)
        assert facts_of(source, ExtraChannels(), LogFiles()) == {
            f"/motor_temperatures/position/{JOINTS[1]}": 40.0,
            f"/motor_temperatures/position/{JOINTS[0]}": 51.0,
            "/temperature1": 20.0,
            "/temperature2": 21.0,
        }

    def test_other_topics_are_read_where_they_are_named(self, tmp_path) -> None:
        messages = Messages()
        topics = {"/minutes": (ARRAY, [(0, messages.array([5.0]))])}
        source = written(tmp_path / "bag", messages, topics)
        assert facts_of(source, ExtraChannels(), LogFiles()) == {}
        assert facts_of(source, ExtraChannels(("/minutes",)), LogFiles()) == {"/minutes": 5.0}
