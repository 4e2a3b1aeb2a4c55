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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, container, open_archive
from hil.archive.check import check_archive
from hil.archive.repair import repair
from hil.errors import HilError
from hil.identify import Identification, identify_archives, identify_campaign
from hil.plots.archive_view import view_of
from hil.progress import Silent
from tests.arguments import parser_of, whole_number
from tests.hil.fast_cell import fast_campaign, fast_cell
from tests.hil.mcap_bytes import chunks, heads

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Undamaged:
    """A completed campaign before any damage.

    Attributes:
        loose: the estimate from the archives without their folder.
        rows: every sample of all archives, see `_rows`.
    """

    root: Path
    files: Mapping[Path, bytes]
    archives: Mapping[Path, Archive]
    loose: Identification
    rows: frozenset[bytes]

    @property
    def paths(self) -> list[Path]:
        """Archives for identification."""
        return [p for p in sorted(self.files) if not p.name.startswith("move")]


def undamaged(root: Path) -> Undamaged:
    """Read a campaign."""
    paths = sorted((root / "archives").glob("*.mcap"))
    fitted = [path for path in paths if not path.name.startswith("move")]
    archives = {path: open_archive(path) for path in paths}
    return Undamaged(
        root,
        {path: path.read_bytes() for path in paths},
        archives,
        identify_archives(fitted, Silent()),
        frozenset().union(*(_rows(archive.columns) for archive in archives.values())),
    )


def broken(truth: Undamaged, harmed: Sequence[Path], number: int) -> Iterator[str]:
    """Yield a sentence for each violated law, of the archives that were damaged.

    Even rounds identify the archives, the others the folder, which has their checksums.
    """
    readers: list[Callable[[], Iterator[str]]] = [
        partial(law, truth, path) for path in harmed for law in (_reads, _checks, _shows, _repairs)
    ]
    if any(path in truth.paths for path in harmed):  # moves are never read for it
        readers.append(partial(_identifies, truth, harmed, campaign=bool(number % 2)))
    for reader in readers:
        try:
            yield from reader()
        except HilError as error:
            if not blamed(str(error), truth, harmed):
                yield f"an error that names nothing that was damaged: {error}"
        except Exception as error:
            yield f"an undocumented {type(error).__name__}: {error}"


def blamed(text: str, truth: Undamaged, harmed: Sequence[Path]) -> bool:
    """Return whether a sentence names a damaged archive, or the folder and no other archive."""
    if any(path.name in text for path in harmed):
        return True
    return str(truth.root) in text and not any(path.name in text for path in truth.files)


def _reads(truth: Undamaged, path: Path) -> Iterator[str]:
    archive = open_archive(path)
    if archive.complete:
        if not any(_same(archive, original) for original in truth.archives.values()):
            yield f"{path.name}: opened as complete with other content"
    elif not archive.missing:
        yield f"{path.name}: incomplete without a message"
    if not _written(archive.columns, truth):
        yield f"{path.name}: contains a sample that was never written"


def _checks(truth: Undamaged, path: Path) -> Iterator[str]:
    if check_archive(path).conforms and not _same(open_archive(path), truth.archives[path]):
        yield f"{path.name}: conforms with other content"


def _repairs(truth: Undamaged, path: Path) -> Iterator[str]:
    """Check that the samples of all undamaged chunks are saved, of a file with chunks in order."""
    before, now = truth.files[path], path.read_bytes()
    whole = [before[begin:end] for begin, end in chunks(before)]
    places = [now.find(chunk) for chunk in whole]
    saved_places = [at for at in places if at >= 0]
    defined = places[0] >= 0 or now.endswith(before[chunks(before)[-1][1] :])
    with tempfile.TemporaryDirectory() as folder:
        saved = open_archive(repair(path, Path(folder) / path.name).output or path)
    if not _written(saved.columns, truth):
        yield f"{path.name}: repaired with a sample that was never written"
    if saved.missing:
        yield f"repaired, and not complete: {saved.missing}"
    if defined and saved_places == sorted(saved_places):
        needed = set().union(
            *(_stamps(chunk) for chunk, at in zip(whole, places, strict=True) if at >= 0)
        )
        if lost := needed - set(saved.columns["stamp"].tolist()):
            yield f"{path.name}: {len(lost)} samples of undamaged chunks are lost"


