"""Import of a recording of any kind, with a column map or without one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

from hil.archive import Archive, open_archive
from hil.archive.header import EPISODE
from hil.base.errors import ArchiveError, NotAnArchiveError, SourceError, UnrecordedJointError
from hil.base.safe_input import parse_toml
from hil.base.toml_text import to_text
from hil.cell.arms import Arm, Links, arms_of, recorded_arms
from hil.cell.toml_edits import with_values
from hil.importers.bag_map import BagMap
from hil.importers.bags import open_bag
from hil.importers.channels import channels_of
from hil.importers.column_map import ColumnMap, Format, map_text
from hil.importers.command_file import CommandFile
from hil.importers.conclusions import (
    ChannelMeaning,
    Conclusion,
    Examined,
    FixedFingers,
    NameBasis,
    RecordedArm,
    UnitBasis,
)
from hil.importers.folder_of_files import proposed_map_of_folder
from hil.importers.imported_robot import Robot
from hil.importers.lerobot import DataSet, Episode, EpisodeUnit, is_data_set
from hil.importers.log import are_in_rows_of_their_own, read_log
from hil.importers.log_files import LogFiles, is_folder_of_logs
from hil.importers.partial_map import PartialMap
from hil.importers.proposed_map import Proposal, proposed_map
from hil.importers.recording_content import RecordingContent, Use, require_writable, write_to
from hil.importers.rosbag2 import Effort, joint_state_topics, read_rosbag2, recorded_joints
from hil.importers.text_table import TextTable
from hil.importers.units import UNITS, Kind
from identification.model.urdf_text import position_units

_BAGS: Final = (".db3", ".bag", ".mcap", ".zstd", ".zst")
_FACTOR: Final = re.compile(r"\*\s*([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*\Z")
"""Of the numbers of a channel, after its name."""
RobotOf = Callable[[Callable[[], tuple[str, ...] | None]], Robot]
"""Returns the robot; its argument reads the names of the recorded joints."""


@dataclass(frozen=True)
class ImportOptions:
    """How recordings are read where it is not concluded from them.

    Attributes:
        columns: file of a column map, of some entries of one, or the name of a ready one; what it
            does not state is proposed.
        chosen: channels by quantity, see :func:`hil.importers.proposed_map.proposed_map`, each
            with a factor where it is ``NAME*FACTOR``.
        sample_rate: of a log without a time [Hz].
        topic: of the joint states of a bag.
        joint_names: in the URDF by name in the bag, where they differ.
        outside_limits: accept positions of which no row is within the limits of the URDF.
        drop_missing: leave out rows of a log in which a number is missing or is other text.
        command_topic: of the commanded positions of a bag, ``none`` for none; None to find it.
        commands: file of the commanded positions of a log, with times of its own.
        calibration: LeRobot's calibration of the arm of a data set, JSON.
        units: of the joints of a data set of LeRobot; None to conclude them.
    """

    columns: Path | None = None
    chosen: Mapping[str, str] = field(default_factory=dict)
    sample_rate: float | None = None
    topic: str | None = None
    joint_names: Mapping[str, str] = field(default_factory=dict)
    outside_limits: bool = False
    drop_missing: bool = False
    command_topic: str | None = None
    commands: Path | None = None
    calibration: Path | None = None
    units: EpisodeUnit | None = None


@dataclass(frozen=True)
class ImportRequest:
    """A recording to read, whatever describes its channels.

    Attributes:
        source: its file or folder.
        place: path of the archive.
        use: what identification uses it for.
        held_joints, coupled, outside_limits: as of :func:`hil.import_log`.
        files: of a log, parsed once.
    """

    source: Path
    place: Path
    use: Use = "excitation"
    held_joints: tuple[str, ...] = ()
    coupled: bool = True
    outside_limits: bool = False
    files: LogFiles = field(default_factory=LogFiles, compare=False, repr=False)

    def imported(
        self,
        content: RecordingContent,
        text: str | None,
        concluded: tuple[Conclusion, ...],
        bag: BagMap | None = None,
    ) -> ImportedRecording:
        """Return what was read.

        Args:
            content: of the recording.
            text: of its column map, TOML; None for joint states of a bag.
            concluded: about its channels.
            bag: map of the bag.
        """
        if self.files.longest is not None:
            content = content.excerpt(self.files.longest)
        archive, examined = content.archive(
            self.place,
            held_joints=self.held_joints,
            use=self.use,
            outside_limits=self.outside_limits,
        )
        return ImportedRecording(self, archive, content.source, text, concluded, examined, bag)


@dataclass(frozen=True)
class ImportedRecording:
    """An imported recording, in memory.

    Attributes:
        request: by which it is read again with another map.
        archive: its content.
        sources: the files that it was read from.
        map_text: the column map, TOML; None for joint states of a bag, which need none.
        concluded: the meaning of each group of channels, what was fixed for it, and what the motion
            and the torque say, in this order.
        examined: what was found in its samples, and warnings.
        bag: how joint states were read; None for a log.
        is_stated: whether a whole column map was given.
    """

    request: ImportRequest
    archive: Archive
    sources: tuple[Path, ...]
    map_text: str | None
    concluded: tuple[Conclusion, ...]
    examined: Examined
    bag: BagMap | None = None
    is_stated: bool = False

    @property
    def text(self) -> str | None:
        """The map with which the recording is read again as it was, TOML."""
        return self.map_text if self.bag is None else self.bag.text

    def write(self, output: Path, *, force: bool = False) -> None:
        """Write the archive; with `force` it replaces another once it is complete.

        Raises:
            ArchiveWriteError: the archive exists or cannot be written.
        """
        require_writable(output, self.sources, force=force)
        write_to(output, self.archive, force=force)


def is_archive(path: Path) -> bool:
    """Return whether a file is an archive of this software, or a folder of such or a campaign."""
    if is_data_set(path):
        return False
    if path.is_dir():
        is_bag = any(path.glob("*.db3*")) or (path / "metadata.yaml").exists()
        return not is_bag and not is_folder_of_logs(path)
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
    if path.is_dir() and is_folder_of_logs(path):
        return False
    if not path.is_dir() and path.suffix.lower() not in _BAGS:
        return False
    with open_bag(path) as bag:
        topics = joint_state_topics(bag.topics)
    return bool(topics) or path.suffix.lower() != ".mcap"


def read_recording(
    source: Path,
    robot_of: RobotOf,
    options: ImportOptions = ImportOptions(),
    *,
    place: Path | None = None,
    held_joints: Sequence[str] = (),
    use: Use = "excitation",
    coupled: bool = True,
    files: LogFiles | None = None,
) -> ImportedRecording:
    """Read a log or a bag; what no column map states is concluded from names and units.

    Joints of a gripper that were not recorded are fixed, and of a robot with several arms all
    joints but those of the recorded one.

    Args:
        source: the recording.
        robot_of: its robot, see :data:`RobotOf`.
        options: how it is read.
        place: path of the archive that may be written.
        held_joints: of :func:`hil.import_log`, as the following.
        use: what identification uses it for.
        coupled: whether the model gets inertia and friction of coupled motors.
        files: of a log, parsed before.

    Raises:
        SourceError: it cannot be read, or its channels leave a quantity open.
    """
    place = place or source.with_suffix(".mcap")
    outside = options.outside_limits
    request = ImportRequest(
        source, place, use, tuple(held_joints), coupled, outside, files or LogFiles()
    )
    return _of_recorded_joints(partial(_imported, request, options=options), robot_of, source)


def _as_it_is(imported: ImportedRecording) -> ImportedRecording:
    return imported


def import_recording(
    source: Path,
    output: Path,
    robot_of: RobotOf,
    options: ImportOptions = ImportOptions(),
    *,
    bag: BagMap | None = None,
    held_joints: Sequence[str] = (),
    use: Use = "excitation",
    coupled: bool = True,
    force: bool = False,
    asked: Callable[[ImportedRecording], ImportedRecording] = _as_it_is,
) -> ImportedRecording:
    """Read a recording and write its archive; see :func:`read_recording`.

    Args:
        source: file or folder of the recording.
        output: path of the archive.
        robot_of: reads the robot's cell or URDF.
        options: of the import.
        bag: topics of a bag; None to find them, or for a log.
        held_joints: joints that were clamped.
        use: what the recording is for.
        coupled: whether coupled angles are searched for.
        force: whether an existing archive is replaced.
        asked: returns the recording as its motion and torque say that it is.

    Raises:
        SourceError: it cannot be read, or its channels leave a quantity open.
        ArchiveWriteError: the archive exists or cannot be written.
    """
    require_writable(output, [source], force=force)
    request = ImportRequest(
        source, output, use, tuple(held_joints), coupled, options.outside_limits
    )
    read = (
        partial(_imported, request, options=options)
        if bag is None
        else partial(_read_bag, request, stated=bag, path=options.columns)
    )
    imported = asked(_of_recorded_joints(read, robot_of, source))
    imported.write(output, force=force)
    return imported


def read_by_map(request: ImportRequest, robot_of: RobotOf, text: str) -> ImportedRecording:
    """Read a log or a bag by its map, TOML; see :func:`read_recording`.

    Raises:
        SourceError: it cannot be read, or the map leaves a quantity open.
    """
    source = request.source
    tables = parse_toml(text)
    bag = BagMap.of(tables)
    if bag is not None:
        return _of_recorded_joints(
            partial(_read_bag, request, stated=bag, path=None), robot_of, source
        )
    columns = ColumnMap.model_validate(tables)

    def read(robots: RobotOf) -> ImportedRecording:
        robot = robots(lambda: _joints_of(columns, source))
        return _of_map(request, _arm_of_map(robot, columns.arm, source), columns, text)

    return _of_recorded_joints(read, robot_of, source)


def _of_recorded_joints(
    read: Callable[[RobotOf], ImportedRecording], robot_of: RobotOf, source: Path
) -> ImportedRecording:
    """Import with unrecorded joints fixed, if the URDF shows which they are."""
    robots = _OfRecordedJoints(robot_of, source)
    try:
        return read(robots)
    except UnrecordedJointError as error:
        imported = _of_fewer_joints(read, robots, error)
    text = imported.map_text
    if text is not None and robots.named is not None:  # so that it is read again in the same way
        text = with_values(text, {"joints": [*robots.named]})
    concluded = (*imported.concluded, *robots.concluded)
    return replace(imported, map_text=text, concluded=concluded)


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
    """Robots with unrecorded joints fixed, after a refused import.

    Attributes:
        named: joints that the channels name, where all others are fixed.
        concluded: what was fixed.
    """

    def __init__(self, robot_of: RobotOf, source: Path) -> None:
        self._robot_of = robot_of
        self._source = source
        self._steps: list[Callable[[Robot], Robot]] = []
        self._robot: Robot | None = None
        self._locks_others = False
        self.named: tuple[str, ...] | None = None
        self.concluded: tuple[Conclusion, ...] = ()

    def __call__(self, recorded: Callable[[], tuple[str, ...] | None]) -> Robot:
        def names() -> tuple[str, ...] | None:
            self._locks_others = True  # only then it is asked
            return self.named or recorded()

        robot = self._robot_of(names)
        for step in self._steps:
            robot = step(robot)
        self._robot = robot
        return robot

    def fix(self, error: UnrecordedJointError) -> bool:
        """Fix joints of a gripper, then joints outside the recorded arm; False without any.

        Instead all that no channel names, if the user says so.

        Raises:
            SourceError: several arms have as many joints as were recorded.
        """
        robot = self._robot
        if robot is None:
            return False
        if self._locks_others and self.named is None and len(error.joints) == error.count:
            self.named = error.joints
            return True
        gripping = robot.without_gripper(error.joints)
        fixed = [name for name in robot.joint_names if name not in gripping.joint_names]
        if fixed and error.count <= len(gripping.joint_names):
            self._steps.append(lambda robot: robot.without_gripper(error.joints))
            fingers = FixedFingers(
                {name: gripping.locked[name] for name in fixed}, position_units(robot.urdf, fixed)
            )
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
        """Return the only arm that may have made the recording, or None."""
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


def read_episodes(
    source: Path,
    robot_of: RobotOf,
    options: ImportOptions = ImportOptions(),
    *,
    use: Use = "excitation",
    place_of: Callable[[Path], Path],
) -> Iterator[tuple[Path, ImportedRecording]]:
    """Yield the episodes of a data set of LeRobot, with the path that names each.

    Args:
        source: folder of the data set.
        robot_of: its robot, see :data:`RobotOf`.
        options: how it is read.
        use: what identification uses it for.
        place_of: the path of an episode's archive.

    Raises:
        SourceError: it cannot be read, or joints or units are not clear.
    """
    data = DataSet.read(source)
    for episode in data.episodes:
        place = place_of(episode.path)
        request = ImportRequest(episode.path, place, use, outside_limits=options.outside_limits)
        read = partial(_of_episode, request, data=data, episode=episode, options=options)
        yield episode.path, _of_recorded_joints(read, robot_of, source)


def _of_episode(
    request: ImportRequest,
    robot_of: RobotOf,
    *,
    data: DataSet,
    episode: Episode,
    options: ImportOptions,
) -> ImportedRecording:
    """Read an episode of a data set."""
    robot = robot_of(lambda: data.joints)
    if options.columns is not None:
        text, concluded = map_text(options.columns), tuple[Conclusion, ...]()
        columns = ColumnMap.load(options.columns)
    else:
        text, units = data.map_for(robot, options.calibration, options.units)
        columns, concluded = ColumnMap.model_validate(parse_toml(text)), (units,)
    request = replace(request, source=episode.path, files=episode.files)
    content = _read_log(request, robot, columns)
    number = {EPISODE: str(episode.number)}
    content = replace(content, source=(episode.source,), metadata={**content.metadata, **number})
    return _by_map(request, robot, columns, text, content, concluded)


def _imported(
    request: ImportRequest, robot_of: RobotOf, *, options: ImportOptions
) -> ImportedRecording:
    """Read with the robot as it is described; see :func:`read_recording`."""
    source = request.source
    if is_data_set(source):
        data = DataSet.read(source)
        return _of_episode(request, robot_of, data=data, episode=data.longest, options=options)
    path = options.columns
    stated = None if path is None else BagMap.load(path)
    if stated is not None:
        return replace(_read_bag(request, robot_of, stated, path), is_stated=True)
    if path is None and has_joint_states(source) and not _read_as_log(source, options):
        return _read_bag(request, robot_of, _bag_map(options), None)
    some = None if path is None or has_joint_states(source) else PartialMap.load(path)
    if path is not None and some is None:
        robot = robot_of(lambda: _joints_of(ColumnMap.load(path), path))
        columns = ColumnMap.load(path)
        robot = _arm_of_map(robot, columns.arm, path)
        imported = _of_map(request, robot, columns, map_text(path))
        return replace(imported, is_stated=True)
    robot = robot_of(_no_joints)
    if some is not None:
        robot = _arm_of_map(robot, some.stated.arm, path)
    proposal = _proposed(request, robot, options, some)
    return _of_map(request, robot, proposal.columns, proposal.text, proposal.concluded)


def _proposed(
    request: ImportRequest, robot: Robot, options: ImportOptions, some: PartialMap | None
) -> Proposal:
    """Return the map that a log or a folder suggests, with the entries that some map states."""
    form = Format(missing="drop") if options.drop_missing else None
    chosen, scales = _scaled(options.chosen)
    rate = options.sample_rate
    if some is not None:
        chosen = some.channels
        rate = some.sample_rate
        form = some.stated.format if "format" in some.entries else None
    source = request.source
    files = request.files
    commands = None
    if options.commands is not None:
        if source.is_dir():
            problem = "is for a single log: a folder has its commands in one of its files"
            remedy = "state the file: --columns 'commanded_position=FILE'"
            raise SourceError(options.commands, problem, field="--commands", remedy=remedy)
        commands = CommandFile.of(options.commands, source, robot.joint_names, form, files)
        chosen = {**chosen, "commanded_position": ",".join(commands.columns)}
    if source.is_dir():
        proposal = proposed_map_of_folder(
            source, robot, chosen, sample_rate=rate, form=form, files=files
        )
    else:
        with_unit = frozenset[str]() if some is None else some.with_unit
        proposal = proposed_map(
            source, robot, chosen, sample_rate=rate, form=form, with_unit=with_unit, files=files
        )
        if commands is not None:
            text = with_values(proposal.text, commands.entries)
            columns = ColumnMap.model_validate(parse_toml(text))
            proposal = replace(proposal, text=text, columns=columns)
        proposal = _with_own_rows(request, robot, proposal)
    if scales:
        text = with_values(proposal.text, scales)
        proposal = replace(proposal, text=text, columns=ColumnMap.model_validate(parse_toml(text)))
    return proposal if some is None else some.completed(proposal)


def _scaled(chosen: Mapping[str, str]) -> tuple[dict[str, str], dict[str, float]]:
    """Return the channels by quantity without factors, and these as entries of a column map."""
    names = dict(chosen)
    scales = {}
    for kind, name in chosen.items():
        if found := _FACTOR.search(name):
            names[kind] = name[: found.start()]
            scales[f"{kind}.scale"] = float(found.group(1))
    return names, scales


def _with_own_rows(request: ImportRequest, robot: Robot, proposal: Proposal) -> Proposal:
    """Return a proposal that interpolates, where quantities are in rows of their own."""
    columns = proposal.columns
    source = request.source
    if columns.format.missing == "interpolate":
        return proposal
    file = request.files.file(source, columns.format)
    if isinstance(file, TextTable) and not file.lacks_numbers:
        return proposal
    text = with_values(proposal.text, {"format.missing": "interpolate"})
    interpolating = ColumnMap.model_validate(parse_toml(text))
    if not are_in_rows_of_their_own(
        source, robot=robot, columns=interpolating, files=request.files
    ):
        return proposal
    return replace(proposal, text=text, columns=interpolating)


def _of_map(
    request: ImportRequest,
    robot: Robot,
    columns: ColumnMap,
    text: str,
    concluded: tuple[Conclusion, ...] = (),
) -> ImportedRecording:
    """Read a log by a column map and its text."""
    content = _read_log(request, robot, columns)
    return _by_map(request, robot, columns, text, content, concluded)


def _read_log(request: ImportRequest, robot: Robot, columns: ColumnMap) -> RecordingContent:
    return read_log(
        request.source,
        robot=robot,
        columns=columns,
        coupled=request.coupled,
        files=request.files,
    )


def _by_map(
    request: ImportRequest,
    robot: Robot,
    columns: ColumnMap,
    text: str,
    content: RecordingContent,
    concluded: tuple[Conclusion, ...],
) -> ImportedRecording:
    """Return what a column map read, with the map as which it is read again."""
    request = replace(request, outside_limits=request.outside_limits or columns.outside_limits)
    return request.imported(content, with_arm(text, robot.links), concluded)


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


def _read_bag(
    request: ImportRequest, robot_of: RobotOf, stated: BagMap, path: Path | None
) -> ImportedRecording:
    """Read joint states by a map of a bag, from a path if it has one."""
    source = request.source
    topic = stated.topic
    names = stated.rename
    robot = robot_of(lambda: recorded_joints(source, topic, names))
    robot = _arm_of_map(robot, stated.arm, path)
    content = read_rosbag2(
        source,
        robot=robot,
        topic=topic,
        effort=stated.effort,
        clock=stated.clock,
        joint_names=names,
        command_topic=stated.command_topic,
    )
    entries = content.metadata
    keys = ("topic", "clock", "effort", "command_topic")
    read = {key: entries[key] for key in keys if key in entries}
    request = replace(request, outside_limits=request.outside_limits or stated.outside_limits)
    others = {"arm": robot.links, "outside_limits": stated.outside_limits}
    bag = BagMap.model_validate({**read, "rename": _used(names, robot), **others})
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
    return request.imported(content, None, concluded, bag)


def _used(names: Mapping[str, str], robot: Robot) -> dict[str, str]:
    """Return the changed names of the joints of a robot."""
    return {recorded: name for recorded, name in names.items() if name in robot.joint_names}


def _content(kind: Kind | None, effort: Effort) -> Kind | None:
    """Return the quantity of a field of joint states; None of an effort that is not used."""
    if kind != "torque" or effort == "torque":
        return kind
    return "motor_current" if effort == "motor_current" else None


def _joints_of(columns: ColumnMap, path: Path) -> tuple[str, ...]:
    if columns.joints is None:
        problem = "does not name the recorded joints"
        remedy = "--lock-others needs joints = [...], the URDF's joint of each column"
        raise SourceError(path, problem, field="joints", remedy=remedy)
    return columns.joints


def _no_joints() -> None:
    """Return no names of joints: names and number of the channels show which were recorded."""
