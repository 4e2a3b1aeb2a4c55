"""pandas DataFrames as logs."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas


@contextmanager
def as_logs(*groups: Any) -> Iterator[list[tuple[Path, ...]]]:
    """Yield the recordings of each group as paths; tables are text files until the end.

    Args:
        groups: each a path, a DataFrame, or several of them. An index other than the numbers of
            the rows is the first column.
    """
    frames = [frame for group in groups for frame in _several(group) if _is_frame(frame)]
    if not frames:
        yield [tuple(map(Path, _several(group))) for group in groups]
        return
    with TemporaryDirectory(prefix="hil-") as folder:
        names = iter(_names(len(frames)))
        yield [
            tuple(
                _written(each, Path(folder) / next(names)) if _is_frame(each) else Path(each)
                for each in _several(group)
            )
            for group in groups
        ]


def _several(group: Any) -> Sequence[Any]:
    return (group,) if isinstance(group, str | PathLike) or _is_frame(group) else tuple(group)


def _is_frame(recording: Any) -> bool:
    """Return whether it is a DataFrame; who has one has loaded pandas."""
    pandas = sys.modules.get("pandas")
    return pandas is not None and isinstance(recording, pandas.DataFrame)


def _names(count: int) -> list[str]:
    return ["recording.csv", *(f"recording-{number}.csv" for number in range(2, count + 1))]


def _written(frame: pandas.DataFrame, path: Path) -> Path:
    """Write every number with all its digits."""
    numbered = type(frame.index).__name__ == "RangeIndex" and frame.index.name is None
    frame.to_csv(path, index=not numbered, index_label=None if numbered else _label(frame))
    return path


def _label(frame: pandas.DataFrame) -> str:
    return str(frame.index.name or "time")