def _stamps(chunk: bytes) -> set[int]:
    """Stamps of the cycles in a chunk [ns]."""
    record = container.Record(0, container.CHUNK, chunk[container.RECORD.size :])
    content = container.chunk_data(container.parse_chunk(record), 0)
    return {head.log_time for head in heads(content) if head.channel == 1}


def _shows(truth: Undamaged, path: Path) -> Iterator[str]:
    """Check a part of the time, found by the index, and what `hil plot` shows."""
    if path.read_bytes() in truth.files.values():
        return  # intact, under the name of another
    before = truth.archives[path].columns
    stamp = before["stamp"]
    start, stop = (float(np.quantile(stamp, share)) * 1e-9 for share in (0.3, 0.7))
    part = open_archive(path, fields=("position", "target_current"), start=start, stop=stop)
    if not _written(part.columns, truth):
        yield f"{path.name}: a part of its time contains a sample that was never written"
    view = view_of(path)
    shown = float(stamp[-1] - stamp[0]) * 1e-9
    if not view.facts.damage and abs(view.stop - shown) > 1e-9:
        yield f"{path.name}: {view.stop} s of {shown} s are shown without a message"


def _identifies(truth: Undamaged, harmed: Sequence[Path], *, campaign: bool) -> Iterator[str]:
    if campaign:
        identification, what = identify_campaign(truth.root, Silent()), "identify of the campaign"
    else:
        identification, what = identify_archives(truth.paths, Silent()), "identify"
    before, now = truth.loose.estimate.pooled, identification.estimate.pooled
    same_parameters = before.values.shape == now.values.shape
    if same_parameters and np.allclose(before.values, now.values, rtol=SAME, atol=0.0):
        return
    messages = [*identification.results.notes, *identification.results.verdict.warnings]
    if not any(path.name in text for path in harmed for text in messages):
        yield f"{what}: another estimate without a message about {harmed[0].name}"
    if same_parameters:  # with too few samples left, they may be others
        apart = np.nanmax(np.abs(now.values - before.values) / np.hypot(before.std, now.std))
        if apart > APART:
            yield f"{what}: an estimate {apart:.1f} standard deviations from that before"


SAME = 1e-9  # Relative difference of two sums of the same terms in another order
APART = 5.0
"""Standard deviations of the difference of two estimates that share most of their samples; these
are correlated, so that 5 is generous, and a wrong sample moves an estimate by far more."""


def _same(archive: Archive, other: Archive) -> bool:
    return (
        archive.columns.keys() == other.columns.keys()
        and all(
            np.array_equal(v, other.columns[k], equal_nan=True) for k, v in archive.columns.items()
        )
        and archive.header == other.header
        and archive.outcome == other.outcome
        and archive.attachments == other.attachments
        and archive.events == other.events
    )


def _written(columns: Columns, truth: Undamaged) -> bool:
    """Return whether each sample was written, at its time."""
    return _rows(columns) <= truth.rows


def _rows(columns: Columns) -> set[bytes]:
    """Time, position and current of each sample."""
    names = ("stamp", "position", "target_current")
    if not all(name in columns and len(columns[name]) for name in names):
        return set()
    parts = [columns[name].reshape(len(columns["stamp"]), -1).astype(float) for name in names]
    return {row.tobytes() for row in np.hstack(parts)}


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
        alike = [file for file in files if file.name.startswith(path.name.partition("_")[0])]
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
    try:
        for path, data in changed.items():
            path.write_bytes(data)
        return damage, list(broken(truth, sorted(changed), number))
    finally:
        for path in changed:
            path.write_bytes(truth.files[path])


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
