"""Damage archives of a finished campaign, many times: `python -m tests.disk.damage --rounds 1000`.

Each round damages an archive or two by its number (`draw`) and runs all readers: `hil archive
check`, `hil.open_recording`, `hil plot`, `hil identify` of archives or of the folder. Each must
raise a named error, return what it returned before, or state what was left out
(`tests/disk/laws.py`).

Rounds in the journal are not run again. A failure is printed with the command that repeats it. The
exit code is 1 if a law was broken in any round of the journal, 2 if the journal is none of these.
"""

from __future__ import annotations

import argparse
import json
import random
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from hil.archive import container
from hil.campaign import stop_on_interrupt
from hil.progress import reporter
from tests.arguments import parser_of, whole_number
from tests.disk.laws import Undamaged, broken, undamaged
from tests.hil.fast_cell import fast_campaign, fast_cell
from tests.hil.mcap_bytes import chunks
from tests.journal import Journal, JournalError
from tests.journal import rounds as known

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
    path, kind = rng.choice(sorted(files)), kind or rng.choice([SWAPPED, *KINDS])
    if kind == SWAPPED:
        alike = [one for one in files if one.name.startswith(path.name.partition("_")[0])]
        other = rng.choice(sorted(alike))
        return {path: files[other], other: files[path]}, f"{kind} in {path.name} and {other.name}"
    other = rng.choice(sorted(set(files) - {path}))
    content, where = KINDS[kind](rng, files[path], files[other])
    return {path: content}, f"{kind} in {path.name} {where}, other archive {other.name}"


def _flip(rng: Random, data: bytes, _: bytes) -> Changed:
    changed, places = bytearray(data), rng.choices(range(len(data)), k=rng.choice((1, 1, 2, 8)))
    for at in places:
        changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed), f"at {places}"


def _burst(rng: Random, data: bytes, _: bytes) -> Changed:
    at, length = rng.randrange(len(data)), rng.randrange(1, 5000)
    noise = rng.randbytes(min(length, len(data) - at))
    return data[:at] + noise + data[at + length :], f"at {at}, {length} bytes"


def _zeroed_sector(rng: Random, data: bytes, _: bytes) -> Changed:
    size = rng.choice(SECTORS)
    at = rng.randrange(0, len(data), size)
    return data[:at] + bytes(min(size, len(data) - at)) + data[at + size :], f"at {at}, {size}"


def _copied_sector(rng: Random, data: bytes, other: bytes) -> Changed:
    """From this archive or the other one."""
    source, size = rng.choice((data, other)), rng.choice(SECTORS)
    at, begin = rng.randrange(0, len(data), size), rng.randrange(0, len(source), size)
    part = source[begin : begin + min(size, len(data) - at)]
    return data[:at] + part + data[at + len(part) :], f"at {at} from {begin}, {len(part)} bytes"


def _cut(rng: Random, data: bytes, _: bytes) -> Changed:
    length = rng.randrange(len(data))
    return data[:length], f"to {length} bytes"


def _zeroed_tail(rng: Random, data: bytes, _: bytes) -> Changed:
    """As after a power failure on file systems that set the length first."""
    at = rng.randrange(0, len(data), rng.choice(SECTORS))
    return data[:at] + bytes(len(data) - at), f"from {at} on"


def _grown(rng: Random, data: bytes, _: bytes) -> Changed:
    length = rng.randrange(1, 5000)
    return data + rng.randbytes(length), f"by {length} bytes"


def _swapped_chunks(rng: Random, data: bytes, _: bytes) -> Changed:
    (a, b), (c, d) = sorted(rng.sample(chunks(data), 2))
    return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:], f"at {a} and {c}"


def _doubled_chunk(rng: Random, data: bytes, _: bytes) -> Changed:
    begin, end = rng.choice(chunks(data))
    return data[:end] + data[begin:], f"at {begin}"


def _missing_chunk(rng: Random, data: bytes, _: bytes) -> Changed:
    begin, end = rng.choice(chunks(data))
    return data[:begin] + data[end:], f"at {begin}"


