"""Files of a rosbag2: where they are, and the messages in them, whatever the storage.

Storage is sqlite3 or MCAP. Files compressed as a whole (``.zstd``) are unpacked into a temporary
folder; messages compressed one by one are known by their first bytes.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import zstandard

from hil.errors import SourceError
from hil.importers import mcap_messages
from hil.importers.mcap_messages import Topic
from hil.importers.mcap_sizes import MOST_INFLATION
from hil.reading import opened

SUFFIXES = (".db3", ".mcap")
_PACKED = (".zstd", ".zst")
_LONGEST_MESSAGE = 1 << 24  # bytes
_LONGEST_ROW = 1 << 28  # bytes
_SLACK = 1 << 20  # bytes
_TABLES = "SELECT name FROM sqlite_master WHERE type = 'table' AND sql NOT LIKE 'CREATE VIRTUAL%'"
_ZSTD = b"\x28\xb5\x2f\xfd"  # begins no CDR message


def bag_files(source: Path) -> list[Path]:
    """The files of a bag in the order they were written.

    Raises:
        SourceError: there is none.
    """
    if not source.exists():
        raise SourceError(
            source, "does not exist", remedy="name a .db3 or .mcap file, or a bag's folder"
        )
    if not source.is_dir():
        return [_regular(source)]
    try:
        files = [path for path in source.iterdir() if _storage(path) in SUFFIXES]
    except OSError as error:
        raise SourceError(source, f"cannot be read: {error.strerror}") from error
    if not files:
        raise SourceError(
            source, "has no .db3 and no .mcap file in it", remedy="name the folder of a rosbag2"
        )
    return sorted(map(_regular, files), key=_place)


def _regular(file: Path) -> Path:
    """The same; no pipe, which would be waited for."""
    try:
        opened(file).close()
    except OSError as error:
        raise SourceError(file, f"cannot be read: {error.strerror}") from error
    return file


def topics(file: Path) -> dict[str, Topic]:
    """The topics of one file by name.

    Raises:
        SourceError: it is no bag.
    """
    if file.suffix == ".mcap":
        return mcap_messages.topics(file)
    with _connected(file) as bag:
        query = "SELECT name, type, serialization_format FROM topics ORDER BY name"
        return {str(name): Topic(str(kind), str(code)) for name, kind, code in bag.execute(query)}


def messages(file: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    """Time of receipt [ns] and data of the messages of one topic, by their time.

    Raises:
        SourceError: the file cannot be read.
    """
    found = _of_mcap(file, topic) if file.suffix == ".mcap" else _of_sqlite(file, topic)
    for stamp, data in found:
        yield stamp, _decompressed(data, file) if data.startswith(_ZSTD) else data


@contextmanager
def unpacked(files: list[Path]) -> Iterator[list[Path]]:
    """The same files, those that are compressed as a whole decompressed for as long as this lasts.

    Raises:
        SourceError: one cannot be decompressed.
    """
    with TemporaryDirectory() as folder:
        yield [_unpacked(file, Path(folder)) for file in files]


def _unpacked(file: Path, folder: Path) -> Path:
    if file.suffix not in _PACKED:
        return file
    target = folder / file.stem
    try:
        most = _SLACK + MOST_INFLATION * file.stat().st_size
        with file.open("rb") as packed, target.open("wb") as plain:
            for block in zstandard.ZstdDecompressor().read_to_iter(packed):
                plain.write(block)
                if plain.tell() > most:
                    raise SourceError(file, f"becomes more than {MOST_INFLATION} times as large")
    except (OSError, zstandard.ZstdError) as error:
        raise SourceError(file, f"cannot be decompressed ({error})") from error
    return target


def _decompressed(data: bytes, file: Path) -> bytes:
    """A message that was compressed by itself."""
    try:
        size = zstandard.frame_content_size(data)
        if size > _LONGEST_MESSAGE:
            raise SourceError(file, f"has a message of {size} bytes")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=_LONGEST_MESSAGE)
    except zstandard.ZstdError as error:
        raise SourceError(file, f"has a message that cannot be decompressed ({error})") from error


def _storage(path: Path) -> str:
    """The suffix that tells the storage."""
    return Path(path.stem).suffix if path.suffix in _PACKED else path.suffix


def _place(path: Path) -> list[tuple[int, str]]:
    """Sorts ``x_10`` behind ``x_2``."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _of_mcap(file: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    for _, stamp, data in mcap_messages.messages(file, [topic]):
        yield stamp, data


def _of_sqlite(file: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    query = (
        "SELECT messages.timestamp, messages.data FROM messages"
        " JOIN topics ON topics.id = messages.topic_id WHERE topics.name = ?"
        " ORDER BY messages.timestamp, messages.id"
    )
    with _connected(file) as bag:
        for number, (stamp, data) in enumerate(bag.execute(query, (topic,))):
            if not isinstance(stamp, int) or not isinstance(data, bytes):
                raise SourceError(
                    file,
                    f"message {number} has no time or no data",
                    field=topic,
                    remedy="take it out, or record again",
                )
            yield stamp, data


@contextmanager
def _connected(file: Path) -> Iterator[sqlite3.Connection]:
    """The bag, for reading only; no side files are left beside one that nobody writes.

    Raises:
        SourceError: it is no bag, or is found damaged while this lasts.
    """
    options = "mode=ro" if file.with_name(file.name + "-wal").exists() else "mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(f"{file.resolve().as_uri()}?{options}", uri=True)) as bag:
            bag.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_ROW)
            # A view could make rows without end.
            tables = {name for (name,) in bag.execute(_TABLES)}
            absent = sorted({"topics", "messages"} - tables)
            if absent:
                raise sqlite3.DatabaseError(f"it has no table {absent[0]}")
            yield bag
    except (sqlite3.Error, UnicodeDecodeError) as error:
        raise SourceError(
            file,
            f"is not a rosbag2 in sqlite3 storage, or damaged ({error})",
            remedy="name the .db3 or .mcap file, or the bag's folder",
        ) from error
