"""Commanded positions in a bag: states of controllers, joint states, trajectories, arrays.

Of several topics with commands that kind is used which says most: the state of a trajectory
controller, joint states that are named as commands, trajectories, arrays without names. What does
not follow the measured positions is a command of something else, and is left out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.importers.bags import Bag, BagMessage
from hil.importers.conclusions import Conclusion, DifferentCommands, KnownCommands, NotCommands
from hil.importers.mcap_messages import Topic
from hil.importers.messages import sentence
from hil.importers.resampling import at_stamps
from hil.importers.ros_messages import CONTROLLER_STATE, JOINT_STATE
from identification.arrays import root_mean_square

Stamps = NDArray[np.int64]

NO_COMMAND: Final = "none"
"""Name of a topic for no commands at all."""
COMMANDED: Final = re.compile(r"target|cmd|command|desired|_des\b|setpoint|ref(erence)?\b", re.I)
"""In the name of a channel of commands."""
_DEGREES_OF_FREEDOM: Final = "control_msgs/msg/MultiDOFStateStamped"
_TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
_ARRAY: Final = "std_msgs/msg/Float64MultiArray"
# rad or m between the commands of two topics that are the same
_MAX_COMMAND_DIFFERENCE: Final = 1e-3


class CommandStamps(NamedTuple):
    """Stamps of messages on the clock of the measured positions."""

    by_header: bool
    latency: int  #: between stamp and receipt of the joint states, median [ns]

    def stamp(self, message: BagMessage) -> int:
        """Return the stamp of a message [ns], of one without a stamp by its time of receipt."""
        header = getattr(message.content, "header", None)
        if not self.by_header:
            return message.received
        stamp = 0 if header is None else _nanoseconds(header.stamp)
        return stamp or message.received - self.latency


@dataclass(frozen=True, eq=False)
class Measured:
    """Measured positions that must follow the commands."""

    joints: tuple[str, ...]  #: of the robot
    renamed: Mapping[str, str]  #: names in the URDF by name in the bag
    stamp: Stamps  #: (m,) [ns]
    position: Array  #: (m, n) [rad or m]
    clock: CommandStamps

    def places(self, names: Sequence[str]) -> list[int] | None:
        """Return where the joints are in the names of a message; None if one is missing."""
        described = [self.renamed.get(name, name) for name in names]
        if not set(self.joints) <= set(described):
            return None
        return [described.index(joint) for joint in self.joints]


class Commands(NamedTuple):
    """Commanded positions at the stamps of the measured ones."""

    values: Array | None  #: (m, n) [rad or m], NaN where nothing was commanded
    topic: str = ""
    reading: str = ""  #: what the messages are
    concluded: tuple[Conclusion, ...] = ()  #: what was left out, and why


class _NotCommandsError(Exception):
    """Why the messages of a topic are no commanded positions of the joints."""


def measured_topics(topics: Mapping[str, Topic]) -> list[str]:
    """Return the topics that carry measured joint states; of controllers where there are none."""
    states = topics_of_kind(topics, JOINT_STATE)
    measured = [name for name in states if not COMMANDED.search(name)]
    return measured or states or topics_of_kind(topics, CONTROLLER_STATE)


def as_joint_state(message: BagMessage) -> BagMessage:
    """Return a message of joint states; a controller's message as its measured state."""
    content = message.content
    if not hasattr(content, "joint_names"):
        return message
    state = _point(content, ("feedback", "actual"))
    return BagMessage(
        message.received,
        SimpleNamespace(
            header=content.header,
            name=content.joint_names,
            position=state.positions,
            velocity=state.velocities,
            effort=state.effort,
        ),
        message.number,
    )


def commanded_positions(
    bag: Bag, states: str, measured: Measured, chosen: str | None = None
) -> Commands:
    """Return the commanded positions of the joints.

    Args:
        bag: that they are read from.
        states: topic of the measured positions.
        measured: positions, with which commands are compared.
        chosen: topic of the commands, `NO_COMMAND` for none; None to find it.

    Raises:
        SourceError: there is no such topic, or it has no commanded positions.
    """
    if chosen == NO_COMMAND:
        return Commands(None)
    concluded: list[NotCommands] = []
    groups = _candidates(bag.topics, states)
    if chosen is not None:
        groups = [[chosen]]
    for group in groups:
        commands = []
        for topic in group:
            try:
                commands.append(_commands_of(bag, topic, measured))
            except _NotCommandsError as error:
                concluded.append(NotCommands(topic, str(error)))
        if not commands and chosen is not None:
            others = ", ".join(name for names in _candidates(bag.topics, states) for name in names)
            remedy = f"choose another one ({others}), or none: --command-topic {NO_COMMAND}"
            problem = sentence(concluded[-1])
            raise SourceError(bag.files[0], problem, field="--command-topic", remedy=remedy)
        if commands:
            return _only(commands, concluded)
    return Commands(None, concluded=tuple(concluded))


