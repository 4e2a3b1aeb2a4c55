"""Import of a recording of any kind, with a column map or without one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from hil.archive import open_archive
from hil.errors import ArchiveError, NotAnArchiveError, SourceError, UnrecordedJointError
from hil.importers.bag_map import BagMap
from hil.importers.bags import open_bag
from hil.importers.channels import channels_of
from hil.importers.column_map import ColumnMap, map_text
from hil.importers.log import import_log
from hil.importers.proposal import proposed_map
from hil.importers.robot import Robot, Use
from hil.importers.rosbag2 import import_rosbag2, joint_state_topics, recorded_joints
from hil.importers.units import UNITS

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
        lines: one for each group of channels that was concluded: name, quantity, unit, reason.
    """

    archive: Path
    map_text: str | None
    lines: tuple[str, ...]
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

    Joints of a gripper that were not recorded are fixed. `held_joints` and the following are those
    of :func:`hil.importers.import_log`.

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
    try:
        return read(robot_of)
    except UnrecordedJointError:
        robots = _WithoutGripper(robot_of, source, options)
        try:
            imported = read(robots)
        except SourceError:
            imported = None  # of the arm with its gripper the remedy is right
        if imported is None or robots.line is None:
            raise
    return replace(imported, lines=(*imported.lines, robots.line))


class _WithoutGripper:
    """Robots whose gripper's joints are fixed, but those that a bag has."""

    def __init__(self, robot_of: RobotOf, source: Path, options: ImportOptions) -> None:
        self._robot_of = robot_of
        self._source = source
        self._options = options
        self.line: str | None = None  #: what was fixed

    def __call__(self, recorded: Callable[[], tuple[str, ...] | None]) -> Robot:
        robot = self._robot_of(recorded)
        arm = robot.without_gripper(self._recorded())
        fixed = [name for name in robot.joint_names if name not in arm.joint_names]
        if fixed:
            names = ", ".join(fixed)
            places = ", ".join(f"{arm.locked[name]:.3g}" for name in fixed)
            self.line = f"{names}: fixed, at {places} (rad or m), as of an unrecorded gripper"
        return arm

    def _recorded(self) -> tuple[str, ...]:
        """Return the joints of a bag; none of a log, which has too few channels for them."""
        options = self._options
        if not has_joint_states(self._source) or _read_as_log(self._source, options):
            return ()
        stated = None if options.columns is None else BagMap.load(options.columns)
        bag = stated or _bag_map(options)
        return recorded_joints(self._source, bag.topic, bag.rename)


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
    lines: tuple[str, ...] = ()
    if options.columns is not None:
        robot = robot_of(partial(_joints_of_map, options.columns))
        columns = ColumnMap.load(options.columns)
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
        lines = proposal.lines
    import_log(
        source,
        output,
        robot=robot,
        columns=columns,
        held_joints=held_joints,
        use=use,
        coupled=coupled,
        force=force,
        outside_limits=options.outside_limits,
    )
    return ImportedRecording(output, text, lines)


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
    import_rosbag2(
        source,
        output,
        robot=robot_of(lambda: recorded_joints(source, topic, names)),
        topic=topic,
        effort=stated.effort,
        clock=stated.clock,
        joint_names=names,
        command_topic=stated.command_topic,
        held_joints=held_joints,
        use=use,
        force=force,
        outside_limits=options.outside_limits,
    )
    entries = open_archive(output, fields=()).header.entries
    read = {
        key: entries[key] for key in ("topic", "clock", "effort", "command_topic") if key in entries
    }
    bag = BagMap.model_validate({**read, "rename": dict(names)})
    lines = tuple(
        f"{channel.name}: {channel.kind}, {next(iter(UNITS[channel.kind]))}, by the field of the "
        "joint states; joints by their names"
        for channel in channels_of(source)
        if channel.kind is not None and channel.name.rpartition("/")[0] == entries["topic"]
    )
    if "command_topic" in entries:
        line = f"{entries['command_topic']}: commanded_position, rad or m, {entries['command']}"
        lines = (*lines, line)
    return ImportedRecording(output, None, lines, bag)


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
