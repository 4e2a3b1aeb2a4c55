"""Results of archives between runs: small files, checked, replaced as a whole.

```
.hil-cache/           beside the archives, if their folder can be written to
    5f/5fd0...        by its key: what an archive is, a summary, a sum, settings, texts of a cell
```

A key is a digest of everything the content depends on, so nothing is ever out of date. An entry
whose checksum fails, or that was written for another key, counts as absent; one that is whole is
our own and trusted.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from sys import intern
from typing import Any, Final

import numpy as np
from isal.isal_zlib import crc32
from numpy.typing import NDArray
from pydantic import TypeAdapter

import drivers
import hil
import identification
from hil.cell import Cell
from hil.files import replacing
from hil.identify.options import Options
from hil.identify.settings import Settings
from hil.io import digest, json_digest
from hil.reading import opened
from identification.factor.factor import Estimate
from identification.factor.phases import PhaseFactor
from planner.checked_data import DAMAGED

from .factors import reduce_bundle
from .types import ArchiveRef, Broken, Bundle, CacheError, Fit, Summary

BESIDE: Final = ".hil-cache"
"""Name of the folder beside the archives."""

_MAGIC: Final = b"HILCACH2"
_HEAD: Final = struct.Struct("<8sII")  # magic, length of the JSON text, checksum of what follows
_KINDS: Final[dict[str, type[np.generic]]] = {"f": np.float64, "i": np.intp}

# What stands between the bytes of an archive and its cache entries.
_PROGRAMS: Final = (
    (drivers, ("**/*.py",)),
    (identification, ("**/*.py",)),
    (hil, ("recordings.py", "archive/**/*.py", "cell/**/*.py", "importers/findings.py")),
    (hil, (*(f"identify/{name}.py" for name in ("deciding", "options", "settings", "sources")),)),
    (hil, (*(f"batch/{name}.py" for name in ("cache", "discovery", "factors", "types")),)),
)
LIBRARIES: Final = ("numpy", "scipy", "pin")
"""Packages that decide about the numbers."""


@dataclass(frozen=True)
class Where:
    """Which folder caches what belongs to an archive.

    Attributes:
        root: of the whole cache; None: beside each archive, and below the user's own cache folder
            where that cannot be written to or something else has its name.
        keep: whether anything is cached at all.
    """

    root: str | None = None
    keep: bool = True

    def store(self, location: str) -> Store:
        """That of the archives in the folder of this one."""
        if not self.keep:
            return Store(None)
        folder = location.rsplit("/", 1)[0] if "/" in location else "."
        if self.root is None and "://" not in location:
            beside = Path(folder) / BESIDE
            there = os.path.lexists(beside)
            usable = beside.is_dir() or not there
            if usable and os.access(beside if there else folder, os.W_OK | os.X_OK):
                return Store(beside)
        root = Path(self.root) if self.root is not None else _users_own()
        name = folder if "://" in location else _resolved(folder)
        return Store(root / digest(name)[:16])


@dataclass(frozen=True)
class Store:
    """One such folder; it need not exist. None holds nothing."""

    folder: Path | None

    def get(self, key: str) -> Any:
        """The content under a key; None if there is none, or none that is whole."""
        if self.folder is None:
            return None
        try:
            with opened(self._path(key)) as file:
                return decoded(file.read(), key)
        except OSError:
            return None

    def has(self, key: str) -> bool:
        """Whether there is a file for the key, whole or not."""
        return self.folder is not None and self._path(key).is_file()

    def put(self, key: str, content: Any) -> None:
        """Write JSON with arrays of numbers in it.

        Raises:
            CacheError: the disk refuses.
        """
        if self.folder is None:
            return
        path = self._path(key)
        # No fsync: what a power cut damages fails its checksum and is made anew.
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary, temporary.open("xb") as file:
                file.write(encoded(key, content))
        except OSError as error:
            raise CacheError(
                path,
                f"cannot be written ({error.strerror})",
                remedy="name another folder with --cache, or none",
            ) from error

    def remove(self, key: str) -> None:
        """Remove an entry, if it is there and can be removed."""
        if self.has(key):
            try:
                self._path(key).unlink(missing_ok=True)
            except OSError:
                return

    def _path(self, key: str) -> Path:
        assert self.folder is not None
        return self.folder / key[:2] / key


def encoded(key: str, content: Any) -> bytes:
    """An entry as its file has it: JSON, and behind it the arrays."""
    arrays: list[NDArray[Any]] = []
    size = 0

    def place(array: NDArray[Any]) -> dict[str, Any]:
        nonlocal size
        arrays.append(np.ascontiguousarray(array))
        at, size = size, size + array.nbytes
        return {"array": array.dtype.kind, "shape": array.shape, "at": at}

    text = json.dumps({"key": key, "content": content}, default=place).encode()
    text += b" " * (-(len(text) + _HEAD.size) % 8)
    body = b"".join([text, *(array.data for array in arrays)])
    return _HEAD.pack(_MAGIC, len(text), crc32(body)) + body


def decoded(data: bytes, key: str) -> Any:
    """The content of an entry, with read-only arrays; None if it is damaged or of another key."""
    if len(data) < _HEAD.size:
        return None
    magic, size, checksum = _HEAD.unpack_from(data)
    body = memoryview(data)[_HEAD.size :]
    if magic != _MAGIC or checksum != crc32(body):
        return None

    def restored(found: dict[str, Any]) -> Any:
        if "array" not in found:
            return found
        kind, count = _KINDS[found["array"]], math.prod(found["shape"])
        return np.frombuffer(body, kind, count, size + found["at"]).reshape(found["shape"])

    try:
        entry = json.loads(bytes(body[:size]), object_hook=restored)
        return entry["content"] if entry["key"] == key else None
    except DAMAGED:  # a checksum that is right, and none of our entries
        return None


@lru_cache(maxsize=1024)
def _resolved(folder: str) -> str:
    return str(Path(folder).resolve())


def _users_own() -> Path:
    """The user's cache folder (XDG base directories)."""
    named = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(named) if Path(named).is_absolute() else Path.home() / ".cache") / "hil"


