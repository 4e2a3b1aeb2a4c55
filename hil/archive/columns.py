"""Columns that grow as chunks arrive."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.archive.cdr import MessageLayout

Bytes = NDArray[np.uint8]

_FIRST_CAPACITY = 4096
_STAMP = ("sec", "nanosec")


class _Block(NamedTuple):
    """Fields of one type that lie side by side in a message: copied together, as bytes."""

    names: list[str]
    start: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    raw: np.dtype[np.void]

    @property
    def end(self) -> int:
        return self.start + len(self.names) * self.raw.itemsize


class Columns:
    """Contiguous arrays, one per field of a message, appended to chunk by chunk.

    Args:
        layout: the messages; their time stamp becomes the column ``stamp`` in nanoseconds.
        fields: fields wanted.
    """

    def __init__(self, layout: MessageLayout, fields: Collection[str]) -> None:
        self._stamp = layout.dtype[list(_STAMP)]
        self._blocks = _blocks(layout, fields)
        self._places = [(slice(block.start, block.end), block.raw) for block in self._blocks]
        self._stamps = np.empty(0, np.int64)
        self._arrays = [np.empty((len(block.names), 0), block.raw) for block in self._blocks]
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, messages: Bytes, expected: int = 0) -> None:
        """Append messages, shape (k, size); `expected` is a guess at the final count."""
        count = len(messages)
        now = slice(self._count, self._count + count)
        if now.stop > len(self._stamps):
            self._grow(max(_FIRST_CAPACITY, now.stop, 2 * self._count, expected))
        self._stamps[now] = self.stamps(messages)
        for (place, raw), array in zip(self._places, self._arrays, strict=True):
            array[:, now] = messages[:, place].view(raw).T
        self._count += count

    def stamps(self, messages: Bytes) -> NDArray[np.int64]:
        """Time stamps of messages, shape (k,) [ns]."""
        stamp = messages.view(self._stamp)[:, 0]
        stamps = np.multiply(stamp["sec"], 10**9, dtype=np.int64)
        stamps += stamp["nanosec"]
        return np.asarray(stamps)

    def finished(self) -> dict[str, NDArray[Any]]:
        """The columns, contiguous and read-only."""
        columns: dict[str, NDArray[Any]] = {"stamp": self._stamps[: self._count]}
        for block, array in zip(self._blocks, self._arrays, strict=True):
            fields = array.view(block.dtype).reshape(*array.shape, *block.shape)
            for name, values in zip(block.names, fields, strict=True):
                columns[name] = values[: self._count]
        for column in columns.values():
            column.flags.writeable = False
        return columns

    def _grow(self, capacity: int) -> None:
        stamps = np.empty(capacity, np.int64)
        stamps[: self._count] = self._stamps[: self._count]
        self._stamps = stamps
        for index, array in enumerate(self._arrays):
            grown = np.empty((len(array), capacity), array.dtype)
            grown[:, : self._count] = array[:, : self._count]
            self._arrays[index] = grown


def _blocks(layout: MessageLayout, fields: Collection[str]) -> list[_Block]:
    """Gather the wanted fields into blocks of neighbours."""
    blocks: list[_Block] = []
    places: Mapping[str, Any] = layout.dtype.fields or {}
    for name, (dtype, start, *_) in places.items():
        if name in _STAMP or name not in fields:
            continue
        base, shape = dtype.subdtype or (dtype, ())
        last = blocks[-1] if blocks else None
        if last and (last.end, last.dtype, last.shape) == (start, base, shape):
            last.names.append(name)
        else:
            raw = np.dtype((np.void, base.itemsize * math.prod(shape)))
            blocks.append(_Block([name], start, base, shape, raw))
    return blocks
