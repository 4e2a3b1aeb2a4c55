"""Laws of damaged archives, for all readers.

Each reader raises a named error, or returns what was written, or less of it with a message.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.archive import Archive, open_archive
from hil.archive.check import check_archive
from hil.batch.cache import CacheLocation
from hil.batch.run import reidentify
from hil.batch.workers import Workers
from hil.errors import HilError
from hil.identify import Identification, identify_archives, identify_campaign
from hil.identify.options import FIXED
from hil.plots.archive_view import view_of
from hil.progress import Silent

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Undamaged:
    """A completed campaign before any damage.

    Attributes:
        loose: the estimate from the archives without their folder.
        batch: estimates of the batch by archive, "" for all; values and standard deviations.
        rows: every sample of all archives, see `_rows`.
    """

    root: Path
    files: Mapping[Path, bytes]
    archives: Mapping[Path, Archive]
    loose: Identification
    batch: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    rows: frozenset[bytes]

    @property
    def paths(self) -> list[Path]:
        """Archives for identification."""
        return [p for p in sorted(self.files) if not p.name.startswith("move")]


def undamaged(root: Path, workers: Workers | None) -> Undamaged:
    """Read a campaign; without workers, without a batch."""
    paths = sorted((root / "archives").glob("*.mcap"))
    fitted = [path for path in paths if not path.name.startswith("move")]
    archives = {path: open_archive(path) for path in paths}
    return Undamaged(
        root,
        {path: path.read_bytes() for path in paths},
        archives,
        identify_archives(fitted, Silent()),
        {} if workers is None else _by_archive(root, workers)[0],
        frozenset().union(*(_rows(one.columns) for one in archives.values())),
    )


def broken(
    truth: Undamaged, harmed: Sequence[Path], number: int, workers: Workers | None = None
) -> Iterator[str]:
    """Yield a sentence for each violated law, of the archives that were damaged.

    Even rounds identify the archives, the others the folder, which has their checksums. With
    workers there is a batch of the folder.
    """
    readers: list[Callable[[], Iterator[str]]] = [
        partial(law, truth, path) for path in harmed for law in (_reads, _checks, _looks)
    ]
    if any(path in truth.paths for path in harmed):  # moves are never read for it
        readers.append(partial(_identifies, truth, harmed, campaign=bool(number % 2)))
    if workers is not None:
        readers.append(partial(_pools, truth, harmed, workers))
    for reader in readers:
        try:
            yield from reader()
        except HilError as error:
            if not _blames(str(error), truth, harmed):
                yield f"an error that names nothing that was damaged: {error}"
        except Exception as error:
            yield f"an undocumented {type(error).__name__}: {error}"


def _blames(text: str, truth: Undamaged, harmed: Sequence[Path]) -> bool:
    """Return whether a sentence names a damaged archive, or the folder and no other archive."""
    if any(path.name in text for path in harmed):
        return True
    return str(truth.root) in text and not any(path.name in text for path in truth.files)


def _reads(truth: Undamaged, path: Path) -> Iterator[str]:
    archive = open_archive(path)
    if archive.complete:
        if not any(_same(archive, one) for one in truth.archives.values()):
            yield f"{path.name}: opened as complete with other content"
    elif not archive.missing:
        yield f"{path.name}: incomplete without a message"
    if not _written(archive.columns, truth):
        yield f"{path.name}: contains a sample that was never written"


def _checks(truth: Undamaged, path: Path) -> Iterator[str]:
    if check_archive(path).conforms and not _same(open_archive(path), truth.archives[path]):
        yield f"{path.name}: conforms with other content"


def _looks(truth: Undamaged, path: Path) -> Iterator[str]:
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
        found, what = identify_campaign(truth.root, Silent()), "identify of the campaign"
    else:
        found, what = identify_archives(truth.paths, Silent()), "identify"
    before, now = truth.loose.estimate.pooled, found.estimate.pooled
    if _alike(before.values, now.values):
        return
    messages = [*found.results.notes, *found.results.verdict.warnings]
    if not any(path.name in text for path in harmed for text in messages):
        yield f"{what}: another estimate without a message about {harmed[0].name}"
    yield from _within(before.values, before.std, now.values, now.std, what)


def _alike(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Return whether two estimates are equal; those of other parameters are not."""
    return one.shape == other.shape and np.allclose(one, other, rtol=SAME, atol=0.0)


def _within(
    before: NDArray[Any], std: NDArray[Any], now: NDArray[Any], other: NDArray[Any], what: str
) -> Iterator[str]:
    """Compare two estimates; with too few samples left, the parameters may be others."""
    if before.shape != now.shape:
        return
    apart = np.abs(now - before) / np.hypot(std, other)
    if np.nanmax(apart) > APART:
        yield f"{what}: an estimate {np.nanmax(apart):.1f} standard deviations from that before"


SAME = 1e-9  # Relative difference of two sums of the same terms in another order
APART = 5.0
"""Standard deviations of the difference of two estimates that share most of their samples; these
are correlated, so that 5 is generous, and a wrong sample moves an estimate by far more."""


def _by_archive(
    root: Path, workers: Workers
) -> tuple[dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]], list[str]]:
    """Return estimates of a batch by archive or "" for all, and its messages."""
    result = reidentify([str(root)], FIXED, workers, Silent(), cache=CacheLocation(keep=False))
    found = {Path(one.archive).name: (one.values, one.std) for one in result.repetitions}
    found[""] = (result.pooled[0].values, result.pooled[0].std)
    messages = [f"{one.path}: {one.reason}" for one in (*result.broken, *result.skipped)]
    levels = (*result.repetitions, *result.campaigns, *result.pooled)
    messages += [warning for one in levels for warning in one.warnings]
    return found, messages


def _pools(truth: Undamaged, harmed: Sequence[Path], workers: Workers) -> Iterator[str]:
    found, messages = _by_archive(truth.root, workers)
    same = found.keys() == truth.batch.keys() and all(
        _alike(found[name][0], truth.batch[name][0]) for name in found
    )
    if not same and not any(path.name in text for path in harmed for text in messages):
        yield f"batch: another estimate without a message about {harmed[0].name}"
    yield from _within(*truth.batch[""], *found[""], "batch")


def _same(one: Archive, other: Archive) -> bool:
    return (
        one.columns.keys() == other.columns.keys()
        and all(np.array_equal(v, other.columns[k], equal_nan=True) for k, v in one.columns.items())
        and one.header == other.header
        and one.outcome == other.outcome
        and one.attachments == other.attachments
        and one.events == other.events
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
