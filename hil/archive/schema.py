"""The archive profile: topics, schemas, and the conversion of cycle records and events to messages.

`docs/archive-format.md` describes the profile.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from itertools import product
from typing import Any, Final, NamedTuple, Self

import numpy as np
from mcap.records import Schema
from numpy.typing import NDArray

from hil.archive.cdr import (
    ENCAPSULATION,
    LayoutBuilder,
    LayoutError,
    MessageLayout,
    Rows,
    fixed_layout,
    joint_state_layout,
)
from hil.base.arrays import Array
from hil.base.safe_input import parse_json

PROFILE = "ros2"
LIBRARY = "hil"  # without version: the same recording gives the same bytes

CYCLE = "/hil/cycle"
MEASURED = "/joint_states"
COMMANDED = "/joint_states_commanded"
COMMANDED_POSITION = "/hil/commanded_position"
MOTOR_CURRENT = "/motor_currents"
EVENTS = "/hil/events"
DESCRIPTION = "/robot_description"
UR_STATE = "/hil/ur_state"

_STAMP_TYPES = {"sec": (np.dtype("<i4"),), "nanosec": (np.dtype("<u4"),)}


_SEPARATOR = "=" * 80
_TIME = """\
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_HEADER = """\
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""

_JOINT_STATE = """\
# Position [rad], velocity [rad/s] and effort [N.m] of the joints in `name`.
# An array is as long as `name`, or empty when the quantity is not known.
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
"""

_CYCLE = """\
# One cycle of the controller link as the PC saw it. Joints in the order of the archive's
# joint_names. Angles follow the robot description (URDF); SI units.
# header.stamp is the time since the controller's initialisation: cycle * period.
std_msgs/Header header
int64 cycle                     # cycles of the controller since its initialisation
float64 arrival                 # s, clock of the PC, for diagnosis only
float64[{n}] target_position      # rad, set-point inside the controller
float64[{n}] target_velocity      # rad/s, set-point inside the controller
float64[{n}] position             # rad, measured
float64[{n}] velocity             # rad/s, measured
float64[{n}] torque               # N.m, joint side, from target_current; NaN when unknown
float64[{n}] target_current       # A, motor side, demanded by the controller's speed loop
float64[{n}] model_current        # A, motor side, of the controller's dynamic model (extra 1)
float64[{n}] diagonal_inertia     # kg.m2, as the controller sends it (extra 2)
float64[{n}] extra3               # as the controller sends it (extra 3)
float64[{n}] commanded_position   # rad, this packet's answer; NaN where no set-point was sent
float64[{n}] commanded_velocity   # rad/s, this packet's answer; NaN where no set-point was sent
int32[{n}] mode                   # mode of each axis, as on the wire
int32 number                    # sequence number of the packet, as on the wire
int32 gap                       # packets lost just before this one
int32 interval                  # index of the interval of open mode
uint8 state                     # state of the session
uint8 status                    # status byte of the arm, as on the wire
"""

_MOTOR_CURRENT = """\
# Measured motor currents of a foreign recording, motor side.
std_msgs/Header header
float64[{n}] motor_current        # A
"""

_COMMANDED_POSITION = """\
# Commanded positions of a foreign recording.
std_msgs/Header header
float64[{n}] commanded_position   # rad
"""

_UR_STATE = """\
# State of a Universal Robots controller in the cycle with the same stamp. Joints as in
# /hil/cycle; NaN, and -1 of integers, where this version of the controller does not send it.
std_msgs/Header header
float64 controller_time              # s, since the start of the controller
float64[{n}] target_acceleration       # rad/s2, of its set-points
float64[{n}] target_moment             # N.m, of its rigid-body model with payload, no friction
float64[{n}] control_current           # A, of its current loops
float64[{n}] current_as_torque         # N.m, as it sends it; its meaning is not documented
float64[{n}] joint_temperature         # degrees Celsius
float64 speed_scaling                # fraction of the program's speed
float64 speed_fraction               # speed slider, 0 to 1
float64 position_deviation_ratio     # 1: protective stop
float64 collision_ratio              # 1: protective stop
float64 payload_mass                 # kg, as set at the controller
float64[3] payload_centre            # m, in the frame of its flange
float64[6] payload_inertia           # kg.m2, about the centre: xx, xy, xz, yy, yz, zz
int32 robot_mode                     # 7: running
int32 safety_mode                    # 1: normal
int32 runtime_state                  # 2: a program is playing
int32 robot_status                   # bits; 2: freedrive
int32 safety_status                  # bits
"""

_LOG = """\
byte DEBUG=10
byte INFO=20
byte WARN=30
byte ERROR=40
byte FATAL=50
builtin_interfaces/Time stamp   # time since the controller's initialisation
uint8 level
string name                     # kind of event
string msg                      # one line of text; a second line, if any, is one JSON object
string file
string function
uint32 line
"""


@dataclass(frozen=True)
class ArchiveChannel:
    """One topic and the ros2msg schema of its messages, with all its dependencies."""

    topic: str
    schema: str
    definition: str


_DESCRIPTION = """\
# The robot description (URDF) that is attached as well.
string data
"""


def _text(message: str, *dependencies: str) -> str:
    return "".join([message, *(f"{_SEPARATOR}\n{part}" for part in dependencies)])


EVENT_CHANNEL = ArchiveChannel(EVENTS, "rcl_interfaces/msg/Log", _text(_LOG, _TIME))
DESCRIPTION_CHANNEL = ArchiveChannel(DESCRIPTION, "std_msgs/msg/String", _DESCRIPTION)


@lru_cache(maxsize=16)
def profile(n_joints: int) -> Mapping[str, ArchiveChannel]:
    """Return the channels of the profile by topic, for a number of joints."""
    state = "sensor_msgs/msg/JointState", _text(_JOINT_STATE, _HEADER, _TIME)
    cycle, current, commanded, ur_state = (
        _text(text.format(n=n_joints), _HEADER, _TIME)
        for text in (_CYCLE, _MOTOR_CURRENT, _COMMANDED_POSITION, _UR_STATE)
    )
    channels = (
        ArchiveChannel(CYCLE, f"hil_msgs/msg/Cycle{n_joints}", cycle),
        ArchiveChannel(MEASURED, *state),
        ArchiveChannel(COMMANDED, *state),
        ArchiveChannel(MOTOR_CURRENT, f"hil_msgs/msg/MotorCurrent{n_joints}", current),
        ArchiveChannel(COMMANDED_POSITION, f"hil_msgs/msg/CommandedPosition{n_joints}", commanded),
        ArchiveChannel(UR_STATE, f"hil_msgs/msg/UrState{n_joints}", ur_state),
        EVENT_CHANNEL,
        DESCRIPTION_CHANNEL,
    )
    return {channel.topic: channel for channel in channels}


OTHERS: Final[Mapping[str, str]] = {
    "motor_current": MOTOR_CURRENT,
    "commanded_position": COMMANDED_POSITION,
}
"""Topics of an imported recording in addition to joint states."""
STATE_TOPICS: Final = (UR_STATE,)
"""Topics of what a controller sends in each cycle beyond `/hil/cycle`."""


class Batch(NamedTuple):
    """Messages of several channels, one of each at each stamp (k,) [ns]."""

    stamp: NDArray[np.int64]
    messages: Mapping[str, Rows]


def cycle_messages(
    names: Sequence[str],
    period: float,
    records: Rows,
    torque: Array,
    states: Mapping[str, Rows] | None = None,
) -> Batch:
    """Return the messages of k cycles: `/hil/cycle` and two JointState channels for viewers.

    Args:
        names: of the joints.
        period: of the controller [s].
        records: of the cycles (k,).
        torque: of the joints (k, n) [N·m].
        states: rows (k,) by topic (`STATE_TOPICS`), with the fields of its messages.
    """
    stamp = _stamp(records, period)
    columns = {name: records[name] for name in records.dtype.names or ()}
    measured = {"position": records["position"], "velocity": records["velocity"], "effort": torque}
    commanded = {name: set_points(records, name) for name in ("position", "velocity")}
    channels = profile(len(names))
    return Batch(
        stamp,
        {
            CYCLE: _numbers(channels[CYCLE], stamp, {**columns, "torque": torque}),
            MEASURED: joint_states(names, stamp, measured),
            COMMANDED: joint_states(names, stamp, commanded),
            **{
                topic: _numbers(
                    channels[topic], stamp, {f: rows[f] for f in rows.dtype.names or ()}
                )
                for topic, rows in (states or {}).items()
            },
        },
    )


def sample_messages(
    names: Sequence[str],
    stamp: NDArray[np.int64],
    states: Mapping[str, Array],
    others: Mapping[str, Array],
) -> Batch:
    """Return samples of an imported recording as messages.

    Args:
        names: of the joints.
        stamp: of the samples (k,) [ns].
        states: ``position``, ``velocity`` and ``effort`` (k, n), where known.
        others: ``motor_current`` [A] and ``commanded_position`` (k, n), where recorded.
    """
    messages = {MEASURED: joint_states(names, stamp, states)}
    for name, values in others.items():
        channel = profile(len(names))[OTHERS[name]]
        messages[channel.topic] = _numbers(channel, stamp, {name: values})
    return Batch(stamp, messages)


def joint_states(
    names: Sequence[str], stamp: NDArray[np.int64], values: Mapping[str, Array]
) -> Rows:
    """Return messages sensor_msgs/JointState at `stamp` (k,) [ns].

    `values` are the known ones of ``position``, ``velocity`` and ``effort``, (k, n).
    """
    position, velocity, effort = (
        len(names) * (word in values) for word in ("position", "velocity", "effort")
    )
    layout = joint_state_layout(tuple(names), position=position, velocity=velocity, effort=effort)
    return _filled(layout, stamp, values)


def set_points(records: Rows | Mapping[str, NDArray[Any]], name: str) -> Array:
    """Return commanded ``position`` or ``velocity`` (k, n), the controller's target where NaN."""
    sent = records[f"commanded_{name}"]
    return np.where(np.isnan(sent), records[f"target_{name}"], sent)