def _candidates(topics: Mapping[str, Topic], states: str) -> list[list[str]]:
    """Return topics that may carry commands, the most telling kinds first."""
    controllers = topics_of_kind(topics, CONTROLLER_STATE) + topics_of_kind(
        topics, _DEGREES_OF_FREEDOM
    )
    named = [
        [name for name in topics_of_kind(topics, kind) if name != states and COMMANDED.search(name)]
        for kind in (JOINT_STATE, _ARRAY)
    ]
    return [controllers, named[0], topics_of_kind(topics, _TRAJECTORY), named[1]]


def topics_of_kind(topics: Mapping[str, Topic], kind: str) -> list[str]:
    """Return the topics whose messages have a type of ROS 2, or the same type of ROS 1."""
    kinds = (kind, kind.replace("/msg/", "/"))
    return [name for name, topic in topics.items() if topic.is_ros and topic.kind in kinds]


def _only(commands: Sequence[Commands], concluded: Sequence[Conclusion]) -> Commands:
    """Return the commands of the topic that has most, if the others say the same."""
    most = max(commands, key=lambda command: np.isfinite(_array(command)).sum())
    for other in commands:
        apart = np.abs(_array(other) - _array(most))
        if np.nanmax(apart, initial=0.0) > _MAX_COMMAND_DIFFERENCE:
            different = DifferentCommands((most.topic, other.topic))
            return Commands(None, concluded=(*concluded, different))
    return most._replace(concluded=(*concluded, *most.concluded))


def _array(command: Commands) -> Array:
    assert command.values is not None
    return command.values


def _commands_of(bag: Bag, topic: str, measured: Measured) -> Commands:
    """Return the commands of a topic; _NotCommandsError."""
    kind = bag.topics[topic].kind if topic in bag.topics else ""
    read = _READERS.get(kind.rpartition("/")[2])
    if read is None:
        raise _NotCommandsError(
            f"its messages are {kind}" if kind else "there is no such topic in the bag"
        )
    try:
        values, reading = read(bag.messages(topic), measured)
    except SourceError as error:
        raise _NotCommandsError(f"its messages cannot be read ({error.problem})") from error
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise _NotCommandsError("its messages differ in fields or lengths") from error
    known = np.asarray(np.isfinite(values).all(axis=1))
    if np.count_nonzero(known) < 2:
        raise _NotCommandsError("it has no command at the time of the measured positions")
    values = np.where(known[:, None], values, np.nan)
    position = measured.position[known]
    wrong = root_mean_square(values[known] - position)
    deviation = position.std(axis=0)
    if (wrong > np.maximum(deviation, _MAX_COMMAND_DIFFERENCE)).any():
        joint = int(np.argmax(wrong / np.maximum(deviation, _MAX_COMMAND_DIFFERENCE)))
        raise _NotCommandsError(
            f"it does not follow the positions of {measured.joints[joint]}: they differ by"
            f" {wrong[joint]:.3g} (rms, rad or m) and move by {deviation[joint]:.3g}"
        )
    if known.all():
        return Commands(values, topic, reading)
    partly = KnownCommands(int(np.count_nonzero(known)), len(known))
    return Commands(values, topic, reading, (partly,))


def _of_states(messages: Iterable[BagMessage], measured: Measured) -> tuple[Array, str]:
    """Return the references of controllers, or commands that are joint states."""
    stamps = []
    rows = []
    reading = "joint states that are named as commands"
    for message in messages:
        content = message.content
        if hasattr(content, "joint_names"):
            reading = "the reference in the state of a controller"
            names = content.joint_names
            positions = _point(content, ("reference", "desired")).positions
        elif hasattr(content, "dof_states"):
            reading = "the reference in the state of a controller"
            names = [state.name for state in content.dof_states]
            positions = np.array([state.reference for state in content.dof_states])
        else:
            names = content.name
            positions = content.position
        places = measured.places(names)
        if places is None or len(positions) != len(names):
            continue  # of other joints, or of velocities only
        stamps.append(measured.clock.stamp(message))
        rows.append(np.asarray(positions, np.float64)[places])
    if not rows:
        raise _NotCommandsError("it has no positions of these joints")
    return at_stamps(measured.stamp, np.array(stamps, np.int64), np.array(rows)), reading


