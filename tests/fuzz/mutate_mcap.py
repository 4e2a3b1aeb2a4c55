"""Changes of MCAP files (https://mcap.dev/spec) with valid checksums.

A file is a list of records; a chunk is a record with such a list. After a change lengths, checksums
and (in most files) the index are recomputed.
"""

from __future__ import annotations

import contextlib
import random
import struct
import zlib
from copy import deepcopy
from dataclasses import dataclass, field

import lz4.frame
import zstandard
from mcap.records import Attachment, Chunk, Metadata

from hil.archive import header, verified_records
from hil.archive.verified_records import Damage, encode
from tests.fuzz.draw import mutate_bytes, mutate_text
from tests.fuzz.targets import Mutation
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
    if not data.startswith(verified_records.MAGIC):
        return None
    records = []
    for opcode, body in split_records(data[len(verified_records.MAGIC) :]):
        if opcode in (verified_records.DATA_END, verified_records.FOOTER):
            break
        if opcode != verified_records.MESSAGE_INDEX:
            records.append(_opened(opcode, body))
    return records


def split_records(data: bytes) -> list[tuple[int, bytes]]:
    """Return opcodes and bodies up to the first invalid record."""
    records: list[tuple[int, bytes]] = []
    with contextlib.suppress(Damage):
        records.extend(
            (record.opcode, record.body) for record in verified_records.split_records(data, 0)
        )
    return records


def _opened(opcode: int, body: bytes) -> Record:
    with contextlib.suppress(Damage):  # another record, or an unreadable chunk
        if opcode == verified_records.CHUNK:
            head = verified_records.parse_chunk(verified_records.Record(0, opcode, body))
            inside = [
                Record(*piece) for piece in split_records(verified_records.decompress(head, 0))
            ]
            times = head.message_start_time, head.message_end_time
            return Record(opcode, body, inside, head.compression, times)
    return Record(opcode, body)


def join_file(records: list[Record], *, index: bool) -> bytes:
    """Return the file with valid lengths and checksums, with or without index."""
    built = Indexed()
    file = built.data
    described = _described(records)
    for record in records:
        body = _sealed(record, {header.DESCRIPTION: described})
        if index:
            built.put(record_of(record.opcode, body))
            continue
        file += record_of(record.opcode, body)
    if index:
        return built.ended()
    end = record_of(verified_records.DATA_END, bytes(4)) + record_of(
        verified_records.FOOTER, bytes(20)
    )
    return bytes(file) + end + verified_records.MAGIC


def _described(records: list[Record]) -> str:
    """Return the checksum of the description, which the outcome repeats."""
    for record in records:
        with contextlib.suppress(Damage):  # unreadable
            name, entries = (
                entries_of(record) if record.opcode == verified_records.METADATA else ("", {})
            )
            if name == header.METADATA:
                entries.pop("checksum", None)
                return header.checksum(entries)
    return ""


def _sealed(record: Record, seals: dict[str, str]) -> bytes:
    """Return the body with valid checksums and entries of the outcome."""
    if record.inside is not None:
        data = record.content
        packed = _PACKED.get(record.compression, bytes)(data)
        start, end = record.times
        return body_of(Chunk(record.compression, packed, end, start, zlib.crc32(data), len(data)))
    if record.opcode == verified_records.ATTACHMENT and len(record.body) > 4:
        return record.body[:-4] + zlib.crc32(record.body[:-4]).to_bytes(4, "little")
    if record.opcode == verified_records.METADATA:
        with contextlib.suppress(Damage):  # unreadable
            name, entries = entries_of(record)
            if entries.pop("checksum", None) is not None:
                entries |= {key: seals[key] for key in seals if key in entries}
                return body_of(Metadata(name, header.with_checksum(entries)))
    return record.body


def body_of(record: Attachment | Chunk | Metadata) -> bytes:
    return encode(record)[verified_records.RECORD.size :]


def entries_of(record: Record) -> tuple[str, dict[str, str]]:
    metadata = verified_records.parse(
        Metadata, verified_records.Record(0, record.opcode, record.body)
    )
    return metadata.name, metadata.metadata


