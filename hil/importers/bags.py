"""Bags of ROS: files of a folder, their topics and messages, read by `rosbags`; MCAP by `mcap`."""

from __future__ import annotations

import re
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import IO, TYPE_CHECKING, Any, Final

import zstandard
from rosbags.interfaces import MessageDefinitionFormat

from hil.archive.verified_records import MAX_COMPRESSION_RATIO
from hil.base.errors import SourceError
from hil.base.safe_input import open_file, read_text
from hil.base.terminal_text import typed
from hil.importers import mcap_messages
from hil.importers.mcap_messages import Topic
from hil.importers.ros_messages import MessageError, decoded, definitions_of, typestore_of

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

SUFFIXES: Final = (".db3", ".mcap", ".bag")
_PACKED: Final = (".zstd", ".zst")
_MAX_MESSAGE_BYTES: Final = 1 << 24  # bytes
_MAX_ROW_BYTES: Final = 1 << 28  # bytes
_BLOCK_BYTES: Final = 1 << 20  # bytes
_SQLITE_MAGIC: Final = b"SQLite format 3\0"
_ROS_1_MAGIC: Final = b"#ROSBAG V2.0\n"
_ZSTD_MAGIC: Final = b"\x28\xb5\x2f\xfd"  # begins no CDR message


def bag_files(source: Path) -> list[Path]:
    """Return the files of a bag in the order of writing, each part once.

    Raises:
        SourceError: there is none, or one that the metadata name is missing.
    """
    files = [source]
    try:
        if source.is_dir():
            files = sorted((p for p in source.iterdir() if _storage(p) in SUFFIXES), key=_sort_key)
        for file in files:
            open_file(file).close()  # raises for a pipe, which would block
    except OSError as error:
        problem = f"cannot be read: {error.strerror}"
        remedy = "give a .db3, .mcap or .bag file, or a bag's folder"
        raise SourceError(error.filename, problem, remedy=remedy) from error
    if not files:
        problem = "has no .db3, no .mcap and no .bag file in it"
        raise SourceError(source, problem, remedy="give the folder of a bag")
    if source.is_dir():
        _require_parts(source, {_unpacked_name(file) for file in files})
    unpacked = {file.name for file in files if file.suffix not in _PACKED}
    # A part and its compressed copy are one part.
    return [file for file in files if file.name in unpacked or _unpacked_name(file) not in unpacked]


def _require_parts(folder: Path, present: set[str]) -> None:
    """Raise SourceError for a part that the metadata of a bag name and that is missing."""
    metadata = folder / "metadata.yaml"
    if not metadata.is_file():
        return
    from ruamel.yaml import YAML  # only for bags

    try:
        content = YAML(typ="safe").load(read_text(metadata))
        named = content["rosbag2_bagfile_information"]["relative_file_paths"]
        names = [Path(str(name)).name for name in named]
    except Exception as error:  # of YAML in any state
        problem = f"cannot be read ({error or type(error).__name__})".replace("\n", " ")
        remedy = "repair it, or give the files of the bag one by one"
        raise SourceError(metadata, problem, remedy=remedy) from error
    missing = [name for name in names if _unpacked_name(Path(name)) not in present]
    if missing:
        problem = f"{', '.join(missing)}: named in metadata.yaml, and not in the folder"
        remedy = (
            "copy what is missing into it; to use one part alone, give its file: "
            f"{', '.join(sorted(present))}"
        )
        raise SourceError(folder, problem, remedy=remedy)


@dataclass(frozen=True)
class BagMessage:
    """A message of a bag."""

    received: int  #: [ns]
    content: Any  #: as `rosbags` decodes it
    number: int  #: from 0, over all parts


class Bag:
    """The files of an open bag: their topics, and messages in the order of the parts."""

    def __init__(self, files: Sequence[Path], parts: Sequence[_Part]) -> None:
        self.files = tuple(files)
        self._parts = tuple(parts)
        #: by name
        self.topics: Mapping[str, Topic] = {
            name: topic for part in parts for name, topic in part.topics.items()
        }

    def messages(self, topic: str) -> Iterator[BagMessage]:
        """Yield the messages of a topic.

        Raises:
            SourceError: the file cannot be read, or a message cannot be decoded.
        """
        number = 0
        for part in self._parts:
            if topic not in part.topics:
                continue  # a part of a split bag may lack it
            for received, data in part.messages(topic):
                try:
                    content = part.decoded(topic, data)
                except MessageError as error:
                    raise SourceError(part.file, f"message {number} {error}") from error
                yield BagMessage(received, content, number)
                number += 1