# Keys


@cache
def code_digest() -> str:
    """Digest of the programs that examine and reduce archives, and of the libraries they use.

    The programs' own text is read, so that a change counts even where nobody has raised a version.
    """
    found: list[Any] = [f"{name} {version(name)}" for name in LIBRARIES]
    for package, patterns in _PROGRAMS:
        root = Path(os.fspath(package.__path__[0]))
        for pattern in patterns:
            paths = sorted(root.glob(pattern))
            assert paths, f"{package.__name__} has no {pattern}"
            found += [(str(path.relative_to(root)), digest(path.read_bytes())) for path in paths]
    return json_digest(found)


def arm_digest(cell: Cell, drive_train: bytes | None, *, simulated: bool = False) -> str:
    """Digest of what makes a robot the same one: links, joints, friction law, drives.

    Not of a payload or a delay (see :func:`hil.batch.discovery.setup_of`): an arm with another
    payload is the same arm.

    Args:
        cell: as it travels in the archive.
        drive_train: the drive train in force, if the archive has one.
        simulated: whether it is no arm, but a model of one.
    """
    drives = cell.file.drive_train
    parts = {
        "urdf": digest(cell.urdf),
        "simulated": simulated,
        "robot": cell.file.robot.model_dump(mode="json", exclude={"payload"}),
        "drives": drives.model_dump(mode="json") if drives is not None else None,
        "in force": None if drive_train is None else digest(drive_train),
    }
    # It stands in tables that people keep: the same text as ever.
    return digest(json.dumps(parts, sort_keys=True, separators=(",", ":")))


def belief_digest(cell: Cell) -> str:
    """Digest of what the maker's figures are, "" without any; the URDF counts to the arm."""
    nominal = cell.file.nominal
    return "" if nominal is None else json_digest(nominal.model_dump(mode="json"))


def settings_digest(settings: Settings) -> str:
    """Digest of all that, beside its bytes, decides about the factor of an archive."""
    entries = asdict(settings)
    for later in ("shrinkage", "choices"):  # of the estimate
        del entries[later]
    return json_digest([entries, code_digest()])


def decision_digest(options: Options, arms: Settings | None, refs: Sequence[ArchiveRef]) -> str:
    """Digest of what settings are decided from: options or the arm's settings, archives, programs.

    Of the estimators only the automatic one asks anything.
    """
    asked = asdict(options) | {"estimator": options.estimator == "auto"}
    known = None if arms is None else asdict(arms)
    return json_digest([asked, known, [ref.sha256 for ref in refs], code_digest()])


def summary_key(ref: ArchiveRef, settings: str) -> str:
    """Key of the summary of an archive; settings by their digest."""
    return json_digest(["summary", ref.sha256, settings])


def sum_key(refs: Sequence[ArchiveRef], settings: str) -> str:
    """Key of the sum over archives, added from first to last."""
    return json_digest(["sum", [ref.sha256 for ref in refs], settings])


# Settings and bundles


def put_settings(store: Store, key: str, settings: Settings) -> None:
    """Cache settings; every figure to the last bit.

    Raises:
        CacheError: the disk refuses.
    """
    store.put(key, asdict(settings))


def cached_settings(store: Store, key: str) -> Settings | None:
    """The settings under a key; None if there are none."""
    found = store.get(key)
    try:
        return None if found is None else TypeAdapter(Settings).validate_python(found)
    except ValueError:
        return None


