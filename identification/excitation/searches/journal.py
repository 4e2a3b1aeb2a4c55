"""What a search has scored so far, stored so that an interrupted search resumes bit-identically.

Layout: a line that names the format, then frames of length (8 bytes, little endian), CRC-32 (4
bytes) and that many bytes: first which search it belongs to (JSON), then for each generation its
genes (m, n_genes) and scores (m, ROW) as two numpy arrays (`.npy`, no pickles).
"""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from time import monotonic
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation.errors import JournalError
from identification.excitation.searches.scores import ROW, Scores

Array = NDArray[np.float64]

# Another release of any of these may draw or compute something else.
_DISTRIBUTIONS: Final = ("hil", "numpy", "scipy", "pymoo", "cma", "ruckig", "pin", "coal")
_FIRST_LINE: Final = b"hil search journal 2\n"
_FRAME: Final = struct.Struct("<QI")
# s; what the operating system has is safe from a crash of ours, what is synced from one of its own.
_SYNCED_EVERY: Final = 5.0


def versions() -> dict[str, str]:
    """Return the releases installed of everything that a search's numbers come from."""
    found = dict.fromkeys(_DISTRIBUTIONS, "not installed")
    for name in _DISTRIBUTIONS:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


class Journal:
    """Scores of a search in a file that only ever grows.

    Scores are found by their genes. Records from the first damaged one on are scored anew, as is a
    last one that was cut off while it was written. Where the disk takes no more, records wait in
    memory and are tried again with the next one: the search goes on.

    Args:
        file: binary, readable, writable and seekable, best without a buffer of its own; empty or
            an earlier journal of this search. It stays the caller's to close. One search at a
            time may use it.
        search: all that scores and genes depend on, data for JSON by name; releases are added.

    Attributes:
        recalled: how many motions were read from the file so far.
        damaged: how many bytes behind the last record that can be read are dropped.
        trouble: why records wait in memory, None while none do.

    Raises:
        JournalError: the file holds something else, or is the journal of another search, or of
            other software.
        OSError: it cannot be read, or a new one not be begun.
    """

    def __init__(self, file: BinaryIO, search: Mapping[str, Any]) -> None:
        self._file = file
        self.recalled = self.damaged = 0
        self.trouble: OSError | None = None
        self._known: dict[bytes, Array] = {}
        self._waiting = b""
        self._synced = monotonic()
        identity = json.dumps({**search, "versions": versions()}, sort_keys=True).encode()
        head = _FIRST_LINE + _framed(identity)
        file.seek(0)
        there = file.read()
        self._next = 0
        if head.startswith(there):  # empty, or cut off at once
            self._append(head)
            return
        if not there.startswith(_FIRST_LINE):
            raise JournalError("this file is not the journal of a search")
        theirs = _content(there, len(_FIRST_LINE))
        if theirs != identity:
            raise JournalError(
                "this journal belongs to another search: " + _difference(theirs, identity)
            )
        self._next = len(head)
        while (content := _content(there, self._next)) is not None:
            generation = _generation(content)
            if generation is not None:
                self._known[_key(generation[0])] = generation[1]
            self._next += _FRAME.size + len(content)
        self.damaged = len(there) - self._next

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


def _content(there: bytes, begin: int) -> bytes | None:
    """Return the content of the frame that begins here, None where there is no whole one."""
    if begin + _FRAME.size > len(there):
        return None
    length, checksum = _FRAME.unpack_from(there, begin)
    content = there[begin + _FRAME.size : begin + _FRAME.size + length]
    return content if len(content) == length and zlib.crc32(content) == checksum else None


def _key(genes: Array) -> bytes:
    return sha256(repr(genes.shape).encode() + np.asarray(genes, dtype="<f8").tobytes()).digest()


def _difference(theirs: bytes | None, ours: bytes) -> str:
    """Return the first part in which two searches differ."""
    try:
        there, here = json.loads(theirs or b""), json.loads(ours)
        for part in sorted({*there, *here}):
            old, new = there.get(part, {}), here.get(part, {})
            for name in sorted({*old, *new}):
                if old.get(name) != new.get(name):
                    return f"{part} {name} was {old.get(name)!r:.80}, is {new.get(name)!r:.80}"
    except (ValueError, TypeError, AttributeError, RecursionError):
        pass
    return "it does not say which"


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