@contextmanager
def open_bag(source: Path) -> Iterator[Bag]:
    """Open a ``.db3``, ``.mcap`` or ``.bag`` file or the folder of a bag, compressed or not.

    Raises:
        SourceError: it is no bag, or damaged.
    """
    files = bag_files(source)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        parts = []
        for number, file in enumerate(files):
            target = folder / f"part_{number}{_storage(file)}"
            _provide(file, target)
            parts.append(
                _McapPart(file, target)
                if target.suffix == ".mcap"
                else stack.enter_context(_reader_part(file, target))
            )
        yield Bag(files, parts)


class _Part(ABC):
    """One file of a bag.

    Attributes:
        file: that the user named, for errors.
        topics: by name.
    """

    file: Path
    topics: Mapping[str, Topic]

    @abstractmethod
    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        """Yield time of receipt [ns] and data of the messages of a topic."""

    def decoded(self, topic: str, data: bytes) -> Any:
        """Return a message; MessageError if it cannot be decoded."""
        described = self.topics[topic]
        text = described.definition.decode(errors="replace")
        *others, last = definitions_of(described.kind, text)
        for definition in others:
            with suppress(MessageError):
                return _decoded(described, definition, data)
        return _decoded(described, last, data)


def _decoded(topic: Topic, definition: str, data: bytes) -> Any:
    store = typestore_of(topic.kind, definition, topic.schema_encoding)
    return decoded(store, topic.kind, data)


class _McapPart(_Part):
    def __init__(self, file: Path, path: Path) -> None:
        self.file = file
        self._path = path
        with _named(path, file):
            self.topics = mcap_messages.read(path, lambda *_: False)[0]

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        with _named(self._path, self.file):
            _, messages = mcap_messages.read(self._path, lambda name, _: name == topic)
        for _, stamp, data in messages:
            yield stamp, _decompressed(data, self.file)


class _ReaderPart(_Part):
    """A file that `rosbags` reads: sqlite3 of ROS 2, or a bag of ROS 1."""

    def __init__(self, file: Path, reader: AnyReader) -> None:
        self.file = file
        self._reader = reader
        self.topics = {
            connection.topic: Topic(
                connection.msgtype,
                getattr(connection.ext, "serialization_format", "ros1"),
                "ros2idl" if connection.msgdef.format is MessageDefinitionFormat.IDL else "ros2msg",
                connection.msgdef.data.encode(),
            )
            for connection in reader.connections
        }

    def messages(self, topic: str) -> Iterator[tuple[int, bytes]]:
        connections = [
            connection for connection in self._reader.connections if connection.topic == topic
        ]
        try:
            for number, (_, stamp, data) in enumerate(self._reader.messages(connections)):
                if not isinstance(stamp, int) or not isinstance(data, bytes | memoryview):
                    problem = f"message {number} has no time or no data"
                    remedy = "remove it, or record again"
                    raise SourceError(self.file, problem, field=topic, remedy=remedy)
                yield stamp, _decompressed(bytes(data), self.file)
        except SourceError:
            raise
        except Exception as error:
            raise _not_a_bag(self.file, error) from error

    def decoded(self, topic: str, data: bytes) -> Any:
        if self._reader.is2:
            return super().decoded(topic, data)
        try:
            return self._reader.deserialize(data, self.topics[topic].kind)
        except Exception as error:
            raise MessageError(f"cannot be decoded ({error or type(error).__name__})") from error


@contextmanager
def _reader_part(file: Path, path: Path) -> Iterator[_ReaderPart]:
    from rosbags.highlevel import AnyReader  # only for bags
    from rosbags.typesys import Stores, get_typestore

    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        for part in reader.readers:
            database = getattr(getattr(part, "storage", None), "dbconn", None)
            if database is not None:  # a row can be larger than the file
                database.limit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_ROW_BYTES)
    except Exception as error:  # of apsw, YAML, struct and others on a damaged file
        raise _not_a_bag(file, error) from error
    try:
        yield _ReaderPart(file, reader)
    finally:
        reader.close()


