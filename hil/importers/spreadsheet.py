"""Sheets of spreadsheets (.xlsx, .xls, .xlsb, .ods) to text tables, read by `python-calamine`."""

from __future__ import annotations

import csv
import datetime
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from hil.base.errors import SourceError
from hil.importers.column_map import Format

_ZIP_MAGIC: Final = b"PK\x03\x04"
_OLE_MAGIC: Final = b"\xd0\xcf\x11\xe0"
_PARTS: Final = ("xl/workbook.", "content.xml")
"""Begin the names of parts that only spreadsheets have, of Office and of the open format."""
_MAX_WORKBOOK_BYTES: Final = 1 << 31  # bytes of an unpacked workbook
_MIN_SIZE_RATIO: Final = 2.0  # cells of the largest sheet over another that is no rival of it
_Cell = (
    int | float | str | bool | datetime.time | datetime.date | datetime.datetime
    | datetime.timedelta
)  # fmt: skip


def is_spreadsheet(path: Path, start: bytes) -> bool:
    """Return whether a file with these first bytes is a spreadsheet, whatever its suffix.

    Text that a logger calls ``.xls`` is none.
    """
    if not start.startswith(_ZIP_MAGIC):
        return start.startswith(_OLE_MAGIC)
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as packed:
        return any(name.startswith(_PARTS) for name in packed.namelist())


def text_of_sheet(path: Path, form: Format) -> str:
    """Return a sheet as text in columns: the one that the map names, else the largest.

    Raises:
        SourceError: it cannot be read, has no such sheet, or two that are about equally large.
    """
    try:
        sheets = _sheets_of(path)
    except Exception as error:  # of calamine on a file in any state
        problem = f"cannot be read as a spreadsheet ({error or type(error).__name__})"
        raise SourceError(path, problem, remedy="save its table as CSV") from error
    sizes = {name: sum(map(len, rows)) for name, rows in sheets.items()}
    chosen = form.sheet or max(sizes, key=lambda name: sizes[name])
    if chosen not in sheets:
        remedy = f"its sheets are {', '.join(sheets)}"
        raise SourceError(path, f"has no sheet {chosen!r}", field="format.sheet", remedy=remedy)
    rivals = [name for name, size in sizes.items() if size * _MIN_SIZE_RATIO > sizes[chosen]]
    if form.sheet is None and len(rivals) > 1:
        options = " or ".join(f'[format] sheet = "{name}"' for name in rivals)
        problem = f"has {len(rivals)} sheets of about the same size: {', '.join(rivals)}"
        raise SourceError(
            path, problem, field="format.sheet", remedy=f"choose one in a map (--map): {options}"
        )
    output = io.StringIO()
    writer = csv.writer(output, lineterminator="\n")
    writer.writerows([_text(cell) for cell in row] for row in sheets[chosen])
    return output.getvalue()


def _sheets_of(path: Path) -> dict[str, Sequence[Sequence[_Cell]]]:
    """Return the rows of each sheet."""
    from python_calamine import CalamineWorkbook  # only for spreadsheets

    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as packed:
            size = sum(member.file_size for member in packed.infolist())
        if size > _MAX_WORKBOOK_BYTES:
            raise ValueError(f"its parts have {size} bytes")
    with CalamineWorkbook.from_path(path) as workbook:
        return {name: workbook.get_sheet_by_name(name).to_python() for name in workbook.sheet_names}


def _text(cell: _Cell) -> str:
    """Return a cell as the text of a table."""
    if isinstance(cell, bool):
        return str(int(cell))
    if isinstance(cell, datetime.timedelta):
        return repr(cell.total_seconds())
    if isinstance(cell, datetime.datetime):
        return cell.isoformat(sep=" ")
    if isinstance(cell, datetime.date | datetime.time):
        return cell.isoformat()
    return repr(cell) if isinstance(cell, float) else str(cell)
