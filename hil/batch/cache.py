"""Cache of a batch between runs: `.npz` files with a JSON header, and JSON files without arrays.

A file is named by its key, a digest of everything that the content depends on, so that no entry is
ever out of date. Files are replaced atomically. An `.npz` has checksums of header and numbers, a
JSON file one of its text in the line above; a damaged entry is ignored.
"""

from __future__ import annotations

import json
import math
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, is_dataclass
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from hil.base.errors import InputError
from hil.base.files import digest, json_digest, replace_file, user_cache
from hil.base.safe_input import open_file
from hil.base.type_adapter import adapter_of
from planner.arrays import DAMAGED_DATA_ERRORS

from .places import folder_of, is_url

T = TypeVar("T")
Arrays = dict[str, NDArray[Any]]

CACHE_FOLDER: Final = ".hil-cache"  # folder next to the archives
HEADER: Final = "header"  # array with the JSON text, as bytes
NUMBERS: Final = "numbers"  # array of all others, one after the other, as bytes
NPZ: Final = ".npz"  # suffix of entries with arrays
JSON: Final = ".json"  # suffix of entries without

LIBRARIES: Final = ("numpy", "scipy", "pin")  # that determine the numbers

_READ_ERRORS: Final = (
    *DAMAGED_DATA_ERRORS,
    *(OSError, EOFError, MemoryError),
    # By the `.zip` around the arrays: its directory, compression, encryption or data.
    *(BadZipFile, NotImplementedError, RuntimeError, struct.error, zlib.error),
    SyntaxError,  # by the Python literal in the header of an array
)
"""What reading a damaged `.npz` raises; the entry is then computed again."""


class CacheError(InputError):
    """The cache folder cannot be written to."""


@dataclass(frozen=True)
class CacheLocation:
    """Cache of the results of archives: one folder for all archives of a folder."""

    #: folder of the whole cache; None: next to each archive, or in the user's cache folder (XDG)
    #: where that is not writable or not a folder, and for URLs
    root: str | None = None
    keep: bool = True  #: whether to cache at all

    def folder(self, location: str) -> Path:
        """Return the cache folder of an archive, which need not exist."""
        folder = folder_of(location)
        if self.root is None and not is_url(location):
            beside = Path(folder) / CACHE_FOLDER
            exists = os.path.lexists(beside)
            usable = beside.is_dir() or not exists
            if usable and os.access(beside if exists else folder, os.W_OK | os.X_OK):
                return beside
        root = user_cache() if self.root is None else Path(self.root)
        return root / digest(folder)[:16]

    def path(self, location: str, key: str, suffix: str = NPZ) -> Path:
        """Return the file of an entry, by default of one with arrays."""
        return self.folder(location) / key[:2] / f"{key}{suffix}"

    def has(self, location: str, key: str, suffix: str = NPZ) -> bool:
        """Return whether there is a file for the key, intact or not."""
        return self.keep and self.path(location, key, suffix).is_file()

    def read(self, location: str, key: str) -> tuple[Any, Arrays] | None:
        """Return the header and the arrays of an entry; None if there is no intact one."""
        if not self.keep:
            return None
        try:
            with (
                open_file(self.path(location, key)) as file,
                np.load(file, allow_pickle=False) as entry,
            ):
                size = os.fstat(file.fileno()).st_size
                if sum(member.file_size for member in entry.zip.infolist()) > size:
                    return None  # compressed, which `write` never does
                header = json.loads(entry[HEADER].tobytes())
                if header["key"] != key:
                    return None
                return header["content"], _split(entry[NUMBERS], header["arrays"])
        except _READ_ERRORS:
            return None

    def write(self, location: str, key: str, content: Any, arrays: Arrays) -> None:
        """Write an entry.

        The arrays are one in the file: `numpy` takes a tenth of a millisecond for each.

        Args:
            location: of the entry.
            key: that it must have when it is read.
            content: JSON data.
            arrays: by name.

        Raises:
            CacheError: the file cannot be written.
        """
        if not self.keep:
            return
        layout = {name: (array.dtype.str, array.shape) for name, array in arrays.items()}
        text = json.dumps({"key": key, "content": content, "arrays": layout}).encode()
        numbers = b"".join(array.tobytes() for array in arrays.values())
        members = {HEADER: text, NUMBERS: numbers}
        with _new_file(self.path(location, key)) as file:
            np.savez(
                file,
                allow_pickle=False,
                **{name: np.frombuffer(data, np.uint8) for name, data in members.items()},
            )

    def get(self, location: str, key: str, kind: type[T]) -> T | None:
        """Return the JSON data of a key as this type; None without an intact entry."""
        if not self.keep:
            return None
        try:
            with open_file(self.path(location, key, JSON)) as file:
                checksum, _, text = file.read().partition(b"\n")
            if checksum != _checksum(key, text):
                return None
            value: T = adapter_of(kind).validate_python(json.loads(text))  # type: ignore[arg-type]
        except (OSError, MemoryError, ValueError, RecursionError):
            return None
        return value

    def put(self, location: str, key: str, content: Any) -> None:
        """Write JSON data, or a dataclass of such.

        Raises:
            CacheError: the file cannot be written.
        """
        if not self.keep:
            return
        is_object = is_dataclass(content) and not isinstance(content, type)
        text = json.dumps(asdict(content) if is_object else content).encode()
        with _new_file(self.path(location, key, JSON)) as file:
            file.write(_checksum(key, text) + b"\n" + text)


def _split(numbers: NDArray[np.uint8], layout: Mapping[str, Any]) -> Arrays:
    """Return the arrays of these types and shapes in `numbers`, as views."""
    arrays = {}
    begin = 0
    for name, (dtype, shape) in layout.items():
        # which refuses objects, and more than there is
        values = np.frombuffer(numbers, dtype, math.prod(shape), begin)
        arrays[name] = values.reshape(shape)
        begin += values.nbytes
    return arrays


def _checksum(key: str, text: bytes) -> bytes:
    return digest(key.encode() + text).encode()


@contextmanager
def _new_file(path: Path) -> Iterator[BinaryIO]:
    """Provide the new file of an entry, which replaces another when it is complete.

    Without fsync: an entry damaged by a power cut fails its checksum and is computed again.

    Raises:
        CacheError: the file cannot be written.
    """
    with cache_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(path) as temporary, temporary.open("xb") as file:
            yield file


@contextmanager
def cache_errors(path: Path) -> Iterator[None]:
    """Convert the errors of writing a file of the cache to `CacheError`."""
    try:
        yield
    except OSError as error:
        problem = f"cannot be written ({error.strerror})"
        remedy = "make room, or choose another folder with --cache, or none"
        raise CacheError(path, problem, remedy=remedy) from error


@cache
def code_digest() -> str:
    """Return the digest of the source code and of the versions of `LIBRARIES`."""
    parts: list[Any] = [f"{name} {version(name)}" for name in LIBRARIES]
    for package in ("drivers", "hil", "identification"):
        root = Path(str(files(package)))
        paths = sorted(root.rglob("*.py"))
        parts += [(str(path.relative_to(root)), digest(path.read_bytes())) for path in paths]
    return json_digest(parts)
