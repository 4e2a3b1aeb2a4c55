"""Cell file: robot, drive train, controller link and limits in one TOML file.

Names are imported on first use.
"""

from typing import TYPE_CHECKING

from hil.base.first_use import on_first_use

if TYPE_CHECKING:
    from hil.cell.cell import AngleFrame, Cell
    from hil.cell.errors import CellError

__all__ = ["AngleFrame", "Cell", "CellError"]

if not TYPE_CHECKING:
    __getattr__, __dir__ = on_first_use(
        __name__,
        {
            "hil.cell.cell": (
                "AngleFrame",
                "Cell",
            ),
            "hil.cell.errors": ("CellError",),
        },
    )
