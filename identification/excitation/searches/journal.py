"""What a search has scored so far, stored so that an interrupted search resumes.

Nothing but scores is stored. A resumed search is the same search run once more: it asks for the
same genes in the same order, and takes from the journal what is there. The last bit of its
result is therefore that of a search nobody interrupted.

Layout: a line that names the format, then frames of length (8 bytes, little endian), CRC-32 (4
bytes) and that many bytes: first which search it belongs to (JSON), then for each generation its
genes (m, n_genes) and scores (m, ROW) as two numpy arrays (`.npy`, no pickles).
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import monotonic
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation.errors import ForeignJournalError, JournalError
from identification.excitation.searches.population import Problem, SearchSettings
from identification.excitation.searches.scores import ROW, Scores
from identification.model.robot import RobotModel

# Another release of any of these may draw or compute something else.
_DISTRIBUTIONS: Final = ("hil", "numpy", "scipy", "pymoo", "cma", "ruckig", "pin", "coal")


def digest(value: object) -> str:
    """Return the SHA-256 of what a value is made of: dataclasses, arrays and data.

    Other objects take part through their own `__reduce__`.

    Raises:
        TypeError: something in it has no description that is the same in every run.
    """
    summary = hashlib.sha256()
    _feed(summary, value)
    return summary.hexdigest()


def versions() -> dict[str, str]:
    """Return the releases installed of everything that a search's numbers come from."""
    found = {}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _feed(summary: hashlib._Hash, value: object) -> None:
    """Add a value, each part under its kind and size, so that no two values read alike."""
    if isinstance(value, RobotModel):
        # The rest of a model is computed from these, maybe with another last bit elsewhere.
        own = (value.chain, value.gravity, value.rotor_inertia, value.friction, value.payload)
        beside = (value.elements,) if value.elements.placed else ()
        _feed(summary, ("RobotModel", *own, *beside, value.parameter_names))
    elif isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        if array.dtype.hasobject:
            raise TypeError("an array of objects has no fingerprint")
        _head(summary, "array", array.dtype.str, *array.shape)
        summary.update(np.ascontiguousarray(array).tobytes())
    elif value is None or isinstance(value, bool | int | float | str | Path):
        text = str(value) if isinstance(value, Path) else repr(value)
        _head(summary, type(value).__name__, len(text.encode()))
        summary.update(text.encode())
    elif isinstance(value, tuple | list):
        _head(summary, "sequence", len(value))
        for item in value:
            _feed(summary, item)
    elif isinstance(value, Mapping):
        _feed(summary, ("mapping", *sorted(value.items())))
    elif is_dataclass(value) and not isinstance(value, type):
        named = [(field.name, getattr(value, field.name)) for field in fields(value) if field.init]
        _feed(summary, (_name(type(value)), *named))
    elif type(value).__reduce__ is not object.__reduce__:
        reduced = value.__reduce__()
        if isinstance(reduced, str):
            raise TypeError(f"{type(value).__qualname__} has no fingerprint")
        _feed(summary, (_name(reduced[0]), reduced[1]))
    else:
        raise TypeError(f"{type(value).__qualname__} has no fingerprint")


def _head(summary: hashlib._Hash, *words: object) -> None:
    summary.update((" ".join(map(str, words)) + "\n").encode())


def _name(thing: object) -> str:
    return f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', '')}"


Array = NDArray[np.float64]

_FIRST_LINE: Final = b"hil search journal 1\n"
_NAMELESS: Final = "this journal does not say which search it belongs to"
_FRAME: Final = struct.Struct("<QI")
# s; what the operating system has is safe from a crash of ours, what is synced from one of its own.
_SYNCED_EVERY: Final = 5.0


