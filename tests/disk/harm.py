"""Ways in which a disk, a cable or a careless copy damages a file, drawn from a seed.

Nobody recomputes a checksum here: who does that forges, and no checksum keeps a forger out. What a
file system may do to files beside each other, however, is done: sectors and whole chunks of one
archive that turn up in another, and files that swap their names.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hil.archive import container
from tests.hil.mcap_bytes import chunks

SECTORS: Final = (512, 4096)
_CHUNK_CRC: Final = 9 + 24  # bytes from the beginning of a chunk's record

Files = Mapping[Path, bytes]


@dataclass(frozen=True)
class Harm:
    """What was done: new bytes by path, and in words."""

    words: str
    files: Files


def draw(rng: random.Random, files: Files, kind: str | None = None) -> Harm:
    """One damage to one of these archives, or to two of them; of any kind if none is named."""
    path = rng.choice(sorted(files))
    kind = kind or rng.choice(sorted(KINDS))
    changed, detail = KINDS[kind](rng, path, files)
    return Harm(f"{kind} in {path.name}{detail}", changed)


def _flip(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    data, places = bytearray(files[path]), []
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(data))
        data[at] ^= 1 << rng.randrange(8)
        places.append(at)
    return {path: bytes(data)}, f" at {places}"


def _burst(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    data = bytearray(files[path])
    at, length = rng.randrange(len(data)), rng.randrange(1, 5000)
    data[at : at + length] = rng.randbytes(min(length, len(data) - at))
    return {path: bytes(data)}, f" at {at}, {length} bytes"


def _zeroed_sector(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    data, size = bytearray(files[path]), rng.choice(SECTORS)
    at = rng.randrange(0, len(data), size)
    data[at : at + size] = bytes(min(size, len(data) - at))
    return {path: bytes(data)}, f" at {at}, {size} bytes"


def _copied_sector(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """From here or from another archive."""
    source, size = rng.choice(sorted(files)), rng.choice(SECTORS)
    data, other = bytearray(files[path]), files[source]
    at, came = rng.randrange(0, len(data), size), rng.randrange(0, len(other), size)
    length = min(size, len(data) - at, len(other) - came)
    data[at : at + length] = other[came : came + length]
    return {path: bytes(data)}, f" at {at} from {source.name} at {came}, {length} bytes"


def _cut(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    length = rng.randrange(len(files[path]))
    return {path: files[path][:length]}, f" to {length} bytes"


def _zeroed_tail(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """What a power failure leaves on file systems that had set the length already."""
    data = files[path]
    at = rng.randrange(0, len(data), rng.choice(SECTORS))
    return {path: data[:at] + bytes(len(data) - at)}, f" from {at} on"


def _grown(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    length = rng.randrange(1, 5000)
    return {path: files[path] + rng.randbytes(length)}, f" by {length} bytes"


def _swapped_chunks(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    data, (one, other) = files[path], sorted(rng.sample(chunks(files[path]), 2))
    changed = (
        data[: one[0]] + data[slice(*other)] + data[one[1] : other[0]] + data[slice(*one)]
        + data[other[1] :]
    )  # fmt: skip
    return {path: changed}, f" at {one[0]} and {other[0]}"


def _doubled_chunk(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    data, (begin, end) = files[path], rng.choice(chunks(files[path]))
    return {path: data[:end] + data[begin:]}, f" at {begin}"


def _missing_chunk(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    data, (begin, end) = files[path], rng.choice(chunks(files[path]))
    return {path: data[:begin] + data[end:]}, f" at {begin}"


def _strange_chunk(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """The same chunk of another archive in the place of ours, whole and with its checksum."""
    source = rng.choice(sorted(set(files) - {path}))
    ours, theirs = chunks(files[path]), chunks(files[source])
    k = rng.randrange(min(len(ours), len(theirs)))
    data, part = files[path], files[source][slice(*theirs[k])]
    return {path: data[: ours[k][0]] + part + data[ours[k][1] :]}, f", number {k} of {source.name}"


def _strange_tail(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """From some chunk on what another archive has."""
    source = rng.choice(sorted(set(files) - {path}))
    ours, theirs = chunks(files[path]), chunks(files[source])
    k = rng.randrange(min(len(ours), len(theirs)))
    changed = files[path][: ours[k][0]] + files[source][theirs[k][0] :]
    return {path: changed}, f", from chunk {k} on that of {source.name}"


def _no_checksum(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """A chunk's checksum is 0, which MCAP takes for none, and a bit of it is another."""
    data, (begin, end) = bytearray(files[path]), rng.choice(chunks(files[path]))
    struct.pack_into("<I", data, begin + _CHUNK_CRC, 0)
    at = rng.randrange(begin + _CHUNK_CRC + 4, end)
    data[at] ^= 1 << rng.randrange(8)
    return {path: bytes(data)}, f" of the chunk at {begin}, and a bit at {at}"


def _index_unchecked(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """The checksum of the summary is 0, and a bit of the summary is another."""
    data = bytearray(files[path])
    footer = len(data) - len(container.MAGIC) - container.FOOTER_SIZE
    (summary,) = struct.unpack_from("<Q", data, footer + 9)
    struct.pack_into("<I", data, footer + 9 + 16, 0)
    at = rng.randrange(summary, footer)
    data[at] ^= 1 << rng.randrange(8)
    return {path: bytes(data)}, f", a bit at {at}"


def _swapped_names(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """Two of a kind, so that nothing is wrong with either of them but its name."""
    kind = path.name.partition("_")[0]
    like = [one for one in sorted(files) if one.name.startswith(kind)]
    other = rng.choice(like)
    return {path: files[other], other: files[path]}, f" and {other.name}"


KINDS: Final[dict[str, Callable[[random.Random, Path, Files], tuple[Files, str]]]] = {
    "bits flipped": _flip,
    "a burst of noise": _burst,
    "a sector zeroed": _zeroed_sector,
    "a sector copied": _copied_sector,
    "cut": _cut,
    "the tail zeroed": _zeroed_tail,
    "bytes added": _grown,
    "chunks swapped": _swapped_chunks,
    "a chunk doubled": _doubled_chunk,
    "a chunk missing": _missing_chunk,
    "a strange chunk": _strange_chunk,
    "a strange tail": _strange_tail,
    "no checksum": _no_checksum,
    "no checksum of the index": _index_unchecked,
    "names swapped": _swapped_names,
}
