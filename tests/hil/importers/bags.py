"""Bags of joint states, written message by message."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STATE = "sensor_msgs/msg/JointState"
STORE = get_typestore(Stores.ROS2_HUMBLE)
COUNT = 300
EPOCH = 1_700_000_000_000_000_000
STAMPS = EPOCH + 8_000_000 * np.arange(COUNT)
RANDOM = np.random.default_rng(11)
POSITION, VELOCITY, EFFORT = RANDOM.normal(size=(3, COUNT, 2))
DRIVES = """\
# State of each drive.
std_msgs/Header header
uint8 OK = 0
bool enabled
Drive[2] drives
float32[] temperature
string firmware
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: vendor_msgs/Drive
int8 mode
float64 angle  # deg, motor side
float64 current
"""


def state(
    stamp: int,
    position: Sequence[float],
    *,
    names: Sequence[str] = ("ankle", "hip"),
    velocity: Sequence[float] = (),
    effort: Sequence[float] = (),
) -> tuple[int, bytes]:
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    message = types[STATE](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=""),
        name=list(names),
        position=np.array(position, float),
        velocity=np.array(velocity, float),
        effort=np.array(effort, float),
    )
    return stamp + 77, bytes(STORE.serialize_cdr(message, STATE))


def bag(path: Path, topics: dict[str, tuple[str, list[tuple[int, bytes]]]]) -> Path:
    with closing(sqlite3.connect(path)) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,"
            " timestamp INTEGER NOT NULL, data BLOB NOT NULL)"
        )
        for number, (name, (kind, messages)) in enumerate(topics.items(), 1):
            database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", (number, name, kind))
            database.executemany(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
                [(number, time, data) for time, data in messages],
            )
        database.commit()
    return path


def states(count: int = 5, **changes: Any) -> list[tuple[int, bytes]]:
    start = 1_700_000_000 * 10**9 + 123
    return [
        state(start + 8_000_001 * i, [0.1 * i, -i], effort=[10.0 + i, 20.0 + i], **changes)
        for i in range(count)
    ]


Messages = list[tuple[int, bytes]]
DEFINITION, _ = STORE.generate_msgdef(STATE, ros_version=2)


def many() -> Messages:
    """Return joint states with all quantities, joints in another order than the robot's."""
    return [
        state(int(stamp), q, velocity=qd, effort=tau)
        for stamp, q, qd, tau in zip(
            STAMPS, POSITION[:, ::-1], VELOCITY[:, ::-1], EFFORT[:, ::-1], strict=True
        )
    ]


def mcap(
    path: Path,
    topics: dict[str, tuple[str, str, str, list[tuple[int, bytes]]]],
    **options: Any,
) -> Path:
    """An MCAP file; topics as type, definition, encoding and messages."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2")
        for topic, (kind, definition, encoding, messages) in topics.items():
            schema = writer.register_schema(kind, "ros2msg", definition.encode())
            channel = writer.register_channel(topic, encoding, schema)
            for number, (time, data) in enumerate(messages):
                writer.add_message(channel, time, data, time, number)
        writer.finish()
    return path


def drives(path: Path, *, firmware: str = "2.1", with_states: bool = False) -> Path:
    """Write messages of a vendor's own type, serialised by rosbags."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(DRIVES, "vendor_msgs/msg/Drives"))
    types = store.types
    angle = np.rad2deg(POSITION) * [100.0, -50.0]
    messages = []
    for row, stamp in enumerate(STAMPS.tolist()):
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        message = types["vendor_msgs/msg/Drives"](
            header=types["std_msgs/msg/Header"](stamp=time, frame_id=""),
            enabled=True,
            drives=[
                types["vendor_msgs/msg/Drive"](mode=4, angle=angle[row, i], current=EFFORT[row, i])
                for i in range(2)
            ],
            temperature=np.array([40.0, 41.0 + row, 42.0], np.float32),
            firmware=firmware if row == COUNT - 1 else "2.1",
        )
        messages.append((stamp, bytes(store.serialize_cdr(message, "vendor_msgs/msg/Drives"))))
    topics = {"/drives": ("vendor_msgs/msg/Drives", DRIVES, "cdr", messages)}
    if with_states:
        topics["/joint_states"] = (STATE, DEFINITION, "cdr", many())
        topics["/json"] = ("anything", "", "json", [(1, b"{}")])
    return mcap(path, topics, chunk_size=10_000)


URDF = """<robot name="two"><link name="base"/>
<link name="upper"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="lower"><inertial><mass value="1"/><origin xyz="0 0 0.2"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<joint name="ankle" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
<origin xyz="0 0 0.4"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>"""
