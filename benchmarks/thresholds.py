"""Thresholds of contacts: how often motion of other recordings exceeds them, over the promise.

Each split of the board is identified. One half of its unseen motion sets the threshold that it
shows itself, the other half is counted, and the other way round. Recordings are without contact.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks import parser_of, show
from benchmarks.board import DATA, import_all
from benchmarks.published import FITTED_SHARE, Published, Split, known
from hil.base.progress import Silent
from hil.pipeline.identification import identify_archives
from hil.pipeline.options import Options
from identification.arrays import Array
from identification.purposes.contact import residual_peaks
from identification.purposes.quiet_torque import once_in, slow_residuals
from identification.purposes.thresholds import SHOWN_EXCEEDANCES
from identification.signals.block_mean import BLOCK_SECONDS

WITHIN: Final = 3.0
"""Factor within which the rate of false alarms is to be."""


class Count(NamedTuple):
    """Blocks of half a second of all joints that exceed a threshold, and how many should."""

    robot: str
    split: str
    seconds: float
    joints: int
    found: int
    promised: float

    @property
    def ratio(self) -> float:
        """Of found to promised."""
        return self.found / self.promised


def counts(name: str, data: Path) -> Iterator[Count]:
    """Count on each split of a robot that predicts by the defaults of the command line."""
    published = Published.named(name)
    with tempfile.TemporaryDirectory() as scratch:
        archives = import_all(published, data / (published.folder or name), Path(scratch))
        for split in published.splits:
            if split.in_sample or split.part == "last" or split.share != FITTED_SHARE:
                continue
            predicted = [] if split.predicted is None else [archives[split.predicted]]
            yield from _counted(name, split, archives[split.fitted], predicted)


def _counted(name: str, split: Split, fitted: Path, predicted: Sequence[Path]) -> Iterator[Count]:
    options = Options(split=FITTED_SHARE)
    found = identify_archives([fitted], Silent(), options, predict=predicted)
    values = found.estimate.pooled.values
    residuals = slow_residuals(found.cell.model, values, found.prepared.held_out)
    peaks = np.concatenate(residual_peaks(residuals))
    middle = len(peaks) // 2
    exceeded, promised = 0, 0.0
    for setting, counted in ((peaks[:middle], peaks[middle:]), (peaks[middle:], peaks[:middle])):
        torque = _shown(setting)
        if torque is None:
            yield Count(name, str(split), len(peaks) * BLOCK_SECONDS, peaks.shape[1], 0, 0.0)
            return
        exceeded += int(np.count_nonzero(counted > torque))
        promised += SHOWN_EXCEEDANCES * len(counted) / len(setting) * peaks.shape[1]
    seconds = len(peaks) * BLOCK_SECONDS
    yield Count(name, str(split), seconds, peaks.shape[1], exceeded, promised)


def _shown(peaks: Array) -> Array | None:
    return once_in(len(peaks) * BLOCK_SECONDS / SHOWN_EXCEEDANCES, peaks)


def main() -> None:
    """Print each split as it comes, then the sums."""
    parser = parser_of(__doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of recordings")
    parser.add_argument("--only", action="append", choices=known(), help="may be repeated")
    options = parser.parse_args()
    rows: list[Count] = []
    for name in options.only or known():
        for row in counts(name, options.data):
            rows.append(row)
            if not options.json:
                print(_line(row), flush=True)
    show(_summary(rows), only_json=options.json)


def _line(row: Count) -> str:
    unseen = f"{row.robot}, {row.split}: {row.seconds:.0f} s of unseen motion"
    if row.promised == 0.0:
        return f"{unseen}, too short for a threshold"
    return f"{unseen}, {row.found} of {row.promised:.1f} promised exceed it: {row.ratio:.2f}"


def _summary(rows: Sequence[Count]) -> dict[str, Any]:
    rows = [row for row in rows if row.promised > 0.0]
    ratios = [row.ratio for row in rows]
    within = [1.0 / WITHIN <= ratio <= WITHIN for ratio in ratios]
    return {
        "splits": len(rows),
        "within a factor of three": sum(within),
        "all found over all promised": sum(row.found for row in rows)
        / sum(row.promised for row in rows),
        "least": min(ratios),
        "most": max(ratios),
    }


if __name__ == "__main__":
    main()