def is_cached(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> bool:
    """Whether there is an entry of the sum of these archives; it may turn out to be damaged."""
    return where.store(refs[0].location).has(sum_key(refs, settings_digest(settings)))


def cached_bundle(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> Bundle | None:
    """Archives reduced earlier; None unless all of them are in the cache."""
    store, used = where.store(refs[0].location), settings_digest(settings)
    found = store.get(sum_key(refs, used))
    if found is None:
        return None
    summaries, broken = [], []
    try:
        for ref in refs:
            one = store.get(summary_key(ref, used))
            if one is None:
                return None
            if "broken" in one:
                broken.append(Broken(ref.location, str(one["broken"])))
            else:
                summaries.append(_summary(one, ref))
        phase = _phase(found["sum"])
    except DAMAGED:  # a checksum that is right, and none of our entries
        return None
    return Bundle(tuple(refs), tuple(summaries), phase, tuple(broken))


def bundle_with_cache(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> Bundle:
    """Reduce archives, or those of them that are not in the cache, and cache what was found.

    Raises:
        CacheError: the disk refuses.
    """
    store, used = where.store(refs[0].location), settings_digest(settings)
    for known in range(len(refs), 0, -1):
        begin = cached_bundle(refs[:known], settings, where)
        if begin is not None:
            break
    else:
        begin, known = None, 0
    if begin is not None and known == len(refs):
        return begin
    bundle = replace(reduce_bundle(refs, settings, begin), read=len(refs) - known)
    if not bundle.lasting:
        return bundle
    reasons = dict(bundle.broken)
    summaries = {one.ref: one for one in bundle.summaries}
    for ref in bundle.refs:
        found = summaries.get(ref)
        content = {"broken": reasons[ref.location]} if found is None else _summary_content(found)
        store.put(summary_key(ref, used), content)
    store.put(sum_key(refs, used), {"sum": _phase_content(bundle.phase)})
    if known:
        store.remove(sum_key(refs[:known], used))  # part of a longer one now
    return bundle


def _phase_content(phase: PhaseFactor | None) -> dict[str, Any] | None:
    if phase is None:
        return None
    return {
        "names": phase.parameter_names,
        "samples": phase.samples,
        "columns": phase.columns,
        "gram": [_triangle(gram) for gram in phase.gram],
    }


def _phase(content: Mapping[str, Any] | None) -> PhaseFactor | None:
    if content is None:
        return None
    return PhaseFactor(
        tuple(_square(one) for one in content["gram"]),
        tuple(content["columns"]),
        content["samples"],
        tuple(content["names"]),
    )


def _summary_content(summary: Summary) -> dict[str, Any]:
    return {
        "total": _phase_content(summary.total),
        "warnings": summary.warnings,
        "products": summary.products,
        "fits": {
            name: {each.name: getattr(fit.estimate, each.name) for each in fields(Estimate)}
            | {"covariance": _triangle(fit.estimate.covariance), "effect": fit.design_effect}
            for name, fit in summary.fits.items()
        },
    }


def _summary(content: Mapping[str, Any], ref: ArchiveRef) -> Summary:
    """The summary of an archive that may lie elsewhere by now."""
    total = _phase(content["total"])
    assert total is not None
    fits = {name: _fit(dict(one), total) for name, one in content["fits"].items()}
    return Summary(ref, total, fits, _interned(content["warnings"]), content["products"])


def _fit(content: dict[str, Any], total: PhaseFactor) -> Fit:
    """Words that most archives share are held once."""
    effect = content.pop("effect")
    content |= {
        "names": total.parameter_names,
        "units": tuple(content["units"]),
        "undetermined": _interned(content["undetermined"]),
        "method": intern(content["method"]),
        "covariance": _square(content["covariance"]),
    }
    return Fit(Estimate(**content), effect)


def _interned(words: Sequence[str]) -> tuple[str, ...]:
    return tuple(map(intern, words))


def _triangle(squares: NDArray[Any]) -> NDArray[Any]:
    """Lower triangles (..., k (k + 1) / 2) of symmetric matrices (..., k, k)."""
    row, column = _places(squares.shape[-1])
    return np.asarray(squares[..., row, column])


def _square(triangles: NDArray[Any]) -> NDArray[Any]:
    """The matrices of `_triangle`."""
    width = round((math.sqrt(8.0 * triangles.shape[-1] + 1.0) - 1.0) / 2.0)
    row, column = _places(width)
    found = np.empty((*triangles.shape[:-1], width, width))
    found[..., row, column] = triangles
    found[..., column, row] = triangles
    return found


@lru_cache(maxsize=64)
def _places(width: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the lower triangle of a square."""
    row, column = np.tril_indices(width)
    return row, column
