"""Changes of MCAP files that get past their checksums: records are taken apart, changed, sealed.

Layout: https://mcap.dev/spec. A file is a list of records; a chunk is one that holds such a list.
After the change lengths, checksums and (in most files) the index are made anew, so that a reader
believes what it reads.
"""

from __future__ import annotations

import contextlib
import random
import struct
import zlib
from dataclasses import dataclass, field

import lz4.frame
import zstandard

from hil.archive import header
from hil.archive.header import chunk_list
from tests.fuzz.mutate_bytes import mutate_bytes
from tests.fuzz.mutate_text import mutate_text
from tests.hil.mcap_bytes import Indexed

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
ATTACHMENT, METADATA, DATA_END = 0x09, 0x0C, 0x0F
_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_MOST_INSIDE = 1 << 20  # bytes of one chunk


@dataclass
class Record:
    """One record; of a chunk what it holds, where that could be read."""

    opcode: int
    body: bytes
    inside: list[Record] | None = None
    compression: bytes = b""
    times: tuple[int, int] = field(default=(0, 0))


def mutate_mcap(data: bytes, most: int, seed: int) -> bytes:
    """One to three changes of records; a tenth of the inputs is changed blindly, seals and all."""
    rng = random.Random(seed)
    records = taken_apart(data) if rng.random() > 0.1 else None
    if not records:
        return mutate_bytes(data, most, seed)
    for _ in range(rng.choice((1, 1, 2, 3))):
        _change(records, rng)
    with contextlib.suppress(Exception):  # what cannot be indexed goes without an index
        sealed = put_together(records, index=rng.random() < 0.8)
        return sealed if len(sealed) <= most else data
    return put_together(records, index=False)[:most]


def taken_apart(data: bytes) -> list[Record] | None:
    """The records of the data section; None for bytes that are no MCAP at all."""
    if not data.startswith(MAGIC):
        return None
    records = []
    for opcode, body in _split(data, len(MAGIC)):
        if opcode in (DATA_END, FOOTER):
            break
        if opcode != MESSAGE_INDEX:
            records.append(_opened(opcode, body))
    return records


def _split(data: bytes, at: int = 0) -> list[tuple[int, bytes]]:
    found = []
    while at + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if length > len(data) - at:
            break
        found.append((opcode, data[at : at + length]))
        at += length
    return found


def _opened(opcode: int, body: bytes) -> Record:
    if opcode != CHUNK or len(body) < _CHUNK.size:
        return Record(opcode, body)
    start, end, _, _, length = _CHUNK.unpack_from(body)
    compression = body[_CHUNK.size : _CHUNK.size + length]
    packed = body[_CHUNK.size + length + 8 :]
    try:
        if compression == b"zstd":
            plain = zstandard.ZstdDecompressor().decompress(packed, max_output_size=_MOST_INSIDE)
        elif compression == b"lz4":
            plain = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=_MOST_INSIDE)
        else:
            plain = packed
    except (zstandard.ZstdError, RuntimeError, EOFError):
        return Record(opcode, body)
    inside = [Record(*piece) for piece in _split(plain)]
    return Record(opcode, body, inside, compression, (start, end))


def put_together(records: list[Record], *, index: bool) -> bytes:
    """The file, with right lengths and checksums, and an index of it where that is wanted."""
    built = Indexed()
    file = built.data
    described = _described(records)
    for one in records:
        body = _sealed(
            one, {header.DESCRIPTION: described, header.CHUNKS: chunk_list(built.checksums)}
        )
        if index:
            built.put(_HEAD.pack(one.opcode, len(body)) + body)
            continue
        if one.opcode == CHUNK and len(body) >= _CHUNK.size:
            built.checksums.append(_CHUNK.unpack_from(body)[3])
        file += _HEAD.pack(one.opcode, len(body)) + body
    if index:
        return built.ended()
    end = _HEAD.pack(DATA_END, 4) + bytes(4)
    return bytes(file) + end + _HEAD.pack(FOOTER, 20) + bytes(20) + MAGIC


def _joined(records: list[Record]) -> bytes:
    return b"".join(_HEAD.pack(one.opcode, len(one.body)) + one.body for one in records)


def _described(records: list[Record]) -> str:
    """The checksum of the description, which the outcome repeats."""
    for one in records:
        with contextlib.suppress(Exception):  # damaged beyond reading: nothing to repeat
            name, entries = _entries(one.body) if one.opcode == METADATA else ("", {})
            if name == header.METADATA:
                entries.pop("checksum", None)
                return header.checksum(entries)
    return ""


