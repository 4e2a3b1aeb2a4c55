"""Changes of MCAP files (https://mcap.dev/spec) with valid checksums.

A file is a list of records; a chunk is a record with such a list. After a change lengths, checksums
and (in most files) the index are recomputed.
"""

from __future__ import annotations

import contextlib
import random
import struct
import zlib
from dataclasses import dataclass, field

import lz4.frame
import zstandard
from mcap.records import Attachment, Chunk, Metadata

from hil.archive import container, header
from hil.archive.container import Damage, encode
from hil.archive.header import format_chunk_list
from tests.fuzz.draw import mutate_bytes, mutate_text
from tests.hil.mcap_bytes import Indexed
from tests.hil.mcap_bytes import record as record_of

_MESSAGE = struct.Struct("<HIQQ")
_PACKED = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}


@dataclass
class Record:
    """One record; of a chunk also the records inside, where readable."""

    opcode: int
    body: bytes
    inside: list[Record] | None = None
    compression: str = ""
    times: tuple[int, int] = field(default=(0, 0))

    @property
    def content(self) -> bytes:
        """The records inside as bytes."""
        return b"".join(record_of(each.opcode, each.body) for each in self.inside or ())


def mutate_mcap(data: bytes, most: int, seed: int) -> bytes:
    """Change one to three records; of a tenth of the inputs any bytes, without checksums."""
    rng = random.Random(seed)
    records = split_file(data) if rng.random() > 0.1 else None
    if not records:
        return mutate_bytes(data, most, seed)
    for _ in range(rng.choice((1, 1, 2, 3))):
        _change(records, rng)
    with contextlib.suppress(Exception):  # without an index if none can be written
        sealed = join_file(records, index=rng.random() < 0.8)
        return sealed if len(sealed) <= most else data
    return join_file(records, index=False)[:most]


def split_file(data: bytes) -> list[Record] | None:
    """Return the records of the data section; None if it is no MCAP file."""
    if not data.startswith(container.MAGIC):
        return None
    records = []
    for opcode, body in split_records(data[len(container.MAGIC) :]):
        if opcode in (container.DATA_END, container.FOOTER):
            break
        if opcode != container.MESSAGE_INDEX:
            records.append(_opened(opcode, body))
    return records


def split_records(data: bytes) -> list[tuple[int, bytes]]:
    """Return opcodes and bodies up to the first invalid record."""
    found: list[tuple[int, bytes]] = []
    with contextlib.suppress(Damage):
        found.extend((record.opcode, record.body) for record in container.split_records(data, 0))
    return found


def _opened(opcode: int, body: bytes) -> Record:
    with contextlib.suppress(Damage):  # another record, or an unreadable chunk
        if opcode == container.CHUNK:
            head = container.parse_chunk(container.Record(0, opcode, body))
            inside = [Record(*piece) for piece in split_records(container.decompress(head, 0))]
            times = head.message_start_time, head.message_end_time
            return Record(opcode, body, inside, head.compression, times)
    return Record(opcode, body)


def join_file(records: list[Record], *, index: bool) -> bytes:
    """Return the file with valid lengths and checksums, with or without index."""
    built = Indexed()
    file = built.data
    described = _described(records)
    for one in records:
        body = _sealed(
            one, {header.DESCRIPTION: described, header.CHUNKS: format_chunk_list(built.checksums)}
        )
        if index:
            built.put(record_of(one.opcode, body))
            continue
        if one.opcode == container.CHUNK:
            with contextlib.suppress(Damage):
                head = container.parse_chunk(container.Record(0, one.opcode, body))
                built.checksums.append(head.uncompressed_crc)
        file += record_of(one.opcode, body)
    if index:
        return built.ended()
    end = record_of(container.DATA_END, bytes(4)) + record_of(container.FOOTER, bytes(20))
    return bytes(file) + end + container.MAGIC


def _described(records: list[Record]) -> str:
    """Return the checksum of the description, which the outcome repeats."""
    for one in records:
        with contextlib.suppress(Damage):  # unreadable
            name, entries = entries_of(one) if one.opcode == container.METADATA else ("", {})
            if name == header.METADATA:
                entries.pop("checksum", None)
                return header.checksum(entries)
    return ""


def _sealed(one: Record, seals: dict[str, str]) -> bytes:
    """Return the body with valid checksums and entries of the outcome."""
    if one.inside is not None:
        data = one.content
        packed = _PACKED.get(one.compression, bytes)(data)
        start, end = one.times
        return body_of(Chunk(one.compression, packed, end, start, zlib.crc32(data), len(data)))
    if one.opcode == container.ATTACHMENT and len(one.body) > 4:
        return one.body[:-4] + zlib.crc32(one.body[:-4]).to_bytes(4, "little")
    if one.opcode == container.METADATA:
        with contextlib.suppress(Damage):  # unreadable
            name, entries = entries_of(one)
            if entries.pop("checksum", None) is not None:
                entries |= {key: seals[key] for key in seals if key in entries}
                return body_of(Metadata(name, header.with_checksum(entries)))
    return one.body


