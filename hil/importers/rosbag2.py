"""Import of joint states from a rosbag2 recording, or any MCAP file with ROS 2 messages."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cache
from itertools import chain
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import zstandard
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from hil.archive import Samples
from hil.archive.container import MOST_INFLATION
from hil.errors import SourceError
from hil.importers import mcap_messages
from hil.importers.mcap_messages import Topic
from hil.importers.robot import NOT_RECORDED, Robot, Use, write_imported
from hil.reading import open_file

SUFFIXES = (".db3", ".mcap")
_PACKED = (".zstd", ".zst")
_LONGEST_MESSAGE = 1 << 24  # bytes
_LONGEST_ROW = 1 << 28  # bytes
_SLACK = 1 << 20  # bytes
_TABLES = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'"
_ZSTD = b"\x28\xb5\x2f\xfd"  # begins no CDR message


def bag_files(source: Path) -> list[Path]:
    """Return the files of a bag in the order of writing.

    Raises:
        SourceError: there is none.
    """
    files = [source]
    try:
        if source.is_dir():
            files = sorted((p for p in source.iterdir() if _storage(p) in SUFFIXES), key=_sort_key)
        for file in files:
            open_file(file).close()  # raises for a pipe, which would block
    except OSError as error:
        problem = f"cannot be read: {error.strerror}"
        remedy = "name a .db3 or .mcap file, or a bag's folder"
        raise SourceError(error.filename, problem, remedy=remedy) from error
    if not files:
        problem, remedy = "has no .db3 and no .mcap file in it", "name the folder of a rosbag2"
        raise SourceError(source, problem, remedy=remedy)
    return files


def topics(file: Path) -> dict[str, Topic]:
    """Return the topics of one file by name.

    Raises:
        SourceError: it is not a bag.
    """
    if file.suffix == ".mcap":
        return mcap_messages.read(file, lambda *_: False)[0]
    with _connected(file) as bag:
        query = "SELECT name, type, serialization_format FROM topics ORDER BY name"
        return {str(name): Topic(str(kind), str(code)) for name, kind, code in bag.execute(query)}


def messages(file: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    """Yield time of receipt [ns] and data of the messages of one topic, in the order of time.

    Raises:
        SourceError: the file cannot be read.
    """
    found: Iterator[tuple[int, bytes]] = _of_sqlite(file, topic)
    if file.suffix == ".mcap":
        _, read = mcap_messages.read(file, lambda name, _: name == topic)
        found = ((stamp, data) for _, stamp, data in read)
    for stamp, data in found:
        yield stamp, _decompressed(data, file) if data.startswith(_ZSTD) else data


@contextmanager
def unpacked(files: list[Path]) -> Iterator[list[Path]]:
    """Yield the files, compressed ones as temporary decompressed copies."""
    with TemporaryDirectory() as folder:
        yield [
            _unpacked(file, Path(folder) / file.stem) if file.suffix in _PACKED else file
            for file in files
        ]


def _unpacked(file: Path, target: Path) -> Path:
    try:
        most = _SLACK + MOST_INFLATION * file.stat().st_size
        with file.open("rb") as packed, target.open("wb") as output:
            for block in zstandard.ZstdDecompressor().read_to_iter(packed):
                output.write(block)
                if output.tell() > most:
                    raise SourceError(file, f"becomes more than {MOST_INFLATION} times as large")
    except (OSError, zstandard.ZstdError) as error:
        raise SourceError(file, f"cannot be decompressed ({error})") from error
    return target


def _decompressed(data: bytes, file: Path) -> bytes:
    """Decompress a message that was compressed by itself."""
    try:
        size = zstandard.frame_content_size(data)
        if size > _LONGEST_MESSAGE:
            raise SourceError(file, f"has a message of {size} bytes")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=_LONGEST_MESSAGE)
    except zstandard.ZstdError as error:
        raise SourceError(file, f"has a message that cannot be decompressed ({error})") from error


def _storage(path: Path) -> str:
    """Return the suffix of the storage format."""
    return Path(path.stem).suffix if path.suffix in _PACKED else path.suffix


def _sort_key(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts ``x_10`` behind ``x_2``."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _of_sqlite(file: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    query = (
        "SELECT messages.timestamp, messages.data FROM messages"
        " JOIN topics ON topics.id = messages.topic_id WHERE topics.name = ?"
        " ORDER BY messages.timestamp, messages.id"
    )
    with _connected(file) as bag:
        for number, (stamp, data) in enumerate(bag.execute(query, (topic,))):
            if not isinstance(stamp, int) or not isinstance(data, bytes):
                problem = f"message {number} has no time or no data"
                remedy = "remove it, or record again"
                raise SourceError(file, problem, field=topic, remedy=remedy)
            yield stamp, data


@contextmanager
def _connected(file: Path) -> Iterator[sqlite3.Connection]:
    """Open the bag read-only, without side files unless another process is writing it."""
    options = "mode=ro" if file.with_name(file.name + "-wal").exists() else "mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?{options}", uri=True)) as bag:
            bag.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_ROW)
            # A view could produce rows without end.
            tables = {name for (name,) in bag.execute(_TABLES)}
            absent = sorted({"topics", "messages"} - tables)
            if absent:
                raise sqlite3.DatabaseError(f"it has no table {absent[0]}")
            yield bag
    except (sqlite3.Error, UnicodeDecodeError) as error:
        problem = f"is not a rosbag2 in sqlite3 storage, or damaged ({error})"
        remedy = "name the .db3 or .mcap file, or the bag's folder"
        raise SourceError(file, problem, remedy=remedy) from error


Array = NDArray[np.float64]
Effort = Literal["torque", "motor_current", "ignore"]

_JOINT_STATE = "sensor_msgs/msg/JointState"
_JOINT_STATES = (_JOINT_STATE, "sensor_msgs/JointState")


def import_rosbag2(
    source: str | PathLike[str],
    output: str | PathLike[str],
    *,
    robot: Robot,
    topic: str | None = None,
    effort: Effort = "torque",
    joint_names: Mapping[str, str] | None = None,
    held_joints: Sequence[str] = (),
    use: Use = "excitation",
    force: bool = False,
    outside_limits: bool = False,
) -> Path:
    """Convert the joint states of a bag to an archive of kind ``imported``, and return its path.

    The source is a ``.db3`` or ``.mcap`` file, or the folder of a bag; compressed ones as well.
    Joints are found by name; `joint_names` are names in the URDF by name in the bag, where they
    differ. Messages with none of them (a gripper on the same topic) are ignored. Stamps are those
    in the messages' headers; where all are empty, the bag's. The effort is a joint torque [N·m] or
    a motor current [A].

    With `force` an existing archive is replaced; `outside_limits` accepts positions of which no row
    is within the limits of the URDF.

    Raises:
        SourceError: no bag, no such topic, a joint that was not recorded, a value not finite.
        ArchiveWriteError: the archive exists or cannot be written.
    """
    files = bag_files(Path(source))
    with _messages(files, topic) as (topic, messages):
        samples, clock = _samples(messages, files[0], robot.joint_names, joint_names or {}, effort)
    metadata = {"importer": "rosbag2", "topic": str(topic), "effort": effort, "clock": clock}
    return write_imported(
        output,
        samples,
        source=files,
        robot=robot,
        metadata=metadata,
        held_joints=held_joints,
        use=use,
        force=force,
        outside_limits=outside_limits,
    )


def recorded_joints(
    source: str | PathLike[str],
    topic: str | None = None,
    joint_names: Mapping[str, str] | None = None,
) -> tuple[str, ...]:
    """Return the joints of a bag, by their names in the URDF: those of its longest message.

    Raises:
        SourceError: no bag, no such topic, or no message.
    """
    files, found = bag_files(Path(source)), ()
    with _messages(files, topic) as (_, messages):
        for number, (_, data) in enumerate(messages):
            found = max(found, tuple(_decoded(data, files[0], number).name), key=len)
    if not found:
        raise SourceError(files[0], "has no message with joints", field="joints")
    return tuple((joint_names or {}).get(name, name) for name in found)


@contextmanager
def _messages(
    files: list[Path], topic: str | None
) -> Iterator[tuple[str, Iterator[tuple[int, bytes]]]]:
    """Open the topic of the joint states: yield time of receipt [ns] and data of its messages."""
    with unpacked(files) as unpacked_file:
        known = [topics(file) for file in unpacked_file]
        everything = {name: found for part in known for name, found in part.items()}
        chosen = _choose(everything, files[0], topic)
        # A part of a split bag may lack the topic.
        parts = [file for file, part in zip(unpacked_file, known, strict=True) if chosen in part]
        yield chosen, chain.from_iterable(messages(file, chosen) for file in parts)


@cache
def _typestore() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


def _decoded(data: bytes, file: Path, number: int) -> Any:
    """Return a joint state."""
    try:
        return _typestore().deserialize_cdr(data, _JOINT_STATE)
    except Exception as error:  # rosbags does not document what it raises
        problem = f"message {number} cannot be decoded ({error or type(error).__name__})"
        raise SourceError(file, problem) from error


def _choose(topics: Mapping[str, Topic], file: Path, topic: str | None) -> str:
    """Return the requested topic, or the only one that carries joint states."""
    fitting = [
        name for name, found in topics.items() if found.is_ros2 and found.kind in _JOINT_STATES
    ]
    if topic is None and len(fitting) == 1:
        (topic,) = fitting
    if topic in fitting:
        return topic
    problem = f"{len(fitting)} topics carry {_JOINT_STATE}"
    if topic is not None:
        problem = f"{topic} is not a topic of {_JOINT_STATE}"
    listing = ", ".join(f"{name} ({found})" for name, found in topics.items()) or "none"
    remedy = f"name one of its topics: {listing}; `hil import log` reads other messages, with a "
    raise SourceError(file, problem, field="topic", remedy=f"{remedy}column map")


def _samples(
    messages: Iterable[tuple[int, bytes]],
    source: Path,
    joints: Sequence[str],
    renamed: Mapping[str, str],
    effort: Effort,
) -> tuple[Samples, str]:
    """Return joint states with the joints in this order, and their clock: header or bag."""
    stamps: dict[str, list[int]] = {"header": [], "bag": []}
    rows: dict[str, list[Array]] = {"position": [], "velocity": [], "effort": []}
    orders: dict[tuple[str, ...], list[int]] = {}
    for number, (stamp, data) in enumerate(messages):
        message = _decoded(data, source, number)
        names = tuple(message.name)
        if names not in orders:
            orders[names] = _order(names, source, joints, renamed)
        if not orders[names]:
            continue  # such as a gripper on the same topic
        time = message.header.stamp
        stamps["header"].append(time.sec * 10**9 + time.nanosec)
        stamps["bag"].append(stamp)
        for name, column in rows.items():
            values = getattr(message, name)
            if len(values) == len(names):
                column.append(values[orders[names]])
            elif len(values):
                problem = f"message {number} has {len(values)} values for {len(names)} joints"
                raise SourceError(source, problem, field=name)
    count = len(stamps["bag"])
    if not count:
        recorded = ", ".join(dict.fromkeys(name for names in orders for name in names)) or "none"
        problem = f"none of the joints {', '.join(joints)} was recorded; recorded are {recorded}"
        remedy = "give the URDF of this robot, or map its joints: --rename RECORDED=URDF"
        raise SourceError(source, problem, field="joints", remedy=remedy)
    columns: dict[str, Array | None] = {}
    if effort == "ignore":
        rows["effort"] = []
    for name, column in rows.items():
        # NaN is what ros2_control publishes for an interface that the hardware does not have.
        recorded_at_all = not all(np.isnan(row).all() for row in column)
        if recorded_at_all and len(column) != count:
            problem = f"only {len(column)} of {count} messages have it"
            raise SourceError(source, problem, field=name, remedy="record it throughout")
        columns[name] = np.array(column, np.float64) if recorded_at_all else None
    position, strength = columns["position"], columns["effort"]
    if position is None:
        raise SourceError(source, "the messages have no positions", field="position")
    clock = "header" if any(stamps["header"]) else "bag"
    samples = Samples(
        stamp=np.array(stamps[clock], np.int64),
        position=position,
        velocity=columns["velocity"],
        torque=strength if effort == "torque" else None,
        motor_current=strength if effort == "motor_current" else None,
    )
    return samples, clock


def _order(
    names: tuple[str, ...], source: Path, joints: Sequence[str], renamed: Mapping[str, str]
) -> list[int]:
    """Return the places of the wanted joints in a message; empty when it has none of them."""
    known = [renamed.get(name, name) for name in names]
    missing = [joint for joint in joints if joint not in known]
    if missing and len(missing) < len(joints):
        problem = f"joint {missing[0]} was not recorded; recorded are {', '.join(names)}"
        remedy = f"give a URDF with the recorded names, or {NOT_RECORDED}"
        raise SourceError(source, problem, field="joints", remedy=remedy)
    return [] if missing else [known.index(joint) for joint in joints]
