"""Archives changed as tests need them, byte by byte."""

from __future__ import annotations

import zlib
from pathlib import Path

from hil.archive import container


def with_attachment(source: Path, target: Path, old: str, new: str) -> Path:
    """A copy with other words, of the same length, in an attachment; its checksum is right."""
    assert len(old.encode()) == len(new.encode())
    data = bytearray(source.read_bytes())
    at, changed = len(container.MAGIC), 0
    while at + container.RECORD.size < len(data):
        opcode, length = container.RECORD.unpack_from(data, at)
        begin, end = at + container.RECORD.size, at + container.RECORD.size + length
        if opcode == container.ATTACHMENT and old.encode() in data[begin:end]:
            content = bytes(data[begin : end - 4]).replace(old.encode(), new.encode())
            data[begin:end] = content + zlib.crc32(content).to_bytes(4, "little")
            changed += 1
        at = end
    assert changed == 1
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
    return target