def _stamp(records: Rows, period: float) -> NDArray[np.int64]:
    return np.rint(records["cycle"] * (period * 1e9)).astype(np.int64)


def _numbers(
    channel: ArchiveChannel, stamp: NDArray[np.int64], columns: Mapping[str, NDArray[Any]]
) -> Rows:
    return _filled(fixed_layout(channel.definition), stamp, columns)


def _filled(
    layout: MessageLayout, stamp: NDArray[np.int64], columns: Mapping[str, NDArray[Any]]
) -> Rows:
    """Return messages with these stamps (k,) [ns], and the columns that are fields of them."""
    rows = layout.rows(len(stamp))
    rows["sec"], rows["nanosec"] = np.divmod(stamp, 10**9)
    for name in columns.keys() & set(rows.dtype.names or ()):
        rows[name] = columns[name]
    return rows


def message_layout(
    topic: str, joints: Sequence[str], record: Schema | None, first: bytes
) -> MessageLayout:
    """Return the layout of the messages of a topic of numbers.

    Args:
        topic: of the messages.
        joints: their names.
        record: schema in the file, None where it has none.
        first: one of the messages: joint states may lack quantities.

    Raises:
        LayoutError: the messages are of another layout.
    """
    n = len(joints)
    if topic in (MEASURED, COMMANDED):
        row = np.frombuffer(first, np.uint8)[None]
        for lengths in product((n, 0), repeat=3):
            sizes = dict(zip(("position", "velocity", "effort"), lengths, strict=True))
            state = joint_state_layout(tuple(joints), **sizes)
            if state.size == len(first) and state.matches(row):
                return state
        raise LayoutError(f"they are not joint states of these {n} joints")
    if record is None:
        raise LayoutError("their schema is missing")
    layout = fixed_layout(record.data.decode(errors="replace"))
    types: Mapping[str, Any] = layout.dtype.fields or {}
    expected: Mapping[str, Any] = _STAMP_TYPES
    if topic in (CYCLE, MOTOR_CURRENT, *STATE_TOPICS):
        expected = fixed_layout(profile(n)[topic].definition).dtype.fields or {}
    for name, (kind, *_) in expected.items():
        if name not in types:
            raise LayoutError(f"they have no {name}")
        if types[name][0] != kind:
            raise LayoutError(f"their {name} does not fit {n} joints")
    return layout


