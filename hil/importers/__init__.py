"""Foreign recordings into archives: CSV logs and rosbag2."""

from hil.importers.column_map import ColumnMap, Quantity, TimeColumn
from hil.importers.csv import import_csv
from hil.importers.robot import Robot
from hil.importers.rosbag2 import import_rosbag2

__all__ = [
    "ColumnMap",
    "Quantity",
    "Robot",
    "TimeColumn",
    "import_csv",
    "import_rosbag2",
]
