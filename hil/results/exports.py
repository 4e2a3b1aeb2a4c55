"""Files for other tools beside `results.json`."""

from __future__ import annotations

from hil.results.frozen import Frozen


class ExportResult(Frozen):
    """Files for other tools, in the folder of `results.json`."""

    written: list[str]
    withheld: dict[str, str]
    """File name and why it was not written."""
