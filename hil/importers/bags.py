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

SUFFIXES = (".db3", ".mcap")
_PACKED = (".zstd", ".zst")
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
        return [source]
    files = [path for path in source.iterdir() if _storage(path) in SUFFIXES]
    if not files:
        raise SourceError(
            source, "has no .db3 and no .mcap file in it", remedy="name the folder of a rosbag2"
        )
    return sorted(files, key=_place)


def topics(file: Path) -> dict[str, Topic]:
    """The topics of one file by name.

    Raises:
        SourceError: it is no bag.
    """
    if file.suffix == ".mcap":
        return mcap_messages.topics(file)
    with closing(_connect(file)) as bag:
        query = "SELECT name, type, serialization_format FROM topics ORDER BY name"
        return {name: Topic(kind, encoding) for name, kind, encoding in bag.execute(query)}


def messages(file: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    """Time of receipt [ns] and data of the messages of one topic, by their time.

    Raises:
        SourceError: the file cannot be read.
    """
    found = _of_mcap(file, topic) if file.suffix == ".mcap" else _of_sqlite(file, topic)
    unpack = zstandard.ZstdDecompressor()
    for stamp, data in found:
        yield stamp, unpack.decompress(data) if data.startswith(_ZSTD) else data


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
        with file.open("rb") as packed, target.open("wb") as plain:
            zstandard.ZstdDecompressor().copy_stream(packed, plain)
    except (OSError, zstandard.ZstdError) as error:
        raise SourceError(file, f"cannot be decompressed ({error})") from error
    return target


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
    with closing(_connect(file)) as bag:
        yield from bag.execute(
            "SELECT messages.timestamp, messages.data FROM messages"
            " JOIN topics ON topics.id = messages.topic_id WHERE topics.name = ?"
            " ORDER BY messages.timestamp, messages.id",
            (topic,),
        )


def _connect(file: Path) -> sqlite3.Connection:
    """Open for reading only; leave no side files beside a bag that nobody writes."""
    options = "mode=ro" if file.with_name(file.name + "-wal").exists() else "mode=ro&immutable=1"
    try:
        bag = sqlite3.connect(f"{file.resolve().as_uri()}?{options}", uri=True)
        bag.execute("SELECT id, name, type, serialization_format FROM topics").close()
        bag.execute("SELECT topic_id, timestamp, data FROM messages LIMIT 1").close()
    except sqlite3.Error as error:
        raise SourceError(
            file,
            f"is not a rosbag2 in sqlite3 storage ({error})",
            remedy="name the .db3 or .mcap file, or the bag's folder",
        ) from error
    return bag