def description_message(urdf: bytes) -> bytes | None:
    """Return the message that shows a robot description; None where it is too long, or no text."""
    builder = LayoutBuilder()
    try:
        builder.string(urdf.decode())
    except (LayoutError, UnicodeDecodeError):
        return None
    return builder.build().template


_LOG_HEAD = struct.Struct("<iIB")  # seconds, nanoseconds, level


class Level(IntEnum):
    """Severity, with the numbers of rcl_interfaces/Log."""

    DEBUG = 10
    INFO = 20
    WARN = 30
    ERROR = 40
    FATAL = 50


@dataclass(frozen=True)
class ArchivedEvent:
    """An event of the recorded interval.

    `time` [s] since the controller's initialisation, kind of event such as ``MotionEnded``, one
    line of text, and machine-readable data: numbers, strings, lists and mappings.
    """

    time: float
    name: str
    text: str
    level: Level = Level.INFO
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def stamp(self) -> int:
        """The time in ns, zero if it is not finite or negative."""
        return max(0, round(self.time * 1e9)) if math.isfinite(self.time) else 0

    def encode(self, stamp: int | None = None) -> bytes:
        """Return the CDR bytes: the line of text and, if there are data, one of JSON.

        `stamp` [ns] replaces `self.stamp`.
        """
        lines = [" ".join(self.text.split())]
        if self.data:
            lines.append(json.dumps(_document(self.data), sort_keys=True, allow_nan=False))
        times = divmod(self.stamp if stamp is None else stamp, 10**9)
        message = bytearray(ENCAPSULATION + _LOG_HEAD.pack(*times, self.level))
        for text in (self.name, "\n".join(lines), "", ""):  # file and function stay empty
            encoded = text.encode() + b"\0"
            message += bytes(-len(message) % 4) + struct.pack("<I", len(encoded)) + encoded
        return bytes(message + bytes(-len(message) % 4 + 4))  # the line number stays 0

    @classmethod
    def decode(cls, message: bytes) -> Self:
        """Decode a log message, else `LayoutError`; a second line that is no JSON is text."""
        if message[: len(ENCAPSULATION)] != ENCAPSULATION:
            raise LayoutError("the message is not little-endian CDR")
        try:
            seconds, nanoseconds, level = _LOG_HEAD.unpack_from(message, len(ENCAPSULATION))
            end = len(ENCAPSULATION) + _LOG_HEAD.size
            texts = []
            for _ in ("name", "text"):
                start = end + -end % 4 + 4
                end = start + int(struct.unpack_from("<I", message, start - 4)[0])
                if end == start or end > len(message):
                    raise LayoutError("a string does not fit into the message")
                texts.append(message[start : end - 1].decode())
        except struct.error as error:
            raise LayoutError("the message ends before its last field") from error
        except UnicodeDecodeError as error:
            raise LayoutError("a string is not UTF-8") from error
        name, whole = texts
        text, _, second = whole.partition("\n")
        data: Any = None
        with suppress(ValueError):
            data = parse_json(second)
        if not isinstance(data, dict):
            text = whole
            data = {}
        severity = max((defined for defined in Level if defined <= level), default=Level.DEBUG)
        return cls((seconds * 10**9 + nanoseconds) * 1e-9, name, text, severity, data)


def _document(value: Any) -> Any:
    """Convert to JSON types; numbers that are not finite become null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _document(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_document(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, str | int) else str(value)