def _not_a_bag(file: Path, error: Exception) -> SourceError:
    kind = "a bag of ROS 1" if _storage(file) == ".bag" else "a rosbag2 in sqlite3 storage"
    reason = re.sub(r"\S*part_\d+\.\w+'?", file.name, str(error)) or type(error).__name__
    problem = f"is not {kind}, or damaged ({reason})"
    remedy = "give the .db3, .mcap or .bag file, or the bag's folder"
    if _is_database(file):
        remedy = "copy it again, together with the file that ends in -wal, if there is one"
    elif _starts_with(file, _ROS_1_MAGIC):
        remedy = f"copy it again; or, if its recorder was killed: rosbag reindex {typed(file.name)}"
    return SourceError(file, problem, remedy=remedy)


def _is_database(file: Path) -> bool:
    return _starts_with(file, _SQLITE_MAGIC)


def _starts_with(file: Path, signature: bytes) -> bool:
    try:
        with file.open("rb") as stream:
            return stream.read(len(signature)) == signature
    except OSError:
        return False


@contextmanager
def _named(path: Path, file: Path) -> Iterator[None]:
    """Name the user's file in errors on another file."""
    try:
        yield
    except SourceError as error:
        if error.path != path:
            raise
        raise SourceError(file, error.problem, field=error.field, remedy=error.remedy) from error


def _provide(file: Path, target: Path) -> None:
    """Make a file readable at a path without special characters: linked, or decompressed.

    A database that was not closed has its last messages in a log next to it: they are merged in a
    copy.
    """
    if file.suffix in _PACKED:
        _unpack(file, target)
        return
    log = file.with_name(file.name + "-wal")
    if not log.exists():
        target.symlink_to(file.resolve())
        return
    try:
        copyfile(file, target)
        copyfile(log, target.with_name(target.name + "-wal"))
        with closing(sqlite3.connect(target)) as database:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    except (OSError, sqlite3.Error) as error:
        raise _not_a_bag(file, error) from error


def _unpack(file: Path, target: Path) -> None:
    try:
        most = _BLOCK_BYTES + MAX_COMPRESSION_RATIO * file.stat().st_size
        with file.open("rb") as packed, target.open("wb") as output:
            for block in _unpacked_blocks(packed, file):
                output.write(block)
                if output.tell() > most:
                    raise SourceError(
                        file, f"expands to more than {MAX_COMPRESSION_RATIO} times as large"
                    )
    except (OSError, zstandard.ZstdError) as error:
        raise SourceError(file, f"cannot be decompressed ({error})") from error


def _unpacked_blocks(packed: IO[bytes], file: Path) -> Iterator[bytes]:
    """Yield blocks of a compressed file; SourceError if its end is missing."""
    frame = None
    while data := packed.read(_BLOCK_BYTES):
        while data:
            frame = frame or zstandard.ZstdDecompressor().decompressobj()
            yield frame.decompress(data)
            data = frame.unused_data
            if frame.eof:
                frame = None
    if frame is not None:
        problem = "ends within its compressed data"
        raise SourceError(file, problem, remedy="copy it again")


def _decompressed(data: bytes, file: Path) -> bytes:
    """Return a message, decompressed if it was compressed individually."""
    if not data.startswith(_ZSTD_MAGIC):
        return data
    try:
        size = zstandard.frame_content_size(data)
        if size > _MAX_MESSAGE_BYTES:
            raise SourceError(file, f"has a message of {size} bytes")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=_MAX_MESSAGE_BYTES)
    except zstandard.ZstdError as error:
        raise SourceError(file, f"has a message that cannot be decompressed ({error})") from error


def _storage(path: Path) -> str:
    """Return the suffix of the storage format."""
    return Path(path.stem).suffix if path.suffix in _PACKED else path.suffix


def _unpacked_name(path: Path) -> str:
    return path.stem if path.suffix in _PACKED else path.name


def _sort_key(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts ``x_10`` behind ``x_2``."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
