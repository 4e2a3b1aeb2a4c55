"""What a search has scored so far, kept so that an interrupted search goes on where it was.

Nothing but scores is kept. A resumed search is the same search run once more: it asks for the
same genes in the same order, and takes from the journal what is there. The last bit of its
result is therefore that of a search nobody interrupted.

Layout: a line that names the format, then frames of length (8 bytes, little endian), CRC-32 (4
bytes) and that many bytes: first which search it belongs to (JSON), then for each generation its
genes (m, n_genes) and scores (m, ROW) as two numpy arrays (`.npy`, no pickles).
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from dataclasses import asdict
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from identification.excitation.errors import ForeignJournalError, JournalError
from identification.excitation.searches.digest import digest, versions
from identification.excitation.searches.problem import Problem
from identification.excitation.searches.scores import ROW, Scores
from identification.excitation.searches.settings import SearchSettings

Array = NDArray[np.float64]

_FIRST_LINE: Final = b"hil search journal 1\n"
_FRAME: Final = struct.Struct("<QI")


class Journal:
    """Scores of a search in a file that only ever grows.

    A last record that was cut off while it was written is dropped.

    Args:
        file: binary, readable, writable and seekable, empty or an earlier journal of this search;
            it stays the caller's to close. One search at a time may use it.
        problem: of the search.
        settings: of the search.

    Raises:
        JournalError: the file holds something else.
        ForeignJournalError: it is the journal of another search, or of other software.
    """

    def __init__(self, file: BinaryIO, problem: Problem, settings: SearchSettings) -> None:
        self._file = file
        self.recalled = 0
        ours = identity(problem, settings)
        head = _FIRST_LINE + _framed(json.dumps(ours, sort_keys=True).encode())
        file.seek(0)
        there = file.read(len(head))
        if len(there) < len(head) and head.startswith(there):  # empty, or cut off at once
            self._next = 0
            self._append(head)
            return
        if not there.startswith(_FIRST_LINE):
            raise JournalError("this file is not the journal of a search")
        self._next = len(_FIRST_LINE)
        _compare(_identity(self._read()), ours)

    def recall(self, genes: Array) -> Scores | None:
        """Return the recorded scores of genes (m, n_genes) if these are what comes next.

        None if other genes or none were recorded; `record` then writes over what follows.
        """
        before = self._next
        recorded = _generation(self._read())
        if recorded is None or not _same_bits(recorded[0], genes):
            self._next = before
            return None
        self.recalled += len(genes)
        return Scores.of_rows(recorded[1])

    def record(self, genes: Array, scores: Scores) -> None:
        """Append the scores of genes (m, n_genes)."""
        content = io.BytesIO()
        for array in (genes, scores.rows):
            np.save(content, np.asarray(array, dtype="<f8"), allow_pickle=False)
        self._append(_framed(content.getvalue()))

    def _append(self, content: bytes) -> None:
        """Put bytes where the next record belongs, and nothing behind them."""
        self._file.seek(self._next)
        self._file.truncate()
        self._file.write(content)
        self._file.flush()
        self._next += len(content)

    def _read(self) -> bytes | None:
        """Return the next frame's content, None where there is no whole one."""
        self._file.seek(self._next)
        head = self._file.read(_FRAME.size)
        if len(head) < _FRAME.size:
            return None
        length, checksum = _FRAME.unpack(head)
        behind = self._file.seek(0, io.SEEK_END) - self._next - _FRAME.size
        if length > behind:
            return None
        self._file.seek(self._next + _FRAME.size)
        content = self._file.read(length)
        if zlib.crc32(content) != checksum:
            return None
        self._next += _FRAME.size + length
        return content


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
    """Raise ForeignJournalError at the first difference."""
    for part in ("problem", "settings", "versions"):
        theirs = there.get(part, {})
        for name in sorted({*theirs, *ours[part]}):
            if theirs.get(name) != ours[part].get(name):
                raise ForeignJournalError(part, name, theirs.get(name), ours[part].get(name))


def _identity(content: bytes | None) -> dict[str, Any]:
    try:
        found = json.loads(content or b"")
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise JournalError("this journal does not say which search it belongs to")
    return found


def _generation(content: bytes | None) -> tuple[Array, Array] | None:
    """Return genes and rows of scores, None where a frame holds something else."""
    if content is None:
        return None
    stream = io.BytesIO(content)
    try:
        genes, rows = (np.load(stream, allow_pickle=False) for _ in range(2))
    except (ValueError, EOFError):
        return None
    if genes.ndim != 2 or rows.shape != (len(genes), ROW) or rows.dtype != np.float64:
        return None
    return genes, rows


def _same_bits(recorded: Array, genes: Array) -> bool:
    return recorded.shape == genes.shape and recorded.tobytes() == genes.tobytes()


def _framed(content: bytes) -> bytes:
    return _FRAME.pack(len(content), zlib.crc32(content)) + content
