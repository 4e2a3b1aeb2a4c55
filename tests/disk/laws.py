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
from hil.errors import HilError
from hil.identify import Identification, identify_archives, identify_campaign
from hil.plots.archive_view import view_of
from hil.progress import Silent

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
        frozenset().union(*(_rows(one.columns) for one in archives.values())),
    )


def broken(truth: Undamaged, harmed: Sequence[Path], number: int) -> Iterator[str]:
    """Yield a sentence for each violated law, of the archives that were damaged.

    Even rounds identify the archives, the others the folder, which has their checksums.
    """
    readers: list[Callable[[], Iterator[str]]] = [
        partial(law, truth, path) for path in harmed for law in (_reads, _checks, _shows)
    ]
    if any(path in truth.paths for path in harmed):  # moves are never read for it
        readers.append(partial(_identifies, truth, harmed, campaign=bool(number % 2)))
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
        found, what = identify_campaign(truth.root, Silent()), "identify of the campaign"
    else:
        found, what = identify_archives(truth.paths, Silent()), "identify"
    before, now = truth.loose.estimate.pooled, found.estimate.pooled
    same_parameters = before.values.shape == now.values.shape
    if same_parameters and np.allclose(before.values, now.values, rtol=SAME, atol=0.0):
        return
    messages = [*found.results.notes, *found.results.verdict.warnings]
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
