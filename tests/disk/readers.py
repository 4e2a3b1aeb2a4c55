"""Laws of readers: a damaged archive is refused by name, read as before, or its loss is stated."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive, verified_records
from hil.archive.check import check_archive
from hil.archive.repair import repair
from hil.base.errors import HilError
from hil.base.progress import Silent
from hil.campaign.identified_campaign import identify_campaign
from hil.pipeline.identification import Identification, identify_archives
from hil.plots.archive_view import view_of
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


@dataclass(frozen=True, eq=False)
class Damage:
    """Archives of a completed campaign that were damaged.

    Attributes:
        truth: the campaign before.
        harmed: archives that were damaged.
        of_campaign: whether the folder is identified, which has the checksums, or its archives.
    """

    truth: Undamaged
    harmed: tuple[Path, ...]
    of_campaign: bool


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
    """Check that the samples of all undamaged chunks are saved, of a file with chunks in order.

    One with a chunk of another archive promises only that no sample is made up.
    """
    before = truth.files[path]
    now = path.read_bytes()
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
    others = [data for file, data in truth.files.items() if file != path]
    foreign = any(data[begin:end] in now for data in others for begin, end in chunks(data))
    if defined and not foreign and saved_places == sorted(saved_places):
        needed = set().union(
            *(_stamps(chunk) for chunk, at in zip(whole, places, strict=True) if at >= 0)
        )
        if lost := needed - set(saved.columns["stamp"].tolist()):
            yield f"{path.name}: {len(lost)} samples of undamaged chunks are lost"


def _stamps(chunk: bytes) -> set[int]:
    """Stamps of the cycles in a chunk [ns]."""
    record = verified_records.Record(
        0, verified_records.CHUNK, chunk[verified_records.RECORD.size :]
    )
    content = verified_records.chunk_data(verified_records.parse_chunk(record), 0)
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


def _identifies(damage: Damage) -> Iterator[str]:
    truth = damage.truth
    harmed = damage.harmed
    if not any(path in truth.paths for path in harmed):
        return  # moves are never read for it
    contents = sorted(path.read_bytes() for path in truth.paths)
    if not damage.of_campaign and contents == sorted(truth.files[path] for path in truth.paths):
        return  # the same recordings in another order
    if damage.of_campaign:
        identification = identify_campaign(truth.root, Silent())
        what = "identify of the campaign"
    else:
        identification = identify_archives(truth.paths, Silent())
        what = "identify"
    before = truth.loose.estimate.pooled
    now = identification.estimate.pooled
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


def _documented(damage: Damage, law: Callable[[], Iterator[str]]) -> Iterator[str]:
    """Yield what a law says; an error of the product has to name what was damaged."""
    try:
        yield from law()
    except HilError as error:
        if not blamed(str(error), damage.truth, damage.harmed):
            yield f"an error that names nothing that was damaged: {error}"
    except Exception as error:
        yield f"an undocumented {type(error).__name__}: {error}"


def _of_each(law: Callable[[Undamaged, Path], Iterator[str]]) -> Callable[[Damage], Iterator[str]]:
    def check(damage: Damage) -> Iterator[str]:
        for path in damage.harmed:
            yield from _documented(damage, lambda path=path: law(damage.truth, path))  # type: ignore[misc]

    return check


LAWS: Final[dict[str, Callable[[Damage], Iterator[str]]]] = {
    "a damaged archive is read as written": _of_each(_reads),
    "a damaged archive does not conform": _of_each(_checks),
    "a damaged archive is shown with its damage": _of_each(_shows),
    "undamaged chunks are saved": _of_each(_repairs),
    "an estimate does not change without a message": lambda damage: _documented(
        damage, lambda: _identifies(damage)
    ),
}
"""By name, of damaged archives (`tests.laws.table`)."""
