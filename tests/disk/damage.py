"""Damage archives of a finished campaign, many times: `python -m tests.disk.damage --rounds 1000`.

Each round damages an archive or two by its number (`draw`) and runs all readers: `hil archive
check`, `hil.open_recording`, `hil plot`, `hil identify` of archives or of the folder. Each must
raise a named error, return what it returned before, or state what was left out; and `hil archive
repair` saves the samples of each undamaged chunk (`broken`). A failure is printed with the command
that repeats it.
"""

from __future__ import annotations

import random
import struct
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Final

from hil.archive import verified_records
from tests.arguments import parser_of, whole_number
from tests.disk.readers import Damage, Undamaged, undamaged
from tests.hil.fast_cell import fast_campaign, fast_cell
from tests.hil.mcap_bytes import chunks
from tests.laws.evidence import Evidence
from tests.laws.table import Scenario, judged

SECTORS: Final = (512, 4096)
SWAPPED: Final = "names swapped"
_CHUNK_CRC: Final = 9 + 24  # bytes from the beginning of a chunk's record

Files = Mapping[Path, bytes]
Random = random.Random
Changed = tuple[bytes, str]  # content, and where it was changed


def draw(rng: Random, files: Files, kind: str | None = None) -> tuple[Files, str]:
    """Return the files changed by one random damage, and its description.

    Damage by disks, cables and file systems: also sectors and chunks of one archive in another, and
    two archives of one kind that swap their names. No checksum is recomputed.
    """
    path = rng.choice(sorted(files))
    kind = kind or rng.choice([SWAPPED, *KINDS])
    if kind == SWAPPED:
        alike = [file for file in files if file.name.startswith(path.name.partition("_")[0])]
        other = rng.choice(sorted(alike))
        return {path: files[other], other: files[path]}, f"{kind} in {path.name} and {other.name}"
    other = rng.choice(sorted(set(files) - {path}))
    content, where = KINDS[kind](rng, files[path], files[other])
    return {path: content}, f"{kind} in {path.name} {where}, other archive {other.name}"


def _flip(rng: Random, data: bytes, _: bytes) -> Changed:
    changed = bytearray(data)
    places = rng.choices(range(len(data)), k=rng.choice((1, 1, 2, 8)))
    for at in places:
        changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed), f"at {places}"


def _overwritten(rng: Random, data: bytes, other: bytes, what: str) -> Changed:
    """A burst of noise, or a sector that is zeroed or copied from this archive or the other."""
    size = rng.randrange(1, 5000) if what == "noise" else rng.choice(SECTORS)
    at = rng.randrange(0, len(data), 1 if what == "noise" else size)
    source = {"noise": rng.randbytes(size), "zeros": bytes(size)}.get(
        what, rng.choice((data, other))
    )
    begin = rng.randrange(0, len(source), size)
    part = source[begin : begin + min(size, len(data) - at)]
    return data[:at] + part + data[at + len(part) :], f"at {at} from {begin}, {len(part)} bytes"


def _ended(rng: Random, data: bytes, _: bytes, what: str) -> Changed:
    """Cut, zeroed as after a power failure on some file systems, or with bytes behind it."""
    at = rng.randrange(0, len(data), rng.choice((1, *SECTORS)))
    if what == "grown":
        return data + rng.randbytes(1 + at % 5000), f"by {1 + at % 5000} bytes"
    return data[:at] + bytes((len(data) - at) * (what == "zeros")), f"at {at}"


def _swapped_chunks(rng: Random, data: bytes, _: bytes) -> Changed:
    (a, b), (c, d) = sorted(rng.sample(chunks(data), 2))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:], f"at {a} and {c}"


def _replaced_chunk(rng: Random, data: bytes, other: bytes, what: str) -> Changed:
    """Of the other archive it is the same chunk, with its checksum, or all from there on."""
    (begin, end), (a, b) = rng.choice([*zip(chunks(data), chunks(other), strict=False)])
    if what == "foreign tail":
        return data[:begin] + other[a:], f"from {begin} on"
    part = {"missing": b"", "doubled": 2 * data[begin:end], "foreign": other[a:b]}[what]
    return data[:begin] + part + data[end:], f"at {begin}"


