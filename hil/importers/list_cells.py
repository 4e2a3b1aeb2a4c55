"""Cells of a text table that are lists, such as pandas writes of a column of arrays.

``"[0.1, 0.2]"``, ``"(0.1, 0.2)"`` and ``[0.1 0.2]`` become columns: ``q[0]``, ``q[1]``.
"""

from __future__ import annotations

import csv
import io
import re
from itertools import chain
from pathlib import Path
from typing import Final

from hil.base.errors import SourceError
from hil.importers.column_map import HOLE

_CELL: Final = re.compile(r"""(?:^|[,;\t|])\s*"?[\[(]\s*[-+.\d][^\])"]*[\])]"?\s*(?=[,;\t|\n]|$)""")
_PROBE_CHARACTERS: Final = 1 << 16  # characters, in which the second line of a table of lists ends
_LIST: Final = re.compile(r"[\[(]\s*(.*?)\s*,?\s*[\])]", re.DOTALL)
_BETWEEN: Final = re.compile(r"\s*,\s*|\s+")
_DELIMITERS: Final = ",;\t|"


def spread_lists(path: Path, text: str, *, drop: bool) -> str:
    """Return a table with a column for each number of its cells that are lists.

    A table without such cells is returned as it is. `drop`: a list of another length than in the
    first row is missing.

    Raises:
        SourceError: a list has another length.
    """
    head, _, below = text[:_PROBE_CHARACTERS].partition("\n")
    if not _CELL.search(below):
        return text
    delimiter = next((mark for mark in _DELIMITERS if mark in head), ",")
    reader = csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True)
    names = next(reader)
    first = next(reader)
    if len(names) != len(first):
        return text
    sizes = {place: len(numbers) for place, cell in enumerate(first) if (numbers := _numbers(cell))}
    header = [
        [f"{name}[{k}]" for k in range(sizes[place])] if place in sizes else [name]
        for place, name in enumerate(names)
    ]
    output = io.StringIO()
    writer = csv.writer(output, delimiter=delimiter, lineterminator="\n")
    writer.writerow(chain(*header))
    for line, cells in enumerate([first, *reader], 2):
        parts = [_numbers(cell) if at in sizes else [cell] for at, cell in enumerate(cells)]
        for place, size in sizes.items():
            if place >= len(parts) or len(parts[place]) == size:
                continue
            if not drop:
                count = len(parts[place])
                problem = f"line {line} has a list of {count} numbers, line 2 one of {size}"
                raise SourceError(path, problem, field=names[place], remedy=HOLE)
            parts[place] = [""] * size
        writer.writerow(chain(*parts))
    return output.getvalue()


def _numbers(cell: str) -> list[str]:
    """Return the numbers of a list as text; none of another cell."""
    match = _LIST.fullmatch(cell.strip())
    return _BETWEEN.split(match[1]) if match and match[1] else []