def body_of(record: Attachment | Chunk | Metadata) -> bytes:
    return encode(record)[container.RECORD.size :]


def entries_of(one: Record) -> tuple[str, dict[str, str]]:
    return container.parse_metadata(container.Record(0, one.opcode, one.body))


def _change(records: list[Record], rng: random.Random) -> None:
    one = rng.choice(records)
    kind = rng.random()
    if kind < 0.12:
        _shuffled(records, rng)
    elif one.inside:
        if rng.random() < 0.15:
            one.times = (rng.choice((0, *one.times, 1 << 63)), rng.choice((*one.times, 0)))
        elif rng.random() < 0.2:
            one.compression = rng.choice(("", "zstd", "lz4", "gzip"))
        elif rng.random() < 0.25:
            _shuffled(one.inside, rng)
        else:
            for message in rng.sample(one.inside, min(len(one.inside), rng.choice((1, 1, 3, 50)))):
                _of_a_message(message, rng)
    elif one.opcode == container.METADATA:
        _of_metadata(one, rng)
    elif one.opcode == container.ATTACHMENT:
        _of_an_attachment(one, rng)
    elif one.opcode in (container.SCHEMA, container.CHANNEL) and rng.random() < 0.7:
        words = mutate_text(one.body[4:], len(one.body) + 200, rng.getrandbits(32))
        one.body = one.body[:4] + words
    else:
        one.body = mutate_bytes(one.body, len(one.body) + 64, rng.getrandbits(32))


def _shuffled(records: list[Record], rng: random.Random) -> None:
    if not records:
        return
    at, other = rng.randrange(len(records)), rng.randrange(len(records))
    kind = rng.randrange(4)
    if kind == 0 and len(records) > 1:
        del records[at]
    elif kind == 1:
        one = records[at]
        copy = Record(one.opcode, one.body, None, one.compression, one.times)
        copy.inside = None if one.inside is None else [Record(r.opcode, r.body) for r in one.inside]
        records.insert(other, copy)
    elif kind == 2:
        records[at], records[other] = records[other], records[at]
    else:
        records[at].opcode = rng.choice((*range(1, 16), 0x80, 0))


def _of_a_message(message: Record, rng: random.Random) -> None:
    if message.opcode != container.MESSAGE or len(message.body) < _MESSAGE.size:
        message.body = mutate_bytes(message.body, len(message.body) + 64, rng.getrandbits(32))
        return
    head = list(_MESSAGE.unpack_from(message.body))
    data = message.body[_MESSAGE.size :]
    kind = rng.randrange(6)
    if kind < 4:
        strange = (0, 1, head[kind] + 1, head[kind] - 1, 2**63, 2**16 - 1, 2**32 - 1)
        limit = (1 << 16, 1 << 32, 1 << 64, 1 << 64)[kind]
        head[kind] = rng.choice(strange) % limit
        if kind > 1 and rng.random() < 0.7:
            head[2] = head[3] = head[kind]
    elif kind == 4:
        data = mutate_bytes(data, len(data) + 64, rng.getrandbits(32))
    else:
        changed = bytearray(data)
        at = rng.randrange(max(1, len(changed) // 8)) * 8 + 4
        value = rng.choice((float("nan"), float("inf"), -1e308, 1e308, 0.0, 5e-324))
        changed[at : at + 8] = struct.pack("<d", value)
        data = bytes(changed)
    message.body = _MESSAGE.pack(*head) + data


def _of_metadata(one: Record, rng: random.Random) -> None:
    try:
        name, entries = entries_of(one)
    except Damage:
        one.body = mutate_bytes(one.body, len(one.body) + 64, rng.getrandbits(32))
        return
    key = rng.choice([*entries, "period", "joint_names", "kind"])
    if rng.random() < 0.2:
        entries.pop(key, None)
    else:
        changed = mutate_text(entries.get(key, "").encode() or b"0", 6000, rng.getrandbits(32))
        entries[key] = changed.decode("utf-8", "replace")
    one.body = body_of(Metadata(name, entries))


def _of_an_attachment(one: Record, rng: random.Random) -> None:
    try:
        found = container.parse(Attachment, container.Record(0, one.opcode, one.body))
    except Damage:
        return
    if rng.random() < 0.1:
        names = ("../../x", "/dev/zero", "", "plan.json", "cell.toml", "init_packet.bin")
        found.name = rng.choice(names)
    else:
        change = mutate_bytes if found.name.endswith(".bin") else mutate_text
        found.data = change(found.data, len(found.data) + 500, rng.getrandbits(32))
    one.body = body_of(found)