def _foreign_chunk(rng: Random, data: bytes, other: bytes) -> Changed:
    """The same chunk of the other archive instead, with its checksum."""
    (begin, end), (a, b) = rng.choice([*zip(chunks(data), chunks(other), strict=False)])
    return data[:begin] + other[a:b] + data[end:], f"at {begin}"


def _foreign_tail(rng: Random, data: bytes, other: bytes) -> Changed:
    """The content of the other archive from some chunk on."""
    (begin, _), (a, _) = rng.choice([*zip(chunks(data), chunks(other), strict=False)])
    return data[:begin] + other[a:], f"from {begin} on"


def _no_checksum(rng: Random, data: bytes, _: bytes) -> Changed:
    """The checksum of a chunk is 0, which means none in MCAP, and one of its bits is flipped."""
    changed, (begin, end) = bytearray(data), rng.choice(chunks(data))
    struct.pack_into("<I", changed, begin + _CHUNK_CRC, 0)
    at = rng.randrange(begin + _CHUNK_CRC + 4, end)
    changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed), f"of the chunk at {begin}, and a bit at {at}"


def _index_unchecked(rng: Random, data: bytes, _: bytes) -> Changed:
    """The checksum of the summary is 0, and one of its bits is flipped."""
    changed, footer = bytearray(data), len(data) - len(container.MAGIC) - container.FOOTER_SIZE
    (summary,) = struct.unpack_from("<Q", changed, footer + 9)
    struct.pack_into("<I", changed, footer + 9 + 16, 0)
    at = rng.randrange(summary, footer)
    changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed), f"and a bit at {at}"


KINDS: Final[dict[str, Callable[[Random, bytes, bytes], Changed]]] = {
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
    "a foreign chunk": _foreign_chunk,
    "a foreign tail": _foreign_tail,
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
    changed, words = draw(random.Random(f"{SEED}/{number}"), truth.files, kind)
    try:
        for path, data in changed.items():
            path.write_bytes(data)
        return words, list(broken(truth, sorted(changed), number))
    finally:
        for path in changed:
            path.write_bytes(truth.files[path])


def run(
    given: argparse.Namespace, before: Mapping[int, dict[str, Any]]
) -> dict[int, dict[str, Any]]:
    """Run the requested rounds, without those of `before`."""
    rounds: dict[int, dict[str, Any]] = {}
    left = [n for n in range(given.start, given.start + given.rounds) if n not in before]
    if not left:
        return rounds
    progress = reporter(quiet=given.json)
    with (
        stop_on_interrupt() as stop,
        tempfile.TemporaryDirectory(dir=given.folder) as folder,
        Journal(given.journal) as journal,
        progress.task("damaging archives (rounds)", len(left)) as task,
    ):
        truth = campaign(Path(folder))
        for number in left:
            if stop.requested:
                break
            words, laws = play(truth, number)
            rounds[number] = {"round": number, "harm": words, "broken": laws}
            journal.add(**rounds[number])
            for law in laws:
                again = f"python -m tests.disk.damage --rounds 1 --start {number}"
                sys.stderr.write(f"round {number} ({words}): {law}\n  again: {again}\n")
            task.advance(1)
    return rounds


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of("tests.disk.damage", __doc__)
    option = parser.add_argument
    option("--rounds", type=whole_number, default=100)
    option("--start", type=whole_number, default=0, help="number of the first round: its seed")
    option("--journal", type=Path, help="JSON lines; rounds in it are not run again")
    option("--folder", type=Path, help="where a temporary folder is made")
    option("--json", action="store_true", help="print one line of JSON")
    given = parser.parse_args(arguments)
    try:
        rounds = known(given.journal, "harm", "broken")
        rounds |= run(given, rounds)
    except JournalError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    failed = sorted(number for number, one in rounds.items() if one["broken"])
    kinds = Counter(str(one["harm"]).partition(" in ")[0] for one in rounds.values())
    facts = {"ran": len(rounds), "failed": len(failed), "seeds_failed": failed}
    if given.json:
        sys.stdout.write(json.dumps({"kinds": dict(kinds), **facts}) + "\n")
    else:
        sys.stdout.write(f"{len(rounds)} rounds, {len(failed)} failed {failed or ''}\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
