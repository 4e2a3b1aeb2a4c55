"""Import of joint states from a bag of ROS, or any MCAP file with ROS 2 messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from hil.archive import ImportedSamples
from hil.base.arrays import Array
from hil.base.errors import SourceError, UnrecordedJointError
from hil.importers.bags import Bag, BagMessage, open_bag
from hil.importers.commands import CommandStamps as CommandClock
from hil.importers.commands import (
    Measured,
    as_joint_state,
    commanded_positions,
    measured_topics,
    topics_of_kind,
)
from hil.importers.conclusions import (
    Conclusion,
    LeftOut,
    MergedMessages,
    Omitted,
    PartialVelocity,
)
from hil.importers.imported_robot import NOT_RECORDED, Robot
from hil.importers.mcap_messages import Topic
from hil.importers.publishers import MAX_MESSAGES_PER_STAMP, MIN_SAMPLE_DISTANCE, second_publisher
from hil.importers.recording_content import RecordingContent, Use
from hil.importers.resampling import at_stamps
from hil.importers.ros_messages import CONTROLLER_STATE, JOINT_STATE
from hil.importers.stamps import leading_zeros, sorted_neighbours

Effort = Literal["torque", "motor_current", "ignore"]
CommandStamps = Literal["auto", "header", "bag"]

_QUANTITIES: Final = ("position", "velocity", "effort")
_MAX_GAP_PERIODS: Final = 2.0  # periods between a sample and the one that it is interpolated to
_MIN_TRAVEL: Final = 1e-3  # rad or m; a joint that moves less is at rest
_AT_REST: Final = "lock joints that did not move: --locked NAME=POSITION"
_BAG_CLOCK: Final = "use the time at which the bag received the messages: --clock bag"


def import_rosbag2(
    source: str | PathLike[str],
    output: str | PathLike[str],
    *,
    robot: Robot,
    topic: str | None = None,
    effort: Effort = "torque",
    clock: CommandStamps = "auto",
    joint_names: Mapping[str, str] | None = None,
    command_topic: str | None = None,
    held_joints: Sequence[str] = (),
    use: Use = "excitation",
    force: bool = False,
    outside_limits: bool = False,
) -> Path:
    """Convert the joint states of a bag to an archive of kind ``imported``, and return its path.

    Joints are found by name in all messages of the topic. Where joints come in messages of their
    own, those are merged by stamp. Messages with none of them (a gripper on the same topic) are
    ignored. Stamps are those in the messages' headers; where all are empty, the bag's.

    Args:
        source: a ``.db3``, ``.mcap`` or (ROS 1) ``.bag`` file, or the folder of a bag; compressed
            ones as well.
        output: path of the archive.
        robot: that was recorded.
        topic: of the joint states.
        effort: whether it is a joint torque [N·m] or a motor current [A].
        clock: ``bag`` for the stamps of the bag.
        joint_names: names in the URDF by name in the bag, where they differ.
        command_topic: of the commanded positions (``none`` for none), by default the topic that
            says most (:mod:`hil.importers.commands`).
        held_joints: joints that were clamped.
        use: of the recording.
        force: replace an existing archive.
        outside_limits: accept positions of which no row is within the limits of the URDF.

    Raises:
        SourceError: no bag, no such topic, a joint that was not recorded, a value not finite.
        ArchiveWriteError: the archive exists or cannot be written.
    """
    content = read_rosbag2(
        source,
        robot=robot,
        topic=topic,
        effort=effort,
        clock=clock,
        joint_names=joint_names,
        command_topic=command_topic,
    )
    content.write(
        output, held_joints=held_joints, use=use, force=force, outside_limits=outside_limits
    )
    return Path(output)


def read_rosbag2(
    source: str | PathLike[str],
    *,
    robot: Robot,
    topic: str | None = None,
    effort: Effort = "torque",
    clock: CommandStamps = "auto",
    joint_names: Mapping[str, str] | None = None,
    command_topic: str | None = None,
) -> RecordingContent:
    """Read the joint states of a bag; see :func:`import_rosbag2`.

    Args:
        source: a file or the folder of a bag.
        robot: that was recorded.
        topic: of the joint states.
        effort: whether it is a torque or a current.
        clock: ``bag`` for the stamps of the bag.
        joint_names: names in the URDF by name in the bag, where they differ.
        command_topic: of the commanded positions.

    Raises:
        SourceError: no bag, no such topic, a joint that was not recorded, a value not finite.
    """
    with open_bag(Path(source)) as bag:
        chosen = _choose(bag, topic)
        states = _States(bag.files[0], robot.joint_names, joint_names or {}, effort, clock)
        for message in bag.messages(chosen):
            states.add(as_joint_state(message))
        files = bag.files
        samples = states.samples()
        commands = commanded_positions(bag, chosen, states.measured(samples), command_topic)
    samples = replace(samples, commanded_position=commands.values)
    metadata = {"importer": "rosbag2", "topic": chosen, "effort": effort, "clock": states.clock}
    if commands.values is not None:
        metadata |= {"command_topic": commands.topic, "command": commands.reading}
    return RecordingContent(
        samples,
        robot,
        source=tuple(files),
        metadata=metadata,
        concluded=(*states.concluded, *commands.concluded),
        clock_remedy=_BAG_CLOCK if states.clock == "header" else "record again",
    )


def recorded_joints(
    source: str | PathLike[str],
    topic: str | None = None,
    joint_names: Mapping[str, str] | None = None,
) -> tuple[str, ...]:
    """Return the joints in all messages of a bag, by their names in the URDF.

    Raises:
        SourceError: no bag, no such topic, or no message.
    """
    with open_bag(Path(source)) as bag:
        chosen = _choose(bag, topic)
        names = dict.fromkeys(
            str(name)
            for message in bag.messages(chosen)
            for name in as_joint_state(message).content.name
        )
        if not names:
            raise SourceError(bag.files[0], "has no message with joints", field="joints")
    return tuple((joint_names or {}).get(name, name) for name in names)


def _choose(bag: Bag, topic: str | None) -> str:
    """Return the requested topic, or the only one with joint states."""
    fitting = measured_topics(bag.topics)
    if topic is None and len(fitting) == 1:
        (topic,) = fitting
    if topic is not None and topic in joint_state_topics(bag.topics):
        return topic
    problem = f"{len(fitting)} topics carry {JOINT_STATE}"
    if topic is not None:
        problem = f"{topic} is not a topic of {JOINT_STATE}"
    listing = ", ".join(f"{name} ({kind})" for name, kind in bag.topics.items()) or "none"
    remedy = (
        f"choose one of its topics: {listing}; `hil import log` reads other messages, with a "
        "column map"
    )
    if fitting:
        remedy = f"choose one of its topics: --topic {fitting[0]}; it has {listing}"
    raise SourceError(bag.files[0], problem, field="topic", remedy=remedy)


def joint_state_topics(topics: Mapping[str, Topic]) -> list[str]:
    """Return the topics that carry joint states, measured or commanded."""
    return [
        name for kind in (JOINT_STATE, CONTROLLER_STATE) for name in topics_of_kind(topics, kind)
    ]


@dataclass
class _Part:
    """Messages of some of the joints, by one publisher, in most bags the only one."""

    joints: tuple[str, ...]  #: of the robot, in its order
    numbers: list[int] = field(default_factory=list)  #: of the messages in the topic
    header: list[int] = field(default_factory=list)  #: [ns]
    received: list[int] = field(default_factory=list)  #: [ns]
    rows: dict[str, list[Array]] = field(default_factory=lambda: {name: [] for name in _QUANTITIES})


@dataclass
class _Joined:
    """Samples of some joints: stamps (m,) [ns] and quantities (m, joints) that were recorded."""

    stamp: NDArray[np.int64]
    values: dict[str, Array]


class _States:
    """Joint states of a topic, collected message by message.

    Attributes:
        clock: whose stamps are used, ``header`` or ``bag``.
        concluded: what was left out, sorted or merged.
    """

    def __init__(
        self,
        source: Path,
        joints: Sequence[str],
        renamed: Mapping[str, str],
        effort: Effort,
        clock: CommandStamps,
    ) -> None:
        self._source = source
        self._joints = tuple(joints)
        self._renamed = renamed
        self._effort = effort
        self._asked = clock
        self._parts: dict[tuple[str, ...], _Part] = {}
        self._orders: dict[tuple[str, ...], list[int]] = {}  # places of the joints in a message
        self._recorded: dict[str, None] = {}  # names as in the bag
        self.clock: Literal["header", "bag"] = "header"
        self.concluded: list[Conclusion] = []

    def add(self, message: BagMessage) -> None:
        """Add a message.

        Raises:
            SourceError: it has more or fewer values than names.
        """
        content = message.content
        names = tuple(content.name)
        if names not in self._orders:
            self._recorded.update(dict.fromkeys(names))
            joint_names = [self._renamed.get(name, name) for name in names]
            self._orders[names] = [
                joint_names.index(joint) for joint in self._joints if joint in joint_names
            ]
        order = self._orders[names]
        if not order:
            return  # such as a gripper on the same topic
        joints = tuple(self._renamed.get(names[place], names[place]) for place in order)
        part = self._parts.setdefault(joints, _Part(joints))
        part.numbers.append(message.number)
        part.header.append(content.header.stamp.sec * 10**9 + content.header.stamp.nanosec)
        part.received.append(message.received)
        for name, rows in part.rows.items():
            values = getattr(content, name)
            if len(values) == len(names):
                rows.append(np.asarray(values, np.float64)[order])
            elif len(values):
                problem = (
                    f"message {message.number} has {len(values)} values for {len(names)} joints"
                )
                raise SourceError(self._source, problem, field=name)

    def samples(self) -> ImportedSamples:
        """Return the samples of all joints in the robot's order.

        Raises:
            SourceError: a joint or a quantity was not recorded throughout, or messages contradict
                each other.
        """
        parts = self._chosen_parts()
        stamps = [stamp for part in parts for stamp in part.header]
        has_header = any(stamps) if self._asked == "auto" else self._asked == "header"
        self.clock = "header" if has_header else "bag"
        joined = self._merged(parts, [self._joined(part) for part in parts])
        effort = joined.values.get("effort")
        return ImportedSamples(
            stamp=joined.stamp,
            position=joined.values["position"],
            velocity=joined.values.get("velocity"),
            torque=effort if self._effort == "torque" else None,
            motor_current=effort if self._effort == "motor_current" else None,
        )

    def measured(self, samples: ImportedSamples) -> Measured:
        """Return the positions that must follow the commands, and the clock of their stamps."""
        late = [
            received - stamp
            for part in self._parts.values()
            for stamp, received in zip(part.header, part.received, strict=True)
            if stamp
        ]
        clock = CommandClock(self.clock == "header", int(np.median(late)) if late else 0)
        return Measured(self._joints, self._renamed, samples.stamp, samples.position, clock)

    def _chosen_parts(self) -> list[_Part]:
        """Return the parts that have each joint once: a whole one, or several."""
        parts = list(self._parts.values())
        recorded = ", ".join(self._recorded) or "none"
        if not parts:
            joints = ", ".join(self._joints)
            problem = f"none of the joints {joints} was recorded; recorded are {recorded}"
            remedy = "give the URDF of this robot, or map its joints: --rename RECORDED=URDF"
            raise SourceError(self._source, problem, field="joints", remedy=remedy)
        present = {joint for part in parts for joint in part.joints}
        missing = [joint for joint in self._joints if joint not in present]
        if missing:
            problem = f"joint {missing[0]} was not recorded; recorded are {recorded}"
            remedy = f"give a URDF with the recorded names, or {NOT_RECORDED}"
            raise UnrecordedJointError(
                self._source,
                problem,
                field="joints",
                remedy=remedy,
                count=len(present),
                joints=[self._renamed.get(name, name) for name in self._recorded],
            )
        whole = [part for part in parts if len(part.joints) == len(self._joints)]
        if whole:
            others = sum(len(part.numbers) for part in parts) - len(whole[0].numbers)
            if others:
                self.concluded.append(LeftOut(Omitted.SOME_JOINTS, others))
            return whole
        for joint in self._joints:
            holders = [part for part in parts if joint in part.joints]
            if len(holders) > 1:
                sets = " and ".join(f"({', '.join(part.joints)})" for part in holders)
                problem = f"joint {joint} comes in messages of two kinds, {sets}"
                remedy = "record again with one publisher of each joint on the topic"
                raise SourceError(self._source, problem, field="joints", remedy=remedy)
        return parts

    def _joined(self, part: _Part) -> _Joined:
        """Return the samples of a part, sorted by stamp."""
        stamp = np.array(part.header if self.clock == "header" else part.received, np.int64)
        received = np.array(part.received, np.int64)
        numbers = np.array(part.numbers)
        values = self._quantities(part)
        keep = np.ones(len(stamp), np.bool_)
        zeros = leading_zeros(stamp)
        if zeros:
            keep[:zeros] = False
            self.concluded.append(LeftOut(Omitted.NO_STAMPS, zeros))
        silent = second_publisher(values["position"], "message")
        if silent.publisher is not None:
            keep &= ~silent.rows
            self.concluded.append(silent.publisher)
        order = np.flatnonzero(keep)
        swapped = sorted_neighbours(stamp[order], "message")
        if swapped.swapped is not None:
            self.concluded.append(swapped.swapped)
        order = order[swapped.order]
        values = {name: array[order] for name, array in values.items()}
        self._check_repeats(stamp[order], received[order], numbers[order], values["position"])
        return _Joined(stamp[order], values)

    def _quantities(self, part: _Part) -> dict[str, Array]:
        """Return the quantities of a part that were recorded, (m, joints)."""
        count = len(part.numbers)
        values: dict[str, Array] = {}
        for name, rows in part.rows.items():
            if not rows or (name == "effort" and self._effort == "ignore"):
                continue
            array = np.array(rows)
            absent = np.isnan(array).all(axis=0)
            # NaN is what ros2_control publishes for an interface that the hardware does not have.
            if absent.all():
                continue
            if len(array) != count:
                problem = f"only {len(array)} of {count} messages have it"
                raise SourceError(self._source, problem, field=name, remedy="record it throughout")
            if absent.any():
                joints = tuple(np.array(part.joints)[absent].tolist())
                if name == "effort":
                    listing = ", ".join(joints)
                    problem = f"joint {listing} has no value in any message, the others have one"
                    remedy = "record it; --effort ignore imports the motion alone"
                    raise SourceError(self._source, problem, field=name, remedy=remedy)
                if name == "velocity":
                    self.concluded.append(PartialVelocity(joints))
                    continue
            values[name] = array
        if "position" not in values:
            raise SourceError(self._source, "the messages have no positions", field="position")
        return values

    def _check_repeats(
        self,
        stamp: NDArray[np.int64],
        received: NDArray[np.int64],
        numbers: NDArray[np.int64],
        position: Array,
    ) -> None:
        """Raise SourceError where messages of one stamp are at other positions.

        Equal stamps one after another are a clock that stands still, else two publishers.
        """
        if self.clock == "bag" or not len(stamp):
            return
        starts = np.flatnonzero(np.diff(stamp, prepend=stamp[0] - 1))
        highest = np.maximum.reduceat(position, starts)
        lowest = np.minimum.reduceat(position, starts)
        apart = (highest - lowest).max(axis=1)
        worst = np.flatnonzero(apart > MIN_SAMPLE_DISTANCE)
        if not worst.size:
            return
        first = int(starts[worst[0]])
        run = np.flatnonzero(stamp == stamp[first])
        steps = np.abs(np.diff(position[run], axis=0)).max()
        if len(run) >= MAX_MESSAGES_PER_STAMP and steps < 0.5 * apart[worst[0]]:
            elapsed = 1e-9 * float(received[run[-1]] - received[run[0]])
            problem = (
                f"{len(run)} messages from message {numbers[first]} have the same stamp, and were "
                f"received in {elapsed:.3g} s: the clock of the stamps stood still"
            )
            raise SourceError(self._source, problem, field="time", remedy=_BAG_CLOCK)
        problem = (
            f"messages {numbers[first]} and {numbers[first + 1]} have the same stamp and positions "
            f"{apart[worst[0]]:.3g} rad or m apart ({worst.size} such stamps): two publishers of "
            "these joints"
        )
        remedy = "record again with one publisher of these joints on the topic"
        raise SourceError(self._source, problem, field="position", remedy=remedy)

    def _merged(self, parts: Sequence[_Part], joined: Sequence[_Joined]) -> _Joined:
        """Return the samples of several parts side by side, in the robot's order of joints."""
        first = joined[0]
        if len(joined) == 1:
            return first
        columns = [joint for part in parts for joint in part.joints]
        order = [columns.index(joint) for joint in self._joints]
        missing = [
            (name, part.joints)
            for part, samples in zip(parts, joined, strict=True)
            for name in {name for other in joined for name in other.values} - set(samples.values)
        ]
        if missing:
            name, without = missing[0]
            listing = ", ".join(without)
            problem = f"{name} was recorded for the other joints, but not for {listing}"
            remedy = f"record it; {_AT_REST}; --effort ignore imports the motion alone"
            raise SourceError(self._source, problem, field=name, remedy=remedy)
        stamp = first.stamp
        for samples in joined[1:]:
            stamp = stamp[(stamp >= samples.stamp[0]) & (stamp <= samples.stamp[-1])]
        exact = all(np.isin(stamp, samples.stamp).all() for samples in joined)
        kinds = " and ".join(f"({', '.join(part.joints)})" for part in parts)
        apart = "" if exact else self._too_far_apart(stamp, parts, joined)
        if len(stamp) < 2 or apart:
            problem = f"{kinds} are in separate messages, {apart or 'not at the same time'}"
            remedy = f"record them in one message; {_AT_REST}"
            raise SourceError(self._source, problem, field="joints", remedy=remedy)
        groups = tuple(tuple(part.joints) for part in parts)
        self.concluded.append(MergedMessages(groups, same_stamps=bool(exact)))
        values = {
            name: np.column_stack(
                [
                    at_stamps(
                        stamp,
                        part_samples.stamp,
                        part_samples.values[name],
                        across_gaps=True,
                    )
                    for part_samples in joined
                ]
            )
            for name in first.values
        }
        return _Joined(stamp, {name: array[:, order] for name, array in values.items()})

    @staticmethod
    def _too_far_apart(
        stamp: NDArray[np.int64], parts: Sequence[_Part], joined: Sequence[_Joined]
    ) -> str:
        """Return which part moves and has no samples within two periods of a stamp, or ""."""
        if len(stamp) < 2:
            return ""
        period = float(np.median(np.diff(stamp)))
        for part, samples in zip(parts, joined, strict=True):
            if np.ptp(samples.values["position"], axis=0).max() < _MIN_TRAVEL:
                continue
            after = np.clip(np.searchsorted(samples.stamp, stamp), 1, len(samples.stamp) - 1)
            gap = samples.stamp[after] - samples.stamp[after - 1]
            if (gap > _MAX_GAP_PERIODS * period).any():
                return (
                    f"for ({', '.join(part.joints)}) up to {1e-6 * gap.max():.3g} ms apart, "
                    f"where {parts[0].joints[0]} comes every {1e-6 * period:.3g} ms"
                )
        return ""
