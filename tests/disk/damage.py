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
_CHUNK_CRC: Final = 9 + 24  # bytes from the beginning of a chunk's record

Files = Mapping[Path, bytes]


def draw(rng: random.Random, files: Files, kind: str | None = None) -> tuple[Files, str]:
    """Return the files changed by one random damage, and its description.

    Damage by disks, cables and file systems: also sectors and chunks of one archive in another, and
    files that swap their names. No checksum is recomputed.
    """
    path = rng.choice(sorted(files))
    kind = kind or rng.choice(sorted(KINDS))
    changed, detail = KINDS[kind](rng, path, files)
    return changed, f"{kind} in {path.name}{detail}"


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
    """From this archive or another one."""
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
    """As after a power failure on file systems that set the length first."""
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
    """The same chunk of another archive instead, with its checksum."""
    source = rng.choice(sorted(set(files) - {path}))
    ours, theirs = chunks(files[path]), chunks(files[source])
    k = rng.randrange(min(len(ours), len(theirs)))
    data, part = files[path], files[source][slice(*theirs[k])]
    return {path: data[: ours[k][0]] + part + data[ours[k][1] :]}, f", number {k} of {source.name}"


def _strange_tail(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """The content of another archive from some chunk on."""
    source = rng.choice(sorted(set(files) - {path}))
    ours, theirs = chunks(files[path]), chunks(files[source])
    k = rng.randrange(min(len(ours), len(theirs)))
    changed = files[path][: ours[k][0]] + files[source][theirs[k][0] :]
    return {path: changed}, f", from chunk {k} on that of {source.name}"


def _no_checksum(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """The checksum of a chunk is 0, which means none in MCAP, and one of its bits is flipped."""
    data, (begin, end) = bytearray(files[path]), rng.choice(chunks(files[path]))
    struct.pack_into("<I", data, begin + _CHUNK_CRC, 0)
    at = rng.randrange(begin + _CHUNK_CRC + 4, end)
    data[at] ^= 1 << rng.randrange(8)
    return {path: bytes(data)}, f" of the chunk at {begin}, and a bit at {at}"


def _index_unchecked(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """The checksum of the summary is 0, and one of its bits is flipped."""
    data = bytearray(files[path])
    footer = len(data) - len(container.MAGIC) - container.FOOTER_SIZE
    (summary,) = struct.unpack_from("<Q", data, footer + 9)
    struct.pack_into("<I", data, footer + 9 + 16, 0)
    at = rng.randrange(summary, footer)
    data[at] ^= 1 << rng.randrange(8)
    return {path: bytes(data)}, f", a bit at {at}"


def _swapped_names(rng: random.Random, path: Path, files: Files) -> tuple[Files, str]:
    """Two archives of one kind, each intact."""
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
