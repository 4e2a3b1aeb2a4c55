"""Import of recordings of other programs: logs of numbers (text, arrays) and rosbag2."""

from hil.importers.column_map import ColumnMap, Quantity, TimeColumn
from hil.importers.dh import Convention, convention_of, urdf_of_dh
from hil.importers.log import import_log
from hil.importers.robot import IMPORTED_LAW, STANDARD_GRAVITY, Robot, Use
from hil.importers.rosbag2 import Clock, Effort, import_rosbag2, recorded_joints

__all__ = [
    "IMPORTED_LAW",
    "STANDARD_GRAVITY",
    "Clock",
    "ColumnMap",
    "Convention",
    "Effort",
    "Quantity",
    "Robot",
    "TimeColumn",
    "Use",
    "convention_of",
    "import_log",
    "import_rosbag2",
    "recorded_joints",
    "urdf_of_dh",
]
