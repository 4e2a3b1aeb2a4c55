"""Import of a recording of any kind, with a column map or without one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from hil.archive import open_archive
from hil.base.errors import ArchiveError, NotAnArchiveError, SourceError, UnrecordedJointError
from hil.base.safe_input import parse_toml
from hil.base.toml_text import to_text
from hil.cell.arms import Arm, Links, arms_of, recorded_arms
from hil.importers.bag_map import BagMap
from hil.importers.bags import open_bag
from hil.importers.channels import channels_of
from hil.importers.column_map import ColumnMap, map_text
from hil.importers.conclusions import (
    ChannelMeaning,
    Conclusion,
    Examined,
    FixedFingers,
    NameBasis,
    RecordedArm,
    UnitBasis,
)
from hil.importers.log import read_log
from hil.importers.proposal import proposed_map
from hil.importers.robot import Robot, Use
from hil.importers.rosbag2 import Effort, joint_state_topics, read_rosbag2, recorded_joints
from hil.importers.units import UNITS, Kind

_BAGS: Final = (".db3", ".bag", ".mcap", ".zstd", ".zst")
RobotOf = Callable[[Callable[[], tuple[str, ...] | None]], Robot]
"""Returns the robot; its argument reads the names of the recorded joints."""


@dataclass(frozen=True)
class ImportOptions:
    """How recordings are read where it is not concluded from them.

    Attributes:
        columns: file of a column map or the name of a ready one; None to propose one.
        chosen: channels by quantity, see :func:`hil.importers.proposal.proposed_map`.
        sample_rate: of a log without a time [Hz].
        topic: of the joint states of a bag.
        joint_names: in the URDF by name in the bag, where they differ.
        outside_limits: accept positions of which no row is within the limits of the URDF.
        drop_missing: leave out rows of a log in which a number is missing or is other text.
        command_topic: of the commanded positions of a bag, ``none`` for none; None to find it.
    """

    columns: Path | None = None
    chosen: Mapping[str, str] = field(default_factory=dict)
    sample_rate: float | None = None
    topic: str | None = None
    joint_names: Mapping[str, str] = field(default_factory=dict)
    outside_limits: bool = False
    drop_missing: bool = False
    command_topic: str | None = None


@dataclass(frozen=True)
class ImportedRecording:
    """An imported recording.

    Attributes:
        archive: that was written.
        map_text: the column map, TOML; None for joint states of a bag, which need none.
        bag: how those were read; None for a log.
        concluded: the meaning of each group of channels, what was fixed for it, and what the motion
            and the torque say, in this order.
        examined: what was found in its samples, and warnings.
    """

    archive: Path
    map_text: str | None
    concluded: tuple[Conclusion, ...]
    examined: Examined
    bag: BagMap | None = None

    @property
    def text(self) -> str | None:
        """The map with which the recording is read again as it was, TOML."""
        return self.map_text if self.bag is None else self.bag.text


def is_archive(path: Path) -> bool:
    """Return whether a file is an archive of this software, or a folder of such or a campaign."""
    if path.is_dir():
        return not any(path.glob("*.db3*")) and not (path / "metadata.yaml").exists()
    if path.suffix.lower() != ".mcap":
        return False
    try:
        open_archive(path, fields=())
    except NotAnArchiveError:
        return False
    except ArchiveError:
        return True  # a damaged one, of which identification says what is damaged
    return True


def has_joint_states(path: Path) -> bool:
    """Return whether a recording is a bag, or another file, with a topic of joint states.

    Raises:
        SourceError: it is named as a bag and cannot be read.
    """
    if not path.is_dir() and path.suffix.lower() not in _BAGS:
        return False
    with open_bag(path) as bag:
        topics = joint_state_topics(bag.topics)
    return bool(topics) or path.suffix.lower() != ".mcap"


def import_recording(
    source: Path,
    output: Path,
    robot_of: RobotOf,
    options: ImportOptions = ImportOptions(),
    *,
    held_joints: Sequence[str] = (),
    use: Use = "excitation",
    coupled: bool = True,
    force: bool = False,
) -> ImportedRecording:
    """Import a log or a bag; what no column map states is concluded from names and units.

    Joints of a gripper that were not recorded are fixed, and of a robot with several arms all
    joints but those of the recorded one. `held_joints` and the following are those of
    :func:`hil.import_log`.

    Raises:
        SourceError: it cannot be read, or its channels leave a quantity open.
        ArchiveWriteError: the archive exists or cannot be written.
    """
    read = partial(
        _imported,
        source,
        output,
        options=options,
        held_joints=held_joints,
        use=use,
        coupled=coupled,
        force=force,
    )
    return _of_recorded_joints(read, robot_of, source)


def import_bag(
    source: Path,
    output: Path,
    robot_of: RobotOf,
    bag: BagMap,
    options: ImportOptions = ImportOptions(),
    *,
    held_joints: Sequence[str] = (),
    use: Use = "excitation",
    force: bool = False,
) -> ImportedRecording:
    """Import the joint states of a bag that `bag` describes; see :func:`import_recording`."""

    def read(robots: RobotOf) -> ImportedRecording:
        return _import_bag(source, output, robots, bag, options, held_joints, use, force=force)

    return _of_recorded_joints(read, robot_of, source)


def _of_recorded_joints(
    read: Callable[[RobotOf], ImportedRecording], robot_of: RobotOf, source: Path
) -> ImportedRecording:
    """Import with joints fixed that were not recorded, where the URDF says which those are."""
    robots = _OfRecordedJoints(robot_of, source)
    try:
        return read(robots)
    except UnrecordedJointError as error:
        imported = _of_fewer_joints(read, robots, error)
    return replace(imported, concluded=(*imported.concluded, *robots.concluded))


def _of_fewer_joints(
    read: Callable[[RobotOf], ImportedRecording],
    robots: _OfRecordedJoints,
    refusal: UnrecordedJointError,
) -> ImportedRecording:
    """Import with fewer joints; raise the refusal where that is no help."""
    error = refusal
    while robots.fix(error):
        try:
            return read(robots)
        except UnrecordedJointError as further:
            error = further
    raise refusal


class _OfRecordedJoints:
    """Robots of which joints that were not recorded are fixed, after a refused import.

    Attributes:
        concluded: what was fixed.
    """

    def __init__(self, robot_of: RobotOf, source: Path) -> None:
        self._robot_of = robot_of
        self._source = source
        self._steps: list[Callable[[Robot], Robot]] = []
        self._robot: Robot | None = None
        self.concluded: tuple[Conclusion, ...] = ()

    def __call__(self, recorded: Callable[[], tuple[str, ...] | None]) -> Robot:
        robot = self._robot_of(recorded)
        for step in self._steps:
            robot = step(robot)
        self._robot = robot
        return robot

    def fix(self, error: UnrecordedJointError) -> bool:
        """Fix joints of a gripper, then those outside the recorded arm; False if there are none.

        Raises:
            SourceError: several arms have as many joints as were recorded.
        """
        robot = self._robot
        if robot is None:
            return False
        gripping = robot.without_gripper(error.joints)
        fixed = [name for name in robot.joint_names if name not in gripping.joint_names]
        if fixed and error.count <= len(gripping.joint_names):
            self._steps.append(lambda robot: robot.without_gripper(error.joints))
            fingers = FixedFingers({name: gripping.locked[name] for name in fixed})
            self.concluded = (*self.concluded, fingers)
            return True
        arm = self._arm(robot, error)
        if arm is None:
            return False
        self._steps.append(lambda robot: robot.between(arm.links))
        recorded = RecordedArm(str(arm), arm.links, by_names=bool(error.joints))
        self.concluded = (*self.concluded, recorded)
        return True

    def _arm(self, robot: Robot, error: UnrecordedJointError) -> Arm | None:
        """Return the only arm that the recording may be of, None without one."""
        arms = arms_of(robot.urdf, robot.joint_names)
        fitting = recorded_arms(arms, error.count, error.joints, error.channels)
        if len(fitting) > 1:
            names = " or ".join(map(str, fitting))
            problem = f"{error.count} joints were recorded, which may be {names}"
            remedy = f"choose the arm: {' or '.join(arm.links.options for arm in fitting)}"
            raise SourceError(self._source, problem, field="--base, --tip", remedy=remedy)
        (arm,) = fitting or (None,)
        return None if arm is None or arm.joints == robot.joint_names else arm


def with_arm(text: str, links: Links) -> str:
    """Return a map with the links of the recorded arm, unless it has them."""
    if not links or ColumnMap.model_validate(parse_toml(text)).arm:
        return text
    table = to_text({"arm": links.model_dump(exclude_none=True)})
    return f"{text.rstrip()}\n\n{table}"


def _arm_of_map(robot: Robot, links: Links, path: Path | None) -> Robot:
    """Return the arm of a map; SourceError where options name another one."""
    if not links or robot.links == links:
        return robot
    if robot.links:
        problem = f"names the arm between {links}, the options that between {robot.links}"
        remedy = "omit --base and --tip, or correct [arm] of the map"
        raise SourceError(path or Path(), problem, field="arm", remedy=remedy)
    return robot.between(links, path)


def _imported(
    source: Path,
    output: Path,
    robot_of: RobotOf,
    *,
    options: ImportOptions,
    held_joints: Sequence[str],
    use: Use,
    coupled: bool,
    force: bool,
) -> ImportedRecording:
    """Import with the robot as it is described; see :func:`import_recording`."""
    stated = None if options.columns is None else BagMap.load(options.columns)
    if stated is not None:
        return _import_bag(source, output, robot_of, stated, options, held_joints, use, force=force)
    if options.columns is None and has_joint_states(source) and not _read_as_log(source, options):
        bag = _bag_map(options)
        return _import_bag(source, output, robot_of, bag, options, held_joints, use, force=force)
    concluded: tuple[Conclusion, ...] = ()
    if options.columns is not None:
        robot = robot_of(partial(_joints_of_map, options.columns))
        columns = ColumnMap.load(options.columns)
        robot = _arm_of_map(robot, columns.arm, options.columns)
        text = map_text(options.columns)
    else:
        robot = robot_of(partial(_no_joints, source))
        proposal = proposed_map(
            source,
            robot,
            options.chosen,
            sample_rate=options.sample_rate,
            drop_missing=options.drop_missing,
        )
        columns = proposal.columns
        text = proposal.text
        concluded = proposal.concluded
    examined = read_log(source, robot=robot, columns=columns, coupled=coupled).write(
        output,
        held_joints=held_joints,
        use=use,
        force=force,
        outside_limits=options.outside_limits,
    )
    return ImportedRecording(output, with_arm(text, robot.links), concluded, examined)


def _bag_map(options: ImportOptions) -> BagMap:
    return BagMap(
        topic=options.topic, command_topic=options.command_topic, rename=options.joint_names
    )


def _read_as_log(source: Path, options: ImportOptions) -> bool:
    """Return whether options of a log are given for a file that also has joint states."""
    if not options.chosen and options.sample_rate is None:
        return False
    if source.suffix.lower() == ".mcap":
        return True
    field = "--columns" if options.chosen else "--sample-rate"
    remedy = "omit it; its topic of joint states is chosen with --topic"
    raise SourceError(source, "is a bag, which names its quantities", field=field, remedy=remedy)


def _import_bag(
    source: Path,
    output: Path,
    robot_of: RobotOf,
    stated: BagMap,
    options: ImportOptions,
    held_joints: Sequence[str],
    use: Use,
    *,
    force: bool,
) -> ImportedRecording:
    topic = stated.topic
    names = stated.rename
    robot = robot_of(lambda: recorded_joints(source, topic, names))
    robot = _arm_of_map(robot, stated.arm, options.columns)
    content = read_rosbag2(
        source,
        robot=robot,
        topic=topic,
        effort=stated.effort,
        clock=stated.clock,
        joint_names=names,
        command_topic=stated.command_topic,
    )
    examined = content.write(
        output,
        held_joints=held_joints,
        use=use,
        force=force,
        outside_limits=options.outside_limits,
    )
    entries = open_archive(output, fields=()).header.entries
    keys = ("topic", "clock", "effort", "command_topic")
    read = {key: entries[key] for key in keys if key in entries}
    bag = BagMap.model_validate({**read, "rename": dict(names), "arm": robot.links})
    basis = NameBasis.MESSAGE, UnitBasis.MESSAGE
    concluded = tuple(
        ChannelMeaning(channel.name, kind, basis[0], next(iter(UNITS[kind])), basis[1])
        for channel in channels_of(source)
        if channel.name.rpartition("/")[0] == entries["topic"]
        and (kind := _content(channel.kind, stated.effort)) is not None
    )
    if "command_topic" in entries:
        topic = str(entries["command_topic"])
        commands = NameBasis.COMMANDS, UnitBasis.MESSAGE
        how = str(entries["command"])
        meaning = ChannelMeaning(topic, "commanded_position", commands[0], None, commands[1], how)
        concluded = (*concluded, meaning)
    return ImportedRecording(output, None, concluded, examined, bag)


def _content(kind: Kind | None, effort: Effort) -> Kind | None:
    """Return the quantity of a field of joint states; None of an effort that is not used."""
    if kind != "torque" or effort == "torque":
        return kind
    return "motor_current" if effort == "motor_current" else None


def _joints_of_map(columns: Path) -> tuple[str, ...]:
    joints = ColumnMap.load(columns).joints
    if joints is None:
        problem = "does not name the recorded joints"
        remedy = "--lock-others needs joints = [...], the URDF's joint of each column"
        raise SourceError(columns, problem, field="joints", remedy=remedy)
    return joints


def _no_joints(source: Path) -> tuple[str, ...]:
    problem = "does not name the recorded joints"
    remedy = "name those that were not recorded with --locked NAME, or give a map with joints"
    raise SourceError(source, problem, field="--lock-others", remedy=remedy)
