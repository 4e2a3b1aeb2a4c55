"""Cache of results of archives between runs: small files with checksum, replaced atomically.

A file is named by its key, a digest of everything that the content depends on, so no entry is ever
out of date. An entry with a wrong checksum or key is ignored.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from functools import cache, lru_cache
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
from hil.cell import Cell
from hil.files import digest, json_digest, replace_file
from hil.identify.options import Options
from hil.identify.settings import Settings
from hil.reading import open_file
from identification.estimators.consistent import Shrinkage
from identification.factor.factor import Estimate, Factor
from identification.selection.inner_prediction import Choice
from identification.signals.samples import Preprocessing
from identification.signals.smoothing import LowPassShape
from planner.arrays import DAMAGED

from .types import ArchiveRef, Bundle, CacheError, Summary

T = TypeVar("T")

BESIDE: Final = ".hil-cache"  # folder beside the archives

_MAGIC: Final = b"HILCACH3"
_HEAD: Final = struct.Struct("<8sII")  # magic, length of the JSON text, checksum of what follows
_KINDS: Final[dict[str, type[np.generic]]] = {"f": np.float64, "i": np.intp}
_TYPES: Final[dict[str, type[Any]]] = {
    kind.__name__: kind
    for kind in (
        *(ArchiveRef, Bundle, Summary, Estimate, Factor),
        *(Settings, Preprocessing, LowPassShape, Shrinkage, Choice),
    )
}

LIBRARIES: Final = ("numpy", "scipy", "pin")  # that determine the numbers


@dataclass(frozen=True)
class CacheLocation:
    """Location of the cache of an archive."""

    #: folder of the whole cache; None: beside each archive, or in the user's cache folder (XDG)
    #: where that is not writable or not a folder
    root: str | None = None
    keep: bool = True  #: whether to cache at all

    def store(self, location: str) -> Store:
        """Return the cache folder of the archives in the same folder as this one."""
        if not self.keep:
            return Store(None)
        folder = location.rsplit("/", 1)[0]
        if self.root is None:
            beside = Path(folder) / BESIDE
            there = os.path.lexists(beside)
            usable = beside.is_dir() or not there
            if usable and os.access(beside if there else folder, os.W_OK | os.X_OK):
                return Store(beside)
        xdg = Path(os.environ.get("XDG_CACHE_HOME", ""))
        own = (xdg if xdg.is_absolute() else Path.home() / ".cache") / "hil"
        return Store((own if self.root is None else Path(self.root)) / digest(folder)[:16])


@dataclass(frozen=True)
class Store:
    """A cache folder, which need not exist. None is empty."""

    folder: Path | None

    def get(self, key: str, kind: type[T]) -> T | None:
        """Return the content of a key; None if there is no intact entry of this type."""
        if self.folder is None:
            return None
        try:
            with open_file(self._path(key)) as file:
                found = decoded(file.read(), key)
        except OSError:
            return None
        return found if isinstance(found, kind) else None

    def has(self, key: str) -> bool:
        """Return whether there is a file for the key, intact or not."""
        return self.folder is not None and self._path(key).is_file()

    def put(self, key: str, content: Any) -> None:
        """Write JSON with arrays of numbers and dataclasses of `_TYPES`.

        Raises:
            CacheError: the file cannot be written.
        """
        if self.folder is None:
            return
        path = self._path(key)
        # No fsync: an entry damaged by a power cut fails its checksum and is computed again.
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replace_file(path) as temporary, temporary.open("xb") as file:
                file.write(encoded(key, content))
        except OSError as error:
            problem = f"cannot be written ({error.strerror})"
            remedy = "name another folder with --cache, or none"
            raise CacheError(path, problem, remedy=remedy) from error

    def _path(self, key: str) -> Path:
        assert self.folder is not None
        return self.folder / key[:2] / key


def encoded(key: str, content: Any) -> bytes:
    """Return the file of an entry: JSON, then the arrays.

    Of symmetric matrices (..., k, k) the lower triangles (..., k (k + 1) / 2) are written.
    """
    arrays: list[NDArray[Any]] = []
    size = 0

    def place(value: Any) -> dict[str, Any]:
        nonlocal size
        if is_dataclass(value) and not isinstance(value, type):
            own = {one.name: getattr(value, one.name) for one in fields(value)}
            return own | {"type": type(value).__name__}
        width = value.shape[-1] if value.ndim > 1 and value.shape[-1] == value.shape[-2] else 0
        if width and np.array_equal(value, value.swapaxes(-1, -2)):
            value = value[(..., *_triangle(width))]
        else:
            width = 0
        arrays.append(np.ascontiguousarray(value))
        at, size = size, size + value.nbytes
        return {"array": value.dtype.kind, "shape": value.shape, "at": at, "square": width}

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
        values = np.frombuffer(body, kind, count, size + found["at"]).reshape(found["shape"])
        if not found["square"]:
            return values
        row, column = _triangle(found["square"])
        square = np.empty((*values.shape[:-1], found["square"], found["square"]), kind)
        square[..., row, column] = square[..., column, row] = values
        return square

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


@lru_cache(maxsize=64)
def _triangle(width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the lower triangle of a square."""
    row, column = np.tril_indices(width)
    return row, column


# Keys


@cache
def code_digest() -> str:
    """Return the digest of the source code and of the versions of `LIBRARIES`."""
    found: list[Any] = [f"{name} {version(name)}" for name in LIBRARIES]
    for package in (drivers, hil, identification):
        root = Path(package.__path__[0])
        paths = sorted(root.rglob("*.py"))
        found += [(str(path.relative_to(root)), digest(path.read_bytes())) for path in paths]
    return json_digest(found)


def arm_digest(cell: Cell, drive_train: bytes | None, *, simulated: bool = False) -> str:
    """Return the digest that identifies a robot: links, joints, friction law, drives.

    Payload and delay are not part of it (see :func:`hil.batch.discovery.describe_setup`). The drive
    train of the archive has precedence over that of the cell.
    """
    drives = cell.file.drive_train
    parts = {
        "urdf": digest(cell.urdf),
        "simulated": simulated,
        "robot": cell.file.robot.model_dump(mode="json", exclude={"payload"}),
        "drives": drives.model_dump(mode="json") if drives is not None else None,
        "in force": None if drive_train is None else digest(drive_train),
    }
    # Users store it in tables, so the text must not change.
    return digest(json.dumps(parts, sort_keys=True, separators=(",", ":")))


def settings_digest(settings: Settings) -> str:
    """Return the digest of the settings that determine the factor of an archive."""
    entries = asdict(settings)
    for later in ("shrinkage", "choices"):  # of the estimate only
        del entries[later]
    return json_digest([entries, code_digest()])


def decision_digest(options: Options, arms: Settings | None, refs: Sequence[ArchiveRef]) -> str:
    """Return the digest of the inputs of a decision: options or the arm's settings, archives, code.

    Of the estimators only the automatic one influences the settings.
    """
    asked = asdict(options) | {"estimator": options.estimator == "auto"}
    known = None if arms is None else asdict(arms)
    return json_digest([asked, known, [ref.sha256 for ref in refs], code_digest()])


def sum_key(refs: Sequence[ArchiveRef], settings: Settings) -> str:
    """Return the key of the sum over archives, added in this order."""
    return json_digest(["sum", [ref.sha256 for ref in refs], settings_digest(settings)])
