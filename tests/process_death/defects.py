"""Defects planted in the processes that the product starts, to see that rounds find them.

A defect is Python that such a process runs before anything else: its supervisor can import a
`sitecustomize`, and what it can import, those that it starts can.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.process_death import product


@dataclass(frozen=True)
class Defect:
    """What is broken."""

    module: str  # that the broken process runs
    code: str  # what breaks it
    found: str  # words of the law that finds it


DEFECTS: Final = {
    "archive-flushes-rarely": Defect(
        product.ARCHIVE,
        "from hil.archive import writer; writer.FLUSH_PERIOD = 5.0",
        "lost with the archive process",
    ),
    "archive-drops-records": Defect(
        product.ARCHIVE,
        "from hil.archive.recorder import Recorder; write = Recorder._write; "
        "Recorder._write = lambda self, rows: write(self, rows[rows['cycle'] % 61 != 0])",
        "has gaps",
    ),
    "exchange-leaves-the-arm": Defect(
        product.EXCHANGE,
        "import os; from drivers.exchange.serving import Serving; "
        "Serving._orphan = lambda *_: os._exit(0)",
        "while the arm moved",
    ),
}

_SITE: Final = """import sys
if {module!r} in sys.orig_argv:
    {code}
"""


def planted(name: str, folder: Path) -> Path:
    """A folder that plants a defect in whoever has it on the path."""
    defect, there = DEFECTS[name], folder / "planted"
    there.mkdir()
    (there / "sitecustomize.py").write_text(
        _SITE.format(module=defect.module, code=defect.code), "utf-8"
    )
    return there