def _change(records: list[Record], rng: random.Random) -> None:
    record = rng.choice(records)
    kind = rng.random()
    if kind < 0.12:
        _shuffled(records, rng)
    elif record.inside:
        if kind < 0.25:
            record.times = (rng.choice((0, *record.times, 1 << 63)), rng.choice((*record.times, 0)))
        elif kind < 0.4:
            record.compression = rng.choice(("", "zstd", "lz4", "gzip"))
        elif kind < 0.55:
            _shuffled(record.inside, rng)
        else:
            for message in rng.sample(
                record.inside, min(len(record.inside), rng.choice((1, 1, 3, 50)))
            ):
                _of_a_message(message, rng)
    elif record.opcode in (verified_records.METADATA, verified_records.ATTACHMENT):
        with contextlib.suppress(Damage):  # unreadable
            record.body = body_of(_with_other_entry(record, rng))
    elif record.opcode in (verified_records.SCHEMA, verified_records.CHANNEL) and kind < 0.7:
        record.body = record.body[:4] + _mutated(record.body[4:], rng, mutate_text)
    else:
        record.body = _mutated(record.body, rng)


def _mutated(data: bytes, rng: random.Random, mutate: Mutation = mutate_bytes) -> bytes:
    return mutate(data, len(data) + 500, rng.getrandbits(32))


def _shuffled(records: list[Record], rng: random.Random) -> None:
    """Remove, repeat or exchange records, or change the kind of one."""
    at = rng.randrange(len(records))
    other = rng.randrange(len(records))
    kind = rng.randrange(4)
    if kind == 0 and len(records) > 1:
        del records[at]
    elif kind == 1:
        records.insert(other, deepcopy(records[at]))
    elif kind == 2:
        records[at], records[other] = records[other], records[at]
    else:
        records[at].opcode = rng.choice((*range(1, 16), 0x80, 0))


def _of_a_message(message: Record, rng: random.Random) -> None:
    """Change its number, times or channel, a value in it, or any bytes."""
    if message.opcode != verified_records.MESSAGE or len(message.body) < _MESSAGE.size:
        message.body = _mutated(message.body, rng)
        return
    head = list(_MESSAGE.unpack_from(message.body))
    data = message.body[_MESSAGE.size :]
    kind = rng.randrange(6)
    if kind < 4:
        strange = (0, 1, head[kind] + 1, head[kind] - 1, 2**63, 2**16 - 1, 2**32 - 1)
        head[kind] = rng.choice(strange) % (1 << 16, 1 << 32, 1 << 64, 1 << 64)[kind]
        if kind > 1 and rng.random() < 0.7:
            head[2] = head[3] = head[kind]
    elif kind == 4:
        data = _mutated(data, rng)
    else:
        at = rng.randrange(max(1, len(data) // 8)) * 8 + 4
        value = rng.choice((float("nan"), float("inf"), -1e308, 1e308, 0.0, 5e-324))
        data = data[:at] + struct.pack("<d", value) + data[at + 8 :]
    message.body = _MESSAGE.pack(*head) + data


def _with_other_entry(record: Record, rng: random.Random) -> Attachment | Metadata:
    """Metadata with an entry changed or removed, or an attachment with other data or name."""
    if record.opcode == verified_records.METADATA:
        name, entries = entries_of(record)
        key = rng.choice([*entries, "period", "joint_names", "kind"])
        changed = _mutated(entries.pop(key, "").encode() or b"0", rng, mutate_text)
        if rng.random() > 0.2:
            entries[key] = changed.decode("utf-8", "replace")
        return Metadata(name, entries)
    attachment = verified_records.parse(
        Attachment, verified_records.Record(0, record.opcode, record.body)
    )
    if rng.random() < 0.1:
        attachment.name = rng.choice(("../../x", "/dev/zero", "", "plan.json", "init_packet.bin"))
    else:
        binary = attachment.name.endswith(".bin")
        attachment.data = _mutated(attachment.data, rng, mutate_bytes if binary else mutate_text)
    return attachment
