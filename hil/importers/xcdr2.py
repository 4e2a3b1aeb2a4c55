"""Messages in version 2 of CDR, rewritten in version 1, which `rosbags` decodes.

Version 2 aligns numbers of eight bytes to four, and writes the size of a list or an array of
strings or of structures before it (OMG DDS-XTypes 1.3, 7.4.3.5).
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_SIMPLE: Final = (b"\x00\x06", b"\x00\x07")
_DELIMITED: Final = (b"\x00\x08", b"\x00\x09")
"""Also with the size of each structure before it: their types may get further fields."""
_SIZES: Final = {
    **dict.fromkeys(("bool", "byte", "char", "octet", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
_MAX_ALIGNMENT: Final = 4  # bytes
_HEADER_BYTES: Final = 4  # bytes of the encapsulation


def is_version_2(data: bytes) -> bool:
    """Return whether a message is in a form of version 2 that can be rewritten."""
    return data[:2] in (*_SIMPLE, *_DELIMITED)


def in_version_1(data: bytes, kind: str, store: Typestore) -> bytes:
    """Return a message of this type in version 1.

    Raises:
        ValueError: it is shorter than its type, or has another type of field.
    """
    message = _Rewritten(data, store)
    try:
        message.structure(kind)
    except (struct.error, IndexError, KeyError) as error:
        raise ValueError(f"not of type {kind}: {error}") from error
    return message.data


class _Rewritten:
    """A message that is read in version 2 and written in version 1."""

    def __init__(self, data: bytes, store: Typestore) -> None:
        self._source = data[_HEADER_BYTES:]
        self._store = store
        self._at = 0
        self._is_delimited = data[:2] in _DELIMITED
        little = data[1] & 1
        self._length = struct.Struct("<I" if little else ">I")
        self._written = bytearray()
        self._head = bytes((0, little, 0, 0))

    @property
    def data(self) -> bytes:
        """What was written."""
        return self._head + bytes(self._written)

    def structure(self, kind: str) -> None:
        """Rewrite a structure."""
        if self._is_delimited:
            self._read_length()
        for _, node in self._store.fielddefs[kind][1]:
            self._field(node)

    def _field(self, node: Any) -> None:
        nature, content = node
        if nature == Nodetype.BASE:
            self._base(content[0])
        elif nature == Nodetype.NAME:
            self.structure(content)
        elif nature == Nodetype.ARRAY:
            self._elements(content[0], content[1], is_list=False)
        else:
            self._elements(content[0], 0, is_list=True)

    def _elements(self, node: Any, count: int, *, is_list: bool) -> None:
        nature, content = node
        size = _SIZES.get(content[0]) if nature == Nodetype.BASE else None
        if size is None:
            self._read_length()  # of all elements in bytes
        if is_list:
            count = self._read_length()
            self._write_length(count)
        if size is None:
            for _ in range(count):
                self._field(node)
        elif count:
            self._copy(size, count)

    def _base(self, name: str) -> None:
        if name == "string":
            length = self._read_length()
            self._write_length(length)
            self._written += self._next(length)
        else:
            self._copy(_SIZES[name], 1)

    def _copy(self, size: int, count: int) -> None:
        """Copy numbers of this size."""
        self._align(size)
        self._written += bytes(-len(self._written) % size)
        self._written += self._next(size * count)

    def _read_length(self) -> int:
        self._align(self._length.size)
        return int(self._length.unpack(self._next(self._length.size))[0])

    def _write_length(self, length: int) -> None:
        self._written += bytes(-len(self._written) % self._length.size)
        self._written += self._length.pack(length)

    def _align(self, size: int) -> None:
        self._at += -self._at % min(size, _MAX_ALIGNMENT)

    def _next(self, count: int) -> bytes:
        end = self._at + count
        if end > len(self._source):
            raise IndexError(f"it ends after {len(self._source)} bytes")
        part = self._source[self._at : end]
        self._at = end
        return part
