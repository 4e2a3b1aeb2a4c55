"""The archive profile: topics, schemas, and how cycle records become messages.

`docs/archive-format.md` describes the profile for readers of the files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.packet_records import LONGEST_PACKET
from hil.archive import definitions
from hil.archive.cdr import LayoutError, MessageLayout, Rows, fixed_layout
from hil.archive.messages import joint_state_layout

Array = NDArray[np.float64]

PROFILE = "ros2"
LIBRARY = "hil"  # without version: the same recording gives the same bytes

CYCLE = "/hil/cycle"
MEASURED = "/joint_states"
COMMANDED = "/joint_states_commanded"
MOTOR_CURRENT = "/motor_currents"
PACKETS = "/hil/packets"
EVENTS = "/hil/events"

PER_CYCLE = frozenset((CYCLE, MEASURED, COMMANDED))
"""Channels of which each cycle has one message, where there are cycles."""

LATER_FIELDS = frozenset(("age",))
"""Fields of a cycle that older archives do not have; zero is what they would have held."""

_STAMP = ("sec", "nanosec")
_STAMP_TYPES = {"sec": (np.dtype("<i4"),), "nanosec": (np.dtype("<u4"),)}


@dataclass(frozen=True)
class Channel:
    """One topic and the ros2msg schema of its messages."""

    topic: str
    schema: str
    definition: str


EVENT_CHANNEL = Channel(EVENTS, definitions.LOG, definitions.log())


class Batch(NamedTuple):
    """Messages of several channels taken at the same instants.

    Attributes:
        stamp: shape (k,), nanoseconds.
        messages: per channel its k messages.
    """

    stamp: NDArray[np.int64]
    messages: tuple[Rows, ...]


class CycleEncoder:
    """Turns cycle records into the three messages that an archive holds for each cycle.

    `/hil/cycle` holds everything; the two JointState channels repeat what viewers plot.

    Attributes:
        channels: the channels, in the order of the messages of a batch.
    """

    def __init__(self, joint_names: Sequence[str], period: float) -> None:
        n = len(joint_names)
        self._period_ns = period * 1e9
        self._cycle = fixed_layout(definitions.cycle(n))
        self._measured = joint_state_layout(joint_names, position=n, velocity=n, effort=n)
        self._commanded = joint_state_layout(joint_names, position=n, velocity=n, effort=0)
        self._copied = [
            name for name in self._cycle.dtype.names or () if name not in (*_STAMP, "torque")
        ]
        self.channels = (
            Channel(CYCLE, definitions.cycle_name(n), definitions.cycle(n)),
            Channel(MEASURED, definitions.JOINT_STATE, definitions.joint_state()),
            Channel(COMMANDED, definitions.JOINT_STATE, definitions.joint_state()),
        )

    def encode(self, records: Rows, torque: Array) -> Batch:
        """Encode k cycle records, and the joint torques (k, n) that belong to them."""
        stamp = np.rint(records["cycle"] * self._period_ns).astype(np.int64)
        cycle, measured, commanded = (
            _stamped(layout, stamp) for layout in (self._cycle, self._measured, self._commanded)
        )
        for name in self._copied:
            if name in (records.dtype.names or ()):  # records of old archives have no age
                cycle[name] = records[name]
        cycle["torque"] = torque
        measured["position"] = records["position"]
        measured["velocity"] = records["velocity"]
        measured["effort"] = torque
        commanded["position"] = records["commanded_position"]
        commanded["velocity"] = records["commanded_velocity"]
        return Batch(stamp, (cycle, measured, commanded))


class PacketEncoder:
    """Turns raw packets of the link into messages.

    Attributes:
        channel: theirs.
    """

    channel = Channel(PACKETS, definitions.PACKET, definitions.packet(LONGEST_PACKET))

    def __init__(self, period: float) -> None:
        self._period_ns = period * 1e9
        self._layout = fixed_layout(self.channel.definition)

    def encode(self, packets: Rows) -> Batch:
        """Encode k packets, rows of `drivers.packet_records.PACKET_DTYPE`."""
        stamp = np.rint(packets["cycle"] * self._period_ns).astype(np.int64)
        rows = _stamped(self._layout, stamp)
        for name in packets.dtype.names or ():
            rows[name] = packets[name]
        return Batch(stamp, (rows,))


class SampleEncoder:
    """Turns the samples of a foreign recording into JointState and motor current messages.

    Quantities that the recording does not have are left out of the messages, not invented.

    Attributes:
        channels: the channels, in the order of the messages of a batch.
    """

    def __init__(
        self, joint_names: Sequence[str], *, velocity: bool, torque: bool, motor_current: bool
    ) -> None:
        n = len(joint_names)
        self._state = joint_state_layout(
            joint_names, position=n, velocity=n * velocity, effort=n * torque
        )
        self._current = fixed_layout(definitions.motor_current(n)) if motor_current else None
        self.channels = [Channel(MEASURED, definitions.JOINT_STATE, definitions.joint_state())]
        if motor_current:
            name, text = definitions.motor_current_name(n), definitions.motor_current(n)
            self.channels.append(Channel(MOTOR_CURRENT, name, text))

    def encode(
        self,
        stamp: NDArray[np.int64],
        position: Array,
        velocity: Array | None,
        torque: Array | None,
        motor_current: Array | None,
    ) -> Batch:
        """Encode k samples; arrays (k, n), None for what was announced as absent."""
        state = _stamped(self._state, stamp)
        for name, values in (("position", position), ("velocity", velocity), ("effort", torque)):
            if values is not None:
                state[name] = values
        if self._current is None or motor_current is None:
            return Batch(stamp, (state,))
        current = _stamped(self._current, stamp)
        current["motor_current"] = motor_current
        return Batch(stamp, (state, current))


def profile_layout(topic: str, n_joints: int) -> MessageLayout | None:
    """How the messages of a topic of numbers are laid out; None where it is not the profile's."""
    definition = {
        CYCLE: definitions.cycle(n_joints),
        MOTOR_CURRENT: definitions.motor_current(n_joints),
        PACKETS: definitions.packet(LONGEST_PACKET),
    }.get(topic)
    return None if definition is None else fixed_layout(definition)


def check_fields(topic: str, layout: MessageLayout, n_joints: int) -> None:
    """Check that the numbers in messages are those of the profile, of so many joints.

    Raises:
        LayoutError: one is missing, or of another type or length.
    """
    found: Mapping[str, Any] = layout.dtype.fields or {}
    profile = profile_layout(topic, n_joints)
    expected: Mapping[str, Any] = _STAMP_TYPES
    if profile is not None:
        expected = profile.dtype.fields or {}
    for name, (kind, *_) in expected.items():
        if name not in found and name not in LATER_FIELDS:
            raise LayoutError(f"they have no {name}")
        if name in found and found[name][0] != kind:
            raise LayoutError(f"their {name} is not that of {n_joints} joints")


def _stamped(layout: MessageLayout, stamp: NDArray[np.int64]) -> Rows:
    rows = layout.rows(len(stamp))
    rows["sec"], rows["nanosec"] = np.divmod(stamp, 10**9)
    return rows
