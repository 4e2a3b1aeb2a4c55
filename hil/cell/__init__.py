"""The cell: robot + drive train + controller link + limits, from one TOML file."""

from .cell import Cell
from .errors import CellError
from .frame import AngleFrame

__all__ = ["AngleFrame", "Cell", "CellError"]