def _of_arrays(messages: Iterable[BagMessage], measured: Measured) -> tuple[Array, str]:
    """Return arrays without names in which each column follows another joint."""
    stamps = []
    rows = []
    for message in messages:
        stamps.append(measured.clock.stamp(message))
        rows.append(np.asarray(message.content.data, np.float64))
    count = len(measured.joints)
    if not rows or any(row.shape != (count,) for row in rows):
        raise _NotCommandsError(f"it has no {count} numbers in each message, one for each joint")
    values = at_stamps(measured.stamp, np.array(stamps, np.int64), np.array(rows))
    known = np.asarray(np.isfinite(values).all(axis=1))
    if not known.any():
        return values, ""
    apart = values[known][:, :, None] - measured.position[known][:, None, :]
    nearest = np.argmin(np.mean(apart**2, axis=0), axis=1)
    if len(set(nearest.tolist())) < count:
        raise _NotCommandsError("it is not clear which number belongs to which joint")
    return values[:, np.argsort(nearest)], "an array, each number of the joint that follows it"


def _of_trajectories(messages: Iterable[BagMessage], measured: Measured) -> tuple[Array, str]:
    """Return trajectories, interpolated as by the trajectory controller of ros2_control.

    Each begins with the command of its predecessor (the first with the measured position) at its
    receipt, is held at its end, and ends with its successor.
    """
    latency = measured.clock.latency if measured.clock.by_header else 0
    parts = []
    for message in messages:
        content = message.content
        places = measured.places(content.joint_names)
        if places is not None and content.points:
            stamp = _nanoseconds(content.header.stamp)
            received = message.received - latency
            begin = stamp if stamp and measured.clock.by_header else received
            parts.append((received, begin, content.points, places))
    if not parts:
        raise _NotCommandsError("it has no trajectory of these joints")
    parts.sort(key=lambda part: part[0])
    origin = measured.stamp[0]
    time = 1e-9 * (measured.stamp - origin)
    values = np.full(measured.position.shape, np.nan)
    before: Callable[[float], tuple[Array, Array]] = partial(_at_rest, time, measured.position)
    for k, (received, begin, points, places) in enumerate(parts):
        start = 1e-9 * (received - origin)
        path = _path(points, places, start, 1e-9 * (begin - origin), before(start))
        end = 1e-9 * (parts[k + 1][0] - origin) if k + 1 < len(parts) else np.inf
        rows = slice(*np.searchsorted(time, [start, end]))
        values[rows] = path(time[rows])
        before = _state_of(path)
    return values, "trajectories, interpolated as by the trajectory controller of ros2_control"


def _path(
    points: Sequence[Any],
    places: Sequence[int],
    start: float,
    begin: float,
    state: tuple[Array, Array],
) -> Callable[[Array], Array]:
    """Return the positions of a trajectory at times (k,) from `start` on, held at its end.

    Between points that have positions only it is linear, with velocities cubic, with accelerations
    quintic.
    """
    times = [start]
    knots = [np.array(state)]
    for point in points:
        at = begin + 1e-9 * _nanoseconds(point.time_from_start)
        if not len(point.positions):
            raise _NotCommandsError("its points have no positions")
        derivatives = [np.asarray(point.positions, np.float64)[list(places)]]
        for further in (point.velocities, point.accelerations):
            if len(further) != len(point.positions):
                break
            derivatives.append(np.asarray(further, np.float64)[list(places)])
        if at <= times[-1]:
            times.pop()
            knots.pop()
            at = max(at, times[-1]) if times else max(at, start)
        times.append(at)
        knots.append(np.array(derivatives))
    final = knots[-1][0]
    if len(times) == 1:
        return lambda at: np.broadcast_to(final, (len(at), len(final)))
    degrees = [2 * min(len(left), len(right)) - 1 for left, right in pairwise(knots)]
    path = scipy.interpolate.BPoly.from_derivatives(times, knots, degrees)
    return lambda at: np.where((at < times[-1])[:, None], path(np.minimum(at, times[-1])), final)


def _state_of(path: Callable[[Array], Array]) -> Callable[[float], tuple[Array, Array]]:
    """Return position and velocity of a path at a time."""
    step = 1e-4  # s

    def state(at: float) -> tuple[Array, Array]:
        early, late = path(np.array([at - step, at]))
        return late, (late - early) / step

    return state


def _at_rest(time: Array, values: Array, at: float) -> tuple[Array, Array]:
    """Return values at a time, at rest."""
    position = np.array([np.interp(at, time, column) for column in values.T])
    return position, np.zeros(len(position))


def _point(content: Any, names: Sequence[str]) -> Any:
    """Return the first of some points in a message that has positions, or one without any."""
    points = [getattr(content, name) for name in names if hasattr(content, name)]
    nothing = SimpleNamespace(positions=[], velocities=[], effort=[])
    return next((point for point in points if len(point.positions)), nothing)


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * 10**9 + int(time.nanosec)


_READERS: Final[Mapping[str, Callable[[Iterable[BagMessage], Measured], tuple[Array, str]]]] = {
    "JointTrajectoryControllerState": _of_states,
    "MultiDOFStateStamped": _of_states,
    "JointState": _of_states,
    "JointTrajectory": _of_trajectories,
    "Float64MultiArray": _of_arrays,
}