class Journal:
    """Scores of a search in a file that only ever grows.

    Scores are found by their genes. Records from the first damaged one on are scored anew, as is a
    last one that was cut off while it was written. Where the disk takes no more, records wait in
    memory and are tried again with the next one: the search goes on.

    Args:
        file: binary, readable, writable and seekable, best without a buffer of its own; empty or
            an earlier journal of this search. It stays the caller's to close. One search at a
            time may use it.
        problem: of the search.
        settings: of the search.

    Attributes:
        recalled: how many motions were read from the file so far.
        damaged: how many bytes behind the last record that can be read are dropped.
        trouble: why records wait in memory, None while none do.

    Raises:
        JournalError: the file holds something else.
        ForeignJournalError: it is the journal of another search, or of other software.
        OSError: it cannot be read, or a new one not be begun.
    """

    def __init__(self, file: BinaryIO, problem: Problem, settings: SearchSettings) -> None:
        self._file = file
        self.recalled = self.damaged = 0
        self.trouble: OSError | None = None
        self._known: dict[bytes, Array] = {}
        self._waiting = b""
        self._synced = monotonic()
        ours = identity(problem, settings)
        head = _FIRST_LINE + _framed(json.dumps(ours, sort_keys=True).encode())
        file.seek(0)
        there = file.read()
        if head.startswith(there):  # empty, or cut off at once
            self._next = 0
            self._append(head)
            return
        if not there.startswith(_FIRST_LINE):
            raise JournalError("this file is not the journal of a search")
        content = _content(there, len(_FIRST_LINE))
        _compare(_identity(content), ours)
        self._next = len(_FIRST_LINE) + _FRAME.size + len(content or b"")
        self._read(there)

    def recall(self, genes: Array) -> Scores | None:
        """Return the recorded scores of genes (m, n_genes), None where there are none."""
        rows = self._known.get(_key(genes))
        if rows is None:
            return None
        self.recalled += len(genes)
        return Scores.of_rows(rows)

    def record(self, genes: Array, scores: Scores) -> None:
        """Append the scores of genes (m, n_genes), as soon as the disk takes them."""
        content = io.BytesIO()
        for array in (genes, scores.rows):
            np.save(content, np.asarray(array, dtype="<f8"), allow_pickle=False)
        self._waiting += _framed(content.getvalue())
        self._write(sync=monotonic() - self._synced >= _SYNCED_EVERY)

    def close(self) -> None:
        """Bring all that waits onto the disk, as far as it can be; the file stays open."""
        self._write(sync=True)

    def _write(self, *, sync: bool) -> None:
        try:
            self._append(self._waiting)
            self._waiting = b""
            if sync:
                with suppress(io.UnsupportedOperation):  # a file in memory
                    os.fsync(self._file.fileno())
                self._synced = monotonic()
            self.trouble = None
        except OSError as error:
            self.trouble = error

    def _append(self, content: bytes) -> None:
        """Put bytes where the next record belongs, and nothing behind them."""
        self._file.seek(self._next)
        self._file.truncate()
        left = memoryview(content)
        while left:  # an unbuffered file may take a part
            left = left[self._file.write(left) :]
        self._file.flush()
        self._next += len(content)

    def _read(self, there: bytes) -> None:
        """Take in every record up to the first damaged one, in whose place the next one belongs."""
        while (content := _content(there, self._next)) is not None:
            generation = _generation(content)
            if generation is not None:
                self._known[_key(generation[0])] = generation[1]
            self._next += _FRAME.size + len(content)
        self.damaged = len(there) - self._next


def _content(there: bytes, begin: int) -> bytes | None:
    """Return the content of the frame that begins here, None where there is no whole one."""
    if begin + _FRAME.size > len(there):
        return None
    length, checksum = _FRAME.unpack_from(there, begin)
    content = there[begin + _FRAME.size : begin + _FRAME.size + length]
    return content if len(content) == length and zlib.crc32(content) == checksum else None


def _key(genes: Array) -> bytes:
    return sha256(repr(genes.shape).encode() + np.asarray(genes, dtype="<f8").tobytes()).digest()


def identity(problem: Problem, settings: SearchSettings) -> dict[str, Any]:
    """Return what must be the same for two searches to ask for the same genes and scores."""
    return {
        "settings": json.loads(json.dumps(asdict(settings))),
        "problem": {
            "genome": digest(problem.genome),
            "objective": digest(problem.objective),
            "constraints": digest(problem.constraints),
            "period": digest(problem.period),
        },
        "versions": versions(),
    }


def _compare(there: dict[str, Any], ours: dict[str, Any]) -> None:
    """Raise ForeignJournalError at the first difference, JournalError where there is no sense."""
    parts = {part: there.get(part, {}) for part in ("problem", "settings", "versions")}
    if not all(isinstance(theirs, dict) for theirs in parts.values()):
        raise JournalError(_NAMELESS)
    for part, theirs in parts.items():
        for name in sorted({*theirs, *ours[part]}):
            if theirs.get(name) != ours[part].get(name):
                raise ForeignJournalError(part, name, theirs.get(name), ours[part].get(name))


def _identity(content: bytes | None) -> dict[str, Any]:
    try:
        found = json.loads(content or b"")
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise JournalError(_NAMELESS)
    return found


def _generation(content: bytes) -> tuple[Array, Array] | None:
    """Return genes and rows of scores, None where a frame holds something else."""
    stream = io.BytesIO(content)
    try:
        genes, rows = (np.lib.format.read_array(stream, allow_pickle=False) for _ in range(2))
    except Exception:  # there is little that a forged header does not raise
        return None
    if genes.ndim != 2 or rows.shape != (len(genes), ROW) or rows.dtype != np.float64:
        return None
    return (genes, rows) if genes.dtype.kind in "fiu" else None


def _framed(content: bytes) -> bytes:
    return _FRAME.pack(len(content), zlib.crc32(content)) + content
