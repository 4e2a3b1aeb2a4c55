"""The cell: robot + drive train + controller link + limits, from one TOML file."""

from .cell import AngleFrame, Cell
from .errors import CellError

__all__ = ["AngleFrame", "Cell", "CellError"]
