"""Generation of a commented cell file from a URDF, a controller or an archive."""

from .cell_text import NewCell, cell_of_dh, cell_of_parameters, cell_of_urdf
from .cell_values import CellValues, from_archive, from_init, read_init
from .ur_values import UrArmStatements, ask_arm, cell_of_arm

__all__ = [
    "CellValues",
    "NewCell",
    "UrArmStatements",
    "ask_arm",
    "cell_of_arm",
    "cell_of_dh",
    "cell_of_parameters",
    "cell_of_urdf",
    "from_archive",
    "from_init",
    "read_init",
]
