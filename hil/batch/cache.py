"""Cache of results of archives between runs: small files with checksum, replaced atomically.

A file is named by its key, a digest of everything that the content depends on, so no entry is ever
out of date. An entry with a wrong checksum or key is ignored.
"""

from __future__ import annotations

import json
import math
import os
import struct
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from sys import intern
from typing import Any, Final, TypeVar

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray

import drivers
import hil
import identification
from hil.errors import InputError
from hil.files import digest, json_digest, replace_file, user_cache
from hil.identify.prepared import Settings
from hil.reading import open_file
from identification.factor.factor import Estimate, Factor
from identification.selection.inner_prediction import Choice, Strength
from identification.signals.samples import Preprocessing
from identification.signals.smoothing import LowPassShape
from planner.arrays import DAMAGED

T = TypeVar("T")

BESIDE: Final = ".hil-cache"  # folder beside the archives

_MAGIC: Final = b"HILCACH4"
_HEAD: Final = struct.Struct("<8sII")  # magic, length of the JSON text, checksum of what follows
_KINDS: Final[dict[str, type[np.generic]]] = {"f": np.float64, "i": np.intp}
_TYPES: Final[dict[str, type[Any]]] = {
    kind.__name__: kind
    for kind in (Estimate, Factor, Settings, Preprocessing, LowPassShape, Strength, Choice)
}

LIBRARIES: Final = ("numpy", "scipy", "pin")  # that determine the numbers


class CacheError(InputError):
    """The cache folder cannot be written to."""


def cacheable(kind: type[T]) -> type[T]:
    """Register a dataclass of which entries may consist."""
    _TYPES[kind.__name__] = kind
    return kind


@dataclass(frozen=True)
class CacheLocation:
    """Cache of the results of archives: a folder for those in the same folder."""

    #: folder of the whole cache; None: beside each archive, or in the user's cache folder (XDG)
    #: where that is not writable or not a folder
    root: str | None = None
    keep: bool = True  #: whether to cache at all

    def folder(self, location: str) -> Path:
        """Return the cache folder of an archive, which need not exist."""
        folder = location.rsplit("/", 1)[0]
        if self.root is None:
            beside = Path(folder) / BESIDE
            there = os.path.lexists(beside)
            usable = beside.is_dir() or not there
            if usable and os.access(beside if there else folder, os.W_OK | os.X_OK):
                return beside
        root = user_cache() if self.root is None else Path(self.root)
        return root / digest(folder)[:16]

    def get(self, location: str, key: str, kind: type[T]) -> T | None:
        """Return the content of a key; None if there is no intact entry of this type."""
        if not self.keep:
            return None
        try:
            with open_file(self._path(location, key)) as file:
                found = decoded(file.read(), key)
        except OSError:
            return None
        return found if isinstance(found, kind) else None

    def has(self, location: str, key: str) -> bool:
        """Return whether there is a file for the key, intact or not."""
        return self.keep and self._path(location, key).is_file()

    def put(self, location: str, key: str, content: Any) -> None:
        """Write JSON with arrays of numbers and registered dataclasses.

        Raises:
            CacheError: the file cannot be written.
        """
        if not self.keep:
            return
        path = self._path(location, key)
        # No fsync: an entry damaged by a power cut fails its checksum and is computed again.
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replace_file(path) as temporary, temporary.open("xb") as file:
                file.write(encoded(key, content))
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            remedy = "name another folder with --cache, or none"
            raise CacheError(path, problem, remedy=remedy) from error

    def _path(self, location: str, key: str) -> Path:
        return self.folder(location) / key[:2] / key


def encoded(key: str, content: Any) -> bytes:
    """Return the file of an entry: JSON, then the arrays."""
    arrays: list[NDArray[Any]] = []
    size = 0

    def place(value: Any) -> dict[str, Any]:
        nonlocal size
        if is_dataclass(value) and not isinstance(value, type):
            own = {one.name: getattr(value, one.name) for one in fields(value)}
            return own | {"type": type(value).__name__}
        arrays.append(np.ascontiguousarray(value))
        at, size = size, size + value.nbytes
        return {"array": value.dtype.kind, "shape": value.shape, "at": at}

    text = json.dumps({"key": key, "content": content}, default=place).encode()
    text += b" " * (-(len(text) + _HEAD.size) % 8)
    body = b"".join([text, *(array.data for array in arrays)])
    return _HEAD.pack(_MAGIC, len(text), crc32(body)) + body


def decoded(data: bytes, key: str) -> Any:
    """Return the content of an entry; None if it is damaged or of another key."""
    if len(data) < _HEAD.size:
        return None
    magic, size, checksum = _HEAD.unpack_from(data)
    body = memoryview(data)[_HEAD.size :]
    if magic != _MAGIC or checksum != crc32(body):
        return None

    def restored(found: dict[str, Any]) -> Any:
        if "type" in found:
            return _TYPES[found.pop("type")](**{name: _fixed(one) for name, one in found.items()})
        if "array" not in found:
            return found
        kind, count = _KINDS[found["array"]], math.prod(found["shape"])
        return np.frombuffer(body, kind, count, size + found["at"]).reshape(found["shape"])

    try:
        entry = json.loads(bytes(body[:size]), object_hook=restored)
        return entry["content"] if entry["key"] == key else None
    except DAMAGED:  # a valid checksum, but not an entry of this program
        return None


def _fixed(value: Any) -> Any:
    """Return lists as tuples, and strings interned, because many archives share them."""
    if isinstance(value, list):
        return tuple(map(_fixed, value))
    return intern(value) if isinstance(value, str) else value


@cache
def code_digest() -> str:
    """Return the digest of the source code and of the versions of `LIBRARIES`."""
    found: list[Any] = [f"{name} {version(name)}" for name in LIBRARIES]
    for package in (drivers, hil, identification):
        root = Path(package.__path__[0])
        paths = sorted(root.rglob("*.py"))
        found += [(str(path.relative_to(root)), digest(path.read_bytes())) for path in paths]
    return json_digest(found)