def _sealed(one: Record, seals: dict[str, str]) -> bytes:
    """The body with the checksums that fit it, and entries of the outcome that fit the rest."""
    if one.inside is not None:
        plain = _joined(one.inside)
        pack = {b"zstd": zstandard.ZstdCompressor().compress, b"lz4": lz4.frame.compress}
        packed: bytes = pack.get(one.compression, bytes)(plain)
        head = _CHUNK.pack(*one.times, len(plain), zlib.crc32(plain), len(one.compression))
        return head + one.compression + struct.pack("<Q", len(packed)) + packed
    if one.opcode == ATTACHMENT and len(one.body) > 4:
        return one.body[:-4] + zlib.crc32(one.body[:-4]).to_bytes(4, "little")
    if one.opcode == METADATA:
        with contextlib.suppress(Exception):  # damaged beyond reading: as it is
            name, entries = _entries(one.body)
            if entries.pop("checksum", None) is not None:
                entries |= {key: seals[key] for key in seals if key in entries}
                return _metadata(name, {**entries, "checksum": header.checksum(entries)})
    return one.body


def _entries(body: bytes) -> tuple[str, dict[str, str]]:
    name, at = _text(body, 0)
    (length,) = struct.unpack_from("<I", body, at)
    at, end = at + 4, at + 4 + length
    entries = {}
    while at < end:
        key, at = _text(body, at)
        entries[key], at = _text(body, at)
    return name, entries


def _text(body: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, at)
    return body[at + 4 : at + 4 + length].decode(), at + 4 + length


def _string(text: str) -> bytes:
    data = text.encode("utf-8", "surrogateescape")
    return struct.pack("<I", len(data)) + data


def _metadata(name: str, entries: dict[str, str]) -> bytes:
    pairs = b"".join(_string(key) + _string(value) for key, value in entries.items())
    return _string(name) + struct.pack("<I", len(pairs)) + pairs


def _change(records: list[Record], rng: random.Random) -> None:
    one = rng.choice(records)
    kind = rng.random()
    if kind < 0.12:
        _shuffled(records, rng)
    elif one.inside:
        if rng.random() < 0.15:
            one.times = (rng.choice((0, *one.times, 1 << 63)), rng.choice((*one.times, 0)))
        elif rng.random() < 0.2:
            one.compression = rng.choice((b"", b"zstd", b"lz4", b"gzip"))
        elif rng.random() < 0.25:
            _shuffled(one.inside, rng)
        else:
            for message in rng.sample(one.inside, min(len(one.inside), rng.choice((1, 1, 3, 50)))):
                _of_a_message(message, rng)
    elif one.opcode == METADATA:
        _of_metadata(one, rng)
    elif one.opcode == ATTACHMENT:
        _of_an_attachment(one, rng)
    elif one.opcode in (SCHEMA, CHANNEL) and rng.random() < 0.7:
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
    if message.opcode != MESSAGE or len(message.body) < _MESSAGE.size:
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
        name, entries = _entries(one.body)
    except (struct.error, UnicodeDecodeError):
        one.body = mutate_bytes(one.body, len(one.body) + 64, rng.getrandbits(32))
        return
    key = rng.choice([*entries, "period", "joint_names", "kind"])
    kind = rng.random()
    if kind < 0.2:
        entries.pop(key, None)
    else:
        old = entries.get(key, "").encode("utf-8", "surrogateescape")
        changed = mutate_text(old or b"0", 6000, rng.getrandbits(32))
        entries[key] = changed.decode("utf-8", "replace")
    one.body = _metadata(name, entries)


def _of_an_attachment(one: Record, rng: random.Random) -> None:
    try:
        name, at = _text(one.body, 16)
        kind, at = _text(one.body, at)
    except (struct.error, UnicodeDecodeError):
        return
    data = one.body[at + 8 : -4]
    if rng.random() < 0.1:
        name = rng.choice(("../../x", "/dev/zero", "", "plan.json", "cell.toml", "init_packet.bin"))
    else:
        change = mutate_bytes if name.endswith(".bin") else mutate_text
        data = change(data, len(data) + 500, rng.getrandbits(32))
    head = one.body[:16] + _string(name) + _string(kind)
    one.body = head + struct.pack("<Q", len(data)) + data + bytes(4)
