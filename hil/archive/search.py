"""Search for the records behind damage, where the length of a record does not lead to the next.

The beginning of a chunk, an attachment or a metadata record of the profile hardly occurs elsewhere,
and its checksum decides.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import BinaryIO, Final

from mcap.records import Metadata

from hil.archive import container
from hil.archive.container import RECORD, Damage, Head, Record
from hil.archive.header import METADATA, OUTCOME, checksum

MOST_SEARCHED: Final = 1 << 26  # bytes, beside as many as whole records have

_BLOCK = 1 << 14  # bytes read at once
_ZEROS = bytes(_BLOCK)
_BEGINS: Final = re.compile(
    # a chunk: length, times, size of the content, checksum, compression, length of the data
    rb"\x06.{4}\0{4}.{16}.{4}\0{4}.{4}\x04\0{3}zstd.{4}\0{4}"
    # an attachment: length, times, which are zero, length of the name
    rb"|\x09.{4}\0{4}\0{16}.\0{3}"
    # header and outcome: length, name
    rb"|\x0c.{4}\0{4}(?:\x03\0{3}hil|\x0b\0{3}hil\.outcome)",
    re.DOTALL,
)
_LONGEST = 53  # bytes of such a beginning, that of a chunk


def verified_metadata(record: Record) -> tuple[str, dict[str, str]]:
    """Return name and entries, without the checksum that they must have if they are ours."""
    found = container.parse(Metadata, record)
    ours, entries = found.name in (METADATA, OUTCOME), found.metadata
    if ours and entries.pop("checksum", None) != checksum(entries):
        raise Damage(record.offset, f"(metadata {found.name!r}) fails its checksum")
    return found.name, entries


def verify(record: Record) -> None:
    """Raise `Damage` if a record with content fails its checksum, or cannot be parsed."""
    if record.opcode == container.CHUNK:
        container.chunk_data(container.parse_chunk(record), record.offset)
    elif record.opcode == container.METADATA:
        verified_metadata(record)
    else:
        container.parse_item(record)


def find_records(stream: BinaryIO, start: int, size: int) -> Iterator[Head]:
    """Yield the heads of records with a checksum from `start` on, in a file of `size` bytes.

    Records that fail it are yielded as well, to be named; the search continues within them. It ends
    after `MOST_SEARCHED` bytes, among which what was checked in vain counts.
    """
    at, left = start, MOST_SEARCHED
    while at < size and left > 0:
        stream.seek(at)
        block = stream.read(_BLOCK)
        match = None if block == _ZEROS else _BEGINS.search(block)  # as after a power failure
        if match is None and len(block) < _BLOCK:
            return
        passed = match.start() if match else len(block) - _LONGEST + 1
        at, left = at + passed, left - passed
        if match is None:
            continue
        opcode, length = RECORD.unpack_from(match[0])
        head = Head(opcode, at, at + RECORD.size + length)
        data = int.from_bytes(match[0][-8:], "little")
        if head.end <= size and (opcode != container.CHUNK or head.end == at + _LONGEST + data):
            yield head
            try:
                verify(container.read_record(stream, head))
                at, left = head.end, left + head.end - at
                continue
            except Damage:
                left -= head.end - at
        at, left = at + 1, left - len(block)