def _no_checksum(rng: Random, data: bytes, _: bytes) -> Changed:
    """The checksum of a chunk is 0, which means none in MCAP, and one of its bits is flipped."""
    changed = bytearray(data)
    (begin, end) = rng.choice(chunks(data))
    struct.pack_into("<I", changed, begin + _CHUNK_CRC, 0)
    at = rng.randrange(begin + _CHUNK_CRC + 4, end)
    changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed), f"of the chunk at {begin}, and a bit at {at}"


def _index_unchecked(rng: Random, data: bytes, _: bytes) -> Changed:
    """The checksum of the summary is 0, and one of its bits is flipped."""
    changed = bytearray(data)
    footer = len(data) - len(verified_records.MAGIC) - verified_records.FOOTER_SIZE
    (summary,) = struct.unpack_from("<Q", changed, footer + 9)
    struct.pack_into("<I", changed, footer + 9 + 16, 0)
    at = rng.randrange(summary, footer)
    changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed), f"and a bit at {at}"


KINDS: Final[dict[str, Callable[[Random, bytes, bytes], Changed]]] = {
    "bits flipped": _flip,
    "a burst of noise": partial(_overwritten, what="noise"),
    "a sector zeroed": partial(_overwritten, what="zeros"),
    "a sector copied": partial(_overwritten, what="copy"),
    "cut": partial(_ended, what="cut"),
    "the tail zeroed": partial(_ended, what="zeros"),
    "bytes added": partial(_ended, what="grown"),
    "chunks swapped": _swapped_chunks,
    "a chunk doubled": partial(_replaced_chunk, what="doubled"),
    "a chunk missing": partial(_replaced_chunk, what="missing"),
    "a foreign chunk": partial(_replaced_chunk, what="foreign"),
    "a foreign tail": partial(_replaced_chunk, what="foreign tail"),
    "no checksum": _no_checksum,
    "no checksum of the index": _index_unchecked,
}


SEED = 20261120


def campaign(folder: Path, repetitions: int = 3) -> Undamaged:
    made = fast_campaign(folder / "campaign", fast_cell(folder, repetitions=repetitions))
    made.run(durable=False, unrehearsed=True)
    return undamaged(made.folder.root)


def play(truth: Undamaged, number: int, kind: str | None = None) -> tuple[str, list[str]]:
    """Run one round; return the damage and the violated laws. The files are restored."""
    changed, damage = draw(random.Random(f"{SEED}/{number}"), truth.files, kind)
    scenario = Scenario(
        f"python -m tests.disk.damage --rounds 1 --start {number}",
        (damage,),
        lambda: harmed(truth, changed, number),
    )
    try:
        return damage, [violation.text for violation in judged(scenario)]
    finally:
        for path in changed:
            path.write_bytes(truth.files[path])


def harmed(truth: Undamaged, changed: Files, number: int) -> Evidence:
    """Damage the files; even rounds identify the archives, the others the folder."""
    for path, data in changed.items():
        path.write_bytes(data)
    return Evidence(damage=Damage(truth, tuple(sorted(changed)), bool(number % 2)))


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of("tests.disk.damage", __doc__)
    option = parser.add_argument
    option("--rounds", type=whole_number, default=100)
    option("--start", type=whole_number, default=0, help="number of the first round: its seed")
    given = parser.parse_args(arguments)
    failed = []
    with tempfile.TemporaryDirectory() as folder:
        truth = campaign(Path(folder))
        for number in range(given.start, given.start + given.rounds):
            damage, laws = play(truth, number)
            failed += [number] * bool(laws)
            for law in laws:
                again = f"python -m tests.disk.damage --rounds 1 --start {number}"
                sys.stderr.write(f"round {number} ({damage}): {law}\n  again: {again}\n")
    sys.stdout.write(f"{given.rounds} rounds, {len(failed)} failed {failed or ''}\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
