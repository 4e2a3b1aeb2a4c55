"""The ROS messages of an archive that are not plain structures: JointState and Log.

A JointState holds names and sequences, but they stay the same over a recording, so it has a
constant layout all the same; the layout of a foreign one is read from its first message. Log
messages differ in length and are encoded one by one.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hil.archive.cdr import (
    ENCAPSULATION,
    LARGEST_MESSAGE,
    LayoutBuilder,
    LayoutError,
    MessageLayout,
)


def joint_state_layout(
    names: Sequence[str], *, position: int, velocity: int, effort: int, frame: str = ""
) -> MessageLayout:
    """Lay out a sensor_msgs/JointState with these names and lengths of its arrays."""
    builder = LayoutBuilder()
    builder.header(frame)
    builder.count(len(names))
    for name in names:
        builder.string(name)
    builder.sequence("position", "float64", position)
    builder.sequence("velocity", "float64", velocity)
    builder.sequence("effort", "float64", effort)
    return builder.build()


class _Cursor:
    """Reads one CDR message, field after field."""

    def __init__(self, message: bytes) -> None:
        if message[:4] != ENCAPSULATION:
            raise LayoutError("the message is not plain little-endian CDR")
        self._data = message
        self._at = 4

    def number(self, code: str, size: int) -> int:
        self._at += -(self._at - 4) % size
        value: int
        try:
            (value,) = struct.unpack_from("<" + code, self._data, self._at)
        except struct.error as error:
            raise LayoutError("the message ends before its last field") from error
        self._at += size
        return value

    def string(self) -> str:
        length = self.number("I", 4)
        if not 0 < length <= len(self._data) - self._at:
            raise LayoutError(f"a string of {length} bytes does not fit into the message")
        data = self._data[self._at : self._at + length - 1]
        self._at += length
        try:
            return data.decode()
        except UnicodeDecodeError as error:
            raise LayoutError("a string is not UTF-8") from error

    def skip_sequence(self) -> int:
        count = self.number("I", 4)
        if count:
            self._at += -(self._at - 4) % 8 + 8 * count
        if self._at > len(self._data):
            raise LayoutError(f"a sequence of {count} numbers does not fit into the message")
        return count


def joint_state_of(message: bytes) -> tuple[tuple[str, ...], MessageLayout]:
    """The joint names in a JointState message, and the layout it and its like have.

    Raises:
        LayoutError: the bytes are not such a message.
    """
    if len(message) > LARGEST_MESSAGE:
        raise LayoutError(f"the message has {len(message)} bytes")
    cursor = _Cursor(message)
    cursor.number("i", 4)
    cursor.number("I", 4)
    frame = cursor.string()
    names = tuple(cursor.string() for _ in range(cursor.number("I", 4)))
    position, velocity, effort = (cursor.skip_sequence() for _ in range(3))
    layout = joint_state_layout(
        names, position=position, velocity=velocity, effort=effort, frame=frame
    )
    if layout.size != len(message):
        raise LayoutError(f"the message has {len(message)} bytes, its fields {layout.size}")
    return names, layout


def check_joints(names: Sequence[str], layout: MessageLayout, joints: Sequence[str]) -> None:
    """Check that messages are of all these joints, and have each quantity of all or of none.

    Raises:
        LayoutError: they are not.
    """
    if tuple(names) != tuple(joints):
        raise LayoutError("they are of other joints than joint_names says")
    lengths: Mapping[str, Any] = layout.dtype.fields or {}
    for name in ("position", "velocity", "effort"):
        if name in lengths and lengths[name][0].shape != (len(joints),):
            raise LayoutError(f"their {name} is not that of {len(joints)} joints")


@dataclass(frozen=True)
class LogMessage:
    """A decoded rcl_interfaces/Log: time in nanoseconds, severity, kind and text."""

    stamp: int
    level: int
    name: str
    text: str


def encode_log(message: LogMessage) -> bytes:
    """The CDR bytes of a log message; file, function and line stay empty."""
    data = bytearray(ENCAPSULATION)
    data += struct.pack("<iIB", *divmod(message.stamp, 10**9), message.level)
    for text in (message.name, message.text, "", ""):
        data += bytes(-(len(data) - 4) % 4)
        encoded = text.encode() + b"\0"
        data += struct.pack("<I", len(encoded)) + encoded
    data += bytes(-(len(data) - 4) % 4) + struct.pack("<I", 0)
    return bytes(data)


def decode_log(message: bytes) -> LogMessage:
    """Read a log message.

    Raises:
        LayoutError: the bytes are not such a message.
    """
    cursor = _Cursor(message)
    seconds = cursor.number("i", 4)
    nanoseconds = cursor.number("I", 4)
    level = cursor.number("B", 1)
    return LogMessage(
        seconds * 10**9 + nanoseconds, level, name=cursor.string(), text=cursor.string()
    )
