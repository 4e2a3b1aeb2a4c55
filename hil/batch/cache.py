"""What is kept of archives between runs: small files, checked, replaced as a whole.

```
.hil-cache/                        beside the archives, if their folder can be written to
    excitation_000_a1.mcap.json    what the archive is, and its digest while its file is untouched
    5f/5fd0...                     a summary, a sum, settings, the texts of a cell: by their key
```

A key holds everything the content depends on, so nothing is ever out of date. An entry that is
damaged, or was written for another key, counts as absent.
"""

from __future__ import annotations

import json
import math
import os
import re
import struct
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

from hil.reading import json_of, opened, text_of
from planner.plain import DAMAGED, table

from .errors import CacheError
from .keys import text_digest

BESIDE: Final = ".hil-cache"
"""Name of the folder beside the archives."""

_MAGIC: Final = b"HILCACH1"
_NUMBERS: Final = re.compile(r"[<|][biuf][1-8]")
"""Codes of the arrays that are kept. numpy would evaluate what else an untrusted file may hold."""
_HEAD: Final = struct.Struct("<8sQI")  # magic, length of the rest, its checksum
_TEXT: Final = struct.Struct("<I")  # length of the JSON text in front of the arrays


class Entry(NamedTuple):
    """What a file holds.

    Attributes:
        header: JSON.
        arrays: read-only, by name.
    """

    header: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Where:
    """Which folder keeps what belongs to an archive.

    Attributes:
        root: of all that is kept; None: beside each archive, and below the user's own cache folder
            where that cannot be written to or something else has its name.
    """

    root: str | None = None

    def store(self, location: str) -> Store:
        """That of the archives in the folder of this one."""
        folder = location.rsplit("/", 1)[0] if "/" in location else "."
        if self.root is None and "://" not in location:
            beside = Path(folder) / BESIDE
            there = os.path.lexists(beside)
            usable = beside.is_dir() or not there
            if usable and os.access(beside if there else folder, os.W_OK | os.X_OK):
                return Store(beside)
        root = Path(self.root) if self.root is not None else _users_own()
        name = folder if "://" in location else _resolved(folder)
        return Store(root / text_digest(name)[:16])


@dataclass(frozen=True)
class Store:
    """One such folder; it need not exist."""

    folder: Path

    def get(self, key: str) -> Entry | None:
        """What is kept under a key; None if nothing, or nothing whole."""
        try:
            with opened(self._path(key)) as file:
                data = file.read()
        except OSError:
            return None
        return decoded(data, key)

    def has(self, key: str) -> bool:
        """Whether there is a file for the key, whole or not."""
        return self._path(key).is_file()

    def put(
        self, key: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None
    ) -> None:
        """Keep something under a key.

        Raises:
            CacheError: the disk refuses.
        """
        self._write(self._path(key), encoded(key, header, arrays or {}))

    def forget(self, key: str) -> None:
        """Keep nothing under a key."""
        with suppress(OSError):
            self._path(key).unlink()

    def note(self, name: str) -> Any:
        """The note about a file of the archives' folder; None if there is none."""
        try:
            return json_of(text_of(self.folder / f"{name}.json"))
        except (OSError, ValueError):
            return None

    def put_note(self, name: str, note: Any) -> None:
        """Keep a note about a file.

        Raises:
            CacheError: the disk refuses.
        """
        self._write(self.folder / f"{name}.json", json.dumps(note).encode())

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / key

    def _write(self, path: Path, data: bytes) -> None:
        # No fsync: what a power cut damages fails its checksum and is made anew.
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".part-")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(data)
                Path(temporary).replace(path)
            except BaseException:
                with suppress(OSError):
                    Path(temporary).unlink()
                raise
        except OSError as error:
            raise CacheError(
                path,
                f"cannot be written ({error.strerror})",
                remedy="name another folder with --cache, or none",
            ) from error


def encoded(key: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An entry as it stands in its file."""
    layout = [[name, array.dtype.str, array.shape] for name, array in arrays.items()]
    text = json.dumps({"key": key, "arrays": layout, "header": header}).encode()
    text += b" " * (-(len(text) + _TEXT.size + _HEAD.size) % 8)
    body = b"".join(
        [_TEXT.pack(len(text)), text, *(np.ascontiguousarray(a).data for a in arrays.values())]
    )
    return _HEAD.pack(_MAGIC, len(body), crc32(body)) + body


def decoded(data: bytes, key: str) -> Entry | None:
    """The entry of a file; None where it is damaged, or of another key."""
    if len(data) < _HEAD.size + _TEXT.size:
        return None
    magic, length, checksum = _HEAD.unpack_from(data)
    body = memoryview(data)[_HEAD.size :]
    if magic != _MAGIC or length != len(body) or checksum != crc32(body):
        return None
    (size,) = _TEXT.unpack_from(body)
    try:
        content = json_of(bytes(body[_TEXT.size : _TEXT.size + size]))
        if content["key"] != key:
            return None
        arrays, at = {}, _TEXT.size + size
        for name, code, shape in content["arrays"]:
            if not _NUMBERS.fullmatch(code) or not all(type(size) is int for size in shape):
                return None
            dtype, count = np.dtype(code), math.prod(shape)
            if not 0 <= count <= len(body):
                return None
            arrays[name] = np.frombuffer(body, dtype, count, at).reshape(shape)
            at += count * dtype.itemsize
        return Entry(dict(table(content["header"])), arrays)
    except DAMAGED:  # sealed, and none of ours
        return None


@lru_cache(maxsize=1024)
def _resolved(folder: str) -> str:
    return str(Path(folder).resolve())


def _users_own() -> Path:
    """The user's cache folder (XDG base directories)."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(named) if Path(named).is_absolute() else Path.home() / ".cache") / "hil"
