"""Logs and bags of one arm of a robot that has several: which arm it is, and how that is stated."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest

from hil.archive import open_archive
from hil.base.errors import InputError, SourceError
from hil.cell.arms import Links, arms_of, recorded_arms
from hil.importers.conclusions import FixedFingers
from hil.importers.imported_robot import Robot
from hil.importers.messages import sentence
from hil.importers.recording_import import ImportOptions, import_recording
from hil.look import look_at
from hil.pipeline.sources import cell_of
from tests.hil.identified.command import hil
from tests.hil.importers.bags import STATE, bag, state
from tests.hil.importers.moving_log import POSITION, TIME, TORQUE
from tests.hil.importers.several_arms import chain, robot_of_arms
from tests.hil.simulated_logs import write_log as log


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    return robot_of_arms(tmp_path, ("left", 3), ("right", 3), ("head", 1))


LEFT, RIGHT = (tuple(f"{side}_j{number}" for number in (1, 2, 3)) for side in ("left", "right"))
LEFT_LINKS, RIGHT_LINKS = (Links(base="torso_l1", tip=f"{side}_l3") for side in ("left", "right"))


def generic(path: Path) -> Path:
    return log(path, ["t", "q{}", "tau{}"], TIME, POSITION, TORQUE)


def by_joint(path: Path, joints: tuple[str, ...]) -> Path:
    names = [f"{kind}_{joint}" for kind in ("pos", "effort") for joint in joints]
    return log(path, ["t", *names], TIME, *POSITION.T, *TORQUE.T)


def joints_of(archive: Path) -> tuple[str, ...]:
    return cell_of(open_archive(archive)).joint_names


class TestArmsOfAUrdf:
    def test_chains_begin_and_end_where_joints_branch(self, urdf: Path) -> None:
        robot = Robot.from_urdf(urdf)
        arms = arms_of(robot.urdf, robot.joint_names)
        whole = [("torso_j1", *joints) for joints in (LEFT, RIGHT)]
        assert {arm.joints for arm in arms} == {LEFT, RIGHT, *whole}
        assert {arm.links for arm in arms if arm.joints in (LEFT, RIGHT)} == {
            LEFT_LINKS,
            RIGHT_LINKS,
        }

    def test_names_of_channels_say_a_side(self, urdf: Path) -> None:
        robot = Robot.from_urdf(urdf)
        arms = arms_of(robot.urdf, robot.joint_names)
        (arm,) = recorded_arms(arms, 3, (), ("r_q1", "r_q2", "r_q3"))
        assert arm.joints == RIGHT

    def test_the_arm_with_the_torso_is_meant_where_that_is_recorded(self, urdf: Path) -> None:
        robot = Robot.from_urdf(urdf)
        arms = arms_of(robot.urdf, robot.joint_names)
        (arm,) = recorded_arms(arms, 4, ("torso_j1", *LEFT), ())
        assert arm.joints == ("torso_j1", *LEFT)


class TestConcluded:
    def test_by_the_names_of_its_joints(self, tmp_path: Path, urdf: Path) -> None:
        path = by_joint(tmp_path / "a.csv", RIGHT)
        imported = import_recording(path, tmp_path / "a.mcap", lambda _: Robot.from_urdf(urdf))
        assert joints_of(imported.archive.path) == RIGHT
        assert (
            "arm: right_j1 .. right_j3, between torso_l1 and right_l3, by the names of the recorded"
            " joints; all others are fixed"
        ) in map(sentence, imported.concluded)

    def test_by_their_names_with_all_others_locked(self, tmp_path: Path, urdf: Path) -> None:
        """A log names its joints in its columns, not beside them as a bag does."""
        path = by_joint(tmp_path / "a.csv", RIGHT)
        output = tmp_path / "a.mcap"
        result = hil("import", "log", path, "--urdf", urdf, "--lock-others", "-o", output)
        assert result.exit_code == 0, (result.output, result.exception)
        assert joints_of(output) == RIGHT

    def test_by_their_number(self, tmp_path: Path) -> None:
        urdf = robot_of_arms(tmp_path, ("arm", 3), ("head", 1))
        path = generic(tmp_path / "a.csv")
        imported = import_recording(path, tmp_path / "a.mcap", lambda _: Robot.from_urdf(urdf))
        assert joints_of(imported.archive.path) == ("arm_j1", "arm_j2", "arm_j3")

    @pytest.mark.parametrize("command", [("import", "log"), ("import", "rosbag2")])
    def test_of_a_bag(self, tmp_path: Path, urdf: Path, command: tuple[str, str]) -> None:
        messages = [
            state(9 + 10**7 * k, [0.01 * k] * 3, names=RIGHT, effort=[1.0] * 3) for k in range(9)
        ]
        source = bag(tmp_path / "x.db3", {"/joint_states": (STATE, messages)})
        result = hil(*command, source, "--urdf", urdf, "-o", tmp_path / "a.mcap")
        assert result.exit_code == 0, (result.output, result.exception)
        assert "arm: right_j1 .. right_j3" in result.output
        assert joints_of(tmp_path / "a.mcap") == RIGHT

    def test_the_map_reads_the_same_arm_again(self, tmp_path: Path, urdf: Path) -> None:
        path = by_joint(tmp_path / "a.csv", RIGHT)
        first = hil("import", "log", path, "--urdf", urdf, "-o", tmp_path / "a.mcap")
        assert first.exit_code == 0, (first.output, first.exception)
        text = (tmp_path / "a.map.toml").read_text()
        assert '[arm]\nbase = "torso_l1"\ntip = "right_l3"' in text
        given = ("--map", tmp_path / "a.map.toml", "-o", tmp_path / "b.mcap")
        again = hil("import", "log", path, "--urdf", urdf, *given)
        assert again.exit_code == 0, (again.output, again.exception)
        columns = [open_archive(tmp_path / f"{name}.mcap").columns for name in "ab"]
        assert all(np.array_equal(columns[0][name], columns[1][name]) for name in columns[1])


class TestStated:
    @pytest.mark.parametrize("command", [("identify",), ("look",), ("import", "log")])
    def test_two_arms_that_fit_are_chosen_from(
        self, tmp_path: Path, urdf: Path, command: tuple[str, ...]
    ) -> None:
        refused = hil(*command, generic(tmp_path / "a.csv"), "--urdf", urdf)
        assert isinstance(refused.exception, InputError)
        assert str(refused.exception).endswith(
            "3 joints were recorded, which may be left_j1 .. left_j3 or right_j1 .. right_j3; "
            "choose the arm: --base torso_l1 --tip left_l3 or --base torso_l1 --tip right_l3"
        )
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "robot.urdf"]

    def test_the_line_of_the_message_works_when_typed(self, tmp_path: Path, urdf: Path) -> None:
        path = generic(tmp_path / "a.csv")
        arguments = ("import", "log", path, "--urdf", urdf, "-o", tmp_path / "a.mcap")
        options = str(hil(*arguments).exception).rpartition("choose the arm: ")[2].split(" or ")
        result = hil(*arguments, *shlex.split(options[1]))
        assert result.exit_code == 0, (result.output, result.exception)
        assert joints_of(tmp_path / "a.mcap") == RIGHT
        assert 'tip = "right_l3"' in (tmp_path / "a.map.toml").read_text()

    def test_a_bag_of_both_arms(self, tmp_path: Path, urdf: Path) -> None:
        names = (*LEFT, *RIGHT)
        messages = [
            state(9 + 10**7 * k, [0.01 * k] * 6, names=names, effort=[1.0] * 6) for k in range(9)
        ]
        source = bag(tmp_path / "x.db3", {"/joint_states": (STATE, messages)})
        arguments = ("import", "log", source, "--urdf", urdf, "-o", tmp_path / "a.mcap")
        assert "choose the arm" in str(hil(*arguments).exception)
        result = hil(*arguments, "--tip", "left_l3", "--base", "torso_l1")
        assert result.exit_code == 0, (result.output, result.exception)
        assert joints_of(tmp_path / "a.mcap") == LEFT
        given = ("--map", tmp_path / "a.map.toml", "-o", tmp_path / "b.mcap")
        again = hil("import", "log", source, "--urdf", urdf, *given)
        assert again.exit_code == 0, (again.output, again.exception)
        assert joints_of(tmp_path / "b.mcap") == LEFT

    def test_options_that_contradict_the_map(self, tmp_path: Path, urdf: Path) -> None:
        path = generic(tmp_path / "a.csv")
        arguments = ("import", "log", path, "--urdf", urdf, "-o", tmp_path / "a.mcap", "--force")
        hil(*arguments, "--base", "torso_l1", "--tip", "left_l3")
        given = ("--map", tmp_path / "a.map.toml")
        refused = hil(*arguments, *given, "--base", "torso_l1", "--tip", "right_l3")
        assert "omit --base and --tip" in str(refused.exception)
        assert hil(*arguments, *given).exit_code == 0

    def test_a_link_that_is_misspelt(self, tmp_path: Path, urdf: Path) -> None:
        refused = hil("look", generic(tmp_path / "a.csv"), "--urdf", urdf, "--tip", "rigt_l3")
        assert "--tip: has no link 'rigt_l3'; the nearest are right_l3" in str(refused.exception)

    def test_a_look_writes_the_arm_into_its_map(self, tmp_path: Path, urdf: Path) -> None:
        robot = Robot.from_urdf(urdf, links=RIGHT_LINKS)
        look = look_at(generic(tmp_path / "a.csv"), lambda _: robot, ImportOptions())
        assert '[arm]\nbase = "torso_l1"' in (look.map_text or "")


def test_joints_that_are_no_arm_are_refused_as_before(tmp_path: Path, urdf: Path) -> None:
    path = by_joint(tmp_path / "a.csv", (*LEFT[:2], "head_j1"))
    with pytest.raises(SourceError, match="3 channels are named as position"):
        import_recording(path, tmp_path / "a.mcap", lambda _: Robot.from_urdf(urdf))


@pytest.mark.long
def test_a_gripper_that_a_bag_has_not_is_fixed_by_every_import(tmp_path: Path) -> None:
    path = robot_of_arms(tmp_path, ("arm", 3))
    finger = chain("finger", 1, "arm_l3")
    path.write_text(path.read_text().replace("</robot>", f"{finger}</robot>"))
    names = ("torso_j1", "arm_j1", "arm_j2", "arm_j3")
    messages = [state(9 + 10**7 * k, [0.0] * 4, names=names, effort=[1.0] * 4) for k in range(9)]
    source = bag(tmp_path / "x.db3", {"/joint_states": (STATE, messages)})
    for number, command in enumerate((("import", "log"), ("import", "rosbag2"))):
        output = tmp_path / f"{number}.mcap"
        result = hil(*command, source, "--urdf", path, "-o", output)
        assert result.exit_code == 0, (result.output, result.exception)
        assert "finger_j1: fixed at 0 rad: a gripper that was not recorded" in result.output
        assert joints_of(output) == names


@pytest.mark.parametrize(
    ("places", "text"),
    [((0.0, 0.0), "fixed at 0 m: a gripper"), ((0.0, 0.02), "fixed at 0 m, 0.02 m: a gripper")],
)
def test_a_place_that_all_fingers_have_is_said_once(places: tuple[float, float], text: str) -> None:
    fingers = "left_finger", "right_finger"
    fixed = FixedFingers(dict(zip(fingers, places, strict=True)), dict.fromkeys(fingers, "m"))
    assert f"left_finger, right_finger: {text}" in sentence(fixed)


@pytest.mark.parametrize("effort", ["motor_current", "ignore"])
def test_what_the_effort_of_a_bag_is_said_to_be(tmp_path: Path, urdf: Path, effort: str) -> None:
    messages = [state(9 + 10**7 * k, [0.0] * 3, names=LEFT, effort=[1.0] * 3) for k in range(9)]
    source = bag(tmp_path / "x.db3", {"/joint_states": (STATE, messages)})
    arguments = (source, "--urdf", urdf, "--effort", effort, "-o", tmp_path / "a.mcap")
    output = hil("import", "rosbag2", *arguments).output
    assert ("/joint_states/effort: motor_current, A" in output) == (effort == "motor_current")
    assert ": torque" not in output
