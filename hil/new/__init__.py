"""A commented cell file for a new arm, from its URDF and what its controller or an archive says."""

from .cell_text import NewCell, cell_of_dh, cell_of_urdf, with_clear_home
from .known import Known, from_archive, from_init, read_init

__all__ = [
    "Known",
    "NewCell",
    "cell_of_dh",
    "cell_of_urdf",
    "from_archive",
    "from_init",
    "read_init",
    "with_clear_home",
]
