"""Cell file: robot, drive train, controller link and limits in one TOML file."""

from .cell import AngleFrame, Cell
from .errors import CellError

__all__ = ["AngleFrame", "Cell", "CellError"]
