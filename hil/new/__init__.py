"""Generation of a commented cell file from a URDF, a controller or an archive."""

from .cell_text import NewCell, cell_of_dh, cell_of_urdf
from .known import Known, from_archive, from_init, read_init

__all__ = [
    "Known",
    "NewCell",
    "cell_of_dh",
    "cell_of_urdf",
    "from_archive",
    "from_init",
    "read_init",
]
