"""Stored scores of a search, from which an interrupted search resumes bit-identically.

Layout: a line with the format, then frames of length (8 bytes, little endian), CRC-32 (4 bytes)
and content: first the identity of the search (JSON), then for each generation its genes
(m, n_genes) and scores (m, ROW) as two numpy arrays (`.npy`, no pickles).
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from typing import Any, BinaryIO, Final

import numpy as np

from identification.arrays import Array
from identification.excitation.errors import JournalError
from identification.excitation.searches.population import Scores

# Packages whose release may change the numbers of a search.
_DISTRIBUTIONS: Final = ("hil", "numpy", "scipy", "pymoo", "ruckig", "pin", "coal")
_FIRST_LINE: Final = b"hil search journal 2\n"
_FRAME: Final = struct.Struct("<QI")


def versions() -> dict[str, str]:
    """Return the installed releases of the packages that determine a search's numbers."""
    releases = dict.fromkeys(_DISTRIBUTIONS, "not installed")
    for name in _DISTRIBUTIONS:
        with suppress(PackageNotFoundError):
            releases[name] = version(name)
    return releases


class Journal:
    """Append-only binary file of the scores of a search, found by their genes.

    The file is unbuffered, empty or an earlier journal of this search, and closed by the caller.
    `search` has tables by name of all that scores depend on, for JSON. Records after a damaged one
    are dropped; a record that the disk refuses is left out.

    Attributes:
        recalled: number of motions whose scores were read from the file.
        damaged: number of dropped bytes after the last valid record.
        error: why the last record was not written, None if it was.

    Raises:
        JournalError: the file is not a journal, or belongs to another search or software.
        OSError: it cannot be read or started.
    """

    def __init__(self, file: BinaryIO, search: Mapping[str, Any]) -> None:
        self._file = file
        self.recalled = self.damaged = 0
        self.error: OSError | None = None
        self._rows: dict[bytes, Array] = {}
        identity = json.dumps({**search, "versions": versions()}, sort_keys=True).encode()
        head = _FIRST_LINE + _framed(identity)
        file.seek(0)
        stored = file.read()
        self._next = 0
        if head.startswith(stored):  # empty or truncated
            self._append(head)
            return
        if not stored.startswith(_FIRST_LINE):
            raise JournalError("this file is not the journal of a search")
        other = _content(stored, len(_FIRST_LINE))
        if other != identity:
            raise JournalError(
                "this journal belongs to another search: " + _difference(other, identity)
            )
        self._next = len(head)
        while (content := _content(stored, self._next)) is not None:
            stream = io.BytesIO(content)
            genes, rows = (np.load(stream, allow_pickle=False) for _ in range(2))
            self._rows[_key(genes)] = rows
            self._next += _FRAME.size + len(content)
        self.damaged = len(stored) - self._next

    def recall(self, genes: Array) -> Scores | None:
        """Return the recorded scores of genes (m, n_genes), or None."""
        rows = self._rows.get(_key(genes))
        if rows is None:
            return None
        self.recalled += len(genes)
        return Scores.of_rows(rows)

    def record(self, genes: Array, scores: Scores) -> None:
        """Append the scores of genes (m, n_genes)."""
        content = io.BytesIO()
        for array in (genes, scores.rows):
            np.save(content, np.asarray(array, dtype="<f8"), allow_pickle=False)
        try:
            self._append(_framed(content.getvalue()))
            self.error = None
        except OSError as error:
            self.error = error

    def _append(self, content: bytes) -> None:
        """Write content after the last valid record and truncate the file there."""
        self._file.seek(self._next)
        self._file.truncate()
        unwritten = memoryview(content)
        while unwritten:  # an unbuffered file may take a part
            unwritten = unwritten[self._file.write(unwritten) :]
        self._file.flush()
        self._next += len(content)


def _content(stored: bytes, begin: int) -> bytes | None:
    """Return the content of the frame that begins here, None if it is incomplete."""
    if begin + _FRAME.size > len(stored):
        return None
    length, checksum = _FRAME.unpack_from(stored, begin)
    content = stored[begin + _FRAME.size : begin + _FRAME.size + length]
    return content if len(content) == length and zlib.crc32(content) == checksum else None


def _key(genes: Array) -> bytes:
    return sha256(np.asarray(genes, dtype="<f8").tobytes()).digest()


def _difference(stored: bytes | None, identity: bytes) -> str:
    """Return the first difference between the identities of two searches."""
    if stored is None:
        return "its identity is damaged"
    old, new = (
        {
            (part, name): value
            for part, table in identity_tables.items()
            for name, value in table.items()
        }
        for identity_tables in (json.loads(stored), json.loads(identity))
    )
    first = min(key for key in old.keys() | new.keys() if old.get(key) != new.get(key))
    return f"{' '.join(first)} was {old.get(first)!r:.80}, is {new.get(first)!r:.80}"


def _framed(content: bytes) -> bytes:
    return _FRAME.pack(len(content), zlib.crc32(content)) + content
